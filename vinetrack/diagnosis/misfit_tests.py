"""Tests of one fitted model: is anything missing, and which effect would explain it. No model is refitted.

A model is rejected by any of three kinds of test. Score tests are made of each candidate (`score_test`, with
family-wise thresholds from `family_test`). Omnibus tests name no candidate: score tests of smooth probe forces, and a
test of the trial effects (`between_conditions_p`). The last compares the misfit with the noise
and the slow errors of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.score_test import (
    CandidateShape,
    FamilyTest,
    Products,
    Scores,
    family_test,
    plausible_range,
    products_of,
    scores_of,
    shapes_of,
)
from vinetrack.dynamics.model import probe
from vinetrack.effects import Effect
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import relative_residuals

# ------------------------------------------------------------------------------
# Omnibus score test of probe forces: would any smooth force improve the fit, whether or not it is in the catalogue.
#
# Probes are bumps of force along the growth, over speed and over time, tested like the shapes of one more candidate.


def _probe_shapes(fit: Fit) -> list[CandidateShape]:
    """Bumps of force along the growth, over speed and over time, with and without a factor P."""
    longest_s = max(float(trial.time_s[-1] - trial.release_s) for trial in fit.trials)
    fastest = max(
        trial.trial.travel_ratio * float(np.quantile(trial.predicted_velocity_m_s, 0.98)) for trial in fit.trials
    )
    # As a part of the length where that is known
    reach = max(
        float(np.max(trial.lead_position_m) - trial.origin_m) / (np.nan_to_num(trial.trial.length_m) or 1.0)
        for trial in fit.trials
    )
    varied = len({round(trial.trial.pressure_Pa, 1) for trial in fit.trials}) > 1
    shapes = []
    # 8, 4, 4: number of probe bumps along growth, speed and time (chosen)
    for kind, count, top in ((0, 8, reach), (1, 4, fastest), (2, 4, longest_s)):
        centres = (np.arange(count) + 0.5) / count * top
        for centre in centres:
            for offset in (0, 3) if varied and kind == 0 else (0,):
                shapes.append(CandidateShape(probe(), (float(kind + offset), float(centre), 0.6 * top / count), 1e-3))
    return shapes


def any_probe_exceeds(scores: Scores, level: float) -> bool:
    """Whether the score of some probe exceeds the threshold of so many bumps, of either sign."""
    signs, names = [0] * scores.score.size, ["probe"] * scores.score.size
    threshold = family_test(scores.cosines, signs, names, level).threshold("probe")
    return bool(np.max(scores.one_sided(signs), initial=0.0) > threshold)


# ------------------------------------------------------------------------------
# Whether trial effects have absorbed what a model lacks.
#
# The deviations of pressure and B of each trial can absorb part of a misfit. Deviations by chance differ between
# replicates of a condition; those that compensate for the model are the same in all of them.

MIN_REPLICATE_DEGREES = 4  # Degrees of freedom between replicates from which their scatter is estimated (chosen)

CAREFUL_DAMPING_SCATTER = 0.04  # Root mean square of ln B by which conditions may differ (chosen)

CAREFUL_PRESSURE_SCATTER = 0.02  # Relative standard deviation of pressure that is usual between trials (chosen)


def between_conditions_p(fit: Fit) -> float:
    """p-value that conditions differ in pressure or B no more than replicates do. 1 where replicates are too few, or
    where conditions differ by less than is usual in careful work.
    """
    known = [p for p, _ in _by_conditions(fit) if not math.isnan(p)]
    return min(2 * min(known, default=1.0), 1.0)


def has_excess_scatter(fit: Fit) -> bool:
    """Whether trials scatter more than is usual in careful work, so that their effects may have absorbed a misfit. They
    have not where conditions differ by no more than replicates, or than is usual: deviations that compensate for a
    model are the same in replicates.
    """
    # 0.05: p-value from which conditions count as differing no more than their replicates (chosen)
    return any(excess and not p > 0.05 for p, excess in _by_conditions(fit))


def _by_conditions(fit: Fit) -> list[tuple[float, bool]]:
    """Of pressure and of ln B: the p-value that conditions differ no more than replicates do, and whether trials
    scatter more than is usual.
    """
    stated = [
        trial.trial.pressure_sigma_Pa / trial.trial.pressure_Pa for trial in fit.trials if trial.trial.pressure_Pa > 0
    ]
    known = [relative for relative in stated if math.isfinite(relative)]
    # 2.0: root mean square by which conditions may differ, in stated errors of the pressure (chosen)
    pressure = max(2.0 * float(np.median(known)) if known else 0.0, CAREFUL_PRESSURE_SCATTER)
    groups = [trial.trial.condition for trial in fit.trials]
    fitted, (pressure_sd, damping_sd) = sum(not math.isfinite(number.bound) for number in fit.numbers), fit.state.spread
    p_values = (
        _anova_p(np.array([trial.pressure_deviation for trial in fit.trials]), groups, fitted, pressure),
        _anova_p(np.log1p([trial.damping_deviation for trial in fit.trials]), groups, fitted, CAREFUL_DAMPING_SCATTER),
    )
    excess = pressure_sd > CAREFUL_PRESSURE_SCATTER, damping_sd > CAREFUL_DAMPING_SCATTER
    return list(zip(p_values, excess, strict=True))


def _anova_p(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> float:
    """p-value of a one-way analysis of variance; 1 where the group means differ by less than `allowed`, rms. NaN where
    too few members tell; with no more groups than parameters fitted to them, no difference between groups can show.
    """
    from scipy.stats import f

    _, group, count = np.unique(groups, return_inverse=True, return_counts=True)
    mean = np.bincount(group, values) / count
    inner, outer = values.size - count.size, count.size - fitted
    if inner < MIN_REPLICATE_DEGREES or outer < 1:
        return math.nan
    within, between = float(np.sum((values - mean[group]) ** 2)), float(np.sum(count * mean**2))
    if not within > 0 or math.sqrt(between / values.size) < allowed:
        return 1.0
    # Replicates that hardly differ would make any difference significant: their variance is at least (allowed / 3)².
    within_variance = max(within / inner, allowed**2 / 9)
    return float(f.sf(between / outer / within_variance, outer, inner))


# Probability that the best of all candidates exceeds its threshold where nothing is missing (chosen)
FALSE_ALARM_LEVEL_FIRST_ROUND, FALSE_ALARM_LEVEL_LATER_ROUNDS = 3e-3, 1e-4

PROBE_LEVEL = 3e-4  # Largest level of the test of all probes (chosen)

# χ² per degree of freedom, against the noise of the tracks alone, from which a model is far off (chosen)
FAR_OFF_CHI2_PER_DOF = 4.0

# Root mean square misfit of the median trial, as a fraction of its growth, that exceeds the slow errors of any tracker
MISSED_FRACTION = 6e-4

# A model that passes every test is searched nevertheless from this χ² per degree of freedom; an effect must then reach
# this many standard deviations (chosen)
SEARCH_CHI2_PER_DOF, SEARCH_SIGMAS = 1.5, 6.0

# Significance that the largest plausible size of an effect must reach for the effect to be testable (chosen)
TESTABLE_SIGMAS = 3.0


LARGEST_MISSED = 0.1  # Misfit of a trial, as a part of its growth, that no error of a track explains (chosen)


def exceeds_slow_errors(fit: Fit) -> bool:
    """Whether the misfit of a fit exceeds the noise and, as a part of the growth of the median trial, the slow errors
    of the tracks; or more of the growth of any trial than an error of a track explains.
    """
    data = fit.predictor.data
    systematic = float(
        np.median([trial_data.position_systematic_m / np.ptp(trial_data.lead_position_m) for trial_data in data])
    )
    missed = relative_residuals(fit.predictor, fit.solution)
    beyond = np.median(missed) > max(MISSED_FRACTION, systematic) or np.max(missed) > LARGEST_MISSED
    return bool(fit.chi2_per_dof > FAR_OFF_CHI2_PER_DOF and beyond)


@dataclass(frozen=True)
class MisfitTests:
    """Test statistics of one fit for every candidate. Arrays have shape (n_shapes,), see `Products`."""

    fit: Fit
    effects: tuple[Effect, ...]
    products: Products
    scores: Scores
    level: float

    @cached_property
    def one_sided_z(self) -> Floats:
        """Score of every shape in standard errors, see `Scores.one_sided`."""
        return self.scores.one_sided(self.signs)

    @property
    def signs(self) -> list[int]:
        """Sign of each shape's size: 1 or −1 where physics fixes it, else 0."""
        return [shape.size.sign if shape.effect.parameters else 1 for shape in self.products.shapes]

    @cached_property
    def family(self) -> FamilyTest:
        """Thresholds of z for the candidates, such that any exceeds its own by chance with probability `level`."""
        return family_test(self.scores.cosines, self.signs, self.products.effects, self.level)

    def any_exceeds(self, level: float) -> bool:
        """Whether any candidate exceeds its threshold at a level that all of them share."""
        family = family_test(self.scores.cosines, self.signs, self.products.effects, level)
        thresholds = np.array([family.threshold(name) for name in self.products.effects])
        return bool(np.any(self.one_sided_z > thresholds))

    @property
    def rejects_model(self) -> bool:
        """Whether any test rejects the model: something is missing, in the catalogue or not."""
        return exceeds_slow_errors(self.fit) or self.any_exceeds(self.level) or self.omnibus_rejects

    @property
    def omnibus_rejects(self) -> bool:
        """Whether a test that names no candidate rejects: probe forces, or trial effects."""
        return self.trial_effect_p < 0.1 * self.level or self.probes_reject

    @cached_property
    def trial_effect_p(self) -> float:
        """p-value of the trial effects: conditions differ no more than replicates."""
        return between_conditions_p(self.fit)

    @property
    def needs_search(self) -> bool:
        """Whether to search even where every test passes: trial effects or noise may have absorbed the misfit."""
        # 1e-2: p-value of the trial effects below which a model that passes every test is searched too (chosen)
        return self.fit.chi2_per_dof > SEARCH_CHI2_PER_DOF or self.trial_effect_p < 1e-2

    @cached_property
    def probes_reject(self) -> bool:
        """Whether a smooth force would improve the fit."""
        scores = scores_of(self.fit, products_of(self.fit, _probe_shapes(self.fit)))
        return any_probe_exceeds(scores, min(PROBE_LEVEL, self.level))

    @cached_property
    def predicted_gains(self) -> Floats:
        """Predicted fall of −2 ln L with each shape (linear); 0 where its sign is not allowed."""
        signs, size = np.array(self.signs), self.scores.size
        return np.where((signs == 0) | (size * signs > 0), self.scores.score * size, 0.0)

    def ranked_shapes(self, name: str) -> list[int]:
        """Indices of an effect's shapes, the largest predicted gain first."""
        indices = [i for i, effect in enumerate(self.products.effects) if effect == name]
        return sorted(indices, key=lambda i: -self.predicted_gains[i])

    def predicted_gain(self, name: str) -> float:
        """Largest fall of −2 ln L that is predicted for any shape of an effect; 0 without shapes."""
        return float(np.max(self.predicted_gains[self.ranked_shapes(name)], initial=0.0))

    def best_z(self, name: str) -> float:
        """Largest z of an effect; 0 where no trial responds to it."""
        return float(np.max(self.one_sided_z[self.ranked_shapes(name)], initial=0.0))

    def upper_limits(self, effect: Effect) -> tuple[dict[str, float], bool]:
        """Upper limit (one-sided 95 %) of an undetected size, and whether a plausible size would be detected at all.
        Returns limits (by `effect.parameter`, SI; empty where no trial responds to the effect or it is not testable),
        testable. Student's t counts where errors are those of the scatter of trials.
        """
        from scipy.stats import norm, t

        indices = self.ranked_shapes(effect.name)
        if not indices or not effect.parameters:
            return {}, bool(indices)
        size, sigma = self.scores.size[indices], self.scores.sigma[indices]
        parameter = self.products.shapes[indices[0]].size
        largest_plausible = max(abs(bound - parameter.zero) for bound in plausible_range(parameter))
        if not np.isfinite(sigma).all() or largest_plausible < TESTABLE_SIGMAS * sigma.min():
            return {}, False
        # The limit of the shape with the largest one holds whatever form the effect has.
        beyond = np.maximum(parameter.sign * size, 0.0) if parameter.sign else np.abs(size)
        by_scatter = (self.scores.robust_sigma > self.scores.plain_sigma)[indices]
        limits = beyond + np.where(by_scatter, t.ppf(0.95, max(self.scores.degrees, 3.0)), norm.ppf(0.95)) * sigma
        sign = parameter.sign or math.copysign(1.0, size[np.argmax(limits)])
        return {f"{effect.name}.{parameter.name}": parameter.zero + sign * float(limits.max())}, True


def misfit_tests(fit: Fit, effects: Sequence[Effect], level: float) -> MisfitTests:
    """Test a fit for these candidates and for misfit that none of them describes."""
    effects = tuple(effect for effect in effects if effect.name not in fit.model)
    trials = [trial.trial for trial in fit.trials]
    shapes: list[CandidateShape] = [shape for effect in effects for shape in shapes_of(effect, trials)]
    products = products_of(fit, shapes)
    return MisfitTests(fit, effects, products, scores_of(fit, products), level)
