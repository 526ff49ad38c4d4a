"""One row of the trial sheet: its cells, what they lack, and the trial they make.

Nothing here opens a recording; `vinetrack.experiment.folder` joins rows, settings and files.
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
from vinetrack.experiment.cells import CellError, read_cell, unusual_value_hint
from vinetrack.experiment.column import Column
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.settings import Charuco, Checkerboard, ExperimentSettings

SHEET = "trials.csv"
MAX_NAME_LENGTH = 100
"""Longer trial names leave no room for suffixes within the 255 bytes a file name may have. Chosen: 155 bytes remain
for suffixes; at twice 55 remain, at half names that people write are refused."""

REQUIRED_COLUMNS = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa")
"""What a trial of an everting vine must have; a body that moves as a whole needs its diameter only."""

PRESSURE_REL_SIGMA, YIELD_SIGMA_KPA = 0.01, 0.2
"""Errors where the sheet states none, part of the contract: 1 % of the pressure, and 0.2 kPa for the yield pressure.
Chosen: a usual gauge is of class 1, and a yield pressure is read off a slowly rising one. At half or twice the errors
of forces near the yield pressure halve or double where the sheet states none."""

SUFFIXES_WITH_RATE = frozenset({".dng", ".cine", ".cih", ".cihx"})
"""Endings of files that carry the rate of capture."""

RATE_REMEDY = "write the rate of capture: the file's own rate is that of playback"


@dataclass
class Row:
    """A row while it is being judged: values by column, in the column's unit, blank ones left out."""

    name: str
    line: int
    values: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        """Whether any of its problems is an error."""
        return any(problem.severity == "error" for problem in self.problems)

    @property
    def in_use(self) -> bool:
        """Whether the person wants this trial analysed."""
        return bool(self.values.get("use", True))

    @property
    def travel_ratio(self) -> float:
        """2 unless the row or the settings say otherwise."""
        return float(self.values.get("travel_ratio", 2.0))

    def add(self, message: str, column: str = "", severity: str = "error", **details: Any) -> None:
        """Note a problem of this row.

        Parameters
        ----------
        message : what is wrong.
        column : where, blank for the row as a whole.
        severity : "error" or "warning".
        **details : further fields of `Problem`.
        """
        place: dict[str, Any] = {"file": SHEET, "trial": self.name, "line": self.line}
        self.problems.append(Problem(message=message, column=column, severity=severity, **place, **details))


def read_row(table: Table, index: int, settings: ExperimentSettings) -> Row:
    """Read one row of the sheet, shared settings filled in where its cells are blank, and judge every cell.

    Parameters
    ----------
    table : the sheet, in the units of its columns.
    index : of the row.
    settings : what all trials share.

    Returns
    -------
    row : values in the unit of each column, and problems.
    """
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
        remedy = "put decimal commas and text with separators in quotes"
        row.add(f"has more cells than the header ({table.extra[index][0][:40]!r} …)", remedy=remedy)
    if not row.in_use:
        row.problems = [replace(problem, severity="warning") for problem in row.problems]
    return row


def unknown_columns(table: Table, file: str) -> list[Problem]:
    """A warning for every column that no trial sheet has, with the nearest that it may have meant.

    Parameters
    ----------
    table : the sheet.
    file : its name, for messages.

    Returns
    -------
    problems : warnings, one a column.
    """
    problems = []
    for name in table.columns:
        if name not in COLUMNS:
            remedy = did_you_mean(name, [column for column in COLUMNS if column not in table.columns])
            message = "is no column of a trial sheet and is ignored"
            place: dict[str, Any] = {"file": file, "line": 1, "column": name}
            problems.append(Problem(message=message, severity="warning", remedy=remedy, **place))
    return problems


def _check_name(row: Row) -> None:
    """Give a row without a usable name one that can stand in files and messages."""
    allowed = "letters, digits, _ and -"
    given = row.name
    if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]*", given, re.ASCII) and len(given) <= MAX_NAME_LENGTH:
        return
    row.name = f"line-{row.line}"
    message = "is blank" if not given else "is too long" if len(given) > MAX_NAME_LENGTH else "is no name for a trial"
    if given.startswith("-"):
        message = "begins with a hyphen, as options of commands do"
    remedy = f"at most {MAX_NAME_LENGTH} characters, no blanks or dots; it names files"
    row.add(message, "trial", value=given, allowed=allowed, remedy=remedy)


def check_row(row: Row, folder: Path) -> None:
    """Judge a row as a whole: paths that lead out, and values that contradict each other.

    Parameters
    ----------
    row : its problems are noted in it.
    folder : of the experiment, which paths must not leave.
    """
    _check_paths(row, folder)
    check_wall(row)
    fps, exposure = row.values.get("capture_fps", math.nan), row.values.get("exposure_us", math.nan)
    # 2 % allows for rounding of both; a shutter that stays open longer than its frame does not exist, and a frame and
    # a half is no rounding.
    if exposure > 1.02e6 / fps:
        longer = exposure * fps / 1e6
        message = f"is longer than a frame at {fps:g} frames a second ({1e6 / fps:.4g} µs), a factor {longer:.3g}"
        severity = "error" if longer > 1.5 else "warning"
        remedy = "check its unit and capture_fps" if longer > 1.5 else ""
        row.add(message, "exposure_us", severity, value=f"{exposure:g}", remedy=remedy)


