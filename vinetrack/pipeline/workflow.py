"""Plan of a workflow for the Snakefile: the experiment, its trials, and the input and output files.

Imports stay light: Snakemake loads this module at every start and in every job.
"""

from __future__ import annotations

import atexit
import json
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.files import is_readable
from vinetrack.core.problems import ExperimentError, format_problems
from vinetrack.figures.registry import PAPER_FIGURES
from vinetrack.pipeline.run_folders import (
    PACKAGE,
    find_experiment,
    find_ground_truth,
    has_wildcard,
    path_problems,
    refuse_shared_results,
)

if TYPE_CHECKING:
    from vinetrack.experiment.settings import RunSettings

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
    from vinetrack.pipeline.run_lock import begin_run, executes_nothing

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
