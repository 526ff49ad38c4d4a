"""Plan of a workflow for the Snakefile: the experiment, its trials, and the input and output files.

Imports stay light: Snakemake loads this module at every start and in every job.
"""

from __future__ import annotations

import atexit
import contextlib
import difflib
import fnmatch
import hashlib
import json
import os
import re
import shlex
import socket
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem, format_problems
from vinetrack.core.tables import is_readable, write_text
from vinetrack.figures.registry import PAPER_FIGURES

if TYPE_CHECKING:
    from vinetrack.experiment.settings import RunSettings


# ------------------------------------------------------------------------------
# The folders of a run: that of the experiment, and that of its results, which belong to one experiment only.

PACKAGE = Path(__file__).parents[1]

CLAIM_FILE = "experiment.json"  # File of a results folder that names its experiment from the start of a run


def find_experiment(folder: Path) -> Path:
    """Return `folder` if it exists."""
    if folder.exists():
        return folder
    parent = folder.absolute().parent
    while not parent.is_dir():
        parent = parent.parent
    folders = sorted(path.name for path in parent.iterdir() if path.is_dir() and not path.name.startswith("."))
    missing = folder.absolute().relative_to(parent).parts[0]
    close = difflib.get_close_matches(missing, folders, 1, 0.5)
    experiments = [name for name in folders if (parent / name / "trials.csv").is_file()][:3]
    if close:
        remedy = f"did you mean {_shown(parent / close[0])}?"
    elif experiments:
        remedy = f"existing experiments are {', '.join(_shown(parent / name) for name in experiments)}"
    else:
        remedy = f"the nearest existing folder is {_shown(parent)}"
    raise ExperimentError([Problem(message="does not exist", file=str(folder), remedy=remedy)])


def _shown(path: Path) -> str:
    return os.path.relpath(path)


def command_for_results(experiment: Path, results: Path) -> str:
    """Return the command that writes the results of an experiment to the folder where they are."""
    name, where = experiment.absolute().name, results.absolute()
    if where.name != name:
        return shlex.join(["snakemake", "--config", f"experiment={experiment}", f"results={results}"])
    command = ["vinetrack", "run", str(experiment)]
    beside = experiment.absolute().parent / "results"
    return shlex.join(command if where.parent == beside else [*command, "--results", _shown(where.parent)])


def find_ground_truth(folder: Path, base: Path) -> Path | None:
    """Return the ground truth of a shipped virtual experiment; None for any other folder. The virtual laboratory has a
    file for each folder of `data/` that it makes, with the same name.
    """
    for ground_truth in sorted((PACKAGE / "laboratory").glob("*.yaml")):
        shipped = base / "data" / ground_truth.stem
        if folder.exists() and shipped.exists() and folder.samefile(shipped):
            return ground_truth
    return None


def refuse_shared_results(results: Path, experiment: Path) -> None:
    """Refuse a results folder that holds the results of another experiment."""
    for name in ("provenance.json", CLAIM_FILE):
        try:
            made_from = Path(str(json.loads((results / name).read_text(encoding="utf-8"))["experiment"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if made_from.is_dir() and experiment.is_dir() and not made_from.samefile(experiment):
            message = f"holds the results of {made_from}, not of {experiment.absolute()}"
            remedy = (
                "choose another results folder (vinetrack run --results DIR, snakemake --config results=DIR), "
                "or rename one of the two"
            )
            raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)])


def claim_results(results: Path, experiment: Path) -> None:
    """Record to which experiment a results folder belongs, before the first result is written."""
    from vinetrack.core.tables import write_json

    write_json(results / CLAIM_FILE, {"experiment": experiment.absolute().as_posix()})


def path_problems(*folders: Path) -> list[Problem]:
    """Report folders whose path Snakemake would take for a pattern."""
    return [
        Problem(
            message="has braces or a word in < > in its path, which Snakemake cannot handle", file=str(folder),
            remedy="rename the folder, or run the stages one by one with vinetrack",
        )
        for folder in folders
        if has_wildcard(folder)
    ]  # fmt: skip


def has_wildcard(path: Path) -> bool:
    """Whether Snakemake would take part of a path for a wildcard or a variable, which cannot be escaped."""
    return re.search(r"[{}]|<\w+>", str(path)) is not None


