"""Plan of a workflow for the Snakefile: the experiment, its trials, and the input and output files.

Imports stay light: Snakemake loads this module at every start and in every job.
"""

from __future__ import annotations

import atexit
import contextlib
import difflib
import hashlib
import json
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem, format_problems
from vinetrack.core.tables import is_readable, write_text
from vinetrack.figures.registry import figures_of

if TYPE_CHECKING:
    from filelock import FileLock

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
    usual = where.parent == Path("results").absolute()
    return shlex.join(command if usual else [*command, "--results", _shown(where.parent)])


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
    """Record to which experiment a results folder belongs, before the first result is written, and who writes it."""
    write_text(
        results / CLAIM_FILE, json.dumps({"experiment": experiment.absolute().as_posix(), "process": os.getpid()})
    )


def _claim(results: Path) -> dict[str, Any]:
    """Read what `claim_results` has written; empty where there is nothing readable."""
    try:
        content = json.loads((results / CLAIM_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


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
# A run holds a lock of the operating system as long as its process lives. Snakemake's own locks are files, which stay
# when a run is killed: those that are found where nobody holds the lock of the results are left over.

MIN_UNFINISHED_AGE_S = 60.0  # Age from which an unfinished file counts as abandoned; others may be written now (chosen)
RUN_LOCK = ".run.lock"

LOCK_REMOVED = "Removed the lock of an interrupted run"
# Temporary names of files that are being written
UNFINISHED_FILES = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?|\.part-.+")

# Options of Snakemake with which it executes no jobs, as its own parser names them
NON_EXECUTING_OPTIONS = (
    "dryrun", "unlock", "lint", "report", "summary", "detailed_summary", "dag", "rulegraph", "filegraph", "d3dag",
    "list_rules", "list_target_rules", "list_changes", "list_input_changes", "list_params_changes",
    "list_code_changes", "list_untracked", "archive", "cleanup_metadata", "cleanup_shadow", "delete_all_output",
    "delete_temp_output", "containerize", "print_compilation",
)  # fmt: skip


def executes_nothing(options: Sequence[str]) -> bool:
    """Whether Snakemake executes no jobs with these options, as in a dry run, a listing, or an unlock."""
    from snakemake.cli import get_argument_parser

    given, _ = get_argument_parser().parse_known_args(list(options))
    return any(getattr(given, name, None) not in (None, False) for name in NON_EXECUTING_OPTIONS)


def refuse_running(results: Path) -> None:
    """Refuse a results folder that another running process writes."""
    if results.is_dir():
        _locked(results).release()


def _locked(results: Path) -> FileLock:
    """Return the lock of a results folder, held by this process."""
    from filelock import FileLock, Timeout

    results.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(results.absolute() / RUN_LOCK, timeout=0)
        lock.acquire()
    except Timeout:
        process = _claim(results).get("process", "unknown")
        problem = Problem(
            message=f"is being written by another run, process {process}",
            file=str(results),
            remedy="wait until it ends, or stop it",
        )
        raise ExperimentError([problem]) from None
    return lock


def begin_run(results: Path, experiment: Path, working: Path, say: Callable[[str], None]) -> FileLock:
    """Make this process the owner of a results folder until it ends, and clean up after a killed run."""
    lock = _locked(results)
    claim_results(results, experiment)
    if _remove_locks(working, results):
        say(f"{LOCK_REMOVED}; the results that it finished are kept.")
    for path in [*results.rglob("*"), *experiment.glob("*")]:
        with contextlib.suppress(OSError):
            if UNFINISHED_FILES.fullmatch(path.name) and time.time() - path.stat().st_mtime >= MIN_UNFINISHED_AGE_S:
                path.unlink()
    return lock


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


# ------------------------------------------------------------------------------
# What the Snakefile asks: the plan of a run with its inputs and outputs.


@lru_cache(maxsize=1)
def code_hash(package: Path = PACKAGE) -> str:
    """Return a hash of the package, which as a parameter of every rule makes Snakemake rerun it after an edit."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


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
    def code(self) -> str:
        """Hash of the package: an edit of its code reruns everything."""
        return code_hash()

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
        if not self.published:
            return []
        titles = {name: one.title for name, one in figures_of("paper").items()}
        return [(titles[name], form, path) for name, form, path in self._figures(titles, "")]

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
    # An own effect may import what lies beside it.
    effects = [folder / path for path in experiment.settings.effects]
    effect_files = dict.fromkeys([*effects, *(file for path in effects for file in sorted(path.parent.glob("*.py")))])
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
        lock = begin_run(plan.results, plan.experiment, Path.cwd(), lambda line: print(line, flush=True))
    except ExperimentError as error:
        print("\n".join(format_problems(error.problems)), file=sys.stderr, flush=True)
        raise SystemExit(1) from None
    # At exit, since `onsuccess` runs before Snakemake's closing lines, and not at all if there was nothing to do.
    atexit.register(_print_report_path, plan)
    atexit.register(lock.release)


def keep_report_path_back() -> None:
    """Do not print the path of the report of an earlier run at the end of one that failed."""
    atexit.unregister(_print_report_path)


def _print_report_path(plan: WorkflowPlan) -> None:
    """Print the path of the report as the last line of this process, if it is newer than all inputs."""
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
