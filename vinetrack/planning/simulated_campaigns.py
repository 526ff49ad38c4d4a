"""Simulated campaigns of planned trials, with scatter, noise and misread yield pressures.

Every trial has its own pressure and B, every vine a misread yield pressure, release falls between frames and positions
are noisy. The true model may have an effect that the fitted one lacks: that is how the power of a campaign is checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.inference.parameters import DAMPING
from vinetrack.planning.predictive_inputs import PredictiveInputs
from vinetrack.tracks.position_noise import ar1_noise

REST_FRAMES = 20  # Frames at rest before release (chosen)

FEWEST_GROWTH_FRAMES = 12  # Frames of growth below which a trial is not worth filming (chosen)


@dataclass(frozen=True)
class FilmingPlan:
    """How a campaign is filmed: frames per second, noise of a position, m, and its lag-one correlation. A recording
    ends with the growth, at twice `longest_s` where the growth does not end, and at the latest `stops_s` after release.
    """

    capture_fps: float
    noise_m: float
    noise_correlation: float = 0.0
    longest_s: float = 4.0
    stops_s: float = math.inf


def joint_model(vine_inputs: Sequence[PredictiveInputs]) -> Model:
    """Return one model with the median B of each vine and everything else shared."""
    B = {inputs.trial.vine: inputs.medians[DAMPING] for inputs in vine_inputs}
    return vine_inputs[0].model.with_values({DAMPING: B})


def make(
    model: Model,
    trials: Sequence[Trial],
    cameras: Sequence[FilmingPlan],
    spreads: tuple[float, float],
    draw: np.random.Generator,
    host: Model | None = None,
) -> list[tuple[Trial, Track]]:
    """Simulate one campaign: its trials as the sheet states them, and their tracks. The camera counts as calibrated:
    positions have no systematic error unless the sheet states one.
    """
    trials = [
        trial if math.isfinite(trial.position_systematic_m) else replace(trial, position_systematic_m=0.0)
        for trial in trials
    ]
    count = len(trials)
    frames_s = np.array([1 / camera.capture_fps for camera in cameras])
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
    longest_s = [2 * camera.longest_s for camera in cameras]
    ends = simulate_many(model, true_trials, [np.array([0.0, s]) for s in longest_s], parameters=theta, host=host)
    stop_s = [
        min(end.end_time_s if end.status == "ended" else longest, camera.stops_s)
        for end, longest, camera in zip(ends, longest_s, cameras, strict=True)
    ]
    release = (REST_FRAMES - draw.uniform(size=count)) * frames_s
    counts = [REST_FRAMES + int(end * camera.capture_fps) for end, camera in zip(stop_s, cameras, strict=True)]
    times: list[Floats] = [
        np.arange(frames, dtype=float) * frame_s for frames, frame_s in zip(counts, frames_s, strict=True)
    ]
    since_release = [time_s - begin for time_s, begin in zip(times, release.tolist(), strict=True)]
    moved = simulate_many(model, true_trials, since_release, parameters=theta, host=host)
    tracks = []
    for time_s, trajectory, camera in zip(times, moved, cameras, strict=True):
        noise_m = ar1_noise(time_s.size, camera.noise_m, camera.noise_correlation, draw)
        origin_m = draw.uniform(-0.05, 0.05)
        tracks.append(plain_track(time_s, trajectory.observed_position_m + noise_m + origin_m))
    return list(zip(trials, tracks, strict=True))
