"""What the Snakefile needs to know before anything runs: which experiment, which trials, which files.

Light on purpose: it is imported every time Snakemake looks at the workflow, before the first job.
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
"""Tables that an experiment gets besides where published numbers are set beside it."""

SHARED_FILES = ("trials.csv", "experiment.yaml", "corrections.csv")

SNAKEFILE = PACKAGE / "pipeline" / "Snakefile"
"""The rules, in the package: `vinetrack run` runs them from anywhere, the Snakefile of a checkout includes them."""

TRIALS_PER_JOB = 100
"""Chosen: trials that come as tracks, and trials whose figures are drawn, in one job of the workflow.

With every file that a job writes Snakemake notes all files that the job reads, 50 µs each: 1,000 trials in one job took
it six minutes, more than the work itself. At half there are twice as many processes to start, 2 to 4 s each; at twice,
twice as many notes a trial, 60 ms.
"""


@dataclass(frozen=True)
class WorkflowPlan:
    """One run of the workflow.

    `trials` are all that get files (those that failed at the sheet too, with empty ones); `filmed` those of them that
    come as recordings, each with its own inputs; `read_from` the tracks and traces of the others;
    `inputs` what all are read from; `unwatched` a fingerprint of inputs
    that cannot stand in a rule; `nature` what is true in a shipped virtual experiment, whose measurements are made on
    first use by the virtual laboratory, and None in anybody's own; `published` whether the paper's numbers are set
    beside those of this experiment.
    """

    experiment: Path
    results: Path
    trials: tuple[str, ...]
    filmed: Mapping[str, tuple[str, ...]]
    read_from: Mapping[str, tuple[str, ...]]
    inputs: tuple[Path, ...]
    unwatched: str
    settings: RunSettings
    nature: Path | None
    published: bool

    @property
    def sheets(self) -> list[str]:
        """The trial sheet and, where there are any, the settings and corrections beside it."""
        return [path.as_posix() for path in self.inputs if path.name in SHARED_FILES]

    @property
    def own_effects(self) -> list[str]:
        """Files of the user's own effects."""
        return [path.as_posix() for path in self.inputs if path.suffix == ".py"]

    @property
    def measurements(self) -> list[str]:
        """What the virtual laboratory makes of a shipped experiment's sheet: recordings and a target, or tracks."""
        return [path.as_posix() for path in self.inputs if path.name not in SHARED_FILES]

    def result(self, *parts: str) -> str:
        """Path of a result."""
        return self.results.joinpath(*parts).as_posix()

    @property
    def tracked(self) -> tuple[str, ...]:
        """Trials that do not come as recordings."""
        return tuple(trial for trial in self.trials if trial not in self.filmed)

    def track_files(self, trials: Iterable[str]) -> list[str]:
        """The tracks and traces of trials that do not come as recordings.

        Parameters
        ----------
        trials : names; one that failed at the sheet has no files.

        Returns
        -------
        list of str
            Paths.
        """
        return [path for trial in trials for path in self.read_from.get(trial, ())]

    @staticmethod
    def parts(stage: str, trials: Sequence[str]) -> dict[str, list[str]]:
        """Trials shared out over the jobs of a stage.

        Parameters
        ----------
        stage : its name.
        trials : names.

        Returns
        -------
        dict of str to list of str
            Names of the trials by the name of the job: the stage's own where one job does for all.
        """
        shares = [list(trials[first : first + TRIALS_PER_JOB]) for first in range(0, len(trials), TRIALS_PER_JOB)]
        return {stage if len(shares) == 1 else f"{stage}_{number}": share for number, share in enumerate(shares, 1)}

    def per_trial(self, folder: str, suffix: str, trials: Iterable[str] | None = None) -> list[str]:
        """One result for each of these trials, by default all.

        Parameters
        ----------
        folder : str
            Folder among the results.
        suffix : str
            End of each file's name.
        trials : iterable of str, optional
            Names; all trials by default.

        Returns
        -------
        list of str
            Paths.
        """
        return [self.result(folder, f"{trial}{suffix}") for trial in (self.trials if trials is None else trials)]

    @property
    def clips(self) -> list[str]:
        """The folder of clips, where there is anything to make one of and they are wanted."""
        return [self.result("overlays")] if self.filmed and self.settings.overlays.of != "none" else []

    @staticmethod
    def one_of(names: Iterable[str]) -> str:
        """A pattern that these names match and nothing else does.

        Parameters
        ----------
        names : iterable of str
            Names.

        Returns
        -------
        str
            Regular expression.
        """
        return "|".join(sorted(names)) or "there-is-none"

    @property
    def figure_list(self) -> str:
        """Which figures of the whole experiment had content: those without are not written."""
        return self.result("figures", "campaign.json")

    @property
    def paper_tables(self) -> list[str]:
        """Tables that set the paper's numbers beside ours; none where they were not asked for."""
        return [self.result(f"{name}.csv") for name in PAPER_TABLES] if self.published else []

    def paper_figures(self) -> list[tuple[str, str, str]]:
        """Figures that stand beside the paper's: name, format and path."""
        return self._figures(PAPER_FIGURES, "") if self.published else []

    def trial_figures(self, trials: Iterable[str] | None = None) -> list[tuple[str, str, str]]:
        """Figures of single trials.

        Parameters
        ----------
        trials : iterable of str, optional
            Names; all trials by default.

        Returns
        -------
        list of (str, str, str)
            Trial, format and path of each.
        """
        return self._figures(self.trials if trials is None else trials, "trial_")

    def figure_files(self) -> list[str]:
        """Paths of all figures."""
        figures = (*self.trial_figures(), *self._figures(self.filmed, "strip_"), *self.paper_figures())
        return [self.figure_list, *(path for _, _, path in figures)]

    def _figures(self, names: Iterable[str], prefix: str) -> list[tuple[str, str, str]]:
        formats = self.settings.figures.formats
        return [(name, form, self.result("figures", f"{prefix}{name}.{form}")) for name in names for form in formats]

    def stage_settings(self, *keys: str) -> str:
        """The settings a stage depends on, or all of them, as JSON: a change of others leaves its results alone.

        Paths are no settings of a stage: the same folder may be written with a slash at its end or without.
        """
        chosen = set(keys) or set(type(self.settings).model_fields) - {"experiment", "results"}
        return json.dumps(self.settings.model_dump(mode="json", include=chosen), sort_keys=True)