# ------------------------------------------------------------------------------
# Ownership of a results folder: only one run writes it at a time, and a killed run does not block the next one.
#
# Snakemake locks the files of a run, but cannot tell later whether that run is still alive. Each run therefore records
# its process and the start time of that process in its results; a process id alone may be reused by another program.

START_TOLERANCE_S = 1.0  # Largest difference between two readings of the start time of one process (derived)
MIN_UNFINISHED_AGE_S = 60.0  # Age from which an unfinished file in the experiment folder counts as abandoned (chosen)
OWNER_FILE = ".run.json"  # File of a results folder that names the process writing it

LOCK_REMOVED = "Removed the lock of an interrupted run"
# Temporary names of files that are being written
UNFINISHED_FILES = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?|\.part-.+")


# Options of Snakemake with which it executes no jobs
NON_EXECUTING_OPTIONS = re.compile(
    r"-[a-zA-Z]*[nlhDS][a-zA-Z]*|--(dry-?run|unlock|lint|report|summary|detailed-summary|dag|rulegraph|filegraph|d3dag|list.*|help|"
    r"version|archive|print-compilation|cleanup-.*|delete-.*|containerize)(=.*)?"
)


@dataclass(frozen=True)
class RunOwner:
    """A process that runs a workflow: its id, its start time (s since 1970), and its computer."""

    pid: int
    started_s: float
    host: str

    @property
    def is_here(self) -> bool:
        """Whether it belongs to this computer, so that its state can be determined."""
        return self.host == socket.gethostname()

    @property
    def is_alive(self) -> bool:
        """Whether it is still running; a process of another computer is assumed to be."""
        if not self.is_here:
            return True
        started_s = _process_start_s(self.pid)
        return started_s is not None and abs(started_s - self.started_s) < START_TOLERANCE_S


def executes_nothing(options: Iterable[str]) -> bool:
    """Whether Snakemake executes no jobs with these options, as in a dry run, a listing, or an unlock."""
    return any(NON_EXECUTING_OPTIONS.fullmatch(option) for option in options)


def refuse_running(results: Path) -> None:
    """Refuse a results folder that another running process writes."""
    owner = _read_owner(results / OWNER_FILE)
    if owner is not None and owner.pid != os.getpid() and owner.is_alive:
        raise ExperimentError([_refusal(owner, results)])


def begin_run(results: Path, experiment: Path, working: Path, say: Callable[[str], None]) -> None:
    """Make this process the owner of a results folder, and clean up after a killed run. Removes the locks and the
    unfinished files of a run that has ended. The ownership ends with this process.
    """
    refuse_running(results)
    owner_file = (results / OWNER_FILE).absolute()  # Snakemake may change the working directory before it exits
    owner = _read_owner(owner_file)
    if owner is not None and owner.pid != os.getpid() and _remove_locks(working, results):
        say(f"{LOCK_REMOVED} (process {owner.pid}); the results that it finished are kept.")
    started_s = _process_start_s(os.getpid()) or time.time()
    write_text(owner_file, json.dumps(asdict(RunOwner(os.getpid(), started_s, socket.gethostname()))))
    atexit.register(_remove_owner_file, owner_file, os.getpid())
    clear_unfinished(results.rglob("*"))
    clear_unfinished(experiment.glob("*"), older_than_s=MIN_UNFINISHED_AGE_S)


def clear_unfinished(paths: Iterable[Path], older_than_s: float = 0.0) -> None:
    """Remove unfinished files of a program that was killed."""
    for path in [path for path in paths if UNFINISHED_FILES.fullmatch(path.name)]:
        with contextlib.suppress(OSError):
            if path.is_file() and time.time() - path.stat().st_mtime >= older_than_s:
                path.unlink()


def _remove_owner_file(owner_file: Path, pid: int) -> None:
    """Remove the owner file at exit, in the process that wrote it only, not in a fork of it."""
    if os.getpid() == pid:
        with contextlib.suppress(OSError):
            owner_file.unlink(missing_ok=True)


def _refusal(owner: RunOwner, results: Path) -> Problem:
    message = f"is being written by another run, process {owner.pid}"
    remedy = "wait until it ends, or stop it"
    if not owner.is_here:
        message += f" on the computer {owner.host}"
        remedy = f"wait until it ends; if it is no longer running, delete {results / OWNER_FILE}"
    since = time.strftime("%H:%M on %d %B", time.localtime(owner.started_s))
    return Problem(message=f"{message}, started at {since}", file=str(results), remedy=remedy)


