"""The thresholds of a verdict held against campaigns of the same design in which nothing is missing.

A diagnosis of a first model calls something missing by four tests, each with a level worked out for noise and scatter
of the kind that the fit assumes (`misfit_tests`). Here each becomes a p-value of its own; the same p-values of N
simulated campaigns, made from the fitted model with its noise and scatter and fitted in the same way, say what they are
worth for this design. With k of N at least as extreme as the observed one, its Monte-Carlo p-value is (k + 1)/(N + 1)
(Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 4.2).

Where the levels are right, −ln p of null campaigns is exponential with rate 1. With another rate a the p-value p is
worth p^a; a is estimated by N/Σ(−ln p), and its interval is exact, for 2aΣ(−ln p) is χ² of 2N degrees of freedom. That
reaches further into the tail than N campaigns do, and is told only where the N p-values are exponential by the test of
Kolmogorov and Smirnov.
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
from vinetrack.diagnosis.family_test import family_p_value
from vinetrack.diagnosis.initial_fit import candidates_of, host_for, initial_fit
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    SINGLE_PROBE_LEVEL,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.power import Rate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.fit_data import FitError
from vinetrack.planning.simulated_campaigns import make

TESTS = {
    "scores of all candidates": FALSE_ALARM_LEVEL_FIRST_ROUND,
    "any smooth force": 0.1 * FALSE_ALARM_LEVEL_FIRST_ROUND,
    "the loudest probe": SINGLE_PROBE_LEVEL,
    "replicates that err alike, noise in motion": 0.1 * FALSE_ALARM_LEVEL_FIRST_ROUND,
}
"""Tests of a first model and the level that each is asked at, as `MisfitTests.rejects_model` sets them. Derived."""

FIT_LEVEL = 0.05
"""Level of the test by which the exponential tail is doubted. A convention."""

LEAST_CHANCE = 1e-12
"""p-values below are set to this: what draws them is no longer noise. Chosen."""


@dataclass(frozen=True)
class CampaignPValues:
    """p-values of the tests of one campaign, by name; `seed` negative for the observed one."""

    __test__ = False

    seed: int
    p_values: Mapping[str, float]
    failed: str = ""


@dataclass(frozen=True)
class CalibratedTest:
    """One test: the p-value that the diagnosis worked with, and what it is worth among null campaigns of this design.

    `null` are the p-values of those campaigns.
    """

    name: str
    level: float
    observed: float
    null: tuple[float, ...]

    @property
    def exceeding(self) -> Rate:
        """How many null campaigns are at least as extreme as the observed one."""
        return Rate(sum(chance <= self.observed for chance in self.null), len(self.null))

    @property
    def monte_carlo(self) -> float:
        """Monte-Carlo p-value, (k + 1)/(N + 1)."""
        return (self.exceeding.count + 1) / (len(self.null) + 1)

    @property
    def alarms(self) -> Rate:
        """How many null campaigns the test calls at its level."""
        return Rate(sum(chance < self.level for chance in self.null), len(self.null))

    @property
    def rate(self) -> tuple[float, float, float]:
        """Rate a of the exponential distribution of −ln p, and the ends of its 95 % interval; 1 where levels hold."""
        from scipy.stats import chi2

        total = float(np.sum(self._logs))
        count = len(self.null)
        if not total > 0:
            return math.nan, math.nan, math.nan
        low, high = chi2.ppf([0.025, 0.975], 2 * count) / (2 * total)
        return count / total, float(low), float(high)

    @property
    def is_exponential(self) -> bool:
        """Whether −ln p of the null campaigns may have that distribution."""
        from scipy.stats import kstest

        logs = self._logs
        if logs.size < 2 or not logs.sum() > 0:
            return False
        return bool(kstest(logs * (logs.size / logs.sum()), "expon").pvalue > FIT_LEVEL)

    @property
    def by_tail(self) -> tuple[float, float, float]:
        """The p-value by the exponential tail, and its 95 % interval; NaN where the tail does not fit."""
        if not self.is_exponential:
            return math.nan, math.nan, math.nan
        a, low, high = (max(self.observed, LEAST_CHANCE) ** rate for rate in self.rate)
        return a, high, low

    @property
    def is_called(self) -> bool:
        """Whether the diagnosis called it at its nominal level."""
        return self.observed < self.level

    @property
    def resolves(self) -> bool:
        """Whether so many campaigns can say anything of its level: 1/(N + 1) must not exceed it."""
        return 1 / (len(self.null) + 1) <= self.level

    @property
    def still_called(self) -> bool | None:
        """Whether it would be called by the null distribution of this design; None where that is not known.

        By the Monte-Carlo p-value where there are campaigns enough, by the tail where the level lies outside its
        interval; and not at all where the interval of the rate of more extreme campaigns lies above the level.
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
    def _logs(self) -> Floats:
        return -np.log(np.clip(np.array(self.null), LEAST_CHANCE, 1.0))

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
    """All tests of a first model, calibrated. `failed` counts campaigns that could not be fitted.

    `model` names the effects that were taken for the truth of the null campaigns.
    """

    tests: tuple[CalibratedTest, ...]
    campaigns: int
    failed: int
    model: tuple[str, ...]

    @property
    def was_called(self) -> bool:
        """Whether any test called something at its nominal level."""
        return any(test.is_called for test in self.tests)

    @property
    def still_called(self) -> bool | None:
        """Whether any would be called by the null distributions; None where that is not known of those that matter."""
        answers = [test.still_called for test in self.tests if test.is_called or test.still_called]
        if any(answers):
            return True
        return None if None in answers else False

    @property
    def alarms(self) -> Rate:
        """In how many null campaigns any test raised an alarm at its nominal level."""
        called = np.any([[chance < test.level for chance in test.null] for test in self.tests], axis=0)
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


