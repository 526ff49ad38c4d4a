"""A run over recordings, killed at random moments: whether the same command ends with the same bytes.

    python benchmarks/killed_runs.py [--kills 50] [--seed 20700] [--within 30]

Three recordings of the laboratory go through the whole chain once, undisturbed. Then the same command is killed again
and again, with all its processes (SIGKILL), at random moments, each time begun anew where it was. Whenever it reaches
its end every file but the logs is compared with those of the first run, byte for byte, nothing half-written may be
left, and the results are deleted for the next. Kills fall within half of the time of the undisturbed run after each
beginning, or within as many seconds as are given: on a busy machine that run may take longer than all others.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.campaigns import Filming, GroundTruth, film, grow
from vinetrack.laboratory.scene import Camera

ROOT = Path(__file__).resolve().parents[1]
PRESSURES_KPA = (30, 36, 42)
SHEET = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,mm_per_px\n"
SETTINGS = "capture_fps: 1069\nexposure_us: 93.5\nyield_pressure_kPa: 3\ngrowth_angle_deg: 90\n"
NOT_COMPARED = {"logs", ".kept", ".snakemake", "experiment.json"}
SOONEST_S = 1.0
"""Chosen: before that nothing has begun."""


def filmed(folder: Path) -> None:
    """An experiment of three recordings."""
    (folder / "videos").mkdir(parents=True)
    rows = [f"p{kPa},videos/p{kPa}.mp4,12,100,140,{kPa},0.24\n" for kPa in PRESSURES_KPA]
    (folder / "trials.csv").write_text(SHEET + "".join(rows))
    (folder / "experiment.yaml").write_text(SETTINGS)
    values = {"eversion_damping.n": 0.37, "eversion_damping.B": {"12mm-100um-140mm": 1.83}}
    nature = GroundTruth(values=values, release_frames=(14, 20), seed=420)
    for i, grown in enumerate(grow(read_experiment(folder, strict=True).trials, nature)):
        film(grown, Filming(camera=Camera(m_per_px=2.4e-4)), grown.stated.video, seed=50 + i)


def begun(folder: Path, log: Path) -> subprocess.Popen[bytes]:
    """The command, in a process group of its own."""
    command = [sys.executable, "-m", "vinetrack.cli.main", "run", str(folder), "--cores", "2"]
    with log.open("ab") as out:
        return subprocess.Popen(
            command, cwd=folder.parent, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=out,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip


def hashes(results: Path) -> dict[str, str]:
    """SHA-256 of every file of the results but logs, what Snakemake keeps and who wrote, by its path."""
    return {
        path.relative_to(results).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(results.rglob("*"))
        if path.is_file() and not NOT_COMPARED & set(path.relative_to(results).parts)
    }


def compared(results: Path, expected: dict[str, str]) -> list[str]:
    """What differs from the undisturbed run, and what is half-written."""
    found = hashes(results)
    names = sorted(found.keys() | expected.keys())
    return [name for name in names if found.get(name) != expected.get(name) or Path(name).name.startswith(".tmp")]


def main() -> None:
    """Run once, then kill; print each end that was reached and what differed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=20700)
    parser.add_argument("--within", type=float)
    wanted = parser.parse_args()
    draw = np.random.default_rng(wanted.seed)
    with tempfile.TemporaryDirectory() as name:
        folder, log = Path(name) / "vines", Path(name) / "log.txt"
        results = Path(name) / "results" / "vines"
        filmed(folder)
        start = time.monotonic()
        if begun(folder, log).wait():
            raise SystemExit(f"The undisturbed run fails:\n{log.read_text()[-3000:]}")
        lasts_s = time.monotonic() - start
        expected, within_s = hashes(results), wanted.within or 0.5 * lasts_s
        print(f"undisturbed: {len(expected)} files in {lasts_s:.0f} s", flush=True)
        shutil.rmtree(results)
        kills, ends, wrong = 0, 0, 0
        while kills < wanted.kills or results.exists():
            process = begun(folder, log)
            try:
                # The last run of all is left alone.
                status = process.wait(draw.uniform(SOONEST_S, within_s) if kills < wanted.kills else None)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                kills += 1
                continue
            if status:
                raise SystemExit(f"After {kills} kills the same command fails:\n{log.read_text()[-3000:]}")
            differing = compared(results, expected)
            ends, wrong = ends + 1, wrong + bool(differing)
            print(f"after {kills} kills: {'the same bytes' if not differing else ', '.join(differing[:6])}", flush=True)
            shutil.rmtree(results)
        print(f"{kills} kills, {ends} ends, {ends - wrong} of them with the same bytes")
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
