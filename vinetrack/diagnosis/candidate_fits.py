"""Fits of single effects: which candidates are worth a fit, and their full fits. Sets of effects: `effect_sets`.

Where linear predictions hold, candidates are chosen by their predicted gain and fitted to all trials at once. Elsewhere
each candidate is first fitted from several starts to a subset, one trial of every condition (`multi_start`), and those
that end near the best are fitted to all trials.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vinetrack.diagnosis.fit_memory import MAX_WHOLE_TESTS, drop_curves, is_large, with_curves
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    MAX_INFLATION,
    LikelihoodRatio,
    best_of,
    likelihood_ratio,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    SEARCH_CHI2_PER_DOF,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.multi_start import (
    SubsetFit,
    SubsetFitter,
    best_subset_fit,
    distinct_starts,
    full_fit,
    sheet_slip_starts,
    start_values,
)
from vinetrack.diagnosis.nested_forms import NestedForm, simpler_forms
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import FitError, refit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.goodness_of_fit import POOR_FIT, is_poor_fit

Report = Callable[[str], None]  # Called with a few words on what is being done

# Largest predicted Δχ² at which linear predictions are still good to a per cent (measured)
LINEAR_PREDICTION_LIMIT = 100.0

MIN_SHARE_OF_SUBSET_GAIN = 0.1  # Share of the subset fit's gain that the fit to all trials must reach (chosen)

FAILED_FIT_DELTA_CHI2 = -1.0  # Δχ² of an added effect below which its fit has failed (derived)

SAME_MINIMUM_PER_POINT = 0.01  # Δχ² per point below which two fits that are far off count as the same minimum (derived)

# Δχ² by which an effect's predicted gain may fall short of the best one's for it still to be fitted (chosen)
LINEAR_REACH, LINEAR_REACH_SHARE, MAX_LINEAR_REACH_SHARE = 16.0, 0.4, 0.75

# Share of its predicted gain that a fit to all trials must reach for no other shape of the effect to be tried (chosen)
PREDICTED_GAIN_SHARE = 0.7

ALIKE_COSINE = 0.95  # Cosine from which two effects count as alike (chosen)

MIN_SHARE_OF_BEST_PREDICTION = 0.2  # Share of the best predicted gain from which an effect is fitted (chosen)

MIN_SUBSET_FITS, HIGHEST_SCORES = 5, 4  # Number of effects fitted to the subset in any case (chosen)

# −2 ln L by which a subset fit may end behind the best and still be fitted to all trials (chosen)
SUBSET_REACH, SUBSET_REACH_SHARE, ALIKE_REACH_FACTOR = 40.0, 0.1, 5.0

MAX_FULL_FITS = 7  # Candidates fitted to all trials after their subset fits, at most (chosen)

STARTS_PER_EFFECT = 3  # Shapes of an effect from which it is fitted (chosen)

# Share of the best gain below which a hypothesis that still misses a visible part of the growth is not fitted from its
# other shapes, if subset fits tried them (chosen)
HOPELESS_GAIN_SHARE = 0.5


@dataclass
class CandidateFits:
    """Fits of single effects added to one model. Subset fits and full fits are made once each. `subset_fits` and
    `fitted` (full fits) are by name; `failed` are effects whose fits failed, `same_minimum` those whose other starts
    ended in the same minimum.
    """

    tests: MisfitTests
    report: Report
    subset_fits: dict[str, SubsetFit] = field(default_factory=dict)
    fitted: dict[str, LikelihoodRatio] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    same_minimum: set[str] = field(default_factory=set)
    started: dict[tuple[tuple[str, ...], str, bool], bool] = field(default_factory=dict)
    nested_checked: list[Fit] = field(default_factory=list)
    nested_labels: set[str] = field(default_factory=set)
    nested_tried: set[NestedForm] = field(default_factory=set)
    tests_by_fit: list[tuple[Fit, bool, MisfitTests]] = field(default_factory=list)
    max_full_fits: int = MAX_FULL_FITS

    def __post_init__(self) -> None:
        self.subset_fitter = SubsetFitter(self.tests.fit)
        self.best_deviance = math.inf
        self.null_deviance = -math.inf

    @property
    def linear_prediction_holds(self) -> bool:
        """Whether linear predictions are accurate enough to choose candidates by."""
        near = not self.tests.far_off and not self.tests.needs_search
        return near and max(map(self.tests.predicted_gain, self.names), default=0.0) < LINEAR_PREDICTION_LIMIT

    @property
    def names(self) -> list[str]:
        """Effects to which trials respond, the largest predicted gain first."""
        names = dict.fromkeys(self.tests.sensitivities.effects)
        return sorted(names, key=lambda name: -self.tests.predicted_gain(name))

    @property
    def credible_fits(self) -> list[LikelihoodRatio]:
        """Fitted hypotheses of plausible and credible sizes."""
        return [hypothesis for hypothesis in self.fitted.values() if hypothesis.plausible and hypothesis.credible]

    @property
    def has_adequate_fit(self) -> bool:
        """Whether a hypothesis fits the tracks: another that is still far off once fitted is then no rival."""
        return any(hypothesis.fit.chi2_per_dof < SEARCH_CHI2_PER_DOF for hypothesis in self.fitted.values())

    def tests_after(self, fit: Fit, *, film: bool = False) -> MisfitTests:
        """Run the misfit tests of one of the fits, at the level of later rounds."""
        for tested_fit, with_film, tests in self.tests_by_fit:
            if tested_fit is fit and with_film == film:
                return tests
        tests = misfit_tests(with_curves(fit), self.tests.effects, FALSE_ALARM_LEVEL_LATER_ROUNDS, film=film)
        if is_large(fit):
            del self.tests_by_fit[: max(len(self.tests_by_fit) - MAX_WHOLE_TESTS + 1, 0)]
        self.tests_by_fit.append((fit, film, tests))
        return tests

    def fit_singles(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit each effect alone that may be the best or near it."""
        if self.linear_prediction_holds:
            return self._fit_predicted(all_of_them=all_of_them)
        self._fit_subsets(self.names if all_of_them else self._worth_a_subset_fit())
        ranked = sorted(self.subset_fits.values(), key=lambda fit: (fit.far_beyond_plausible, fit.deviance))
        if not ranked:
            return []
        best = ranked[0]
        null_fit = self.subset_fitter.fit_hypothesis((), {}, iterations=4)
        self.null_deviance = null_fit.deviance if null_fit else best.deviance
        gain = max(self.null_deviance - best.deviance, 0.0)
        reach = max(SUBSET_REACH, SUBSET_REACH_SHARE * gain)
        alike = [fit for fit in ranked if self.tests.cosine(fit.names[0], best.names[0]) > ALIKE_COSINE]
        within_reach = [
            fit
            for fit in ranked
            if fit.deviance - best.deviance < (ALIKE_REACH_FACTOR * reach if fit in alike else reach)
        ]
        chosen = [fit for fit in within_reach if not fit.far_beyond_plausible] or within_reach
        for subset_fit in chosen if all_of_them else chosen[: self.max_full_fits]:
            self._fit(subset_fit)
        self._fit_simpler_forms()
        self._refit_rivals_from_best()
        return list(self.fitted.values())

    def fit_to_all_trials(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit candidates of large predicted gain, or all, to all trials whatever their subset fits gave. A subset fit
        may end in a local minimum. And a model whose parameters have adapted to the lack of an effect may predict no
        gain for it, not even the right sign.
        """
        top = self.tests.predicted_gain(self.names[0]) if self.names else 0.0
        for name in self.names:
            promising = all_of_them or self.tests.predicted_gain(name) > MIN_SHARE_OF_BEST_PREDICTION * top
            if promising and name not in self.fitted and name not in self.failed:
                self._fit_from_prediction(name)
        self._fit_simpler_forms()
        return list(self.fitted.values())

    def _refit_rivals_from_best(self) -> None:
        """Refit hypotheses just outside the answer set from where the best ended: its releases may suit them too. Where
        trials begin slowly, a minute difference between starts may decide which minimum a fit settles in.
        """
        credible = self.credible_fits
        if not credible or is_poor_fit((best := best_of(credible)).fit.predictor, best.fit.solution):
            return
        rivals = [
            rival
            for rival in credible
            if ANSWER_SET_DELTA_CHI2 < rival.deviance_excess(best) < SUBSET_REACH * ALIKE_REACH_FACTOR
        ]
        for rival in sorted(rivals, key=lambda rival: rival.deviance_excess(best))[:STARTS_PER_EFFECT]:
            model = self.tests.fit.model.with_effects(rival.effects)
            values = {
                key: rival.fit.model.values[key] for key in model.parameter_names if key.split(".")[0] in rival.names
            }
            with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
                fit = refit(best.fit, model, start=values, thorough=False)
                if fit.log_likelihood > rival.fit.log_likelihood:
                    self.fitted[rival.label] = likelihood_ratio(self.tests.fit, rival.effects, fit)

    def _fit_simpler_forms(self) -> None:
        """Fit the simpler forms of effects that contain one, from where the larger form ended. A larger form that is
        out of the running is skipped: the simpler form is nested in it and fits no better.
        """
        before = self.tests.fit
        best = max((hypothesis.fit.log_likelihood for hypothesis in self.fitted.values()), default=0.0)
        for hypothesis in list(self.fitted.values()):
            excluded = 2 * (best - hypothesis.fit.log_likelihood) > ANSWER_SET_DELTA_CHI2 * MAX_INFLATION
            if excluded or any(checked is hypothesis.fit for checked in self.nested_checked):
                continue
            self.nested_checked.append(hypothesis.fit)
            for effects, fit in simpler_forms(before, hypothesis, self.tests.effects, self.nested_tried):
                simpler = likelihood_ratio(before, effects, fit)
                self.nested_labels.add(simpler.label)
                known = self.fitted.get(simpler.label)
                if known is None or simpler.delta_chi2 > max(known.delta_chi2, FAILED_FIT_DELTA_CHI2):
                    self.fitted[simpler.label] = simpler

    def _worth_a_subset_fit(self) -> list[str]:
        """Effects of a large predicted gain or score, and those that look like the most promising one."""
        top = self.tests.predicted_gain(self.names[0]) if self.names else 0.0
        highest_scores = self._highest_scores()
        return [
            name
            for k, name in enumerate(self.names)
            if k < MIN_SUBSET_FITS
            or name in highest_scores
            or self.tests.predicted_gain(name) > MIN_SHARE_OF_BEST_PREDICTION * top
            or self.tests.cosine(name, self.names[0]) > ALIKE_COSINE
        ]

    def _highest_scores(self) -> list[str]:
        return sorted(self.names, key=lambda name: -self.tests.best_z(name)[0])[:HIGHEST_SCORES]

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
            subset_fit = best_subset_fit(self.subset_fitter, starts, self.best_deviance, search=True)
            if subset_fit is None:
                self.failed.add(name)
                continue
            self.best_deviance = min(self.best_deviance, subset_fit.deviance)
            self.subset_fits[name] = subset_fit

    def _fit_predicted(self, *, all_of_them: bool) -> list[LikelihoodRatio]:
        """Fit to all trials the effects whose predicted gain is near the best, or all."""
        names = self.names
        if not names:
            return []
        top, highest_score = self.tests.predicted_gain(names[0]), self._highest_scores()[:1]
        reach = min(max(LINEAR_REACH, LINEAR_REACH_SHARE * top), MAX_LINEAR_REACH_SHARE * top)
        for name in names:
            promising = self.tests.predicted_gain(name) > top - reach
            alike = self.tests.cosine(name, names[0]) > ALIKE_COSINE or name in highest_score
            if (promising or alike or all_of_them) and name not in self.fitted and name not in self.failed:
                self.report(f"fitting {name}")
                self._fit_from_prediction(name)
        self._fit_simpler_forms()
        return list(self.fitted.values())

    def _fit_from_prediction(self, name: str) -> None:
        """Fit an effect to all trials from its shapes of largest predicted gain, until one gains what is predicted."""
        sizes = self.tests.predicted_gains[1]
        for index in self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]:
            shape = self.tests.sensitivities.shapes[index]
            self._fit(SubsetFit((shape.effect,), math.nan, start_values(shape, float(sizes[index]))))
            required = PREDICTED_GAIN_SHARE * self.tests.predicted_gain(name)
            if name in self.fitted and self.fitted[name].delta_chi2 > required:
                break
            if self._is_hopeless(name):
                break

    def _is_hopeless(self, name: str) -> bool:
        """Whether a hypothesis is out of the running from its best shape, and subset fits tried its other shapes."""
        hypothesis = self.fitted.get(name)
        if hypothesis is None or name not in self.subset_fits:
            return False
        best = max(known.delta_chi2 for known in self.fitted.values())
        small_gain = hypothesis.delta_chi2 < HOPELESS_GAIN_SHARE * best
        return small_gain and is_poor_fit(hypothesis.fit.predictor, hypothesis.fit.solution)

    def _negligible_sizes(self, effects: Sequence[Effect]) -> dict[str, Value]:
        """Parameter values at which the effects hardly act."""
        values: dict[str, Value] = {}
        for effect in effects:
            indices = self.tests.ranked_shapes(effect.name)
            if indices:
                shape = self.tests.sensitivities.shapes[indices[0]]
                predicted = float(self.tests.predicted_gains[1][indices[0]])
                values |= start_values(shape, math.copysign(abs(shape.step), predicted))
        return values

    def _fit(self, start: SubsetFit) -> None:
        """Fit a hypothesis to all trials from a start; repeated from others if it gains less than it should."""
        name = "+".join(start.names)
        from_subset = math.isfinite(start.deviance)
        if name in self.fitted and from_subset:
            return
        self.report(f"fitting {name}")
        # A hypothesis whose sizes are not credible, however well it fits, is no reason to abandon the others.
        best = max((known.fit.log_likelihood for known in self.credible_fits), default=-math.inf)
        rescue = from_subset or not self.has_adequate_fit
        if not self._is_new_start(start, rescue=rescue):
            return
        hypothesis = self._fit_from(start, best, rescue=rescue)
        expected = max(self.null_deviance - start.deviance, 0.0) if from_subset else 0.0
        if hypothesis is not None:
            required = MIN_SHARE_OF_SUBSET_GAIN * expected or -_same_minimum_tolerance(hypothesis.fit)
            if hypothesis.delta_chi2 < required:
                hypothesis = self._restarted(start, hypothesis, best, rescue=rescue)
        if hypothesis is None or hypothesis.delta_chi2 < FAILED_FIT_DELTA_CHI2:
            self.failed.add(name)
        elif name not in self.fitted or hypothesis.delta_chi2 > self.fitted[name].delta_chi2:
            self.fitted[name] = hypothesis
            drop_curves(self.fitted)

    def _restarted(
        self, start: SubsetFit, hypothesis: LikelihoodRatio, best: float, *, rescue: bool
    ) -> LikelihoodRatio:
        """Return the best fit of a hypothesis over this and other starts, in case the first start misled it. The first
        restart is from sizes at which it hardly acts, or from the same values with the state reset where it began
        there. If that ends in the same minimum, the start is not to blame, and no other start is tried.
        """
        name = "+".join(start.names)
        if name in self.same_minimum:
            return hypothesis
        negligible = SubsetFit(start.effects, math.nan, self._negligible_sizes(start.effects))
        starts = [(negligible, False), (start, True)] if negligible.values != start.values else [(start, True)]
        fits = [hypothesis]
        for restart, reset in starts:
            if not self._is_new_start(restart, reset=reset, rescue=rescue):
                if restart is start:
                    self.same_minimum.add(name)
                continue
            other = self._fit_from(restart, best, reset=reset, rescue=rescue)
            if other is not None:
                fits.append(other)
                tolerance = _same_minimum_tolerance(other.fit, hypothesis.fit)
                if abs(other.delta_chi2 - hypothesis.delta_chi2) < tolerance:
                    self.same_minimum.add(name)
                    break
        return max(fits, key=lambda fitted: fitted.delta_chi2)

    def _is_new_start(self, start: SubsetFit, *, rescue: bool, reset: bool = False) -> bool:
        """Whether no full fit began there yet; where the model is far off, `refit` always resets the state."""
        key = start.names, repr(sorted(start.values.items())), reset or self.tests.fit.chi2_per_dof > POOR_FIT
        if key in self.started and (self.started[key] or not rescue):
            return False
        self.started[key] = rescue
        return True

    def _fit_from(self, start: SubsetFit, best: float, *, rescue: bool, reset: bool = False) -> LikelihoodRatio | None:
        fit = full_fit(self.tests.fit, start, best, reset=reset, rescue=rescue)
        return None if fit is None else likelihood_ratio(self.tests.fit, start.effects, fit)


def _same_minimum_tolerance(*fits: Fit) -> float:
    """Difference in −2 ln L below which two fits of one hypothesis count as the same minimum."""
    if not all(is_poor_fit(fit.predictor, fit.solution) for fit in fits):
        return -FAILED_FIT_DELTA_CHI2
    n_points = sum(trial.time_s.size for trial in fits[0].predictor.data)
    return max(-FAILED_FIT_DELTA_CHI2, SAME_MINIMUM_PER_POINT * n_points)
