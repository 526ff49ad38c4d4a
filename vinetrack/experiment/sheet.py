"""One row of the trial sheet: reading its cells, checking them, and making a trial of them.

This module never opens recordings; `vinetrack.experiment.folder` combines rows, settings and files.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vinetrack.core.problems import Problem, did_you_mean
from vinetrack.core.records import POSITION_SYSTEMATIC_M, Trial
from vinetrack.core.tables import Table, TableError, safe_join
from vinetrack.experiment.schema import COLUMNS, SHARED, CellError, Column, read_cell, unusual_value_hint
from vinetrack.experiment.settings import Charuco, Checkerboard, ExperimentSettings

SHEET = "trials.csv"
MAX_NAME_LENGTH = 100  # Longest trial name; files are named after it (chosen)

# Columns that a trial of an everting vine requires; a body that moves as a whole requires the diameter only
REQUIRED_COLUMNS = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa")

PRESSURE_REL_SIGMA, YIELD_SIGMA_KPA = 0.01, 0.2  # Default standard errors (chosen)

SUFFIXES_WITH_RATE = frozenset({".dng", ".cine", ".cih", ".cihx"})  # Suffixes of files that may carry the capture rate


@dataclass
class Row:
    """A row while it is checked: values by column, in the unit of the column, without blank ones, and problems."""

    name: str
    line: int
    values: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        """Whether the row has an error."""
        return any(problem.severity == "error" for problem in self.problems)

    @property
    def in_use(self) -> bool:
        """Whether the trial is to be analysed; False for `use: no`."""
        return bool(self.values.get("use", True))

    @property
    def travel_ratio(self) -> float:
        """Travel ratio of row or settings; 2 by default."""
        return float(self.values.get("travel_ratio", 2.0))

    def add(self, message: str, column: str = "", severity: str = "error", **details: Any) -> None:
        """Record a problem of this row."""
        place: dict[str, Any] = {"file": SHEET, "trial": self.name, "line": self.line}
        self.problems.append(Problem(message=message, column=column, severity=severity, **place, **details))


def read_row(table: Table, index: int, settings: ExperimentSettings) -> Row:
    """Read and check the cells of one row; shared settings fill blank cells."""
    cells, line = table.rows[index], table.lines[index]
    row = Row(cells.get("trial", f"line-{line}"), line)
    _check_name(row)
    for name, column in COLUMNS.items():
        text = cells.get(name, "")
        if text == "":
            if name in SHARED and (shared := getattr(settings, name)) is not None:
                row.values[name] = shared
            continue
        try:
            row.values[name] = read_cell(column, text, table.decimal)
        except CellError as error:
            row.add(error.message, name, value=text, allowed=error.allowed, remedy=error.remedy)
            continue
        if column.kind == "number" and (hint := unusual_value_hint(column, row.values[name])):
            row.add(f"is unusual: {hint}", name, "warning", value=text)
    if table.extra[index]:
        remedy = "put text that contains separators, and decimal commas, in quotes"
        row.add(f"has more cells than the header ({table.extra[index][0][:40]!r} …)", remedy=remedy)
    if not row.in_use:
        row.problems = [replace(problem, severity="warning") for problem in row.problems]
    return row


def unknown_columns(table: Table, file: str) -> list[Problem]:
    """Warn of every unknown column, with the most similar known names."""
    problems = []
    for name in table.columns:
        if name not in COLUMNS:
            remedy = did_you_mean(name, [column for column in COLUMNS if column not in table.columns])
            message = "is not a column of the trial sheet and is ignored"
            place: dict[str, Any] = {"file": file, "line": 1, "column": name}
            problems.append(Problem(message=message, severity="warning", remedy=remedy, **place))
    return problems


def _check_name(row: Row) -> None:
    """Report an invalid trial name, and replace it by the number of the line."""
    allowed = "letters, digits, _ and -"
    given = row.name
    if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]*", given, re.ASCII) and len(given) <= MAX_NAME_LENGTH:
        return
    row.name = f"line-{row.line}"
    message = (
        "is blank" if not given else "is too long" if len(given) > MAX_NAME_LENGTH else "is not a valid trial name"
    )
    if given.startswith("-"):
        message = "begins with a hyphen, like a command-line option"
    remedy = f"at most {MAX_NAME_LENGTH} characters, no spaces or dots: files are named after it"
    row.add(message, "trial", value=given, allowed=allowed, remedy=remedy)


def check_row(row: Row, folder: Path) -> None:
    """Check a row as a whole: its paths, and values that contradict each other."""
    _check_paths(row, folder)
    check_wall(row)
    fps, exposure = row.values.get("capture_fps", math.nan), row.values.get("exposure_us", math.nan)
    # An exposure cannot exceed the frame interval. 2 % allows for rounding of both numbers; above 1.5 intervals
    # rounding cannot be the reason.
    if exposure > 1.02e6 / fps:
        intervals = exposure * fps / 1e6
        message = f"is {intervals:.3g} times the frame interval at {fps:g} frames per second ({1e6 / fps:.4g} µs)"
        severity = "error" if intervals > 1.5 else "warning"
        remedy = "check its unit and capture_fps" if intervals > 1.5 else ""
        row.add(message, "exposure_us", severity, value=f"{exposure:g}", remedy=remedy)


def find_missing(row: Row, folder: Path, columns: tuple[str, ...]) -> set[str]:
    """Report required cells that are blank, and return required columns that neither sheet nor settings have. The
    latter are a fault of the sheet, which the caller reports once.
    """
    faulty = {problem.column for problem in row.problems if problem.severity == "error"}
    absent: set[str] = set()
    if "travel_ratio" in faulty:
        return absent
    missing = [name for name in _required_columns(row, folder) if name not in row.values and name not in faulty]
    for name in missing:
        if name in columns:
            rate = "write the capture rate; the rate stored in the file is that of playback"
            remedy = rate if name == "capture_fps" else "fill it in"
            row.add("is blank", name, code="blank", value="", allowed=COLUMNS[name].allowed, remedy=remedy)
        else:
            absent.add(name)
    return absent


def _required_columns(row: Row, folder: Path) -> list[str]:
    """Columns that a row requires, depending on its travel ratio and on the kind of its recording."""
    required = list(REQUIRED_COLUMNS if row.travel_ratio == 2 else REQUIRED_COLUMNS[:1])
    if "pressure_kPa" in required and ("pressure_trace" in row.values or "track" in row.values):
        required.remove("pressure_kPa")
    if "video" in row.values and "track" not in row.values and not _may_state_rate(folder, row.values["video"]):
        required.append("capture_fps")
    return required


def _check_paths(row: Row, folder: Path) -> None:
    """Check that the row names exactly one recording or track, and that no path leaves the folder."""
    for name in ("video", "track", "pressure_trace"):
        if name in row.values:
            try:
                safe_join(folder, row.values[name])
            except TableError as error:
                row.add(error.message, name, value=row.values[name], remedy=error.remedy)
    if "video" in row.values and "track" in row.values:
        row.add("has both a video and a track", "track", value=row.values["track"], remedy="keep one of the two")
    if "video" not in row.values and "track" not in row.values:
        row.add(
            "has neither a video nor a track", remedy="name a recording under video, or a file of positions under track"
        )


def _may_state_rate(folder: Path, video: str) -> bool:
    """Whether a recording is of a kind that can carry its capture rate; whether it does, only opening it shows."""
    try:
        path = safe_join(folder, video)
        files = path.iterdir() if path.is_dir() else [path, path.with_suffix(".cih"), path.with_suffix(".cihx")]
        return any(file.suffix.lower() in SUFFIXES_WITH_RATE and file.exists() for file in files)
    except (TableError, OSError, ValueError):
        return False


def check_wall(row: Row) -> None:
    """Report a wall thickness above a quarter of the diameter, which no tube can have."""
    diameter, thickness = row.values.get("diameter_mm", math.nan), row.values.get("thickness_um", math.nan)
    if thickness / 1000 > diameter / 4:
        message = f"is more than a quarter of the diameter ({diameter:g} mm)"
        allowed, remedy = f"at most {250 * diameter:g} µm", "check the units: thickness in µm, diameter in mm"
        row.add(message, "thickness_um", value=f"{thickness:g}", allowed=allowed, remedy=remedy)


def check_pressures(row: Row) -> None:
    """Warn of pressures that are allowed but implausible."""
    pressure = row.values.get("pressure_kPa", math.nan)
    yield_pressure = row.values.get("yield_pressure_kPa", math.nan)
    if row.travel_ratio == 2 and yield_pressure >= pressure:
        message = f"is not below the pressure of {pressure:g} kPa, so the vine would not grow (psi? 1 psi is 6.895 kPa)"
        row.add(message, "yield_pressure_kPa", "warning", value=f"{yield_pressure:g}")
    if (
        row.travel_ratio == 2
        and pressure > 0
        and yield_pressure == 0
        and not row.values.get("yield_pressure_sigma_kPa", 0.0) > 0
    ):
        message = "states that the vine grows at any pressure, which no vine does, with an error of 0.2 kPa"
        remedy = "measure it (raise the pressure until the tip moves), or state its error in yield_pressure_sigma_kPa"
        row.add(message, "yield_pressure_kPa", "warning", value="0", remedy=remedy)
    if row.travel_ratio == 1 and pressure > 0:
        message = "is above 0 although the body moves as a whole (travel_ratio 1): is it a vine?"
        row.add(message, "pressure_kPa", "warning", value=f"{pressure:g}")


def make_trial(row: Row, folder: Path, settings: ExperimentSettings) -> Trial:
    """Make the trial of a row without errors, in SI units, with the documented defaults."""
    values: dict[str, Any] = dict(row.values)
    pressure_kPa = values.setdefault("pressure_kPa", 0.0)
    values.setdefault("pressure_sigma_kPa", PRESSURE_REL_SIGMA * pressure_kPa)
    values.setdefault("yield_pressure_kPa", 0.0)
    values.setdefault("yield_pressure_sigma_kPa", YIELD_SIGMA_KPA if row.travel_ratio == 2 else 0.0)
    values["trial"] = row.name
    fields = {COLUMNS[name].field: _in_si(COLUMNS[name], value, folder) for name, value in values.items()}
    return Trial(
        **fields,
        ambient_pressure_Pa=settings.ambient_pressure_kPa * 1000,
        mass_loss=settings.mass_loss,
        tail_slack=settings.tail_slack,
        tail_store=settings.tail_store,
        position_systematic_m=_position_systematic_m(settings, values),
    )


def _in_si(column: Column, value: Any, folder: Path) -> Any:
    """Convert the value of a cell for a trial: numbers to SI, paths to paths inside the folder."""
    if column.kind == "path":
        return safe_join(folder, value)
    return column.to_si(float(value)) if column.kind in ("number", "choice") else value


def _position_systematic_m(settings: ExperimentSettings, values: dict[str, Any]) -> float:
    """Standard deviation of smooth position errors, m: as stated, else by whether lens distortion was corrected. A
    target with many corners reveals the distortion, hence 0. Two points, a scale, a scale of the trial's own and
    positions measured elsewhere do not show whether it was corrected, hence the default. NaN for a planned trial.
    """
    if settings.position_systematic_mm is not None:
        return settings.position_systematic_mm / 1e3
    if "track" not in values and "video" not in values:
        return math.nan
    measured = "track" in values or "mm_per_px" in values
    return POSITION_SYSTEMATIC_M if measured else expected_systematic_m(settings)


def expected_systematic_m(settings: ExperimentSettings) -> float:
    """Standard deviation of smooth position errors, m, of trials that are still to be filmed."""
    if settings.position_systematic_mm is not None:
        return settings.position_systematic_mm / 1e3
    return 0.0 if isinstance(settings.calibration, (Charuco, Checkerboard)) else POSITION_SYSTEMATIC_M
