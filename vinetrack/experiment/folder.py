"""An experiment folder: the rows of its sheet, its settings, corrections and, on request, every track.

All problems are collected before an error is raised. A fault of the sheet or the settings stops the experiment; a fault
of a single row makes that trial `failed`, unless the experiment is `strict`. Recordings are never opened here.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core import tables
from vinetrack.core.problems import ExperimentError, InputError, Problem, joined
from vinetrack.core.records import CAMERA_FILES, SIDE_FILES, Correction, Floats, Track, Trial
from vinetrack.core.tables import Table, parse_number, read_table, safe_join
from vinetrack.core.units import UNITS, convert, pressure_text
from vinetrack.experiment.schema import COLUMNS, GROUPINGS, SHARED, did_you_mean, option, with_names
from vinetrack.experiment.settings import Board, ExperimentSettings, in_sheet_units, read_experiment_settings
from vinetrack.tracks.importers import load_track, read_pressure_trace, read_track

if TYPE_CHECKING:
    from vinetrack.effects import Effect


# ------------------------------------------------------------------------------
# Rows of the trial sheet: reading their cells, checking them, and making trials of them.


SHEET = "trials.csv"

# Columns that a trial of an everting vine requires; a body that moves as a whole requires the diameter only
REQUIRED_COLUMNS = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa")

YIELD_SIGMA_KPA = 0.2  # Default standard error of a yield pressure (chosen)


@dataclass
class Row:
    """A row while it is checked: values by column, in the unit of the column, without blank ones, and problems."""

    name: str
    line: int
    pressure_unit: str = "kPa"
    values: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    @property
    def faulty(self) -> set[str]:
        """Columns that have an error; a blank for one of the row as a whole."""
        return {problem.column for problem in self.problems if problem.severity == "error"}

    @property
    def given(self) -> set[str]:
        """Columns that have a value, or an error."""
        return {*self.values, *self.faulty}

    @property
    def in_use(self) -> bool:
        """Whether the trial is to be analysed; False for `use: no`."""
        return bool(self.values.get("use", True))

    @property
    def travel_ratio(self) -> float:
        """Travel ratio of row or settings; 2 by default."""
        return self.number("travel_ratio", 2.0)

    def number(self, column: str, blank: float = math.nan) -> float:
        """Return the number of a column."""
        return float(self.values.get(column, blank))

    def add(self, code: str, message: str, column: str = "", severity: str = "error", **details: Any) -> None:
        """Record a problem of this row."""
        place: dict[str, Any] = {"file": SHEET, "trial": self.name, "line": self.line}
        self.problems.append(Problem(code, message, column, severity=severity, **place, **details))

    def add_error(self, error: InputError, column: str, value: str | None = None) -> None:
        """Record why the value of a column cannot be used."""
        self.add(error.code, error.message, column, value=value, allowed=error.allowed, remedy=error.remedy)

    def add_blank(self, columns: Sequence[str], remedy: str = "fill it in", severity: str = "error") -> None:
        """Report required columns that have no value, unless another problem already concerns them."""
        code = "blank" if self.line else "missing"  # a row that stands in no file has no blank cells
        for name in columns:
            if name not in self.given:
                told = f"{COLUMNS[name].if_blank}; {remedy}".lstrip("; ")
                self.add(code, f"is {code}", name, severity, value="", allowed=COLUMNS[name].allowed, remedy=told)

    def check(self) -> None:
        """Check the row as a whole: one recording or track, values that agree."""
        given = self.given
        if {"video", "track"} <= given:
            message, remedy = "has both a video and a track", "keep one of the two"
            self.add("two_recordings", message, "track", value=self.values.get("track"), remedy=remedy)
        elif not {"video", "track"} & given:
            remedy = "name a recording under video, or a file of positions under track"
            self.add("no_recording", "has neither a video nor a track", remedy=remedy)
        self.check_wall()
        fps, exposure = self.number("capture_fps"), self.number("exposure_us")
        # An exposure cannot exceed the frame interval. 2 % allows for rounding of both numbers; above 1.5 intervals
        # rounding cannot be the reason.
        if exposure > 1.02e6 / fps:
            intervals = exposure * fps / 1e6
            message = f"is {intervals:.3g} times the frame interval at {fps:g} frames per second ({1e6 / fps:.4g} µs)"
            severity, remedy = ("error", "check its unit and capture_fps") if intervals > 1.5 else ("warning", "")
            self.add("longer_than_a_frame", message, "exposure_us", severity, value=f"{exposure:g}", remedy=remedy)

    def find_missing(self, folder: Path, columns: tuple[str, ...]) -> set[str]:
        """Report required cells that are blank; return required columns that neither sheet nor settings have."""
        if "travel_ratio" in self.faulty:
            return set()
        required = list(REQUIRED_COLUMNS if self.travel_ratio == 2 else REQUIRED_COLUMNS[:1])
        if "pressure_kPa" in required and {"pressure_trace", "track"} & self.given:
            required.remove("pressure_kPa")
        self.add_blank([name for name in required if name in columns])
        if "video" in self.values and "track" not in self.values and not _may_state_rate(folder, self.values["video"]):
            required.append("capture_fps")
            remedy = "write the capture rate; the rate stored in the file is that of playback"
            self.add_blank(["capture_fps"] if "capture_fps" in columns else [], remedy)
        return set(required) - set(columns) - set(self.values)

    def check_wall(self) -> None:
        """Report a wall thickness above a quarter of the diameter, which no tube can have."""
        diameter, thickness = self.number("diameter_mm"), self.number("thickness_um")
        if thickness / 1000 > diameter / 4:
            message = f"is more than a quarter of the diameter ({diameter:g} mm)"
            allowed, remedy = f"at most {250 * diameter:g} µm", "check the units: thickness in µm, diameter in mm"
            self.add("wall", message, "thickness_um", value=f"{thickness:g}", allowed=allowed, remedy=remedy)

    def check_pressures(self) -> None:
        """Warn of pressures that are allowed but implausible."""
        pressure, yield_pressure = self.number("pressure_kPa"), self.number("yield_pressure_kPa")
        if self.travel_ratio == 1:
            message = "is above 0 although the body moves as a whole (travel_ratio 1): is it a vine?"
            if pressure > 0:
                self.add("pressure_of_a_body", message, "pressure_kPa", "warning", value=f"{pressure:g}")
            return
        if yield_pressure >= pressure:
            message = "is not below the pressure, nothing would grow: check both units (1 bar is 100 kPa, 1 psi 6.895)"
            value = pressure_text(1e3 * yield_pressure, self.pressure_unit)
            self.add("no_growth", message, "yield_pressure_kPa", "warning", value=value)
        if pressure > 0 and yield_pressure == 0 and not self.values.get("yield_pressure_sigma_kPa"):
            message = "states that the vine grows at any pressure, which no vine does, with an error of 0.2 kPa"
            remedy = "measure it (raise the pressure until the tip moves), or state yield_pressure_sigma_kPa"
            self.add("no_yield_pressure", message, "yield_pressure_kPa", "warning", value="0", remedy=remedy)


def read_row(table: Table, index: int, settings: ExperimentSettings) -> Row:
    """Read and check the cells of one row; shared settings fill blank cells. An invalid name gives way to the line."""
    cells, line = table.rows[index], table.lines[index]
    name, unit = cells.get("trial", f"line-{line}"), table.units.get("pressure_kPa", "kPa")
    if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}", name, re.ASCII):
        row = Row(name, line, unit)
    else:
        row = Row(f"line-{line}", line, unit)
        code, message = ("name", "is not a valid trial name") if name else ("blank", "is blank")
        remedy = "at most 100 characters, no spaces or dots, no hyphen first: files are named after it"
        row.add(code, message, "trial", value=name, allowed=COLUMNS["trial"].allowed, remedy=remedy)
    for name, column in COLUMNS.items():
        typed = text = cells.get(name, "")
        if text and (of_column := table.units.get(name)):
            with suppress(InputError):  # as it stands in the sheet, in the unit of its column
                value = convert(parse_number(text, table.decimal), column.unit_key, of_column)
                typed = f"{value:.6g} {UNITS[of_column].text}"
        try:
            if text:
                row.values[name] = column.read(text, table.decimal, table.units.get(name, ""))
                if said := column.unusual(row.values[name], table.units.get(name, "")):
                    row.add("unusual", said, name, "warning", value=typed)
            elif name in SHARED and (shared := getattr(settings, name)) is not None:
                row.values[name] = shared
        except InputError as error:
            row.add_error(error, name, typed)
    if table.extra[index]:
        remedy = "put text that contains separators, and decimal commas, in quotes, or remove separators at its end"
        row.add("more_cells", "has more cells than the header", remedy=remedy)
    if not row.in_use:
        row.problems = [replace(problem, severity="warning") for problem in row.problems]
    return row


def read_sheet(path: Path) -> tuple[Table, list[Problem]]:
    """Read a sheet in the units of its columns, and what is wrong with its columns; unknown ones are ignored."""
    try:
        table, problems = in_sheet_units(read_table(path), path.name)
    except InputError as error:
        raise ExperimentError([Problem.from_error(error, path.name)]) from None
    warning = partial(Problem, file=path.name, severity="warning")
    message = "is not a column of the trial sheet and is ignored"
    left = [column for column in COLUMNS if column not in table.columns]
    told = {problem.column for problem in problems}  # of the same quantity in two units one is ignored
    unknown = [name for name in table.columns if name not in COLUMNS and name not in told]
    if not any(difflib.get_close_matches(name, COLUMNS, 1) for name in table.columns):
        remedy = "name them as vinetrack settings does, and delete what stands above their names"
        raise ExperimentError([Problem("no_columns", "names no known column", file=path.name, line=1, remedy=remedy)])
    problems += [warning("unknown_column", message, name, line=1, remedy=did_you_mean(name, left)) for name in unknown]
    if table.nameless:
        problems.append(warning("nameless_column", "has a column without a name, which is ignored"))
    if not table.rows:
        problems.append(Problem("no_rows", "has no rows", file=path.name, remedy="write one row per trial"))
    return table, problems


def closest_entry(path: Path, taken: Set[Path] = frozenset()) -> str:
    """Entry beside a missing file most like it, whatever its case, and not `taken`; blank if there is none."""
    try:
        names = {entry.name.lower(): entry.name for entry in sorted(path.parent.iterdir()) if entry not in taken}
    except (OSError, ValueError):
        return ""
    close = difflib.get_close_matches(path.name.lower(), names, 1)
    return names[close[0]] if close else ""


def _may_state_rate(folder: Path, video: str) -> bool:
    """Whether a recording is of a kind that can carry its capture rate; whether it does, only opening it shows."""
    try:
        path = safe_join(folder, video)
        files = path.iterdir() if path.is_dir() else [path, *map(path.with_suffix, SIDE_FILES)]
        return any(file.suffix.lower() in {".dng", *CAMERA_FILES} and file.exists() for file in files)
    except (OSError, ValueError):
        return False


def make_trial(row: Row, folder: Path, settings: ExperimentSettings) -> Trial:
    """Make the trial of a row without errors, in SI units, with the documented defaults."""
    defaults = {
        "pressure_kPa": 0.0,
        "pressure_sigma_kPa": 0.01 * row.values.get("pressure_kPa", 0.0),  # 1 %: default standard error (chosen)
        "yield_pressure_kPa": 0.0,
        "yield_pressure_sigma_kPa": YIELD_SIGMA_KPA if row.travel_ratio == 2 else 0.0,
    }
    scale = getattr(settings.calibration, "mm_per_px", None)  # of a recording its picture is asked, as for its lens
    defaults |= {"mm_per_px": scale} if scale and "track" in row.values else {}
    values: dict[str, Any] = {**defaults, **row.values, "trial": row.name}
    return Trial(
        **{COLUMNS[name].field: COLUMNS[name].in_trial(value, folder) for name, value in values.items()},
        pressure_unit=row.pressure_unit,
        ambient_pressure_Pa=settings.ambient_pressure_kPa * 1000,
        mass_loss=settings.mass_loss,
        tail_slack=settings.tail_slack,
        tail_store=settings.tail_store,
        position_systematic_m=math.nan if (mm := settings.position_systematic_mm) is None else mm / 1e3,
        # Without a recording the trial is planned, and what will limit its positions is not known.
        systematic_of_travel=systematic_of_travel(settings, "video" not in values or "mm_per_px" in values),
    )


def systematic_of_travel(settings: ExperimentSettings, scaled_elsewhere: bool = False) -> float:
    """Standard deviation of smooth position errors as a part of the longest travel. Two points, a scale, a scale of the
    trial's own and positions measured elsewhere (`scaled_elsewhere`) do not show whether the distortion was corrected;
    the many corners of a target do.
    """
    # 5e-5: that by a target, of which 0.67 is beside a constant and a scale, on sixteen pictures (measured)
    known = isinstance(settings.calibration, Board) and not scaled_elsewhere
    return 5e-5 if known else Trial.systematic_of_travel


# ------------------------------------------------------------------------------
# The experiment.


SETTINGS = "experiment.yaml"


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
    blank: dict[str, tuple[str, ...]] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every trial of the sheet, in its order."""
        return tuple(self.lines)

    @property
    def blank_notes(self) -> list[str]:
        """Sentences on `blank` cells by column: what they stand for, or the effects that cannot be tried."""
        from vinetrack.effects import catalogue

        notes, in_use = [], len(self.names) - len(self.left_out)
        for column, names in self.blank.items():
            untried = joined([name for name, effect in catalogue().items() if column in effect.needs])
            said = COLUMNS[column].if_blank or (f"{untried} cannot be tried" if untried else "")
            which = "all trials" if len(names) == in_use else f"{len(names)} trials, {names[0]} first"
            notes += [f"{column} is blank ({which}): {said}"] if said else []
        return notes

    @property
    def user_effects(self) -> Mapping[str, Effect]:
        """The user's own effects by name, read and tried out."""
        from vinetrack.effects import own_effects

        return own_effects([tables.safe_join(self.folder, path) for path in self.settings.effects])

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
    settings, table = None, None
    try:
        settings = read_experiment_settings(folder / SETTINGS, problems)
        for name in SHARED:
            if said := COLUMNS[name].unusual(value := getattr(settings, name)):
                problems.append(Problem("unusual", said, name, file=SETTINGS, value=f"{value:g}", severity="warning"))
    except ExperimentError as error:
        problems += error.problems
    try:
        table = _read_sheet(folder, problems)
    except ExperimentError as error:
        problems += error.problems
    rows = [read_row(table, i, settings or ExperimentSettings()) for i in range(len(table.rows))] if table else []
    absent = {"trial"} - set(table.columns) if table else set()
    in_use = [row for row in rows if row.in_use]
    for row in in_use:
        row.check()
        # A value that the sheet lacks may stand in the settings, so this needs readable settings.
        absent |= row.find_missing(folder, table.columns) if table and settings else set()
    for name in filter(absent.__contains__, COLUMNS):
        remedy = f"add the column {name}" + ("" if name == "trial" else f", or the key to {SETTINGS}")
        problems.append(Problem("missing", "is missing", name, file=SHEET, remedy=remedy))
    corrections, faults = read_corrections(folder)
    problems += faults
    filmed = {row.name: "video" in row.values for row in rows}
    for trial in corrections:
        if not filmed.get(trial):
            message = f"is not {'a recording' if trial in filmed else 'in the sheet'}; its corrections are ignored"
            place: dict[str, Any] = {"file": CORRECTIONS_FILE, "value": trial, "severity": "warning"}
            problems.append(Problem("ignored", message, "trial", **place))
    sheet_is_sound = not (_names_repeat(rows) or any(problem.severity == "error" for problem in problems))
    vines = [row for row in in_use if row.travel_ratio == 2]
    may_be_blank = [name for name, column in COLUMNS.items() if column.if_blank or column.default == "unknown"]
    blank = {column: tuple(row.name for row in vines if column not in row.given) for column in may_be_blank}
    # Where no row writes 0, a blank payload is none, as many write it.
    unsaid = [name for name in blank if COLUMNS[name].default != "0" or any(row.number(name) == 0 for row in vines)]
    partly = [name for name in unsaid if COLUMNS[name].if_blank and len(blank[name]) < len(vines)]
    for row in vines if settings else ():
        row.add_blank(partly, "others have a value, so fill it in, 0 as well", "warning")
    for row in in_use:
        if sheet_is_sound and not row.faulty:
            _take_pressure_from_recording(row, folder)
            row.check_pressures()
    problems += [problem for row in rows for problem in row.problems]
    if vines and sum(problem.code == "no_growth" for problem in problems) == len(vines):
        sheet_is_sound = False  # in one row a trial that may fail, in all one mistake
        problems = [replace(one, severity="error") if one.code == "no_growth" else one for one in problems]
    strict = strict if strict is not None else settings is not None and settings.strict
    if settings is None or not sheet_is_sound or (strict and any(row.faulty for row in in_use)):
        raise ExperimentError(problems)
    trials = [make_trial(row, folder, settings) for row in in_use if not row.faulty]
    trials = [replace(trial, corrections=corrections.get(trial.name, ())) if trial.video else trial for trial in trials]
    reasons = {row.name: "; ".join(p.reason for p in row.problems if p.severity == "error") for row in in_use}
    return Experiment(
        name=Path(os.path.normpath(folder.absolute())).name or "experiment",
        folder=folder,
        settings=settings,
        trials=with_names(trials),
        failed={name: reason for name, reason in reasons.items() if reason},
        left_out={row.name: "left out by the sheet (use: no)" for row in rows if not row.in_use},
        problems=tuple(problems),
        lines={row.name: row.line for row in rows},
        blank={column: names for column, names in blank.items() if names and column not in partly},
        columns=table.columns if table else (),
        recordings=tuple(row.values["video"] for row in rows if "video" in row.values),
    )


