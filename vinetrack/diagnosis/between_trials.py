"""Differences between trials as hypotheses: n by vine, drift with the order of trials, specimens, days.

A tube that wears, another tube for the high pressures, or a gauge whose zero changes between days changes B or the
pressure of whole groups of trials. Where all replicates of a condition are in one group, this is indistinguishable from
physics that depends on the condition. Such differences are therefore hypotheses like the effects of the catalogue:

    ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
    P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random effects of trials

A hypothesis is an entry of `BETWEEN`, a function that lists its forms, of which the best counts.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import fdtrc

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import within_groups
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, full_fit, likelihood_ratio, stand_in
from vinetrack.diagnosis.result import BETWEEN_TRIALS
from vinetrack.effects import Effect, Parameter
from vinetrack.experiment.folder import trial_order
from vinetrack.inference.errors import with_systematics
from vinetrack.inference.fit_result import DAMPING, EXPONENT, BetweenTerm, Fit, groups_of
from vinetrack.inference.marginal_likelihood import deviances, estimate_between_trial_sd, marginal
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE
from vinetrack.inference.systematics import with_unknowns

ORDER_DRIFT, SPECIMEN = "order_drift", "specimen"


@dataclass(frozen=True)
class Difference:
    """One form of a hypothesis: terms of pressure or ln B, or parameters that vines no longer share (`shared`). It is
    `stated` by a column of the sheet or assumed, and the best of `n_forms`; `reach` is its largest plausible size.
    """

    name: str
    terms: tuple[BetweenTerm, ...] = ()
    shared: Mapping[str, str] = field(default_factory=dict)
    stated: bool = True
    confounded: bool = True
    reach: float = math.inf
    n_forms: int = 1
    gain: float = 0.0
    p: float = 1.0


# ------------------------------------------------------------------------------
# Forms of the hypotheses: which parameter differs between which trials, and whether that follows the conditions.

MIN_TRIALS_EACH_SIDE = 2  # Minimum number of trials before and after a change (derived)

FEWEST_TRIALS = 6  # Number of trials from which drifts and changes are tested (chosen)


def _of_vines(name: str, fit: Fit, _: Solution) -> list[Difference]:
    """An exponent for each vine, where they share one."""
    n_exponents = sum(number.key == EXPONENT for number in fit.predictor.layout.free)
    several = len({trial.trial.vine for trial in fit.trials}) > 1
    return [Difference(name, shared={EXPONENT: "vine"})] if several and n_exponents == 1 else []


def _of_order(name: str, fit: Fit, base: Solution) -> list[Difference]:
    """Drift of ln B with the earlier trials of the same tube, and of ln P with all earlier trials; and a step of ln P
    from the likeliest trial on, as where a regulator is set again.
    """
    trials = [trial.trial for trial in fit.trials]
    if len(trials) < FEWEST_TRIALS:
        return []
    ranks, stated = trial_order(trials)
    uses, count = np.zeros(ranks.size), Counter[str]()
    for i in np.argsort(ranks):
        uses[i] = count[trials[i].group(SPECIMEN)]
        count[trials[i].group(SPECIMEN)] += 1
    driven = all(trial.pressure_Pa > 0 for trial in trials)

    def form(key: str, symbol: str, unit: str, reach: float, groups: Sequence[str], regressor: Floats) -> Difference:
        term = BetweenTerm(f"{name}.{key}", symbol, unit, key != "B", tuple(groups), regressor, scale=0.01)
        varying = np.where([bool(group) for group in groups], regressor, 0.0)[:, None]
        return Difference(name, (term,), stated=stated, confounded=confounded(varying, trials), reach=reach)

    # 0.05, 0.05, 0.01: largest plausible step of ln P, and drift of ln B and of ln P per trial (chosen)
    def step(first: int) -> Difference:
        begin = trials[int(np.argsort(ranks)[first])]
        groups = [f"from {begin.name} on" if rank >= first else "" for rank in ranks]
        return form("step", "ΔlnP", "", 0.05, groups, np.ones(ranks.size))

    every = ("all",) * ranks.size
    drifts = (("B", "dlnB", 0.05, uses), ("P", "dlnP", 0.01, ranks)) if driven else (("B", "dlnB", 0.05, uses),)
    forms = [form(key, symbol, "1/trial", reach, every, past) for key, symbol, reach, past in drifts if past.any()]
    begins = range(MIN_TRIALS_EACH_SIDE, len(trials) - MIN_TRIALS_EACH_SIDE + 1)
    if driven:
        forms.append(replace(_likeliest(fit, base, map(step, begins)), n_forms=len(begins)))
    return forms


def of_column(name: str, fit: Fit, _: Solution, **sd: float) -> list[Difference]:
    """Differences between the groups of the text column so named, with these standard deviations, see `_of_groups`."""
    trials = [trial.trial for trial in fit.trials]
    stated = all(getattr(trial, name) for trial in trials)
    return _of_groups(name, [trial.group(name) for trial in trials], trials, stated, **sd) if stated else []


def _of_specimens(name: str, fit: Fit, base: Solution, **sd: float) -> list[Difference]:
    """Differences between specimens. Where they are not stated, changes of tube: from some trial of each vine on, or
    with each condition. A tube for each condition is possible only where replicates were made consecutively.
    """
    trials = [trial.trial for trial in fit.trials]
    if all(trial.specimen for trial in trials):
        # A vine with a single tube has its own B already.
        tubes = Counter(vine for vine, _ in {(trial.vine, trial.specimen) for trial in trials})
        return _of_groups(
            name, [trial.group(name) if tubes[trial.vine] > 1 else "" for trial in trials], trials, True, **sd
        )
    if len(trials) < FEWEST_TRIALS:
        return []
    ranks, _ = trial_order(trials)
    groups = [""] * len(trials)
    for vine in dict.fromkeys(trial.vine for trial in trials):
        members = sorted((i for i, trial in enumerate(trials) if trial.vine == vine), key=lambda i: ranks[i])
        later = []
        for first in range(MIN_TRIALS_EACH_SIDE, len(members) - MIN_TRIALS_EACH_SIDE + 1):
            after = set(members[first:])
            apart = [f"{vine}, later tube" if i in after else group for i, group in enumerate(groups)]
            later.append(_of_groups(name, apart, trials, False, **sd)[-1])
        if later:
            groups = list(_likeliest(fit, base, later).terms[0].groups)
    conditions = [trial.condition for trial in trials]
    changes = _of_groups(name, groups, trials, False, **sd) if any(groups) else []
    made = [conditions[i] for i in np.argsort(ranks)]
    if 1 < len(set(made)) == len(list(itertools.groupby(made))) < len(made):
        changes += _of_groups(name, conditions, trials, False, **sd)
    return changes


def _of_groups(
    name: str,
    groups: Sequence[str],
    trials: Sequence[Trial],
    stated: bool,
    /,
    *,
    B_sd: float = 0.0,
    pressure_sd_Pa: float = 0.0,
    gain_sd: float = 0.0,
) -> list[Difference]:
    """Forms in which groups differ, those with a standard deviation: in ln B, in pressure, in both, or by a factor of
    the pressure.
    """
    labels = [label for label in dict.fromkeys(groups) if label]
    if len(labels) < 2 and stated:
        return []
    pressures_Pa = np.array([trial.pressure_Pa for trial in trials])
    driven = np.isfinite(pressures_Pa) & (pressures_Pa > 0)
    per_Pa, ones = np.where(driven, 1 / np.where(driven, pressures_Pa, 1.0), 0.0), np.ones(len(trials))
    terms = {
        key: BetweenTerm(f"{name}.{key}", symbol, unit, key != "B", tuple(groups), regressor, sd, sd)
        for key, symbol, unit, regressor, sd in (
            ("B", "ΔlnB", "", ones, B_sd),
            ("P", "ΔP", "Pa", per_Pa, pressure_sd_Pa),
            ("gain", "ΔlnP", "", ones, gain_sd),
        )
        if sd > 0 and (driven.any() or key == "B")
    }
    is_confounded = confounded(np.array([[group == label for label in labels] for group in groups], float), trials)
    return [
        Difference(name, tuple(terms[key] for key in keys), stated=stated, confounded=is_confounded)
        for keys in (("B",), ("P",), ("B", "P"), ("gain",))
        if terms.keys() >= set(keys)
    ]


def confounded(regressors: Floats, trials: Sequence[Trial]) -> bool:
    """Whether regressors are confounded with the conditions: they hardly vary among replicates. The criterion is the
    mean square within conditions over that within vines, 1 on average for trials in random order. Without replicates
    they are always confounded. Shapes: regressors (n_trials, k).
    """
    in_conditions, inner_degrees = within_groups(regressors, [trial.condition for trial in trials])
    in_vines, outer_degrees = within_groups(regressors, [trial.vine for trial in trials])
    if inner_degrees == 0 or np.allclose(in_vines, 0.0):
        return True
    # 0.5: A difference is confounded with the conditions if its variance within conditions is below this fraction
    # of that in random order (1 on average) (chosen)
    return bool(np.sum(in_conditions**2) / inner_degrees < 0.5 * np.sum(in_vines**2) / max(outer_degrees, 1))


# Hypotheses that trials differ, by their names in an answer set: what lists their forms, given this name, that the
# trials of a fit, linearised at a solution, can test; standard deviations are chosen
BETWEEN: dict[str, Callable[[str, Fit, Solution], Sequence[Difference]]] = {
    "n_by_vine": _of_vines,
    ORDER_DRIFT: _of_order,
    SPECIMEN: partial(_of_specimens, B_sd=0.06, pressure_sd_Pa=300.0),
    "day": partial(of_column, B_sd=0.03, pressure_sd_Pa=300.0, gain_sd=0.03),
}


# ------------------------------------------------------------------------------
# What a difference would gain, from the linear mixed model of a fit, without simulations.


def differences(fit: Fit) -> list[Difference]:
    """Hypotheses that trials differ, each in its best form, with their predicted gains and p-values."""
    if DAMPING not in fit.predictor.layout.keys:
        return []
    base, best = with_systematics(fit.predictor, fit.solution).solution, list[Difference]()
    for name, forms_of in BETWEEN.items():
        forms, estimated = forms_of(name, fit, base), list[Difference]()
        for form in forms:
            widened = _widened(fit, base, form)
            gain = _deviance(base, base) - _deviance(widened, base)
            if math.isfinite(gain):
                p = _p_value(fit, form, gain, widened.problem.prior_mean.size - base.problem.prior_mean.size)
                n_forms = form.n_forms * len(forms)
                estimated.append(replace(form, gain=gain, n_forms=n_forms, p=min(p * n_forms, 1.0)))
        # By the fall of −2 ln L, less the penalty 2 ln N for the choice among N forms
        best += sorted(estimated, key=lambda form: 2 * math.log(form.n_forms) - form.gain)[:1]
    return best


def _p_value(fit: Fit, difference: Difference, gain: float, extra: int) -> float:
    """p-value of a gain by `extra` coefficients where trials do not differ. For fixed ones by the F test, LR = N ln(1 +
    q F / dof): χ² would be anticonservative for few trials. For random effects exp(gain / 2) would be a Bayes factor K,
    P(K > 1/α) ≤ α by Markov's inequality, were it not for parameters and scatter, which both hypotheses fit: in
    simulations of 8 to 24 trials in 2 to 6 groups, α was exceeded by no more than 0.07 α.
    """
    if gain <= 0:
        return 1.0
    if any(math.isfinite(term.prior_sd) for term in difference.terms):
        return min(1.0, math.exp(-0.5 * gain))
    trials = len(fit.trials)
    spare = max(trials - int(np.count_nonzero(fit.predictor.layout.prior_precision == 0)) - extra, 1)
    return float(fdtrc(extra, spare, math.expm1(min(gain / trials, 500.0)) * spare / extra))


def _likeliest(fit: Fit, base: Solution, forms: Iterable[Difference]) -> Difference:
    """The form that gains most at the between-trial standard deviations of the solution."""
    return min(forms, key=lambda form: _deviance(_widened(fit, base, form), base, base.state.spread))


def _deviance(solution: Solution, base: Solution, spread: tuple[float, float] | None = None) -> float:
    """−2 ln L, minimised over the parameters and, unless given, the between-trial standard deviations that `base`
    estimates.
    """
    problem, state = solution.problem, solution.state
    part = marginal(solution.cross_products, problem, state)
    if spread is None:
        spread = estimate_between_trial_sd(part, problem, state, base.estimable, restricted=False)
    return float(deviances(part, problem, state, np.array([spread]), restricted=False)[0])


def _widened(fit: Fit, base: Solution, difference: Difference) -> Solution:
    """A solution with the coefficients of a difference added, all zero. Each is a multiple of a column that the
    solution has: that of a trial's deviation, or of a parameter that vines shared.
    """
    columns, groups, factors, precisions = [], [], [], []
    for term in difference.terms:
        columns.append(PRESSURE if term.pressure else DAMPING_DEVIATION)
        groups.append(term.groups)
        factors.append(term.scale * term.regressor)
        precisions.append((term.scale / term.prior_sd) ** 2)
    for key, how in difference.shared.items():
        columns.append(base.problem.n_effects + fit.predictor.layout.keys.index(key))
        of_trials = groups_of([trial.trial for trial in fit.trials], how)
        groups.append(tuple("" if group == of_trials[0] else group for group in of_trials))
        factors.append(np.ones(len(of_trials)))
        precisions.append(0.0)
    members = [[group for group in dict.fromkeys(of_trials) if group] for of_trials in groups]
    first = base.problem.prior_mean.size + np.cumsum([0, *map(len, members)])
    places = [
        [begin + names.index(group) if group else -1 for group in of_trials]
        for begin, names, of_trials in zip(first[:-1], members, groups, strict=True)
    ]
    precision = np.repeat(precisions, [len(names) for names in members])
    problem = with_unknowns(base.problem, precision.size, precision)
    problem = replace(
        problem,
        index=np.column_stack([base.problem.index, *places]),
        random=np.append(base.problem.random, precision > 0),
    )
    size = base.cross_products.shape[-1]
    T = np.zeros((len(base.cross_products), size, size + len(columns)))
    T[:, range(size - 1), range(size - 1)] = T[:, -1, -1] = 1.0
    for k, (column, factor) in enumerate(zip(columns, factors, strict=True)):
        T[:, column, size - 1 + k] = np.where(problem.index[:, base.problem.index.shape[1] + k] >= 0, factor, 0.0)
    cross_products = np.einsum("nka,nckl,nlb->ncab", T, base.cross_products, T, optimize=True)
    theta = np.append(base.state.theta, np.zeros(precision.size))
    return replace(base, cross_products=cross_products, problem=problem, state=replace(base.state, theta=theta))


# ------------------------------------------------------------------------------
# Differences that matter, and their fits.

MIN_LINEAR_GAIN = 2.0  # Predicted fall of −2 ln L below which a difference is not fitted (chosen)


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
        fit = full_fit(before, between=between, shared=difference.shared)
        if fit is None:
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
    plausible = (-difference.reach, difference.reach) if math.isfinite(difference.reach) else None
    described = [(term.key, term.symbol, term.unit) for term in difference.terms]
    described += [(key, key, "") for key in difference.shared]
    parameters = [
        Parameter(key.split(".")[1], symbol, unit, 0.0, plausible=plausible) for key, symbol, unit in described
    ]
    return stand_in(difference.name, BETWEEN_TRIALS, tuple(parameters))
