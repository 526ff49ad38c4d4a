"""Settings shared by all trials (`experiment.yaml`) and settings of the analysis (`config/config.yaml`).

The pydantic models below define all keys, defaults and allowed values; a test keeps `config/config.yaml` consistent
with them. All unknown keys, repeated keys and values that are not allowed are reported together.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

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
from vinetrack.core.tables import Table, TableError, parse_number
from vinetrack.core.units import BASE_EFFECTS, UNITS, convert, other_units, split_unit
from vinetrack.core.yaml_document import YamlDocument, read_yaml
from vinetrack.experiment.schema import (
    COLUMNS,
    LIMITED,
    SHARED,
    SMALLEST_POINT_SPACING_PX,
    CellError,
    interior_values,
    read_limit,
    read_range,
    read_value,
)

# ------------------------------------------------------------------------------
# Conversion of columns and keys in other units, such as `pressure_psi` or `diameter_in`, each with a warning.


def in_sheet_units(table: Table, file: str) -> tuple[Table, list[Problem]]:
    """Rename columns in other units to those of the sheet and convert their numbers, with a warning for each. A column
    of the sheet without any value gives way to the same quantity in another unit.
    """
    problems: list[Problem] = []
    known = {other: (name, unit) for name in COLUMNS for other, unit in other_units(name).items()}
    filled = {name for name in table.columns if any(row[name] for row in table.rows)}
    renamed: dict[str, tuple[str, str]] = {}
    for name in table.columns:
        if name in COLUMNS or name not in known:
            continue
        column, unit = known[name]
        place: dict[str, Any] = {"file": file, "line": 1, "column": name, "severity": "warning"}
        if column in filled or column in [target for target, _ in renamed.values()]:
            problems.append(Problem(message=f"is ignored, because the sheet also has {column}", **place))
            continue
        renamed[name] = known[name]
        problems.append(Problem(message=_conversion(column, unit), **place))
    if not renamed:
        return table, problems
    blank = {column for column, _ in renamed.values()}
    names = {name: renamed[name][0] if name in renamed else name for name in table.columns if name not in blank}
    rows = tuple(
        {
            column: _converted(row[name], renamed[name][1], column, table.decimal) if name in renamed else row[name]
            for name, column in names.items()
        }
        for row in table.rows
    )
    return replace(table, columns=tuple(names.values()), rows=rows), problems


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


def _in_key_units(document: YamlDocument, file: str, problems: list[Problem]) -> YamlDocument:
    """Rename keys in other units, such as `pressure_psi`, to those of the settings and convert their numbers, with a
    warning for each. Of two keys for one quantity a blank one gives way.
    """
    content, lines = dict(document.content), dict(document.lines)
    for group, models in _GROUPS.items():
        keys = content if not group else content.get(group)
        if not isinstance(keys, dict):
            continue
        path, keys = ((group,) if group else ()), dict(keys)
        for name in [name for model in models for name in model.model_fields]:
            for other, unit in other_units(name).items():
                if other not in keys or None not in (keys.get(name), keys[other]):
                    continue
                value, line = keys.pop(other), lines.get((*path, other), 0)
                if value is None:
                    continue
                keys[name], lines[*path, name] = _converted(value, unit, name), line
                place: dict[str, Any] = {"file": file, "line": line, "column": ".".join((*path, other))}
                problems.append(Problem(message=_conversion(name, unit), severity="warning", **place))
        content = {**content, group: keys} if group else keys
    return YamlDocument(content, lines)


def _conversion(name: str, unit: str) -> str:
    own = split_unit(name)[1]
    return f"is read as {name}: 1 {UNITS[unit].text} is {convert(1.0, unit, own):.6g} {UNITS[own].text}"


def _no_yes_or_no(value: Any) -> Any:
    """Refuse yes and no, which pydantic would convert to 1 and 0."""
    if isinstance(value, bool):
        raise CellError("is yes or no where a number belongs", "write the number")
    return value


Number = Annotated[float, BeforeValidator(_no_yes_or_no)]
Count = Annotated[int, BeforeValidator(_no_yes_or_no)]
Positive = Annotated[Number, Field(gt=0)]
Pixel = tuple[Number, Number]
Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    """Base of all settings: immutable, without unknown keys, NaN or infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True)


