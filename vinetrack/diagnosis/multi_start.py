"""Fits of hypotheses: a quick climb on a part of the trials, then a fit to all of them.

A climb takes one trial of every condition, spreads as a batch of vines shows them, and noise as correlated as in the
tracks: so it is guided by what a hypothesis misses. Left free, correlation and spreads would take that in and hold the
fit where it is.
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
from vinetrack.inference.marginal_likelihood import deviance, marginal
from vinetrack.inference.optimiser import CREEPING, FixedTerms, is_poor_fit, solve
from vinetrack.inference.parameters import EXPONENT, YIELD_PRESSURE, ParameterMap, make_layout
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE, Predictor
from vinetrack.inference.solving import SLOW_NOISE
from vinetrack.inference.starts import align, one_of_each_condition
from vinetrack.inference.trace_errors import as_recorded

Start = tuple[Sequence[Effect], Mapping[str, Value]]
"""Effects to add and values to begin from."""

SUBSET_SPREADS = (0.01, 0.03)
"""Between-trial standard deviations of pressure and ln B, and iterations, of a subset fit. Chosen as FIRST_SPREADS of
the optimiser; for time."""

SUBSET_FIRST_ITERATIONS, SUBSET_FURTHER_ITERATIONS = 4, 10
"""Iterations of a subset fit from each start, and of the best of them each further time. Chosen for time: a start that
leads anywhere has shown it after four steps."""

MAX_SUBSET_TRIALS = 14
"""Trials of a climb: one of every condition, no more than this. Chosen for time."""

FULL_FIT_FIRST_ITERATIONS, FULL_FIT_MAX_ITERATIONS, ABANDONED_BEHIND = 14, 40, 50.0
"""Iterations of a full fit at first and in all, and how far behind the best in −2 ln L it is given up. Chosen for
time."""

MIN_SHARE_OF_BEST_GAIN = 0.3
"""Part of what the best hypothesis explains that another must explain for larger sets to be built on it. So a fit far
off that cannot come to it need not be led to its end. Chosen for time: effects that share a misfit evenly explain a
third of it each; at half weaker ones are built on too (time), at twice two that explain half each may not be."""

MIN_DEVIANCE_FALL, MIN_DEVIANCE_FALL_PER_POINT = 1.0, 0.02
"""By how much −2 ln L of a climb must end lower for its start to be worth a fit. Chosen: unsettled iterations differ
by as much."""

HOPELESS_RANGE_FACTOR = 6.0
"""Times its plausible range. Chosen: twice what CREDIBLE_RANGE_FACTOR refuses."""

START_EXPONENTS = (0.2, 0.4, 0.7)
"""Exponents from which a model is begun again. Chosen: about the published 0.37, each within a factor of two."""

HOPELESS_DEVIANCE_PER_POINT = 0.5
"""A climb goes on where its misfit, on a logarithmic scale, has come at least this far towards the best so far. Chosen
for time."""


@dataclass(frozen=True)
class SubsetFit:
    """Where a climb ended: −2 ln L on its trials, what to begin a full fit from, and whether it is far off.

    `yields_Pa` are yield pressures by the name of their number: beside a friction at rest, those that were found
    without it may hold a vine back altogether.
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
        """Whether it ended at sizes so far beyond what is plausible that a full fit will not bring it back."""
        return any(
            not is_plausible(parameter, value, 0.0, widened=HOPELESS_RANGE_FACTOR)
            for effect in self.effects
            for parameter in effect.parameters
            if isinstance(value := self.values.get(f"{effect.name}.{parameter.name}"), float)
        )


class SubsetFitter:
    """Climbs from one fit, all on the same trials, so that their deviances can be held against each other."""

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        self.chosen = _one_of_each(fit.predictor.data)
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
        """Fit with these effects added from `start`; None where the start cannot be followed.

        Parameters
        ----------
        effects : sequence of Effect
            Added to the model.
        start : mapping
            Values of parameters, SI.
        iterations : int
            Steps at most.
        align_first : bool
            Whether releases are looked for first.
        search : bool
            Whether it is one of many, see `optimiser.solve`.

        Returns
        -------
        SubsetFit or None
        """
        model = self.fit.model.with_effects(effects).with_values({**self.fit.model.values, **start})
        layout = make_layout(model, self.data, fixed=self._fixed(model.parameter_names), shared={})
        predictor = Predictor(layout, self.data, self.fit.predictor.host)
        trial_effects = self.fit.solution.state.trial_effects[self.chosen].copy()
        trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
        held = FixedTerms(spread=SUBSET_SPREADS, correlation=self.correlation)
        try:
            theta = layout.start
            if align_first:
                trial_effects, _ = align(self.data, predictor, theta, trial_effects)
            problem = make_problem(predictor, trial_effects)
            state = first_state(self.data, theta, trial_effects)
            solution = solve(predictor, problem, state, held, warm=True, most_iterations=iterations, search=search)
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
        """How many points the trials of a climb have."""
        return sum(trial_data.time_s.size for trial_data in self.data)

    def null_deviance(self) -> float:
        """−2 ln L where a few steps from the fit itself end; infinite where it cannot be followed."""
        climb = self.fit_hypothesis((), {}, iterations=SUBSET_FIRST_ITERATIONS, align_first=False)
        return math.inf if climb is None else climb.deviance

    def _fixed(self, names: Iterable[str]) -> tuple[str, ...]:
        held = self.fit.options["fixed"]
        return tuple(name for name in held if name in names or any(name == full.split(".")[1] for full in names))


