"""Editing of `experiment.yaml` as text with its comments preserved, and a commented template for a new one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import TableError, read_text
from vinetrack.core.units import split_unit
from vinetrack.core.yaml_document import parse_yaml
from vinetrack.core.yaml_edit import with_value
from vinetrack.experiment.folder import SETTINGS
from vinetrack.experiment.schema import COLUMNS, SHARED

# Keys of a new file: what all trials of most campaigns share
FIRST_KEYS = ("capture_fps", "exposure_us", "yield_pressure_kPa", "growth_angle_deg", "chamber_l")

_HEAD = """\
# What all trials share; a column of the same name in trials.csv overrides it. The unit of a value is in its name, and
# a name may end in another one (yield_pressure_psi). `vinetrack settings` lists every key.
"""
_SCALE = """\
# The scale: two marks on a ruler in the plane of growth (kind: two_points, from_px, to_px, length_mm), a printed board
# (kind: charuco, image, squares, square_mm, marker_mm, dictionary), or the scale itself (kind: mm_per_px, mm_per_px).
calibration:
# The growth axis in the picture (from_px, to_px, width_mm); found from the motion if blank.
axis:
"""


def read_settings_text(folder: Path) -> str:
    """Return the text of `experiment.yaml`; if there is none, that of a template with blanks to fill."""
    path = folder / SETTINGS
    if not path.exists():
        return first_settings()
    try:
        text = read_text(path)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, SETTINGS)]) from None
    parse_yaml(text, SETTINGS)
    return text


def first_settings() -> str:
    """Return a template of `experiment.yaml`: keys without values, each with its meaning and how to measure it."""
    width = max(len(key) for key in FIRST_KEYS) + 3
    lines = [f"{f'{key}:':{width}}# {_comment(key)}\n" for key in FIRST_KEYS]
    return _HEAD + "".join(lines) + _SCALE


def _comment(key: str) -> str:
    column = COLUMNS[key]
    unit = f" [{column.unit}]" if column.unit and column.unit.lower() not in column.meaning.lower() else ""
    how = f" {column.measured}" if column.measured else ""
    blank = "" if column.default.startswith("required") else f" Blank: {column.default or 'unknown'}."
    return f"{column.meaning.rstrip('.')}{unit}.{how}{blank}"


def shared_values(text: str) -> dict[str, Any]:
    """Return the columns that the settings set for all trials, under the names (and units) used there."""
    quantities = {split_unit(name)[0] for name in SHARED}
    content = parse_yaml(text, SETTINGS).content
    return {
        key: value
        for key, value in content.items()
        if value is not None and (key in SHARED or split_unit(str(key))[0] in quantities)
    }


def with_shared(text: str, values: Mapping[str, str]) -> str:
    """Return the settings with columns set or cleared for all trials; other keys and all comments are kept."""
    content = parse_yaml(text, SETTINGS).content
    for key, cell in values.items():
        for other in [name for name in content if name != key and _same_quantity(str(name), key)]:
            if content[other] is not None:
                text = with_value(text, other, None, SETTINGS)
        value = _value(cell)
        if value is None and content.get(key) is None:
            continue
        if value is not None and content.get(key) is not None and str(content[key]) == str(value):
            continue
        text = with_value(text, key, value, SETTINGS)
    return text


def _same_quantity(name: str, other: str) -> bool:
    return split_unit(name)[0] == split_unit(other)[0] and bool(split_unit(name)[1])


def _value(cell: str) -> Any:
    """A cell as YAML would read it, so that a number is not quoted; None if it is blank."""
    cell = cell.strip()
    if not cell:
        return None
    try:
        read = parse_yaml(f"v: {cell}\n", SETTINGS).content["v"]
    except ExperimentError:
        return cell
    return read if isinstance(read, int | float | bool | str) else cell