def find_missing(row: Row, folder: Path, columns: tuple[str, ...]) -> set[str]:
    """Note required cells that are blank in a row whose shared settings are filled in.

    Returns the required columns that neither sheet nor settings have at all: a fault of the sheet, to be reported
    once. Where the travel ratio is broken, what the row needs is not known.

    Parameters
    ----------
    row : its problems are noted in it.
    folder : of the experiment.
    columns : that the sheet has.

    Returns
    -------
    required columns that neither sheet nor settings have at all: a fault of the sheet, to be reported once. Empty where
        the travel ratio is broken: what the row needs is then not known.
    """
    broken = {problem.column for problem in row.problems if problem.severity == "error"}
    absent: set[str] = set()
    if "travel_ratio" in broken:
        return absent
    needed = [name for name in _required_columns(row, folder) if name not in row.values and name not in broken]
    for name in needed:
        if name in columns:
            remedy = RATE_REMEDY if name == "capture_fps" else "fill it in"
            row.add("is blank", name, value="", allowed=COLUMNS[name].allowed, remedy=remedy)
        else:
            absent.add(name)
    return absent


def _required_columns(row: Row, folder: Path) -> list[str]:
    """Columns that a row with this travel ratio and these recordings cannot do without."""
    needed = list(REQUIRED_COLUMNS if row.travel_ratio == 2 else REQUIRED_COLUMNS[:1])
    if "pressure_kPa" in needed and ("pressure_trace" in row.values or "track" in row.values):
        needed.remove("pressure_kPa")
    if "video" in row.values and "track" not in row.values and not _states_its_rate(folder, row.values["video"]):
        needed.append("capture_fps")
    return needed


def _check_paths(row: Row, folder: Path) -> None:
    """Exactly one recording, and no path that leaves the folder."""
    for name in ("video", "track", "pressure_trace"):
        if name in row.values:
            try:
                safe_join(folder, row.values[name])
            except TableError as error:
                message, _, remedy = str(error).partition(": ")
                row.add(message, name, value=row.values[name], remedy=remedy)
    if "video" in row.values and "track" in row.values:
        row.add("has both a video and a track", "track", value=row.values["track"], remedy="keep one of the two")
    if "video" not in row.values and "track" not in row.values:
        row.add("has neither a video nor a track", remedy="name the recording under video, or positions under track")


def _states_its_rate(folder: Path, video: str) -> bool:
    """Whether a recording is of a kind that may carry the rate of capture; whether it does shows when it is opened."""
    try:
        path = safe_join(folder, video)
        files = path.iterdir() if path.is_dir() else [path, path.with_suffix(".cih"), path.with_suffix(".cihx")]
        return any(file.suffix.lower() in SUFFIXES_WITH_RATE and file.exists() for file in files)
    except (TableError, OSError, ValueError):
        return False


def check_wall(row: Row) -> None:
    """Refuse a wall that no tube of this diameter can have.

    Parameters
    ----------
    row : its problems are noted in it.
    """
    diameter, thickness = row.values.get("diameter_mm", math.nan), row.values.get("thickness_um", math.nan)
    if thickness / 1000 > diameter / 4:
        message = f"is a wall above a quarter of the diameter of {diameter:g} mm"
        allowed, remedy = f"at most {250 * diameter:g} µm", "the wall is in µm, the diameter in mm"
        row.add(message, "thickness_um", value=f"{thickness:g}", allowed=allowed, remedy=remedy)


def check_pressures(row: Row) -> None:
    """Warn of pressures that are legal but hardly meant.

    Parameters
    ----------
    row : its problems are noted in it.
    """
    pressure = row.values.get("pressure_kPa", math.nan)
    onset = row.values.get("yield_pressure_kPa", math.nan)
    if row.travel_ratio == 2 and onset >= pressure:
        message = f"is not below the pressure of {pressure:g} kPa: nothing would move (psi? 1 psi is 6.895 kPa)"
        row.add(message, "yield_pressure_kPa", "warning", value=f"{onset:g}")
    if (
        row.travel_ratio == 2
        and pressure > 0
        and onset == 0
        and not row.values.get("yield_pressure_sigma_kPa", 0.0) > 0
    ):
        message = "says that the vine grows at any pressure, which none does, and is believed to 0.2 kPa"
        remedy = "raise the pressure slowly until the tip moves, or say in yield_pressure_sigma_kPa how little is known"
        row.add(message, "yield_pressure_kPa", "warning", value="0", remedy=remedy)
    if row.travel_ratio == 1 and pressure > 0:
        message = "drives a body that moves as a whole (travel_ratio 1): is it a vine?"
        row.add(message, "pressure_kPa", "warning", value=f"{pressure:g}")


def make_trial(row: Row, folder: Path, settings: ExperimentSettings) -> Trial:
    """The trial of a row that has no errors and a pressure, in SI units, with the defaults of the documentation.

    Parameters
    ----------
    row : without errors.
    folder : of the experiment, for its paths.
    settings : what all trials share.

    Returns
    -------
    trial : SI units; NaN where the sheet is blank and nothing else is stated.
    """
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
    """The value of a cell as a trial holds it: numbers in SI, paths inside the folder."""
    if column.kind == "path":
        return safe_join(folder, value)
    return column.to_si(float(value)) if column.kind in ("number", "choice") else value


def _position_systematic_m(settings: ExperimentSettings, values: dict[str, Any]) -> float:
    """Smooth error of positions, standard deviation, m: as stated, else by what is known of the lens.

    A target of many corners shows the distortion of the lens; two points or a scale do not, nor do positions that
    somebody else measured, or a scale of the trial's own, say whether it was corrected. Of a trial that nobody has
    filmed yet nothing is known: NaN.
    """
    if settings.position_systematic_mm is not None:
        return settings.position_systematic_mm / 1e3
    if "track" not in values and "video" not in values:
        return math.nan
    measured = "track" in values or "mm_per_px" in values
    knows_lens = isinstance(settings.calibration, (Charuco, Checkerboard)) and not measured
    return 0.0 if knows_lens else POSITION_SYSTEMATIC_M
