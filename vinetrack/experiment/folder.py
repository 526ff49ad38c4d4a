"""Reading and checking an experiment folder: sheet, settings and, on request, every track.

All problems are collected before an error is raised. A fault of the sheet or the settings stops the experiment; a fault
of a single row makes that trial `failed`, unless the experiment is `strict`.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vinetrack.core.problems import CLOSE_NAME_RATIO, ExperimentError, Problem
from vinetrack.core.records import CORRECTION_ACTIONS, IMAGES, Correction, Floats, Trial
from vinetrack.core.tables import (
    Table,
    TableError,
    file_size,
    list_recordings,
    missing_file_message,
    parse_number,
    read_table,
    safe_join,
)
from vinetrack.experiment.schema import COLUMNS, SHARED, unusual_value_hint, with_names
from vinetrack.experiment.settings import (
    ExperimentSettings,
    in_sheet_units,
    read_experiment_settings,
)
from vinetrack.experiment.sheet import (
    SHEET,
    Row,
    check_pressures,
    check_row,
    find_missing,
    make_trial,
    read_row,
    unknown_columns,
)
from vinetrack.tracks.importers import TrackError, load_track, read_pressure_trace, read_track

# ------------------------------------------------------------------------------
# The order in which trials were run, and whether it is confounded with pressure.
#
# A drift (wear of the tube, warming, a moving zero of the gauge) follows the order of the trials. If the pressure
# rises with the order, the data cannot distinguish such a drift from an effect of pressure.

CONFOUNDING_CORRELATION = 0.7  # Rank correlation above which order and pressure count as confounded (derived)

FEWEST_TRIALS = 8  # Fewest trials for which the correlation is computed (derived)

REMEDY = "run the trials in random order, or repeat six of them in random order, and number them under order"


def trial_order(trials: Sequence[Trial]) -> tuple[Floats, bool]:
    """Return the rank of every trial in the order in which they were run, and whether the sheet states that order.
    Returns ranks, stated: Ranks from 0, shape (n_trials,).
    """
    order = np.array([trial.order for trial in trials], dtype=float)
    stated = bool(order.size and np.isfinite(order).all() and np.unique(order).size == order.size)
    ranks = np.argsort(np.argsort(order)) if stated else np.arange(order.size)
    return ranks.astype(float), stated


def order_pressure_correlation(trials: Sequence[Trial]) -> float:
    """Return Spearman's rank correlation of order and set pressure within vines, pooled over all vines. Returns −1 to
    1; NaN if there are fewer than `FEWEST_TRIALS` trials, or each vine has only one pressure.
    """
    from scipy.stats import rankdata

    ranks, _ = trial_order(trials)
    pairs: list[Floats] = []
    for vine in dict.fromkeys(trial.vine for trial in trials):
        members = [i for i, trial in enumerate(trials) if trial.vine == vine and math.isfinite(trial.pressure_Pa)]
        pressures = np.array([trials[i].pressure_Pa for i in members])
        if len(members) > 1 and np.ptp(pressures) > 0:
            both = np.array([rankdata(ranks[members]), rankdata(pressures)])
            pairs.append((both - both.mean(axis=1, keepdims=True)) / len(members))
    if sum(pair.shape[1] for pair in pairs) < FEWEST_TRIALS:
        return math.nan
    order, pressure = np.hstack(pairs)
    return float(order @ pressure / math.sqrt(float(order @ order) * float(pressure @ pressure)))


def order_problems(trials: Sequence[Trial], file: str) -> Iterator[Problem]:
    """Warn of confounding: order with pressure, and specimen or day with condition."""
    correlation = order_pressure_correlation(trials)
    _, stated = trial_order(trials)
    if abs(correlation) >= CONFOUNDING_CORRELATION and stated:
        message = (
            f"follows the pressure (rank correlation {correlation:.2f}): a drift would look like a physical effect"
        )
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    elif abs(correlation) >= CONFOUNDING_CORRELATION:
        message = (
            f"is blank and the rows are sorted by pressure (rank correlation {correlation:.2f}): if the trials were "
            "run in this order, a drift would look like a physical effect"
        )
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    for column in ("specimen", "day"):
        if _confounded_with_condition(trials, column):
            message = f"differs for every condition: a difference between {column}s would look like a physical effect"
            remedy = f"spread every condition over two {column}s"
            yield Problem(message=message, file=file, column=column, severity="warning", remedy=remedy)


def _confounded_with_condition(trials: Sequence[Trial], column: str) -> bool:
    """Whether every condition has a single value of `specimen` or `day`, while values differ within a vine."""
    values = {(trial.vine, trial.condition, getattr(trial, column)) for trial in trials}
    if not values or any(not value for _, _, value in values):
        return False
    in_condition = Counter(condition for _, condition, _ in values)
    in_vine = Counter(vine for vine, _ in {(vine, value) for vine, _, value in values})
    return max(in_condition.values()) == 1 and max(in_vine.values()) > 1


# ------------------------------------------------------------------------------
# Manual corrections of tracked points: `corrections.csv` beside the trial sheet.
#
# One line per point: `trial, frame, action, edge_px`. The tracker applies the action and flags the point `corrected`;
# the position that it had found itself is kept in the results.

CORRECTIONS_FILE = "corrections.csv"
CORRECTION_COLUMNS = ("trial", "frame", "action", "edge_px")


def read_corrections(folder: Path) -> tuple[dict[str, tuple[Correction, ...]], list[Problem]]:
    """Read the corrections of an experiment. Returns corrections, problems : by name of trial, and what is wrong with
    the file; both empty if there is no file.
    """
    path = folder / CORRECTIONS_FILE
    if not os.path.lexists(path):
        return {}, []
    try:
        table = read_table(path)
    except TableError as error:
        return {}, [Problem.from_error(error, CORRECTIONS_FILE)]
    missing = [name for name in CORRECTION_COLUMNS if name not in table.columns]
    if missing:
        remedy = f"its columns are {', '.join(CORRECTION_COLUMNS)}"
        return {}, [
            Problem(message="is missing", code="missing", file=CORRECTIONS_FILE, column=missing[0], remedy=remedy)
        ]
    by_trial: dict[str, dict[int, Correction]] = {}
    problems: list[Problem] = []
    for i, row in enumerate(table.rows):
        correction = _read_line(table, i, problems)
        by_frame = by_trial.setdefault(row["trial"], {})
        if correction is None:
            continue
        if correction.frame in by_frame:
            problems.append(_problem(table, i, "frame", "is corrected twice", "keep one of the lines"))
        by_frame[correction.frame] = correction
    return {
        trial: tuple(by_frame[frame] for frame in sorted(by_frame)) for trial, by_frame in by_trial.items()
    }, problems


def _read_line(table: Table, index: int, problems: list[Problem]) -> Correction | None:
    """Read one line; None if it is faulty, in which case the fault is added to `problems`."""
    row = table.rows[index]
    if row["action"] not in CORRECTION_ACTIONS:
        remedy = f"write {', '.join(CORRECTION_ACTIONS[:-1])} or {CORRECTION_ACTIONS[-1]}"
        problems.append(_problem(table, index, "action", "is not an action", remedy))
        return None
    numbers = {}
    for column in ("frame", "edge_px"):
        if column == "edge_px" and row["action"] != "move":
            continue
        try:
            numbers[column] = parse_number(row[column], table.decimal)
        except TableError as error:
            problems.append(_problem(table, index, column, error.message, error.remedy))
            return None
    if numbers["frame"] < 0 or numbers["frame"] != int(numbers["frame"]):
        problems.append(_problem(table, index, "frame", "is not a frame number", "frames are counted 0, 1, 2, …"))
        return None
    return Correction(int(numbers["frame"]), row["action"], numbers.get("edge_px", math.nan))


def _problem(table: Table, index: int, column: str, message: str, remedy: str) -> Problem:
    row = table.rows[index]
    return Problem(
        message=message,
        file=CORRECTIONS_FILE,
        line=table.lines[index],
        trial=row["trial"],
        column=column,
        value=row[column],
        remedy=remedy,
    )


def unmatched_corrections(
    corrections: Mapping[str, object], names: Iterable[str], filmed: Iterable[str]
) -> list[Problem]:
    """Warn of corrections of a trial that is not in the sheet, or is not a recording."""
    in_sheet, recordings = set(names), set(filmed)
    return [
        Problem(
            message="is not a recording; its corrections are ignored"
            if trial in in_sheet
            else "is not in the sheet; its corrections are ignored",
            file=CORRECTIONS_FILE,
            column="trial",
            value=trial,
            severity="warning",
        )
        for trial in corrections
        if trial not in recordings
    ]


def corrections_text(corrections: Mapping[str, Iterable[Correction]]) -> str:
    """Return the content of `corrections.csv` for these corrections."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CORRECTION_COLUMNS)
    for trial, of_trial in corrections.items():
        for correction in of_trial:
            edge = f"{correction.edge_px:.2f}" if math.isfinite(correction.edge_px) else ""
            writer.writerow([trial, correction.frame, correction.action, edge])
    return out.getvalue()


