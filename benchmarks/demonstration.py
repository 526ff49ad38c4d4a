"""Tracking of the shipped demonstration against the virtual laboratory's truth, a row a recording.

    python benchmarks/demonstration.py [--keep DIR] [--processes N]

The demonstration is grown and filmed anew, as on first use, into a scratch folder, and measured as the workflow
measures it: axis found from the motion, scale from the calibration picture. No constant was tuned on it.

SD, robust SD (1.4826 × median absolute deviation) and bias: of tracked minus true position along the tracked axis, px
of the picture, over frames in which the edge truly moves (an origin is free in every analysis, so a bias costs
nothing). Pull: SD of the error over each point's stated error, 1 where stated errors are right. Lost: moving frames
without a usable position. Scale: error of the length from the first to the last moving frame's true place by the
calibration, against the stated relative error of the scale. Lens: the range of the error of these true places by the
calibration. Places: SD of tracked minus true places, of edge and lens together. Both are in µm.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from vinetrack.core.tables import write_text
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.laboratory.__main__ import DEMO
from vinetrack.laboratory.campaigns import (
    Filming,
    VirtualTrial,
    film,
    grow,
    make_filming,
    picture_target,
    read_ground_truth,
)
from vinetrack.laboratory.render import Truth
from vinetrack.video.survey import Measurement, measure_recording

SHIPPED = Path(__file__).parents[1] / "data" / "demo"


@dataclass(frozen=True)
class Row:
    """One recording's numbers: px, and relative errors of the scale."""

    name: str
    n_moving: int
    lost: int
    sd_px: float
    robust_px: float
    bias_px: float
    stated_px: float
    pull: float
    scale_error: float
    scale_sigma: float
    lens_um: float
    places_um: float


def film_demonstration(folder: Path, processes: int) -> tuple[Experiment, dict[str, Truth]]:
    """Sheet and settings copied, target pictured, trials grown and filmed; what was filmed of each."""
    for name in ("trials.csv", "experiment.yaml"):
        write_text(folder / name, (SHIPPED / name).read_text(encoding="utf-8"))
    experiment = read_experiment(folder, strict=True)
    nature = read_ground_truth(DEMO)
    filming = make_filming(yaml.safe_load(DEMO.read_text(encoding="utf-8"))["filming"])
    picture_target(filming, folder / experiment.settings.calibration.image, nature.seed)
    grown = grow(experiment.trials, nature)
    (folder / "videos").mkdir(exist_ok=True)
    one = partial(_film, filming=filming)
    seeds = [nature.seed + number for number in range(len(grown))]
    with ProcessPoolExecutor(processes) as pool:
        return experiment, {
            trial.stated.name: truth for trial, truth in zip(grown, pool.map(one, grown, seeds), strict=True)
        }


def _film(trial: VirtualTrial, seed: int, filming: Filming) -> Truth:
    return film(trial, filming, trial.stated.video, seed)


def compare(name: str, measured: Measurement, truth: Truth) -> Row:
    """Numbers of one measured recording against what was filmed."""
    track, axis = measured.tracking.track, measured.tracking.axis
    tips = np.column_stack([truth.tip_x_px, truth.tip_y_px])
    true_px = (tips - np.asarray(axis.from_px)) @ axis.direction
    moving = (np.diff(true_px, append=true_px[-1]) > 0.05) & truth.in_frame & np.isfinite(true_px)
    used = moving & track.usable
    error_px = track.edge_px[used] - true_px[used]
    stated_px = np.hypot(track.lead_position_sigma_m, track.lead_position_systematic_m)[used] / measured.m_per_px
    off = error_px - np.median(error_px)
    assert measured.calibration is not None
    seen_m = measured.calibration.along(axis).position_m(tips[moving])
    true_m = truth.lead_position_m[moving]
    return Row(
        name,
        int(moving.sum()),
        int((moving & ~track.usable).sum()),
        float(error_px.std()),
        float(1.4826 * np.median(np.abs(off))),
        float(error_px.mean()),
        float(np.sqrt(np.mean(stated_px**2))),
        float(np.std(off / stated_px)),
        float((seen_m[-1] - seen_m[0]) / (true_m[-1] - true_m[0]) - 1),
        measured.scale_rel_sigma,
        float(1e6 * np.ptp(seen_m - true_m)),
        float(1e6 * np.std((track.lead_position_m - truth.lead_position_m)[used])),
    )


def measure_all(experiment: Experiment, truths: dict[str, Truth]) -> Iterator[Row]:
    """One recording after another."""
    for trial in experiment.trials:
        measured = measure_recording(trial, experiment.settings, experiment.folder)
        yield compare(trial.name, measured, truths[trial.name])


def show(rows: Iterator[Row]) -> None:
    """Print the table as it comes, then the medians."""
    heads = ("moving", "lost", "SD", "robust", "bias", "stated", "pull", "scale err", "stated", "lens", "places")
    print(f"{'recording':18s}" + "".join(f"{head:>10s}" for head in heads))
    done = []
    for row in rows:
        done.append(row)
        px = f"{row.sd_px:10.3f}{row.robust_px:10.3f}{row.bias_px:+10.3f}{row.stated_px:10.3f}{row.pull:10.2f}"
        scale = f"{100 * row.scale_error:+9.4f}%{100 * row.scale_sigma:9.4f}%"
        scale += f"{row.lens_um:10.1f}{row.places_um:10.1f}"
        print(f"{row.name:18s}{row.n_moving:10d}{row.lost:10d}{px}{scale}", flush=True)

    def median(name: str) -> float:
        return float(np.median([getattr(row, name) for row in done]))

    print(f"median error of the lens {median('lens_um'):.1f} µm, of places {median('places_um'):.1f} µm")
    lost, moving = sum(row.lost for row in done), sum(row.n_moving for row in done)
    fair = sum(1 / 1.5 <= row.sd_px / row.stated_px <= 1.5 for row in done)
    print(f"\nmedian SD {median('sd_px'):.3f} px, robust {median('robust_px'):.3f} px, pull {median('pull'):.2f}")
    print(f"worst SD {max(row.sd_px for row in done):.3f} px; {lost} of {moving} moving frames lost")
    print(f"stated errors within a factor 1.5 of SD: {fair} of {len(done)} recordings")
    within = sum(abs(row.scale_error) <= 2 * row.scale_sigma for row in done)
    print(f"scale within twice its stated error: {within} of {len(done)} recordings")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, help="folder for the filmed demonstration")
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        experiment, truths = film_demonstration(chosen.keep or Path(scratch), chosen.processes)
        show(measure_all(experiment, truths))


if __name__ == "__main__":
    main()
