"""Calibration of the tests behind a verdict on campaigns of the same design in which nothing is missing.

A diagnosis of a first model calls something missing by four tests (`misfit_tests`), whose levels are derived for the
kind of noise and scatter that the fit assumes. Here each test gives a p-value of its own. The same p-values of N
simulated campaigns, drawn from the fitted model with its noise and scatter and fitted in the same way, show what they
mean for this design. With k of N at least as extreme as the observed one, its Monte-Carlo p-value is (k + 1)/(N + 1)
(Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 4.2).

Where the levels are right, −ln p of null campaigns is exponential with rate 1. With another rate a, the calibrated
p-value is p^a; a is estimated by N/Σ(−ln p), with an exact interval, since 2aΣ(−ln p) is χ² with 2N degrees of freedom.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.campaign_power import CampaignDesign, with_measurement_errors
from vinetrack.diagnosis.candidates import testable
from vinetrack.diagnosis.ladder import candidates_of, initial_fit
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    SINGLE_PROBE_LEVEL,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.power import Rate
from vinetrack.diagnosis.score_test import family_p_value
from vinetrack.dynamics.model import host_for
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.fit_data import FitError
from vinetrack.planning.simulated_campaigns import make

# Tests of a first model and their levels, as `MisfitTests.something` sets them (derived)
TESTS = {
    "scores of all candidates": FALSE_ALARM_LEVEL_FIRST_ROUND,
    "any smooth force": 0.1 * FALSE_ALARM_LEVEL_FIRST_ROUND,
    "the loudest probe": SINGLE_PROBE_LEVEL,
    "replicates that err alike, noise in motion": 0.1 * FALSE_ALARM_LEVEL_FIRST_ROUND,
}

TAIL_TEST_LEVEL = 0.05  # Level of the test of the exponential tail

LEAST_P = 1e-12  # Smaller p-values are set to this: they no longer come from noise (chosen)


@dataclass(frozen=True)
class CampaignPValues:
    """p-values of the tests of one campaign, by name; `seed` is negative for the observed one."""

    __test__ = False

    seed: int
    p_values: Mapping[str, float]
    failed: str = ""


@dataclass(frozen=True)
class CalibratedTest:
    """One test: the p-value that the diagnosis used, and those of null campaigns of the same design, `null`."""

    name: str
    level: float
    observed: float
    null: tuple[float, ...]

    @property
    def exceeding(self) -> Rate:
        """How many null campaigns are at least as extreme as the observed one."""
        return Rate(sum(p <= self.observed for p in self.null), len(self.null))

    @property
    def monte_carlo(self) -> float:
        """Monte-Carlo p-value, (k + 1)/(N + 1)."""
        return (self.exceeding.count + 1) / (len(self.null) + 1)

    @property
    def alarms(self) -> Rate:
        """How many null campaigns the test rejects at its level."""
        return Rate(sum(p < self.level for p in self.null), len(self.null))

    @property
    def rate(self) -> tuple[float, float, float]:
        """Rate a of the exponential distribution of −ln p, and the ends of its 95 % interval; 1 where levels hold."""
        from scipy.stats import chi2

        total = float(np.sum(self._minus_log_p))
        count = len(self.null)
        if not total > 0:
            return math.nan, math.nan, math.nan
        low, high = chi2.ppf([0.025, 0.975], 2 * count) / (2 * total)
        return count / total, float(low), float(high)

    @property
    def is_exponential(self) -> bool:
        """Whether −ln p of the null campaigns is consistent with an exponential distribution."""
        from scipy.stats import kstest

        logs = self._minus_log_p
        if logs.size < 2 or not logs.sum() > 0:
            return False
        return bool(kstest(logs * (logs.size / logs.sum()), "expon").pvalue > TAIL_TEST_LEVEL)

    @property
    def by_tail(self) -> tuple[float, float, float]:
        """The calibrated p-value by the exponential tail, and its 95 % interval; NaN where the tail does not fit."""
        if not self.is_exponential:
            return math.nan, math.nan, math.nan
        a, low, high = (max(self.observed, LEAST_P) ** rate for rate in self.rate)
        return a, high, low

    @property
    def is_called(self) -> bool:
        """Whether the diagnosis rejected at its nominal level."""
        return self.observed < self.level

    @property
    def resolves(self) -> bool:
        """Whether there are enough campaigns for its level: 1/(N + 1) must not exceed it."""
        return 1 / (len(self.null) + 1) <= self.level

    @property
    def still_called(self) -> bool | None:
        """Whether the null distribution of this design would reject as well; None where that is not known. By the
        Monte-Carlo p-value where there are enough campaigns, and by the tail where the level lies outside its interval.
        It does not reject where the interval of the rate of more extreme campaigns lies above the level.
        """
        low, _ = self.exceeding.interval
        if low > self.level:
            return False
        if self.resolves and self.monte_carlo <= self.level:
            return True
        _, least, most = self.by_tail
        if most <= self.level:
            return True
        return False if least > self.level else None

    @property
    def _minus_log_p(self) -> Floats:
        return -np.log(np.clip(np.array(self.null), LEAST_P, 1.0))

    def to_json(self) -> dict[str, Any]:
        """As an entry of `calibration.tests`."""
        return {
            "name": self.name,
            "level": self.level,
            "nominal_p": self.observed,
            "monte_carlo_p": self.monte_carlo,
            "more_extreme": self.exceeding.count,
            "interval_95": list(self.exceeding.interval),
            "tail_rate": list(self.rate),
            "tail_p": list(self.by_tail),
            "called": self.is_called,
            "still_called": self.still_called,
            "null_alarms": self.alarms.count,
        }


@dataclass(frozen=True)
class NullCalibration:
    """Calibration of all tests of a first model. `failed` counts campaigns that could not be fitted. `model` names the
    effects of the true model of the null campaigns.
    """

    tests: tuple[CalibratedTest, ...]
    campaigns: int
    failed: int
    model: tuple[str, ...]

    @property
    def was_called(self) -> bool:
        """Whether any test rejected at its nominal level."""
        return any(test.is_called for test in self.tests)

    @property
    def still_called(self) -> bool | None:
        """Whether any test would reject by its null distribution; None where that is not known of those that matter."""
        outcomes = [test.still_called for test in self.tests if test.is_called or test.still_called]
        if any(outcomes):
            return True
        return None if None in outcomes else False

    @property
    def alarms(self) -> Rate:
        """Number of null campaigns in which any test rejected at its nominal level."""
        called = np.any([[p < test.level for p in test.null] for test in self.tests], axis=0)
        return Rate(int(np.count_nonzero(called)), self.campaigns)

    def to_json(self) -> dict[str, Any]:
        """As the key `calibration` of what `vinetrack power --json` writes."""
        return {
            "model": list(self.model),
            "campaigns": self.campaigns,
            "failed": self.failed,
            "called": self.was_called,
            "still_called": self.still_called,
            "null_alarms": self.alarms.count,
            "null_alarms_interval_95": list(self.alarms.interval),
            "tests": [test.to_json() for test in self.tests],
        }


def p_values_of(tests: MisfitTests) -> dict[str, float]:
    """p-value of each test of a fitted model. Returns by name, as in `TESTS`."""
    family = family_p_value(tests.scores.cosines, tests.signs, tests.sensitivities.effects, tests.one_sided_z)
    structure = tests.structure
    return dict(zip(TESTS, (family, structure.p, structure.smallest_probe_p, tests.trial_effect_p), strict=True))


def null_p_values(design: CampaignDesign, seed: int) -> CampaignPValues:
    """Simulate one campaign of a design with nothing missing, fit it, and compute the p-value of every test."""
    try:
        candidates = candidates_of(design.to_fit, design.candidates, design.model.user_effects)
        draw = np.random.default_rng([seed, 78])
        pairs = make(
            design.model, design.trials, design.cameras, design.spreads, draw, host_for(design.to_fit, candidates)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fitted = initial_fit(design.to_fit, with_measurement_errors(design, pairs), candidates, profile=False)
            effects, _ = testable(candidates, fitted.predictor.data)
            return CampaignPValues(seed, p_values_of(misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)))
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError) as error:
        return CampaignPValues(seed, {}, f"{type(error).__name__}: {error}")


def calibrate(observed: Mapping[str, float], null: Sequence[CampaignPValues], model: Sequence[str]) -> NullCalibration:
    """Compare the p-values of a diagnosis with those of null campaigns."""
    completed = [campaign for campaign in null if not campaign.failed]
    tests = tuple(
        CalibratedTest(name, level, observed[name], tuple(campaign.p_values[name] for campaign in completed))
        for name, level in TESTS.items()
    )
    return NullCalibration(tests, len(completed), len(null) - len(completed), tuple(model))
