"""Data exchanged between page and files: available columns, cells, settings, and problems with their fields."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Correction
from vinetrack.core.units import UNITS, split_unit
from vinetrack.core.yaml_document import parse_yaml
from vinetrack.core.yaml_edit import with_value
from vinetrack.experiment.folder import SETTINGS, check_experiment
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.sheet import REQUIRED_COLUMNS
from vinetrack.setup_page.clip_names import list_pictures, list_recordings, list_tables, units_of
from vinetrack.setup_page.draft_files import Draft, draft_folder, open_draft, same_cells
from vinetrack.setup_page.settings_draft import shared_values, with_shared
from vinetrack.setup_page.sheet_draft import SheetDraft, read_draft

# Columns that the page always shows, whether or not the sheet has them
OFFERED_COLUMNS = (
    "capture_fps",
    *REQUIRED_COLUMNS,
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "exposure_us",
    "pressure_trace",
)


def page_state(folder: Path) -> dict[str, Any]:
    """Return the initial state of the page. Returns mapping of JSON types."""
    draft = open_draft(folder)
    present = read_draft(folder)
    content = parse_yaml(draft.settings, SETTINGS).content
    shared = {key: str(value) for key, value in shared_values(draft.settings).items()}
    return {
        "name": folder.resolve().name,
        "folder": str(folder),
        "stamp": draft.stamp,
        "known": {name: _column_json(name) for name in COLUMNS if name not in ("trial", "video")},
        "units": {key: unit.text for key, unit in UNITS.items()},
        "offered": list(OFFERED_COLUMNS),
        "sheet": _sheet_json(draft.sheet),
        "kept": list(present.columns) if present.rows else ["trial", "video"],
        "unsaved": not (folder / SETTINGS).exists() or not present.rows or not same_cells(present, draft.sheet),
        "shared": shared,
        "calibration": content.get("calibration"),
        "axis": content.get("axis"),
        "corrections": {
            trial: [vars(correction) | _place(correction) for correction in given]
            for trial, given in draft.corrections.items()
        },
        "recordings": list_recordings(folder),
        "pictures": list_pictures(folder),
        "traces": list_tables(folder),
    }


def _column_json(name: str) -> dict[str, Any]:
    column = COLUMNS[name]
    return {
        "quantity": split_unit(name)[0],
        "units": units_of(name),
        "unit": split_unit(name)[1] if units_of(name) else "",
        "kind": column.kind,
        "meaning": column.meaning,
        "measured": column.measured,
        "default": column.default,
        "shared": name in SHARED,
    }


def _sheet_json(sheet: SheetDraft) -> dict[str, Any]:
    rows = [dict(row) for row in sheet.rows]
    return {"columns": list(sheet.columns), "rows": rows, "delimiter": sheet.delimiter, "decimal": sheet.decimal}


def _place(correction: Correction) -> dict[str, Any]:
    """New position of a moved point for JSON, with None for NaN."""
    return {"edge_px": correction.edge_px if math.isfinite(correction.edge_px) else None}


def _frame(point: Mapping[str, Any]) -> int:
    return int(point["frame"])


def _correction(point: Mapping[str, Any]) -> Correction:
    """A correction from the JSON of the page."""
    edge_px = math.nan if point["edge_px"] is None else float(point["edge_px"])
    return Correction(_frame(point), str(point["action"]), edge_px)


def draft_from_json(folder: Path, content: Mapping[str, Any]) -> Draft:
    """Return the draft sent by the page; comments and keys unknown to the page come from the files."""
    from_files = open_draft(folder)
    sent = content["sheet"]
    columns = tuple(str(column) for column in sent["columns"])
    rows = tuple({name: str(row.get(name, "")) for name in columns} for row in sent["rows"])
    sheet = SheetDraft(columns, rows, from_files.sheet.delimiter, from_files.sheet.decimal)
    text = with_shared(from_files.settings, {str(key): str(cell) for key, cell in content["shared"].items()})
    present = parse_yaml(text, SETTINGS).content
    for key in ("calibration", "axis"):
        value = content.get(key)
        if value is not None or present.get(key) is not None:
            text = with_value(text, key, value, SETTINGS)
    given = content.get("corrections", {}).items()
    corrections = {str(trial): tuple(map(_correction, sorted(points, key=_frame))) for trial, points in given if points}
    return Draft(sheet, text, str(content["stamp"]), corrections)


def draft_problems(folder: Path, draft: Draft, thorough: bool = False) -> dict[str, Any]:
    """Return the messages of `vinetrack check` for a draft, each problem with the field concerned. Returns mapping of
    JSON types: `problems` (severity, trial, column, text, field), `notes`, `understood`.
    """
    notes: list[str] = []
    understood: list[str] = []
    with draft_folder(folder, draft) as copy:
        if thorough:
            from vinetrack.pipeline.check_stage import check_folder

            checked = check_folder(copy)
            problems, notes, understood = list(checked.problems), list(checked.notes), list(checked.recording_lines)
        else:
            problems = [*check_experiment(copy), *_scale_missing(draft)]
    return {
        "problems": [_problem_json(problem, draft) for problem in problems],
        "notes": notes,
        "understood": understood,
    }


def _scale_missing(draft: Draft) -> list[Problem]:
    """The problem that the check of recordings would report for a missing scale."""
    content = parse_yaml(draft.settings, SETTINGS).content
    has_scale = content.get("calibration") is not None or content.get("mm_per_px") is not None
    without = [row for row in draft.sheet.rows if row.get("video") and not row.get("mm_per_px")]
    if has_scale or not without:
        return []
    remedy = "click two marks on a ruler, or choose a picture of a printed board"
    return [Problem(message="is missing: no recording has a scale", file=SETTINGS, column="calibration", remedy=remedy)]


def problems_json(error: ExperimentError) -> list[dict[str, Any]]:
    """Return the problems of a draft that cannot be read at all."""
    return [_problem_json(problem, None) for problem in error.problems]


def _problem_json(problem: Problem, draft: Draft | None) -> dict[str, Any]:
    """A problem with its field: a cell of the sheet, a value for all trials, the scale, the axis, or `whole`."""
    column = problem.column
    field = "whole"
    if column.split(".")[0] in ("calibration", "axis") and not problem.trial:
        field = column.split(".")[0]
    elif problem.trial and column:
        field = "cell"
    elif problem.trial:
        field = "row"
    elif column in COLUMNS or split_unit(column)[0] in {split_unit(name)[0] for name in COLUMNS}:
        field = "shared"
    if field in ("cell", "shared") and draft is not None:
        column = _as_drafted(column, draft)
    return {
        "severity": problem.severity,
        "field": field,
        "trial": problem.trial,
        "column": column,
        "text": problem.reason,
        "of_a_measurement": problem.of_a_measurement,
    }


def _as_drafted(column: str, draft: Draft) -> str:
    """The name of a column in the draft, which may have another unit."""
    quantity = split_unit(column)[0]
    return next((name for name in draft.sheet.columns if split_unit(name)[0] == quantity), column)
