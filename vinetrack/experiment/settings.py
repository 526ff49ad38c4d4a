"""Settings shared by all trials (`experiment.yaml`) and settings of the analysis (`config/config.yaml`).

The pydantic models below define all keys, defaults, allowed values and meanings; a string beside a type says how to
measure the value. A test keeps `config/config.yaml` consistent with them. All unknown keys, repeated keys and values
that are not allowed are reported together.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    create_model,
    field_validator,
    model_validator,
)

from vinetrack.core.problems import ExperimentError, Problem, did_you_mean
from vinetrack.core.records import Bend
from vinetrack.core.tables import Table, TableError, YamlDocument, parse_number, read_yaml
from vinetrack.core.units import BASE_EFFECTS, UNITS, convert, other_units, split_unit
from vinetrack.experiment.schema import (
    COLUMNS,
    LIMITED,
    SHARED,
    SMALLEST_POINT_SPACING_PX,
    CellError,
    read_cell,
    read_limit,
    read_range,
)


def _no_yes_or_no(value: Any) -> Any:
    """Refuse yes and no, which pydantic would convert to 1 and 0."""
    if isinstance(value, bool):
        raise CellError("is yes or no where a number belongs", "write the number", code="not_a_number")
    return value


Number = Annotated[float, BeforeValidator(_no_yes_or_no)]
Count = Annotated[int, BeforeValidator(_no_yes_or_no)]
Positive = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(gt=0, le=1)]
Pixel = tuple[Number, Number]
Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    """Base of all settings: immutable, without unknown keys, NaN or infinity."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True, use_attribute_docstrings=True
    )


class _TwoEnds(_Strict):
    from_px: Annotated[Pixel, "Any picture viewer shows it."]
    """First point, x to the right and y down from the upper left corner."""
    to_px: Annotated[Pixel, "Any picture viewer shows it."]
    """Second point."""

    @model_validator(mode="after")
    def _has_a_length(self) -> _TwoEnds:
        via_px: tuple[Pixel, ...] = getattr(self, "via_px", None) or ()
        through = (self.from_px, *via_px, self.to_px)
        if not via_px and self.from_px == self.to_px:
            raise CellError("from_px and to_px are the same point", "name two", code="too_close")
        if via_px and any(math.dist(a, b) < SMALLEST_POINT_SPACING_PX for a, b in pairwise(through)):
            message = f"neighbouring points are less than {SMALLEST_POINT_SPACING_PX} pixels apart"
            raise CellError(message, "leave out the second", code="too_close")
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


class _Board(_Strict):
    image: Annotated[str, "Film it with the settings of the trials."]
    """Picture or clip of the target, in the plane of growth."""
    squares: Annotated[tuple[Annotated[Count, Field(ge=2)], Annotated[Count, Field(ge=2)]], "Count them."]
    """Squares across and down."""
    square_mm: Annotated[Positive, "Calliper over ten printed squares, divided by ten: printers scale."]
    """Side of a square."""


class Checkerboard(_Board):
    """A checkerboard: `squares` across and down."""

    kind: Literal["checkerboard"]
    squares: Annotated[tuple[Annotated[Count, Field(ge=3)], Annotated[Count, Field(ge=3)]], "Count them."]
    """Squares across and down."""


class Charuco(_Board):
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
            raise CellError(message, remedy, code="markers")
        return self


Calibration = Annotated[Charuco | Checkerboard | TwoPoints | MmPerPx, Field(discriminator="kind")]

# Models of `calibration`, by its kind
CALIBRATIONS: dict[str, type[BaseModel]] = {
    **{"charuco": Charuco, "checkerboard": Checkerboard, "two_points": TwoPoints, "mm_per_px": MmPerPx}
}


def _optional_fields(types: Mapping[str, Any]) -> Any:
    """Return a base class with an optional field of each name and type, None by default."""
    fields: dict[str, Any] = {name: (kind | None, None) for name, kind in types.items()}
    return create_model("Columns", __base__=_Strict, **fields)