def _read_owner(owner_file: Path) -> RunOwner | None:
    """Read the recorded owner; None if there is none, or the file cannot be read."""
    try:
        return RunOwner(**json.loads(owner_file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _remove_locks(working: Path, results: Path) -> int:
    """Remove Snakemake's locks on files of these results, not those of other results; return how many."""
    removed = 0
    inside = str(results.absolute()) + os.sep
    for lock in sorted((working / ".snakemake" / "locks").glob("*.lock")):
        with contextlib.suppress(OSError):
            files = lock.read_text(encoding="utf-8").splitlines()
            if any(str(working / file).startswith(inside) for file in files):
                lock.unlink()
                removed += 1
    return removed


def _process_start_s(pid: int) -> float | None:
    """Start time of a process, s since 1970; None if it does not exist or is a zombie."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else float(process.create_time())
    except psutil.Error:
        return None


# ------------------------------------------------------------------------------
# The code that a stage of the workflow depends on, found from its imports, so that an edit reruns outdated stages.
#
# Starting from the modules that a stage's command calls, every import of a vinetrack module is followed, including
# those
# inside functions but not those for the type checker only. A module also depends on files beside it that it names in a
# string: effects (`"*.py"`), templates, style sheets, YAML files.
#
# The sources are scanned with regular expressions: parsing 300 files takes 1.3 s, scanning those of all stages 0.15 s,
# and Snakemake waits for it at every start. A test compares the scan with the syntax trees of all files.

_EXPERIMENT_READERS = ("experiment.folder", "experiment.settings")
# Modules that the command of each stage calls
STAGE_MODULES = {
    "laboratory": ("laboratory.__main__",),
    "recording": ("pipeline.recordings_stage", *_EXPERIMENT_READERS),
    "tracks": ("pipeline.tracks_stage", *_EXPERIMENT_READERS),
    "gather": ("pipeline.tracks_stage", *_EXPERIMENT_READERS),
    "damping": ("pipeline.damping_stage", *_EXPERIMENT_READERS),
    "model": ("pipeline.model_stage", *_EXPERIMENT_READERS),
    "diagnosis": ("pipeline.diagnosis_stage", *_EXPERIMENT_READERS),
    "figures": ("pipeline.figures_stage", *_EXPERIMENT_READERS),
    "paper": ("pipeline.paper_stage", *_EXPERIMENT_READERS),
    "overlays": ("pipeline.overlays_stage", *_EXPERIMENT_READERS),
    "report": ("pipeline.report_stage", *_EXPERIMENT_READERS),
}

_TYPE_CHECKING_BLOCK = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t]+[^\n]*)?\n)+", re.MULTILINE)
_FROM = re.compile(r"^[ \t]*from (vinetrack[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(r"^[ \t]*import (vinetrack[\w.]*)", re.MULTILINE)
_RESOURCES = re.compile(r"""\bfiles\("(vinetrack[\w.]*)"\)""")
_STRING = re.compile(r'"([^"\n]+)"')
_PLACEHOLDER = re.compile(r"\{[^}]*\}")


def code_hash(stage: str, package: Path = PACKAGE) -> str:
    """Return a hash of the code of a stage, which as a parameter of its rule makes Snakemake rerun it after an edit."""
    digest = hashlib.sha256()
    for path in stage_files(stage, package):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + _content(path))
    return digest.hexdigest()[:16]


def stage_files(stage: str, package: Path = PACKAGE) -> list[Path]:
    """Return all files of the package that a stage runs or reads, sorted."""
    waiting = [path for name in STAGE_MODULES[stage] for path in _module_files(name, package)]
    reached: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in reached:
            reached.add(path)
            waiting.extend(_files_used(path, package))
    return sorted(reached)


@lru_cache(maxsize=1024)
def _files_used(path: Path, package: Path) -> tuple[Path, ...]:
    """Files of the package that one file imports or names; each file is scanned once per process."""
    if path.suffix != ".py":
        return ()
    text = _content(path).decode("utf-8")
    names = imported_names(text)
    modules = [file for name in names for file in _module_files(name, package)]
    resources = [file for name in _RESOURCES.findall(text) for file in _data_files(_folder(name, package))]
    return tuple(dict.fromkeys([*modules, *resources, *_named_beside(path, text)]))


def imported_names(text: str) -> set[str]:
    r"""Return the dotted names below `vinetrack` that a source imports at run time: modules and their members. `from
    vinetrack.core import published` gives `core` and `core.published`: the text alone does not tell whether `published`
    is a module.
    """
    text = _TYPE_CHECKING_BLOCK.sub("", text)
    names = set(_IMPORT.findall(text))
    for module, imported in _FROM.findall(text):
        names.add(module)
        names.update(f"{module}.{name}" for name in re.findall(r"(\w+)(?: as \w+)?", imported))
    return {name.removeprefix("vinetrack").lstrip(".") for name in names}


@lru_cache(maxsize=4096)
def _module_files(name: str, package: Path) -> tuple[Path, ...]:
    """File of a module and the `__init__.py` that Python runs before it; empty if the name is not a module. The
    `__init__.py` of vinetrack itself counts only if something is imported from it: it loads nothing.
    """
    if not name:
        return (package / "__init__.py",)
    folder = package.joinpath(*name.split("."))
    file = folder.with_suffix(".py")
    if file.is_file():
        init_file = file.with_name("__init__.py")
        return (file, init_file) if file.parent != package and init_file.is_file() else (file,)
    return (folder / "__init__.py",) if (folder / "__init__.py").is_file() else ()


def _folder(name: str, package: Path) -> Path:
    return package.joinpath(*name.split(".")[1:])


def _named_beside(path: Path, text: str) -> list[Path]:
    """Files beside a module, or folders of them, that it names in a string; `*` and `{…}` match any text."""
    neighbours = {entry.name: entry for entry in _entries(path.parent)}
    named: list[Path] = []
    for string in dict.fromkeys(_STRING.findall(text)):
        if string in neighbours:
            named.append(neighbours[string])
        elif "." in string and ("*" in string or "{" in string):
            pattern = _PLACEHOLDER.sub("*", string)
            # A pattern without a definite suffix (`*.*`, `*`) refers to files elsewhere.
            if re.search(r"\.\w+$", pattern):
                named += [neighbours[name] for name in fnmatch.filter(neighbours, pattern)]
    return [file for entry in named for file in (_data_files(entry) if entry.is_dir() else [entry])]


@lru_cache(maxsize=256)
def _entries(folder: Path) -> tuple[Path, ...]:
    """Files of a folder, and its subfolders that are not packages."""
    entries = [entry for entry in sorted(folder.iterdir()) if entry.name != "__pycache__"]
    return tuple(entry for entry in entries if entry.is_file() or not (entry / "__init__.py").exists())


def _data_files(folder: Path) -> list[Path]:
    """All files below a folder; of a package, only those that are not modules."""
    is_package = (folder / "__init__.py").exists()
    files: Iterable[Path] = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return [path for path in files if not (is_package and path.suffix == ".py")]


@lru_cache(maxsize=1024)
def _content(path: Path) -> bytes:
    return path.read_bytes()


def forget_scans() -> None:
    """Clear all caches, for a process in which the sources change."""
    for cached in (_files_used, _module_files, _entries, _content):
        cached.cache_clear()


# Additional tables of an experiment that is compared with published numbers
PAPER_TABLES = (
    "paper",
    "paper_departures",
    "paper_motions",
    "paper_means",
    "paper_positions",
    "paper_pressures",
    "paper_speeds",
    "paper_speed_curves",
)

SHARED_FILES = ("trials.csv", "experiment.yaml", "corrections.csv")

# The rules: `vinetrack run` runs this file from anywhere, and the Snakefile of a checkout includes it
SNAKEFILE = PACKAGE / "pipeline" / "Snakefile"

# Largest number of tracks analysed, or of trial figures drawn, in one job of the workflow (chosen)
TRIALS_PER_JOB = 100


@dataclass(frozen=True)
class WorkflowPlan:
    """Inputs and outputs of one run of the workflow. `trials` are all trials that get files (a trial with a faulty row
    gets empty ones); `filmed` maps those that are recordings to their input files, `track_inputs` the others to their
    tracks and traces.
    """

    experiment: Path
    results: Path
    trials: tuple[str, ...]
    filmed: Mapping[str, tuple[str, ...]]
    track_inputs: Mapping[str, tuple[str, ...]]
    inputs: tuple[Path, ...]
    unwatched: str
    settings: RunSettings
    ground_truth: Path | None
    published: bool

    @property
    def sheets(self) -> list[str]:
        """The trial sheet, and the settings and corrections if they exist."""
        return [path.as_posix() for path in self.inputs if path.name in SHARED_FILES]

    @property
    def own_effects(self) -> list[str]:
        """Files of the user's own effects."""
        return [path.as_posix() for path in self.inputs if path.suffix == ".py"]

    @property
    def measurements(self) -> list[str]:
        """Files that the virtual laboratory makes for a shipped experiment: recordings and a target, or tracks."""
        return [path.as_posix() for path in self.inputs if path.name not in SHARED_FILES]

    def result(self, *parts: str) -> str:
        """Path of a result."""
        return self.results.joinpath(*parts).as_posix()

    @property
    def tracked(self) -> tuple[str, ...]:
        """Trials that are not recordings."""
        return tuple(trial for trial in self.trials if trial not in self.filmed)

    def track_files(self, trials: Iterable[str]) -> list[str]:
        """Return the tracks and traces of trials that are not recordings."""
        return [path for trial in trials for path in self.track_inputs.get(trial, ())]

    @staticmethod
    def parts(stage: str, trials: Sequence[str]) -> dict[str, list[str]]:
        """Distribute trials over the jobs of a stage. Returns names of trials by name of the job, which is that of the
        stage if there is only one job.
        """
        shares = [list(trials[first : first + TRIALS_PER_JOB]) for first in range(0, len(trials), TRIALS_PER_JOB)]
        return {stage if len(shares) == 1 else f"{stage}_{number}": share for number, share in enumerate(shares, 1)}

    def per_trial(self, folder: str, suffix: str, trials: Iterable[str] | None = None) -> list[str]:
        """Return the path of one result for each trial."""
        return [self.result(folder, f"{trial}{suffix}") for trial in (self.trials if trials is None else trials)]

    @property
    def clips(self) -> list[str]:
        """The folder of clips, if there are recordings and the settings ask for clips."""
        return [self.result("overlays")] if self.filmed and self.settings.overlays.of != "none" else []

    @staticmethod
    def one_of(names: Iterable[str]) -> str:
        """Return a regular expression that matches exactly these names."""
        return "|".join(sorted(names)) or "there-is-none"

    @property
    def figure_list(self) -> str:
        """The list of the figures of the whole experiment that were drawn; figures without content are not."""
        return self.result("figures", "campaign.json")

    @property
    def paper_tables(self) -> list[str]:
        """Tables of the comparison with the paper; none if it was not requested."""
        return [self.result(f"{name}.csv") for name in PAPER_TABLES] if self.published else []

    def paper_figures(self) -> list[tuple[str, str, str]]:
        """Figures of the comparison with the paper: name, format and path."""
        return self._figures(PAPER_FIGURES, "") if self.published else []

    def trial_figures(self, trials: Iterable[str] | None = None) -> list[tuple[str, str, str]]:
        """Return the figures of single trials."""
        return self._figures(self.trials if trials is None else trials, "trial_")

    def figure_files(self) -> list[str]:
        """Paths of all figures."""
        figures = (*self.trial_figures(), *self._figures(self.filmed, "strip_"), *self.paper_figures())
        return [self.figure_list, *(path for _, _, path in figures)]

    def _figures(self, names: Iterable[str], prefix: str) -> list[tuple[str, str, str]]:
        formats = self.settings.figures.formats
        return [(name, form, self.result("figures", f"{prefix}{name}.{form}")) for name in names for form in formats]

    def stage_settings(self, *keys: str) -> str:
        """Settings that a stage depends on, as JSON; without keys, all but the paths. A stage reruns only if one of
        these changes. Paths are left out, since the same folder can be written in several ways.
        """
        chosen = set(keys) or set(type(self.settings).model_fields) - {"experiment", "results"}
        return json.dumps(self.settings.model_dump(mode="json", include=chosen), sort_keys=True)


def make_plan(config: Mapping[str, Any], base: Path) -> WorkflowPlan:
    """Plan a run: read the settings and the sheet, and list the input files."""
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
    is_virtual = ground_truth is not None
    experiment = read_experiment(find_experiment(folder))
    results = Path(settings.results) if settings.results else Path("results") / experiment.name
    if problems := path_problems(folder, results):
        raise ExperimentError(problems)
    refuse_shared_results(results, folder)
    trials = tuple(name for name in experiment.names if name not in experiment.left_out)
    files = (path for trial in experiment.trials for path in (trial.track, trial.video, trial.pressure_trace))
    present = (path for path in files if path is not None and (is_virtual or is_readable(path)))
    effect_files = (folder / path for path in experiment.settings.effects)
    shared = [path for path in (*(folder / name for name in SHARED_FILES), *effect_files) if is_readable(path)]
    target = getattr(experiment.settings.calibration, "image", None)
    targets = [folder / target] if target is not None and (is_virtual or is_readable(folder / target)) else []
    inputs = dict.fromkeys([*shared, *targets, *present])
    watched = {path: None for path in inputs if not has_wildcard(path)}
    filmed = {
        trial.name: tuple(
            path.as_posix()
            for path in (*shared, *targets, trial.video, trial.pressure_trace)
            if path is not None and path in watched
        )
        for trial in experiment.trials
        if trial.video is not None
    }
    track_inputs = {
        trial.name: tuple(
            path.as_posix() for path in (trial.track, trial.pressure_trace) if path is not None and path in watched
        )
        for trial in experiment.trials
        if trial.video is None
    }
    return WorkflowPlan(
        experiment=folder,
        results=results,
        trials=trials,
        filmed=filmed,
        track_inputs=track_inputs,
        inputs=tuple(watched),
        unwatched=_fingerprint(inputs),
        settings=settings,
        ground_truth=ground_truth,
        published=experiment.settings.published is not None,
    )


def _fingerprint(inputs: Iterable[Path]) -> str:
    """Size and modification time of the inputs that Snakemake cannot watch, so that their changes cause a rerun."""
    stats = [(path.name, path.stat()) for path in inputs if has_wildcard(path) and path.exists()]
    return ";".join(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in stats)


def make_plan_or_exit(config: Mapping[str, Any], base: Path) -> WorkflowPlan:
    """Call `make_plan`; print its problems in at most 20 lines and exit with status 1. For the Snakefile, where an
    exception would be printed with Snakemake's traceback.
    """
    try:
        return make_plan(config, base)
    except ExperimentError as error:
        print("\n".join(format_problems(error.problems)), file=sys.stderr)
        sys.stderr.flush()
        raise SystemExit(1) from None


def begin_run_or_exit(plan: WorkflowPlan) -> None:
    """Call `begin_run`; print a refusal and exit with status 1. For the Snakefile, like `make_plan_or_exit`. Nothing is
    begun if Snakemake executes no jobs (a dry run, for example), which only its command line tells.
    """
    if executes_nothing(sys.argv[1:]):
        return
    try:
        begin_run(plan.results, plan.experiment, Path.cwd(), lambda line: print(line, flush=True))
    except ExperimentError as error:
        print("\n".join(format_problems(error.problems)), file=sys.stderr, flush=True)
        raise SystemExit(1) from None


def print_report_path_at_exit(plan: WorkflowPlan, quiet: bool = False) -> None:
    """Print the path of the report as the last line of this process, if the report is newer than all inputs.
    Snakemake's `onsuccess` runs before its closing lines, and not at all if there was nothing to do.
    """
    if not quiet:
        atexit.register(_print_report_path, plan)


def _print_report_path(plan: WorkflowPlan) -> None:
    path = plan.results / "report.html"
    if not path.exists():
        return
    made = path.stat().st_mtime
    if all(source.stat().st_mtime <= made for source in plan.inputs if source.exists()):
        print(f"Report: {path}", flush=True)


def shell_prefix() -> str:
    """Return a prefix for all shell commands that puts this Python first in PATH: no environment need be activated."""
    return f'set -euo pipefail; export PATH={shlex.quote(str(Path(sys.executable).parent))}:"$PATH"; '.replace(
        "{", "{{"
    ).replace("}", "}}")
