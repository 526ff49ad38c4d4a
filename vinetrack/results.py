"""Layout of a results folder: its files, their columns, and reading them; what it was made from, and by which run.

Names of trials are always text: `007` stays `007`, and a trial may be called `NaN`.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import vinetrack
from vinetrack.core.problems import ExperimentError, InputError, Problem, UserError
from vinetrack.core.records import Track, Trial
from vinetrack.core.tables import PROVENANCE, write_text

if TYPE_CHECKING:
    import pandas as pd
    from filelock import FileLock

    from vinetrack.diagnosis.result import Diagnosis
    from vinetrack.experiment.folder import Experiment
    from vinetrack.inference.fit_result import FitSummary


TRACK_COLUMNS = (
    "frame", "time_s", "edge_px", "lead_position_m", "lead_position_sigma_m", "flag", "tracked_edge_px",
    "lead_position_systematic_m", "pressure_Pa",
)  # fmt: skip
KINEMATICS_COLUMNS = (
    "time_s", "lead_position_m", "lead_velocity_m_s", "lead_velocity_sigma_m_s", "tail_velocity_m_s",
    "lead_acceleration_m_s2",
)  # fmt: skip
TRIALS_COLUMNS = (
    "trial", "vine", "condition", "status", "reason", "n_frames", "mm_per_px", "scale_rel_sigma", "noise_m",
    "steady_from_s", "steady_to_s", "steady_rule", "x_ss_m_s", "x_ss_sigma_m_s", "x_ss_paper_m_s", "cv", "force_N",
    "final_lead_velocity_m_s", "efficiency", "tube_width_mm", "growth_mm",
)  # fmt: skip
STEADY_COLUMNS = (
    "trial", "rule", "accepted", "from_s", "to_s", "points", "x_ss_m_s", "x_ss_sigma_m_s", "drift", "drift_95_low",
    "drift_95_high", "cv", "reason",
)  # fmt: skip
POINT_COLUMNS = (
    "trial", "vine", "condition", "diameter_mm", "thickness_um", "pressure_kPa", "window_pressure_kPa",
    "pressure_source", "x_ss_m_s", "x_ss_sigma_m_s", "force_N", "force_sigma_N", "yield_force_sigma_N",
    "scale_rel_sigma", "x_ss_paper_m_s", "force_paper_N", "eligible", "used", "reason",
)  # fmt: skip
TEXT_COLUMNS = frozenset({
    "trial", "vine", "condition", "status", "reason", "steady_rule", "rule", "flag", "pressure_source", "model",
    "term", "size", "note", "added", "parameter", "symbol", "unit", "against", "sentence", "row", "where",
    "quantity", "setting", "as_printed", "mark", "how", "beside", "figure", "departure", "method",
})  # fmt: skip
TRUTH_COLUMNS = frozenset({"accepted", "eligible", "used", "significant", "relative", "partial"})


class ResultsError(UserError):
    """A folder that is not a results folder, or lacks a file that is needed; one sentence with a remedy."""


class _File:
    """A file or folder of the results, as an attribute of `Results`."""

    def __init__(self, *parts: str) -> None:
        self.parts = parts

    def __get__(self, results: Results, _: type[Results]) -> Path:
        return results.folder.joinpath(*self.parts)


class _Named:
    """A file of each trial, condition or figure: a method of `Results` that takes its name, perhaps a suffix."""

    def __init__(self, folder: str, suffix: str = "", prefix: str = "") -> None:
        self.folder, self.suffix, self.prefix = folder, suffix, prefix

    def __get__(self, results: Results, _: type[Results]) -> Callable[..., Path]:
        def path(name: str, suffix: str = self.suffix) -> Path:
            if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", name):  # it could leave the folder
                raise InputError(f"{name[:40]!r} cannot name a file", "use letters, digits, _ and -")
            return results.folder / self.folder / f"{self.prefix}{name}{suffix}"

        return path


@dataclass(frozen=True)
class Results:
    """Paths of a results folder."""

    folder: Path

    trials = _File("trials.csv")  # One row per trial of the sheet
    steady = _File("steady.csv")  # Steady windows, one row per trial and rule
    points = _File("damping_points.csv")  # Points of the damping fit, with the reason if a point is not used
    conditions = _File("conditions.csv")  # Results of each condition, its replicates combined
    damping = _File("damping.json")  # The damping law by both methods
    scaling = _File("scaling.json")  # Scaling of B with the size of the vine
    fit = _File("fit.json")  # The model in use, fitted to the trajectories
    comparison = _File("comparison.csv")  # Comparison of model and measurement, one row per condition
    model_check = _File("model_check.csv")  # B and n from steady windows, compared with those from whole trajectories
    audit = _File("audit.csv")  # Size of neglected effects along the motion of each trial
    diagnosis = _File("diagnosis.json")  # The diagnosis of the model in use
    ladder = _File("ladder.csv")  # Errors of the initial model and of each later model
    kept_steps = _File(".kept", "steps.csv")  # As `diagnosis/steps.csv`, where a run does not begin by deleting it
    final_fit = _File("diagnosis", "final_fit.json")  # The fit with all added effects; exists only if there are any
    overlays = _File("overlays")  # Folder of the clips
    provenance = _File("provenance.json")  # Versions, settings and hashes of all inputs
    report = _File("report.html")  # The report

    track = _Named("tracks", ".csv")  # Positions of one leading edge
    kinematics = _Named("kinematics", ".csv")  # Motion of one leading edge
    analysed = _Named("analysed", ".json")  # A trial's contribution to the tables of the experiment
    trajectories = _Named("comparison", ".csv")  # Measured and modelled trajectories of one condition
    predictions = _Named("diagnosis/predictions", ".csv")  # Predictions of one trial, by the initial and final model
    overlay = _Named("overlays", ".mp4")  # The clip of one trial with the edges drawn
    figure = _Named("figures")  # A figure of the whole experiment
    trial_figure = _Named("figures", prefix="trial_")  # The figure of one trial
    strip_figure = _Named("figures", prefix="strip_")  # The strip of one recording with its tracked edge


def results_within(folder: Path) -> list[Path]:
    """The results folders that stand in a folder that is neither one itself nor an experiment."""
    if not folder.is_dir() or any((folder / name).exists() for name in ("trials.csv", "provenance.json")):
        return []
    return sorted(path.parent for path in folder.glob("*/provenance.json"))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Say in a sentence that a file is not there, or that it does not hold what a stage wrote."""
    try:
        yield
    except FileNotFoundError:
        if (path.parent / "trials.csv").exists() and not (path.parent / "experiment.json").exists():
            where = f"{path.parent} is an experiment: give its results, such as results/{path.parent.name}"
        elif within := results_within(path.parent):
            where = f"{path.parent} holds results folders: give one of them, such as {within[0]}"
        else:
            where = f"{path} does not exist: give a results folder, or write it with vinetrack run or snakemake"
        raise ResultsError(where) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        fault = str(error).partition("\n")[0] if isinstance(error, OSError | ValueError) else repr(error)
        raise ResultsError(f"{path} cannot be read ({fault}): delete it and run `vinetrack run` again") from None


