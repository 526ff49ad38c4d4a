"""A vine followed by SciPy from an equation that a test writes out in full, and the same vine by the compiled model.
One compiled model serves all tests: that of the diagnoses, the whole catalogue with every effect at no size that the
test does not name. Nothing here but `simulated` uses the package's own physics.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, base_model, host_for
from vinetrack.dynamics.simulate import Trajectory, simulate

G = 9.81
ATM = 101_325.0
RT_AIR = 287.0 * 293.0
N = 0.37


@dataclass(frozen=True)
class Vine:
    """Numbers of one trial, worked out by hand; r = 2."""

    D: float
    t: float
    L: float
    P: float
    P_y: float
    B: float
    payload: float = 0.0
    down: float = 1.0

    @property
    def A(self) -> float:
        return math.pi * self.D**2 / 4

    @property
    def lam(self) -> float:
        return 1200 * math.pi * self.D * self.t

    def m(self, x: float) -> float:
        """Tail and payload; the tests stop before the film's mass comes to its floor."""
        return self.lam * self.L - self.lam / 2 * x + self.payload

    def base(self, x: float, v: float) -> float:
        """Right side of Eq. (2): ½(P − P_y)A + m g cosθ − ½Bẋⁿ."""
        return 0.5 * (self.P - self.P_y) * self.A + self.m(x) * G * self.down - 0.5 * self.B * max(v, 0.0) ** N

    def trial(self, **others: object) -> Trial:
        sizes = {"diameter_m": self.D, "thickness_m": self.t, "length_m": self.L, "payload_kg": self.payload}
        supply = {"pressure_Pa": self.P, "yield_pressure_Pa": self.P_y, "chamber_m3": 3.7e-3, "inlet_m": 6e-3}
        fields = {"name": "t", "vine": "v", "growth_angle_rad": math.acos(self.down), **sizes, **supply}
        return Trial(**{**fields, **others})  # type: ignore[arg-type]


LOADED = Vine(D=24e-3, t=200e-6, L=0.28, P=28e3, P_y=3e3, B=6.44, payload=35.6e-3)
BARE = Vine(D=12e-3, t=100e-6, L=0.30, P=40e3, P_y=5e3, B=1.83)
LEVEL = replace(LOADED, down=0.0)


def whole_catalogue(sizes: Mapping[str, float]) -> Model:
    """Every effect at no size but those whose sizes are given, and the base effects."""
    model = host_for(base_model())
    nothing = {f"{e.name}.{p.name}": p.zero for e in model for p in e.parameters if e.kind != "base"}
    return model.with_values({**nothing, **sizes})


def simulated(vine: Vine, sizes: Mapping[str, float], times, trace=None, **others: object) -> Trajectory:
    """The compiled model's answer."""
    model = whole_catalogue({"eversion_damping.B": vine.B, "eversion_damping.n": N, **sizes})
    return simulate(model, vine.trial(**others), times, trace=trace)


def followed(acceleration, stop: float, *, chamber=None, until=20.0, max_step=np.inf) -> Callable[[Floats], Floats]:
    """Tail travel against time by SciPy, from rest to x = `stop`.
    `acceleration(t, x, v)`, or `acceleration(t, x, v, P)` with `chamber` = its first pressure and Ṗ(t, x, v, P). Its
    last time, at `stop`, is kept as the attribute `end`, (x, ẋ) against time as `state`.
    """

    def slope(t: float, s: Floats) -> list[float]:
        v = max(s[1], 0.0)
        extra = [] if chamber is None else [s[2]]
        rate = [] if chamber is None else [chamber[1](t, s[0], v, s[2])]
        return [v, acceleration(t, s[0], v, *extra), *rate]

    def there(_t: float, s: Floats) -> float:
        return s[0] - stop

    there.terminal = True
    start = [0.0, 0.0] if chamber is None else [0.0, 0.0, chamber[0]]
    how = {"rtol": 1e-10, "atol": [1e-13, 1e-12, 1e-6][: len(start)], "dense_output": True, "max_step": max_step}
    done = solve_ivp(slope, (0.0, until), start, "LSODA", events=there, **how)
    assert done.success, done.message

    def travel(times: Floats) -> Floats:
        return np.asarray(done.sol(times)[0])

    travel.end, travel.state = float(done.t[-1]), done.sol
    return travel


def assert_same_motion(vine: Vine, sizes, acceleration, *, share=0.9, chamber=None, **others: object) -> None:
    """Lead positions agree to 10⁻⁵ of the distance, up to `share` of the length; and the effect does something."""
    travel = followed(acceleration, 2 * share * vine.L, chamber=chamber)
    times = np.linspace(0.0, travel.end, 61)  # type: ignore[attr-defined]
    truth = travel(times) / 2
    got = simulated(vine, sizes, times, **others).lead_position_m
    assert np.max(np.abs(got - truth)) < 1e-5 * truth[-1]
    without = simulated(vine, {}, times, **others).lead_position_m
    assert np.max(np.abs(without - truth)) > 1e-4 * truth[-1]
