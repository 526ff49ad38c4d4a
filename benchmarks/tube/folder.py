"""The recordings as an experiment folder: sheet, settings, and tracks with their pressure."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from tube.recordings import DIAMETER_M, THICKNESS_M, Recording

SETTINGS = """\
# Low-density polyethylene; the tail comes off a reel; the tube grows level along a bench.
tail_store: reel
film_density_kg_m3: 920
growth_angle_deg: 90
"""
YIELD_SIGMA_KPA = 1.0
"""The lowest pressure at which a tube was seen to grow bounds its yield pressure from above only."""

COLUMNS = (
    *("trial", "track", "diameter_mm", "thickness_um", "length_mm"),
    *("pressure_kPa", "yield_pressure_kPa", "yield_pressure_sigma_kPa"),
)


def write_folder(recordings: Sequence[Recording], folder: Path) -> Path:
    """Write the experiment.

    The tubes are specimens, not replicates: each has a length of its own, the most its reel let out, and so a B and a
    yield pressure of its own. The pressure is the supply's; what reached the tube is the trace in the track.
    """
    (folder / "tracks").mkdir(parents=True, exist_ok=True)
    lengths = {one.tube: max(other.travel_m for other in recordings if other.tube == one.tube) for one in recordings}
    lowest = {
        one.tube: min(other.lowest_growing_Pa for other in recordings if other.tube == one.tube) for one in recordings
    }
    with (folder / "trials.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for one in recordings:
            row = (
                *(f"{DIAMETER_M * 1e3:g}", f"{THICKNESS_M * 1e6:g}", f"{lengths[one.tube] * 1e3:.0f}"),
                *(f"{one.supply_Pa / 1e3:.1f}", f"{lowest[one.tube] / 1e3:.1f}", f"{YIELD_SIGMA_KPA:g}"),
            )
            writer.writerow((one.name, f"tracks/{one.name}.csv", *row))
    for one in recordings:
        _write_track(one, folder / "tracks" / f"{one.name}.csv")
    (folder / "experiment.yaml").write_text(SETTINGS, encoding="utf-8")
    return folder


def _write_track(one: Recording, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(("time_s", "position_m", "pressure_kPa"))
        for t, y, pressure in zip(one.time_s, one.lead_position_m, one.pressure_Pa, strict=True):
            writer.writerow((f"{t:.7f}", f"{y:.8f}", f"{pressure / 1e3:.6f}"))
