"""Differences between trials as explanations: n by vine, drift with the order of trials, specimens, days.

A tube that wears, another tube for the high pressures or a gauge whose zero moves from day to day changes B or the
pressure of whole groups of trials. Where all replicates of a condition share the group, that looks exactly like physics
that follows the condition. So such differences are hypotheses of the diagnosis like the effects of the catalogue:

    ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
    P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random from trial to trial

with z_gj the number of trials that the vine (or specimen) of trial j has seen (pressure: all trials before, as a supply
empties or a regulator creeps), or 1 in group g and 0 elsewhere (pressure: 1 kPa / P_set,j, a shift of the zero of the
gauge or of P_y, which are the same to a force (P − P_y) A).
Coefficients of groups are random effects with a prior, integrated out of the likelihood, so that a hypothesis with many
groups pays for each of them; a drift has one coefficient, fixed. All are compared by the same Δχ² as effects are.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.between_gain import (
    Difference,
    beside_systematics,
    beside_trace_errors,
    chance_of_gain,
    gains_from_each,
    linear_gain,
)
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.result import (
    BETWEEN_SUMMARIES,
    BETWEEN_TRIALS,
    DAY,
    N_BY_VINE,
    ORDER_DRIFT,
    REFITTED,
    SPECIMEN,
    Candidate,
)
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.experiment.trial_order import trial_order
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.parameters import DAMPING, EXPONENT, BetweenTerm
from vinetrack.inference.position_errors import with_smooth_errors

SPECIMEN_B_SD, SPECIMEN_PA_SD = 0.06, 300.0
"""Standard deviation of ln B and of P_y among tubes of one kind. Chosen: tubes of a batch differ by 3 to 8 % in B and a
few tenths of a kPa; at half and twice, ln L of a hypothesis moves by about ln 2 for each coefficient of a group."""

DAY_B_SD, DAY_PA_SD = 0.03, 300.0
"""The same from day to day: film in other air, a gauge zeroed anew. Chosen: a gauge holds its zero to 0.3 kPa."""

PLAUSIBLE_DRIFT = {"B": 0.05, "P": 0.01}
"""Change of ln B a trial that is still plausible, and of ln P. Chosen: a tube whose B rises by 5 % a trial is done for
after ten; a supply that loses 1 % a trial has lost a fifth after twenty, and somebody has looked at the gauge."""

DRIFT_FORMS = 2
"""Forms of a drift, of B and of the pressure. Derived: where the better one counts, chance is that of either."""

FEWEST_TRIALS = 6
"""Trials from which a drift or a change is asked for: below, any order of a few pressures is like any other. Chosen:
with six, one order in 360 is the strict one, either way. At half chance orders pass for drifts, at twice small
campaigns are never asked."""

OUT_OF_REACH = 40.0
"""How far in −2 ln L the linear estimate may stay behind the best hypothesis and still be fitted. Chosen: well above
the answer set's 9 times the usual inflation of 1 to 3; twice as much only costs time."""

LEAST_GAIN = 2.0
"""Fall of −2 ln L below which a difference is not fitted. Chosen: a fifth of what the gate asks for."""

ASKED_AGAIN = 0.01
"""Chance below which a difference is also asked beside the errors that all replicates of a condition share. Chosen for
time: three times the level of all tests of a first model, so that at half of it as at twice nothing that would be
called goes unasked; beside more errors no difference gains chance."""

SPREAD_OVER_CONDITIONS = 0.5
"""A difference counts as confounded with the conditions where it varies within them by less than this part of what
random order gives (1 on average). Chosen: replicates in adjacent places give under 0.1, random order 0.6 to 1.3."""

FIRST_ITERATIONS, MORE_ITERATIONS = 14, 30
"""Iterations of the fit of a difference: at first, and in all. Chosen for time; a fit that has not settled by then says
so."""


