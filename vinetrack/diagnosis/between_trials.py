"""Differences between trials as hypotheses: n by vine, drift with the order of trials, specimens, days.

A tube that wears, another tube for the high pressures, or a gauge whose zero changes between days changes B or the
pressure of whole groups of trials. Where all replicates of a condition are in one group, this is indistinguishable from
physics that depends on the condition. Such differences are therefore hypotheses like the effects of the catalogue:

    ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
    P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random effects of trials
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.likelihood_ratio import (
    Difference,
    LikelihoodRatio,
    gain_p_value,
    likelihood_ratio,
    linear_gain,
)
from vinetrack.diagnosis.result import (
    BETWEEN,
    BETWEEN_TRIALS,
    N_BY_VINE,
    ORDER_DRIFT,
    SPECIMEN,
)
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.experiment.folder import trial_order
from vinetrack.inference.errors import with_systematics
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, EXPONENT, BetweenTerm, Fit
from vinetrack.inference.optimiser import Solution

# ------------------------------------------------------------------------------
# Hypotheses that trials differ: which parameter differs, by which column of the sheet, and whether it is confounded.
#
# Each hypothesis has several forms, of which the best counts: a drift of B, a drift of the pressure, or a step of the
# pressure from some trial on; specimens and days differ in B, in pressure, or in both. `between_trials` states the
# model and compares the hypotheses.

MIN_TRIALS_EACH_SIDE = 2  # Minimum number of trials before and after a change (derived)

FEWEST_TRIALS = 6  # Number of trials from which drifts and changes are tested (chosen)


def forms_of(fit: Fit, base: Solution) -> list[Difference]:
    """List every form of every hypothesis that these trials can test."""
    trials, forms = [trial.trial for trial in fit.trials], list[Difference]()
    n_exponents = sum(number.key == EXPONENT for number in fit.predictor.layout.free)
    if n_exponents == 1 and len({trial.vine for trial in trials}) > 1:
        forms.append(Difference(N_BY_VINE, shared={EXPONENT: "vine"}))
    enough = len(trials) >= FEWEST_TRIALS
    forms += _of_order(fit, base, trials) if enough else ()
    # Groups that columns of the sheet state; a vine with a single tube has its own B already.
    tubes = Counter(vine for vine, _ in {(trial.vine, trial.specimen) for trial in trials})
    for name in BETWEEN:
        if all(getattr(trial, name, "") for trial in trials):
            alone = [name == SPECIMEN and tubes[trial.vine] == 1 for trial in trials]
            groups = ["" if one else trial.group(name) for one, trial in zip(alone, trials, strict=True)]
            forms += _forms(name, groups, trials)
    forms += _changes(fit, base, trials) if enough else ()
    n_forms = Counter(difference.name for difference in forms)
    return [replace(difference, n_forms=difference.n_forms * n_forms[difference.name]) for difference in forms]


def _of_order(fit: Fit, base: Solution, trials: Sequence[Trial]) -> list[Difference]:
    """Drift of ln B with the earlier trials of the same tube, and of ln P with all earlier trials; and a step of ln P
    from the likeliest trial on, as where a regulator is set again.
    """
    ranks, stated = trial_order(trials)
    uses, count = np.zeros(ranks.size), Counter[str]()
    for i in np.argsort(ranks):
        uses[i] = count[trials[i].group(SPECIMEN)]
        count[trials[i].group(SPECIMEN)] += 1
    driven = all(trial.pressure_Pa > 0 for trial in trials)

    def form(key: str, symbol: str, unit: str, groups: Sequence[str], regressor: Floats) -> Difference:
        term = BetweenTerm(f"{ORDER_DRIFT}.{key}", symbol, unit, key != "B", tuple(groups), regressor, scale=0.01)
        varying = np.where([bool(group) for group in groups], regressor, 0.0)[:, None]
        return Difference(ORDER_DRIFT, (term,), stated=stated, confounded=confounded(varying, trials))

    def step(first: int) -> Difference:
        begin = trials[int(np.argsort(ranks)[first])]
        groups = [f"from {begin.name} on" if rank >= first else "" for rank in ranks]
        return form("step", "ΔlnP", "", groups, np.ones(ranks.size))

    every = ("all",) * ranks.size
    drifts = (("B", "dlnB", uses), ("P", "dlnP", ranks)) if driven else (("B", "dlnB", uses),)
    forms = [form(key, symbol, "1/trial", every, past) for key, symbol, past in drifts if past.any()]
    begins = range(MIN_TRIALS_EACH_SIDE, len(trials) - MIN_TRIALS_EACH_SIDE + 1)
    if driven:
        forms.append(replace(_likeliest(fit, base, map(step, begins)), n_forms=len(begins)))
    return forms


def _likeliest(fit: Fit, base: Solution, forms: Iterable[Difference]) -> Difference:
    """The form that gains most."""
    return max(forms, key=lambda form: linear_gain(fit, base, form, base.state.spread))


def _forms(name: str, groups: Sequence[str], trials: Sequence[Trial], *, stated: bool = True) -> list[Difference]:
    """Forms in which groups differ: in B, in pressure, in both, or by a factor of the pressure."""
    if len({group for group in groups if group}) < 2 and stated:
        return []
    pressures_Pa = np.array([trial.pressure_Pa for trial in trials])
    driven = np.isfinite(pressures_Pa) & (pressures_Pa > 0)
    per_Pa = np.where(driven, 1 / np.where(driven, pressures_Pa, 1.0), 0.0)
    groups = tuple(groups)
    sd, ones = BETWEEN[name], np.ones(len(groups))
    in_B = BetweenTerm(f"{name}.B", "ΔlnB", "", False, groups, ones, sd.B_sd, sd.B_sd)
    in_P = BetweenTerm(f"{name}.P", "ΔP", "Pa", True, groups, per_Pa, sd.pressure_sd_Pa, sd.pressure_sd_Pa)
    in_gain = BetweenTerm(f"{name}.gain", "ΔlnP", "", True, groups, ones, sd.gain_sd, sd.gain_sd)
    member = np.array([[group == label for label in dict.fromkeys(groups) if label] for group in groups], dtype=float)
    is_confounded = confounded(member, trials)
    return [
        Difference(name, terms, stated=stated, confounded=is_confounded)
        for terms in ((in_B,), (in_P,), (in_B, in_P), (in_gain,))
        if all(term.prior_sd > 0 and (driven.any() or not term.pressure) for term in terms)
    ]


def _changes(fit: Fit, base: Solution, trials: Sequence[Trial]) -> list[Difference]:
    """Changes of tube where specimens are not stated: from some trial of each vine on, or with each condition. A tube
    for each condition is possible only where replicates were made consecutively.
    """
    if all(trial.specimen for trial in trials):
        return []
    ranks, _ = trial_order(trials)
    groups = [""] * len(trials)
    for vine in dict.fromkeys(trial.vine for trial in trials):
        members = sorted((i for i, trial in enumerate(trials) if trial.vine == vine), key=lambda i: ranks[i])
        later = []
        for first in range(MIN_TRIALS_EACH_SIDE, len(members) - MIN_TRIALS_EACH_SIDE + 1):
            after = set(members[first:])
            apart = [f"{vine}, later tube" if i in after else group for i, group in enumerate(groups)]
            later.append(_forms(SPECIMEN, apart, trials, stated=False)[-1])
        if later:
            groups = list(_likeliest(fit, base, later).terms[0].groups)
    conditions = [trial.condition for trial in trials]
    changes = _forms(SPECIMEN, groups, trials, stated=False) if any(groups) else []
    made = [conditions[i] for i in np.argsort(ranks)]
    if 1 < len(set(made)) == len(list(itertools.groupby(made))) < len(made):
        changes += _forms(SPECIMEN, conditions, trials, stated=False)
    return changes


def confounded(regressors: Floats, trials: Sequence[Trial]) -> bool:
    """Whether regressors are confounded with the conditions: they hardly vary among replicates. The criterion is the
    mean square within conditions over that within vines, 1 on average for trials in random order. Without replicates
    they are always confounded. Shapes: regressors (n_trials, k).
    """
    in_conditions, inner_degrees = _square_within(regressors, [trial.condition for trial in trials])
    in_vines, outer_degrees = _square_within(regressors, [trial.vine for trial in trials])
    if inner_degrees == 0 or in_vines == 0:
        return True
    # 0.5: A difference is confounded with the conditions if its variance within conditions is below this fraction
    # of that in random order (1 on average) (chosen)
    return in_conditions / inner_degrees < 0.5 * in_vines / max(outer_degrees, 1)


def _square_within(values: Floats, groups: Sequence[str]) -> tuple[float, int]:
    """Sum of squares about the group means, and its degrees of freedom."""
    total, names = 0.0, sorted(set(groups))
    for name in names:
        member = values[np.array([group == name for group in groups])]
        total += float(np.sum((member - member.mean(axis=0)) ** 2))
    return total, len(groups) - len(names)


# Largest plausible drift of ln B and of ln P per trial, and step of ln P (chosen)
PLAUSIBLE_DRIFT = {"B": 0.05, "P": 0.01, "step": 0.05}


MIN_LINEAR_GAIN = 2.0  # Predicted fall of −2 ln L below which a difference is not fitted (chosen)


def differences(fit: Fit) -> list[Difference]:
    """Hypotheses that trials differ, with their predicted gains and p-values."""
    if DAMPING not in fit.predictor.layout.keys:
        return []
    base = with_systematics(fit.predictor, fit.solution, fit.options.get("held")).solution
    best: dict[str, Difference] = {}
    for difference in forms_of(fit, base):
        gain = linear_gain(fit, base, difference)
        if not math.isfinite(gain):
            continue
        p = gain_p_value(fit, difference, gain)
        estimated = replace(difference, gain=gain, p=min(p * difference.n_forms, 1.0))
        known = best.get(difference.name)
        if known is None or estimated.penalised_gain > known.penalised_gain:
            best[difference.name] = estimated
    return list(best.values())


def significant(estimated: Sequence[Difference], level: float) -> list[Difference]:
    """Significant differences that are confounded with the conditions, so that they could pass for physics. Random
    order and replicates separate a difference from the conditions; it is then a random deviation of the trials, which
    the fit includes. Differences by a column of the sheet make a model inadequate.
    """
    return [difference for difference in estimated if difference.confounded and difference.p < level / len(estimated)]


def between_fits(
    before: Fit, estimated: Sequence[Difference], best: float, report: Callable[[str], None]
) -> list[LikelihoodRatio]:
    """Fit the differences whose predicted gain is near the best Δχ² of the effects."""
    fitted: list[LikelihoodRatio] = []
    for difference in estimated:
        # 40.0: predicted −2 ln L by which a difference may be behind the best hypothesis and still be fitted (chosen)
        if difference.gain < MIN_LINEAR_GAIN or difference.gain < best - max(40.0, 0.3 * best):
            continue
        report(f"fitting {difference.name}")
        between = (*before.predictor.layout.between, *difference.terms)
        try:
            # 14, 30: iterations of the fit of a difference, at first and in all (chosen)
            fit = refit(before, between=between, shared=difference.shared, most_iterations=14)
            fit = fit if fit.converged else refit(fit, most_iterations=30)
        except (FitError, SimulationError, np.linalg.LinAlgError):
            continue
        # Exponents of several vines are as many sizes, less the one they had; random effects are integrated out.
        sizes = max(len(fit.numbers) - len(before.numbers), 1) if difference.shared else 1
        # The robust error of a random effect's coefficient, from the few trials of its group, is meaningless.
        random = any(math.isfinite(term.prior_sd) for term in difference.terms)
        widened_by = () if random else (difference.name, *difference.shared)
        ratio = likelihood_ratio(before, (_effect_of(difference),), fit, widened_by=widened_by, sizes=sizes)
        fitted.append(replace(ratio, split=tuple(difference.shared)))
    return fitted


def _effect_of(difference: Difference) -> Effect:
    """The difference in the form of an effect, for the tables of candidates and the answer set."""
    described = [(term.key, term.symbol, term.unit) for term in difference.terms]
    parameters = []
    for key, symbol, unit in described or [(key, key, "") for key in difference.shared]:
        name = key.split(".")[1]
        limit = PLAUSIBLE_DRIFT[name] if difference.name == ORDER_DRIFT else 0.0
        parameters.append(Parameter(name, symbol, unit, 0.0, plausible=(-limit, limit) if limit else None))
    return Effect(
        name=difference.name,
        kind=BETWEEN_TRIALS,
        summary=BETWEEN[difference.name].summary,
        text=BETWEEN[difference.name].summary,
        parameters=tuple(parameters),
        functions={},
        path=Path(difference.name),
    )