def _read_sheet(folder: Path, problems: list[Problem]) -> tables.Table:
    """Read the sheet as a table and check its columns."""
    if not folder.is_dir():
        message, remedy = ("is a file", "give its folder") if folder.exists() else tables.missing_file_message(folder)
        raise ExperimentError([Problem("no_folder", message, file=str(folder), remedy=remedy)])
    if not os.path.lexists(folder / SHEET):
        remedy = f"vinetrack setup FOLDER makes {SHEET} and {SETTINGS} from a folder of recordings or tracks"
        if close := closest_entry(folder / SHEET):
            remedy = f"if {close} is the sheet, save it as {SHEET}; else {remedy}"
        raise ExperimentError([Problem("missing", "is missing", file=SHEET, remedy=remedy)])
    table, found = read_sheet(folder / SHEET)
    problems += found
    return table


def _names_repeat(rows: list[Row]) -> bool:
    """Whether two rows have the same name, an error; names that differ in case only, and one recording, warn."""
    repeat, seen = False, dict[object, Row]()
    for row in rows:
        video, *part = (row.values.get(name) for name in ("video", "frames_used", "axis"))
        if video and row.in_use and (other := seen.setdefault((video, *part), row)) is not row:
            remedy = "name its own recording, or its part of one under frames_used"
            row.add("twice", f"is also the recording of {other.name}", "video", "warning", remedy=remedy)
        first = seen.setdefault(row.name.lower(), row)
        if first.name != row.name:
            message = f"differs from {first.name!r} on line {first.line} in case only, which some file systems ignore"
            row.add("twice", message, "trial", "warning", value=row.name)
        elif first is not row:
            remedy, repeat = "give every trial a name of its own", True
            row.add("twice", f"is also the name of line {first.line}", "trial", value=row.name, remedy=remedy)
    return repeat


