"""Fits of single effects: which candidates are worth a fit, and their fits. Sets of effects: `selection`.

Candidates are chosen by the gain that the linear model predicts, and fitted to all trials from the shapes of which it
expects most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from vinetrack.diagnosis.likelihood_ratio import (
    OUT_OF_REACH,
    LikelihoodRatio,
    likelihood_ratio,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.score_test import CandidateShape
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import is_poor_fit
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.solving import assemble

# Share of the best hypothesis's gain that a hypothesis needs for larger sets to be built on it (chosen)
MIN_SHARE_OF_BEST_GAIN = 0.3


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


def full_fit(before: Fit, model: Model | None = None, *, best: float = -math.inf, **how: Any) -> Fit | None:
    """Refit with another model, or other options of `refit`; None where the fit fails. `best` is the largest ln L of
    other hypotheses: a fit that stays far behind it, or far off the tracks, is given up.
    """
    try:
        # 14, 40, 50.0: iterations of a full fit at first and in all (chosen)
        fit = refit(before, model, most_iterations=14, **how)
        if fit.converged or fit.log_likelihood < best - 50.0 or is_poor_fit(fit.predictor, fit.solution):
            return fit
        return refit(fit, most_iterations=40)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


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

STARTS_PER_EFFECT = 3  # Shapes of an effect from which it is fitted (chosen)


@dataclass
class CandidateFits:
    """Fits of single effects added to one model, by name, made once each; `failed` are effects whose fits failed."""

    tests: MisfitTests
    report: Report
    fitted: dict[str, LikelihoodRatio] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    tests_by_fit: list[tuple[Fit, MisfitTests]] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """Effects to which trials respond, the largest predicted gain first."""
        names = dict.fromkeys(self.tests.products.effects)
        return sorted(names, key=lambda name: -self.tests.predicted_gain(name))

    def tests_after(self, fit: Fit) -> MisfitTests:
        """Run the misfit tests of one of the fits, at the level of later rounds."""
        for tested_fit, tests in self.tests_by_fit:
            if tested_fit is fit:
                return tests
        tests = misfit_tests(with_curves(fit), self.tests.effects, FALSE_ALARM_LEVEL_LATER_ROUNDS)
        if is_large(fit):
            self.tests_by_fit.clear()
        self.tests_by_fit.append((fit, tests))
        return tests

    def fit(self, most: int | None = None, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit candidates of large predicted gain, at `most` so many, or all: a model whose parameters have adapted to
        the lack of an effect may predict no gain for it, not even the right sign.
        """
        for name in self.names if all_of_them else self._promising[:most]:
            if name not in self.fitted and name not in self.failed:
                self._fit_from_prediction(name)
        return list(self.fitted.values())

    @property
    def _promising(self) -> list[str]:
        """Effects of a large part of the largest predicted gain, the largest first."""
        gains = {name: self.tests.predicted_gain(name) for name in self.names}
        return [name for name in gains if gains[name] > MIN_SHARE_OF_BEST_PREDICTION * max(gains.values())]

    def _fit_from_prediction(self, name: str) -> None:
        """Fit an effect from its shapes of largest predicted gain, until one gains what is predicted."""
        self.report(f"fitting {name}")
        for index in self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]:
            shape, size = self.tests.products.shapes[index], float(self.tests.scores.size[index])
            # A hypothesis whose sizes are not credible, however well it fits, is no reason to abandon the others.
            credible = [known for known in self.fitted.values() if known.plausible and known.credible]
            best = max((known.fit.log_likelihood for known in credible), default=-math.inf)
            model = self.tests.fit.model.with_effects((shape.effect,))
            near = any(not is_poor_fit(known.fit.predictor, known.fit.solution) for known in credible)
            fit = full_fit(self.tests.fit, model, start=start_values(shape, size), best=best, once=near)
            hypothesis = None if fit is None else likelihood_ratio(self.tests.fit, (shape.effect,), fit)
            if hypothesis is None or hypothesis.delta_chi2 < FAILED_FIT_DELTA_CHI2:
                self.failed.add(name)
            elif name not in self.fitted or hypothesis.delta_chi2 > self.fitted[name].delta_chi2:
                self.fitted[name] = hypothesis
                drop_curves(self.fitted)
            # 0.7: share of its predicted gain that a fit must reach for no other shape to be tried (chosen)
            if name in self.fitted and self.fitted[name].delta_chi2 > 0.7 * self.tests.predicted_gain(name):
                break
