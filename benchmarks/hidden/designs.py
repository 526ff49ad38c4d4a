"""What was set up: vines, pressures, payloads, rig and camera of a campaign, different for every seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

FILM_KG_M3 = 1200.0
CAMERA_HZ = (500.0, 750.0, 1000.0, 1069.0, 1500.0, 2000.0)
FEWEST_FRAMES, MOST_FRAMES = 25, 1200
"""Moving frames of the fastest and the slowest trial, roughly."""


@dataclass(frozen=True)
class Vine:
    """One vine, in the units of a sheet; `B` and `n` are what it truly has."""

    diameter_mm: float
    thickness_um: float
    length_mm: float
    yield_kPa: float
    B: float
    n: float

    @property
    def area_m2(self) -> float:
        """Cross-section."""
        return math.pi * (self.diameter_mm / 1e3) ** 2 / 4

    def pressure_for(self, tail_speed_m_s: float) -> float:
        """Gauge pressure at which this would be the steady speed, kPa."""
        return self.yield_kPa + self.B * tail_speed_m_s**self.n / self.area_m2 / 1e3


@dataclass(frozen=True)
class Setting:
    """One trial as planned: what the sheet will say but for rounding."""

    vine: Vine
    pressure_kPa: float
    payload_g: float
    replicate: int
    capture_hz: float
    angle_deg: float
    chamber_l: float
    inlet_mm: float
    bends_mm: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Wants:
    """What a hidden effect needs in order to be there at all and to be asked after."""

    payload: bool | None = None
    chamber: bool = False
    inlet: bool = False
    bends: bool = False
    vines: int = 1
    fast: bool = False
    wide_chamber: bool = False
    quiet: bool = False
    angles: bool = False
    trials: tuple[int, int] = (24, 48)


def _vine(draw: np.random.Generator, isometric: int, n: float, fast: bool) -> Vine:
    if fast:
        diameter, thickness = float(draw.choice([18, 20, 24, 25, 30])), float(draw.choice([50, 75, 100, 150]))
        length = round(float(draw.uniform(250, 450)), -1)
    elif isometric:
        diameter, thickness, length = 6.0 * isometric, 50.0 * isometric, 70.0 * isometric
        if draw.uniform() < 0.3:
            length = round(float(draw.uniform(150, 400)), -1)
    else:
        diameter = float(draw.choice([8, 10, 12, 16, 18, 20, 24, 25, 30]))
        thickness = float(draw.choice([50, 75, 100, 150, 200]))
        length = round(float(draw.uniform(180, 450)), -1)
    B = 6.44 * thickness / 200 * (diameter / 24) ** 0.75 * math.exp(0.15 * draw.standard_normal())
    return Vine(diameter, thickness, length, round(float(draw.uniform(1.5, 4.5)), 1), B, n)


def _vines(draw: np.random.Generator, wants: Wants) -> list[Vine]:
    count = max(int(draw.choice([1, 2, 2, 3, 4])), wants.vines)
    n = float(draw.uniform(0.3, 0.45))
    paper = draw.uniform() < 0.5
    scales = draw.permutation([4, 3, 2, 1] if count > 2 else [4, 3, 2])
    vines: list[Vine] = []
    while len(vines) < count:
        isometric = int(scales[len(vines)]) if paper and len(vines) < scales.size else 0
        vine = _vine(draw, isometric, n, wants.fast)
        if all((vine.diameter_mm, vine.thickness_um) != (v.diameter_mm, v.thickness_um) for v in vines):
            vines.append(vine)
    return vines


def _pressures_kPa(draw: np.random.Generator, vine: Vine, hz: float, count: int, fast: bool) -> list[float]:
    """Pressures from slow to fast, such that no trial has too few or too many frames."""
    length_m = vine.length_mm / 1e3
    if fast:
        # So far above the steady speeds that the film's own inertia holds it back: up to some 30 m/s of the edge.
        return [round(P, 1) for P in np.geomspace(vine.pressure_for(1.0), draw.uniform(35, 62), count).tolist()]
    highest = min(float(draw.uniform(5, 9)), 2 * length_m * hz / FEWEST_FRAMES)
    lowest = max(float(draw.uniform(0.4, 1.5)), 2 * length_m * hz / MOST_FRAMES)
    lowest = min(lowest, highest / 4)
    speeds = np.geomspace(lowest, highest, count)
    return [round(vine.pressure_for(float(v)), 1) for v in speeds]


def _payloads_g(draw: np.random.Generator, vine: Vine, wants: Wants) -> list[float]:
    with_payload = draw.uniform() < 0.4 if wants.payload is None else wants.payload
    if not with_payload:
        return [0.0]
    film_g = 1e3 * FILM_KG_M3 * math.pi * vine.diameter_mm * vine.thickness_um * vine.length_mm * 1e-12
    loads = [round(film_g * float(draw.uniform(2, 10) if wants.payload else draw.uniform(0.5, 6)), 1)]
    if wants.payload or draw.uniform() < 0.6:
        loads.insert(0, 0.0)
    return loads


def design(draw: np.random.Generator, wants: Wants) -> list[Setting]:
    """Plan a campaign of as many trials as wanted."""
    while True:
        hz = float(draw.choice(CAMERA_HZ[3:] if wants.fast else CAMERA_HZ))
        angle = float(draw.choice([0, 0, 0, 90, 90, 180]))
        largest = 60 if wants.wide_chamber and draw.uniform() < 0.4 else 8
        chamber = round(float(np.exp(draw.uniform(math.log(1), math.log(largest)))), 1)
        stated = wants.chamber or draw.uniform() < 0.75
        inlet = wants.inlet or draw.uniform() < 0.7
        counts = int(draw.integers(3, 7)), int(draw.integers(2, 5))
        vines = _vines(draw, wants)
        settings: list[Setting] = []
        for vine in vines:
            inlet_mm = round(vine.diameter_mm * float(draw.uniform(0.25, 0.6)), 1) if inlet else math.nan
            bends = _bends(draw, vine) if wants.bends else ()
            for payload_g in _payloads_g(draw, vine, wants):
                for pressure_kPa in _pressures_kPa(draw, vine, hz, counts[0], wants.fast):
                    one = Setting(vine, pressure_kPa, payload_g, 0, hz, angle, chamber, inlet_mm, bends)
                    settings += [replace(one, replicate=k) for k in range(counts[1])]
        if wants.angles:
            settings = [replace(one, angle_deg=float(draw.choice([0, 90]))) for one in settings]
        low, high = wants.trials
        if low <= len(settings) <= high:
            if not stated:
                settings = [replace(one, chamber_l=math.nan) for one in settings]
            return settings


def _bends(draw: np.random.Generator, vine: Vine) -> tuple[tuple[float, float, float], ...]:
    """One or two bends: start, arc and radius, mm."""
    starts = np.sort(draw.uniform(0.1, 0.7, int(draw.integers(1, 3)))) * vine.length_mm
    if starts.size == 2 and starts[1] - starts[0] < 0.2 * vine.length_mm:
        starts = starts[:1]
    arc = 0.15 * vine.length_mm
    return tuple((round(float(s), 1), round(arc, 1), round(arc / float(draw.uniform(0.6, 1.6)), 1)) for s in starts)