def _take_pressure_from_recording(row: Row, folder: Path) -> None:
    """Set a blank pressure to the first value of the measured trace, to three digits, as the nominal pressure."""
    if "pressure_kPa" in row.values or row.travel_ratio == 1:
        return
    column = "pressure_trace" if "pressure_trace" in row.values else "track"
    path = tables.safe_join(folder, row.values[column])
    try:
        pressure = read_pressure_trace(path)[1] if column == "pressure_trace" else read_track(path).pressure_Pa
    except InputError as error:
        return row.add_error(error, column, row.values[column])
    if pressure is None:
        remedy = "fill it in, or give the track a column pressure_kPa"
        return row.add("blank", "is blank, and the track carries no pressure", "pressure_kPa", remedy=remedy)
    nominal_kPa = float(f"{float(pressure[0]) / 1000:.3g}")
    if nominal_kPa < 0:
        remedy = f"fill it in: the measured pressure starts at {nominal_kPa:g} kPa, below zero"
        return row.add("blank", "is blank", "pressure_kPa", value="", remedy=remedy)
    row.values["pressure_kPa"] = nominal_kPa


# ------------------------------------------------------------------------------
# Planned trials: one given by command-line options, or the rows of a sheet, with or without recordings.
#
# Both pass the checks of a trial sheet, so that a wrong unit gets the same message everywhere.

