"""Reference of all columns of `trials.csv` and all keys of `experiment.yaml` and `config/config.yaml`.

Generated from the declarations that validate them, so that reference and validation agree.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from vinetrack.core.terminal import table
from vinetrack.core.units import UNITS, split_unit
from vinetrack.experiment.schema import COLUMNS, LIMITED, SHARED
from vinetrack.experiment.settings import CALIBRATIONS, AxisSettings, ExperimentSettings, Limits, RunSettings


class Entry(NamedTuple):
    """Reference entry of a column or key; fields that do not apply are blank. `measured` says how to measure it."""

    name: str
    unit: str
    default: str
    allowed: str
    meaning: str
    measured: str = ""


def _bounds_of(column: str) -> str:
    """Allowed values of a column without its unit, which has a place of its own."""
    return COLUMNS[column].allowed.removesuffix(COLUMNS[column].unit).rstrip()


def setting_entries(model: type[BaseModel], prefix: str = "", suffix: str = "") -> Iterator[Entry]:
    """Yield the entries of all keys of a settings model that are not columns; keys of a group as `group.key`."""
    for name, field in model.model_fields.items():
        if name == "kind" or (model is ExperimentSettings and name in SHARED):
            continue
        if model is Limits and name in COLUMNS:
            words = "Range to choose from." if name in LIMITED["range"] else "Values to choose from."
            yield Entry(prefix + name, COLUMNS[name].unit, "as in the trials so far", _bounds_of(name), words)
            continue
        key = split_unit(name)[1]
        unit = UNITS[key].text if key else "mm/px" if name == "mm_per_px" else "px" if name.endswith("_px") else ""
        meaning = " ".join((field.description or "").split())
        measured = next((text for text in field.metadata if isinstance(text, str)), "")
        yield Entry(f"{prefix}{name}{suffix}", unit, _default(name, field), _allowed(field), meaning, measured)
        if isinstance(field.default, BaseModel):
            yield from setting_entries(type(field.default), f"{name}.")


def _picture_entries() -> Iterator[Entry]:
    """Yield the entries of the keys of `calibration`, by its kind, and of `axis`."""
    for kind, model in CALIBRATIONS.items():
        yield from setting_entries(model, "calibration.", f" (kind: {kind})")
    yield from setting_entries(AxisSettings, "axis.")


def reference_content() -> dict[str, list[dict[str, str]]]:
    """Return the reference for a program: lists of entries under `columns`, `experiment`, `picture` and `run`."""
    return {name: [entry._asdict() for entry in entries] for name, _, entries in _groups()}


def _groups() -> tuple[tuple[str, str, list[Entry]], ...]:
    """Name, title and entries of each part of the reference."""
    not_shared = ", ".join(name for name, column in COLUMNS.items() if not column.shared)
    title = f"Columns of trials.csv; all but {not_shared} may be set in experiment.yaml for all trials"
    run_title = "Keys of config/config.yaml, also --config key=value of snakemake"
    columns = [Entry(c.name, c.unit, c.default, _bounds_of(c.name), c.meaning, c.measured) for c in COLUMNS.values()]
    return (
        ("columns", title, columns),
        ("experiment", "Keys of experiment.yaml", list(setting_entries(ExperimentSettings))),
        ("picture", "Keys of calibration and axis in experiment.yaml", list(_picture_entries())),
        ("run", run_title, list(setting_entries(RunSettings))),
    )


def reference_page() -> str:
    """Return the reference as the page `docs/settings.md`."""
    parts = [
        "# Every column and key",
        "",
        "Generated from the declarations that validate them: `vinetrack settings` prints the same,",
        "`vinetrack settings --json -` prints it for a program, and `vinetrack settings --page docs/settings.md`",
        "writes this page. A column, or a key of `experiment.yaml`, may state another unit in its name",
        "(`pressure_psi`, `diameter_in`, …): it is converted, and `vinetrack check` reports the conversion.",
        "A blank cell means the default.",
        "",
    ]
    for _, title, entries in _groups():
        heading, _, shared = title.partition("; ")
        parts += [f"## {heading}", ""]
        parts += [f"{shared[0].upper()}{shared[1:]}.", ""] if shared else []
        parts += ["| name | default | allowed | meaning, *how to measure it* |", "|---|---|---|---|"]
        for e in entries:
            measured = f" *{e.measured}*" if e.measured else ""
            cells = (f"`{e.name}`", e.default, e.allowed, e.meaning + measured)
            parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append("")
    return "\n".join(parts)


def reference_lines() -> list[str]:
    """Return the reference as aligned lines for the terminal, one per column or key."""
    head = ("name", "unit", "default", "allowed", "meaning")
    lines: list[str] = []
    for _, title, entries in _groups():
        rows = [(e.name, e.unit, e.default, e.allowed, f"{e.meaning} {e.measured}".rstrip()) for e in entries]
        lines += [title, *table(rows, head, indent="  ", align="<<<<<"), ""]
    return [
        *lines,
        "A column may state another unit in its name (pressure_psi, pressure_bar, diameter_in, …): it is converted.",
    ]


def _default(name: str, field: FieldInfo) -> str:
    value = {"via_px": "none: a straight line", "width_mm": "from the motion"}.get(name, field.default)
    if field.is_required():
        return "required"
    if value is None or isinstance(value, BaseModel):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _allowed(field: FieldInfo) -> str:
    """Choices or bounds of a key, read from its annotation."""
    several = get_origin(field.annotation) in (types.UnionType, Union, tuple)
    parts: tuple[Any, ...] = get_args(field.annotation) if several else (field.annotation,)
    choices = [str(choice) for part in parts if get_origin(part) is Literal for choice in get_args(part)]
    if choices:
        return ", ".join(dict.fromkeys(choices))
    rules = list(field.metadata)
    for rule in (rule for part in parts for rule in getattr(part, "__metadata__", ())):
        rules += rule.metadata if isinstance(rule, FieldInfo) else [rule]
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    bounds = [f"{words[name]} {getattr(rule, name):g}" for rule in rules for name in words if hasattr(rule, name)]
    return ", ".join(dict.fromkeys(bounds))
