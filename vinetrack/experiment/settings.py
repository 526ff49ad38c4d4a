"""Settings: what all trials share (`experiment.yaml`) and how the analysis runs (`config/config.yaml`).

The pydantic models below are the one truth about keys, defaults and what is allowed; a test keeps `config/config.yaml`
in step. An unknown key, a key written twice and a value that is not allowed are all reported at once.
"""

from __future__ import annotations

import math
import os
import re
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

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

from vinetrack.core.constants import BASE_EFFECTS
from vinetrack.core.problems import ExperimentError, Problem, did_you_mean
from vinetrack.core.records import Bend
from vinetrack.core.yaml_document import YamlDocument, read_yaml
from vinetrack.experiment.cells import SMALLEST_POINT_SPACING_PX, interior_values, read_limit, read_range, read_value
from vinetrack.experiment.other_units import in_key_units
from vinetrack.experiment.schema import COLUMNS, LIMITED, SHARED


def _no_yes_or_no(value: Any) -> Any:
    """Refuse what pydantic would take for 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("is yes or no where a number belongs: write the number")
    return value


Number = Annotated[float, BeforeValidator(_no_yes_or_no)]
Count = Annotated[int, BeforeValidator(_no_yes_or_no)]
Positive = Annotated[Number, Field(gt=0)]
Pixel = tuple[Number, Number]
Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    """Unknown keys are refused, instances cannot change, NaN and infinity are no settings."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True)


def _optional_fields(types: dict[str, Any]) -> Any:
    """A base class with a field of each name and type, None where it is not given."""
    fields: dict[str, Any] = {name: (kind | None, None) for name, kind in types.items()}
    return create_model("Columns", __base__=_Strict, **fields)


class AxisSettings(_Strict):
    """The growth axis in the picture, and how wide a strip along it is looked at."""

    from_px: Pixel
    to_px: Pixel
    via_px: tuple[Pixel, ...] | None = None
    width_mm: Positive | None = None

    @model_validator(mode="after")
    def _has_a_direction(self) -> AxisSettings:
        through = (self.from_px, *(self.via_px or ()), self.to_px)
        if self.via_px and any(math.dist(a, b) < SMALLEST_POINT_SPACING_PX for a, b in pairwise(through)):
            raise ValueError(
                f"neighbouring points are less than {SMALLEST_POINT_SPACING_PX} pixels apart: leave out the second"
            )
        if not self.via_px and self.from_px == self.to_px:
            raise ValueError("from_px and to_px are the same point: name two")
        return self


class MmPerPx(_Strict):
    """The scale itself."""

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
            raise ValueError("from_px and to_px are the same point: name two")
        return self


class Checkerboard(_Strict):
    """A checkerboard: `squares` across and down."""

    kind: Literal["checkerboard"]
    image: str
    squares: tuple[Annotated[Count, Field(ge=3)], Annotated[Count, Field(ge=3)]]
    square_mm: Positive


class Charuco(_Strict):
    """A ChArUco board: `squares` across and down, and the name of its marker dictionary as OpenCV has it."""

    kind: Literal["charuco"]
    image: str
    squares: tuple[Annotated[Count, Field(ge=2)], Annotated[Count, Field(ge=2)]]
    square_mm: Positive
    marker_mm: Positive
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$")]

    @model_validator(mode="after")
    def _markers_fit(self) -> Charuco:
        if self.marker_mm >= self.square_mm:
            raise ValueError("marker_mm is not smaller than square_mm: markers lie inside their squares")
        return self


Calibration = Annotated[Charuco | Checkerboard | TwoPoints | MmPerPx, Field(discriminator="kind")]


_LimitedColumns: Any = _optional_fields(
    dict.fromkeys(LIMITED["range"], tuple[float, float]) | dict.fromkeys(LIMITED["choice"], tuple[float, ...])
)