# Columns that a prediction needs; an unknown yield pressure is taken from the scaling prior
REQUIRED_FOR_PREDICTION = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa")


def planned_trial(values: Mapping[str, str], needed: Sequence[str] = REQUIRED_FOR_PREDICTION) -> Experiment:
    """Read a trial from texts by name of column, as given on the command line.

    A yield pressure that is not given is NaN. Messages name the command-line option.

    Parameters
    ----------
    values : texts by column, in the unit of the column.
    needed : required columns.

    Returns
    -------
    planned : an experiment of that trial, and warnings.

    Raises
    ------
    ExperimentError
        With every value that is missing or not allowed.

    Examples
    --------
    >>> texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "30"}
    >>> planned_trial(texts).trials[0].vine
    '24mm-200um-280mm'
    """
    table = table_of_texts([{"trial": "planned", **{name: text.strip() for name, text in values.items()}}])
    return planned_rows(table, ExperimentSettings(), needed)


def planned_sheet(path: Path, *, every_row: bool = False) -> Experiment:
    """Read the conditions in use of a folder or sheet, filmed or not: the first row of each, or `every_row`."""
    file = path / SHEET if path.is_dir() else path
    if not file.is_file():
        close = closest_entry(file)
        remedy = f"did you mean {close}?" if close else f"give a folder with {SHEET}, or a sheet"
        raise ExperimentError([Problem("no_file", "does not exist", file=str(file), remedy=remedy)])
    table, header = read_sheet(file)
    settings = read_experiment_settings(file.parent / "experiment.yaml")
    given = {*table.columns, *(name for name in SHARED if getattr(settings, name) is not None)}
    if absent := [name for name in REQUIRED_FOR_PREDICTION if name not in given]:
        remedy = "give a trial sheet, one row a trial, with these columns"
        header.append(Problem("missing", f"has no column {', '.join(absent)}", file=file.name, remedy=remedy))
    if absent or not table.rows:
        raise ExperimentError(header)
    planned = planned_rows(table, settings, REQUIRED_FOR_PREDICTION, header, file)
    first = {trial.condition: trial for trial in reversed(planned.trials)}
    shown = tuple(trial for trial in planned.trials if every_row or trial is first[trial.condition])
    return replace(planned, trials=shown)


