"""A campaign as an experiment folder: sheet, tracks, settings. The truth is not in it."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from hidden.campaigns import Hidden
from vinetrack.core.records import Track, Trial

COLUMNS = (
    "trial",
    "track",
    "capture_fps",
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "pressure_kPa",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
    "bends",
)


def write_folder(campaign: Hidden, folder: Path) -> None:
    """Write `trials.csv`, `tracks/*.csv` and `experiment.yaml`."""
    (folder / "tracks").mkdir(parents=True, exist_ok=True)
    with (folder / "trials.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        writer.writerows(_row(trial) for trial, _ in campaign.pairs)
    for trial, track in campaign.pairs:
        _write_track(track, folder / "tracks" / f"{trial.name}.csv")
    (folder / "experiment.yaml").write_text("ambient_pressure_kPa: 101.325\n", encoding="utf-8")


def _cell(value: float, factor: float = 1.0) -> str:
    return f"{value * factor:.8g}" if math.isfinite(value) else ""


def _row(trial: Trial) -> tuple[str, ...]:
    bends = ";".join(":".join(_cell(m, 1e3) for m in (b.start_m, b.arc_m, b.radius_m)) for b in trial.bends)
    return (
        trial.name,
        f"tracks/{trial.name}.csv",
        _cell(trial.capture_fps),
        _cell(trial.diameter_m, 1e3),
        _cell(trial.thickness_m, 1e6),
        _cell(trial.length_m, 1e3),
        _cell(trial.pressure_Pa, 1e-3),
        _cell(trial.yield_pressure_Pa, 1e-3),
        _cell(trial.payload_kg, 1e3),
        _cell(math.degrees(trial.growth_angle_rad)),
        _cell(trial.chamber_m3, 1e3),
        _cell(trial.inlet_m, 1e3),
        bends,
    )


def _write_track(track: Track, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        traced = track.pressure_Pa is not None
        writer.writerow(("time_s", "position_m", *(("pressure_kPa",) if traced else ())))
        for i, (t, y) in enumerate(zip(track.time_s.tolist(), track.lead_position_m.tolist(), strict=True)):
            row = [f"{t:.9f}", f"{y:.8f}"]
            if track.pressure_Pa is not None:
                row.append(f"{track.pressure_Pa[i] / 1e3:.5f}")
            writer.writerow(row)