def _values(layout: ParameterMap, theta: Floats) -> tuple[dict[str, Value], dict[str, float]]:
    """Parameters by name, those of single vines as mappings, and yield pressures, Pa, by the name of their number."""
    numbers = list(zip(layout.free, layout.values(theta).tolist(), strict=True))
    return (
        values_by_key((number.key, number.vine, value) for number, value in numbers if number.key != YIELD_PRESSURE),
        {number.name: value for number, value in numbers if number.key == YIELD_PRESSURE},
    )


def _one_of_each(data: Sequence[FitTrial]) -> list[int]:
    """Places of one trial of every condition, the one with the most points; spread evenly where there are too many."""
    places = one_of_each_condition(data)
    if len(places) <= MAX_SUBSET_TRIALS:
        return places
    vines = {data[i].trial.vine for i in places}
    take = [places[k] for k in np.unique(np.linspace(0, len(places) - 1, MAX_SUBSET_TRIALS).round().astype(int))]
    lacking = vines - {data[i].trial.vine for i in take}
    return sorted({*take, *(next(i for i in places if data[i].trial.vine == vine) for vine in lacking)})


def start_values(shape: CandidateShape, size: float) -> dict[str, Value]:
    """Values of an effect's parameters to begin from: the predicted size brought inside what is possible.

    Parameters
    ----------
    shape
        Form in which the effect is tried.
    size : float, SI
        Predicted size, from the parameter's zero.

    Returns
    -------
    dict
        By `effect.parameter`, SI.
    """
    effect = shape.effect
    if not effect.parameters:
        return {}
    parameter = shape.size
    low, high = parameter.bounds
    if shape.whole:
        size = shape.step
    elif parameter.plausible is not None:
        # A prediction far beyond what is plausible is a straight line drawn too far.
        reach = 3 * max(abs(bound - parameter.zero) for bound in parameter.plausible)
        size = float(np.clip(size, -reach, reach))
    if parameter.sign * size < 0 or size == 0:
        size = parameter.sign * abs(shape.step) or shape.step
    begun = float(np.clip(parameter.zero + size, low, high))
    of_groups = dict.fromkeys(shape.other_groups, parameter.zero) | {shape.group: begun}
    values: tuple[Value, ...] = (of_groups if shape.group else begun, *shape.other_values)
    return {f"{effect.name}.{known.name}": value for known, value in zip(effect.parameters, values, strict=True)}


def best_subset_fit(
    slope: SubsetFitter, starts: Sequence[Start], goal: float, *, search: bool = False
) -> SubsetFit | None:
    """The best of several starts of one hypothesis: each a few steps, the best of them on to the end.

    One that stays far above `goal`, the best deviance of any hypothesis so far, is not followed further.

    Parameters
    ----------
    slope
        Fits to one trial of every condition.
    starts : sequence of Start
        Of one hypothesis.
    goal : float
        Best deviance of any hypothesis so far.
    search : bool
        Whether the hypothesis is one of many: far off, it is not followed where it only creeps.

    Returns
    -------
    SubsetFit or None
    """
    first = [
        subset_fit
        for effects, start in starts
        if (subset_fit := slope.fit_hypothesis(effects, start, iterations=SUBSET_FIRST_ITERATIONS)) is not None
    ]
    if not first:
        return None
    best = min(first, key=lambda subset_fit: subset_fit.deviance)
    if best.deviance - goal > HOPELESS_DEVIANCE_PER_POINT * slope.n_points:
        return best
    for _ in range(3):
        again = slope.fit_hypothesis(best.effects, best.values, iterations=SUBSET_FURTHER_ITERATIONS, search=search)
        if again is None:
            break
        least = CREEPING * slope.n_points if search and again.far_off else 0.1
        creeps = again.deviance > best.deviance - least
        best = min((best, again), key=lambda subset_fit: subset_fit.deviance)
        if creeps:
            break
    return best