def table_of_texts(rows: Sequence[dict[str, str]]) -> tables.Table:
    """Return a table of rows that stand in no file: their lines are 0."""
    columns = tuple(dict.fromkeys(name for row in rows for name in row))
    return tables.Table(columns, tuple(rows), (0,) * len(rows), ((),) * len(rows), ",", ".")


def planned_rows(
    table: tables.Table, settings: ExperimentSettings, needed: Sequence[str], header: Sequence[Problem] = (),
    file: Path = Path(), *, measured: bool = False,
) -> Experiment:  # fmt: skip
    """Check the rows in use, and make an experiment of them without their recordings, unless there is an error. A yield
    pressure and a scatter of the pressure that are not given are NaN, and all are vines, unless they are `measured`.
    Problems name the sheet, or without a file the options.
    """
    # Columns about recordings: optional for a planned trial, and ignored but for the rate
    of_recordings = ("video", "track", "pressure_trace", "exposure_us", "mm_per_px", "steady", "capture_fps")
    rows = [row for i in range(len(table.rows)) if (row := read_row(table, i, settings)).in_use]
    remedy = "remove `use: no` from at least one row"
    problems = [] if rows else [Problem("no_rows", "has no trial in use", remedy=remedy)]
    for row in rows:
        is_body = row.travel_ratio != 2
        row.add_blank(needed[:1] if is_body and measured else needed, "give it")
        if is_body and not measured:
            remedy = "predictions are for everting vines (travel_ratio 2)"
            row.add("a_body", "is that of a body that moves as a whole", "travel_ratio", remedy=remedy)
        row.check_wall()
        row.check_pressures()
        problems += [problem for problem in row.problems if measured or problem.column not in of_recordings]
    if not file.name:
        problems = [replace(p, trial="", column=option(p.column) if p.column else "") for p in problems]
    problems = [*header, *(replace(problem, file=file.name) for problem in problems)]
    if any(problem.severity == "error" for problem in problems):
        raise ExperimentError(problems)
    for row in rows if not measured else ():
        row.values = {name: value for name, value in row.values.items() if name not in of_recordings[:-1]}
        row.values.setdefault("pressure_sigma_kPa", math.nan)
        if "yield_pressure_kPa" not in row.values:
            row.values |= dict.fromkeys(("yield_pressure_kPa", "yield_pressure_sigma_kPa"), math.nan)
    trials = with_names([make_trial(row, Path(), settings) for row in rows])
    return Experiment("planned", file.parent, settings, trials, problems=tuple(problems))


