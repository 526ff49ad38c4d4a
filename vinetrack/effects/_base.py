"""What an effect is made of: the state it sees, the rig it acts in, its parameters, its worked numbers.

All numbers are SI. The symbols are those of the model

    m(x) ẍ = (1/r) Σ tip forces + Σ tail forces,   x = r·y

The tip is a moving pulley: whatever acts there counts 1/r on the tail; what acts on the tail itself counts whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

HOOKS = ("pressure", "damping_gain", "tip_force", "tail_force", "added_mass")
"""What an effect may change, in the order in which the model asks: see `Effect`."""

KINDS = ("base", "physical", "measurement")


class State(NamedTuple):
    """The moving vine at one instant, as an effect sees it (SI; arrays of one shape are as good as numbers)."""

    time: float  #: s since release
    lead_position: float  #: y, m of growth
    lead_velocity: float  #: ẏ, m/s
    tail_position: float  #: x = r·y, m
    tail_velocity: float  #: ẋ, m/s
    pressure: float  #: gauge, Pa, as changed by the effects asked before
    area: float  #: A, m²
    moving_mass: float  #: m(x), kg
    damping_gain: float  #: factor on B, 1 unless an effect changes it


class Rig(NamedTuple):
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


@dataclass(frozen=True)
class Parameter:
    """A number of an effect that can be fitted.

    `zero` is the value at which the effect vanishes; `shared` says over what one value holds: `all` trials or one
    `vine`. `bounds` are what physics allows, `plausible` what an experimenter would believe.
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

    Its functions take `(s: State, rig: Rig, *parameters)` and return, by hook:

    pressure        the gauge pressure it leaves, Pa
    damping_gain    the factor it leaves on B
    tip_force       force at the tip, N, positive along growth
    tail_force      force on tail and payload, N, positive along growth
    added_mass      mass moving with the tail that it adds, kg
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

    @property
    def formula(self) -> str:
        """The formula: the indented lines of the docstring, stripped."""
        lines = [line.strip() for line in self.text.splitlines() if line.startswith("    ")]
        return "; ".join(line for line in lines if line)

    def __hash__(self) -> int:
        return hash((self.name, self.path))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and (self.name, self.path) == (other.name, other.path)

    def __repr__(self) -> str:
        return f"<effect {self.name}: {self.formula}>"
