"""Simulated campaigns measured as tracks, with known ground truth.

Every trial has its own stream of random numbers, so that leaving one out does not change the others. A `GroundTruth` is
what is hidden from the analysis: physics, scatter, noise, faults.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.core.tables import write_csv, write_json, write_text
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.dynamics.audit import pressure_along
from vinetrack.dynamics.model import Model, Value, make_model
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.tracks.position_noise import ar1_noise


@dataclass(frozen=True)
class VirtualTrial:
    """One simulated trial and its measurement. `stated` is the trial as the sheet states it, `true` as it was, `model`
    the true model. `track` is what the analysis gets; its zeros are arbitrary. The rest is the truth at the track's
    rows, SI; `release_s` is on the track's clock.
    """

    stated: Trial
    true: Trial
    model: Model
    damping: float
    track: Track
    release_s: float
    origin_m: float
    true_lead_position_m: Floats
    true_lead_velocity_m_s: Floats
    true_pressure_Pa: Floats
    dropped: tuple[int, ...]
    repeated: tuple[int, ...]


def grow(trials: Sequence[Trial], truth: GroundTruth) -> list[VirtualTrial]:
    """Simulate and measure trials; the same seed gives the same numbers."""
    model = truth.model()
    draws = [_draw(truth.seed, 0, trial.name) for trial in trials]
    errors = _yield_errors(trials, truth)
    true, damping = [], []
    theta = np.array([model.parameters_of(trial) for trial in trials])
    column = model.parameter_names.index("eversion_damping.B") if "eversion_damping" in model else None
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        set_Pa = trial.pressure_Pa * (1 + truth.pressure_scatter * draw.standard_normal())
        factor = 1 + truth.damping_scatter * draw.standard_normal()
        true.append(replace(trial, pressure_Pa=set_Pa, yield_pressure_Pa=trial.yield_pressure_Pa + errors[trial.vine]))
        if column is not None:
            theta[i, column] *= factor
        damping.append(float(theta[i, column]) if column is not None else math.nan)
    times, release = zip(
        *(_frame_times(trial, truth, draw) for trial, draw in zip(trials, draws, strict=True)), strict=True
    )
    moved = simulate_many(model, true, [t - t0 for t, t0 in zip(times, release, strict=True)], parameters=theta)
    grown = []
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        trial_model = model.with_values(dict(zip(model.parameter_names, theta[i].tolist(), strict=True)))
        pressure_Pa = pressure_along(
            trial_model, true[i], times[i] - release[i], moved[i].lead_position_m, moved[i].lead_velocity_m_s
        )
        grown.append(
            _measure(trial, true[i], trial_model, damping[i], times[i], release[i], moved[i], pressure_Pa, truth, draw)
        )
    return grown


def _yield_errors(trials: Sequence[Trial], truth: GroundTruth) -> dict[str, float]:
    """True minus stated yield pressure of each vine, Pa."""
    vines = dict.fromkeys(trial.vine for trial in trials)
    return {vine: 1e3 * truth.yield_error_kPa * _draw(truth.seed, 1, vine).standard_normal() for vine in vines}


def _draw(seed: int, kind: int, name: str) -> np.random.Generator:
    """The random generator of one trial (kind 0) or vine (kind 1), by its name."""
    return np.random.default_rng([seed, kind, zlib.crc32(name.encode())])


def _frame_times(trial: Trial, truth: GroundTruth, draw: np.random.Generator) -> tuple[Floats, float]:
    """Times of all possible frames, and the time of release on the same clock, s."""
    step_s = 1 / trial.capture_fps
    resting = draw.integers(truth.release_frames[0], truth.release_frames[1], endpoint=True)
    release_s = (resting - 1 + draw.uniform()) * step_s
    return np.arange(truth.longest_frames, dtype=float) * step_s, float(release_s)


def _measure(
    trial: Trial,
    true: Trial,
    model: Model,
    damping: float,
    time_s: Floats,
    release_s: float,
    moved: Trajectory,
    pressure_Pa: Floats,
    truth: GroundTruth,
    draw: np.random.Generator,
) -> VirtualTrial:
    """Measure a trajectory: noise, an arbitrary origin, dropped and repeated frames, gauge readings."""
    stop = time_s.size
    if moved.status == "ended":
        stop = min(stop, int(np.searchsorted(time_s - release_s, moved.end_time_s)) + truth.frames_after_end)
    origin_m = draw.uniform(*truth.origin_m)
    noise = ar1_noise(stop, truth.noise_m, truth.noise_correlation, draw)
    shown, index, dropped, repeated = _faults(moved.lead_velocity_m_s[:stop], truth, draw)
    measured = (origin_m + moved.observed_position_m[:stop] + noise)[shown]
    gauge = None
    if truth.trace_sigma_kPa is not None:
        gauge = pressure_Pa[shown] + 1e3 * truth.trace_sigma_kPa * draw.standard_normal(shown.size)
    sigma_m = np.full(shown.size, truth.noise_m) if truth.stated_sigma else None
    track = plain_track(time_s[index], measured, sigma_m=sigma_m, pressure_Pa=gauge)
    return VirtualTrial(
        stated=trial,
        true=true,
        model=model,
        damping=damping,
        track=track,
        release_s=release_s,
        origin_m=origin_m,
        true_lead_position_m=moved.lead_position_m[shown],
        true_lead_velocity_m_s=moved.lead_velocity_m_s[shown],
        true_pressure_Pa=pressure_Pa[shown],
        dropped=dropped,
        repeated=repeated,
    )


def _faults(
    velocity_m_s: Floats, truth: GroundTruth, draw: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...], tuple[int, ...]]:
    """True frame that each row shows, and the frame number it claims; then dropped frames and repeated rows. A dropped
    frame is missing without notice, so all later rows claim a time one frame too early. A repeated frame shows its
    predecessor instead of itself.
    """
    moving = velocity_m_s > 0
    dropped = moving & (draw.uniform(size=velocity_m_s.size) < truth.dropped)
    shown = np.flatnonzero(~dropped)
    stale = moving[shown] & (draw.uniform(size=shown.size) < truth.repeated)
    stale[0] = False
    # Consecutive repeated rows all show the last new frame.
    shown = shown[np.maximum.accumulate(np.where(stale, 0, np.arange(shown.size)))]
    rows = np.flatnonzero(stale)
    return shown, np.arange(shown.size), tuple(np.flatnonzero(dropped).tolist()), tuple(rows.tolist())


def write_tracks(grown: Sequence[VirtualTrial], folder: Path) -> None:
    """Write the track of each trial to `folder/<trial>.csv`."""
    for trial in grown:
        columns = {"time_s": trial.track.time_s.round(9), "position_m": trial.track.lead_position_m.round(8)}
        if np.isfinite(trial.track.lead_position_sigma_m).any():
            columns["sigma_m"] = trial.track.lead_position_sigma_m
        if trial.track.pressure_Pa is not None:
            columns["pressure_kPa"] = (trial.track.pressure_Pa / 1e3).round(5)
        write_csv(folder / f"{trial.stated.name}.csv", pd.DataFrame(columns))


SHEET_COLUMNS = (
    "trial",
    "track",
    "capture_fps",
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "pressure_kPa",
    "yield_pressure_kPa",
    "payload_g",
)


def sheet(trials: Sequence[Trial]) -> pd.DataFrame:
    """Return the trial sheet of a campaign whose tracks lie in `tracks/`."""
    rows = [
        (
            trial.name,
            f"tracks/{trial.name}.csv",
            trial.capture_fps,
            round(trial.diameter_m * 1e3, 6),
            round(trial.thickness_m * 1e6, 6),
            round(trial.length_m * 1e3, 6),
            round(trial.pressure_Pa / 1e3, 6),
            round(trial.yield_pressure_Pa / 1e3, 6),
            round(trial.payload_kg * 1e3, 6),
        )
        for trial in trials
    ]
    return pd.DataFrame(rows, columns=list(SHEET_COLUMNS))


def write_experiment(grown: Sequence[VirtualTrial], folder: Path, settings: str = "") -> None:
    """Write an experiment folder: sheet, tracks and, where given, the text of `experiment.yaml`; no truth."""
    write_tracks(grown, folder / "tracks")
    write_csv(folder / "trials.csv", sheet([trial.stated for trial in grown]))
    if settings:
        write_text(folder / "experiment.yaml", settings)


def write_truth(grown: Sequence[VirtualTrial], truth: GroundTruth, path: Path) -> None:
    """Write the ground truth to a JSON file."""
    for parent in path.absolute().parents:
        if (parent / "trials.csv").exists():
            raise ValueError(f"{path}: the truth must not lie inside the experiment {parent}")
    trials = {
        trial.stated.name: {
            "pressure_Pa": trial.true.pressure_Pa,
            "yield_pressure_Pa": trial.true.yield_pressure_Pa,
            "B": trial.damping,
            "release_s": trial.release_s,
            "origin_m": trial.origin_m,
            "dropped": trial.dropped,
            "repeated": trial.repeated,
            "true_lead_position_m": trial.true_lead_position_m.tolist(),
        }
        for trial in grown
    }
    write_json(path, {"nature": asdict(truth), "trials": trials})


BASE = BASE_EFFECTS


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth of a simulated campaign. `effects` and `values` are the physics. Scatter is a relative between-trial
    standard deviation of B or P; `yield_error_kPa` is the standard deviation of the error of the stated yield
    pressures.
    """

    effects: tuple[str, ...] = BASE
    values: Mapping[str, Value] = field(default_factory=dict)
    damping_scatter: float = 0.03
    pressure_scatter: float = 0.01
    yield_error_kPa: float = 0.0
    noise_m: float = 1e-4
    noise_correlation: float = 0.0
    release_frames: tuple[int, int] = (15, 40)
    frames_after_end: int = 4
    longest_frames: int = 12_000
    origin_m: tuple[float, float] = (-0.05, 0.05)
    dropped: float = 0.0
    repeated: float = 0.0
    trace_sigma_kPa: float | None = None
    stated_sigma: bool = False
    seed: int = 0

    def model(self) -> Model:
        """The true model with its true values."""
        return make_model(self.effects).with_values(self.values)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a ground truth from YAML, whose keys are the fields of `GroundTruth` and `filming`, which is
    ignored here.
    """
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    content.pop("filming", None)
    for key in ("effects", "release_frames", "origin_m"):
        if key in content:
            content[key] = tuple(content[key])
    return GroundTruth(**content)
