"""One campaign a verdict, from recordings: grown by another simulator, rendered, tracked, diagnosed.

    python benchmarks/filmed_verdicts.py [--kinds KIND,KIND] [--seed 950] [--processes 2] [--keep DIR]

The campaigns are those of `benchmarks/hidden/` (see `hidden_effects.py`), which shares no code with the package's
model; the virtual laboratory films them with distortion, blur, photon noise and compression, beside a calibration
board. What is analysed is a folder of recordings and a sheet, by the command line alone.

SD: of tracked minus true position, px, after the mean is taken out, the median of the trials. An offset of all frames
is no error, any analysis has an origin of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from hidden import make
from hidden.campaigns import Hidden
from hidden.filmed import film_campaign, filming_of

ONE_EACH = (
    "null:anything",
    "reservoir_depletion",
    "air_drag",
    "perspective",
    "outsider:rough_patch",
    "tail_friction",
    "frames:dropped",
)
"""One campaign for every verdict at least: adequate, missing, ambiguous, artefact, unexplained."""


def tracked_sd_px(campaign: Hidden, results: Path) -> float:
    """Median over the trials of the SD of tracked minus true position."""
    m_per_px = filming_of(campaign).camera.m_per_px
    errors = []
    for trial, track in campaign.pairs:
        path = results / "tracks" / f"{trial.name}.csv"
        if not path.is_file():
            continue
        seen = pd.read_csv(path, comment="#")
        true = np.interp(seen["time_s"], track.time_s, track.lead_position_m)
        error = seen["position_m"] - true
        errors.append(float(np.nanstd(error - error.mean())) / m_per_px)
    return float(np.median(errors)) if errors else float("nan")


def ask(kind: str, seed: int, folder: Path, processes: int) -> None:
    """Film, analyse and print one row."""
    campaign = make(kind, seed, filmed=True)
    begun = time.perf_counter()
    experiment = film_campaign(campaign, folder, processes)
    filmed_s = time.perf_counter() - begun
    begun = time.perf_counter()
    results = folder / "results"
    command = [sys.executable, "-m", "vinetrack", "diagnose", str(experiment.folder), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode:
        print(f"{kind}: {done.stderr.strip().splitlines()[-1:]}")
        return
    said = json.loads(done.stdout)
    hidden = "+".join(campaign.truth.effects) or campaign.truth.outsider or "nothing"
    print(
        f"{hidden:22s}{len(campaign.pairs):4d} trials  {said['verdict']:12s}"
        f"{', '.join(said.get('answer_set', [])) or '-':40s} filmed in {filmed_s:.0f} s, "
        f"tracked and diagnosed in {time.perf_counter() - begun:.0f} s, SD {tracked_sd_px(campaign, results):.3f} px",
        flush=True,
    )
    print("    " + said["explanation"][:400])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default=",".join(ONE_EACH))
    parser.add_argument("--seed", type=int, default=950)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for recordings and results")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for kind in chosen.kinds.split(","):
            ask(kind, chosen.seed, (chosen.keep or Path(scratch)) / kind.replace(":", "_"), chosen.processes)


if __name__ == "__main__":
    main()
