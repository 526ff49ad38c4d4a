"""One campaign a verdict, from recordings: grown by another simulator, rendered, tracked, diagnosed.

    python benchmarks/filmed_verdicts.py [--campaigns KIND@SEED,...] [--cores 2] [--keep DIR]

The campaigns are those of `benchmarks/hidden/` (see `hidden_effects.py`), which shares no code with the package's
model; the virtual laboratory films them with distortion, blur, photon noise and compression, beside a calibration
board. What is analysed is a folder of recordings and a sheet, as anybody's.

SD: of tracked minus true position, px, after the mean is taken out, the median of the trials with sure frames. An
offset of all frames is no error, any analysis has an origin of its own.

Seeds 950–974 are kept for this and were chosen by the length of their recordings, the shortest first.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from hidden import make
from hidden.campaigns import Hidden
from hidden.filmed import film_campaign, filming_of

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.experiment.settings import ExperimentSettings
from vinetrack.video.axis import askew_trials, slope_deg
from vinetrack.video.frames import RecordingError
from vinetrack.video.survey import measure_recording
from vinetrack.video.track import Tracking

ONE_EACH = (
    "null:anything@953",
    "null:anything@966",
    "reservoir_depletion@973",
    "tail_friction@950",
    "air_drag@956",
    "inlet_loss@962",
    "perspective@959",
    "length_scale@962",
    "outsider:rough_patch@962",
)


def ask(kind: str, seed: int, folder: Path, cores: int) -> None:
    """Film, track, diagnose and print one row."""
    campaign = make(kind, seed, filmed=True)
    begun = time.perf_counter()
    experiment = film_campaign(campaign, folder, cores)
    filmed_s = time.perf_counter() - begun
    begun = time.perf_counter()
    track = partial(measured, settings=experiment.settings, folder=experiment.folder)
    with ProcessPoolExecutor(cores) as pool:
        seen = list(zip(experiment.trials, pool.map(track, experiment.trials), strict=True))
        trackings = {trial.name: tracking for trial, tracking in seen if tracking is not None}
    axes = {name: tracking.axis for name, tracking in trackings.items()}
    slopes_deg = {name: slope_deg(axis.from_px, axis.to_px, bends=axis.bends) for name, axis in axes.items()}
    askew = {name for names, _ in askew_trials(slopes_deg, experiment.trials) for name in names}
    for name in sorted(askew):
        print(f"    left out: the growth axis of {name} is askew to the others'")
    tracks = {name: tracking.track for name, tracking in trackings.items() if name not in askew}
    tracked_s = time.perf_counter() - begun
    begun = time.perf_counter()
    said = vt.diagnose(experiment, tracks=tracks, ladder=False, advice=False)
    hidden = "+".join(campaign.truth.effects) or campaign.truth.outsider or "nothing"
    print(
        f"{hidden:20s} {seed} {len(tracks):3d} trials  {said.verdict:12s}{', '.join(said.answer_set) or '-':36s}"
        f"then {said.final_verdict:12s} SD {tracked_sd_px(campaign, tracks):.3f} px; seconds: filmed {filmed_s:.0f}, "
        f"tracked {tracked_s:.0f}, diagnosed {time.perf_counter() - begun:.0f}",
        flush=True,
    )
    print("    " + said.explanation[:500], flush=True)


def measured(trial: Trial, settings: ExperimentSettings, folder: Path) -> Tracking | None:
    """What is tracked of one recording; None where it is refused, as the workflow leaves out such a trial alone."""
    try:
        return measure_recording(trial, settings, folder).tracking
    except RecordingError as error:
        print(f"    left out: {error}")
        return None


def tracked_sd_px(campaign: Hidden, tracks: dict[str, Track]) -> float:
    """Median over the trials of the SD of tracked minus true position, where no frame is doubtful."""
    m_per_px = filming_of(campaign).camera.m_per_px
    errors = []
    for trial, true in campaign.pairs:
        if trial.name not in tracks:
            continue
        seen = tracks[trial.name]
        sure = seen.usable & (seen.flag == "")
        if sure.sum() < 2:
            continue
        error = seen.lead_position_m[sure] - np.interp(seen.time_s[sure], true.time_s, true.lead_position_m)
        errors.append(float(np.std(error)) / m_per_px)
    return float(np.median(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", default=",".join(ONE_EACH), help="KIND@SEED, comma-separated")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for recordings and results")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for one in chosen.campaigns.split(","):
            kind, seed = one.split("@")
            folder = (chosen.keep or Path(scratch)) / f"{kind.replace(':', '_')}_{seed}"
            ask(kind, int(seed), folder, chosen.cores)


if __name__ == "__main__":
    main()