def _optional_fields(types: dict[str, Any]) -> Any:
    """Return a base class with an optional field of each name and type, None by default."""
    fields: dict[str, Any] = {name: (kind | None, None) for name, kind in types.items()}
    return create_model("Columns", __base__=_Strict, **fields)


class AxisSettings(_Strict):
    """The growth axis in the picture, and the width of the strip along it that is tracked."""

    from_px: Pixel
    to_px: Pixel
    via_px: tuple[Pixel, ...] | None = None
    width_mm: Positive | None = None

    @model_validator(mode="after")
    def _has_a_direction(self) -> AxisSettings:
        through = (self.from_px, *(self.via_px or ()), self.to_px)
        if self.via_px and any(math.dist(a, b) < SMALLEST_POINT_SPACING_PX for a, b in pairwise(through)):
            message = f"neighbouring points are less than {SMALLEST_POINT_SPACING_PX} pixels apart"
            raise CellError(message, "leave out the second")
        if not self.via_px and self.from_px == self.to_px:
            raise CellError("from_px and to_px are the same point", "name two")
        return self


class MmPerPx(_Strict):
    """The scale, stated directly."""

    kind: Literal["mm_per_px"]
    mm_per_px: Positive


class TwoPoints(_Strict):
    """Two points in the picture and the distance between them."""

    kind: Literal["two_points"]
    from_px: Pixel
    to_px: Pixel
    length_mm: Positive

    @model_validator(mode="after")
    def _has_a_length(self) -> TwoPoints:
        if self.from_px == self.to_px:
            raise CellError("from_px and to_px are the same point", "name two")
        return self


class Checkerboard(_Strict):
    """A checkerboard: `squares` across and down."""

    kind: Literal["checkerboard"]
    image: str
    squares: tuple[Annotated[Count, Field(ge=3)], Annotated[Count, Field(ge=3)]]
    square_mm: Positive


class Charuco(_Strict):
    """A ChArUco board: `squares` across and down, and the OpenCV name of its marker dictionary."""

    kind: Literal["charuco"]
    image: str
    squares: tuple[Annotated[Count, Field(ge=2)], Annotated[Count, Field(ge=2)]]
    square_mm: Positive
    marker_mm: Positive
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$")]

    @model_validator(mode="after")
    def _markers_fit(self) -> Charuco:
        if self.marker_mm >= self.square_mm:
            raise CellError("marker_mm is not smaller than square_mm", "markers lie inside their squares")
        return self


Calibration = Annotated[Charuco | Checkerboard | TwoPoints | MmPerPx, Field(discriminator="kind")]


_LimitedColumns: Any = _optional_fields(
    dict.fromkeys(LIMITED["range"], tuple[float, float]) | dict.fromkeys(LIMITED["choice"], tuple[float, ...])
)


