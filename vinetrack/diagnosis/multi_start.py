"""Fits of hypotheses from several starts: a short fit to a subset of the trials, then a full fit to all of them.

A subset fit takes one trial of every condition. Its between-trial standard deviations are fixed at those of a typical
batch of vines, and the correlation of its noise at that of the tracks: if free, they would absorb the misfit and stall
the optimiser.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape, is_plausible
from vinetrack.dynamics.model import Value, values_by_key
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.fit_problem import first_state, make_problem, track_correlation
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.goodness_of_fit import is_poor_fit
from vinetrack.inference.marginal_likelihood import deviance, marginal
from vinetrack.inference.optimiser import STAGNATION_DECREASE, FixedTerms, solve
from vinetrack.inference.parameters import EXPONENT, YIELD_PRESSURE, ParameterMap, make_layout
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE, Predictor
from vinetrack.inference.solving import SLOW_NOISE
from vinetrack.inference.starts import align, one_trial_per_condition
from vinetrack.inference.trace_errors import as_recorded

Start = tuple[Sequence[Effect], Mapping[str, Value]]  # Effects to add, and parameter values to start from

SUBSET_SPREADS = (0.01, 0.03)  # Between-trial standard deviations of pressure and ln B in a subset fit (chosen)

# Iterations of a subset fit from each start, and of the best one each further time (chosen)
SUBSET_FIRST_ITERATIONS, SUBSET_FURTHER_ITERATIONS = 4, 10

MAX_SUBSET_TRIALS = 14  # Trials of a subset fit: one of every condition, at most this many (chosen)

# Iterations of a full fit at first and in all (chosen)
FULL_FIT_FIRST_ITERATIONS, FULL_FIT_MAX_ITERATIONS, ABANDONED_BEHIND = 14, 40, 50.0

# Share of the best hypothesis's gain that a hypothesis needs for larger sets to be built on it (chosen)
MIN_SHARE_OF_BEST_GAIN = 0.3

# Fall of −2 ln L of a subset fit from which its start is worth a full fit (chosen)
MIN_DEVIANCE_FALL, MIN_DEVIANCE_FALL_PER_POINT = 1.0, 0.02

HOPELESS_RANGE_FACTOR = 6.0  # Multiple of its plausible range beyond which a size of a subset fit is hopeless (chosen)

START_EXPONENTS = (0.2, 0.4, 0.7)  # Exponents from which a model is started (chosen)

# −2 ln L per point by which a subset fit may stay behind the best so far after its first iterations and still be
# continued (chosen)
HOPELESS_DEVIANCE_PER_POINT = 0.5


@dataclass(frozen=True)
class SubsetFit:
    """End of a subset fit, from which a full fit starts: −2 ln L on its trials, values, and whether it is far off.
    `yields_Pa` are yield pressures by name of number: with a friction at rest added, those fitted without it may stop a
    vine altogether. A start that no subset fit was made for has the deviance NaN.
    """

    effects: tuple[Effect, ...]
    deviance: float
    values: Mapping[str, Value]
    far_off: bool = False
    yields_Pa: Mapping[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that were added."""
        return tuple(effect.name for effect in self.effects)

    @property
    def far_beyond_plausible(self) -> bool:
        """Whether a size is so far beyond its plausible range that a full fit will not bring it back."""
        return any(
            not is_plausible(parameter, value, 0.0, widened=HOPELESS_RANGE_FACTOR)
            for effect in self.effects
            for parameter in effect.parameters
            if isinstance(value := self.values.get(f"{effect.name}.{parameter.name}"), float)
        )


