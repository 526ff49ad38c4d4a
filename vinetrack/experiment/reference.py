"""Reference of all columns of `trials.csv` and all keys of `experiment.yaml` and `config/config.yaml`.

Generated from the declarations that validate them, so that reference and validation agree.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from vinetrack.core.terminal import table
from vinetrack.core.units import UNITS, split_unit
from vinetrack.experiment.schema import COLUMNS, LIMITED, SHARED
from vinetrack.experiment.settings import (
    AxisSettings,
    Charuco,
    Checkerboard,
    ExperimentSettings,
    MmPerPx,
    RunSettings,
    TwoPoints,
)

_BOUNDS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}

# Allowed values of columns that are not bounded numbers, by kind
_KIND_ALLOWED = {
    "text": "letters, digits, _ and -",
    "path": "a path inside the folder",
    "bends": "start_mm:arc_mm:radius_mm;…",
    "window": "from_s:to_s",
    "axis": "x,y:x,y[:x,y…][:width_mm]",
    "frames": "from:to",
    "yes_no": "yes, no",
    "choice": "1, 2",
}


# Groups of keys about the picture: key of the group, its kind, and the model that validates it
_PICTURE_MODELS = (
    ("calibration", "charuco", Charuco),
    ("calibration", "checkerboard", Checkerboard),
    ("calibration", "two_points", TwoPoints),
    ("calibration", "mm_per_px", MmPerPx),
    ("axis", "", AxisSettings),
)

# Meaning of each of those keys, and how to measure it
_PICTURE_MEANINGS = {
    "image": ("Picture or clip of the target, in the plane of growth.", "Film it with the settings of the trials."),
    "squares": ("Squares across and down.", "Count them."),
    "square_mm": ("Side of a square.", "Calliper over ten printed squares, divided by ten: printers scale."),
    "marker_mm": ("Side of a marker inside its square.", "Calliper."),
    "dictionary": ("Marker dictionary of the board, by its OpenCV name.", "Stated by the program that printed it."),
    "from_px": ("First point, x to the right and y down from the upper left corner.", "Any picture viewer shows it."),
    "to_px": ("Second point.", "Any picture viewer shows it."),
    "via_px": (
        "Intermediate points of a curved path, in order; a smooth curve passes through all.",
        "Like the ends.",
    ),
    "length_mm": ("Distance between the two points.", "Two marks of a ruler in the plane of growth."),
    "mm_per_px": ("Scale of the picture.", "Length of a ruler in the plane of growth over its pixels."),
    "width_mm": ("Width of the strip along the axis that is tracked.", "About the diameter of the vine."),
}

_PICTURE_DEFAULTS = {"via_px": "none: a straight line"}  # Defaults of optional keys

# Introduction of the page
_PAGE_HEAD = """# Every column and key