class Limits(_LimitedColumns):
    """Which further trials could be made, for the next experiment; None where the trials so far are the guide.

    Pressure and payload are ranges (`7:40` or two numbers); the others are what there is to choose from: one value, a
    list, or a range, of which five values are looked at. `trials` is how many can be afforded, `new_vines` whether a
    vine can be made for them, `hoop_stress_MPa` what the film is trusted to hold.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    trials: Annotated[Count, Field(ge=1, le=24)] = 4
    """How many further trials can be afforded."""
    new_vines: bool = True
    """Whether a vine can be made for them."""
    hoop_stress_MPa: Positive = 7.8
    """Hoop stress that the film is trusted to hold."""

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
                raise ValueError("is empty: name at least one value, or remove the key")
            return tuple(sorted({read_limit(column, limit) for limit in value}))
        return value if value is None else (read_limit(column, value),)


_TYPES: dict[str, Any] = {
    "number": float,
    "choice": float,
    "text": str,
    "path": str,
    "bends": tuple[Bend, ...],
    "window": tuple[float, float],
    "yes_no": bool,
}
"""What a value of each kind of column becomes."""

_SharedColumns: Any = _optional_fields({name: _TYPES[COLUMNS[name].kind] for name in SHARED})


class ExperimentSettings(_SharedColumns):
    """What all trials of an experiment share. Values keep the unit in their name; None where not given.

    Every column but `trial`, `video` and `track` may stand here; a cell of the sheet overrides it.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    ambient_pressure_kPa: Annotated[Number, Field(gt=0, le=1000)] = 101.325
    """Absolute pressure of the air around: enters the gas of chambers."""
    tail_slack: Literal["taut", "free"] = "taut"
    """Whether a tail that the model would have to push goes slack (free) or stays taut."""
    tail_store: Literal["body", "reel"] = "body"
    """Where the tail is kept: in the body of the vine, or on a reel."""
    mass_loss: Literal["geometric", "as_printed"] = "geometric"
    """How the moving mass shrinks: by the geometry of eversion, or as the paper prints it."""
    position_systematic_mm: Annotated[Number, Field(ge=0, le=100)] | None = None
    """Standard deviation of smooth errors of position that all trials share, such as a lens makes; by default 0.1 for
    positions from elsewhere and for calibrations by two points or a scale, 0 for those by a target."""
    model: tuple[str, ...] = BASE_EFFECTS
    """Effects of the model in use."""
    candidates: tuple[str, ...] | None = None
    """Effects that a diagnosis may propose; blank for the whole catalogue."""
    effects: tuple[str, ...] = ()
    """Paths of Python files with effects of one's own."""
    strict: bool = False
    """Whether a fault of one trial stops all."""
    axis: AxisSettings | None = None
    """The growth axis in the picture, from_px, to_px, width_mm, and via_px where it bends; found where blank."""
    calibration: Calibration | None = None
    """kind: charuco, checkerboard, two_points or mm_per_px, with the keys of that kind."""
    limits: Limits = Limits()
    """What further trials may look like; see below."""
    published: Literal["simulated", "measured"] | None = None
    """Set the paper's numbers beside ours, whose trials were grown from its parameters, or filmed."""

    @field_validator(*SHARED, mode="before")
    @classmethod
    def _as_in_the_sheet(cls, value: Any, info: Any) -> Any:
        """Judge a shared value as the sheet's cell would be."""
        column = COLUMNS[info.field_name]
        if value is None or isinstance(value, tuple) or (isinstance(value, bool) and column.kind == "yes_no"):
            return value
        if isinstance(value, bool | list | dict):
            raise ValueError("is not a single value: write one, as in the sheet")
        return read_value(column, value)

    @field_validator("model", "candidates", "effects")
    @classmethod
    def _named_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names and (twice := sorted({name for name in names if names.count(name) > 1})):
            raise ValueError(f"names {twice[0]!r} twice: keep one")
        return names


class SteadySettings(_Strict):
    """When a stretch of motion counts as steady; see `vinetrack.kinematics.steady`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    drift_limit: Annotated[Number, Field(gt=0, le=1)] = 0.03
    """Largest relative drift of speed across a steady window, with its 95 % interval."""
    start_fraction: Annotated[Number, Field(ge=0, lt=1)] = 0.2
    """A window may begin once the speed exceeds this fraction of the largest of its trial,"""
    start_sigmas: Annotated[Number, Field(ge=0)] = 5.0
    """and this many standard errors of the speed."""
    paper_cv: Annotated[Number, Field(gt=0, le=1)] = 0.03
    """The paper's rule: largest coefficient of variation of speed,"""
    paper_points: Annotated[Count, Field(ge=3)] = 3
    """over at least so many consecutive points."""


class VelocitySettings(_Strict):
    """How positions become velocities; see `vinetrack.kinematics.velocity`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    kappa: Positive = 3.0
    """Smoothing windows must agree within this many standard errors."""
    order: Annotated[Count, Field(ge=1, le=5)] = 3
    """Degree of the local polynomial."""


class DampingSettings(_Strict):
    """How the damping law and its intervals are computed; see `vinetrack.kinematics.damping`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    resamples: Annotated[Count, Field(ge=100)] = 2000
    """Resamplings of whole trials behind each 95 % interval."""
    seed: Annotated[Count, Field(ge=0)] = 1
    """Seed of the resampling."""


class FigureSettings(_Strict):
    """Files that every figure is saved as."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    formats: tuple[Literal["png", "svg", "pdf"], ...] = ("png", "svg")
    """Formats of every figure."""
    dpi: Annotated[Count, Field(ge=50, le=1200)] = 150
    """Resolution of png files, dots per inch."""

    @field_validator("formats")
    @classmethod
    def _at_least_one(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        if not formats:
            raise ValueError("is empty: name at least one of png, svg, pdf")
        return formats


class OverlaySettings(_Strict):
    """Clips of the recordings with the tracked edge and the models' edges; see `vinetrack.figures.overlay`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    of: Literal["one_per_condition", "all", "none"] = "one_per_condition"
    """Which recordings get a clip."""
    seconds: Positive = 6.0
    """About how long a clip plays, in seconds."""
    width_px: Annotated[Count, Field(ge=320, le=3840)] = 960
    """Width of the picture, in pixels."""


