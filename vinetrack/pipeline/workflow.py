"""The workflow of a run: its stages, and the plan of their jobs for the Snakefile; the check before it, and the run.

One table says what each stage reads and writes; Snakemake's rules and the commands are made from it. A stage is a
function of an experiment, a results folder and settings; it returns lines for the terminal. Every command that does
part of a run calls the same function. Imports stay light: Snakemake loads this module at every start and in every job.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import multiprocessing
import os
import pickle
import re
import shlex
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vinetrack.core.problems import ExperimentError, Problem, UserError, format_problems, remark
from vinetrack.core.process import waiting
from vinetrack.core.tables import write_bytes, write_text
from vinetrack.results import CLAIM_FILE, claim, locked, refuse_shared_results, results_within

if TYPE_CHECKING:
    from vinetrack.core.records import Track, Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings
    from vinetrack.video.survey import Keep
    from vinetrack.video.track import Tracking


# ------------------------------------------------------------------------------
# The stages of a run.


PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Job:
    """What a stage is asked for: `trials` are the names of some trials, None for all; `say` shows what it is doing."""

    experiment: Experiment
    results: Path
    settings: RunSettings
    trials: Sequence[str] | None = None
    threads: int = 1
    say: Callable[[str], None] = lambda _: None


@dataclass(frozen=True)
class Stage:
    """One stage: what it does in words, and by which function, `module:name`, of a job; the keys of a run's settings
    that it depends on; what it `reads` and `writes`: files of the results, or groups that the plan knows, in `<…>`.
    """

    does: str
    function: str
    settings: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    parallel: bool = False

    def run(self, job: Job) -> list[str]:
        """Do the job; return lines for the terminal, the first of which says what was done."""
        module, name = self.function.split(":")
        with compilation_told(job.say):
            lines: list[str] = getattr(import_module(f"vinetrack.pipeline.{module}"), name)(job)
        return lines


STAGES = {
    "trials": Stage(
        "Track recordings, analyse the motion of every trial, and draw both.",
        "analysis:analyse_trials",
        ("steady", "velocity", "final_at_fraction", "efficiency_at_mm", "figures"),
        ("<measurements>",),
        ("<trials>",),
        parallel=True,
    ),
    "model": Stage(
        "Fit the damping law and the model in use to all trials, audit neglected effects, and diagnose what it lacks.",
        "analysis:fit_and_diagnose",
        ("steady", "velocity", "damping", "final_at_fraction", "efficiency_at_mm"),
        ("<trials>",),
        ("trials.csv", "conditions.csv", "steady.csv", "damping_points.csv", "damping.json", "scaling.json", "fit.json",
         "comparison.csv", "model_check.csv", "audit.csv", "diagnosis.json", "ladder.csv"),
    ),
    "report": Stage(
        "Draw the figures of the experiment and clips of its recordings, and write the report, a single file.",
        "report_stage:write_report",
        (),
        ("diagnosis.json",),
        ("report.html", "provenance.json"),  # which figures have content is not known in advance
        parallel=True,
    ),
}  # fmt: skip


COMPILING = "compiling for this machine, once (half a minute)"


@contextmanager
def compilation_told(say: Callable[[str], None]) -> Iterator[None]:
    """Say so when code is first compiled meanwhile; what was compiled before is kept, so mostly nothing is said."""
    from numba.core import event

    class Listener(event.Listener):
        is_told = False

        def on_start(self, _: object) -> None:
            if not self.is_told:
                say(COMPILING)
            self.is_told = True

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


# ------------------------------------------------------------------------------
# Applying a function to many trials in several processes.

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def map_unordered(function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int) -> Iterator[Answer]:
    """Yield `function(item)` of every item as soon as it is ready; both go to other processes, so are picklable."""
    if n_workers < 2 or len(items) < 2:
        yield from map(function, items)
        return
    # Forked on Linux, where workers are ready at once and share what is imported, and spawned elsewhere.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(min(n_workers, len(items)), mp_context=context, initializer=_end_with_parent) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:
            pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this worker when its parent process ends, even if that is killed. A worker waits for its next argument on a
    pipe that the others hold open too: all of them would wait for ever and keep their memory.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()


# ------------------------------------------------------------------------------
# What a run need not make twice: the check, tracks in pixels, figures of trials; kept in the results by their inputs.
#
# It lies beside the results, in a folder that Snakemake does not know. A file that is replaced, or another version of
# the program, has another key; what no run asks for in a month is dropped.


@lru_cache
def code_hash() -> str:
    """Hash of the package."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def identity(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, size and time of modification of a file and of those that share its name, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else (one for one in path.parent.iterdir() if one.stem == path.stem)
    stats = [(file.name, file.stat()) for file in sorted({path, *files}) if file.is_file()]
    return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)