# ------------------------------------------------------------------------------
# Manual corrections of tracked points: `corrections.csv` beside the trial sheet.
#
# The tracker applies the action and flags the point `corrected`; the position it had found itself stays in the results.

CORRECTIONS_FILE = "corrections.csv"
CORRECTION_COLUMNS = ("trial", "frame", "action", "edge_px")

Corrections = dict[str, tuple[Correction, ...]]


def read_corrections(folder: Path) -> tuple[Corrections, list[Problem]]:
    """Read the corrections of an experiment, by name of trial, and what is wrong with their file."""
    if not os.path.lexists(folder / CORRECTIONS_FILE):
        return {}, []
    try:
        table = tables.read_table(folder / CORRECTIONS_FILE)
    except InputError as error:
        return {}, [Problem.from_error(error, CORRECTIONS_FILE)]
    if missing := [name for name in CORRECTION_COLUMNS if name not in table.columns]:
        remedy = f"its columns are {', '.join(CORRECTION_COLUMNS)}"
        return {}, [Problem("missing", "is missing", missing[0], file=CORRECTIONS_FILE, remedy=remedy)]
    by_trial: dict[str, dict[int, Correction]] = {}
    problems: list[Problem] = []
    for row, line in zip(table.rows, table.lines, strict=True):
        by_frame = by_trial.setdefault(row["trial"], {})
        column = "action"
        try:
            if row["action"] not in ("move", "drop", "confirm"):
                raise InputError("is not an action", "write move, drop or confirm", code="not_a_choice")
            column = "edge_px"
            edge_px = tables.parse_number(row["edge_px"], table.decimal) if row["action"] == "move" else math.nan
            column = "frame"
            frame = tables.parse_number(row["frame"], table.decimal)
            if frame < 0 or frame != int(frame):
                raise InputError("is not a frame number", "frames are counted 0, 1, 2, …", code="not_a_frame")
            if frame in by_frame:
                raise InputError("is corrected twice", "keep one of the lines", code="twice")
            by_frame[int(frame)] = Correction(int(frame), row["action"], edge_px)
        except InputError as error:
            place: dict[str, Any] = {"line": line, "trial": row["trial"], "column": column, "value": row[column]}
            problems.append(Problem.from_error(error, CORRECTIONS_FILE, **place))
    return {name: tuple(by_frame[frame] for frame in sorted(by_frame)) for name, by_frame in by_trial.items()}, problems


