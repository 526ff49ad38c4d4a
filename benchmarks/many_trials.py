"""What the chain costs from a folder to its report: seconds, processor seconds, memory and files.

    python benchmarks/many_trials.py [--recordings 24 96 200] [--tracks 100 1000] [--kind reservoir_depletion]

Recordings: the demonstration's conditions, repeated until there are so many, grown and filmed anew. Their films are
decoded alone, then `vinetrack run` is timed on the folder; with the fewest recordings also after one pressure in the
sheet was changed, and once more when nothing was. Model and diagnosis are timed once more alone, for their part in the
whole. Tracks: a campaign of `benchmarks/hidden/` of this kind, likewise.

A row for each run: its seconds, those of its steps, processor seconds and peak memory of the largest of its processes,
files written, recordings tracked, verdict. The last lines are the ratios that do not depend on the machine. The first
run on a new installation holds the time of compiling too.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "data" / "demo"
ENVIRONMENT = os.environ | {
    "PYTHONPATH": str(ROOT), **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
}  # fmt: skip
DECODE = "import sys; from vinetrack.video.frames import *; [sum(1 for _ in iterate_frames(inspect_recording(Path(f)))) for f in sys.argv[1:]]"  # noqa: E501


@dataclass
class Run:
    """One command: seconds, processor seconds, peak memory of one process, MB, and seconds up to each line it said."""

    wall_s: float = 0.0
    processor_s: float = 0.0
    peak_mb: float = 0.0
    steps: dict[str, float] = field(default_factory=dict)


def timed(*arguments: object) -> Run:
    """Run Python with these arguments; ends this script where that fails."""
    begun, steps = time.monotonic(), {}
    process = subprocess.Popen(
        [sys.executable, *map(str, arguments)], env=ENVIRONMENT, stdout=subprocess.PIPE, encoding="utf-8"
    )
    for line in process.stdout or ():
        steps.setdefault(line.rstrip(), time.monotonic() - begun)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(map(str, arguments))[:200]} ended with {os.waitstatus_to_exitcode(status)}.")
    return Run(time.monotonic() - begun, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, steps)


def run_chain(experiment: Path, results: Path, cores: int) -> tuple[Run, str]:
    """`vinetrack run`, and the verdict that it ends with."""
    used = timed("-m", "vinetrack.cli.main", "run", experiment, "--results", results, "--cores", cores)
    diagnosis = json.loads((results / experiment.name / "diagnosis.json").read_text(encoding="utf-8"))
    return used, f"{diagnosis['verdict']} {','.join(diagnosis['answer_set'])}".strip()


def of_tracks(kind: str, seed: int, trials: int, folder: Path, cores: int = 1) -> tuple[Run, str]:
    """The chain over a campaign of so many tracks, and its verdict."""
    from hidden import make, write_folder

    write_folder(make(kind, seed, trials=trials), folder / "experiment")
    return run_chain(folder / "experiment", folder / "results", cores)


def film(count: int, folder: Path, processes: int) -> None:
    """An experiment of so many recordings: rows of the demonstration's sheet, repeated under further names."""
    with (DEMO / "trials.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    folder.mkdir(parents=True)
    with (folder / "trials.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        for k in range(count):
            name = f"{rows[k % len(rows)]['trial']}_{k // len(rows)}"
            writer.writerow(rows[k % len(rows)] | {"trial": name, "video": f"videos/{name}.mp4"})
    (folder / "experiment.yaml").write_text((DEMO / "experiment.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    timed("-m", "vinetrack.laboratory", folder, "--processes", processes)


def with_another_pressure(sheet: Path) -> None:
    """Change the pressure of the first trial by a thousandth."""
    text = sheet.read_text(encoding="utf-8")
    row = text.splitlines()[1]
    sheet.write_text(text.replace(row, re.sub(r",(\d+),0$", r",\g<1>.02,0", row)), encoding="utf-8")


def show(what: str, used: Run, results: Path | None = None, tracked: int = 0, verdict: str = "") -> None:
    """Print a row, and the seconds of its steps below."""
    files = sum(path.is_file() for path in results.rglob("*")) if results else 0
    cells = f"{used.wall_s:8.1f}{used.processor_s:11.1f}{used.peak_mb:9.0f}{files:7d}{tracked:9d}"
    print(f"{what:38s}{cells}  {verdict}", flush=True)
    before, steps = 0.0, []
    for line, at_s in used.steps.items():
        if line.startswith(("trials: ", "model: ", "report: ")):
            steps.append(f"{line} {at_s - before:.1f} s")
            before = at_s
    if steps:
        print(f"    {'; '.join(steps)}", flush=True)


def of_recordings(counts: list[int], cores: int, folder: Path) -> None:
    """The rows of recordings, and the ratios of the largest number below 200 to the smallest."""
    first: dict[int, tuple[float, float, float]] = {}
    for count in sorted(counts):
        experiment, results = folder / f"films_{count}", folder / "results"
        film(count, experiment, cores)
        decoding = timed("-c", DECODE, *sorted((experiment / "videos").iterdir()))
        show(f"{count} recordings, decoding alone", decoding)
        kept = results / experiment.name / ".kept"
        tracks: set[Path] = set()
        for what in ("first", *(("one pressure changed", "nothing changed") if count == min(counts) else ())):
            if what == "one pressure changed":
                with_another_pressure(experiment / "trials.csv")
            used, verdict = run_chain(experiment, results, cores)
            new = set(kept.glob("*.track")) - tracks
            tracks |= new
            show(f"{count} recordings, {what}", used, results / experiment.name, len(new), verdict)
            if count not in first:
                model = timed("-m", "vinetrack.cli.main", "model", experiment, results / experiment.name)
                show(f"{count} recordings, model and diagnosis alone", model)
                first[count] = used.processor_s, model.processor_s, decoding.processor_s
    for few, many in zip(sorted(first), sorted(first)[1:], strict=False):
        whole, model_s, decoded = ((b - a) / (many - few) for a, b in zip(first[few], first[many], strict=True))
        print(f"a further recording, {few} to {many}: {whole:.2f} processor s, model and diagnosis {model_s:.2f};")
        print(f"    from film to figure {whole - model_s:.2f}, of which decoding {decoded:.3f}")
        print(f"chain over decoding alone, {many}: {first[many][0] / first[many][2]:.1f}", flush=True)


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, nargs="*", default=[24, 96])
    parser.add_argument("--tracks", type=int, nargs="*", default=[100])
    parser.add_argument("--kind", default="reservoir_depletion")
    parser.add_argument("--seed", type=int, default=52001)
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args()
    print(f"{'':38s}{'s':>8}{'processor':>11}{'peak MB':>9}{'files':>7}{'tracked':>9}  verdict", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        of_recordings(given.recordings, given.cores, Path(scratch))
        for count in given.tracks:
            folder = Path(scratch) / f"tracks_{count}"
            used, verdict = of_tracks(given.kind, given.seed, count, folder, given.cores)
            show(f"{count} tracks", used, folder / "results", 0, verdict)


if __name__ == "__main__":
    main()
