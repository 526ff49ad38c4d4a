"""The command `vinetrack run`: run the Snakefile of the package on one experiment."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem, UserError, format_problems
from vinetrack.core.tables import write_text
from vinetrack.core.terminal import Progress, progress
from vinetrack.pipeline.kept import PACKAGE, Kept
from vinetrack.pipeline.stages import STAGES
from vinetrack.pipeline.workflow import (
    SNAKEFILE,
    find_experiment,
    find_ground_truth,
    refuse_running,
    refuse_shared_results,
)

if TYPE_CHECKING:
    from vinetrack.video.survey import Keep

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


def check_folder(folder: Path, keep: Keep | None = None) -> CheckReport:
    """Check sheet, settings, effects, tracks and recordings of an experiment; `keep` keeps what is tracked."""
    from vinetrack.experiment.folder import SETTINGS, SHEET, check_experiment, read_experiment
    from vinetrack.pipeline.effects_stage import model_problems
    from vinetrack.pipeline.workflow import path_problems
    from vinetrack.planning.predictive_inputs import pressure_problems
    from vinetrack.tracks.frame_timing import mean_speed
    from vinetrack.tracks.importers import TrackError, load_track
    from vinetrack.tracks.position_noise import common_rounding_noise
    from vinetrack.tracks.smoothed_positions import detect_smoothing
    from vinetrack.video.survey import Surveyor, axis_notes, direction_notes, facts_entry, facts_rows

    surveyor = Surveyor(keep)
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

RUN = "VINETRACK_RUN"  # Variable that asks stages to say in a line what they have done
_PROGRESS = re.compile(r"(\d+) of (\d+) \w+")  # What a stage says while it works


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


def check_before_run(paths: RunPaths, say: Say) -> None:
    """Print the problems of an experiment before its run."""
    from vinetrack.experiment.folder import read_experiment

    if find_ground_truth(paths.experiment, PACKAGE.parent):
        return  # The recordings of the demonstration do not exist yet: the run makes them.
    report = check_folder(paths.experiment, Kept(paths.results).track)
    errors = [problem for problem in report.problems if problem.severity == "error"]
    trials = {trial.name for trial in read_experiment(paths.experiment).trials}
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
        "--cores", str(cores), "--rerun-incomplete", "--nolock", "--quiet", "all", "--configfile", str(config_file),
    ]  # fmt: skip
    bar: Progress[None]
    # Its standard output is what the stages say, since Snakemake itself is quiet; in a process of its own it stops its
    # jobs itself when the user interrupts the run.
    with (
        log.open("w", encoding="utf-8") as errors,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, env=os.environ | {RUN: "1"}, text=True, encoding="utf-8"
        ) as process,
        progress(0, "trials") as bar,
    ):
        assert process.stdout is not None
        finished = {stage.done for stage in STAGES.values()}
        for line in map(str.rstrip, process.stdout):
            if match := _PROGRESS.fullmatch(line):
                bar.reach(int(match[1]), int(match[2]))
            elif line in finished:
                say(line)
    if process.returncode:
        # 12: last lines of a run that failed which are printed (chosen)
        explanation = log.read_text(encoding="utf-8").splitlines()[-12:]
        raise RunError("\n".join([*explanation, f"The run stopped; the logs of its stages are in {log.parent}."]))


def run_lines(results: Path) -> list[str]:
    """Summarise finished results for the terminal: failed trials, path of the report, reasons, and last the verdict."""
    from vinetrack.pipeline.model_stage import diagnosis_lines
    from vinetrack.results.folder_layout import Results, read_result

    trials = read_result(Results(results).trials)
    failed = trials[trials["status"] == "failed"]
    lines = [f"{row.trial} failed: {row.reason}" for row in failed.head(5).itertuples()]
    if len(failed) > 5:
        lines.append(f"… and {len(failed) - 5} more trial{'s' if len(failed) > 6 else ''} failed")
    verdict, *reasons = diagnosis_lines(results)
    return [*lines, f"Report: {Results(results).report}", *reasons, verdict]
