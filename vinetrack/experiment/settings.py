"""Settings shared by all trials (`experiment.yaml`) and settings of the analysis (`config/config.yaml`).

The pydantic models below define all keys, defaults, allowed values and meanings; a string beside a type says how to
measure the value. A test keeps `config/config.yaml` consistent with them. All unknown keys and values that are not
allowed are reported together.
"""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic.fields import FieldInfo
from pydantic.functional_validators import AfterValidator, BeforeValidator, field_validator, model_validator

from vinetrack.core.problems import ExperimentError, InputError, Problem
from vinetrack.core.tables import Table, YamlDocument, parse_number, read_yaml
from vinetrack.core.units import BASE_EFFECTS, UNITS, convert, other_units, split_unit
from vinetrack.experiment.schema import COLUMNS, LIMITED, SHARED, check_path, did_you_mean, read_range

InFolder = Annotated[str, AfterValidator(COLUMNS["track"].read)]  # A path, checked as in the sheet
NoTruth = BeforeValidator(lambda value: str(value) if isinstance(value, bool) else value)  # yes and no are no 1 and 0
# Text is read like a cell of the sheet
Number = Annotated[float, BeforeValidator(lambda v: parse_number(str(v)) if isinstance(v, str | bool) else v)]
Count = Annotated[int, NoTruth]
Positive = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(gt=0, le=1)]
Pixel = tuple[Number, Number]


