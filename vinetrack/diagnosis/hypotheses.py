"""Hypotheses: fits of candidate effects, likelihood ratios, the plausibility of sizes, and the answer set; and
differences between trials, which are hypotheses too: n by vine, drift with the order of trials, specimens, days.

The answer set holds every hypothesis that the data cannot exclude. Which are fitted is in `selection`.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import fdtrc, hyperu, ndtri_exp

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import within_groups
from vinetrack.diagnosis.misfit_tests import is_plausible
from vinetrack.diagnosis.result import BETWEEN_TRIALS
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.experiment.folder import trial_order
from vinetrack.inference.errors import FEWEST_CLUSTERS, robust_variances, with_systematics
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, EXPONENT, BetweenTerm, Fit, Number, groups_of
from vinetrack.inference.optimiser import Solution, is_poor_fit
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE

# ------------------------------------------------------------------------------
# Hypotheses compared with the fit without them, and the answer set: those that the data cannot exclude.

ANSWER_SET_DELTA_CHI2 = 9.0  # A hypothesis whose −2 ln L lies within this of the best cannot be excluded (derived)

# −2 ln L behind the best from which a hypothesis is not looked at again, whatever the scatter of trials (chosen)
OUT_OF_REACH = 54.0

CREDIBLE_RANGE_FACTOR = 3.0  # Multiple of its plausible range within which a size is still credible (chosen)


@dataclass(frozen=True)
class LikelihoodRatio:
    """A hypothesis compared with the fit without it: the effects it adds, its own fit, and the likelihood ratio.
    `delta_chi2` is the fall of −2 ln L, `sigma` the normal deviate as unlikely as that with one degree of freedom a
    size, reduced where trials scatter more than the noise model predicts.
    """

    effects: tuple[Effect, ...]
    fit: Fit
    delta_chi2: float
    sigma: float
    plausible: bool
    reason: Remark
    credible: bool = True
    inflation: float = 1.0
    split: tuple[str, ...] = ()  #: parameters of the model that it splits by groups of trials

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that it adds."""
        return tuple(effect.name for effect in self.effects)

    @property
    def label(self) -> str:
        """Names of the effects, joined by `+`."""
        return "+".join(self.names)

    @property
    def n_parameters(self) -> int:
        """Number of parameters of its effects."""
        return sum(len(effect.parameters) for effect in self.effects)

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Fitted sizes of its effects, without those that no trajectory depends on."""
        return tuple(number for number in self.fit.numbers if self._adds(number) and math.isfinite(number.sigma))

    @property
    def others(self) -> tuple[Number, ...]:
        """All other parameters of its fit."""
        return tuple(number for number in self.fit.numbers if not self._adds(number))

    def _adds(self, number: Number) -> bool:
        return number.key.split(".")[0] in self.names or number.key in self.split

    def contains(self, other: LikelihoodRatio) -> bool:
        """Whether another hypothesis is a limit of this one, which fits as well by construction."""
        return any(name in other.names for effect in self.effects for name in effect.replaces)

    def deviance_excess(self, other: LikelihoodRatio) -> float:
        """−2 ln L of this hypothesis minus that of another."""
        return 2 * (other.fit.log_likelihood - self.fit.log_likelihood)


def best_of(hypotheses: Iterable[LikelihoodRatio]) -> LikelihoodRatio:
    """The hypothesis with the highest likelihood."""
    return max(hypotheses, key=lambda hypothesis: hypothesis.fit.log_likelihood)


def likelihood_ratio(
    before: Fit,
    effects: Sequence[Effect],
    after: Fit,
    *,
    widened_by: Collection[str] | None = None,
    sizes: int | None = None,
) -> LikelihoodRatio:
    """Compare a refit with the fit without the effects."""
    delta_chi2 = 2 * (after.log_likelihood - before.log_likelihood)
    ratio = robust_ratio(after, [effect.name for effect in effects] if widened_by is None else widened_by)
    reason = implausible(effects, after)
    return LikelihoodRatio(
        effects=tuple(effects),
        fit=after,
        delta_chi2=delta_chi2,
        sigma=in_sigmas(delta_chi2 / ratio**2, sizes_of(effects, after) if sizes is None else sizes),
        plausible=not reason,
        reason=reason,
        credible=not implausible(effects, after, CREDIBLE_RANGE_FACTOR),
        inflation=ratio**2,
    )


def size_in_errors(effect: Effect, after: Fit) -> float:
    """Size of an effect in standard errors; the largest where each vine has its own; infinite where none is known."""
    sizes = [
        abs(number.value - parameter.zero) / number.sigma
        for parameter in effect.parameters[:1]
        for number in after.numbers
        if number.key == f"{effect.name}.{parameter.name}" and 0 < number.sigma < math.inf
    ]
    return max(sizes, default=math.inf)


def sizes_of(effects: Sequence[Effect], after: Fit) -> int:
    """Number of sizes of effects in a fit, the degrees of freedom of their likelihood ratio: the first parameter of
    each, for all trials or for each vine or day. The others shape it: where its size is zero nothing depends on them,
    so that Wilks' theorem does not hold (Davies, Biometrika 74, 33, 1987): it is the largest ratio of many.
    """
    sizes = [f"{effect.name}.{effect.parameters[0].name}" if effect.parameters else "" for effect in effects]
    return sum(max(sum(number.key == size for number in after.numbers), 1) for size in sizes)


def in_sigmas(delta_chi2: float, degrees_of_freedom: int) -> float:
    """Normal deviate of the same two-sided tail probability as Δχ² with these degrees of freedom (Wilks' theorem).
    Returns negative where the fit is worse; with several degrees of freedom 0 where it is no better than chance makes
    it.
    """
    if degrees_of_freedom < 2 or delta_chi2 <= 0:
        return math.copysign(math.sqrt(abs(delta_chi2)), delta_chi2)
    # Also where the tail probability underflows: Γ(a, x) = xᵃ e⁻ˣ U(1, 1 + a, x), https://dlmf.nist.gov/8.5.E3.
    a, x = 0.5 * degrees_of_freedom, 0.5 * delta_chi2
    log_p = a * math.log(x) - x - math.lgamma(a) + math.log(hyperu(1, 1 + a, x))
    return max(float(-ndtri_exp(log_p - math.log(2))), 0.0)


def implausible(effects: Sequence[Effect], after: Fit, widened: float = 1.0, errors: float = 1.0) -> Remark:
    """Why the fitted sizes are not plausible; blank where they are, or might be within so much of their errors."""
    parameters = {f"{effect.name}.{parameter.name}": parameter for effect in effects for parameter in effect.parameters}
    for number in after.numbers:
        if (parameter := parameters.get(number.key)) is None or not math.isfinite(number.sigma):
            continue
        low, high = parameter.plausible or (math.nan, math.nan)
        # At a bound outside the plausible range the size is implausible whatever its standard error.
        at_implausible_bound = math.isfinite(number.bound) and (number.bound < low or number.bound > high)
        if at_implausible_bound or not is_plausible(
            parameter, number.value, number.sigma, widened=widened, errors=errors
        ):
            unit = "" if parameter.unit == "1" else parameter.unit
            facts = {"symbol": number.symbol, "value": number.value, "unit": unit, "low": low, "high": high}
            return Remark("implausible_size", facts | {"pressure_unit": number.pressure_unit})
    return Remark()


def robust_ratio(after: Fit, names: Collection[str]) -> float:
    """Ratio of the standard error of a size from the scatter of trials to that from the noise model; at least 1. The
    largest of all these sizes.
    """
    if not names or len(after.predictor.data) < FEWEST_CLUSTERS:
        return 1.0
    plain, variance, _ = robust_variances(after.solution)
    ratios = [
        float(variance[k] / plain[k, k])
        for k, number in enumerate(after.numbers)
        if (number.key.split(".")[0] in names or number.key in names) and plain[k, k] > 0
    ]
    return math.sqrt(max([1.0, *ratios]))


def answer_set(hypotheses: Sequence[LikelihoodRatio]) -> tuple[list[LikelihoodRatio], dict[str, Remark]]:
    """Hypotheses that cannot be excluded, the best first, and for those rejected the reason in words. A hypothesis is
    excluded if its −2 ln L, divided by the best one's inflation, is more than 9 above the best. Returns members,
    rejected (reason by label; hypotheses excluded by their likelihood alone are not listed).
    """
    best = best_of(hypotheses)
    reach = ANSWER_SET_DELTA_CHI2 * best.inflation
    likely = [hypothesis for hypothesis in hypotheses if hypothesis.deviance_excess(best) <= reach]
    likely.sort(key=lambda ratio: -ratio.fit.log_likelihood)
    # Sizes outside the plausible range are believed where no other hypothesis has plausible ones.
    credible = [ratio for ratio in likely if ratio.credible]
    plausible = [ratio for ratio in credible if ratio.plausible] or credible or likely
    rejected = {ratio.label: ratio.reason for ratio in likely if ratio not in plausible}
    members = []
    for ratio in plausible:
        simpler = [
            other
            for other in plausible
            if ratio.contains(other)
            and other.n_parameters < ratio.n_parameters
            and other.deviance_excess(ratio) <= reach
        ]
        if simpler:
            rejected[ratio.label] = remark("contains_and_fits_no_better", name=simpler[0].names[-1])
        else:
            members.append(ratio)
    return members, rejected


def stand_in(name: str, kind: str = "physical", parameters: tuple[Parameter, ...] = ()) -> Effect:
    """What stands for a hypothesis that is no effect in tables of candidates and answer sets."""
    return Effect(name=name, kind=kind, summary=name, text=name, parameters=parameters, functions={}, path=Path(name))


FAR_BEHIND = 50.0  # Difference of ln L to another hypothesis at which a fit is given up (chosen)


def full_fit(before: Fit, model: Model | None = None, *, best: float = -math.inf, **how: Any) -> Fit | None:
    """Refit with another model, or other options of `refit`; None where the fit fails. `best` is the largest ln L of
    other hypotheses: a fit that stays far behind it, or far off the tracks, is given up.
    """
    try:
        # 14, 40: iterations of a full fit at first, and of one that is near then (chosen)
        fit = refit(before, model, most_iterations=14, least=best - FAR_BEHIND, **how)
        if fit.converged or fit.iterations < 14 or is_poor_fit(fit.solution):
            return fit
        return refit(fit, most_iterations=40, least=best - FAR_BEHIND)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


# ------------------------------------------------------------------------------
# Differences between trials.
#
# A tube that wears, another tube for the high pressures, or a gauge whose zero changes between days changes B or the
# pressure of whole groups of trials. Where all replicates of a condition are in one group, this is indistinguishable
# from physics that depends on the condition. Such differences are therefore hypotheses like the effects of the
# catalogue:
#
#     ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
#     P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random effects of trials
#
# A hypothesis is an entry of `BETWEEN`, a function that lists its forms, of which the best counts.

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
    base, best = with_systematics(fit.solution).solution, list[Difference]()
    for name, forms_of in BETWEEN.items():
        forms, estimated = forms_of(name, fit, base), list[Difference]()
        for form in forms:
            widened = _widened(fit, base, form)
            gain = 2 * (widened.log_likelihood() - base.log_likelihood())
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
    spreads = np.array([base.state.spread])
    return min(forms, key=lambda form: float(_widened(fit, base, form).deviances(spreads, restricted=False)[0]))


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
    first = np.cumsum([0, *map(len, members)])
    places = np.transpose(
        [
            [begin + names.index(group) if group else -1 for group in of_trials]
            for begin, names, of_trials in zip(first[:-1], members, groups, strict=True)
        ]
    )
    precision = np.repeat(precisions, [len(names) for names in members])
    problem = base.problem.with_unknowns(places, precision)
    problem = replace(problem, random=np.append(base.problem.random, precision > 0))
    size = base.cross_products.shape[-1]
    T = np.zeros((len(base.cross_products), size, size + len(columns)))
    T[:, range(size - 1), range(size - 1)] = T[:, -1, -1] = 1.0
    for k, (column, factor) in enumerate(zip(columns, factors, strict=True)):
        T[:, column, size - 1 + k] = np.where(places[:, k] >= 0, factor, 0.0)
    cross_products = np.einsum("nka,nckl,nlb->ncab", T, base.cross_products, T, optimize=True)
    theta = np.append(base.state.theta, np.zeros(precision.size))
    return replace(base, cross_products=cross_products, problem=problem).with_state(theta=theta)


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