def read_result(path: Path) -> pd.DataFrame:
    """Read a table that a stage wrote: text stays text, numbers are floats, truth values are bool."""
    import pandas as pd

    with _reading(path):
        with path.open(encoding="utf-8") as file:
            columns = file.readline().strip().split(",")
        numbers = [column for column in columns if column not in TEXT_COLUMNS | TRUTH_COLUMNS]
        kinds = {column: bool if column in TRUTH_COLUMNS else str for column in columns} | dict.fromkeys(numbers, float)
        blank = {column: ["", "NaN"] for column in numbers}
        return pd.read_csv(path, dtype=kinds, keep_default_na=False, na_values=blank)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that a stage wrote; see `read_result`. SI units; None for an unknown number."""
    with _reading(path):
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def table_of(columns: Sequence[str], rows: Sequence[Mapping[str, Any]] = ()) -> pd.DataFrame:
    """Return rows, or none, as a table with typed columns; a number that JSON stores as null becomes NaN."""
    import pandas as pd

    kinds = {
        column: "Int64" if column in ("n_frames", "points") else "bool" if column in TRUTH_COLUMNS else "float"
        for column in columns
        if column not in TEXT_COLUMNS
    }
    return pd.DataFrame(rows, columns=list(columns)).astype(kinds)


def read_fit(results: Results) -> FitSummary:
    """Read `fit.json` as a typed object; its only reader."""
    from vinetrack.inference.fit_result import FitSummary

    with _reading(results.fit):
        return FitSummary.from_json(read_json(results.fit))


def read_diagnosis(results: Results) -> Diagnosis | None:
    """Read `diagnosis.json` and `ladder.csv` as a typed object; their only reader. None if there is none."""
    from vinetrack.diagnosis.result import Diagnosis

    if not results.diagnosis.exists():
        return None
    ladder = read_result(results.ladder) if results.ladder.exists() else None
    with _reading(results.diagnosis):
        named = shlex.quote(min(str(results.folder), os.path.relpath(results.folder), key=len))
        content = read_json(results.diagnosis) | {"results": named}
        return Diagnosis.from_json(content, None if ladder is None or ladder.empty else ladder)


# ------------------------------------------------------------------------------
# The experiment that a results folder was made from, and its measured trials.


def read_source_experiment(folder: Path, experiment: Path | None = None) -> Experiment:
    """Read the experiment that a results folder was made from, as stated by its `provenance.json`."""
    from vinetrack.experiment.folder import read_experiment

    with _reading(Results(folder).provenance):
        path = experiment or Path(str(read_json(Results(folder).provenance)["experiment"]))
    if not path.is_dir():
        raise ResultsError(
            f"{folder} was made from {path}, which does not exist any more: give its new path with --experiment PATH"
        )
    return read_experiment(path)


def measured_trials(experiment: Experiment, results: Results) -> list[tuple[Trial, Track]]:
    """Read the trials that did not fail, with their tracks."""
    pairs, failed = [], set[str]()
    if results.trials.exists():
        gathered = read_result(results.trials)
        failed = set(gathered.loc[gathered["status"] == "failed", "trial"])
    for trial in experiment.trials:
        table = read_result(results.track(trial.name))
        if not len(table) or trial.name in failed:
            continue
        with _reading(results.track(trial.name)):
            names = ("time_s", "lead_position_m", "lead_position_sigma_m", "edge_px")
            columns: dict[str, Any] = {name: table[name].to_numpy(dtype=float) for name in names}
            for name in ("lead_position_systematic_m", "pressure_Pa"):  # not known where it is NaN in every frame
                values = table[name].to_numpy(dtype=float)
                columns[name] = values if np.isfinite(values).any() else None
            pairs.append((trial, Track(**columns, flag=table["flag"].to_numpy(dtype=str))))
    return pairs


# ------------------------------------------------------------------------------
# What a results folder was made from, and which run owns it: only one writes it at a time, and a killed run does not
# block the next one. A run holds a lock of the operating system as long as its process lives. Snakemake's own locks are
# files, which stay when a run is killed; the profile and `vinetrack run` do without them.

CLAIM_FILE = "experiment.json"  # File of a results folder that names its experiment from the start of a run


def refuse_shared_results(results: Path, experiment: Path) -> None:
    """Refuse a results folder that holds the results of another experiment."""
    other = "choose another results folder (vinetrack run --results DIR, snakemake --config results=DIR)"
    for name in (PROVENANCE, CLAIM_FILE):
        made_from = Path(str(claim(results / name).get("experiment", "")))
        if made_from.name and made_from.is_dir() and experiment.is_dir() and not made_from.samefile(experiment):
            message = f"holds the results of {made_from}, not of {experiment.absolute()}"
            remedy = f"{other}, or rename one of the two"
            raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)])


def claim(path: Path) -> dict[str, Any]:
    """Read what a file of the results says of its experiment; empty where there is nothing readable."""
    with suppress(OSError, ValueError, TypeError):
        return dict(json.loads(path.read_text(encoding="utf-8")))
    return {}


def locked(results: Path) -> FileLock:
    """Return the lock of a results folder, held by this process."""
    from filelock import FileLock, Timeout

    results.mkdir(parents=True, exist_ok=True)
    lock = FileLock(results.absolute() / ".run.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        process = claim(results / CLAIM_FILE).get("process", "unknown")
        message, remedy = f"is being written by another run, process {process}", "wait until it ends, or stop it"
        raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)]) from None
    return lock


def begin_run(results: Path, experiment: Path) -> FileLock:
    """Make this process the owner of a results folder until it ends, record that, and clean up after a killed run."""
    lock = locked(results)
    claim = {"experiment": experiment.absolute().as_posix(), "process": os.getpid()}
    write_text(results / CLAIM_FILE, json.dumps(claim))
    unfinished = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?")  # names of files that are being written
    for path in [*results.rglob("*"), *experiment.glob("*")]:
        with suppress(OSError):
            # 60.0: age from which an unfinished file counts as abandoned; others may be written now (chosen)
            if unfinished.fullmatch(path.name) and time.time() - path.stat().st_mtime >= 60.0:
                path.unlink()
    return lock


def describe_run(
    experiment: Path, inputs: Iterable[Path], settings: dict[str, Any], model: Iterable[str]
) -> dict[str, Any]:
    """Return the content of `provenance.json`: versions, platform, SHA-256 of every input, model, settings."""
    libraries = ("numpy", "scipy", "pandas", "numba", "av", "matplotlib", "opencv-python-headless")
    return {
        "vinetrack": vinetrack.__version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "libraries": {name: version(name) for name in libraries},
        "experiment": experiment.absolute().as_posix(),
        "inputs": {
            (path.relative_to(experiment) if path.is_relative_to(experiment) else path).as_posix(): _hash_file(path)
            for path in inputs
        },
        "model": list(model),
        "settings": settings,
    }


def _hash_file(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of a folder of frames; else "missing" or "unreadable"."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        lines = [f"{file.relative_to(path).as_posix()} {_hash_file(file)}\n" for file in files]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if not path.is_file():
        return "missing"
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "unreadable"