Generated from the declarations that validate them: `vinetrack settings` prints the same, `vinetrack settings --json -`
prints it for a program, and `vinetrack settings --page docs/settings.md` writes this page. A column, or a key of
`experiment.yaml`, may state another unit in its name (`pressure_psi`, `diameter_in`, …): it is converted, and
`vinetrack check` reports the conversion. A blank cell means the default; a blank `growth_angle_deg` means straight
down.
"""


@dataclass(frozen=True)
class Entry:
    """Reference entry of a column or key; fields that do not apply are blank. `measured` says how to measure it."""

    name: str
    unit: str
    default: str
    allowed: str
    meaning: str
    measured: str = ""


def column_entries() -> list[Entry]:
    """Entries of all columns of the trial sheet, in the order of their declaration."""
    return [
        Entry(
            name=column.name,
            unit=column.unit,
            default=column.default,
            allowed=_KIND_ALLOWED.get(column.kind) or column.allowed.removesuffix(column.unit).rstrip(),
            meaning=column.meaning,
            measured=column.measured,
        )
        for column in COLUMNS.values()
    ]


def setting_entries(model: type[BaseModel], prefix: str = "") -> Iterator[Entry]:
    """Yield the entries of all keys of a settings model that are not columns; keys of a group as `group.key`."""
    columns = SHARED if model is ExperimentSettings else ()
    for name, field in model.model_fields.items():
        if name in columns:
            continue
        limited = next((kind for kind, names in LIMITED.items() if prefix == "limits." and name in names), "")
        if limited:
            words = "Range to choose from." if limited == "range" else "Values to choose from."
            unit = COLUMNS[name].unit
            allowed = COLUMNS[name].allowed.removesuffix(unit).rstrip()
            yield Entry(prefix + name, unit, "as in the trials so far", allowed, words)
            continue
        key = split_unit(name)[1]
        yield Entry(
            prefix + name,
            UNITS[key].text if key else "",
            _default(field),
            _allowed(field),
            " ".join((field.description or "").split()),
        )
        if isinstance(field.default, BaseModel):
            yield from setting_entries(type(field.default), f"{name}.")


def picture_entries() -> list[Entry]:
    """Entries of the keys of `calibration`, by its kind, and of `axis`."""
    entries = []
    for prefix, kind, model in _PICTURE_MODELS:
        for name, field in model.model_fields.items():
            if name != "kind":
                meaning = _PICTURE_MEANINGS[name]
                ends = {"_per_px": "mm/px", "_mm": "mm", "_px": "px"}
                unit = next((text for end, text in ends.items() if name.endswith(end)), "")
                of_kind = f" (kind: {kind})" if kind else ""
                default = "required" if field.is_required() else _PICTURE_DEFAULTS.get(name, "from the motion")
                entries.append(Entry(f"{prefix}.{name}{of_kind}", unit, default, _allowed(field), *meaning))
    return entries


def _groups() -> tuple[tuple[str, list[Entry]], ...]:
    """Title and entries of each part of the reference."""
    not_shared = ", ".join(name for name, column in COLUMNS.items() if not column.shared)
    return (
        (f"Columns of trials.csv; all but {not_shared} may be set in experiment.yaml for all trials", column_entries()),
        ("Keys of experiment.yaml", list(setting_entries(ExperimentSettings))),
        ("Keys of calibration and axis in experiment.yaml", picture_entries()),
        ("Keys of config/config.yaml, also --config key=value of snakemake", list(setting_entries(RunSettings))),
    )


def reference_page() -> str:
    """Return the reference as the page `docs/settings.md`."""
    parts = [_PAGE_HEAD]
    for title, entries in _groups():
        heading, _, shared = title.partition("; ")
        parts += [f"## {heading}", ""]
        parts += [f"{shared[0].upper()}{shared[1:]}.", ""] if shared else []
        parts += ["| name | unit | default | allowed | meaning | how to measure it |", "|---|---|---|---|---|---|"]
        for e in entries:
            cells = (f"`{e.name}`", e.unit, e.default, e.allowed, e.meaning, e.measured)
            parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append("")
    return "\n".join(parts)


def reference_lines() -> list[str]:
    """Return the reference as aligned lines for the terminal, one per column or key."""
    head = ("name", "unit", "default", "allowed", "meaning")
    lines: list[str] = []
    for title, entries in _groups():
        rows = [(e.name, e.unit, e.default, e.allowed, f"{e.meaning} {e.measured}".rstrip()) for e in entries]
        lines += ["", title, *table(rows, head, indent="  ", align="<<<<<")]
    lines += [
        "",
        "A column may state another unit in its name (pressure_psi, pressure_bar, diameter_in, …): it is converted.",
    ]
    return lines[1:]


def _default(field: FieldInfo) -> str:
    value = field.default
    if value is None or isinstance(value, BaseModel):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _allowed(field: FieldInfo) -> str:
    """Choices or bounds of a key, read from its annotation."""
    choices = [str(choice) for part in _parts(field.annotation) for choice in _literals(part)]
    if choices:
        return ", ".join(dict.fromkeys(choices))
    bounds = [(name, getattr(rule, name)) for rule in _rules(field) for name in _BOUNDS if hasattr(rule, name)]
    return ", ".join(dict.fromkeys(f"{_BOUNDS[name]} {value:g}" for name, value in bounds))


def _rules(field: FieldInfo) -> list[Any]:
    """Constraints of a key, including those of annotated parts of a union."""
    rules = list(field.metadata)
    for part in _parts(field.annotation):
        for rule in getattr(part, "__metadata__", ()):
            rules += rule.metadata if isinstance(rule, FieldInfo) else [rule]
    return rules


def _parts(annotation: Any) -> tuple[Any, ...]:
    several = get_origin(annotation) in (types.UnionType, Union, tuple)
    return get_args(annotation) if several else (annotation,)


def _literals(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def reference_content() -> dict[str, list[dict[str, str]]]:
    """Return the reference for a program: lists of entries under `columns`, `experiment`, `picture` and `run`."""
    groups = {
        "columns": column_entries(),
        "experiment": list(setting_entries(ExperimentSettings)),
        "picture": picture_entries(),
        "run": list(setting_entries(RunSettings)),
    }
    return {name: [asdict(entry) for entry in entries] for name, entries in groups.items()}