@dataclass(frozen=True)
class BetweenRatio(LikelihoodRatio):
    """The likelihood ratio of a difference between trials; `difference` tells which."""

    difference: Difference = field(default_factory=lambda: Difference(""))

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Its coefficients, or the exponents of the vines."""
        keys = {term.key for term in self.difference.terms} | set(self.difference.shared)
        return tuple(number for number in self.fit.numbers if number.key in keys and math.isfinite(number.sigma))

    @property
    def others(self) -> tuple[Number, ...]:
        """All other numbers of its fit."""
        keys = {number.name for number in self.numbers}
        return tuple(number for number in self.fit.numbers if number.name not in keys)


def differences(fit: Fit) -> list[Difference]:
    """The hypotheses that trials differ which these data allow, each with its linear estimate.

    Parameters
    ----------
    fit
        The fit that is questioned.

    Returns
    -------
    list
        Of the forms of a hypothesis (B, pressure, both) the one that gains most.
    """
    if DAMPING not in fit.predictor.layout.keys:
        return []
    trials = [trial.trial for trial in fit.trials]
    plain = with_smooth_errors(fit)
    base = beside_trace_errors(fit, plain)
    best: dict[str, Difference] = {}
    for difference in (*_law(fit, trials), *_drifts(trials), *_groups(trials), *_changes(fit, base, trials)):
        estimated = _estimated(fit, plain, base, difference)
        if estimated is not None and (difference.name not in best or estimated.gain > best[difference.name].gain):
            best[difference.name] = estimated
    return list(best.values())


def called(among: Sequence[Difference], level: float) -> list[Difference]:
    """Differences that alone make a model inadequate: significant, stated by the sheet, and confounded with conditions.

    One that random order or replicates keep apart from the conditions is a random deviation of the trials, which the
    fit allows for. `level` is the chance of a false alarm of them all (Bonferroni).

    Parameters
    ----------
    among : sequence of Difference
        Those that were estimated.
    level : float
        Chance of a false alarm of them all.

    Returns
    -------
    list of Difference
    """
    return [
        difference
        for difference in among
        if difference.stated and difference.confounded and difference.p < level / len(among)
    ]


def between_fits(
    before: Fit, among: Sequence[Difference], best: float, report: Callable[[str], None]
) -> list[LikelihoodRatio]:
    """Fits of the differences whose estimate comes near the `best` Δχ² of the effects.

    Parameters
    ----------
    before
        The fit that is questioned.
    among : sequence of Difference
        Those that were estimated.
    best : float
        Largest Δχ² of the effects.
    report : callable
        Called with a sentence at each fit.

    Returns
    -------
    list of LikelihoodRatio
    """
    fitted: list[LikelihoodRatio] = []
    for difference in among:
        if difference.gain < LEAST_GAIN or difference.gain < best - max(OUT_OF_REACH, 0.3 * best):
            continue
        report(f"fitting {difference.name}")
        fit = _fitted(before, difference)
        if fit is None:
            continue
        ratio = likelihood_ratio(before, (_effect_of(difference),), fit, widened_by=_widened_by(difference))
        fitted.append(BetweenRatio(**{**vars(ratio), "difference": difference}))
    return fitted


def _widened_by(difference: Difference) -> tuple[str, ...]:
    """Names whose scatter from trial to trial takes away from the significance of a difference.

    Those of its numbers; but a coefficient of a random effect, which only the few trials of its group feel, has a
    robust error that says nothing.
    """
    random = any(math.isfinite(term.prior_sd) for term in difference.terms)
    return () if random else (difference.name, *difference.shared)


def _effect_of(difference: Difference) -> Effect:
    """A stand-in for the effect that the tables of candidates and the answer set show."""
    drift = tuple(
        Parameter(name, term.symbol, term.unit, 0.0, plausible=(-PLAUSIBLE_DRIFT[name], PLAUSIBLE_DRIFT[name]))
        for term in difference.terms
        for name in [term.key.split(".")[1]]
        if difference.name == ORDER_DRIFT
    )
    keys = [term.key for term in difference.terms] or list(difference.shared)
    parameters = tuple(Parameter(key.split(".")[1], key, "", 0.0) for key in keys)
    return Effect(
        name=difference.name,
        kind=BETWEEN_TRIALS,
        summary=BETWEEN_SUMMARIES[difference.name],
        text=BETWEEN_SUMMARIES[difference.name],
        parameters=drift or parameters,
        functions={},
        needs=(),
        easily_taken_for=(),
        worked=(),
        path=Path(difference.name),
    )


def _law(fit: Fit, trials: Sequence[Trial]) -> list[Difference]:
    """N of every vine, where there are several with one n."""
    free = [number for number in fit.predictor.layout.free if number.key == EXPONENT]
    if len(free) != 1 or len({trial.vine for trial in trials}) < 2:
        return []
    return [Difference(N_BY_VINE, shared={EXPONENT: "vine"})]


def _tube(trial: Trial) -> str:
    """The tube that a trial was made with: its vine, and the specimen where it is known."""
    return f"{trial.vine}, {trial.specimen}" if trial.specimen else trial.vine


def _drifts(trials: Sequence[Trial]) -> list[Difference]:
    """Ln B by the number of trials that the tube has seen before; pressure by that of all trials before."""
    if len(trials) < FEWEST_TRIALS:
        return []
    ranks, stated = trial_order(trials)
    uses, seen = np.zeros(ranks.size), Counter[str]()
    for i in np.argsort(ranks):
        uses[i] = seen[_tube(trials[i])]
        seen[_tube(trials[i])] += 1
    pressures_Pa = np.array([trial.pressure_Pa for trial in trials])
    forms = (("B", "dlnB", uses), ("P", "dlnP", ranks)) if np.all(pressures_Pa > 0) else (("B", "dlnB", uses),)
    return [
        Difference(
            ORDER_DRIFT,
            (
                BetweenTerm(
                    f"{ORDER_DRIFT}.{name}", symbol, "1/trial", name == "P", ("all",) * ranks.size, past, scale=0.01
                ),
            ),
            stated=stated,
            confounded=confounded(past[:, None], trials),
        )
        for name, symbol, past in forms
        if past.any()
    ]


def _groups(trials: Sequence[Trial]) -> list[Difference]:
    """Specimens and days that the sheet states."""
    differences_found: list[Difference] = []
    if all(trial.specimen for trial in trials):
        tubes = tuple(_tube(trial) for trial in trials)
        # A vine of which there is one tube has a B of its own already.
        several = {vine for vine in (t.vine for t in trials) if len({_tube(t) for t in trials if t.vine == vine}) > 1}
        groups = tuple(tube if trial.vine in several else "" for tube, trial in zip(tubes, trials, strict=True))
        differences_found += _forms(SPECIMEN, groups, trials, SPECIMEN_B_SD, SPECIMEN_PA_SD, stated=True)
    if all(trial.day for trial in trials):
        days = tuple(f"day {trial.day}" for trial in trials)
        differences_found += _forms(DAY, days, trials, DAY_B_SD, DAY_PA_SD, stated=True)
    return differences_found


def _forms(
    name: str, groups: Sequence[str], trials: Sequence[Trial], B_sd: float, pressure_sd_Pa: float, *, stated: bool
) -> list[Difference]:
    """Groups that differ in B, in pressure, or in both."""
    if len({group for group in groups if group}) < 2 and stated:
        return []
    pressures_Pa = np.array([trial.pressure_Pa for trial in trials])
    driven = np.isfinite(pressures_Pa) & (pressures_Pa > 0)
    per_Pa = np.where(driven, 1 / np.where(driven, pressures_Pa, 1.0), 0.0)
    groups = tuple(groups)
    in_B = BetweenTerm(f"{name}.B", "ΔlnB", "", False, groups, np.ones(len(groups)), B_sd, B_sd)
    in_P = BetweenTerm(f"{name}.P", "ΔP", "Pa", True, groups, per_Pa, pressure_sd_Pa, pressure_sd_Pa)
    member = np.array([[group == label for label in dict.fromkeys(groups) if label] for group in groups], dtype=float)
    apart = confounded(member, trials)
    return [
        Difference(name, terms, stated=stated, confounded=apart)
        for terms in ((in_B,), (in_P,), (in_B, in_P))
        if not any(term.pressure for term in terms) or driven.any()
    ]


def _changes(fit: Fit, base: Solution, trials: Sequence[Trial]) -> list[Difference]:
    """Where specimens are not stated: another tube of each vine from some trial on, or for each condition.

    A tube for each condition can only be where replicates were made one after the other.
    """
    if all(trial.specimen for trial in trials) or len(trials) < FEWEST_TRIALS:
        return []
    ranks, _ = trial_order(trials)
    groups = [""] * len(trials)
    for vine in dict.fromkeys(trial.vine for trial in trials):
        members = sorted((i for i, trial in enumerate(trials) if trial.vine == vine), key=lambda i: ranks[i])
        begins = range(2, len(members) - 1)
        if not begins:
            continue
        tube = f"{vine}, later tube"
        whole = [tube if trial.vine == vine else group for trial, group in zip(trials, groups, strict=True)]
        form = _forms(SPECIMEN, whole, trials, SPECIMEN_B_SD, SPECIMEN_PA_SD, stated=False)[-1]
        first = begins[int(np.argmax(gains_from_each(fit, base, form, members, begins)))]
        for i in members[first:]:
            groups[i] = tube
    conditions = [trial.condition for trial in trials]
    changes = _forms(SPECIMEN, groups, trials, SPECIMEN_B_SD, SPECIMEN_PA_SD, stated=False) if any(groups) else []
    if _in_turn(ranks, conditions):
        changes += _forms(SPECIMEN, conditions, trials, SPECIMEN_B_SD, SPECIMEN_PA_SD, stated=False)
    return changes


def _in_turn(ranks: Floats, conditions: Sequence[str]) -> bool:
    """Whether the replicates of every condition were made one after the other."""
    ordered = [conditions[i] for i in np.argsort(ranks)]
    changes = sum(before != after for before, after in itertools.pairwise(ordered))
    return 1 < len(set(conditions)) == changes + 1 < len(conditions)


def confounded(regressors: Floats, trials: Sequence[Trial]) -> bool:
    """Whether regressors, shape (n_trials, k), hardly vary among the replicates of a condition.

    The mean square within conditions over that within vines: 1 on average where trials are in random order. Without
    replicates nothing tells them apart.

    Parameters
    ----------
    regressors : array, shape (n_trials, k)
    trials : sequence of Trial

    Returns
    -------
    bool
    """
    within, inner = _square_within(regressors, [trial.condition for trial in trials])
    whole, outer = _square_within(regressors, [trial.vine for trial in trials])
    if inner == 0 or whole == 0:
        return True
    return within / inner < SPREAD_OVER_CONDITIONS * whole / max(outer, 1)


def _square_within(values: Floats, groups: Sequence[str]) -> tuple[float, int]:
    """Sum of squares about the means of groups, and its degrees of freedom."""
    total, names = 0.0, sorted(set(groups))
    for name in names:
        member = values[np.array([group == name for group in groups])]
        total += float(np.sum((member - member.mean(axis=0)) ** 2))
    return total, len(groups) - len(names)


def _estimated(fit: Fit, plain: Solution, base: Solution, difference: Difference) -> Difference | None:
    """The difference with its linear estimate; None where it cannot be laid out."""
    gain = linear_gain(fit, base, difference)
    if not math.isfinite(gain):
        return None
    p = chance_of_gain(fit, difference, gain)
    if p < ASKED_AGAIN and difference.stated and difference.confounded:
        beside = linear_gain(fit, beside_systematics(fit, plain), difference)
        p = max(p, chance_of_gain(fit, difference, beside))
    return replace(difference, gain=gain, p=min(p * (DRIFT_FORMS if difference.name == ORDER_DRIFT else 1), 1.0))


def _fitted(before: Fit, difference: Difference) -> Fit | None:
    """The difference fitted; None where it cannot be followed."""
    between = (*before.predictor.layout.between, *difference.terms)
    try:
        fit = refit(before, between=between, shared=difference.shared, most_iterations=FIRST_ITERATIONS, thorough=False)
        return fit if fit.converged else refit(fit, most_iterations=MORE_ITERATIONS, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


def between_candidates(
    tried: Sequence[LikelihoodRatio], answer: Sequence[str], aside: Mapping[str, str]
) -> list[Candidate]:
    """Rows of the ranking of candidates for the differences that were fitted.

    Parameters
    ----------
    tried : sequence of LikelihoodRatio
        Hypotheses that were fitted.
    answer : sequence of str
        Names in the answer set.
    aside : mapping
        Why those set aside were, by name.

    Returns
    -------
    list of Candidate
    """
    return [
        Candidate(
            hypothesis.names[0],
            BETWEEN_TRIALS,
            REFITTED,
            hypothesis.delta_chi2,
            hypothesis.sigma,
            hypothesis.numbers,
            hypothesis.plausible,
            hypothesis.names[0] in answer,
            aside.get(hypothesis.names[0], hypothesis.reason),
            {},
            hypothesis.others if hypothesis.names[0] in answer else (),
        )
        for hypothesis in tried
        if hypothesis.effects[-1].kind == BETWEEN_TRIALS
    ]


__all__ = ["BetweenRatio", "Difference", "between_candidates", "between_fits", "called", "differences"]