class _Strict(BaseModel):
    """Base of all settings: immutable, without unknown keys, NaN or infinity."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True, use_attribute_docstrings=True
    )

    @classmethod
    def read_from(cls, document: YamlDocument, file: str) -> Self:
        """Return a document as settings; raise an ExperimentError with all its problems."""
        try:
            return cls.model_validate(document.content)
        except ValidationError as error:
            raise ExperimentError([_as_problem(cls, document, file, detail) for detail in error.errors()]) from None


class _TwoEnds(_Strict):
    from_px: Annotated[Pixel, "Any picture viewer shows it."]
    """First point, x to the right and y down from the upper left corner."""
    to_px: Annotated[Pixel, "Any picture viewer shows it."]
    """Second point."""

    @model_validator(mode="after")
    def _has_a_length(self) -> _TwoEnds:
        check_path((self.from_px, *(getattr(self, "via_px", None) or ()), self.to_px))
        return self


class AxisSettings(_TwoEnds):
    """The growth axis in the picture, and the width of the strip along it that is tracked."""

    via_px: Annotated[tuple[Pixel, ...] | None, "Like the ends."] = None
    """Intermediate points of a curved path, in order; a smooth curve passes through all."""
    width_mm: Annotated[Positive | None, "About the diameter of the vine."] = None
    """Width of the strip along the axis that is tracked."""


class MmPerPx(_Strict):
    """The scale, stated directly."""

    kind: Literal["mm_per_px"]
    mm_per_px: Annotated[Positive, "Length of a ruler in the plane of growth over its pixels."]
    """Scale of the picture."""


class TwoPoints(_TwoEnds):
    """Two points in the picture and the distance between them."""

    kind: Literal["two_points"]
    length_mm: Annotated[Positive, "Two marks of a ruler in the plane of growth."]
    """Distance between the two points."""

    @property
    def mm_per_px(self) -> float:
        """The scale, the same everywhere."""
        return self.length_mm / math.dist(self.from_px, self.to_px)


class Board(_Strict):
    """A printed target."""

    image: Annotated[InFolder, "Film it with the settings of the trials."]
    """Picture or clip of the target, in the plane of growth."""
    squares: Annotated[tuple[Annotated[Count, Field(ge=2)], Annotated[Count, Field(ge=2)]], "Count them."]
    """Squares across and down."""
    square_mm: Annotated[Positive, "Calliper over ten printed squares, divided by ten: printers scale."]
    """Side of a square."""


class Checkerboard(Board):
    """A checkerboard: `squares` across and down."""

    kind: Literal["checkerboard"]
    squares: Annotated[tuple[Annotated[Count, Field(ge=3)], Annotated[Count, Field(ge=3)]], "Count them."]
    """Squares across and down."""


class Charuco(Board):
    """A ChArUco board: `squares` across and down, and the OpenCV name of its marker dictionary."""

    kind: Literal["charuco"]
    marker_mm: Annotated[Positive, "Calliper."]
    """Side of a marker inside its square."""
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$"), "Stated by the program that printed it."]
    """Marker dictionary of the board, by its OpenCV name."""

    @model_validator(mode="after")
    def _markers_fit(self) -> Charuco:
        if self.marker_mm >= self.square_mm:
            message, remedy = "marker_mm is not smaller than square_mm", "markers lie inside their squares"
            raise InputError(message, remedy, code="markers")
        return self


Calibration = Annotated[Charuco | Checkerboard | TwoPoints | MmPerPx, Field(discriminator="kind")]

# Models of `calibration`, by its kind
CALIBRATIONS: dict[str, type[BaseModel]] = {"charuco": Charuco, "checkerboard": Checkerboard}
CALIBRATIONS |= {"two_points": TwoPoints, "mm_per_px": MmPerPx}


def _columns(names: Iterable[str]) -> Any:
    """Return a base class with a field of each name, None by default; its values are read like cells of the sheet."""
    fields: dict[str, Any] = dict.fromkeys(names, (Any, None))
    return create_model("Columns", __base__=_Strict, **fields)


class Limits(_columns(chain(*LIMITED.values()))):  # type: ignore[misc]
    """Constraints on further trials, for the design of the next experiment; None: the range of the trials so far.
    Pressure and payload are ranges (`7:40` or two numbers); the others are sets of values to choose from: one value, a
    list, or a range, of which five values are considered.
    """

    trials: Annotated[Count, Field(ge=1, le=24)] = 4
    """Largest number of further trials."""
    new_vines: bool = True
    """Whether new vines can be made for them."""
    hoop_stress_MPa: Positive = 7.8
    """Largest hoop stress allowed in the film."""

    @field_validator(*chain(*LIMITED.values()), mode="before")
    @classmethod
    def _as_in_the_sheet(cls, value: Any, info: Any) -> Any:
        column = COLUMNS[info.field_name]
        if value is None:
            return None
        if column.limit == "range":
            return read_range(column, value)
        if isinstance(value, str) and ":" in value:
            low, high = read_range(column, value)
            steps = np.geomspace(low, high, 5) if low > 0 else np.linspace(low, high, 5)
            return tuple(sorted({low, *(float(f"{step:.3g}") for step in steps[1:-1]), high}))
        limits = value if isinstance(value, list | tuple) else [value]
        if not limits:
            raise InputError("is empty", "name at least one value, or remove the key", code="empty")
        return tuple(sorted(set(map(column.read_key, limits))))


class ExperimentSettings(_columns(SHARED)):  # type: ignore[misc]
    """Settings shared by all trials of an experiment, in the unit of their name; None where not given. The columns that
    are declared `shared` may be set here for all trials; a cell of the sheet overrides them.
    """

    ambient_pressure_kPa: Annotated[Number, Field(gt=0, le=1000)] = 101.325
    """Absolute ambient pressure; used in the gas law of chambers."""
    tail_slack: Literal["taut", "free"] = "taut"
    """Whether a tail in which the model predicts compression goes slack (free) or stays taut."""
    tail_store: Literal["body", "reel"] = "body"
    """Where the tail is kept: in the body of the vine, or on a reel."""
    mass_loss: Literal["geometric", "as_printed"] = "geometric"
    """How the moving mass decreases: by the geometry of eversion, or as printed in the paper."""
    position_systematic_mm: Annotated[Number, Field(ge=0, le=100)] | None = None
    """Standard deviation of smooth position errors shared by all trials, such as lens distortion; by default
    0.04 % of the longest travel for positions measured elsewhere and for a scale from two points or mm_per_px, 0.005 %
    for a calibration target."""
    model: tuple[str, ...] = BASE_EFFECTS
    """Effects of the model in use."""
    candidates: tuple[str, ...] | None = None
    """Effects that a diagnosis may propose; blank for the whole catalogue."""
    effects: tuple[InFolder, ...] = ()
    """Paths of Python files with effects of your own."""
    strict: bool = False
    """Whether a fault of one trial stops the whole experiment."""
    axis: AxisSettings | None = None
    """The growth axis in the picture: from_px (where growth begins), to_px, width_mm, and via_px if it bends; found
    from the motion if blank."""
    calibration: Calibration | None = None
    """kind: charuco, checkerboard, two_points or mm_per_px, with the keys of that kind."""
    limits: Limits = Limits()
    """Constraints on further trials; see below."""
    published: Literal["simulated", "measured"] | None = None
    """Compare with the numbers of the paper: trials simulated from its parameters, or measured; blank: no
    comparison."""

    @property
    def paths(self) -> list[tuple[str, str]]:
        """All paths, each with its key."""
        image = getattr(self.calibration, "image", None)
        paths = [("effects", path) for path in self.effects]
        return paths if image is None else [*paths, ("calibration.image", image)]

    @field_validator(*SHARED, mode="before")
    @classmethod
    def _as_in_the_sheet(cls, value: Any, info: Any) -> Any:
        """Check a shared value like a cell of the sheet."""
        column = COLUMNS[info.field_name]
        if value is None or isinstance(value, tuple) or (isinstance(value, bool) and column.kind == "yes_no"):
            return value
        return column.read_key(value)

    @field_validator("model", "candidates", "effects")
    @classmethod
    def _named_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names and (twice := sorted({name for name in names if names.count(name) > 1})):
            raise InputError(f"names {twice[0]!r} twice", "keep one", code="twice")
        return names


class SteadySettings(_Strict):
    """When a stretch of motion counts as steady; see `vinetrack.kinematics.steady`."""

    drift_limit: Share = 0.03
    """Bound on the relative drift of speed across a steady window; must contain its 95 % interval."""
    start_fraction: Annotated[Number, Field(ge=0, lt=1)] = 0.2
    """A window may begin once the speed exceeds this fraction of the trial's largest speed,"""
    start_sigmas: Annotated[Number, Field(ge=0)] = 5.0
    """and this many standard errors of the speed."""
    paper_cv: Share = 0.03
    """The paper's rule: largest coefficient of variation of speed,"""
    paper_points: Annotated[Count, Field(ge=3)] = 3
    """over at least this many consecutive points."""


