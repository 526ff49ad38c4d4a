"""Conversion of columns and keys in other units, such as `pressure_psi` or `diameter_in`, each with a warning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from vinetrack.core.problems import Problem
from vinetrack.core.tables import Table, TableError, parse_number
from vinetrack.core.units import UNITS, convert, split_unit
from vinetrack.core.yaml_document import YamlDocument, read_yaml
from vinetrack.experiment.column import Column
from vinetrack.experiment.schema import COLUMNS, column_in_other_unit


def in_sheet_units(table: Table, file: str) -> tuple[Table, list[Problem]]:
    """Convert columns in other units to the columns of the sheet. Returns table, problems: The table with those columns
    renamed and their numbers converted, and a warning for each.
    """
    problems: list[Problem] = []
    renamed: dict[str, tuple[Column, str]] = {}
    for name in table.columns:
        if name in COLUMNS or (other := column_in_other_unit(name)) is None:
            continue
        column, unit = other
        place: dict[str, Any] = {"file": file, "line": 1, "column": name, "severity": "warning"}
        if column.name in table.columns or column.name in [target.name for target, _ in renamed.values()]:
            problems.append(Problem(message=f"is ignored, because the sheet also has {column.name}", **place))
            continue
        renamed[name] = other
        problems.append(Problem(message=_conversion(column, unit), **place))
    if not renamed:
        return table, problems
    rows = tuple(
        {
            (renamed[name][0].name if name in renamed else name): (
                _converted(cell, renamed[name][1], renamed[name][0], table.decimal) if name in renamed else cell
            )
            for name, cell in row.items()
        }
        for row in table.rows
    )
    columns = tuple(renamed[name][0].name if name in renamed else name for name in table.columns)
    return replace(table, columns=columns, rows=rows), problems


def _converted(cell: str, unit: str, column: Column, decimal: str) -> str:
    """Return a cell converted to the unit of its column, to 15 digits, with the decimal mark of the sheet."""
    try:
        value = convert(parse_number(cell, decimal), unit, split_unit(column.name)[1])
    except TableError:
        return cell
    return f"{value:.15g}".replace(".", decimal or ".")


def in_key_units(document: YamlDocument, file: str) -> tuple[YamlDocument, list[Problem]]:
    """Convert keys in other units, such as `pressure_psi`, to the keys of the settings. Returns document, problems: The
    document with those keys renamed and their numbers converted, and a warning for each.
    """
    problems: list[Problem] = []
    if not isinstance(document.content, dict):
        return document, problems
    content, lines = {}, dict(document.lines)
    for key, value in document.content.items():
        other = column_in_other_unit(key) if isinstance(key, str) and key not in COLUMNS else None
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if other is None or not is_number or not other[0].shared or other[0].name in document.content:
            content[key] = value
            continue
        column, unit = other
        unit_of_column = split_unit(column.name)[1]
        content[column.name] = float(f"{convert(float(value), unit, unit_of_column):.15g}")
        line = lines.get((key,), 0)
        lines[column.name,] = line
        message = _conversion(column, unit)
        problems.append(Problem(message=message, severity="warning", file=file, line=line, column=key))
    return YamlDocument(content, lines), problems


def keys_in_other_units(path: Path) -> list[Problem]:
    """Return the warnings of `in_key_units` for a settings file."""
    return in_key_units(read_yaml(path), path.name)[1] if path.exists() else []


def _conversion(column: Column, unit: str) -> str:
    size = convert(1.0, unit, split_unit(column.name)[1])
    return f"is read as {column.name}: 1 {UNITS[unit].text} is {size:.6g} {column.unit}"