class Limits(_LimitedColumns):
    """Constraints on further trials, for the design of the next experiment; None: the range of the trials so far.
    Pressure and payload are ranges (`7:40` or two numbers); the others are sets of values to choose from: one value, a
    list, or a range, of which five values are considered.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    trials: Annotated[Count, Field(ge=1, le=24)] = 4
    """Largest number of further trials."""
    new_vines: bool = True
    """Whether new vines can be made for them."""
    hoop_stress_MPa: Positive = 7.8
    """Largest hoop stress allowed in the film."""

    @field_validator(*LIMITED["range"], mode="before")
    @classmethod
    def _range(cls, value: Any, info: Any) -> Any:
        return value if value is None else read_range(COLUMNS[info.field_name], value)

    @field_validator(*LIMITED["choice"], mode="before")
    @classmethod
    def _values(cls, value: Any, info: Any) -> Any:
        column = COLUMNS[info.field_name]
        if isinstance(value, str) and ":" in value:
            low, high = read_range(column, value)
            return tuple(sorted({low, *(float(f"{step:.3g}") for step in interior_values(low, high)), high}))
        if isinstance(value, list | tuple):
            if not value:
                raise CellError("is empty", "name at least one value, or remove the key")
            return tuple(sorted({read_limit(column, limit) for limit in value}))
        return value if value is None else (read_limit(column, value),)


# Type of the value of each kind of column
_TYPES: dict[str, Any] = {
    "number": float,
    "choice": float,
    "text": str,
    "path": str,
    "bends": tuple[Bend, ...],
    "window": tuple[float, float],
    "yes_no": bool,
}

_SharedColumns: Any = _optional_fields({name: _TYPES[COLUMNS[name].kind] for name in SHARED})


class ExperimentSettings(_SharedColumns):
    """Settings shared by all trials of an experiment, in the unit of their name; None where not given. The columns that
    are declared `shared` may be set here for all trials; a cell of the sheet overrides them.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    ambient_pressure_kPa: Annotated[Number, Field(gt=0, le=1000)] = 101.325
    """Absolute ambient pressure; used in the gas law of chambers."""
    tail_slack: Literal["taut", "free"] = "taut"
    """Whether a tail in which the model predicts compression goes slack (free) or stays taut."""
    tail_store: Literal["body", "reel"] = "body"
    """Where the tail is kept: in the body of the vine, or on a reel."""
    mass_loss: Literal["geometric", "as_printed"] = "geometric"
    """How the moving mass decreases: by the geometry of eversion, or as printed in the paper."""
    position_systematic_mm: Annotated[Number, Field(ge=0, le=100)] | None = None
    """Standard deviation of smooth position errors shared by all trials, such as lens distortion; by default 0.1 for
    positions measured elsewhere and for a scale from two points or mm_per_px, 0 for a calibration target."""
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

    @field_validator(*SHARED, mode="before")
    @classmethod
    def _as_in_the_sheet(cls, value: Any, info: Any) -> Any:
        """Check a shared value like a cell of the sheet."""
        column = COLUMNS[info.field_name]
        if value is None or isinstance(value, tuple) or (isinstance(value, bool) and column.kind == "yes_no"):
            return value
        if isinstance(value, bool | list | dict):
            raise CellError("is not a single value", "write one, as in the sheet")
        return read_value(column, value)

    @field_validator("model", "candidates", "effects")
    @classmethod
    def _named_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names and (twice := sorted({name for name in names if names.count(name) > 1})):
            raise CellError(f"names {twice[0]!r} twice", "keep one")
        return names


class SteadySettings(_Strict):
    """When a stretch of motion counts as steady; see `vinetrack.kinematics.steady`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    drift_limit: Annotated[Number, Field(gt=0, le=1)] = 0.03
    """Bound on the relative drift of speed across a steady window; must contain its 95 % interval."""
    start_fraction: Annotated[Number, Field(ge=0, lt=1)] = 0.2
    """A window may begin once the speed exceeds this fraction of the trial's largest speed,"""
    start_sigmas: Annotated[Number, Field(ge=0)] = 5.0
    """and this many standard errors of the speed."""
    paper_cv: Annotated[Number, Field(gt=0, le=1)] = 0.03
    """The paper's rule: largest coefficient of variation of speed,"""
    paper_points: Annotated[Count, Field(ge=3)] = 3
    """over at least this many consecutive points."""


class VelocitySettings(_Strict):
    """How positions become velocities; see `vinetrack.kinematics.velocity`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    kappa: Positive = 3.0
    """The smoothing window is the widest that agrees with all narrower ones within this many standard errors."""
    order: Annotated[Count, Field(ge=1, le=5)] = 3
    """Degree of the local polynomial."""


class DampingSettings(_Strict):
    """How the damping law and its intervals are computed; see `vinetrack.kinematics.damping`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    resamples: Annotated[Count, Field(ge=100)] = 2000
    """Resamplings of whole trials behind each 95 % interval."""
    seed: Annotated[Count, Field(ge=0)] = 1
    """Seed of the bootstrap."""


