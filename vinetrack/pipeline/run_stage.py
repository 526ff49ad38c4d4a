"""The command `vinetrack run`: run the Snakefile of the package on one experiment."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import subprocess
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from vinetrack.core.problems import ExperimentError, Problem, UserError, format_problems
from vinetrack.core.tables import write_text
from vinetrack.core.terminal import Progress, progress
from vinetrack.pipeline.workflow import (
    LOCK_REMOVED,
    PACKAGE,
    SNAKEFILE,
    find_experiment,
    find_ground_truth,
    refuse_running,
    refuse_shared_results,
)

# ------------------------------------------------------------------------------
# The command `vinetrack check`: facts about the recordings of an experiment, and all problems, before any analysis.


@dataclass(frozen=True)
class CheckReport:
    """Result of a check: `problems`, facts about each recording (`recordings`, also as lines), and `notes`."""

    problems: tuple[Problem, ...]
    recordings: tuple[dict[str, Any], ...]
    recording_lines: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def failed(self) -> bool:
        """Whether there is an error."""
        return any(problem.severity == "error" for problem in self.problems)

    def lines(self) -> list[str]:
        """Return facts and notes, then the problems in at most 20 lines, notes included."""
        facts = [*self.recording_lines, *self.notes]
        return [*facts, *format_problems(self.problems, 20 - len(self.notes))]

    def to_json(self) -> dict[str, Any]:
        """Return the report for a program."""
        problems = [{key: value for key, value in vars(problem).items() if value} for problem in self.problems]
        return {"recordings": list(self.recordings), "notes": list(self.notes), "problems": problems}


def check_folder(folder: Path) -> CheckReport:
    """Check sheet, settings, effects, tracks and recordings of an experiment."""
    from vinetrack.experiment.folder import SETTINGS, SHEET, check_experiment, read_experiment
    from vinetrack.pipeline.effects_stage import model_problems
    from vinetrack.pipeline.workflow import path_problems
    from vinetrack.planning.predictive_inputs import pressure_problems
    from vinetrack.tracks.frame_timing import mean_speed
    from vinetrack.tracks.importers import TrackError, load_track
    from vinetrack.tracks.position_noise import common_rounding_noise
    from vinetrack.tracks.smoothed_positions import detect_smoothing
    from vinetrack.video.survey import Surveyor, axis_notes, direction_notes, facts_entry, facts_rows

    surveyor = Surveyor()
    problems = [*path_problems(folder.absolute()), *check_experiment(folder, surveyor), *model_problems(folder)]
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError:
        return CheckReport(tuple(problems), (), (), ())
    facts = {trial.name: recording_facts for trial, recording_facts in surveyor.facts.items()}
    trials = [trial for trial in experiment.trials if trial.name in facts]
    speeds = [(trial, facts[trial.name].mean_speed_m_s) for trial in trials]
    tracks = []
    for trial in experiment.trials:
        if trial.track is not None:
            with contextlib.suppress(TrackError):
                tracks.append((trial, load_track(trial)))
    speeds += [(trial, mean_speed(track)) for trial, track in tracks]
    # The plausibility of a pressure depends on the sizes, so it is tested only if these have no errors.
    if not any(problem.severity == "error" for problem in problems):
        stated_in = SHEET if "pressure_kPa" in experiment.columns else SETTINGS
        problems += [replace(problem, file=stated_in) for problem in pressure_problems(speeds)]
    entries = [facts[trial.name] for trial in trials]
    lines = facts_rows(entries, trials) if entries else []
    if 0 < len(surveyor.looked_into) < len(entries):
        lines.append(f"{len(surveyor.looked_into)} of {len(entries)} recordings were examined, one of each condition")
    notes = list(experiment.blank_notes)
    notes += [*direction_notes(entries, trials, experiment.angle_blank), *axis_notes(entries, trials)]
    rounding_m = common_rounding_noise([track.lead_position_m[track.usable] for _, track in tracks])
    smoothing = detect_smoothing(tracks, rounding_m)
    if smoothing is not None:
        notes.append(smoothing.note)
    if rounding_m > 0:
        notes.append(
            f"Positions are rounded to {1e3 * math.sqrt(12) * rounding_m:.3g} mm, and rounding is most of their noise:"
            " export them with all measured digits."
        )
    return CheckReport(tuple(problems), tuple(map(facts_entry, entries)), tuple(lines), tuple(notes))


Say = Callable[[str], None]

_FINISHED = re.compile(r"^Finished jobid: \d+ \(Rule: (\w+?)(?:_(\d+))?\)")
_STEPS = re.compile(r"^(\d+) of (\d+) steps")
_FAILED = re.compile(r"^Error in rule (\w+)")
_STAGE_LOG = re.compile(r"^\s+log: (\S.*\.log)")
# Lines that Snakemake prints about itself; format of version 9
_SNAKEMAKE_LINES = re.compile(
    r"^(\[|\s|$|Finished jobid|\d+ of \d+ steps|Select jobs|Execute \d|Using |Config file|Assuming|Building|Provided|"
    r"Rules claiming|Job stats|job  |-----|total  |Error in rule|Complete log|Elapsed|Shutting down|Exiting|"
    r"Removing output|Nothing to be done|Report: |RuleException|CalledProcessError|Trying to restart|At least one job)"
)

MAX_EXPLANATION_LINES = 12  # Lines printed by stages that are kept to explain a failure (chosen)

STAGE_DONE_TEXT = {
    "laboratory": "virtual measurements made",
    "recording": "recordings tracked",
    "tracks": "tracks analysed",
    "gather": "trials gathered",
    "damping": "damping law fitted",
    "model": "model fitted",
    "diagnosis": "model diagnosed",
    "trial_figures": "figures of the trials drawn",
    "campaign_figures": "figures of the experiment drawn",
    "paper": "comparison with the paper made",
    "overlays": "clips drawn",
    "report_page": "report written",
}


class RunError(UserError):
    """A run that failed; the message names the stage and the reason."""


@dataclass(frozen=True)
class RunPaths:
    """The experiment folder and the results folder of a run, both absolute."""

    experiment: Path
    results: Path


def run_paths(folder: Path, base: Path | None) -> RunPaths:
    """Return the folders of a run."""
    experiment = Path(os.path.normpath(find_experiment(folder).absolute()))
    name = experiment.name or "experiment"
    results = (base or Path("results")).absolute() / name
    refuse_shared_results(results, experiment)
    return RunPaths(experiment, results)


def check_before_run(experiment: Path, say: Say) -> None:
    """Print the problems of an experiment before its run."""
    from vinetrack.core.problems import format_problems
    from vinetrack.experiment.folder import read_experiment

    if find_ground_truth(experiment, PACKAGE.parent):
        return  # The recordings of the demonstration do not exist yet: the run makes them.
    report = check_folder(experiment)
    errors = [problem for problem in report.problems if problem.severity == "error"]
    trials = {trial.name for trial in read_experiment(experiment).trials}
    faulty_trials = {problem.trial for problem in errors}  # "" stands for the experiment as a whole
    if errors and ("" in faulty_trials or trials <= faulty_trials):
        raise ExperimentError(report.problems)
    for line in [*report.notes, *format_problems(report.problems, 20 - len(report.notes))]:
        say(line)


def run_chain(paths: RunPaths, cores: int, say: Say) -> None:
    """Run Snakemake on an experiment; show a progress bar on a terminal, and one line per stage elsewhere."""
    refuse_running(paths.results)
    log = paths.results / "logs" / "run.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    # Snakemake parses values of --config as YAML, where ` #2` in the name of a folder would be a comment.
    config_file = log.with_name("run.json")
    write_text(config_file, json.dumps({"experiment": str(paths.experiment), "results": str(paths.results)}))
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), "--directory", str(paths.results),
        "--cores", str(cores), "--rerun-incomplete", "--quiet", "rules", "host",
        "--configfile", str(config_file),
    ]  # fmt: skip
    with log.open("w", encoding="utf-8") as log_file:
        # In a process of its own, Snakemake stops its jobs itself when the user interrupts the run.
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace"
        ) as process:
            assert process.stdout is not None
            failed, last_lines = _follow(_copied_to(process.stdout, log_file), say)
        if process.returncode:
            raise RunError(_failure_text(failed, last_lines, log))


def _copied_to(lines: Iterable[str], file: TextIO) -> Iterator[str]:
    """Yield the lines without line ends, and copy each to the file."""
    for line in lines:
        file.write(line)
        yield line.rstrip("\n")


def _follow(lines: Iterator[str], say: Say) -> tuple[dict[str, str], list[str]]:
    """Show the progress of a run; return the logs of the stages that failed, and the last lines that stages printed."""
    failed: dict[str, str] = {}
    last_lines: deque[str] = deque(maxlen=MAX_EXPLANATION_LINES)
    done: Counter[str] = Counter()
    on_terminal, rule, part = sys.stderr.isatty(), "", None
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
            if on_terminal:
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
            last_lines.append(line)
    if bar is not None:
        bar.__exit__(None, None, None)
    return failed, list(last_lines)


def _failure_text(failed: dict[str, str], last_lines: list[str], log: Path) -> str:
    """Name the stage that stopped a run, with its last output and its log."""
    sentences = [line for line in last_lines if line.strip()]
    if not failed:
        return "\n".join([*sentences, f"The run stopped; its whole output is in {log}."])
    stages = ", ".join(failed)
    logs = ", ".join(path for path in failed.values() if path) or str(log)
    return "\n".join(
        [*sentences[-3:], f"The run stopped in {stages}; its log is {logs}, its whole output is in {log}."]
    )


def run_lines(results: Path) -> list[str]:
    """Summarise finished results for the terminal: failed trials, path of the report, reasons, and last the verdict."""
    from vinetrack.pipeline.diagnosis_stage import diagnosis_lines
    from vinetrack.results.folder_layout import Results, read_result

    trials = read_result(Results(results).trials)
    failed = trials[trials["status"] == "failed"]
    lines = [f"{row.trial} failed: {row.reason}" for row in failed.head(5).itertuples()]
    if len(failed) > 5:
        lines.append(f"… and {len(failed) - 5} more trial{'s' if len(failed) > 6 else ''} failed")
    verdict, *reasons = diagnosis_lines(results)
    return [*lines, f"Report: {Results(results).report}", *reasons, verdict]
