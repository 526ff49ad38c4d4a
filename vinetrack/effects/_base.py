"""Parts of an effect: the state and trial inputs that its functions receive, its parameters, its worked numbers.

All numbers are SI. The symbols are those of the model

    m(x) ẍ = (1/r) Σ tip forces + Σ tail forces,   x = r·y

The tip is a moving pulley: a force there acts on the tail with the factor 1/r; a force on the tail itself acts in full.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import ConfigDict, Field

from vinetrack.core.records import Trial
from vinetrack.core.units import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K

HOOKS: Mapping[str, str | float] = {
    "true_time": "time",
    "trace_time": "time",
    "trace_pressure": "pressure",
    "film_gain": 1.0,
    "gauge": "pressure",
    "yield_gauge": "yield_pressure",
    "area": "area",
    "chamber_rate": 0.0,
    "pressure": "pressure",
    "damping_gain": "damping_gain",
    "added_mass": 0.0,
    "tip_force": 0.0,
    "tail_force": 0.0,
    "rest_force": 0.0,
    "observed_position": "observed",
    "row_delay": 0.0,
    "averaged_over": 0.0,
}
"""Quantities that an effect may change, in the order in which the model evaluates them (see `Effect`), each with what
its function returns where the effect vanishes: a field of the state, or a number.
"""


class State(NamedTuple):
    """State of the moving vine at one instant, SI; the fields are numbers, or arrays of one shape."""

    time: float  #: s since release
    lead_position: float  #: y, m of growth
    lead_velocity: float  #: ẏ, m/s
    tail_position: float  #: x = r·y, m
    tail_velocity: float  #: ẋ, m/s
    set_pressure: float  #: gauge pressure at release, Pa, as the gauge should have read it
    pressure: float  #: present gauge pressure, Pa, as changed by effects evaluated before
    yield_pressure: float  #: Pa, as the gauge should have read it
    area: float  #: A, m²
    linear_density: float  #: λ, kg/m
    moving_mass: float  #: m(x), kg
    damping_gain: float  #: factor on B, 1 unless an effect changes it
    bend_angle: float  #: angle of the bends that the tip has passed, rad
    tail_tension: float  #: T₁, tension of the tail that balances the tip forces, N (for `observed_position` only)
    observed: float  #: position that the camera reports, m, as changed by effects evaluated before
    pressure_slope: float  #: rate at which a recorded pressure changes, Pa/s (for `trace_pressure` only)


class TrialInputs(NamedTuple):
    """Quantities that are constant during one trial, SI; NaN where the sheet is blank."""

    set_pressure: float
    yield_pressure: float
    diameter: float
    thickness: float
    length: float
    area: float
    linear_density: float
    mass_loss: float  #: c, kg lost per metre of tail travel
    payload_mass: float
    cos_angle: float  #: of the growth angle; 1 straight down
    travel_ratio: float
    ambient_pressure: float
    chamber_volume: float
    inlet_area: float
    least_mass: float  #: lower limit of the moving mass: fold and gas, kg
    has_bends: float  #: 1 where the sheet has bends
    tail_on_reel: float  #: 1 where the tail comes off a reel instead of lying in the body
    bend_count: float  #: number of bends in the sheet
    bend_total: float  #: sum of their angles, rad
    as_printed: float  #: 1 where the paper's terms are taken literally
    tail_free: float  #: 1 where the tail goes slack instead of carrying compression

    @classmethod
    def of(cls, trial: Trial) -> TrialInputs:
        """Those of one trial."""
        whole_body = trial.travel_ratio == 1
        length = trial.length_m if math.isfinite(trial.length_m) else 0.0
        area = trial.area_m2 if math.isfinite(trial.diameter_m) else 0.0
        linear_density = trial.linear_density_kg_m
        pressure = 0.0 if whole_body and not math.isfinite(trial.pressure_Pa) else trial.pressure_Pa
        yield_pressure = 0.0 if whole_body and not math.isfinite(trial.yield_pressure_Pa) else trial.yield_pressure_Pa
        gas_density = (pressure + trial.ambient_pressure_Pa) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
        fold = 0.0 if linear_density == 0 else linear_density * math.pi * trial.thickness_m
        return cls(
            set_pressure=pressure,
            yield_pressure=yield_pressure,
            diameter=trial.diameter_m,
            thickness=trial.thickness_m,
            length=length,
            area=area,
            linear_density=linear_density,
            mass_loss=trial.mass_loss_kg_m if linear_density else 0.0,
            payload_mass=trial.payload_kg,
            cos_angle=math.cos(trial.growth_angle_rad),
            travel_ratio=trial.travel_ratio,
            ambient_pressure=trial.ambient_pressure_Pa,
            chamber_volume=trial.chamber_m3,
            inlet_area=math.pi * trial.inlet_m**2 / 4,
            least_mass=fold + gas_density * area * length / trial.travel_ratio**2,
            has_bends=float(bool(trial.bends)),
            tail_on_reel=float(trial.tail_store == "reel"),
            bend_count=float(len(trial.bends)),
            bend_total=sum(bend.arc_m / bend.radius_m for bend in trial.bends),
            as_printed=float(trial.mass_loss == "as_printed"),
            tail_free=float(trial.tail_slack == "free" and not whole_body),
        )


# The largest vine of Alvarez et al. (2025), grown downwards with their payload, 0.4 m long
REFERENCE_TRIAL = Trial(
    name="reference", vine="reference", diameter_m=24e-3, thickness_m=200e-6, length_m=0.4, pressure_Pa=28e3,
    yield_pressure_Pa=3e3, payload_kg=35.6e-3, chamber_m3=3.7e-3, inlet_m=6e-3,
)  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect that can be fitted.

    `zero` is the value at which the effect vanishes. `shared` says which trials have one value: `all`, those of one
    `vine`, or of one `day` where the sheet states it for every trial, else of one vine: a camera is set up anew for
    either. `bounds` are the physical limits, `plausible` the range that an experimenter would expect. A `held`
    parameter is known and fixed unless it is freed by name. For a shape parameter, `tried` are the values at which a
    diagnosis tests the effect; by default two or three of the plausible range. For a size they are far ones, from which
    it is fitted as well where a model fits poorly. Values a `period` apart are equivalent.
    `slips` are sizes of a relative error that a common slip in the sheet causes, each with a description; such a size
    is plausible however large it is.
    """

    __pydantic_config__ = ConfigDict(revalidate_instances="always")

    name: str
    symbol: str
    unit: str
    default: float
    bounds: tuple[float, float] = (-math.inf, math.inf)
    zero: float = 0.0
    shared: str = "all"
    plausible: tuple[float, float] | None = None
    meaning: str = ""
    held: bool = False
    tried: tuple[float, ...] = ()
    period: float = math.inf
    slips: tuple[tuple[float, str], ...] = ()

    @property
    def sign(self) -> int:
        """1 or −1 where the bounds allow only values on one side of `zero`, else 0."""
        low, high = self.bounds
        return (1 if low >= self.zero else 0) - (1 if high <= self.zero else 0)

    def words(self, value: float, vine: str = "") -> str:
        """A value with symbol, vine and unit, such as `k = 0.5 N/m`."""
        of_vine, unit = f" ({vine})" if vine else "", "" if self.unit == "1" else f" {self.unit}"
        return f"{self.symbol}{of_vine} = {value:.6g}{unit}"


