"""Power of a campaign: of trials that were fitted, or of a planned design.

A planned campaign is simulated without noise, and tested with the noise and between-trial scatter expected of it. As a
check, campaigns are simulated with all of these and diagnosed in full: every trial has its own pressure and B, every
vine a misread yield pressure, release falls between frames and positions are noisy; the truth may have one effect more.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from vinetrack.core.problems import Remark
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.diagnosis.diagnose import diagnose
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.power import SimulatedRates
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.diagnosis.score_test import testable
from vinetrack.dynamics.model import Model, host_for
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.effects import EffectError
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, Fit
from vinetrack.tracks.position_noise import ar1_noise


@dataclass(frozen=True)
class FilmingPlan:
    """How a trial is filmed: frames per second, noise of a position, m, and its lag-one correlation. A recording ends
    with the growth, at twice `longest_s` where the growth does not end, and at the latest `stops_s` after release.
    `slow_error_m` is the slow error that its tracker states, NaN for positions measured elsewhere; `has_trace` says
    whether its pressure is measured.
    """

    capture_fps: float
    noise_m: float
    noise_correlation: float = 0.0
    longest_s: float = 4.0
    stops_s: float = math.inf
    slow_error_m: float = math.nan
    has_trace: bool = False


def make(
    model: Model,
    trials: Sequence[Trial],
    cameras: Sequence[FilmingPlan],
    spreads: tuple[float, float],
    draw: np.random.Generator,
    host: Model | None = None,
) -> list[tuple[Trial, Track]]:
    """Simulate one campaign: its trials as the sheet states them, and their tracks."""
    rest_frames = 20  # Frames at rest before release (chosen)
    count = len(trials)
    pressure_factors = 1 + spreads[0] * draw.standard_normal(count)
    misread = {vine: draw.standard_normal() for vine in dict.fromkeys(trial.vine for trial in trials)}
    true_trials = [
        replace(
            trial,
            pressure_Pa=trial.pressure_Pa * float(factor),
            yield_pressure_Pa=max(trial.yield_pressure_Pa + trial.yield_pressure_sigma_Pa * misread[trial.vine], 0.0),
        )
        for trial, factor in zip(trials, pressure_factors, strict=True)
    ]
    theta = np.array([model.parameters_of(trial) for trial in trials])
    theta[:, model.parameter_names.index(DAMPING)] *= np.exp(spreads[1] * draw.standard_normal(count))
    release_s = (rest_frames - draw.uniform(size=count)) / [camera.capture_fps for camera in cameras]
    times = [np.arange(rest_frames + int(2 * c.longest_s * c.capture_fps)) / c.capture_fps for c in cameras]
    since_release = [time_s - first_s for time_s, first_s in zip(times, release_s.tolist(), strict=True)]
    moved = simulate_many(model, true_trials, since_release, parameters=theta, host=host)
    pairs = []
    for trial, whole_s, trajectory, camera in zip(trials, times, moved, cameras, strict=True):
        ends_s = trajectory.end_time_s if trajectory.status == "ended" else 2 * camera.longest_s
        time_s = whole_s[: rest_frames + int(min(ends_s, camera.stops_s) * camera.capture_fps)]
        noise_m = ar1_noise(time_s.size, camera.noise_m, camera.noise_correlation, draw)
        position_m = trajectory.observed_position_m[: time_s.size] + noise_m + draw.uniform(-0.05, 0.05)
        pressure_Pa = np.full(time_s.size, trial.pressure_Pa) if camera.has_trace else None
        track = plain_track(time_s, position_m, pressure_Pa=pressure_Pa)
        pairs.append((trial, replace(track, lead_position_systematic_m=np.full(time_s.size, camera.slow_error_m))))
    return pairs


@dataclass(frozen=True)
class CampaignDesign:
    """What a campaign is simulated from: the true model with its values, the trials and how each is filmed, and the
    between-trial standard deviations of pressure and B.
    """

    model: Model
    trials: tuple[Trial, ...]
    cameras: tuple[FilmingPlan, ...]
    spreads: tuple[float, float]
    candidates: Sequence[str] | None = None

    @property
    def to_fit(self) -> Model:
        """The model without the values that a fit estimates."""
        held = {f"{effect.name}.{p.name}" for effect in self.model for p in effect.parameters if p.held}
        return replace(self.model, values={key: value for key, value in self.model.values.items() if key in held})


def design_of_fit(fitted: Fit, candidates: Sequence[str] | None = None) -> CampaignDesign:
    """The design of a fitted campaign, with its model as the truth and its noise and scatter as estimated."""
    data, rho = fitted.predictor.data, float(fitted.state.rho)
    variance = fitted.state.variance / (1 - rho**2)
    cameras = [
        FilmingPlan(
            capture_fps=1 / known.frame_s,
            noise_m=math.sqrt(float(variance[i])),
            noise_correlation=rho,
            longest_s=float(known.time_s[-1] - known.time_s[0]),
            stops_s=float(known.time_s[-1]) - fitted.trials[i].release_s,
            slow_error_m=math.nan if known.slow_m is None else float(np.median(known.slow_m)),
            has_trace=known.trace is not None,
        )
        for i, known in enumerate(data)
    ]
    trials = [replace(known.trial, position_systematic_m=known.position_systematic_m) for known in data]
    pressure, damping = fitted.state.spread
    return CampaignDesign(fitted.model, tuple(trials), tuple(cameras), (float(pressure), float(damping)), candidates)


def fitted_tests(fitted: Fit, candidates: Sequence[str] | None = None) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a fit with all candidates, and the reasons by name of those that cannot act with this sheet."""
    tried = candidates_of(fitted.model, candidates, fitted.model.user_effects)
    effects, not_testable = testable(tried, fitted.predictor.data)
    return misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND), not_testable


