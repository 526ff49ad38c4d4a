"""Simulated campaigns measured as tracks, with known ground truth.

Every trial has its own stream of random numbers, so that leaving one out does not change the others. A `GroundTruth` is
what is hidden from the analysis: physics, scatter, noise, faults.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.core.tables import write_csv, write_text
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model, Value, make_model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.sheet import REQUIRED_COLUMNS, SHEET
from vinetrack.inference.fit_result import DAMPING, EXPONENT
from vinetrack.paper import published
from vinetrack.tracks.position_noise import ar1_noise


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth of a simulated campaign. `effects` and `values` are the physics. Scatter is a relative between-trial
    standard deviation of B or P; `yield_error_kPa` is the standard deviation of the error of the stated yield
    pressures.
    """

    effects: Sequence[str] = BASE_EFFECTS
    values: Mapping[str, Value] = field(default_factory=dict)
    damping_scatter: float = 0.03
    pressure_scatter: float = 0.01
    yield_error_kPa: float = 0.0
    noise_m: float = 1e-4
    noise_correlation: float = 0.0
    release_frames: Sequence[int] = (15, 40)
    frames_after_end: int = 4
    longest_frames: int = 12_000
    trace_sigma_kPa: float | None = None
    seed: int = 0

    def model(self) -> Model:
        """The true model with its true values."""
        return make_model(self.effects).with_values(self.values)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a ground truth from YAML, whose keys are the fields of `GroundTruth` and `filming`, which is ignored."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return GroundTruth(**{key: content[key] for key in content if key != "filming"})


@dataclass(frozen=True)
class VirtualTrial:
    """One simulated trial and its measurement. `stated` is the trial as the sheet states it, `true` as it was, `model`
    the true model with this trial's B. `track` is what the analysis gets; its zeros are arbitrary. The rest is the
    truth, SI; `release_s` is on the track's clock.
    """

    stated: Trial
    true: Trial
    model: Model
    track: Track
    release_s: float
    origin_m: float
    true_lead_position_m: Floats


def grow(trials: Sequence[Trial], truth: GroundTruth) -> list[VirtualTrial]:
    """Simulate and measure trials; the same seed gives the same numbers."""
    model = truth.model()
    draws = [_draw(truth.seed, 0, trial.name) for trial in trials]
    vines = dict.fromkeys(trial.vine for trial in trials)
    errors = {vine: 1e3 * truth.yield_error_kPa * _draw(truth.seed, 1, vine).standard_normal() for vine in vines}
    true, times, release = [], [], []
    theta = np.array([model.parameters_of(trial) for trial in trials])
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        set_Pa = trial.pressure_Pa * (1 + truth.pressure_scatter * draw.standard_normal())
        factor = 1 + truth.damping_scatter * draw.standard_normal()
        true.append(replace(trial, pressure_Pa=set_Pa, yield_pressure_Pa=trial.yield_pressure_Pa + errors[trial.vine]))
        if DAMPING in model.parameter_names:
            theta[i, model.parameter_names.index(DAMPING)] *= factor
        step_s = 1 / trial.capture_fps
        resting = draw.integers(truth.release_frames[0], truth.release_frames[1], endpoint=True)
        release.append(float((resting - 1 + draw.uniform()) * step_s))
        times.append(np.arange(truth.longest_frames, dtype=float) * step_s)
    moved = simulate_many(model, true, [t - t0 for t, t0 in zip(times, release, strict=True)], parameters=theta)
    grown = []
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        stop = times[i].size
        if moved[i].status == "ended":
            stop = min(stop, int(np.searchsorted(times[i] - release[i], moved[i].end_time_s)) + truth.frames_after_end)
        own_model = model.with_values(dict(zip(model.parameter_names, theta[i].tolist(), strict=True)))
        origin_m = draw.uniform(-0.05, 0.05)  # a track's zero of position is arbitrary
        noise_m = ar1_noise(stop, truth.noise_m, truth.noise_correlation, draw)
        time_s, lead_m = times[i][:stop], moved[i].lead_position_m[:stop]
        gauge_Pa = None
        if truth.trace_sigma_kPa is not None:
            velocity_m_s = moved[i].lead_velocity_m_s[:stop]
            gauge_Pa = evaluate(own_model, true[i], time_s - release[i], lead_m, velocity_m_s).pressure_Pa
            gauge_Pa = gauge_Pa + 1e3 * truth.trace_sigma_kPa * draw.standard_normal(stop)
        seen_m = origin_m + moved[i].observed_position_m[:stop] + noise_m
        track = plain_track(time_s, seen_m, pressure_Pa=gauge_Pa)
        grown.append(VirtualTrial(trial, true[i], own_model, track, release[i], origin_m, lead_m))
    return grown


