"""Simulated campaigns of a design, diagnosed from beginning to end as real ones are: the check on linear theory."""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.diagnosis.campaign_power import CampaignDesign, with_measurement_errors
from vinetrack.diagnosis.diagnose import diagnose
from vinetrack.diagnosis.initial_fit import candidates_of, host_for
from vinetrack.diagnosis.power import Rate, SimulatedRates
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.fit_data import FitError
from vinetrack.planning.simulated_campaigns import make


@dataclass(frozen=True)
class SimulatedDiagnosis:
    """What the diagnosis of one simulated campaign said.

    `effect` and `value` are what was in it, blank and NaN where nothing was; `failed` is the reason why there is no
    verdict.
    """

    effect: str
    value: float
    seed: int
    verdict: str = ""
    answer_set: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()
    seconds: float = math.nan
    failed: str = ""

    @property
    def alarm(self) -> bool:
        """Whether anything was said to be missing or at fault."""
        return bool(self.verdict) and self.verdict != ADEQUATE

    @property
    def is_found(self) -> bool:
        """Whether the effect is in the answer set, or was added later on."""
        return self.alarm and self.effect in (*self.answer_set, *self.effects)

    @property
    def named(self) -> str:
        """What was named: the members of the answer set, else the verdict."""
        return " or ".join(self.answer_set) or self.verdict


def simulated_diagnosis(design: CampaignDesign, effect: str, value: float, seed: int) -> SimulatedDiagnosis:
    """Make one campaign of a design and diagnose it from beginning to end.

    Parameters
    ----------
    design : of the campaign.
    effect : in the true model but not in the fitted one; blank for none.
    value : of its first parameter, SI.
    seed : of the random numbers.

    Returns
    -------
    SimulatedDiagnosis
    """
    begun = time.perf_counter()
    try:
        truth = design.with_effect(effect, value) if effect else design
        draw = np.random.default_rng([seed, 77])
        host = host_for(design.to_fit, candidates_of(design.to_fit, design.candidates, design.model.user_effects))
        pairs = make(truth.model, truth.trials, truth.cameras, truth.spreads, draw, host)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = diagnose(
                with_measurement_errors(truth, pairs), model=design.to_fit, candidates=design.candidates, ladder=False,
                advice=False, user_effects=design.model.user_effects,
            )  # fmt: skip
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError) as error:
        return SimulatedDiagnosis(effect, value, seed, failed=f"{type(error).__name__}: {error}")
    return SimulatedDiagnosis(
        effect, value, seed, answer.verdict, answer.answer_set, answer.effects, time.perf_counter() - begun
    )


def rates_of(answers: Sequence[SimulatedDiagnosis], promised: float) -> SimulatedRates:
    """Count the answers about campaigns with the same effect at the same size.

    Parameters
    ----------
    answers : one at least.
    promised : float
        What linear theory gives.

    Returns
    -------
    SimulatedRates
        Campaigns without a verdict are counted apart.
    """
    given = [answer for answer in answers if not answer.failed]
    named = Counter(answer.named for answer in given if answer.alarm)
    return SimulatedRates(
        effect=answers[0].effect,
        value=answers[0].value,
        promised=promised,
        alarms=Rate(sum(answer.alarm for answer in given), len(given)),
        detections=Rate(sum(answer.is_found for answer in given), len(given)),
        named=tuple(named.most_common()),
        failed=len(answers) - len(given),
    )
