"""One campaign a verdict, from recordings: grown by another simulator, rendered, tracked, diagnosed.

    python benchmarks/filmed_verdicts.py [--campaigns KIND@SEED,...] [--cores 2] [--keep DIR]

The campaigns are those of `benchmarks/hidden/` (see `hidden_effects.py`), which shares no code with the package's
model; the virtual laboratory films them with distortion, blur, photon noise and compression, beside a calibration
board. What is analysed is a folder of recordings and a sheet, by the workflow, as anybody's.

SD: of tracked minus true position, px, after the mean is taken out, the median of the trials. An offset of all frames
is no error, any analysis has an origin of its own.

Seeds 950–974 are kept for this and were chosen by the length of their recordings, the shortest first.
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
    "null:anything@953",
    "null:anything@966",
    "reservoir_depletion@973",
    "tail_friction@950",
    "air_drag@956",
    "perspective@959",
    "length_scale@962",
    "outsider:rough_patch@962",
)
ROOT = Path(__file__).parents[1]


def tracked_sd_px(campaign: Hidden, results: Path) -> float:
    """Median over the trials of the SD of tracked minus true position."""
    m_per_px = filming_of(campaign).camera.m_per_px
    errors = []
    for trial, track in campaign.pairs:
        path = results / "tracks" / f"{trial.name}.csv"
        if not path.is_file():
            continue
        seen = pd.read_csv(path, comment="#")
        seen = seen[seen["flag"].isna()]
        true = np.interp(seen["time_s"], track.time_s, track.lead_position_m)
        error = seen["lead_position_m"] - true
        errors.append(float(np.nanstd(error - error.mean())) / m_per_px)
    return float(np.median(errors)) if errors else float("nan")


def ask(kind: str, seed: int, folder: Path, cores: int) -> None:
    """Film, analyse and print one row."""
    campaign = make(kind, seed, filmed=True)
    begun = time.perf_counter()
    experiment = film_campaign(campaign, folder, cores)
    filmed_s = time.perf_counter() - begun
    begun = time.perf_counter()
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder)]
    command += ["--cores", str(cores), "--config", f"experiment={experiment.folder}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    results = folder / "results" / experiment.folder.name
    hidden = "+".join(campaign.truth.effects) or campaign.truth.outsider or "nothing"
    if not (results / "diagnosis.json").is_file():
        print(f"{hidden}: no diagnosis\n{done.stderr[-2000:]}", flush=True)
        return
    said = json.loads((results / "diagnosis.json").read_text(encoding="utf-8"))
    answer = ", ".join(said.get("answer_set", [])) or "-"
    print(
        f"{hidden:20s} {seed} {len(campaign.pairs):3d} trials  {said['verdict']:12s}{answer:36s}"
        f"filmed {filmed_s:4.0f} s, analysed {time.perf_counter() - begun:4.0f} s, "
        f"SD {tracked_sd_px(campaign, results):.3f} px",
        flush=True,
    )
    print("    " + said["explanation"][:500], flush=True)


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