class FigureSettings(_Strict):
    """File formats of the figures."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    formats: tuple[Literal["png", "svg", "pdf"], ...] = ("png", "svg")
    """Formats of every figure; svg is always among them, since the report holds it."""
    dpi: Annotated[Count, Field(ge=50, le=1200)] = 150
    """Resolution of png files, dots per inch."""

    @field_validator("formats")
    @classmethod
    def _with_svg(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        if not formats:
            raise CellError("is empty", "name at least one of png, svg, pdf")
        return tuple(dict.fromkeys([*formats, "svg"]))


class OverlaySettings(_Strict):
    """Clips of the recordings with tracked and modelled edges; see `vinetrack.figures.overlay`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    of: Literal["one_per_condition", "all", "none"] = "one_per_condition"
    """Which recordings get a clip."""
    seconds: Positive = 6.0
    """Approximate duration of a clip, in seconds."""
    width_px: Annotated[Count, Field(ge=320, le=3840)] = 960
    """Width of the picture, in pixels."""


class RunSettings(_Strict):
    """Everything in `config/config.yaml`; any key may be overridden by `--config key=value`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

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
    final_at_fraction: Annotated[Number, Field(gt=0, le=1)] = 0.95
    """Fraction of the length at which final speeds are evaluated."""
    efficiency_at_mm: Positive = 150.0
    """Growth at which the energy efficiency is evaluated, in mm."""
    figures: FigureSettings = FigureSettings()
    """Files of the figures."""
    overlays: OverlaySettings = OverlaySettings()
    """Clips of the recordings."""


# Groups of keys of `experiment.yaml`, and the models of which one validates them; "" for the keys of no group
_GROUPS: dict[str, tuple[type[BaseModel], ...]] = {
    "": (ExperimentSettings,),
    "limits": (Limits,),
    "axis": (AxisSettings,),
    "calibration": (Charuco, Checkerboard, TwoPoints, MmPerPx),
}


def read_experiment_settings(path: Path, warnings: list[Problem] | None = None) -> ExperimentSettings:
    """Read `experiment.yaml`, and add to `warnings` what is converted; return the defaults if there is no such file."""
    # A broken link is an error, not a missing file: defaults would silently replace the intended settings.
    if not os.path.lexists(path):
        return ExperimentSettings()
    document = _in_key_units(read_yaml(path), path.name, [] if warnings is None else warnings)
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
    # pydantic inserts the kind of a calibration between "calibration" and the key; the file does not contain it.
    location = tuple(part for i, part in enumerate(detail["loc"]) if not (i == 1 and detail["loc"][0] == "calibration"))
    key = ".".join(str(part) for part in location)
    line = next(
        (document.lines[location[:n]] for n in range(len(location), 0, -1) if location[:n] in document.lines), 0
    )
    value = detail["input"] if isinstance(detail["input"], str | int | float | bool) else None
    shown = None if value is None else str(value)
    if detail["type"] == "extra_forbidden":
        names = _valid_keys(model, document.content, location)
        if same := [name for name in names if location[-1] in other_units(name)]:
            remedy = "keep one of the two"
            return Problem(message=f"is {same[0]} again", file=file, line=line, column=key, remedy=remedy)
        remedy = did_you_mean(str(location[-1]), names) or "remove it"
        return Problem(message="is not a setting", file=file, line=line, column=key, remedy=remedy)
    if detail["type"] == "missing":
        return Problem(message="is missing", code="missing", file=file, line=line, column=key, remedy="add it")
    error = detail.get("ctx", {}).get("error")
    if isinstance(error, CellError):
        return Problem.from_error(error, file, line=line, column=key, value=shown)
    words = re.sub(r"a valid (tuple|list)", "a list", detail["msg"])
    words = re.sub(r"a valid dictionary.*", "a group of keys", words)
    message = f"is not allowed: {words[:1].lower()}{words[1:]}"
    return Problem(message=message, file=file, line=line, column=key, value=shown)


def _kind(content: Any) -> Any:
    calibration = content.get("calibration") if isinstance(content, dict) else None
    return calibration.get("kind") if isinstance(calibration, dict) else None


def _valid_keys(model: type[BaseModel], content: Any, location: tuple[Any, ...]) -> list[str]:
    """Return the keys that are valid at the location of an unknown key."""
    if len(location) == 1:
        return list(model.model_fields)
    if location[0] == "calibration":
        models = {get_args(m.model_fields["kind"].annotation)[0]: m for m in _GROUPS["calibration"]}
        return list(models[_kind(content)].model_fields)
    inner = type(model.model_fields[location[0]].default) if location[0] != "axis" else AxisSettings
    return list(getattr(inner, "model_fields", {}))