SETTINGS = "experiment.yaml"
EXPECTED_FOLDER = (
    f"expected a folder with {SHEET} (one row per trial) and, for videos, {SETTINGS}; vinetrack setup FOLDER "
    "creates both from a folder of recordings"
)


@dataclass(frozen=True)
class Experiment:
    """An experiment: its settings and trials. `trials` are the trials to analyse, in the order of the sheet; `failed`
    maps the name of every faulty trial to the reason, and `left_out` that of every excluded one (`use: no`).
    """

    name: str
    folder: Path
    settings: ExperimentSettings
    trials: tuple[Trial, ...]
    failed: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    lines: dict[str, int] = field(default_factory=dict)
    angle_blank: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every trial of the sheet, in its order."""
        return tuple(self.lines)

    @property
    def blank_notes(self) -> list[str]:
        """Sentences that state which default blank cells stand for, where it affects the physics."""
        blank = [name for name in self.angle_blank if name not in self.left_out]
        if not blank:
            return []
        which = "all trials" if len(blank) == len(self.names) else f"{len(blank)} trials, {blank[0]} first"
        return [f"growth_angle_deg is blank ({which}): taken as 0, straight down; 90 is level, 180 straight up"]

    def trial(self, name: str) -> Trial:
        """Return the trial with this name."""
        return {trial.name: trial for trial in self.trials}[name]


def read_experiment(folder: Path | str, strict: bool | None = None) -> Experiment:
    """Read the sheet and settings of an experiment.

    Tracks are opened only if a pressure must be taken from them, videos never; see `check_experiment`.

    Parameters
    ----------
    folder : experiment folder.
    strict : whether a fault of one row stops the experiment; None for `strict` of the settings.

    Returns
    -------
    experiment : trials in SI units, failed trials with reasons, and all problems.

    Raises
    ------
    ExperimentError
        With all problems, if the sheet or the settings cannot be read, or if `strict` and any row has an error.

    Examples
    --------
    >>> import vinetrack as vt
    >>> vt.read_experiment("nowhere")
    Traceback (most recent call last):
    vinetrack.core.problems.ExperimentError: ...
    """
    folder = Path(folder)
    problems: list[Problem] = []
    settings = _read_settings(folder, problems)
    table = _read_sheet(folder, problems)
    rows = [read_row(table, i, settings or ExperimentSettings()) for i in range(len(table.rows))] if table else []
    absent: set[str] = set()
    for row in rows:
        if row.in_use:
            check_row(row, folder)
            # A value that the sheet lacks may stand in the settings, so this needs readable settings.
            absent |= find_missing(row, folder, table.columns) if table and settings else set()
    problems += _name_problems(rows)
    problems += [_absent_column(name) for name in COLUMNS if name in absent]
    corrections, faults = read_corrections(folder)
    problems += faults
    problems += unmatched_corrections(
        corrections, [row.name for row in rows], [row.name for row in rows if "video" in row.values]
    )
    sheet_is_sound = not any(problem.severity == "error" for problem in problems)
    for row in rows:
        if sheet_is_sound and row.in_use and not row.failed:
            _take_pressure_from_recording(row, folder)
            check_pressures(row)
    problems += [problem for row in rows for problem in row.problems]
    strict = strict if strict is not None else settings is not None and settings.strict
    if settings is None or not sheet_is_sound or (strict and any(row.failed and row.in_use for row in rows)):
        raise ExperimentError(problems)
    return _assemble(folder, settings, rows, problems, table.columns if table else (), corrections)


def _assemble(
    folder: Path,
    settings: ExperimentSettings,
    rows: list[Row],
    problems: list[Problem],
    columns: Iterable[str],
    corrections: Mapping[str, tuple[Correction, ...]],
) -> Experiment:
    """Sort the rows into trials to analyse, failed trials, and excluded ones."""
    good = [row for row in rows if row.in_use and not row.failed]
    trials = [make_trial(row, folder, settings) for row in good]
    trials = [replace(trial, corrections=corrections.get(trial.name, ()) if trial.video else ()) for trial in trials]
    errors = {row.name: [p.reason for p in row.problems if p.severity == "error"] for row in rows if row.in_use}
    return Experiment(
        name=Path(os.path.normpath(folder.absolute())).name or "experiment",
        folder=folder,
        settings=settings,
        trials=with_names(trials),
        failed={name: "; ".join(reasons) for name, reasons in errors.items() if reasons},
        left_out={row.name: "left out by the sheet (use: no)" for row in rows if not row.in_use},
        problems=tuple(problems),
        lines={row.name: row.line for row in rows},
        angle_blank=tuple(row.name for row in rows if "growth_angle_deg" not in row.values and row.travel_ratio == 2),
        columns=tuple(columns),
        recordings=tuple(row.values["video"] for row in rows if "video" in row.values),
    )


def _read_settings(folder: Path, problems: list[Problem]) -> ExperimentSettings | None:
    """Read the settings and check their paths and values; None if they cannot be read."""
    try:
        settings = read_experiment_settings(folder / SETTINGS, problems)
    except ExperimentError as error:
        problems += error.problems
        return None
    for key, relative in _settings_paths(settings):
        try:
            safe_join(folder, relative)
        except TableError as error:
            problems.append(Problem.from_error(error, SETTINGS, column=key, value=relative))
    for name in SHARED:
        value = getattr(settings, name)
        if COLUMNS[name].kind == "number" and value is not None and (hint := unusual_value_hint(COLUMNS[name], value)):
            place: dict[str, Any] = {"file": SETTINGS, "column": name, "value": f"{value:g}"}
            problems.append(Problem(message=f"is unusual: {hint}", severity="warning", **place))
    return settings


def _settings_paths(settings: ExperimentSettings) -> list[tuple[str, str]]:
    """Return the (key, path) pairs of all paths in the settings."""
    image = getattr(settings.calibration, "image", None)
    paths = [("effects", path) for path in settings.effects]
    return [*paths, ("calibration.image", image)] if image is not None else paths


def _read_sheet(folder: Path, problems: list[Problem]) -> Table | None:
    """Read the sheet as a table and check its columns; None if it cannot be read."""
    if not folder.is_dir():
        message = "is a file, not a folder" if folder.exists() else "does not exist"
        problems.append(Problem(message=message, file=str(folder), remedy=EXPECTED_FOLDER))
        return None
    if not os.path.lexists(folder / SHEET):
        problems.append(Problem(message="is missing", code="missing", file=SHEET, remedy=_missing_sheet_remedy(folder)))
        return None
    try:
        table = read_table(folder / SHEET)
    except TableError as error:
        problems.append(Problem.from_error(error, SHEET))
        return None
    table, converted = in_sheet_units(table, SHEET)
    problems += [*converted, *_judge_columns(table)]
    return table


def _missing_sheet_remedy(folder: Path) -> str:
    """Remedy for a missing sheet: rename a file with a similar name, else what a folder should contain."""
    try:
        names = sorted(path.name for path in folder.iterdir())
    except OSError:
        return "allow its folder to be read"
    close = difflib.get_close_matches(SHEET, [name for name in names if "tri" in name.lower()], 1, 0.5)
    if close and not close[0].endswith(".csv"):
        return f"save {close[0]} as {SHEET}"
    if close:
        return f"rename {close[0]} to {SHEET}"
    return EXPECTED_FOLDER if names else f"the folder is empty; {EXPECTED_FOLDER}"


def _judge_columns(table: Table) -> list[Problem]:
    """Return the problems of the header, and report a sheet without rows."""
    problems = unknown_columns(table, SHEET)
    if table.nameless:
        problems.append(
            Problem(message="has a column without a name, which is ignored", file=SHEET, severity="warning")
        )
    if "trial" not in table.columns:
        problems.append(_absent_column("trial"))
    if not {"video", "track"} & set(table.columns):
        message = "has neither a column video nor a column track"
        problems.append(Problem(message=message, file=SHEET, remedy="add the one that applies"))
    if not table.rows:
        problems.append(Problem(message="has no rows", file=SHEET, remedy="write one row per trial below the header"))
    return problems


def _absent_column(name: str) -> Problem:
    remedy = f"add the column {name}" + ("" if name == "trial" else f", or the key to {SETTINGS}")
    return Problem(message="is missing", code="missing", file=SHEET, column=name, remedy=remedy)


def _name_problems(rows: list[Row]) -> list[Problem]:
    """Report repeated names (errors) and names that differ only in case (warnings)."""
    problems, seen = [], dict[str, Row]()
    for row in rows:
        first = seen.setdefault(row.name.lower(), row)
        if first is row:
            continue
        place: dict[str, Any] = {"file": SHEET, "trial": row.name, "column": "trial", "value": row.name}
        if first.name == row.name:
            message = f"is also the name of line {first.line}"
            problems.append(
                Problem(message=message, line=row.line, remedy="give every trial a name of its own", **place)
            )
        else:
            message = f"differs from {first.name!r} on line {first.line} in case only, which some file systems ignore"
            problems.append(Problem(message=message, line=row.line, severity="warning", **place))
    return problems


def _take_pressure_from_recording(row: Row, folder: Path) -> None:
    """Set a blank pressure to the first value of the measured trace, to three digits, as the nominal pressure."""
    if "pressure_kPa" in row.values or row.travel_ratio == 1:
        return
    column = "pressure_trace" if "pressure_trace" in row.values else "track"
    path = safe_join(folder, row.values[column])
    try:
        pressure = read_pressure_trace(path)[1] if column == "pressure_trace" else read_track(path).pressure_Pa
    except TrackError as error:
        row.problems.append(
            Problem.from_error(error, SHEET, trial=row.name, line=row.line, column=column, value=row.values[column])
        )
        return
    if pressure is None:
        remedy = "fill it in, or give the track a column pressure_kPa"
        row.add("is blank, and the track carries no pressure", "pressure_kPa", remedy=remedy)
        return
    nominal_kPa = float(f"{float(pressure[0]) / 1000:.3g}")
    if nominal_kPa < 0:
        remedy = f"fill it in: the measured pressure starts at {nominal_kPa:g} kPa, below zero"
        row.add("is blank", "pressure_kPa", code="blank", value="", remedy=remedy)
        return
    row.values["pressure_kPa"] = nominal_kPa


def _in_no_row(experiment: Experiment) -> list[Problem]:
    """Warn of recordings in the folder that neither a row of the sheet nor the calibration names."""
    paths = [*experiment.recordings, *(path for _, path in _settings_paths(experiment.settings))]
    named = {_normal(experiment.folder, path) for path in paths}
    named |= {path.parent for path in named if path.suffix.lower() in IMAGES}  # the first picture of a burst
    named |= {path.with_suffix(".mraw") for path in named if path.suffix.lower() in (".cih", ".cihx")}
    found = [name for name in list_recordings(experiment.folder) if _normal(experiment.folder, name) not in named]
    if not found:
        return []
    more = f" and {len(found) - 5} more" if len(found) > 5 else ""
    message = f"names no trial for {', '.join(found[:5])}{more}"
    remedy = "add a row for each, with `use: no` if it is to be left out, or move it elsewhere"
    return [Problem(message=message, file=SHEET, column="video", severity="warning", remedy=remedy)]


def _normal(folder: Path, name: str) -> Path:
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


OpenRecordings = Callable[[Experiment, list[Trial]], Iterable[Problem]]


def check_experiment(folder: Path | str, open_videos: OpenRecordings | None = None) -> list[Problem]:
    """Find all problems of sheet, settings and tracks, and missing videos; this takes seconds."""
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError as error:
        return list(error.problems)
    problems = list(experiment.problems)
    for key, relative in _settings_paths(experiment.settings):
        if not safe_join(experiment.folder, relative).exists():
            message, remedy = missing_file_message(safe_join(experiment.folder, relative))
            problems.append(Problem(message=message, file=SETTINGS, column=key, value=relative, remedy=remedy))
    problems += [*order_problems(experiment.trials, SHEET), *_in_no_row(experiment)]
    trial_problems: list[Problem] = []
    readable: list[Trial] = []
    named_videos = {trial.video for trial in experiment.trials if trial.video}
    for trial in experiment.trials:
        of_trial = _check_track(trial) if trial.track else _check_video(trial, named_videos)
        trial_problems += [replace(problem, trial=trial.name) for problem in of_trial]
        if trial.video and not of_trial:
            readable.append(trial)
    if readable and open_videos is not None:
        trial_problems += open_videos(experiment, readable)
    return problems + [_with_location(problem, experiment) for problem in trial_problems]


def _with_location(problem: Problem, experiment: Experiment) -> Problem:
    """Add the location to a trial's problem: its line in the sheet, or the settings if only they state the value."""
    if not problem.trial:
        return problem
    if problem.column in SHARED and problem.column not in experiment.columns:
        return replace(problem, file=SETTINGS)
    return replace(problem, file=SHEET, line=experiment.lines[problem.trial])