def full_fit(
    before: Fit, climb: SubsetFit, best: float = -math.inf, *, afresh: bool = False, led: bool = True
) -> Fit | None:
    """The hypothesis fitted to all trials from where its climb ended; None where it cannot be followed.

    `afresh` begins with nothing of what the fit had bent to do without it. One whose ln L is still far below the `best`
    after the first iterations is left unsettled.

    Parameters
    ----------
    before
        The fit without the effects.
    climb
        Where the subset fit ended.
    best : float
        Largest ln L of any hypothesis so far.
    afresh : bool
        Begin with releases, deviations and noise as the tracks show them.
    led : bool
        Whether a fit that ends far off is begun again, see `refit`.

    Returns
    -------
    Fit or None
    """
    model = before.model.with_effects(climb.effects)
    goal = (
        before.log_likelihood + MIN_SHARE_OF_BEST_GAIN * (best - before.log_likelihood) if climb.effects else -math.inf
    )
    try:
        fit = refit(
            before,
            model,
            start=climb.values,
            yields_Pa=climb.yields_Pa,
            most_iterations=FULL_FIT_FIRST_ITERATIONS,
            thorough=False,
            afresh=afresh,
            led=led,
            goal=goal,
        )
        if fit.noise_correlation > SLOW_NOISE and is_poor_fit(fit.predictor, fit.solution):
            # Noise that wanders as it likes makes anything likely.
            return None
        if fit.converged or fit.log_likelihood < best - ABANDONED_BEHIND or is_poor_fit(fit.predictor, fit.solution):
            return fit
        return refit(fit, most_iterations=FULL_FIT_MAX_ITERATIONS, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


def restart_exponents(fit: Fit) -> Fit:
    """The same model fitted from where climbs from several exponents end, if that is better; else the fit itself.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    Fit
    """
    starts = exponent_starts(fit)
    if len(starts) == 1:
        return fit
    slope = SubsetFitter(fit)
    return _from(slope, starts, slope.null_deviance(), MIN_DEVIANCE_FALL_PER_POINT * slope.n_points)


def exponent_starts(fit: Fit) -> list[Start]:
    """Starts from several exponents n of the damping law; the fit's own numbers alone where n is not free.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    list of Start
    """
    if EXPONENT not in fit.model.parameter_names or EXPONENT in fit.options["fixed"]:
        return [((), {})]
    return [((), {EXPONENT: n}) for n in START_EXPONENTS]


def restart_without(fit: Fit, other: Fit) -> Fit:
    """The model of a fit begun from the numbers of another fit, which holds it, if that is better; else the fit.

    It is fitted where a climb from there makes up for half of what the other fit is better by.

    Parameters
    ----------
    fit
        The fit without the effect.
    other
        A fit whose model holds that of `fit`.

    Returns
    -------
    Fit
    """
    slope, names = SubsetFitter(fit), set(fit.model.parameter_names)
    added = [effect for effect in other.model if effect.name not in fit.model]
    here, there = slope.null_deviance(), slope.fit_hypothesis(added, other.model.values, iterations=1)
    lower = math.inf if there is None else max(MIN_DEVIANCE_FALL, 0.5 * (here - there.deviance))
    return _from(slope, [((), {key: value for key, value in other.model.values.items() if key in names})], here, lower)


def _from(slope: SubsetFitter, starts: Sequence[Start], here: float, lower: float) -> Fit:
    """The model of a fit begun elsewhere, where a climb from there ends lower than `here` by this."""
    fit = slope.fit
    climb = best_subset_fit(slope, starts, here)
    if climb is None or climb.deviance > here - lower:
        return fit
    other = full_fit(fit, climb, fit.log_likelihood)
    return other if other is not None and other.log_likelihood > fit.log_likelihood else fit


def distinct_starts(shapes: Iterable[tuple[CandidateShape, float]]) -> list[Start]:
    """Starts of one effect from its shapes and the sizes predicted for them.

    Parameters
    ----------
    shapes : iterable of (CandidateShape, float)
        Shapes of one effect with their predicted sizes, SI.

    Returns
    -------
    list of Start
    """
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
    """Starts of one effect from what common slips in the sheet leave.

    Parameters
    ----------
    effect

    Returns
    -------
    list of Start
    """
    return [
        ((effect,), {f"{effect.name}.{parameter.name}": size})
        for parameter in effect.parameters
        for size, _ in parameter.slips
    ]
