"""Manual corrections of tracked points: `corrections.csv` beside the trial sheet.

One line per point: `trial, frame, action, edge_px`. The tracker applies the action and flags the point `corrected`; the
position that it had found itself is kept in the results.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from vinetrack.core.problems import Problem
from vinetrack.core.records import CORRECTION_ACTIONS, Correction
from vinetrack.core.tables import Table, TableError, parse_number, read_table

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
        return {}, [Problem(message="is missing", file=CORRECTIONS_FILE, column=missing[0], remedy=remedy)]
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
            message, _, remedy = str(error).partition(": ")
            problems.append(_problem(table, index, column, message, remedy))
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