def _check_track(trial: Trial) -> list[Problem]:
    """Read a track with its pressure, and warn where it contradicts the sheet."""
    place: dict[str, Any] = {"column": "track", "value": trial.track.name if trial.track else ""}
    try:
        track = load_track(trial)
    except TrackError as error:
        return [Problem.from_error(error, SHEET, **place)]
    remarks = []
    frames = float(np.median(np.diff(track.time_s))) * trial.capture_fps
    if abs(frames - 1) > 0.02:
        remarks.append(f"has points {frames:.4g} frames apart at this capture_fps: is capture_fps right?")
    travel_m = float(np.ptp(track.lead_position_m[track.usable]))
    # A factor of 2 allows for a poor scale or axis, but not for millimetres read as metres.
    if travel_m > 2 * trial.length_m:
        remarks.append(
            f"travels {travel_m:.4g} m, but the vine is {trial.length_m:g} m long: are its positions in metres?"
        )
    if track.lead_position_m[track.usable][-1] < track.lead_position_m[track.usable][0]:
        remarks.append("runs backwards: position should grow as the vine does")
    if track.pressure_Pa is not None and trial.pressure_Pa > 0:
        highest_kPa = float(np.max(track.pressure_Pa)) / 1000
        if not 0.5 < highest_kPa / (trial.pressure_Pa / 1000) < 2:
            remarks.append(
                f"has pressures up to {highest_kPa:.4g} kPa, but the sheet says {trial.pressure_Pa / 1000:g} kPa"
            )
    return [Problem(message=message, severity="warning", **place) for message in remarks]