def corrections_text(corrections: Mapping[str, Iterable[Correction]]) -> str:
    """Return the content of `corrections.csv` for these corrections."""
    from pandas import DataFrame

    rows = [(trial, one.frame, one.action, one.edge_px) for trial, given in corrections.items() for one in given]
    table = DataFrame(rows, columns=list(CORRECTION_COLUMNS))
    return table.to_csv(index=False, float_format="%.2f", lineterminator="\n")


# ------------------------------------------------------------------------------
# The order in which trials were run, and whether it is confounded with pressure.
#
# A drift (wear of the tube, warming, a moving zero of the gauge) follows the order of the trials. If the pressure
# rises with the order, the data cannot distinguish such a drift from an effect of pressure.


def trial_order(trials: Sequence[Trial]) -> tuple[Floats, bool]:
    """Return the rank of every trial, from 0, as they were run, shape (n_trials,), and whether the sheet says so."""
    order = np.array([trial.order for trial in trials], dtype=float)
    stated = bool(order.size and np.isfinite(order).all() and np.unique(order).size == order.size)
    ranks = np.argsort(np.argsort(order)) if stated else np.arange(order.size)
    return ranks.astype(float), stated


def order_pressure_correlation(trials: Sequence[Trial]) -> float:
    """Return Spearman's rank correlation of order and set pressure within vines, pooled over all vines; NaN if there
    are fewer than eight trials (derived), or each vine has only one pressure.
    """
    from pandas import DataFrame  # which is loaded already: scipy.stats takes a second

    ranks, _ = trial_order(trials)
    rows = [(trial.vine, rank, trial.pressure_Pa) for trial, rank in zip(trials, ranks, strict=True)]
    frame = DataFrame(rows, columns=["vine", "order", "pressure"]).dropna()
    frame = frame[frame.groupby("vine")["pressure"].transform("nunique") > 1]
    shares = frame.groupby("vine").rank(pct=True)
    within = shares - shares.groupby(frame["vine"]).transform("mean")
    return float(within["order"].corr(within["pressure"], min_periods=8))


def _order_problems(trials: Sequence[Trial]) -> Iterator[Problem]:
    """Warn of confounding: order with pressure, and specimen or day with condition."""
    from pandas import DataFrame

    correlation, (_, stated) = order_pressure_correlation(trials), trial_order(trials)
    # 0.7: rank correlation above which order and pressure count as confounded (derived)
    if abs(correlation) >= 0.7:
        said = "" if stated else "is blank: taken as that of the rows, which "
        message = f"{said}follows the pressure (rank correlation {correlation:.2f}): a drift would look like an effect"
        remedy = "run the trials in random order, or repeat six of them in random order, and number them under order"
        severity = "warning" if stated else "note"
        yield Problem("confounded", message, "order", file=SHEET, severity=severity, remedy=remedy)
    frame = DataFrame(map(vars, trials), columns=["vine", "condition", *GROUPINGS])
    for column in GROUPINGS if trials else ():
        # Every condition has a single specimen or day, while they differ within a vine.
        in_condition, in_vine = (frame.groupby(of)[column].nunique().max() for of in ("condition", "vine"))
        if (frame[column] != "").all() and in_condition == 1 and in_vine > 1:
            message = f"differs for every condition: a difference between {column}s would look like a physical effect"
            remedy = f"spread every condition over two {column}s"
            yield Problem("confounded", message, column, file=SHEET, severity="warning", remedy=remedy)


# ------------------------------------------------------------------------------
# The check of an experiment before any work: tracks are read, recordings handed on to who can open them.


