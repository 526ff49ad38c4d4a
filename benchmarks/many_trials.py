"""Time and memory from tracks to a report against the number of trials, stage by stage.

    python benchmarks/many_trials.py [--kind null:white] [--seeds 120] [--trials 24 50 100 200]

Campaigns of `benchmarks/hidden/` whose conditions are repeated until there are so many trials, written as experiment
folders. Each stage runs as its own command, as the workflow runs it, on one core. Printed for each stage and for the
whole: processor time a trial, ms, without what a process takes to start; peak memory, MB; and the verdict. The first
row of a new installation holds the time of compiling too. The bound: the time a trial at the largest number is at most
1.2 times that at half of it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from hidden import make, write_folder

from vinetrack.experiment.settings import RunSettings

STAGES: dict[str, tuple[str, ...]] = {
    "tracks": ("tracks", "--threads", "1"),
    "gather": ("gather",),
    "damping": ("damping",),
    "model": ("model",),
    "diagnosis": ("diagnosis",),
    "trial figures": ("figures", "--of", "trials", "--threads", "1"),
    "campaign figures": ("figures", "--of", "campaign"),
    "report": ("report",),
}
"""Commands of the workflow after one another, with their options."""

WITHOUT_EXPERIMENT = ("damping",)
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Cost(NamedTuple):
    """Processor time, s, and peak memory, MB, of one process."""

    processor_s: float
    peak_mb: float


def cost_of(arguments: Sequence[str]) -> Cost:
    """What a command takes.

    Raises
    ------
    SystemExit
        If it fails.
    """
    code = "import sys; from vinetrack.cli.main import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], env={**os.environ, **ONE_THREAD}, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"vinetrack {' '.join(arguments)} ended with {os.waitstatus_to_exitcode(status)}.")
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def costs(kind: str, seed: int, trials: int, folder: Path) -> tuple[dict[str, Cost], str]:
    """What every stage takes for a campaign of so many trials, and its verdict."""
    experiment, results = folder / "experiment", folder / "results"
    write_folder(make(kind, seed, trials=trials), experiment)
    settings = RunSettings().model_dump_json(exclude={"experiment", "results"})
    found = {"start": cost_of(["--version"])}
    for stage, (command, *options) in STAGES.items():
        folders = [str(results)] if stage in WITHOUT_EXPERIMENT else [str(experiment), str(results)]
        found[stage] = cost_of([command, *folders, "--settings", settings, *options])
        print(f"{trials} trials, {stage}: {found[stage].processor_s:.0f} s", file=sys.stderr, flush=True)
    diagnosis = json.loads((results / "diagnosis.json").read_text())
    return found, f"{diagnosis['verdict']} {','.join(diagnosis['answer_set'])}".strip()


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", default="null:white")
    parser.add_argument("--seeds", type=int, nargs="+", default=[120])
    parser.add_argument("--trials", type=int, nargs="+", default=[24, 50, 100, 200])
    given = parser.parse_args()
    columns = [*STAGES, "all"]
    print(f"{'seed':>5}{'trials':>7}  " + "".join(f"{name:>17}" for name in columns) + "  verdict", flush=True)
    for seed in given.seeds:
        for trials in given.trials:
            with tempfile.TemporaryDirectory() as folder:
                found, verdict = costs(given.kind, seed, trials, Path(folder))
            start = found.pop("start").processor_s
            each = {name: (cost.processor_s - start, cost.peak_mb) for name, cost in found.items()}
            whole = sum(seconds for seconds, _ in each.values()), max(peak for _, peak in each.values())
            cells = "".join(f"{1e3 * seconds / trials:10.0f}{peak:7.0f}" for seconds, peak in (*each.values(), whole))
            print(f"{seed:>5}{trials:>7}  {cells}  {verdict}", flush=True)


if __name__ == "__main__":
    main()
