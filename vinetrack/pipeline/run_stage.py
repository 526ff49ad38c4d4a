"""The command `vinetrack run`: the whole chain on one experiment, from anywhere, with the Snakefile of the package."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from vinetrack.core.problems import ExperimentError, UserError
from vinetrack.core.tables import write_text
from vinetrack.core.terminal import Progress, progress
from vinetrack.pipeline.run_folders import (
    PACKAGE,
    claim_results,
    find_experiment,
    find_ground_truth,
    refuse_shared_results,
)
from vinetrack.pipeline.run_lock import LOCK_REMOVED, refuse_running
from vinetrack.pipeline.workflow import SNAKEFILE

Say = Callable[[str], None]

_FINISHED = re.compile(r"^Finished jobid: \d+ \(Rule: (\w+?)(?:_(\d+))?\)")
_STEPS = re.compile(r"^(\d+) of (\d+) steps")
_FAILED = re.compile(r"^Error in rule (\w+)")
_STAGE_LOG = re.compile(r"^\s+log: (\S.*\.log)")
_SNAKEMAKE_LINES = re.compile(
    r"^(\[|\s|$|Finished jobid|\d+ of \d+ steps|Select jobs|Execute \d|Using |Config file|Assuming|Building|Provided|"
    r"Rules claiming|Job stats|job  |-----|total  |Error in rule|Complete log|Elapsed|Shutting down|Exiting|"
    r"Removing output|Nothing to be done|Report: |RuleException|CalledProcessError|Trying to restart|At least one job)"
)
"""Lines of Snakemake about itself; format of version 9. What stages print is what is left."""

MAX_EXPLANATION_LINES = 12
"""Chosen: lines of stages that are kept to explain a failure; a stage that stops says why in one to three."""

STAGE_DONE_TEXT = {
    "laboratory": "recordings of the virtual laboratory made",
    "recording": "recordings tracked",
    "tracks": "tracks analysed",
    "gather": "trials gathered",
    "damping": "damping law fitted",
    "model": "model fitted",
    "diagnosis": "model diagnosed",
    "trial_figures": "figures of the trials drawn",
    "campaign_figures": "figures of the experiment drawn",
    "paper": "paper's numbers set beside",
    "overlays": "clips drawn",
    "report_page": "report written",
}


class RunError(UserError):
    """A run that did not reach its end: which stage stopped it, and why."""


@dataclass(frozen=True)
class RunPaths:
    """The experiment of a run and the folder of its results, both absolute."""

    experiment: Path
    results: Path


def run_paths(folder: Path, base: Path | None) -> RunPaths:
    """Where a run reads and writes.

    Parameters
    ----------
    folder : the experiment's.
    base : folder under which results go, in one named after the experiment; None for `results` beside the experiment.

    Returns
    -------
    paths : absolute.

    Raises
    ------
    ExperimentError
        If there is no such experiment, or the results there are those of another.
    """
    experiment = Path(os.path.normpath(find_experiment(folder).absolute()))
    name = experiment.name or "experiment"
    results = (experiment.parent / "results" if base is None else base.absolute()) / name
    refuse_shared_results(results, experiment)
    return RunPaths(experiment, results)


def check_before_run(experiment: Path, say: Say) -> None:
    """Say what is wrong with an experiment before its run.

    Parameters
    ----------
    experiment : its folder.
    say : takes a line.

    Raises
    ------
    ExperimentError
        If every trial has an error, or the sheet or the settings cannot be read.
    """
    from vinetrack.core.problems import format_problems
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.pipeline.check_stage import check_folder

    if find_ground_truth(experiment, PACKAGE.parent):
        return  # The virtual laboratory makes the recordings of the demonstration in the run itself.
    checked = check_folder(experiment)
    errors = [problem for problem in checked.problems if problem.severity == "error"]
    read = read_experiment(experiment)
    hopeless = {problem.trial for problem in errors}
    if errors and ("" in hopeless or {trial.name for trial in read.trials} <= hopeless):
        raise ExperimentError(checked.problems)
    for line in [*checked.notes, *format_problems(checked.problems, 20 - len(checked.notes))]:
        say(line)


def run_chain(paths: RunPaths, cores: int, say: Say) -> None:
    """Run Snakemake over an experiment, with a bar on a terminal and a line a stage elsewhere.

    Parameters
    ----------
    paths : of experiment and results.
    cores : that it may use.
    say : takes a line.

    Raises
    ------
    RunError
        If a stage fails, with what it said.
    ExperimentError
        If another run writes the same results.
    """
    refuse_running(paths.results)
    claim_results(paths.results, paths.experiment)
    log = paths.results / "logs" / "run.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    # On the command line Snakemake reads values as YAML: ` #2` of a folder's name would be a comment.
    named = log.with_name("run.json")
    write_text(named, json.dumps({"experiment": str(paths.experiment), "results": str(paths.results)}))
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), "--directory", str(paths.results),
        "--cores", str(cores), "--rerun-incomplete", "--quiet", "rules", "host",
        "--configfile", str(named),
    ]  # fmt: skip
    with log.open("w", encoding="utf-8") as kept:
        # A process of its own, so that Snakemake stops its jobs by itself when the user breaks off.
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace"
        ) as process:
            assert process.stdout is not None
            failed, words = _follow(_copied_to(process.stdout, kept), say)
        if process.returncode:
            raise RunError(_failure_text(failed, words, log))


def _copied_to(lines: Iterable[str], file: TextIO) -> Iterator[str]:
    """The lines without their ends, each written to the file before it is handed on."""
    for line in lines:
        file.write(line)
        yield line.rstrip("\n")


def _follow(lines: Iterator[str], say: Say) -> tuple[dict[str, str], list[str]]:
    """Show how a run gets on; the stages that failed with their logs, and the last lines that stages printed."""
    failed: dict[str, str] = {}
    words: deque[str] = deque(maxlen=MAX_EXPLANATION_LINES)
    done: Counter[str] = Counter()
    shown, rule, part = sys.stderr.isatty(), "", None
    bar: Progress[int] | None = None
    for line in lines:
        if match := _FINISHED.match(line):
            rule, part = match[1], match[2]
            done[rule] += 1
        elif (match := _STEPS.match(line)) and rule in STAGE_DONE_TEXT:
            steps, total = int(match[1]), int(match[2])
            text = STAGE_DONE_TEXT[rule]
            if part:
                text += f", part {part}"
            elif done[rule] > 1:
                text = f"{done[rule]} {text}"
            if shown:
                bar = bar or progress(total, "run", unit="step")
                bar.say(text)
                bar.reach(steps)
            else:
                say(f"step {steps} of {total} done: {text}")
        elif match := _FAILED.match(line):
            rule = match[1]
            failed.setdefault(rule, "")
        elif failed and (match := _STAGE_LOG.match(line)):
            failed[rule] = failed[rule] or match[1].split(" (check log")[0]
        elif line.startswith(LOCK_REMOVED):
            say(line)
        elif not _SNAKEMAKE_LINES.match(line):
            words.append(line)
    if bar is not None:
        bar.__exit__(None, None, None)
    return failed, list(words)


def _failure_text(failed: dict[str, str], words: list[str], log: Path) -> str:
    """Which stage stopped a run and what it printed."""
    sentences = [line for line in words if line.strip()]
    if not failed:
        return "\n".join([*sentences, f"The run stopped; everything it printed is in {log}."])
    stages = ", ".join(failed)
    logs = ", ".join(path for path in failed.values() if path) or str(log)
    return "\n".join(
        [*sentences[-3:], f"The run stopped in {stages}; its log is {logs}, everything printed is in {log}."]
    )


def run_lines(results: Path) -> list[str]:
    """What to say of finished results: where the report is, and last the verdict.

    Parameters
    ----------
    results : their folder.

    Returns
    -------
    lines : the verdict last.
    """
    from vinetrack.pipeline.diagnosis_stage import diagnosis_lines
    from vinetrack.results.folder_layout import Results, read_result

    trials = read_result(Results(results).trials)
    failed = trials[trials["status"] == "failed"]
    lines = [f"{row.trial} failed: {row.reason}" for row in failed.head(5).itertuples()]
    if len(failed) > 5:
        lines.append(f"… and {len(failed) - 5} more trial{'s' if len(failed) > 6 else ''} failed")
    verdict, *reasons = diagnosis_lines(results)
    return [*lines, f"Report: {Results(results).report}", *reasons, verdict]