def make_plan(config: Mapping[str, Any], base: Path) -> WorkflowPlan:
    """Read the settings and the experiment's sheet.

    Parameters
    ----------
    config : mapping
        Snakemake's `config`, the command line included.
    base : Path
        Folder of the Snakefile; the shipped demonstration is found from there, wherever Snakemake is run.

    Returns
    -------
    Plan

    Raises
    ------
    ExperimentError
        With every problem of the settings, or else of the sheet.
    """
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.experiment.settings import run_settings

    # Beside the Snakefile of a checkout lies `data`; the rules of the package are two folders further down.
    base = base if (base / "data").is_dir() else PACKAGE.parent
    paths = {key: str(config[key]) for key in ("experiment", "results") if config.get(key) is not None}
    settings = run_settings({**config, **paths})
    folder = Path(settings.experiment)
    if not folder.exists() and find_ground_truth(base / folder, base):
        folder = base / folder
    nature = find_ground_truth(folder, base)
    is_virtual = nature is not None
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
    read_from = {
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
        read_from=read_from,
        inputs=tuple(watched),
        unwatched=_fingerprint(inputs),
        settings=settings,
        nature=nature,
        published=experiment.settings.published is not None,
    )


def _fingerprint(inputs: Iterable[Path]) -> str:
    """Size and time of the inputs that Snakemake cannot watch, so that a change of them is seen all the same."""
    stats = [(path.name, path.stat()) for path in inputs if has_wildcard(path) and path.exists()]
    return ";".join(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in stats)


def make_plan_or_exit(config: Mapping[str, Any], base: Path) -> WorkflowPlan:
    """`make_plan`, but what is wrong is printed in at most 20 lines and the process ends with status 1.

    For the Snakefile: an exception there would be printed with Snakemake's own stack.

    Parameters
    ----------
    config : mapping
        Snakemake's `config`.
    base : Path
        Folder of the Snakefile.

    Returns
    -------
    Plan
    """
    try:
        return make_plan(config, base)
    except ExperimentError as error:
        print("\n".join(format_problems(error.problems)), file=sys.stderr)
        sys.stderr.flush()
        raise SystemExit(1) from None


def begin_run_or_exit(plan: WorkflowPlan) -> None:
    """Call `begin_run`; print a refusal and exit with status 1. For the Snakefile, like `make_plan_or_exit`.

    Where Snakemake only shows what it would do nothing is begun; it does not tell a Snakefile, its command line does.

    Parameters
    ----------
    plan : of this run.
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
    """Let the last line of this process say where the report is, if it is there and no older than what it is made of.

    Snakemake's own `onsuccess` comes before its closing lines, and not at all where nothing had to be done.

    Parameters
    ----------
    plan
        Of this run.
    quiet : bool
        Say nothing.
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
    """Line before every shell command that puts this Python's programs first: no environment need be activated."""
    return f'set -euo pipefail; export PATH={shlex.quote(str(Path(sys.executable).parent))}:"$PATH"; '.replace(
        "{", "{{"
    ).replace("}", "}}")