class RunSettings(_Strict):
    """Everything in `config/config.yaml`; any key may be overridden by `--config key=value`."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    experiment: str = "data/demo"
    """The experiment's folder."""
    results: str | None = None
    """Where results go; blank for results/<name of the experiment>."""
    steady: SteadySettings = SteadySettings()
    """When a stretch of motion counts as steady; see below."""
    velocity: VelocitySettings = VelocitySettings()
    """How positions become velocities."""
    damping: DampingSettings = DampingSettings()
    """The damping law."""
    final_at_fraction: Annotated[Number, Field(gt=0, le=1)] = 0.95
    """Fraction of the length at which final speeds are taken."""
    efficiency_at_mm: Positive = 150.0
    """Growth at which the energy efficiency is taken, in mm."""
    figures: FigureSettings = FigureSettings()
    """Files of the figures."""
    overlays: OverlaySettings = OverlaySettings()
    """Clips of the recordings."""


def read_experiment_settings(path: Path) -> ExperimentSettings:
    """Read `experiment.yaml`; all defaults where there is no such file.

    Parameters
    ----------
    path : of `experiment.yaml`.

    Returns
    -------
    the settings.

    Raises
    ------
    ExperimentError
        With every problem of the file.
    """
    # A link whose end is missing is no file left out: the settings behind it were meant.
    if not os.path.lexists(path):
        return ExperimentSettings()
    return _validate(ExperimentSettings, in_key_units(read_yaml(path), path.name)[0], path.name)


def run_settings(values: dict[str, Any]) -> RunSettings:
    """Check settings of a run given as a mapping, such as Snakemake's `config` after `--config`.

    Parameters
    ----------
    values : as `config/config.yaml` would hold them.

    Returns
    -------
    the settings.

    Raises
    ------
    ExperimentError
        With every problem of the mapping.

    >>> run_settings({"damping": {"seed": 7}}).damping.seed
    7
    """
    return _validate(RunSettings, YamlDocument(values, {}), "config.yaml")


def _validate(model: type[Model], document: YamlDocument, file: str) -> Model:
    """The document as a settings object, or every problem it has."""
    try:
        return model.model_validate(document.content)
    except ValidationError as error:
        raise ExperimentError([_as_problem(model, document, file, detail) for detail in error.errors()]) from None


def _as_problem(model: type[BaseModel], document: YamlDocument, file: str, detail: Any) -> Problem:
    """One of pydantic's errors as a problem that names the key, its line and what is allowed."""
    # Inside a calibration pydantic names the kind between "calibration" and the key; the file does not.
    location = tuple(part for i, part in enumerate(detail["loc"]) if not (i == 1 and detail["loc"][0] == "calibration"))
    key = ".".join(str(part) for part in location)
    line = next(
        (document.lines[location[:n]] for n in range(len(location), 0, -1) if location[:n] in document.lines), 0
    )
    value = detail["input"] if isinstance(detail["input"], str | int | float | bool) else None
    shown = None if value is None else str(value)
    if detail["type"] == "extra_forbidden":
        remedy = did_you_mean(str(location[-1]), _keys_beside(model, document.content, location)) or "remove it"
        return Problem(message="is no setting", file=file, line=line, column=key, remedy=remedy)
    if detail["type"] == "missing":
        return Problem(message="is missing", file=file, line=line, column=key, remedy="add it")
    message, _, remedy = detail["msg"].removeprefix("Value error, ").partition(": ")
    if not detail["msg"].startswith("Value error, "):
        words = re.sub(r"a valid (tuple|list)", "a list", detail["msg"])
        words = re.sub(r"a valid dictionary.*", "a group of keys", words)
        message, remedy = f"is not allowed: {words[:1].lower()}{words[1:]}", ""
    return Problem(message=message, file=file, line=line, column=key, value=shown, remedy=remedy)


def _kind(content: Any) -> Any:
    calibration = content.get("calibration") if isinstance(content, dict) else None
    return calibration.get("kind") if isinstance(calibration, dict) else None


def _keys_beside(model: type[BaseModel], content: Any, location: tuple[Any, ...]) -> list[str]:
    """Keys that would have been right where an unknown one stands."""
    if len(location) == 1:
        return list(model.model_fields)
    if location[0] == "calibration":
        kinds: dict[Any, type[BaseModel]] = {
            "charuco": Charuco,
            "checkerboard": Checkerboard,
            "two_points": TwoPoints,
            "mm_per_px": MmPerPx,
        }
        return list(kinds[_kind(content)].model_fields)
    inner = type(model.model_fields[location[0]].default) if location[0] != "axis" else AxisSettings
    return list(getattr(inner, "model_fields", {}))
