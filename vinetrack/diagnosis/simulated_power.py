"""Simulated campaigns of a design, diagnosed in full as measured ones are: a check on linear theory."""

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
from vinetrack.diagnosis.initial_fit import candidates_of
from vinetrack.diagnosis.power import Rate, SimulatedRates
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.dynamics.host import host_for
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.fit_data import FitError
from vinetrack.planning.simulated_campaigns import make


@dataclass(frozen=True)
class SimulatedDiagnosis:
    """Result of the diagnosis of one simulated campaign. `effect` and `value` are those of the true model, blank and
    NaN where nothing was missing; `failed` is the reason why there is no verdict.
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
        """Whether anything was called missing or a fault of the measurement."""
        return bool(self.verdict) and self.verdict != ADEQUATE

    @property
    def is_found(self) -> bool:
        """Whether the effect is in the answer set, or was added later."""
        return self.alarm and self.effect in (*self.answer_set, *self.effects)

    @property
    def named(self) -> str:
        """What was named: the members of the answer set, else the verdict."""
        return " or ".join(self.answer_set) or self.verdict


def simulated_diagnosis(design: CampaignDesign, effect: str, value: float, seed: int) -> SimulatedDiagnosis:
    """Simulate one campaign of a design and diagnose it in full."""
    start_s = time.perf_counter()
    try:
        truth = design.with_effect(effect, value) if effect else design
        draw = np.random.default_rng([seed, 77])
        host = host_for(design.to_fit, candidates_of(design.to_fit, design.candidates, design.model.user_effects))
        pairs = make(truth.model, truth.trials, truth.cameras, truth.spreads, draw, host)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            diagnosis = diagnose(
                with_measurement_errors(truth, pairs), model=design.to_fit, candidates=design.candidates, ladder=False,
                advice=False, user_effects=design.model.user_effects,
            )  # fmt: skip
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError) as error:
        return SimulatedDiagnosis(effect, value, seed, failed=f"{type(error).__name__}: {error}")
    return SimulatedDiagnosis(
        effect, value, seed, diagnosis.verdict, diagnosis.answer_set, diagnosis.effects, time.perf_counter() - start_s
    )


def rates_of(diagnoses: Sequence[SimulatedDiagnosis], promised: float) -> SimulatedRates:
    """Count the outcomes of campaigns with the same effect at the same size."""
    completed = [diagnosis for diagnosis in diagnoses if not diagnosis.failed]
    named = Counter(diagnosis.named for diagnosis in completed if diagnosis.alarm)
    return SimulatedRates(
        effect=diagnoses[0].effect,
        value=diagnoses[0].value,
        promised=promised,
        alarms=Rate(sum(diagnosis.alarm for diagnosis in completed), len(completed)),
        detections=Rate(sum(diagnosis.is_found for diagnosis in completed), len(completed)),
        named=tuple(named.most_common()),
        failed=len(diagnoses) - len(completed),
    )