class Kept:
    """The kept files of a results folder; `tracked` is the key of the last track that was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / ".kept"
        self.tracked = ""

    def track(self, film: Path, inputs: tuple[object, ...], make: Callable[[], Tracking]) -> Tracking:
        """The tracking in pixels of a recording, kept or made."""
        libraries = [import_module(name).__version__ for name in ("numpy", "scipy", "numba", "av", "cv2")]
        state = (code_hash(), libraries, film.resolve(), identity(film), inputs)
        self.tracked = _key(*state)
        return self.made("track", state, make)

    def made(
        self, kind: str, inputs: tuple[object, ...], make: Callable[[], Answer],
        lasts: Callable[[Answer], bool] = lambda _: True,
    ) -> Answer:  # fmt: skip
        """What was made for these inputs, kept or made: the same, bit by bit. It is kept if it `lasts`."""
        path = self.folder / f"{_key(*inputs)}.{kind}"
        try:
            os.utime(path)  # it counts as asked for now
            content = zlib.decompress(path.read_bytes())
        except FileNotFoundError:
            content = pickle.dumps(made := make())
            if lasts(made):
                write_bytes(path, zlib.compress(content, 1))
        found: Answer = pickle.loads(content)
        return found

    def forget(self) -> None:
        """Drop what no run has asked for in a long time."""
        for path in self.folder.glob(f"{'?' * 32}.*"):  # named by a key, as the steps of earlier runs are not
            if path.stat().st_mtime < time.time() - 30 * 86400:  # a month (chosen)
                path.unlink(missing_ok=True)


def _key(*inputs: object) -> str:
    return hashlib.sha256(repr(inputs).encode()).hexdigest()[:32]


Say = Callable[[str], None]

# ------------------------------------------------------------------------------
# The folders of a run: that of the experiment, and that of its results.


def find_experiment(folder: Path) -> Path:
    """Return `folder` if it exists."""
    from vinetrack.experiment.folder import closest_entry

    if experiment := claim(folder / CLAIM_FILE).get("experiment", ""):
        remedy = f"give {experiment}; vinetrack run {experiment} finishes results that were stopped"
        raise ExperimentError([Problem(message="holds results", file=str(folder), remedy=remedy)])
    if within := results_within(folder):
        remedy = f"give one of them, such as {within[0]}, or an experiment"
        raise ExperimentError([Problem(message="holds results folders", file=str(folder), remedy=remedy)])
    if folder.exists():
        return folder
    close = closest_entry(folder)
    remedy = f"did you mean {folder.with_name(close)}?" if close else "check the path and its upper and lower case"
    raise ExperimentError([Problem(message="does not exist", file=str(folder), remedy=remedy)])


def command_for_results(experiment: Path, results: Path) -> str:
    """Return the command that writes the results of an experiment to the folder where they are."""
    name, where = experiment.absolute().name, results.absolute()
    if where.name != name:
        chain = ["snakemake", "--snakefile", str(PACKAGE / "pipeline" / "Snakefile"), "--cores", "2", "--config"]
        return shlex.join([*chain, f"experiment={experiment}", f"results={results}"])
    command = ["vinetrack", "run", str(experiment)]
    usual = where.parent == Path("results").absolute()
    return shlex.join(command if usual else [*command, "--results", os.path.relpath(where.parent)])


def find_ground_truth(folder: Path, base: Path) -> Path | None:
    """Ground truth, named like its folder in `data/`, of a shipped virtual experiment; None for any other."""
    for ground_truth in sorted((PACKAGE / "laboratory").glob("*.yaml")):
        shipped = base / "data" / ground_truth.stem
        if folder.exists() and shipped.exists() and folder.samefile(shipped):
            return ground_truth
    return None


def path_problems(*folders: Path) -> list[Problem]:
    """Report folders of whose path Snakemake would take part for a wildcard or a variable, which cannot be escaped."""
    message = "has braces or a word in < > in its path, which Snakemake cannot handle"
    remedy = "rename the folder, or run the stages one by one with vinetrack"
    named = [folder for folder in map(str, folders) if re.search(r"[{}]|<\w+>", folder)]
    return [Problem(message=message, file=folder, remedy=remedy) for folder in named]


# ------------------------------------------------------------------------------
# What the Snakefile asks: the plan of a run with its inputs and outputs.

SHARED_FILES = ("trials.csv", "experiment.yaml", "corrections.csv")  # Those that the set-up page writes
TRIALS_PER_JOB = 100  # Largest number of trials of one job (chosen: as recordings two cores take one or two minutes)


@dataclass(frozen=True)
class WorkflowPlan:
    """Inputs and outputs of one run: `trials` that get files (empty ones for a faulty row), `measurements` that the
    virtual laboratory makes, and the `state` of all files that people brought.
    """

    experiment: Path
    results: Path
    trials: tuple[str, ...]
    measurements: tuple[Path, ...]
    state: str
    settings: RunSettings
    ground_truth: Path | None

    @cached_property
    def version_file(self) -> str:
        """A file of the results that changes with the package, with any input, and where a trial lacks other files than
        its last; it reruns everything, but what is kept. Snakemake need not watch inputs, whose names it may take for
        patterns, and parameters of rules would not do: it compares them only with what it ran from the same folder.
        """
        path, version = self.results / "logs" / "version", f"{code_hash()} {self.state}"
        figures = (f"figures/trial_{{}}.{form}" for form in self.settings.figures.formats)
        beside = [self.result(name) for name in ("tracks/{}.csv", "kinematics/{}.csv", *figures)]
        whole = [trial for trial in self.trials if Path(*self.files("<trials>", [trial])).exists()]
        torn = not all(Path(name.format(trial)).exists() for trial in whole for name in beside)
        if torn or not path.exists() or path.read_text(encoding="utf-8") != version:
            write_text(path, version)
        return path.as_posix()

    @property
    def jobs(self) -> dict[str, tuple[str, Stage, Sequence[str]]]:
        """Jobs by name: name of the stage, stage, trials; many trials are shared out over several jobs."""
        jobs: dict[str, tuple[str, Stage, Sequence[str]]] = {}
        for name, stage in STAGES.items():
            step = TRIALS_PER_JOB if name == "trials" else len(self.trials)
            parts = [self.trials[first : first + step] for first in range(0, len(self.trials), max(step, 1))] or [()]
            jobs |= {name if len(parts) == 1 else f"{name}_{k}": (name, stage, part) for k, part in enumerate(parts, 1)}
        return jobs

    def files(self, group: str, trials: Sequence[str] | None = None) -> list[str]:
        """Paths of a file, folder or group of files of the table of stages; of some trials alone, or of all. One file
        stands for those of a trial, the last that is written: Snakemake takes its time over each.
        """
        trials = self.trials if trials is None else trials
        if not group.startswith("<"):
            return [self.result(group)]
        if group == "<trials>":
            return [self.result(f"analysed/{trial}.json") for trial in trials]
        return [path.as_posix() for path in self.measurements]

    def result(self, *parts: str) -> str:
        """Path of a result."""
        return self.results.joinpath(*parts).as_posix()

    def settings_of(self, stage: Stage) -> str:
        """Settings that a stage depends on, as JSON; all but the paths, which have many spellings, if it names none."""
        chosen = set(stage.settings) or set(type(self.settings).model_fields) - {"experiment", "results"}
        return json.dumps(self.settings.model_dump(mode="json", include=chosen), sort_keys=True)


def input_files(experiment: Experiment) -> list[Path]:
    """The files of an experiment, whether they are there or not."""
    folder, settings = experiment.folder, experiment.settings
    effects = [folder / path for path in settings.effects]
    beside = [file for path in effects for file in sorted(path.parent.glob("*.py"))]  # which an effect may import
    target = getattr(settings.calibration, "image", None)
    targets = [] if target is None else [folder / target]
    measured = [path for trial in experiment.trials for path in (trial.track, trial.video, trial.pressure_trace)]
    files = [*(folder / name for name in SHARED_FILES), *filter(None, measured), *targets, *effects, *beside]
    return list(dict.fromkeys(files))


def make_plan(config: Mapping[str, Any], base: Path) -> WorkflowPlan:
    """Plan a run: read the settings and the sheet, and look at the input files."""
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.experiment.settings import run_settings

    # In a checkout, `data` lies beside the Snakefile, and two folders above the Snakefile of the package.
    base = base if (base / "data").is_dir() else PACKAGE.parent
    paths = {key: str(config[key]) for key in ("experiment", "results") if config.get(key) is not None}
    settings = run_settings({**config, **paths})
    folder = Path(settings.experiment)
    if not folder.exists() and find_ground_truth(base / folder, base):
        folder = base / folder
    ground_truth = find_ground_truth(folder, base)
    experiment = read_experiment(find_experiment(folder))
    results = Path(settings.results) if settings.results else Path("results") / experiment.name
    if problems := path_problems(folder, results):
        raise ExperimentError(problems)
    refuse_shared_results(results, folder)
    inputs = input_files(experiment)
    brought = {path for path in inputs if path.name in SHARED_FILES or path.suffix == ".py" or not ground_truth}
    stats = [(path.relative_to(folder).as_posix(), path.stat()) for path in inputs if path in brought and path.exists()]
    state = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return WorkflowPlan(
        experiment=folder,
        results=results,
        trials=tuple(name for name in experiment.names if name not in experiment.left_out),
        measurements=tuple(path for path in inputs if path not in brought),
        state=hashlib.sha256(repr(state).encode()).hexdigest(),
        settings=settings,
        ground_truth=ground_truth,
    )


def or_exit(function: Callable[..., Any], *given: Any) -> Any:
    """Call a function for the Snakefile; print its problems instead of a traceback and exit with status 1."""
    try:
        return function(*given)
    except ExperimentError as error:
        print("\n".join(format_problems(error.problems)), file=sys.stderr, flush=True)
        raise SystemExit(1) from None


def print_report_path(plan: WorkflowPlan, workflow: Any) -> None:
    """Print the path of a report newer than its inputs; not after a listing, a dry run, or a run that failed."""
    path = plan.results / "report.html"
    ran = workflow.execution_settings is not None and not workflow.dryrun and path.exists()
    if ran and path.stat().st_mtime >= Path(plan.version_file).stat().st_mtime:
        print(f"Report: {path}", flush=True)


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
        return [*self.recording_lines, *self.notes, *format_problems(self.problems, 20 - len(self.notes))]

    def to_json(self) -> dict[str, Any]:
        """Return the report for a program."""
        problems = [{key: value for key, value in vars(problem).items() if value} for problem in self.problems]
        told = {"recordings": self.recordings, "lines": self.recording_lines, "notes": self.notes}
        return {name: list(each) for name, each in told.items()} | {"problems": problems}


def check_folder(folder: Path, keep: Keep | None = None) -> CheckReport:
    """Check sheet, settings, effects, tracks and recordings of an experiment; `keep` keeps what is tracked."""
    from vinetrack.experiment.folder import SETTINGS, SHEET, check_experiment, read_experiment
    from vinetrack.inference.fit_data import not_measured
    from vinetrack.planning.predictive_inputs import pressure_problems
    from vinetrack.tracks.frame_timing import ends_short, longer_than_stated, mean_speed
    from vinetrack.tracks.importers import track_lines
    from vinetrack.tracks.position_noise import common_rounding_noise, detect_smoothing, low_passed
    from vinetrack.video.axis import askew_trials, axis_entry
    from vinetrack.video.survey import Surveyor, facts_entry, facts_rows, in_no_row

    surveyor = Surveyor(keep)
    tracks: list[tuple[Trial, Track]] = []
    problems = [*path_problems(folder.absolute()), *check_experiment(folder, surveyor, tracks)]
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError:
        return CheckReport(tuple(problems), (), (), ())
    problems += [*in_no_row(experiment), *model_problems(experiment)]
    entries = list(surveyor.facts.values())
    axes = {} if experiment.settings.axis else {entry.trial: axis_entry(entry.axis) for entry in entries if entry.axis}
    problems += [
        Problem("axis_askew", str(remark("axis_askew", count=agreed)), severity="warning", file=SHEET, trial=name)
        for name, agreed in askew_trials(axes, experiment.trials).items()
    ]
    problems += [
        Problem("not_measured", f"is left out of the fit: {why}", severity="warning", file=SHEET, trial=name)
        for name, why in not_measured(tracks).items()
    ]
    ends_s = {trial: facts.duration_s for trial, facts in surveyor.facts.items()}
    ends_s |= {trial: float(track.time_s[-1]) for trial, track in tracks}
    problems += [
        Problem("window", f"begins after the recording has ended, at {end_s:.3g} s: is it in seconds?", "steady",
                severity="warning", file=SHEET, trial=trial.name)
        for trial, end_s in ends_s.items() if trial.steady_window_s is not None and trial.steady_window_s[0] > end_s
    ]  # fmt: skip
    for told, severity in ((longer_than_stated(tracks), "warning"), (ends_short(tracks), "note")):
        if told:
            problems.append(Problem(told.code, str(told), "length_mm", severity=severity, file=SHEET))
    speeds = [(trial, entry.mean_speed_m_s) for trial, entry in surveyor.facts.items()]
    speeds += [(trial, mean_speed(track)) for trial, track in tracks]
    # The plausibility of a pressure depends on sizes and positions, so it is tested only if these have no errors.
    if not any(problem.severity == "error" or problem.code == "longer_than_the_vine" for problem in problems):
        for problem in pressure_problems(speeds):
            column = "pressure_kPa" if problem.column.startswith("pressure") else problem.column
            problems.append(replace(problem, file=SHEET if column in experiment.columns else SETTINGS))
    lines = facts_rows(entries, list(surveyor.facts)) if entries else []
    if 0 < len(surveyor.looked_into) < len(entries):
        lines.append(f"{len(surveyor.looked_into)} of {len(entries)} recordings were examined, one of each condition")
    notes = list(experiment.blank_notes)
    rounding_m = common_rounding_noise([track.lead_position_m[track.usable] for _, track in tracks])
    if smoothing := detect_smoothing(tracks, rounding_m):
        notes.append(str(remark("smoothed", how=str(smoothing), frames=smoothing.decimation)))
    elif filtered := low_passed(tracks):
        notes.append(str(filtered))
    if rounding_m > 0:
        notes.append(str(remark("rounded", step_m=math.sqrt(12) * rounding_m)))
    return CheckReport(tuple(problems), tuple(map(facts_entry, entries)), (*lines, *track_lines(tracks)), tuple(notes))


def model_problems(experiment: Experiment) -> list[Problem]:
    """Find problems of the effects that an experiment names in `model`, `candidates` or `effects`."""
    from vinetrack.dynamics.model import check_needs, make_model
    from vinetrack.effects import EffectError, find_effect

    settings = experiment.settings
    if not all((experiment.folder / path).exists() for path in settings.effects):
        return []
    column = "effects"
    try:
        user_effects = experiment.user_effects
        column = "candidates"
        for name in settings.candidates or ():
            find_effect(name, user_effects)
        column = "model"
        check_needs(make_model(settings.model, user_effects), *experiment.trials)
    except EffectError as error:
        return [Problem(message=str(error).rstrip("."), file="experiment.yaml", column=column)]
    return []


RUN = "VINETRACK_RUN"  # Variable that asks stages to say in a line what they have done


def run_paths(folder: Path, base: Path | None) -> tuple[Path, Path]:
    """Return the experiment folder and the results folder of a run, both absolute."""
    experiment = Path(os.path.normpath(find_experiment(folder).absolute()))
    results = (base or Path("results")).absolute() / (experiment.name or "experiment")
    refuse_shared_results(results, experiment)
    return experiment, results


def check_before_run(experiment: Path, results: Path, say: Say) -> None:
    """Print the problems of an experiment before its run; a check of the same files that found no error is kept."""
    from vinetrack.experiment.folder import read_experiment

    if results.is_dir():
        locked(results).release()  # refused, if another running process writes there
    if find_ground_truth(experiment, PACKAGE.parent):
        return  # The recordings of the demonstration do not exist yet: the run makes them.
    kept, files = Kept(results), []
    with contextlib.suppress(ExperimentError):
        files = input_files(read_experiment(experiment, strict=False))
    inside = experiment.resolve()
    linked = [path for path in files if not path.resolve().is_relative_to(inside)]
    report: CheckReport = kept.made(
        "check",
        (code_hash(), inside, [identity(path) for path in (experiment, *linked)]),
        lambda: check_folder(experiment, kept.track),
        lasts=lambda made: not made.failed,  # a fault may be mended without a change of a file
    )
    if report.failed:
        trials = {trial.name for trial in read_experiment(experiment).trials}
        faulty_trials = {problem.trial for problem in report.problems if problem.severity == "error"}
        if "" in faulty_trials or trials <= faulty_trials:  # "" stands for the experiment as a whole
            raise ExperimentError(report.problems)
    for line in replace(report, recording_lines=()).lines():
        say(line)


def run_chain(experiment: Path, results: Path, cores: int, say: Say, verbose: bool = False) -> None:
    """Run Snakemake on an experiment; show a progress bar on a terminal, a line per stage elsewhere, or all it says."""
    log = results / "logs" / "run.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    # Snakemake parses values of --config as YAML, where ` #2` in the name of a folder would be a comment.
    config_file = log.with_name("run.json")
    write_text(config_file, json.dumps({"experiment": str(experiment), "results": str(results)}))
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(PACKAGE / "pipeline" / "Snakefile"),
        "--directory", str(results), "--cores", str(cores), "--rerun-incomplete", "--nolock", "--configfile",
        str(config_file), *([] if verbose else ["--quiet", "all"]),
    ]  # fmt: skip
    # Its output is what the stages say, since it is quiet itself; when the user interrupts the run it stops its jobs.
    with (
        open(2, "w", closefd=False) if verbose else log.open("w", encoding="utf-8") as shown,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=shown, env=os.environ | {RUN: "1"}, encoding="utf-8"
        ) as process,
        waiting("starting") as bar,
    ):
        assert process.stdout is not None
        told = {COMPILING}
        for line in map(str.rstrip, process.stdout):
            if match := re.fullmatch(r"(\d+) of (\d+) (\w+)", line):  # what a stage says while it works
                bar.update(bar.task_ids[0], completed=int(match[1]), total=int(match[2]), description=match[3])
            elif line in told or line.partition(":")[0] in STAGES:  # what a stage has done
                say(line)
                told.discard(line)
            else:
                bar.remove_task(bar.task_ids[0])
                bar.add_task(line, total=None)
    if process.returncode:
        # 12: last lines of a run that failed which are printed (chosen)
        explanation = log.read_text(encoding="utf-8").splitlines()[-12:]
        raise UserError("\n".join([f"the run stopped; the logs of its stages are in {log.parent}", *explanation]))