def check_experiment(
    folder: Path | str, open_videos: Callable[[Experiment, list[Trial]], Iterable[Problem]] | None = None,
    tracks: list[tuple[Trial, Track]] | None = None,
) -> list[Problem]:  # fmt: skip
    """Find all problems of sheet, settings and tracks, and missing videos; `tracks` gets the tracks that are read."""
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError as error:
        return list(error.problems)
    problems = list(experiment.problems)
    for key, relative in experiment.settings.paths:
        if not (path := tables.safe_join(experiment.folder, relative)).exists():
            message, remedy = tables.missing_file_message(path)
            problems.append(Problem("no_file", message, key, file=SETTINGS, value=relative, remedy=remedy))
    problems += _order_problems(experiment.trials)
    of_trials: list[Problem] = []
    readable: list[Trial] = []
    named_videos = {trial.video for trial in experiment.trials if trial.video}
    for trial in experiment.trials:
        found = _check_video(trial.video, named_videos) if trial.video else _check_track(trial, tracks)
        of_trials += [replace(problem, trial=trial.name) for problem in found]
        readable += [trial] if trial.video and not found else []
    if readable and open_videos is not None:
        of_trials += open_videos(experiment, readable)
    for problem in of_trials:
        in_settings = problem.column in SHARED and problem.column not in experiment.columns  # which alone state it
        place = {"file": SETTINGS} if in_settings else {"file": SHEET, "line": experiment.lines.get(problem.trial)}
        problems.append(replace(problem, **place) if problem.trial else problem)
    return problems


def _check_track(trial: Trial, tracks: list[tuple[Trial, Track]] | None) -> list[Problem]:
    """Read a track with its pressure, add it to `tracks`, and warn where it contradicts the sheet."""
    place: dict[str, Any] = {"column": "track", "value": trial.track.name if trial.track else ""}
    try:
        track = load_track(trial)
    except InputError as error:
        return [Problem.from_error(error, SHEET, **place)]
    if tracks is not None:
        tracks.append((trial, track))
    remarks = {}
    step_s = float(np.median(np.diff(track.time_s)))
    if step_s > 0.2:  # no camera that films a growth takes so few pictures (chosen)
        remarks["times"] = f"has points {step_s:.3g} s apart: are its times in seconds?"
    elif abs((frames := step_s * trial.capture_fps) - 1) > 0.02:
        remarks["capture_fps"] = f"has points {frames:.4g} frames apart at this capture_fps: is capture_fps right?"
    travel_m = float(np.ptp(track.lead_position_m[track.usable]))
    # A factor of 2 allows for a poor scale or axis, but not for millimetres or pixels read as metres; 0.001 for the
    # beginning of a motion, but not for metres read as pixels.
    if not 0.001 < travel_m / trial.length_m < 2 and math.isfinite(trial.length_m):
        remarks["longer_than_the_vine"] = (
            f"travels {travel_m:.4g} m, but the vine is {1000 * trial.length_m:g} mm long by the sheet: is length_mm "
            "in millimetres, and what are the units of the positions (pixels take mm_per_px)?"
        )
    if track.lead_position_m[track.usable][-1] < track.lead_position_m[track.usable][0]:
        remarks["backwards"] = "runs backwards: position should grow as the vine does"
    if track.pressure_Pa is not None and trial.pressure_Pa > 0:
        highest_Pa = float(np.max(track.pressure_Pa))
        if not 0.5 < highest_Pa / trial.pressure_Pa < 2:
            found, stated = (pressure_text(of_Pa, trial.pressure_unit, 4) for of_Pa in (highest_Pa, trial.pressure_Pa))
            remarks["pressure"] = f"has pressures up to {found}, but the sheet says {stated}"
    return [Problem(code, message, severity="warning", **place) for code, message in remarks.items()]


def _check_video(path: Path, named_videos: Set[Path]) -> list[Problem]:
    """Check that a recording exists and is not empty; `named_videos` are the recordings named by any trial."""
    code, message, remedy = "empty", "is empty", "copy it again"
    try:
        if any(path.iterdir()) if path.is_dir() else tables.file_size(path):
            return []
    except (FileNotFoundError, ValueError):
        code, (message, remedy) = "no_file", tables.missing_file_message(path)
        below = (f"{entry.parent.name}/{path.name}" for entry in path.parent.glob(f"*/{path.name}"))
        if not path.is_symlink() and (close := closest_entry(path, named_videos) or next(below, "")):
            remedy = f"did you mean {close}?"
    except OSError as error:
        code, message, remedy = "unreadable", f"cannot be read: {error.strerror}", ""
    return [Problem(code, message, "video", value=path.name, remedy=remedy)]
