"""Whether the stated errors of n, B, γ and P_y are right when they come from films: the demonstration, filmed anew.

    python benchmarks/film_coverage.py [--first SEED] [--count 10] [--rows FILE]

Every campaign has the sheet of the shipped demonstration, but other scatter, other pictures, and a camera of its own
(scale, tilt, distortion, exposure). Its films are measured as the workflow measures them, and fitted by the true model.
z is the error of a number over its stated one: their mean is 0 and their root mean square 1 where stated errors are
right. B is that of the vine in the ground truth, so that its scatter from trial to trial counts.

So that the cause of an error can be told, three further sets of positions are fitted: the true ones with white noise
(`true`), those that the calibration makes of the true places in the picture, with the same noise (`lens`), and the true
ones with the errors of the edge (`edge`). No constant was tuned on seeds from 600 up.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from demonstration import SHIPPED
from rich.progress import track

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.core.tables import write_text
from vinetrack.dynamics.model import make_model
from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.__main__ import DEMO
from vinetrack.laboratory.campaigns import film, grow, make_filming, picture_target, read_ground_truth
from vinetrack.video.survey import measure_recording

NOISE_M = 1.2e-5  # Noise of positions that are not tracked, about that of the demonstration's
YIELD_PRESSURE_PA = 3e3  # As the sheet has it
Row = dict[str, Any]


def camera_of(seed: int) -> dict[str, Any]:
    """How a campaign is filmed: that of the demonstration with another camera."""
    rng = np.random.default_rng([seed, 99])
    content: dict[str, Any] = yaml.safe_load(DEMO.read_text(encoding="utf-8"))["filming"]
    content["camera"] |= {
        "k1": float(rng.uniform(-0.12, 0.03)),
        "tilt_y_deg": float(rng.uniform(-2, 2)),
        "m_per_px": float(rng.uniform(2.25e-4, 2.6e-4)),
    }
    return content | {"exposure_fraction": float(rng.choice([0.05, 0.1, 0.2]))}


def campaign(seed: int, folder: Path) -> dict[str, list[tuple[Trial, Track]]]:
    """Grow, film and measure the trials of one campaign; trials and tracks by where their positions come from."""
    content, truth = camera_of(seed), replace(read_ground_truth(DEMO), seed=seed)
    exposure_us = 1e6 * content["exposure_fraction"] / 1069
    settings = (SHIPPED / "experiment.yaml").read_text(encoding="utf-8")
    write_text(folder / "experiment.yaml", settings.replace("exposure_us: 93.5", f"exposure_us: {exposure_us:.1f}"))
    write_text(folder / "trials.csv", (SHIPPED / "trials.csv").read_text(encoding="utf-8"))
    experiment, filming = read_experiment(folder, strict=True), make_filming(content)
    picture_target(filming, folder / experiment.settings.calibration.image, seed)
    (folder / "videos").mkdir()
    rng, pairs = np.random.default_rng([seed, 98]), dict[str, list[tuple[Trial, Track]]]()
    for number, grown in enumerate(grow(experiment.trials, truth)):
        seen = film(grown, filming, grown.stated.video, 100 * seed + number)
        measured = measure_recording(grown.stated, experiment.settings, folder)
        grown.stated.video.unlink()
        tracked, true_m = measured.tracking.track, seen.lead_position_m
        assert measured.calibration is not None
        places_px = np.column_stack([seen.tip_x_px, seen.tip_y_px])
        lens_m = measured.calibration.along(measured.tracking.axis).position_m(places_px)
        noise_m, edge_m = rng.normal(0, NOISE_M, true_m.size), tracked.lead_position_m - lens_m
        positions = {"films": tracked.lead_position_m, "true": true_m + noise_m, "lens": lens_m + noise_m}
        for name, position_m in (positions | {"edge": true_m + edge_m}).items():
            known_m = np.where(np.isfinite(position_m), position_m, tracked.lead_position_m)
            pairs.setdefault(name, []).append((grown.stated, replace(tracked, lead_position_m=known_m)))
    return pairs


def measure(seed: int) -> Iterator[Row]:
    """The rows of one campaign: errors over stated ones, and stated errors, of every number."""
    truth = read_ground_truth(DEMO)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, pairs in campaign(seed, Path(folder)).items():
            row: Row = {"seed": seed, "positions": name}
            for number in vt.fit(make_model(truth.effects), pairs).numbers:
                true = truth.values.get(number.key, YIELD_PRESSURE_PA)
                true = true[number.vine] if isinstance(true, dict) else true
                key = f"{number.symbol} {number.vine[:4]}".strip()
                row |= {f"z {key}": (number.value - true) / number.sigma, f"sigma {key}": number.sigma}
            yield row


def show(rows: list[Row]) -> None:
    """Print mean and root mean square of z, and the mean stated error, by where positions come from."""
    for name in dict.fromkeys(row["positions"] for row in rows):
        chosen = [row for row in rows if row["positions"] == name]
        keys = [key[2:] for key in chosen[0] if key[:2] == "z "]
        told = []
        for key in keys:
            z = np.array([row[f"z {key}"] for row in chosen])
            sigma = float(np.mean([row[f"sigma {key}"] for row in chosen]))
            told.append(f"{key} {z.mean():+.2f}, {np.sqrt(np.mean(z**2)):.2f} (± {sigma:.3g})")
        every = np.array([[row[f"z {key}"] for key in keys] for row in chosen])
        inside = f"{np.sum(np.abs(every) < 1.96)} of {every.size} within 1.96"
        print(f"{name:6s} {len(chosen)} campaigns, all {np.sqrt(np.mean(every**2)):.2f}, {inside}: " + "; ".join(told))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=600, help="first seed")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--rows", type=Path, help="keep every answer as it comes; what is there is not asked again")
    chosen = parser.parse_args()
    known = chosen.rows.read_text(encoding="utf-8").splitlines() if chosen.rows and chosen.rows.exists() else []
    rows: list[Row] = list(map(json.loads, known))
    asked = set(range(chosen.first, chosen.first + chosen.count)) - {row["seed"] for row in rows}
    for seed in track(sorted(asked), "filming"):
        new = list(measure(seed))
        rows += new
        if chosen.rows:
            with chosen.rows.open("a", encoding="utf-8") as file:
                file.writelines(f"{json.dumps(row)}\n" for row in new)
    show(rows)


if __name__ == "__main__":
    main()