class SubsetFitter:
    """Subset fits of hypotheses about one fit, all on the same trials, so that their deviances can be compared."""

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        self.chosen = _subset(fit.predictor.data)
        self.data = [as_recorded(fit.predictor.data[i]) for i in self.chosen]
        self.correlation = track_correlation(self.data)

    def fit_hypothesis(
        self,
        effects: Sequence[Effect],
        start: Mapping[str, Value],
        *,
        iterations: int,
        align_first: bool = True,
        search: bool = False,
    ) -> SubsetFit | None:
        """Fit the model with these effects added; None where the fit fails."""
        model = self.fit.model.with_effects(effects).with_values({**self.fit.model.values, **start})
        layout = make_layout(model, self.data, fixed=self._fixed(model.parameter_names), shared={})
        predictor = Predictor(layout, self.data, self.fit.predictor.host)
        trial_effects = self.fit.solution.state.trial_effects[self.chosen].copy()
        trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
        fixed = FixedTerms(spread=SUBSET_SPREADS, correlation=self.correlation)
        try:
            theta = layout.start
            if align_first:
                trial_effects, _ = align(self.data, predictor, theta, trial_effects)
            problem = make_problem(predictor, trial_effects)
            state = first_state(self.data, theta, trial_effects)
            solution = solve(predictor, problem, state, fixed, warm=True, most_iterations=iterations, search=search)
            part = marginal(solution.cross_products, solution.problem, solution.state)
        except (SimulationError, FitError, np.linalg.LinAlgError):
            return None
        level = deviance(part, solution.problem, solution.state, SUBSET_SPREADS, restricted=False)
        if not math.isfinite(level):
            return None
        values, yields_Pa = _values(layout, solution.state.theta)
        return SubsetFit(tuple(effects), level, values, is_poor_fit(predictor, solution), yields_Pa)

    @property
    def n_points(self) -> int:
        """Number of points of the subset."""
        return sum(trial_data.time_s.size for trial_data in self.data)

    def null_deviance(self) -> float:
        """−2 ln L of the model without further effects, after a few iterations; infinite where the fit fails."""
        null_fit = self.fit_hypothesis((), {}, iterations=SUBSET_FIRST_ITERATIONS, align_first=False)
        return math.inf if null_fit is None else null_fit.deviance

    def _fixed(self, names: Iterable[str]) -> tuple[str, ...]:
        fixed = self.fit.options["fixed"]
        return tuple(name for name in fixed if name in names or any(name == full.split(".")[1] for full in names))


def _values(layout: ParameterMap, theta: Floats) -> tuple[dict[str, Value], dict[str, float]]:
    """Parameter values by name, those of single vines as mappings; and yield pressures, Pa, by name of number."""
    numbers = list(zip(layout.free, layout.values(theta).tolist(), strict=True))
    return (
        values_by_key((number.key, number.vine, value) for number, value in numbers if number.key != YIELD_PRESSURE),
        {number.name: value for number, value in numbers if number.key == YIELD_PRESSURE},
    )


def _subset(data: Sequence[FitTrial]) -> list[int]:
    """Indices of one trial of every condition, that with the most points; evenly thinned where there are too many.
    Every vine keeps at least one trial.
    """
    candidates = one_trial_per_condition(data)
    if len(candidates) <= MAX_SUBSET_TRIALS:
        return candidates
    vines = {data[i].trial.vine for i in candidates}
    evenly = np.unique(np.linspace(0, len(candidates) - 1, MAX_SUBSET_TRIALS).round().astype(int))
    chosen = [candidates[k] for k in evenly]
    missing = vines - {data[i].trial.vine for i in chosen}
    return sorted({*chosen, *(next(i for i in candidates if data[i].trial.vine == vine) for vine in missing)})


def start_values(shape: CandidateShape, size: float) -> dict[str, Value]:
    """Values of an effect's parameters to start from: the predicted size, limited to what is possible. Returns by
    `effect.parameter`, SI.
    """
    effect = shape.effect
    if not effect.parameters:
        return {}
    parameter = shape.size
    low, high = parameter.bounds
    if shape.whole:
        size = shape.step
    elif parameter.plausible is not None:
        # A prediction far beyond the plausible range is an extrapolation of the linear model.
        reach = 3 * max(abs(bound - parameter.zero) for bound in parameter.plausible)
        size = float(np.clip(size, -reach, reach))
    if parameter.sign * size < 0 or size == 0:
        size = parameter.sign * abs(shape.step) or shape.step
    start = float(np.clip(parameter.zero + size, low, high))
    by_group = dict.fromkeys(shape.other_groups, parameter.zero) | {shape.group: start}
    values: tuple[Value, ...] = (by_group if shape.group else start, *shape.other_values)
    return {f"{effect.name}.{p.name}": value for p, value in zip(effect.parameters, values, strict=True)}


def best_subset_fit(
    fitter: SubsetFitter, starts: Sequence[Start], goal: float, *, search: bool = False
) -> SubsetFit | None:
    """Fit one hypothesis to the subset from several starts: a few iterations from each, then the best one on."""
    first_fits = [
        subset_fit
        for effects, start in starts
        if (subset_fit := fitter.fit_hypothesis(effects, start, iterations=SUBSET_FIRST_ITERATIONS)) is not None
    ]
    if not first_fits:
        return None
    best = min(first_fits, key=lambda subset_fit: subset_fit.deviance)
    if best.deviance - goal > HOPELESS_DEVIANCE_PER_POINT * fitter.n_points:
        return best
    for _ in range(3):
        further = fitter.fit_hypothesis(best.effects, best.values, iterations=SUBSET_FURTHER_ITERATIONS, search=search)
        if further is None:
            break
        required_fall = STAGNATION_DECREASE * fitter.n_points if search and further.far_off else 0.1
        improves_slowly = further.deviance > best.deviance - required_fall
        best = min((best, further), key=lambda subset_fit: subset_fit.deviance)
        if improves_slowly:
            break
    return best


