"""What an effect is made of: the state it sees, the rig it acts in, its parameters, its worked numbers.

All numbers are SI. The symbols are those of the model

    m(x) ẍ = (1/r) Σ tip forces + Σ tail forces,   x = r·y

The tip is a moving pulley: whatever acts there counts 1/r on the tail; what acts on the tail itself counts whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

HOOKS = (
    "true_time",
    "trace_time",
    "film_gain",
    "gauge",
    "yield_gauge",
    "area",
    "chamber_rate",
    "pressure",
    "damping_gain",
    "added_mass",
    "tip_force",
    "tail_force",
    "rest_force",
    "observed_position",
    "row_delay",
    "averaged_over",
)
"""What an effect may change, in the order in which the model asks: see `Effect`."""

KINDS = ("base", "physical", "measurement")


class State(NamedTuple):
    """The moving vine at one instant, as an effect sees it (SI; arrays of one shape are as good as numbers)."""

    time: float  #: s since release
    lead_position: float  #: y, m of growth
    lead_velocity: float  #: ẏ, m/s
    tail_position: float  #: x = r·y, m
    tail_velocity: float  #: ẋ, m/s
    set_pressure: float  #: gauge pressure at release, Pa, as the gauge should have read it
    pressure: float  #: gauge pressure now, Pa, as changed by the effects asked before
    yield_pressure: float  #: Pa, as the gauge should have read it
    area: float  #: A, m²
    linear_density: float  #: λ, kg/m
    moving_mass: float  #: m(x), kg
    damping_gain: float  #: factor on B, 1 unless an effect changes it
    bend_angle: float  #: angle of the bends that the tip has passed, rad
    tail_tension: float  #: T₁, what the tip's forces leave for the tail, N (asked for by `observed_position` only)
    observed: float  #: position that the camera would report, m, as changed by the effects asked before


class TrialInputs(NamedTuple):
    """What stays the same during one trial (SI; NaN where the sheet is blank)."""

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
    least_mass: float  #: floor of the moving mass: fold and gas, kg
    has_bends: float  #: 1 where the sheet has bends
    tail_on_reel: float  #: 1 where the tail comes off a reel instead of lying in the body
    bend_count: float  #: number of bends in the sheet
    bend_total: float  #: their angles added up, rad
    as_printed: float  #: 1 where the paper's terms are taken literally
    tail_free: float  #: 1 where a tail that would have to push goes slack


@dataclass(frozen=True)
class Parameter:
    """A number of an effect that can be fitted.

    `zero` is the value at which the effect vanishes; `shared` says over what one value holds: `all` trials, one `vine`,
    or one `day` where the sheet states it for every trial. `bounds` are what physics allows, `plausible` what an
    experimenter would believe. One that is `held` is known beforehand: a fit leaves it at its value unless told to find
    it. `tried` are values at which a diagnosis tries the effect where it is no size but a shape; without them two or
    three of the plausible range. Values a `period` apart are the same. `slips` are sizes of a relative error that a
    common slip in the sheet leaves, each with what was done: however large, such a size is plausible.
    """

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
        """1 or −1 where physics lets it lie on one side of `zero` only, else 0."""
        low, high = self.bounds
        return (1 if low >= self.zero else 0) - (1 if high <= self.zero else 0)


@dataclass(frozen=True)
class Worked:
    """A number worked out by hand: `hook` of the effect at this state and rig must return `expected`.

    `how` shows the arithmetic, `rel` is the rounding of the hand-worked number.
    """

    hook: str
    expected: float
    how: str
    state: Mapping[str, float] = field(default_factory=dict)
    rig: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    rel: float = 1e-3


@dataclass(frozen=True)
class Effect:
    """One term of the model, read from one file.

    `breakpoints` takes `(rig: TrialInputs, *parameters)`; its other functions take `(s: State, rig: TrialInputs,
    *parameters)` and return, by hook:

    true_time           time since release at which what the camera stamps `s.time` really happened, s
    trace_time          time since release at which what a pressure trace stamps `s.time` really happened, s
    film_gain           factor on the film's mass per metre
    gauge               the gauge pressure that was truly there where the gauge read `s.pressure`, Pa
    yield_gauge         the yield pressure that was truly there, Pa
    area                the cross-section it leaves, m²
    chamber_rate        rate of change of the chamber's pressure, Pa/s (the chamber then follows its own equation)
    pressure            the gauge pressure it leaves, Pa
    damping_gain        the factor it leaves on B
    added_mass          mass moving with the tail that it adds, kg
    tip_force           force at the tip, N, positive along growth
    tail_force          force on tail and payload, N, positive along growth
    rest_force          force at the tip that holds a vine at rest and is gone once it moves, N, negative
    observed_position   position of the leading edge that the camera reports, m
    row_delay           how much later the camera reads it by the metre of that position, s/m; asked at release
    averaged_over       square of the time over which positions are averaged, s²; asked at release

    Effects of one hook are asked by rising `order`, then as they stand in the model, and each sees what the ones before
    left. In the chain of pressures 1 is the chamber, 2 a leak, 3 losses on the way (as everywhere if not said); what
    the camera makes of the position comes after what the vine does, at 4 and 5.
    """

    name: str
    kind: str
    summary: str
    text: str
    parameters: tuple[Parameter, ...]
    functions: Mapping[str, Callable[..., Any]]
    needs: tuple[str, ...]
    easily_taken_for: tuple[str, ...]
    worked: tuple[Worked, ...]
    path: Path
    in_trace: bool = False  #: a pressure measured during growth already holds it
    replaces: tuple[str, ...] = ()  #: effects that it contains and that rest while it is in the model
    order: int = 3  #: place among the effects of one hook
    finite: bool = False  #: small sizes look like something else (a later release): it is tried at finite ones too
    breakpoints: Callable[..., Sequence[float]] | None = None  #: lead positions where its slope breaks, m

    @property
    def formula(self) -> str:
        """The formula: the indented lines of the docstring, stripped."""
        lines = [line.strip() for line in self.text.splitlines() if line.startswith("    ")]
        return "; ".join(line for line in lines if line)

    @cached_property
    def zero(self) -> tuple[float, ...]:
        """Values of the parameters at which it changes nothing, in their order."""
        return tuple(parameter.zero for parameter in self.parameters)

    def __hash__(self) -> int:
        return hash((self.name, self.path))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and (self.name, self.path) == (other.name, other.path)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes as the file it was read from."""
        from vinetrack.effects._catalogue import load_effect

        return load_effect, (self.path,)

    def __repr__(self) -> str:
        return f"<effect {self.name}: {self.formula}>"