_LimitedColumns: Any = _optional_fields(
    dict.fromkeys(LIMITED["range"], tuple[float, float]) | dict.fromkeys(LIMITED["choice"], tuple[float, ...])
)


class Limits(_LimitedColumns):
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

    @field_validator(*LIMITED["range"], *LIMITED["choice"], mode="before")
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
        if not isinstance(value, list | tuple):
            return (read_limit(column, value),)
        if not value:
            raise CellError("is empty", "name at least one value, or remove the key", code="empty")
        return tuple(sorted({read_limit(column, limit) for limit in value}))


# Type of the value of each kind of column; all others are numbers
_TYPES: Any = {"text": str, "path": str, "bends": tuple[Bend, ...], "window": tuple[float, float], "yes_no": bool}
_SharedColumns: Any = _optional_fields({name: _TYPES.get(COLUMNS[name].kind, float) for name in SHARED})


class ExperimentSettings(_SharedColumns):
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
    0.04 % of the longest travel for positions measured elsewhere and for a scale from two points or mm_per_px, 0 for a
    calibration target."""
    model: tuple[str, ...] = BASE_EFFECTS
    """Effects of the model in use."""
    candidates: tuple[str, ...] | None = None
    """Effects that a diagnosis may propose; blank for the whole catalogue."""
    effects: tuple[str, ...] = ()
    """Paths of Python files with effects of your own."""
    strict: bool = False
    """Whether a fault of one trial stops the whole experiment."""
    axis: AxisSettings | None = None
    """The growth axis in the picture: from_px, to_px, width_mm, and via_px if it bends; found from the motion if
    blank."""
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
        if isinstance(value, bool | list | dict):
            raise CellError("is not a single value", "write one, as in the sheet", code="not_a_value")
        return read_cell(column, str(value).strip())

    @field_validator("model", "candidates", "effects")
    @classmethod
    def _named_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names and (twice := sorted({name for name in names if names.count(name) > 1})):
            raise CellError(f"names {twice[0]!r} twice", "keep one", code="twice")
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
    """How positions become velocities; see `vinetrack.kinematics.velocity`."""

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
            raise CellError("is empty", "name at least one of png, svg, pdf", code="empty")
        return tuple(dict.fromkeys(formats))


class OverlaySettings(_Strict):
    """Clips of the recordings with tracked and modelled edges; see `vinetrack.figures.overlay`."""

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
        return ExperimentSettings()
    document = read_yaml(path)
    _to_key_units(document, path.name, [] if warnings is None else warnings)
    return _validate(ExperimentSettings, document, path.name)


def run_settings(values: dict[str, Any]) -> RunSettings:
    """Validate settings of a run given as a mapping, such as Snakemake's `config`."""
    return _validate(RunSettings, YamlDocument(values, {}), "config.yaml")


def _validate(model: type[Model], document: YamlDocument, file: str) -> Model:
    """Return the document as a settings object; raise an ExperimentError with all its problems."""
    try:
        return model.model_validate(document.content)
    except ValidationError as error:
        raise ExperimentError([_as_problem(model, document, file, detail) for detail in error.errors()]) from None


def _as_problem(model: type[BaseModel], document: YamlDocument, file: str, detail: Any) -> Problem:
    """Convert a pydantic error to a problem that names the key, its line and what is allowed."""
    found = detail["loc"]
    # pydantic inserts the kind of a calibration between "calibration" and the key; the file does not contain it.
    location = (found[0], *found[2:]) if found[0] == "calibration" else found
    starts = (location[:n] for n in range(len(location), 0, -1))
    line = next((document.lines[start] for start in starts if start in document.lines), 0)
    place: dict[str, Any] = {"file": file, "line": line, "column": ".".join(str(part) for part in location)}
    if detail["type"] == "extra_forbidden":
        names = list(_group(model, found).model_fields)
        if same := [name for name in names if location[-1] in other_units(name)]:
            return Problem("twice", f"is {same[0]} again", remedy="keep one of the two", **place)
        remedy = did_you_mean(str(location[-1]), names) or "remove it"
        return Problem("unknown_key", "is not a setting", remedy=remedy, **place)
    if detail["type"] == "missing":
        return Problem("missing", "is missing", remedy="add it", **place)
    place["value"] = str(detail["input"]) if isinstance(detail["input"], str | int | float | bool) else None
    error = detail.get("ctx", {}).get("error")
    if isinstance(error, CellError):
        return Problem.from_error(error, **place)
    words = re.sub(r"a valid (tuple|list)", "a list", detail["msg"])
    words = re.sub(r"a valid dictionary.*", "a group of keys", words)
    return Problem("not_allowed", f"is not allowed: {words[:1].lower()}{words[1:]}", **place)


