"""Fits of single effects: which candidates are worth a fit, and their full fits. Sets of effects: `selection`.

Where linear predictions hold, candidates are chosen by their predicted gain and fitted to all trials at once. Elsewhere
each candidate is first fitted from several starts to a subset, one trial of every condition, and those
that end near the best are fitted to all trials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.likelihood_ratio import (
    OUT_OF_REACH,
    LikelihoodRatio,
    NestedForm,
    likelihood_ratio,
    simpler_forms,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.score_test import CandidateShape
from vinetrack.dynamics.model import Value, values_by_key
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.fit_result import YIELD_PRESSURE, Fit, ParameterMap, make_layout
from vinetrack.inference.marginal_likelihood import deviance, marginal
from vinetrack.inference.optimiser import (
    FixedTerms,
    first_state,
    is_poor_fit,
    make_problem,
    solve,
    track_correlation,
)
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE, Predictor, align, one_trial_per_condition
from vinetrack.inference.solving import SLOW_NOISE, as_recorded, assemble

# ------------------------------------------------------------------------------
# Fits of hypotheses from several starts: a short fit to a subset of the trials, then a full fit to all of them.
#
# A subset fit takes one trial of every condition. Its between-trial standard deviations are fixed at those of a
# typical batch of vines, and the correlation of its noise at that of the tracks: if free, they would absorb the
# misfit and stall the optimiser.

Start = tuple[Sequence[Effect], Mapping[str, Value]]  # Effects to add, and parameter values to start from


SUBSET_FIRST_ITERATIONS = 4  # Iterations of a subset fit from each start (chosen)

# Share of the best hypothesis's gain that a hypothesis needs for larger sets to be built on it (chosen)
MIN_SHARE_OF_BEST_GAIN = 0.3


@dataclass(frozen=True)
class SubsetFit:
    """End of a subset fit, from which a full fit starts: −2 ln L on its trials, NaN where none was made, and values.
    `yields_Pa` are yield pressures by name of number: with a friction at rest added, those fitted without it may stop a
    vine altogether.
    """

    effects: tuple[Effect, ...]
    deviance: float
    values: Mapping[str, Value]
    yields_Pa: Mapping[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that were added."""
        return tuple(effect.name for effect in self.effects)


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
    ) -> SubsetFit | None:
        """Fit the model with these effects added; None where the fit fails."""
        subset_spreads = (0.01, 0.03)  # Between-trial standard deviations of pressure and ln B in a subset fit (chosen)
        model = self.fit.model.with_effects(effects).with_values({**self.fit.model.values, **start})
        layout = make_layout(model, self.data, fixed=self._fixed(model.parameter_names), shared={})
        predictor = Predictor(layout, self.data, self.fit.predictor.host)
        trial_effects = self.fit.solution.state.trial_effects[self.chosen].copy()
        trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
        fixed = FixedTerms(spread=subset_spreads, correlation=self.correlation)
        try:
            theta = layout.start
            trial_effects, _ = align(self.data, predictor, theta, trial_effects)
            problem = make_problem(predictor, trial_effects)
            state = first_state(self.data, theta, trial_effects)
            solution = solve(predictor, problem, state, fixed, warm=True, most_iterations=iterations, search=True)
            part = marginal(solution.cross_products, solution.problem, solution.state)
        except (SimulationError, FitError, np.linalg.LinAlgError):
            return None
        level = deviance(part, solution.problem, solution.state, subset_spreads, restricted=False)
        if not math.isfinite(level):
            return None
        values, yields_Pa = _values(layout, solution.state.theta)
        return SubsetFit(tuple(effects), level, values, yields_Pa)

    @property
    def n_points(self) -> int:
        """Number of points of the subset."""
        return sum(trial_data.time_s.size for trial_data in self.data)

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
    max_subset_trials = 14  # Trials of a subset fit: one of every condition, at most this many (chosen)
    candidates = one_trial_per_condition(data)
    if len(candidates) <= max_subset_trials:
        return candidates
    vines = {data[i].trial.vine for i in candidates}
    evenly = np.unique(np.linspace(0, len(candidates) - 1, max_subset_trials).round().astype(int))
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