def planned_tests(design: CampaignDesign) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a noise-free campaign, under the noise and scatter of its design: its scores are zero but for
    rounding, its information is what the campaign would have.
    """
    host = host_for(design.model, candidates_of(design.model, design.candidates, design.model.user_effects))
    # 1e-3: part of the stated noise that the noise-free campaign has (chosen)
    cameras = [replace(camera, noise_m=1e-3 * camera.noise_m, noise_correlation=0.0) for camera in design.cameras]
    exact = [replace(trial, yield_pressure_sigma_Pa=0.0) for trial in design.trials]
    # Noise-free replicates have the same track, which is simulated once. They are compared by their text, because from
    # Python 3.13 on records that hold a NaN are not equal to themselves.
    ungrouped: dict[str, Any] = dict.fromkeys(GROUPINGS, "")
    signatures = [
        repr((replace(trial, name="", order=0.0, **ungrouped), camera))
        for trial, camera in zip(exact, cameras, strict=True)
    ]
    different = dict(zip(signatures, zip(exact, cameras, strict=True), strict=True))
    trials, plans = zip(*different.values(), strict=True)
    made = make(design.model, trials, plans, (0.0, 0.0), np.random.default_rng(0), host)
    track_of = {signature: track for signature, (_, track) in zip(different, made, strict=True)}
    pairs = [(trial, track_of[signature]) for trial, signature in zip(design.trials, signatures, strict=True)]
    noise_m = math.sqrt(float(np.mean([camera.noise_m**2 for camera in design.cameras])))
    noise = (noise_m, design.cameras[0].noise_correlation)
    fitted = fit(design.to_fit, pairs, spreads=design.spreads, noise=noise, host=host, profile=False, thorough=False)
    return fitted_tests(fitted, design.candidates)


# ------------------------------------------------------------------------------
# Simulated campaigns of a design, diagnosed in full as measured ones are: a check on linear theory.


class SimulatedDiagnosis(NamedTuple):
    """What the diagnosis of one simulated campaign named, blank for nothing; whether the effect was among it or was
    added later; and the reason why there is no verdict.
    """

    named: str = ""
    found: bool = False
    failed: str = ""


def simulated_diagnosis(design: CampaignDesign, effect: str, values: Sequence[float], seed: int) -> SimulatedDiagnosis:
    """Simulate one campaign of a design, with an effect of these values unless it is blank, and diagnose it in full."""
    draw = np.random.default_rng([seed, 77])
    truth = design.model
    try:
        if effect:
            truth = truth + effect
            names = [name for name in truth.parameter_names if name.startswith(f"{effect}.")]
            truth = truth.with_values(dict(zip(names, values, strict=False)))
        host = host_for(design.to_fit, candidates_of(design.to_fit, design.candidates, design.model.user_effects))
        pairs = make(truth, design.trials, design.cameras, design.spreads, draw, host)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            diagnosis = diagnose(
                pairs, model=design.to_fit, candidates=design.candidates, ladder=False, advice=False,
                user_effects=design.model.user_effects,
            )  # fmt: skip
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError) as error:
        return SimulatedDiagnosis(failed=f"{type(error).__name__}: {error}")
    if diagnosis.verdict == ADEQUATE:
        return SimulatedDiagnosis()
    named = " or ".join(diagnosis.answer_set) or diagnosis.verdict
    return SimulatedDiagnosis(named, effect in (*diagnosis.answer_set, *diagnosis.effects))


def rates_of(effect: str, diagnoses: Sequence[SimulatedDiagnosis], value: float, promised: float) -> SimulatedRates:
    """Count the outcomes of campaigns with one effect, of this size; with none where it is blank."""
    named = Counter(diagnosis.named for diagnosis in diagnoses if diagnosis.named)
    failed = sum(bool(diagnosis.failed) for diagnosis in diagnoses)
    return SimulatedRates(
        effect=effect,
        value=value,
        promised=promised,
        alarms=named.total(),
        count=sum(diagnosis.found for diagnosis in diagnoses) if effect else named.total(),
        campaigns=len(diagnoses) - failed,
        named=tuple(named.most_common()),
        failed=failed,
    )