def _group(model: type[BaseModel], location: tuple[Any, ...]) -> type[BaseModel]:
    """Return the model of the group of keys that holds a location, as pydantic gives it."""
    if len(location) == 1:
        return model
    if location[0] == "calibration":
        return CALIBRATIONS[location[1]]
    return AxisSettings if location[0] == "axis" else type(model.model_fields[location[0]].default)


# ------------------------------------------------------------------------------
# Conversion of columns and keys in other units, such as `pressure_psi` or `diameter_in`, each with a warning.


def in_sheet_units(table: Table, file: str) -> tuple[Table, list[Problem]]:
    """Convert columns in other units to those of the sheet, with a warning each; of two units the blank gives way."""
    problems: list[Problem] = []
    known = {other: (name, unit) for name in COLUMNS for other, unit in other_units(name).items()}
    taken = {name for name in table.columns if any(row[name] for row in table.rows)}
    renamed: dict[str, tuple[str, str]] = {}
    for other in table.columns:
        if other in COLUMNS or other not in known:
            continue
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
    return replace(table, columns=columns, rows=tuple(rows)), problems


def _to_key_units(document: YamlDocument, file: str, problems: list[Problem]) -> None:
    """Convert keys in other units to those of the settings, with a warning each; of two units the blank gives way."""
    groups: dict[tuple[str, ...], Iterable[type[BaseModel]]] = {
        (): [ExperimentSettings],
        ("limits",): [Limits],
        ("axis",): [AxisSettings],
        ("calibration",): CALIBRATIONS.values(),
    }
    for path, models in groups.items():
        keys = document.content.get(path[0]) if path else document.content
        names = dict.fromkeys(name for model in models for name in model.model_fields)
        pairs = [(name, *other) for name in names for other in other_units(name).items()]
        for name, other, unit in pairs if isinstance(keys, dict) else ():
            if other not in keys or None not in (keys.get(name), keys[other]):
                continue
            value = keys.pop(other)
            if value is not None:
                line = document.lines[*path, name] = document.lines.get((*path, other), 0)
                keys[name] = _converted(value, unit, name)
                problems.append(_conversion(name, unit, column=".".join((*path, other)), file=file, line=line))


def _converted(value: Any, unit: str, name: str, decimal: str = ".") -> Any:
    """Convert the numbers of a cell or key to the unit of its name, to 15 digits; what is no number stays."""
    if isinstance(value, list):
        return [_converted(element, unit, name) for element in value]
    if isinstance(value, str) and ":" in value:
        return ":".join(_converted(part, unit, name, decimal) for part in value.split(":"))
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return value
    try:
        given = parse_number(value, decimal) if isinstance(value, str) else float(value)
    except TableError:
        return value
    text = f"{convert(given, unit, split_unit(name)[1]):.15g}"
    return text.replace(".", decimal or ".") if isinstance(value, str) else float(text)


def _conversion(name: str, unit: str, **place: Any) -> Problem:
    own = split_unit(name)[1]
    message = f"is read as {name}: 1 {UNITS[unit].text} is {convert(1.0, unit, own):.6g} {UNITS[own].text}"
    return Problem("unit", message, severity="warning", **place)