class VelocitySettings(_Strict):
    """How positions become velocities; see `vinetrack.kinematics.summary`."""

    kappa: Positive = 3.0
    """The smoothing window is the widest that agrees with all narrower ones within this many standard errors."""
    order: Annotated[Count, Field(ge=1, le=5)] = 3
    """Degree of the local polynomial."""


class DampingSettings(_Strict):
    """How the damping law and its intervals are computed; see `vinetrack.kinematics.damping`."""

    resamples: Annotated[Count, Field(ge=100)] = 2000
    """Resamplings of whole trials behind each 95 % interval."""
    seed: Annotated[Count, Field(ge=0)] = 1
    """Seed of the bootstrap."""


class FigureSettings(_Strict):
    """File formats of the figures."""

    formats: tuple[Literal["png", "svg", "pdf"], ...] = ("png", "svg")
    """Formats of every figure; the report holds the svg, or the png where there is none."""
    dpi: Annotated[Count, Field(ge=50, le=1200)] = 150
    """Resolution of png files, dots per inch."""

    @field_validator("formats")
    @classmethod
    def _some(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        if not formats:
            raise InputError("is empty", "name at least one of png, svg, pdf", code="empty")
        return formats


class OverlaySettings(_Strict):
    """Clips of the recordings with tracked and modelled edges; see `vinetrack.figures.motion_figures`."""

    of: Literal["one_per_condition", "all", "none"] = "one_per_condition"
    """Which recordings get a clip."""
    seconds: Positive = 6.0
    """Approximate duration of a clip, in seconds."""
    width_px: Annotated[Count, Field(ge=320, le=3840)] = 960
    """Width of the picture, in pixels."""


class RunSettings(_Strict):
    """Everything in `config/config.yaml`; any key may be overridden by `--config key=value`."""

    experiment: str = "data/demo"
    """The experiment's folder."""
    results: str | None = None
    """The results folder; blank for results/<name of the experiment>."""
    steady: SteadySettings = SteadySettings()
    """When a stretch of motion counts as steady; see below."""
    velocity: VelocitySettings = VelocitySettings()
    """How positions become velocities."""
    damping: DampingSettings = DampingSettings()
    """The damping law."""
    final_at_fraction: Share = 0.95
    """Fraction of the length at which final speeds are evaluated."""
    efficiency_at_mm: Positive = 150.0
    """Growth at which the energy efficiency is evaluated, in mm."""
    figures: FigureSettings = FigureSettings()
    """Files of the figures."""
    overlays: OverlaySettings = OverlaySettings()
    """Clips of the recordings."""


# ------------------------------------------------------------------------------
# Reading settings, with problems that name the key, its line and what is allowed.


def read_experiment_settings(path: Path, warnings: list[Problem] | None = None) -> ExperimentSettings:
    """Read `experiment.yaml`, and add to `warnings` what is converted; return the defaults if there is no such file."""
    # A broken link is an error, not a missing file: defaults would silently replace the intended settings.
    if not os.path.lexists(path):
        if other := next(path.parent.glob("[eE]xperiment.[yY]*"), None):
            raise ExperimentError([Problem("misnamed", f"is not read: rename it to {path.name}", file=other.name)])
        return ExperimentSettings()
    document = read_yaml(path)
    _to_key_units(document, path.name, [] if warnings is None else warnings)
    return ExperimentSettings.read_from(document, path.name)


def run_settings(values: dict[str, Any]) -> RunSettings:
    """Validate settings of a run given as a mapping, such as Snakemake's `config`."""
    return RunSettings.read_from(YamlDocument(values), "config.yaml")


def _as_problem(model: type[BaseModel], document: YamlDocument, file: str, detail: Any) -> Problem:
    """Convert a pydantic error to a problem that names the key, its line and what is allowed."""
    found = detail["loc"]
    # pydantic inserts the kind of a calibration between "calibration" and the key; the file does not contain it.
    location = (found[0], *found[2:]) if found[0] == "calibration" else found
    column = ".".join(str(part) for part in location)
    place: dict[str, Any] = {"file": file, "line": document.line(location), "column": column}
    if detail["type"] == "extra_forbidden":
        group: Any = model
        if len(found) > 1:
            of_axis = AxisSettings if found[0] == "axis" else type(model.model_fields[found[0]].default)
            group = CALIBRATIONS[found[1]] if found[0] == "calibration" else of_axis
        names = list(group.model_fields)
        if same := [name for name in names if location[-1] in other_units(name)]:
            return Problem("twice", f"is {same[0]} again", remedy="keep one of the two", **place)
        remedy = did_you_mean(str(location[-1]), names) or "remove it"
        return Problem("unknown_key", "is not a setting", remedy=remedy, **place)
    if detail["type"] == "missing":
        return Problem("missing", "is missing", remedy="add it", **place)
    if detail["type"].startswith("union_tag"):  # of a calibration, by its kind
        kind = detail["ctx"].get("tag", "")
        place |= {"column": "calibration.kind", "value": kind, "allowed": ", ".join(CALIBRATIONS)}
        return Problem("not_a_choice", "is unknown", remedy=did_you_mean(kind, CALIBRATIONS) or "add it", **place)
    place["value"] = str(detail["input"]) if isinstance(detail["input"], str | int | float | bool) else None
    error = detail.get("ctx", {}).get("error")
    if isinstance(error, InputError):
        return Problem.from_error(error, **place)
    words = re.sub(r"a valid (tuple|list)", "a list", detail["msg"])
    words = re.sub(r"a valid dictionary.*", "a group of keys", words)
    return Problem("not_allowed", f"is not allowed: {words[:1].lower()}{words[1:]}", **place)


# ------------------------------------------------------------------------------
# Conversion of columns and keys in other units, such as `pressure_psi` or `diameter_in`, each with a note.


def _in_other_units(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Every name of one of these quantities in another unit: its own name, and that unit."""
    return {other: (name, unit) for name in names for other, unit in other_units(name).items()}


def in_sheet_units(table: Table, file: str) -> tuple[Table, list[Problem]]:
    """Convert columns in other units to those of the sheet, with a note each; of two units the blank gives way."""
    problems: list[Problem] = []
    known, renamed = _in_other_units(COLUMNS), dict[str, tuple[str, str]]()
    taken = {name for name in table.columns if any(row[name] for row in table.rows)}
    for other in filter(known.__contains__, table.columns):
        name, unit = known[other]
        if name in taken:
            message = f"is ignored, because the sheet also has {name}"
            problems.append(Problem("twice", message, other, file=file, line=1, severity="warning"))
        else:
            taken.add(name)
            renamed[other] = name, unit
            problems.append(_conversion(name, unit, column=other, file=file, line=1))
    rows = [dict(row) for row in table.rows]
    for row in rows:
        for other, (name, unit) in renamed.items():
            row[name] = _converted(row.pop(other), unit, name, table.decimal)
    columns = tuple(dict.fromkeys(renamed.get(name, (name, ""))[0] for name in table.columns))
    return replace(table, columns=columns, rows=tuple(rows), units=dict(renamed.values())), problems


def _to_key_units(document: YamlDocument, file: str, problems: list[Problem]) -> None:
    """Convert keys in other units to those of the settings, with a note each; of two units the blank gives way."""
    of_group: dict[str, Any] = {"": [ExperimentSettings], "limits": [Limits], "axis": [AxisSettings]}
    for group, models in (of_group | {"calibration": CALIBRATIONS.values()}).items():
        keys, path = (document.content.get(group), (group,)) if group else (document.content, ())
        known = _in_other_units(name for model in models for name in model.model_fields)
        for other, (name, unit) in known.items() if isinstance(keys, dict) else ():
            if other not in keys or None not in (keys.get(name), keys[other]):
                continue
            if (value := keys.pop(other)) is not None:
                place = {"column": ".".join((*path, other)), "file": file, "line": document.line((*path, other))}
                document.text = document.text.replace(f"{other}:", f"{name}:")
                keys[name] = _converted(value, unit, name)
                problems.append(_conversion(name, unit, **place))


def _converted(value: Any, unit: str, name: str, decimal: str = ".") -> Any:
    """Convert the numbers of a cell or key to the unit of its name, to 15 digits; what is no number stays."""
    if isinstance(value, list):
        return [_converted(element, unit, name) for element in value]
    if isinstance(value, str) and ":" in value:
        return ":".join(_converted(part, unit, name, decimal) for part in value.split(":"))
    try:
        number = convert(parse_number(str(value), decimal), unit, split_unit(name)[1])
    except InputError:
        return value
    return f"{number:.15g}".replace(".", decimal or ".") if isinstance(value, str) else float(f"{number:.15g}")


def _conversion(name: str, unit: str, **place: Any) -> Problem:
    own = split_unit(name)[1]
    message = f"is read as {name}: 1 {UNITS[unit].text} is {convert(1.0, unit, own):.6g} {UNITS[own].text}"
    return Problem("unit", message, severity="note", **place)


# ------------------------------------------------------------------------------
# Reference of all columns and keys, generated from the declarations that validate them.


class Entry(NamedTuple):
    """Reference entry of a column or key; fields that do not apply are blank. `measured` says how to measure it."""

    name: str
    unit: str
    default: str
    allowed: str
    meaning: str
    measured: str = ""


def setting_entries(model: type[BaseModel], prefix: str = "", suffix: str = "") -> Iterator[Entry]:
    """Yield the entries of all keys of a settings model that are not columns; keys of a group as `group.key`."""
    for name, field in model.model_fields.items():
        if name == "kind" or (model is ExperimentSettings and name in SHARED):
            continue
        if model is Limits and name in COLUMNS:
            words = "Range to choose from." if name in LIMITED["range"] else "Values to choose from."
            yield Entry(prefix + name, COLUMNS[name].unit, "as in the trials so far", COLUMNS[name].bounds, words)
            continue
        key = split_unit(name)[1]
        unit = UNITS[key].text if key else "mm/px" if name == "mm_per_px" else "px" if name.endswith("_px") else ""
        meaning = " ".join((field.description or "").split())
        measured = next((text for text in field.metadata if isinstance(text, str)), "")
        yield Entry(f"{prefix}{name}{suffix}", unit, _default(name, field), _allowed(field), meaning, measured)
        if isinstance(field.default, BaseModel):
            yield from setting_entries(type(field.default), f"{name}.")


def reference_content() -> dict[str, list[dict[str, str]]]:
    """Return the reference for a program: lists of entries under `columns`, `experiment`, `picture` and `run`."""
    return {name: [entry._asdict() for entry in entries] for name, _, entries in _groups()}


def _groups() -> tuple[tuple[str, str, list[Entry]], ...]:
    """Name, title and entries of each part of the reference."""
    not_shared = ", ".join(name for name, column in COLUMNS.items() if not column.shared)
    title = f"Columns of trials.csv; all but {not_shared} may be set in experiment.yaml for all trials"
    run_title = "Keys of config/config.yaml, also --config key=value of snakemake"
    columns = [Entry(c.name, c.unit, c.default, c.bounds, c.meaning, c.measured) for c in COLUMNS.values()]
    picture = [setting_entries(of_kind, "calibration.", f" (kind: {kind})") for kind, of_kind in CALIBRATIONS.items()]
    picture.append(setting_entries(AxisSettings, "axis."))
    return (
        ("columns", title, columns),
        ("experiment", "Keys of experiment.yaml", list(setting_entries(ExperimentSettings))),
        ("picture", "Keys of calibration and axis in experiment.yaml", list(chain(*picture))),
        ("run", run_title, list(setting_entries(RunSettings))),
    )


def reference_page() -> str:
    """Return the reference as the page `docs/settings.md`."""
    page = """\
# Every column and key

Printed by `vinetrack settings`, also with `--json -`; `--page docs/settings.md` writes this page. A column, or a key of
`experiment.yaml`, may state another unit in its name (`pressure_psi`, `diameter_in`, …): it is converted, as `vinetrack
check` says; pages show pressures in it. A blank cell means the default.
"""
    for _, title, entries in _groups():
        heading, _, shared = title.partition("; ")
        page += f"\n## {heading}\n\n" + (f"{shared[0].upper()}{shared[1:]}.\n\n" if shared else "")
        page += "| name | default | allowed | meaning, *how to measure it* |\n|---|---|---|---|\n"
        for e in entries:
            cells = (f"`{e.name}`", e.default, e.allowed, f"{e.meaning} *{e.measured}*" if e.measured else e.meaning)
            page += "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
    return page


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
    rules = [*field.metadata, *(rule for part in parts for rule in getattr(part, "__metadata__", ()))]
    rules += [inner for rule in rules if isinstance(rule, FieldInfo) for inner in rule.metadata]
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    bounds = [f"{words[name]} {getattr(rule, name):g}" for rule in rules for name in words if hasattr(rule, name)]
    return ", ".join(dict.fromkeys(choices or bounds))
