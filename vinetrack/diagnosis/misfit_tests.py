"""Tests of one fitted model: is anything missing, and which effect would explain it. No model is refitted.

A model is rejected by any of three kinds of test. Score tests are made of each candidate (`score_test`, with
family-wise thresholds from `family_test`). Omnibus tests name no candidate: score tests of smooth probe forces
(`structure_test`), and tests of the trial effects and the noise (`trial_effect_tests`). The last compares the misfit
with the noise and the slow errors of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape, plausible_range, shapes_of
from vinetrack.diagnosis.effect_sensitivities import EffectSensitivities, effect_sensitivities
from vinetrack.diagnosis.family_test import FamilyTest, family_test
from vinetrack.diagnosis.score_test import Scores, linear_gains, scores_of
from vinetrack.diagnosis.shape_products import Products, fit_columns, products_of
from vinetrack.diagnosis.structure_test import Structure, structure_of
from vinetrack.diagnosis.trial_effect_tests import between_conditions_p, noise_in_motion_p
from vinetrack.effects import Effect
from vinetrack.inference.fit_problem import track_correlation
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.goodness_of_fit import is_poor_fit, relative_residual
from vinetrack.inference.systematics import systematics_of

# Probability that the best of all candidates exceeds its threshold where nothing is missing (chosen)
FALSE_ALARM_LEVEL_FIRST_ROUND, FALSE_ALARM_LEVEL_LATER_ROUNDS = 3e-3, 1e-4

SINGLE_PROBE_LEVEL = 3e-4  # Level of the test of the single most significant probe (chosen)

# χ² per degree of freedom, against the noise of the tracks alone, from which a model is far off (chosen)
FAR_OFF_CHI2_PER_DOF = 4.0

# Root mean square misfit of the median trial, as a fraction of its growth, that exceeds the slow errors of any tracker
MISSED_FRACTION, MISSED_FRACTION_WITHOUT_SLOW_ERRORS = 6e-4, 1.5e-4

# A model that passes every test is searched nevertheless from this χ² per degree of freedom, or below this p-value of
# the trial effects; an effect must then reach this many standard deviations (chosen)
SEARCH_CHI2_PER_DOF, SEARCH_P_VALUE, SEARCH_SIGMAS = 1.5, 1e-2, 6.0

# Significance that the largest plausible size of an effect must reach for the effect to be testable (chosen)
TESTABLE_SIGMAS = 3.0

ONE_SIDED_95 = 1.645  # Derived: quantile of the normal distribution


@dataclass(frozen=True)
class MisfitTests:
    """Test statistics of one fit for every candidate. Arrays have shape (n_shapes,), see `EffectSensitivities`."""

    fit: Fit
    effects: tuple[Effect, ...]
    sensitivities: EffectSensitivities
    products: Products
    scores: Scores
    structure: Structure
    level: float

    @cached_property
    def one_sided_z(self) -> Floats:
        """Score of every shape in standard errors (z) where its sign is allowed; 0 where it is not. The smaller of two:
        by the noise model, and by the scatter of single trials, whose Student's t is converted to the normal quantile
        of the same tail probability.
        """
        from scipy.stats import norm, t

        size, signs = self.scores.size, np.array(self.signs)
        allowed_size = np.where(signs == 0, np.abs(size), np.maximum(size * signs, 0.0))
        plain, robust = self.scores.plain_sigma, self.scores.robust_sigma
        z = allowed_size / plain
        with np.errstate(divide="ignore", invalid="ignore"):
            robust_t = np.where(robust > 0, allowed_size / robust, np.inf)
        log_tail = t.logsf(np.minimum(robust_t, 1e6), max(self.scores.degrees, 3.0))
        return np.asarray(np.minimum(z, norm.isf(np.exp(np.maximum(log_tail, -700.0)))))

    @property
    def signs(self) -> list[int]:
        """Sign of each shape's size: 1 or −1 where physics fixes it, else 0."""
        return [shape.size.sign if shape.effect.parameters else 1 for shape in self.sensitivities.shapes]

    @cached_property
    def family(self) -> FamilyTest:
        """Thresholds of z for the candidates, such that any exceeds its own by chance with probability `level`."""
        return family_test(self.scores.cosines, self.signs, self.sensitivities.effects, self.level)

    def largest_excess(self, family: FamilyTest) -> float:
        """Largest excess of a candidate's z over its threshold; negative where no candidate exceeds its own."""
        thresholds = np.array([family.threshold(name) for name in self.sensitivities.effects])
        return float(np.max(self.one_sided_z - thresholds, initial=-math.inf))

    @property
    def rejects_model(self) -> bool:
        """Whether any test rejects the model: something is missing, in the catalogue or not."""
        return bool(self.exceeds_slow_errors or self.omnibus_rejects or self.largest_excess(self.family) > 0)

    @property
    def omnibus_rejects(self) -> bool:
        """Whether a test that names no candidate rejects: probe forces, or trial effects and noise."""
        return self.probes_reject or self.trial_effect_p < 0.1 * self.level

    @cached_property
    def trial_effect_p(self) -> float:
        """p-value of the trial effects: conditions differ more than replicates, or noise is larger in motion."""
        return min(between_conditions_p(self.fit), noise_in_motion_p(self.fit))

    @property
    def needs_search(self) -> bool:
        """Whether to search even where every test passes: trial effects and noise may have absorbed the misfit."""
        return self.fit.chi2_per_dof > SEARCH_CHI2_PER_DOF or self.trial_effect_p < SEARCH_P_VALUE

    @cached_property
    def rejects_at_first_round_level(self) -> bool:
        """Whether any candidate exceeds its threshold at the level of the first round."""
        return (
            self.largest_excess(
                family_test(self.scores.cosines, self.signs, self.sensitivities.effects, FALSE_ALARM_LEVEL_FIRST_ROUND)
            )
            > 0
        )

    @property
    def probes_reject(self) -> bool:
        """Whether a smooth force would improve the fit: all probes together, or the most significant one."""
        all_probes = self.structure.p < 0.1 * self.level
        return all_probes or self.structure.smallest_probe_p < min(SINGLE_PROBE_LEVEL, self.level)

    @property
    def far_off(self) -> bool:
        """Whether the misfit exceeds any noise."""
        return self.fit.chi2_per_dof > FAR_OFF_CHI2_PER_DOF

    @property
    def exceeds_slow_errors(self) -> bool:
        """Whether the misfit exceeds the noise and, as a fraction of growth, the slow errors of the tracks."""
        return self.far_off and relative_residual(self.fit.predictor, self.fit.solution) > self._slow_error_fraction

    @property
    def _slow_error_fraction(self) -> float:
        """Fraction of growth that slow errors may explain; less where neither tracks nor a gauge have such errors."""
        data = self.fit.predictor.data
        systematic = float(
            np.median([trial_data.position_systematic_m / np.ptp(trial_data.lead_position_m) for trial_data in data])
        )
        has_slow_errors = any(trial_data.slow_m is not None or trial_data.trace is not None for trial_data in data)
        return max(MISSED_FRACTION if has_slow_errors else MISSED_FRACTION_WITHOUT_SLOW_ERRORS, systematic)

    @property
    def poorly_fitted(self) -> bool:
        """Whether the model misses a visible part of the growth: linear predictions from this fit are meaningless."""
        return is_poor_fit(self.fit.predictor, self.fit.solution)

    @cached_property
    def predicted_gains(self) -> tuple[Floats, Floats]:
        """Predicted fall of −2 ln L with each shape, and the size it is predicted at (linear)."""
        if self.far_off:
            return linear_gains(self.fit, self.products, track_correlation(self.fit.predictor.data))
        signs, size = np.array(self.signs), self.scores.size
        sign_allowed = (signs == 0) | (size * signs > 0)
        return np.where(sign_allowed, self.scores.score * size, 0.0), size

    def ranked_shapes(self, name: str) -> list[int]:
        """Indices of an effect's shapes, the largest predicted gain first."""
        gains = self.predicted_gains[0]
        return sorted(self._shapes_of(name), key=lambda i: -gains[i])

    def _shapes_of(self, name: str) -> list[int]:
        """Indices of an effect's shapes, in their order."""
        return [i for i, effect in enumerate(self.sensitivities.effects) if effect == name]

    def predicted_gain(self, name: str) -> float:
        """Largest fall of −2 ln L that is predicted for any shape of an effect; 0 without shapes."""
        indices = self.ranked_shapes(name)
        return float(self.predicted_gains[0][indices[0]]) if indices else 0.0

    def best_z(self, name: str) -> tuple[float, int]:
        """Largest z of an effect and the index of its shape; 0 and −1 where no trial responds to it.
        Returns z, index.
        """
        indices = self._shapes_of(name)
        if not indices:
            return 0.0, -1
        index = max(indices, key=lambda i: self.one_sided_z[i])
        return float(self.one_sided_z[index]), index

    def cosine(self, first: str, second: str) -> float:
        """Largest |cosine| between shapes of two effects."""
        pairs = np.ix_(self._shapes_of(first), self._shapes_of(second))
        return float(np.max(np.abs(self.scores.cosines[pairs]), initial=0.0))

    def upper_limits(self, effect: Effect) -> tuple[dict[str, float], bool]:
        """Upper limit (one-sided 95 %) of an undetected size, and whether a plausible size would be detected at all.
        Returns limits (by `effect.parameter`, SI; empty where no trial responds to the effect or it is not testable),
        testable.
        """
        indices = self._shapes_of(effect.name)
        if not indices or not effect.parameters:
            return {}, bool(indices)
        # The shape with the largest standard error gives a limit that holds whatever form the effect has.
        index = max(indices, key=lambda i: self.scores.sigma[i])
        size, sigma = float(self.scores.size[index]), float(self.scores.sigma[index])
        parameter = self.sensitivities.shapes[index].size
        largest_plausible = max(abs(bound - parameter.zero) for bound in plausible_range(parameter))
        key = f"{effect.name}.{parameter.name}"
        if not math.isfinite(sigma) or largest_plausible < TESTABLE_SIGMAS * self.scores.sigma[indices].min():
            return {}, False
        if parameter.sign:
            return {
                key: parameter.zero + parameter.sign * (max(parameter.sign * size, 0.0) + ONE_SIDED_95 * sigma)
            }, True
        return {key: parameter.zero + math.copysign(abs(size) + ONE_SIDED_95 * sigma, size)}, True

    def predicted_size(self, effect: Effect, index: int) -> tuple[Number, ...]:
        """One-step estimate of an effect's size with its standard error; empty where the model is too far off."""
        if index < 0 or not effect.parameters or self.poorly_fitted:
            return ()
        size, sigma = float(self.scores.size[index]), float(self.scores.sigma[index])
        parameter = self.sensitivities.shapes[index].size
        value = parameter.zero + size
        return (
            Number(
                key=f"{effect.name}.{parameter.name}",
                vine=self.sensitivities.shapes[index].group,
                symbol=parameter.symbol,
                unit=parameter.unit,
                value=value,
                sigma=sigma,
                low=value - 1.96 * sigma,
                high=value + 1.96 * sigma,
                dof=self.scores.degrees,
                method="predicted",
                lower=parameter.bounds[0],
                upper=parameter.bounds[1],
            ),
        )


def misfit_tests(fit: Fit, effects: Sequence[Effect], level: float, *, film: bool = False) -> MisfitTests:
    """Test a fit for these candidates and for misfit that none of them describes."""
    effects = tuple(effect for effect in effects if effect.name not in fit.model)
    trials = [trial.trial for trial in fit.trials]
    shapes: list[CandidateShape] = [shape for effect in effects for shape in shapes_of(effect, trials)]
    sensitivities = effect_sensitivities(fit, shapes)
    systematics = systematics_of(fit.predictor, fit.solution, fit.trials, film=film)
    columns = systematics.at_zero_errors(fit_columns(fit))
    products = products_of(fit, columns, sensitivities, systematics)
    structure = structure_of(fit, columns, systematics)
    return MisfitTests(fit, effects, sensitivities, products, scores_of(fit, products), structure, level)