def best_subset_fit(fitter: SubsetFitter, starts: Sequence[Start], goal: float) -> SubsetFit | None:
    """Fit one hypothesis to the subset from several starts: a few iterations from each, then the best one on."""
    first_fits = [
        subset_fit
        for effects, start in starts
        if (subset_fit := fitter.fit_hypothesis(effects, start, iterations=SUBSET_FIRST_ITERATIONS)) is not None
    ]
    if not first_fits:
        return None
    best = min(first_fits, key=lambda subset_fit: subset_fit.deviance)
    # 0.5: −2 ln L per point by which a subset fit may stay behind the best so far after its first iterations and
    # still be continued (chosen)
    if best.deviance - goal > 0.5 * fitter.n_points:
        return best
    for _ in range(3):
        # 10: iterations of the best subset fit each further time (chosen)
        further = fitter.fit_hypothesis(best.effects, best.values, iterations=10)
        if further is None:
            break
        improves_slowly = further.deviance > best.deviance - 0.1
        best = min((best, further), key=lambda subset_fit: subset_fit.deviance)
        if improves_slowly:
            break
    return best


def full_fit(before: Fit, start: SubsetFit, best: float = -math.inf) -> Fit | None:
    """Fit a hypothesis to all trials from where its subset fit ended; None where the fit fails."""
    model = before.model.with_effects(start.effects)
    goal = (
        before.log_likelihood + MIN_SHARE_OF_BEST_GAIN * (best - before.log_likelihood) if start.effects else -math.inf
    )
    try:
        # 14, 40, 50.0: iterations of a full fit at first and in all (chosen)
        fit = refit(
            before,
            model,
            start=start.values,
            yields_Pa=start.yields_Pa,
            most_iterations=14,
            thorough=False,
            goal=goal,
        )
        poor = is_poor_fit(fit.predictor, fit.solution)
        if fit.noise_correlation > SLOW_NOISE and poor:
            # Strongly correlated noise absorbs any misfit, and the likelihood says nothing.
            return None
        if fit.converged or fit.log_likelihood < best - 50.0 or poor:
            return fit
        return refit(fit, most_iterations=40, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


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


# ------------------------------------------------------------------------------
# Memory of a search over hypotheses about many trials: curves of fits that no longer compete are dropped.
#
# The curves of a fit to a thousand trials of 550 frames take some sixty megabytes, its misfit tests 700, and a search
# makes dozens of fits. Numbers, likelihood and state of a fit always stay; its curves are computed again from them
# where a later step needs them.


Key = TypeVar("Key")


def is_large(fit: Fit) -> bool:
    """Whether a fit has so many points that the fits of other hypotheses cannot all be kept whole."""
    # 150_000: points of all trials from which curves are dropped (chosen)
    return sum(trial_data.time_s.size for trial_data in fit.predictor.data) > 150_000


def drop_curves(fitted: MutableMapping[Key, LikelihoodRatio]) -> None:
    """Drop the curves of hypotheses that can no longer enter an answer set."""
    ranked = sorted(fitted.items(), key=lambda entry: -entry[1].fit.log_likelihood)
    # 8: fits, the likeliest of a search, that are kept whole (chosen)
    for key, hypothesis in ranked[8:]:
        fit = hypothesis.fit
        deviance_excess = 2 * (ranked[0][1].fit.log_likelihood - fit.log_likelihood)
        if fit.trials and deviance_excess > OUT_OF_REACH and is_large(fit):
            fitted[key] = replace(hypothesis, fit=without_curves(fit))


def without_curves(fit: Fit) -> Fit:
    """Return a fit without its curves: its numbers, its state and the residuals of each trial."""
    residuals = tuple(columns[:, -1:].copy() for columns in fit.solution.columns)
    return replace(fit, trials=(), solution=replace(fit.solution, columns=residuals))


def with_curves(fit: Fit) -> Fit:
    """Return a fit with its curves, computed again where they were dropped."""
    if fit.trials:
        return fit
    former, state = fit.predictor, fit.solution.state
    predictor = Predictor(former.layout, former.data, former.host)
    predictor.steps, predictor.pressure_step = former.steps.copy(), former.pressure_step.copy()
    columns = predictor.linearise(state.theta, state.trial_effects)
    # Cross products stay those of the fit, whose columns were computed with other steps.
    solution = replace(fit.solution, columns=tuple(columns))
    trials = assemble(former, solution, fit.left_out, fit.options, profile=False).trials
    return replace(fit, trials=trials, solution=solution)


Report = Callable[[str], None]  # Called with a few words on what is being done


FAILED_FIT_DELTA_CHI2 = -1.0  # Δχ² of an added effect below which its fit has failed (derived)

MIN_SHARE_OF_BEST_PREDICTION = 0.2  # Share of the best predicted gain from which an effect is fitted (chosen)

# −2 ln L by which a subset fit may end behind the best and still be fitted to all trials (chosen)
SUBSET_REACH = 40.0

MAX_FULL_FITS = 7  # Candidates fitted to all trials after their subset fits, at most (chosen)

STARTS_PER_EFFECT = 3  # Shapes of an effect from which it is fitted (chosen)


@dataclass
class CandidateFits:
    """Fits of single effects added to one model. Subset fits and full fits are made once each. `subset_fits` and
    `fitted` (full fits) are by name; `failed` are effects whose fits failed.
    """

    tests: MisfitTests
    report: Report
    subset_fits: dict[str, SubsetFit] = field(default_factory=dict)
    fitted: dict[str, LikelihoodRatio] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    nested_checked: list[Fit] = field(default_factory=list)
    nested_labels: set[str] = field(default_factory=set)
    nested_tried: set[NestedForm] = field(default_factory=set)
    tests_by_fit: list[tuple[Fit, bool, MisfitTests]] = field(default_factory=list)
    max_full_fits: int = MAX_FULL_FITS

    def __post_init__(self) -> None:
        self.subset_fitter = SubsetFitter(self.tests.fit)
        self.best_deviance = math.inf

    @property
    def linear_prediction_holds(self) -> bool:
        """Whether linear predictions are accurate enough to choose candidates by."""
        near = not self.tests.far_off and not self.tests.needs_search
        # 100.0: largest predicted Δχ² at which linear predictions are still good to a per cent (measured)
        return near and max(map(self.tests.predicted_gain, self.names), default=0.0) < 100.0

    @property
    def names(self) -> list[str]:
        """Effects to which trials respond, the largest predicted gain first."""
        names = dict.fromkeys(self.tests.sensitivities.effects)
        return sorted(names, key=lambda name: -self.tests.predicted_gain(name))

    @property
    def credible_fits(self) -> list[LikelihoodRatio]:
        """Fitted hypotheses of plausible and credible sizes."""
        return [hypothesis for hypothesis in self.fitted.values() if hypothesis.plausible and hypothesis.credible]

    def tests_after(self, fit: Fit, *, film: bool = False) -> MisfitTests:
        """Run the misfit tests of one of the fits, at the level of later rounds."""
        for tested_fit, with_film, tests in self.tests_by_fit:
            if tested_fit is fit and with_film == film:
                return tests
        tests = misfit_tests(with_curves(fit), self.tests.effects, FALSE_ALARM_LEVEL_LATER_ROUNDS, film=film)
        if is_large(fit):
            self.tests_by_fit.clear()
        self.tests_by_fit.append((fit, film, tests))
        return tests

    def fit_singles(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit each effect alone that may be the best or near it."""
        if self.linear_prediction_holds:
            return self.fit_to_all_trials(all_of_them=all_of_them)
        by_score = sorted(self.names, key=lambda name: -self.tests.best_z(name)[0])
        # 5, 4: effects of the largest predicted gains and of the highest scores, fitted to the subset (chosen)
        promising = dict.fromkeys((*self.names[:5], *by_score[:4], *self._promising))
        self._fit_subsets(self.names if all_of_them else promising)
        ranked = sorted(self.subset_fits.values(), key=lambda subset_fit: subset_fit.deviance)
        chosen = [subset_fit for subset_fit in ranked if subset_fit.deviance - ranked[0].deviance < SUBSET_REACH]
        for subset_fit in chosen if all_of_them else chosen[: self.max_full_fits]:
            self._fit(subset_fit)
        self._fit_simpler_forms()
        return list(self.fitted.values())

    def fit_to_all_trials(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit candidates of large predicted gain, or all, to all trials whatever their subset fits gave. A subset fit
        may end in a local minimum. And a model whose parameters have adapted to the lack of an effect may predict no
        gain for it, not even the right sign.
        """
        for name in self.names if all_of_them else self._promising:
            if name not in self.fitted and name not in self.failed:
                self._fit_from_prediction(name)
        self._fit_simpler_forms()
        return list(self.fitted.values())

    def _fit_simpler_forms(self) -> None:
        """Fit the simpler forms of effects that contain one, from where the larger form ended. A larger form that is
        out of the running is skipped: the simpler form is nested in it and fits no better.
        """
        before = self.tests.fit
        best = max((hypothesis.fit.log_likelihood for hypothesis in self.fitted.values()), default=0.0)
        for hypothesis in list(self.fitted.values()):
            excluded = 2 * (best - hypothesis.fit.log_likelihood) > OUT_OF_REACH
            if excluded or any(checked is hypothesis.fit for checked in self.nested_checked):
                continue
            self.nested_checked.append(hypothesis.fit)
            for effects, fit in simpler_forms(before, hypothesis, self.tests.effects, self.nested_tried):
                simpler = likelihood_ratio(before, effects, fit)
                self.nested_labels.add(simpler.label)
                known = self.fitted.get(simpler.label)
                if known is None or simpler.delta_chi2 > max(known.delta_chi2, FAILED_FIT_DELTA_CHI2):
                    self.fitted[simpler.label] = simpler

    @property
    def _promising(self) -> list[str]:
        """Effects of a large part of the largest predicted gain."""
        gains = {name: self.tests.predicted_gain(name) for name in self.names}
        return [name for name in gains if gains[name] > MIN_SHARE_OF_BEST_PREDICTION * max(gains.values())]

    def _fit_subsets(self, names: Iterable[str]) -> None:
        """Fit effects to the subset, each from its best shapes and from the sizes of common slips in the sheet."""
        for name in names:
            if name in self.subset_fits or name in self.failed:
                continue
            self.report(f"trying {name}")
            indices = self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]
            sizes = self.tests.predicted_gains[1]
            shapes = self.tests.sensitivities.shapes
            starts = distinct_starts((shapes[i], float(sizes[i])) for i in indices)
            starts += sheet_slip_starts(shapes[indices[0]].effect)
            subset_fit = best_subset_fit(self.subset_fitter, starts, self.best_deviance)
            if subset_fit is None:
                self.failed.add(name)
                continue
            self.best_deviance = min(self.best_deviance, subset_fit.deviance)
            self.subset_fits[name] = subset_fit

    def _fit_from_prediction(self, name: str) -> None:
        """Fit an effect to all trials from its shapes of largest predicted gain, until one gains what is predicted."""
        sizes = self.tests.predicted_gains[1]
        for index in self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]:
            shape = self.tests.sensitivities.shapes[index]
            self._fit(SubsetFit((shape.effect,), math.nan, start_values(shape, float(sizes[index]))))
            # 0.7: share of its predicted gain that a fit to all trials must reach for no other shape of
            # the effect to be tried (chosen)
            required = 0.7 * self.tests.predicted_gain(name)
            if name in self.fitted and self.fitted[name].delta_chi2 > required:
                break

    def _fit(self, start: SubsetFit) -> None:
        """Fit a hypothesis to all trials from a start, unless it is known from a better one."""
        name = "+".join(start.names)
        from_subset = math.isfinite(start.deviance)
        if name in self.fitted and from_subset:
            return
        self.report(f"fitting {name}")
        # A hypothesis whose sizes are not credible, however well it fits, is no reason to abandon the others.
        best = max((known.fit.log_likelihood for known in self.credible_fits), default=-math.inf)
        fit = full_fit(self.tests.fit, start, best)
        hypothesis = None if fit is None else likelihood_ratio(self.tests.fit, start.effects, fit)
        if hypothesis is None or hypothesis.delta_chi2 < FAILED_FIT_DELTA_CHI2:
            self.failed.add(name)
        elif name not in self.fitted or hypothesis.delta_chi2 > self.fitted[name].delta_chi2:
            self.fitted[name] = hypothesis
            drop_curves(self.fitted)