def p_values_of(questions: MisfitTests) -> dict[str, float]:
    """Return the p-value of each test of a fitted model.

    Parameters
    ----------
    questions : the fit, held against all candidates.

    Returns
    -------
    dict of float
        By name, as in `TESTS`.
    """
    family = family_p_value(
        questions.scores.cosines, questions.signs, questions.sensitivities.effects, questions.one_sided_z
    )
    structure = questions.structure
    return dict(zip(TESTS, (family, structure.p, structure.smallest_probe_p, questions.trial_effect_p), strict=True))


def null_p_values(design: CampaignDesign, seed: int) -> CampaignPValues:
    """Make one campaign of a design with nothing missing, fit it, and ask every test.

    Parameters
    ----------
    design : of the campaign.
    seed : of the random numbers.

    Returns
    -------
    CampaignPValues
    """
    try:
        questioned = candidates_of(design.to_fit, design.candidates, design.model.user_effects)
        draw = np.random.default_rng([seed, 78])
        pairs = make(
            design.model, design.trials, design.cameras, design.spreads, draw, host_for(design.to_fit, questioned)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fitted = initial_fit(design.to_fit, with_measurement_errors(design, pairs), questioned, profile=False)
            effects, _ = testable(questioned, fitted.predictor.data)
            return CampaignPValues(seed, p_values_of(misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)))
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError) as error:
        return CampaignPValues(seed, {}, f"{type(error).__name__}: {error}")


def calibrate(observed: Mapping[str, float], null: Sequence[CampaignPValues], model: Sequence[str]) -> NullCalibration:
    """Hold the p-values of a diagnosis against those of null campaigns.

    Parameters
    ----------
    observed : p-values by test.
    null : of simulated campaigns; those that failed are counted apart.
    model : names of the effects of the fitted model.

    Returns
    -------
    NullCalibration
    """
    given = [campaign for campaign in null if not campaign.failed]
    tests = tuple(
        CalibratedTest(name, level, observed[name], tuple(campaign.p_values[name] for campaign in given))
        for name, level in TESTS.items()
    )
    return NullCalibration(tests, len(given), len(null) - len(given), tuple(model))