def full_fit(
    before: Fit, start: SubsetFit, best: float = -math.inf, *, reset: bool = False, rescue: bool = True
) -> Fit | None:
    """Fit a hypothesis to all trials from where its subset fit ended; None where the fit fails."""
    model = before.model.with_effects(start.effects)
    goal = (
        before.log_likelihood + MIN_SHARE_OF_BEST_GAIN * (best - before.log_likelihood) if start.effects else -math.inf
    )
    try:
        fit = refit(
            before,
            model,
            start=start.values,
            yields_Pa=start.yields_Pa,
            most_iterations=FULL_FIT_FIRST_ITERATIONS,
            thorough=False,
            afresh=reset,
            led=rescue,
            goal=goal,
        )
        poor = is_poor_fit(fit.predictor, fit.solution)
        if fit.noise_correlation > SLOW_NOISE and poor:
            # Strongly correlated noise absorbs any misfit, and the likelihood says nothing.
            return None
        if fit.converged or fit.log_likelihood < best - ABANDONED_BEHIND or poor:
            return fit
        return refit(fit, most_iterations=FULL_FIT_MAX_ITERATIONS, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


def restart_exponents(fit: Fit) -> Fit:
    """Refit a model from several exponents of the damping law; return the better of this and the given fit."""
    starts = exponent_starts(fit)
    if len(starts) == 1:
        return fit
    fitter = SubsetFitter(fit)
    return _restart(fitter, starts, fitter.null_deviance(), MIN_DEVIANCE_FALL_PER_POINT * fitter.n_points)


def exponent_starts(fit: Fit) -> list[Start]:
    """Starts from several exponents n of the damping law; the fit's own values alone where n is not free."""
    if EXPONENT not in fit.model.parameter_names or EXPONENT in fit.options["fixed"]:
        return [((), {})]
    return [((), {EXPONENT: n}) for n in START_EXPONENTS]


def restart_without(fit: Fit, larger: Fit) -> Fit:
    """Refit a model from the values of a larger model's fit; return the better of this and the given fit. The refit is
    made where a subset fit from there recovers half of the larger model's advantage.
    """
    fitter, names = SubsetFitter(fit), set(fit.model.parameter_names)
    added = [effect for effect in larger.model if effect.name not in fit.model]
    null_deviance = fitter.null_deviance()
    with_effects = fitter.fit_hypothesis(added, larger.model.values, iterations=1)
    if with_effects is None:
        required_fall = math.inf
    else:
        required_fall = max(MIN_DEVIANCE_FALL, 0.5 * (null_deviance - with_effects.deviance))
    start = {key: value for key, value in larger.model.values.items() if key in names}
    return _restart(fitter, [((), start)], null_deviance, required_fall)


def _restart(fitter: SubsetFitter, starts: Sequence[Start], null_deviance: float, required_fall: float) -> Fit:
    """Refit a model from other starts if the deviance of its subset fit falls enough; return the better fit."""
    fit = fitter.fit
    subset_fit = best_subset_fit(fitter, starts, null_deviance)
    if subset_fit is None or subset_fit.deviance > null_deviance - required_fall:
        return fit
    refitted = full_fit(fit, subset_fit, fit.log_likelihood)
    return refitted if refitted is not None and refitted.log_likelihood > fit.log_likelihood else fit


def distinct_starts(shapes: Iterable[tuple[CandidateShape, float]]) -> list[Start]:
    """Starts of one effect from its shapes at their predicted sizes, without duplicates."""
    seen: set[str] = set()
    starts: list[Start] = []
    for shape, size in shapes:
        start = start_values(shape, size)
        key = repr(start)
        if key not in seen:
            seen.add(key)
            starts.append(((shape.effect,), start))
    return starts


def sheet_slip_starts(effect: Effect) -> list[Start]:
    """Starts of one effect from the sizes that common slips in the sheet would produce."""
    return [
        ((effect,), {f"{effect.name}.{parameter.name}": size})
        for parameter in effect.parameters
        for size, _ in parameter.slips
    ]
