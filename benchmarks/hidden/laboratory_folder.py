"""A laboratory's campaign on disk: the experiment folder, and the truth beside it."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

from hidden.shots import Campaign, Recording


def write_experiment(campaign: Campaign, folder: Path) -> None:
    """Write `trials.csv`, `tracks/*.csv` and `experiment.yaml`."""
    (folder / "tracks").mkdir(parents=True, exist_ok=True)
    columns = list(campaign.recordings[0].cells)
    with (folder / "trials.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows([_cell(one.cells[name]) for name in columns] for one in campaign.recordings)
    for one in campaign.recordings:
        _write_track(one, folder / str(one.cells["track"]))
    # JSON is YAML.
    lines = [f"{key}: {json.dumps(value)}\n" for key, value in campaign.settings.items()]
    (folder / "experiment.yaml").write_text("".join(lines), encoding="utf-8")


def write_truth(campaign: Campaign, path: Path) -> None:
    """Write what the folder does not tell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(campaign.truth, indent=1) + "\n", encoding="utf-8")


def _cell(value: str | float) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.8g}" if math.isfinite(value) else ""


def _write_track(one: Recording, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        header = ["time_s", "position_m"]
        columns = [[f"{t:.9f}" for t in one.time_s], [f"{y:.8f}" for y in one.position_m]]
        if one.pressure_kPa is not None:
            header.append("pressure_kPa")
            columns.append([f"{P:.5f}" for P in one.pressure_kPa])
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))
