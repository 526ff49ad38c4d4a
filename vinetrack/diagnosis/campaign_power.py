"""Power of a campaign: of trials that were fitted, or of a planned design.

A planned campaign is simulated without noise, and tested with the noise and between-trial scatter expected of it.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis.diagnose import diagnose
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.power import Power, PowerInput, Rate, SimulatedRates
from vinetrack.diagnosis.remarks import Remark
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.diagnosis.score_test import shapes_of, testable
from vinetrack.dynamics.model import Model, host_for
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.planning.simulated_campaigns import FilmingPlan, make


def fit_power(fitted: Fit, candidates: Sequence[str] | None = None, inputs: Sequence[PowerInput] = ()) -> Power:
    """Compute which effects outside its model the trials of a fit can detect."""
    candidates_to_test = candidates_of(fitted.model, candidates, fitted.model.user_effects)
    effects, not_testable = testable(candidates_to_test, fitted.predictor.data)
    tests = misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)
    return power_of(tests, not_testable, inputs, nonlinear=True)


def design_power(design: CampaignDesign, inputs: Sequence[PowerInput] = ()) -> Power:
    """Compute which effects a planned campaign could detect."""
    tests, not_testable = planned_tests(design)
    return power_of(tests, not_testable, inputs, nonlinear=True)


@dataclass(frozen=True)
class CampaignDesign:
    """What a campaign is simulated from: the true model with its values, trials, cameras, between-trial scatter.
    `cameras`, `slow_error_m` and `has_trace` are given for each trial: how it is filmed, the slow error that its
    tracker states (NaN for positions measured elsewhere), and whether its pressure is measured.
    """

    model: Model
    trials: tuple[Trial, ...]
    cameras: tuple[FilmingPlan, ...]
    spreads: tuple[float, float]
    slow_error_m: tuple[float, ...]
    has_trace: tuple[bool, ...]
    candidates: tuple[str, ...] | None = None
    other_values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def to_fit(self) -> Model:
        """The model without the values that a fit estimates."""
        held = [f"{effect.name}.{parameter.name}" for effect in self.model for parameter in effect.parameters
                if parameter.held]  # fmt: skip
        return replace(self.model, values={key: self.model.values[key] for key in held if key in self.model.values})

    def with_effect(self, name: str, value: float) -> CampaignDesign:
        """The same design with an effect in the true model that the fitted one lacks."""
        model = self.model + name
        effect = next(effect for effect in model if effect.name == name)
        if not effect.parameters:
            return replace(self, model=model)
        small = [shape for shape in shapes_of(effect) if not shape.whole] or shapes_of(effect)
        values = (value, *self.other_values.get(name, small[len(small) // 2].other_values))
        names = [f"{name}.{parameter.name}" for parameter in effect.parameters]
        return replace(self, model=model.with_values(dict(zip(names, values, strict=True))))


def design_of_fit(fitted: Fit, candidates: Sequence[str] | None = None) -> CampaignDesign:
    """The design of a fitted campaign, with its model as the truth and its noise and scatter as estimated."""
    data = fitted.predictor.data
    variance = fitted.state.variance / (1 - fitted.state.rho**2)
    cameras = [
        FilmingPlan(
            capture_fps=1 / trial_data.frame_s,
            noise_m=math.sqrt(float(variance[i])),
            noise_correlation=float(fitted.state.rho),
            longest_s=float(trial_data.time_s[-1] - trial_data.time_s[0]),
            stops_s=float(trial_data.time_s[-1]) - fitted.trials[i].release_s,
        )
        for i, trial_data in enumerate(data)
    ]
    trials = [replace(trial_data.trial, position_systematic_m=trial_data.position_systematic_m) for trial_data in data]
    pressure, damping = fitted.state.spread
    return CampaignDesign(
        model=fitted.model,
        trials=tuple(trials),
        cameras=tuple(cameras),
        spreads=(float(pressure), float(damping)),
        slow_error_m=tuple(math.nan if known.slow_m is None else float(np.median(known.slow_m)) for known in data),
        has_trace=tuple(trial_data.trace is not None for trial_data in data),
        candidates=None if candidates is None else tuple(candidates),
    )


def planned_tests(design: CampaignDesign) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a noise-free campaign with all candidates, under the noise and scatter of its design. Returns
    tests (its scores are zero but for rounding; its information is what the campaign would have), not_testable (reasons
    by name of the candidates that cannot act with this sheet).
    """
    candidates_to_test = candidates_of(design.model, design.candidates, design.model.user_effects)
    host = host_for(design.model, candidates_to_test)
    # 1e-3: part of the stated noise that the noise-free campaign has (chosen)
    cameras = [replace(camera, noise_m=1e-3 * camera.noise_m, noise_correlation=0.0) for camera in design.cameras]
    exact = [replace(trial, yield_pressure_sigma_Pa=0.0) for trial in design.trials]
    # Noise-free replicates have the same track, which is simulated once. They are compared by their text, because from
    # Python 3.13 on records that hold a NaN are not equal to themselves.
    signatures = [
        repr((replace(trial, name="", specimen="", day="", order=0.0), camera))
        for trial, camera in zip(exact, cameras, strict=True)
    ]
    first = [signatures.index(signature) for signature in signatures]
    unique = sorted(set(first))
    simulated = make(
        design.model, [exact[k] for k in unique], [cameras[k] for k in unique], (0.0, 0.0),
        np.random.default_rng(0), host,
    )  # fmt: skip
    pairs = []
    for planned, k in zip(design.trials, first, strict=True):
        trial, track = simulated[unique.index(k)]
        pairs.append((replace(planned, position_systematic_m=trial.position_systematic_m), track))
    noise_m = math.sqrt(float(np.mean([camera.noise_m**2 for camera in design.cameras])))
    noise = (noise_m, design.cameras[0].noise_correlation)
    fitted = fit(
        design.to_fit,
        with_measurement_errors(design, pairs),
        spreads=design.spreads,
        noise=noise,
        host=host,
        profile=False,
        thorough=False,
    )
    effects, not_testable = testable(candidates_to_test, fitted.predictor.data)
    return misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND), not_testable


def with_measurement_errors(design: CampaignDesign, pairs: Sequence[tuple[Trial, Track]]) -> list[tuple[Trial, Track]]:
    """Give tracks the slow error that a tracker states, and the pressure trace where the campaign measures it."""
    measured = []
    for (trial, track), slow_m, has_trace in zip(pairs, design.slow_error_m, design.has_trace, strict=True):
        stated = np.full(track.time_s.size, slow_m)
        pressure = np.full(track.time_s.size, trial.pressure_Pa) if has_trace else None
        measured.append((trial, replace(track, lead_position_systematic_m=stated, pressure_Pa=pressure)))
    return measured


# ------------------------------------------------------------------------------
# Simulated campaigns of a design, diagnosed in full as measured ones are: a check on linear theory.


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