def _draw(seed: int, kind: int, name: str) -> np.random.Generator:
    """The random generator of one trial (kind 0) or vine (kind 1), by its name."""
    return np.random.default_rng([seed, kind, zlib.crc32(name.encode())])


def write_tracks(grown: Sequence[VirtualTrial], folder: Path) -> None:
    """Write the track of each trial to `folder/<trial>.csv`."""
    for trial in grown:
        columns = {"time_s": trial.track.time_s.round(9), "position_m": trial.track.lead_position_m.round(8)}
        if trial.track.pressure_Pa is not None:
            columns["pressure_kPa"] = (trial.track.pressure_Pa / 1e3).round(5)
        write_csv(folder / f"{trial.stated.name}.csv", pd.DataFrame(columns))


def write_experiment(grown: Sequence[VirtualTrial], folder: Path, settings: str = "") -> None:
    """Write an experiment folder: sheet, tracks and, where given, the text of `experiment.yaml`; no truth."""
    write_tracks(grown, folder / "tracks")
    columns = ("capture_fps", *REQUIRED_COLUMNS, "payload_g")
    sheet = [
        {"trial": one.stated.name, "track": f"tracks/{one.stated.name}.csv"}
        | {name: round(COLUMNS[name].of_trial(one.stated), 6) for name in columns}
        for one in grown
    ]
    write_csv(folder / SHEET, pd.DataFrame(sheet))
    if settings:
        write_text(folder / "experiment.yaml", settings)


# ------------------------------------------------------------------------------
# Campaigns: vines, pressures, payloads and number of replicates. The published ones are in `data/paper`.


@dataclass(frozen=True)
class Vine:
    """A vine of a campaign, in the units of a trial sheet."""

    diameter_mm: float
    thickness_um: float
    length_mm: float
    yield_pressure_kPa: float = 3.0

    def trial(
        self, name: str, pressure_kPa: float, payload_g: float = 0.0, capture_fps: float = published.CAPTURE_FPS
    ) -> Trial:
        """Make one trial with this vine."""
        return Trial(
            name=name, capture_fps=capture_fps, payload_kg=payload_g / 1e3,
            diameter_m=self.diameter_mm / 1e3, thickness_m=self.thickness_um / 1e6, length_m=self.length_mm / 1e3,
            pressure_Pa=pressure_kPa * 1e3, pressure_sigma_Pa=10.0 * pressure_kPa,
            yield_pressure_Pa=self.yield_pressure_kPa * 1e3, yield_pressure_sigma_Pa=200.0,
        )  # fmt: skip


def isometric_vine(scale: int) -> Vine:
    """The paper's vine of scale R = 1…4: 50R µm, 6R mm and, isometric with the 280 mm of R = 4, 70R mm."""
    return Vine(6.0 * scale, 50.0 * scale, 70.0 * scale)


def campaign(
    vine: Vine, pressures_kPa: Iterable[float], replicates: int, payload_g: float = 0.0, prefix: str = ""
) -> list[Trial]:
    """Make trials of every pressure, `replicates` times, with one vine and payload."""
    return [
        vine.trial(f"{prefix}{pressure_kPa:g}kPa_{k + 1}".replace(".", "p"), pressure_kPa, payload_g)
        for pressure_kPa in pressures_kPa
        for k in range(replicates)
    ]


def damping_values(trials: Iterable[Trial]) -> dict[str, dict[str, float] | float]:
    """Parameters of isometric vines as `GroundTruth.values` takes them: the printed B by vine, N·(s/m)ⁿ, and n."""
    by_vine = {trial.vine: published.DAMPING_B[round(trial.diameter_m / 6e-3)] for trial in trials}
    return {DAMPING: by_vine, EXPONENT: published.EXPONENT}