@dataclass(frozen=True)
class Worked:
    """A value computed by hand: `hook` of the effect at this state and rig must return `expected`.

    `how` shows the arithmetic, `rel` is the relative rounding of the expected value. Parameters that are not given have
    their defaults.
    """

    __pydantic_config__ = ConfigDict(revalidate_instances="always")

    hook: str
    expected: float
    how: str
    state: Mapping[str, float] = field(default_factory=dict)
    rig: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    rel: float = 1e-3


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One term of the model, read from one file.

    `breakpoints` takes `(rig: TrialInputs, *parameters)`; its other functions take `(s: State, rig: TrialInputs,
    *parameters)` and return, by hook:

    true_time           true time since release of a frame that the camera stamps `s.time`, s
    trace_time          true time since release of a sample that a pressure trace stamps `s.time`, s
    trace_pressure      pressure where a pressure trace, read at `s.time`, shows `s.pressure`, with this slope, Pa
    film_gain           factor on the film's mass per metre
    gauge               true gauge pressure where the gauge reads `s.pressure`, Pa
    yield_gauge         true yield pressure, Pa
    area                changed cross-section, m²
    chamber_rate        rate of change of the chamber's pressure, Pa/s (the chamber then follows its own equation)
    pressure            changed gauge pressure, Pa
    damping_gain        changed factor on B
    added_mass          additional mass that moves with the tail, kg
    tip_force           force at the tip, N, positive along growth
    tail_force          force on tail and payload, N, positive along growth
    rest_force          force at the tip that holds a vine at rest and vanishes once it moves, N, negative
    observed_position   position of the leading edge that the camera reports, m
    row_delay           delay of the camera's readout per metre of that position, s/m; evaluated at release
    averaged_over       square of the time over which positions are averaged, s²; evaluated at release

    Effects of one hook are evaluated by increasing `order`, then in the order of the model, each on the result of the
    one before. In the chain of pressures 1 is the chamber, 2 a leak, 3 a loss on the way (the default); effects of the
    camera on the position come last, at 4 and 5.
    """

    name: str
    kind: Annotated[str, Field(pattern="^(base|physical|measurement)$")] = "physical"
    summary: str
    text: str
    parameters: tuple[Parameter, ...] = ()
    functions: Mapping[str, Callable[..., Any]]
    needs: tuple[str, ...] = ()
    worked: tuple[Worked, ...] = ()
    path: Path
    in_trace: bool = False  #: a pressure measured during growth already includes it
    replaces: tuple[str, ...] = ()  #: effects that it contains and that are inactive while it is in the model
    order: int = 3  #: place among the effects of one hook
    finite: bool = False  #: small sizes resemble another effect (a later release), so finite ones are tested too
    breakpoints: Callable[..., Sequence[float]] | None = None  #: lead positions where its slope breaks, m

    @property
    def formula(self) -> str:
        """The formula: the indented lines of the docstring, stripped."""
        lines = [line.strip() for line in self.text.splitlines() if line.startswith("    ")]
        return "; ".join(line for line in lines if line)

    @property
    def remedy(self) -> str:
        """How to reduce or measure it, as its file says in one line, or blank."""
        return self._paragraph("Reduce it", "It cannot be reduced", "Measure it")

    @property
    def told_apart(self) -> str:
        """Which effects it is easily taken for, and what tells them apart, as its file says, or blank."""
        return self._paragraph("Easily taken for")

    def _paragraph(self, *begins: str) -> str:
        found = (paragraph for paragraph in self.text.split("\n\n") if paragraph.startswith(begins))
        return " ".join(next(found, "").split()).replace("`", "")

    @cached_property
    def zero(self) -> tuple[float, ...]:
        """Values of the parameters at which the effect vanishes, in their order."""
        return tuple(parameter.zero for parameter in self.parameters)

    def __hash__(self) -> int:
        return hash((self.name, self.path))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and (self.name, self.path) == (other.name, other.path)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the path of the file that it was read from."""
        from vinetrack.effects._catalogue import load_effect

        return load_effect, (self.path,)

    def __repr__(self) -> str:
        return f"<effect {self.name}: {self.formula}>"