def _check_video(trial: Trial, named_videos: Set[Path]) -> list[Problem]:
    """Check that a recording exists and is not empty; `named_videos` are the recordings named by any trial."""
    path = trial.video
    if path is None:
        return []
    place: dict[str, Any] = {"column": "video", "value": path.name}
    try:
        if path.is_dir():
            empty = not any(path.iterdir())
            return [Problem(message="is an empty folder", remedy="put the frames in it", **place)] if empty else []
        if file_size(path) == 0:
            return [Problem(message="is an empty file", remedy="copy it again", **place)]
    except (FileNotFoundError, ValueError):
        message, remedy = missing_file_message(path)
        remedy = remedy if path.is_symlink() else _missing_video_remedy(path, named_videos)
        return [Problem(message=message, remedy=remedy, **place)]
    except OSError as error:
        return [Problem(message=f"cannot be read: {error.strerror}", **place)]
    return []


def _missing_video_remedy(path: Path, named_videos: Set[Path]) -> str:
    """Remedy for a missing recording: a similar name in its folder that no other trial uses, if there is one."""
    try:
        names = sorted(entry.name for entry in path.parent.iterdir() if entry not in named_videos)
    except (OSError, ValueError):
        names = []
    close = difflib.get_close_matches(path.name.lower(), [name.lower() for name in names], 1, CLOSE_NAME_RATIO)
    if not close:
        return "check the path and its upper and lower case"
    return f"did you mean {next(name for name in names if name.lower() == close[0])}?"
