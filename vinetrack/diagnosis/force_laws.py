"""Simple laws that a missing force may follow, each with the words for it.

Every law is a shape of largest size 1 along the motions at hand, so that its amplitude is the largest force, N; a
periodic one has two shapes, a quarter of a period apart. Laws with a place or a scale come in a grid of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.numbers import decimals
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_sensitivities import FittedMotion

PLACES, WIDTHS = 16, (0.06, 0.12, 0.2, 0.33)
"""Places and widths of a local force, as parts of the growth. Chosen: neighbours overlap by half."""

PERIODS = 24
"""Periods tried. Chosen: each a tenth shorter than the one before."""

LONGEST_PERIOD, SHORTEST_PERIOD = 0.6, 0.04
"""Of the growth. Longer ones are slopes; shorter ones leave no trace in positions. Derived: two inertial lengths of
the fastest vine, and 1.5 periods in the growth."""

SCALES = (0.04, 0.1, 0.2, 0.4)
"""Decay lengths tried, as parts of the growth. Chosen in factors of two."""

LEAST_SPEED = 0.05
"""Part of the highest speed at which 1/ẋ stops rising: a vine starts from rest. Chosen: below, a frame says nothing of
the speed."""

EDGE = 0.1
"""Of a patch's width, over which the force rises at its ends. Chosen: sharp against the patch, smooth against a
frame."""

START = 0.05
"""Of the growth, over which a vine gathers speed: a force there is not the largest that is seen. Chosen; wording alone
depends on it."""

LEAST_PATCH_M = 1e-3
"""Least width of a local force that is named. Chosen: its ends are printed in millimetres; at half of it both ends
could be the same number, at twice a narrow obstacle goes unnamed."""

PLACES_BEYOND, SPEEDS_BEYOND = 8, 8
"""Places and speeds beyond which a force may set in. Chosen: each is then found between its neighbours by the fit in
full. Powers of the speed are 1, 2 and 3 only: one near n is the damping itself, and takes any size with B."""

SAME_AREA = 1.02
"""Ratio of areas up to which two vines count as one. Chosen: twice the error of a diameter of 0.5 %."""


@dataclass(frozen=True)
class Law:
    """One shape of force along a motion.

    `kind` names it; `low` and `high` are its place (m of growth), `scale` its period, range or where it sets in.
    `times` is what it is multiplied by: "position", "speed", "pressure" or nothing. `shapes` counts the numbers that
    shape it, `columns` its amplitudes. `by_area` tells a force that is larger on a wider vine, as the cross-section;
    `largest` is what the bare expression reaches along the motions at hand.
    """

    kind: str
    columns: int = 1
    shapes: int = 0
    low: float = math.nan
    high: float = math.nan
    scale: float = math.nan
    by_area: float = 0.0
    largest: float = 1.0
    times: str = ""

    @property
    def name(self) -> str:
        """What it is told from others by."""
        return f"{self.kind}_by_{self.times}" if self.times else self.kind

    @property
    def numbers(self) -> int:
        """Numbers that it has, a second factor counted as one: it was chosen among several."""
        return self.columns + self.shapes + bool(self.times)

    @property
    def variables(self) -> tuple[str, ...]:
        """What it hangs on: growth, speed, time or pressure; nothing where it is constant."""
        both = {VARIABLE[kind] for kind in (self.kind, self.times) if kind in VARIABLE}
        return tuple(name for name in ("growth", "speed", "time", "pressure") if name in both)

    @property
    def is_a_point(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that sees the growth resolves."""
        return self.kind == "patch" and not self.high - max(self.low, 0.0) > LEAST_PATCH_M

    @property
    def precision(self) -> float:
        """Of its amplitudes beforehand, 1/N²: none, they are free."""
        return 0.0

    @property
    def shape_names(self) -> tuple[str, ...]:
        """The numbers that shape it."""
        return ("low", "high") if self.kind == "patch" else ("scale",) * self.shapes

    def size_of(self, name: str) -> float:
        """How much of a change of one of them is a large one.

        Parameters
        ----------
        name : str
            One of `shape_names`.

        Returns
        -------
        float
        """
        return self.high - self.low if self.kind == "patch" else float(getattr(self, name))

    def shifted(self, name: str, by: float) -> Law:
        """The law with one of them changed.

        Parameters
        ----------
        name : str
            One of `shape_names`.
        by : float
            Added to it.

        Returns
        -------
        Law
        """
        return replace(self, **{name: getattr(self, name) + by})

    def kept_inside(self, growth_m: float) -> Law:
        """A patch no further beyond the growth than it is rounded.

        Parameters
        ----------
        growth_m : float
            Growth of the longest trial, m.

        Returns
        -------
        Law
        """
        if self.kind != "patch":
            return self
        room = EDGE * (self.high - self.low)
        return replace(self, low=max(self.low, -room), high=min(self.high, growth_m + room))

    def along(self, motion: FittedMotion) -> Floats:
        """The force of amplitude 1 along a motion, N, shape (n_times, columns).

        Parameters
        ----------
        motion
            A fitted motion.

        Returns
        -------
        array, shape (n_times, n_columns), N
        """
        size = (motion.trial.area_m2 / self.by_area if self.by_area else 1.0) / self.largest
        force = size * _EXPRESSIONS[self.kind](self, motion)
        return force * _EXPRESSIONS[self.times](self, motion) if self.times else force

    def words(self, amplitude_N: Sequence[float], sigma_N: float) -> str:
        """What it looks like, with its size.

        Parameters
        ----------
        amplitude_N : sequence of float, N
        sigma_N : float, N
            Standard error of the amplitude.

        Returns
        -------
        str
        """
        if self.kind == "periodic":
            size = f"with an amplitude of {_sized(math.hypot(*amplitude_N), sigma_N)}"
        else:
            size = f"{'+' if amplitude_N[0] > 0 else ''}{_sized(amplitude_N[0], sigma_N)}".replace("-", "−")
        wide = ", larger on a wider vine as its cross-section" if self.by_area else ""
        words = _WORDS[self.kind]
        if self.times:
            words = f"{words.partition(', {size}')[0]}, times {_TIMES[self.times]}, {{size}} at its largest"
        return (
            words.format(
                size=size,
                low=f"{1e3 * max(self.low, 0.0):.0f}",
                high=f"{1e3 * self.high:.0f}",
                scale_mm=_round(1e3 * self.scale),
                scale_ms=_round(1e3 * self.scale),
                scale=f"{self.scale:.2g}",
            )
            + wide
        )


def _round(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _sized(value_N: float, sigma_N: float) -> str:
    if not math.isfinite(sigma_N):
        return "any size"
    digits = decimals(sigma_N)
    return f"{value_N:.{digits}f} ± {sigma_N:.{digits}f} N"


def _patch(law: Law, motion: FittedMotion) -> Floats:
    edge = EDGE * (law.high - law.low)
    y = motion.lead_position_m
    return (0.5 * (np.tanh((y - law.low) / edge) - np.tanh((y - law.high) / edge)))[:, None]


def _periodic(law: Law, motion: FittedMotion) -> Floats:
    phase = 2 * math.pi * motion.lead_position_m / law.scale
    return np.column_stack([np.sin(phase), np.cos(phase)])


_EXPRESSIONS = {
    "constant": lambda _, m: np.ones((m.time_s.size, 1)),
    "position": lambda _, m: m.tail_position_m[:, None],
    "speed": lambda _, m: m.tail_velocity_m_s[:, None],
    "speed_squared": lambda _, m: m.tail_velocity_m_s[:, None] ** 2,
    "position_squared": lambda _, m: m.tail_position_m[:, None] ** 2,
    "beyond_a_place": lambda law, m: np.maximum(m.lead_position_m - law.scale, 0.0)[:, None],
    "speed_cubed": lambda _, m: m.tail_velocity_m_s[:, None] ** 3,
    "beyond_a_speed": lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0)[:, None],
    "squared_beyond_a_speed": lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0)[:, None] ** 2,
    "pressure": lambda _, m: m.pressure_Pa[:, None],
    "time": lambda _, m: m.time_s[:, None],
    "inverse_speed": lambda law, m: 1 / np.maximum(m.tail_velocity_m_s, law.scale)[:, None],
    "falling_with_speed": lambda law, m: np.exp(-m.tail_velocity_m_s / law.scale)[:, None],
    "fading_in_time": lambda law, m: np.exp(-m.time_s / law.scale)[:, None],
    "fading_along": lambda law, m: np.exp(-m.lead_position_m / law.scale)[:, None],
    "patch": _patch,
    "periodic": _periodic,
}
VARIABLE = {
    **dict.fromkeys(("position", "position_squared", "beyond_a_place", "fading_along", "patch", "periodic"), "growth"),
    **dict.fromkeys(("speed", "speed_squared", "speed_cubed", "beyond_a_speed", "squared_beyond_a_speed"), "speed"),
    **dict.fromkeys(("inverse_speed", "falling_with_speed"), "speed"),
    **dict.fromkeys(("time", "fading_in_time"), "time"),
    "pressure": "pressure",
}
"""What every kind but the constant hangs on."""

_OF_SPEED = ("inverse_speed", "falling_with_speed")
"""Largest at rest, where no speed tells: their size is that at the slowest that is seen."""

_WORDS = {
    "constant": "a constant force of {size}",
    "position": "a force in proportion to the tail's travel x, {size} at the end",
    "speed": "a force in proportion to the speed ẋ, {size} at the highest",
    "speed_squared": "a force in proportion to ẋ², {size} at the highest speed",
    "position_squared": "a force in proportion to x², {size} at the end",
    "beyond_a_place": "a force that rises in proportion to the growth beyond {scale_mm} mm, {size} at the end",
    "speed_cubed": "a force in proportion to ẋ³, {size} at the highest speed",
    "beyond_a_speed": "a force in proportion to what ẋ has beyond {scale} m/s, {size} at the highest",
    "squared_beyond_a_speed": "a force with the square of what ẋ has beyond {scale} m/s, {size} at the highest",
    "pressure": "a force in proportion to the pressure, {size} at the highest",
    "time": "a force that grows in proportion to time, {size} at the end of the longest trial",
    "inverse_speed": "a force that falls with speed as 1/ẋ, {size} at {scale} m/s and below",
    "falling_with_speed": "a force that falls with speed, {size} where slowest and e times less every {scale} m/s of ẋ",
    "fading_in_time": "a force that fades in time, {size} at release and e times less every {scale_ms} ms",
    "fading_along": "a force that fades along the growth, {size} at the start and e times less every {scale_mm} mm",
    "patch": "a force that acts between {low} and {high} mm of growth, {size}",
    "periodic": "a force that comes back every {scale_mm} mm of growth, {size}",
}


_TIMES_OF = {
    **dict.fromkeys(("position", "position_squared", "fading_along", "beyond_a_place"), ("speed", "pressure")),
    **dict.fromkeys(("speed", "speed_squared", "inverse_speed"), ("pressure",)),
    "speed_squared": ("position", "pressure"),
    "falling_with_speed": ("pressure",),
}
"""Products that are tried: a function of the growth with the speed or the pressure, of the speed with travel or
pressure. One that reads the same either way stands once. Chosen: a fall with speed times the travel is left out, for
x exp(−ẋ/v₀) is nearly x/ẋ, which is time, and takes its place."""

_TIMES = {"position": "the tail's travel x", "speed": "the speed ẋ", "pressure": "the pressure"}


@dataclass(frozen=True)
class _Reach:
    """How far the motions go."""

    growth_m: float
    speed_m_s: float
    time_s: float


def coarse_laws(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, each also in proportion to the cross-section.

    Parameters
    ----------
    motions : sequence of FittedMotion

    Returns
    -------
    list of Law
    """
    reach = _reach(motions)
    plain = ["constant", "position", "speed", "speed_squared", "pressure", "time", "position_squared", "speed_cubed"]
    laws = [Law(kind) for kind in plain]
    for k in range(PLACES_BEYOND):
        laws.append(Law("beyond_a_place", shapes=1, scale=(k + 0.5) / PLACES_BEYOND * reach.growth_m))
    for k in range(SPEEDS_BEYOND):
        beyond_m_s = (k + 0.5) / SPEEDS_BEYOND * reach.speed_m_s
        laws += [Law(kind, shapes=1, scale=beyond_m_s) for kind in ("beyond_a_speed", "squared_beyond_a_speed")]
    laws.append(Law("inverse_speed", scale=LEAST_SPEED * reach.speed_m_s))
    for part in SCALES:
        laws.append(Law("falling_with_speed", shapes=1, scale=part * reach.speed_m_s))
        laws.append(Law("fading_in_time", shapes=1, scale=part * reach.time_s))
        laws.append(Law("fading_along", shapes=1, scale=part * reach.growth_m))
    for width in WIDTHS:
        for centre in (np.arange(PLACES) + 0.5) / PLACES * reach.growth_m:
            laws.append(_patch_at(float(centre), width * reach.growth_m))
    for period in np.geomspace(SHORTEST_PERIOD, LONGEST_PERIOD, PERIODS) * reach.growth_m:
        laws.append(Law("periodic", columns=2, shapes=1, scale=float(period)))
    laws += [replace(law, times=other) for law in laws for other in _TIMES_OF.get(law.kind, ())]
    areas = [motion.trial.area_m2 for motion in motions]
    if max(areas) > SAME_AREA * min(areas):
        laws += [_by_area(law, float(np.mean(areas))) for law in laws if "pressure" not in law.variables]
    return _scaled(laws, motions)


def finer_laws(law: Law, motions: Sequence[FittedMotion]) -> list[Law]:
    """Laws around the best of the grid: its place, width, period or range moved by less than a step of the grid.

    Parameters
    ----------
    law : the best of the grid.
    motions : sequence of FittedMotion

    Returns
    -------
    list of Law
    """
    if law.kind == "patch":
        centre, width = (law.low + law.high) / 2, law.high - law.low
        step = _reach(motions).growth_m / PLACES
        near = [law] if law.times else [replace(law, times="speed"), replace(law, times="pressure")]
        near += [
            replace(_patch_at(centre + shift * step, stretch * width), times=law.times)
            for shift in np.linspace(-0.75, 0.75, 7)
            for stretch in (0.5, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8)
        ]
    elif law.shapes:
        near = [
            replace(law, scale=law.scale * factor)
            for factor in (
                np.geomspace(0.9, 1.11, 17) if law.kind == "periodic" else np.geomspace(0.5, 2.0, 13)
            ).tolist()
        ]
    else:
        return []
    return _scaled([_by_area(near_law, law.by_area) if law.by_area else near_law for near_law in near], motions)


def _patch_at(centre: float, width: float) -> Law:
    return Law("patch", shapes=2, low=centre - width / 2, high=centre + width / 2)


def _by_area(law: Law, mean_area: float) -> Law:
    return replace(law, by_area=mean_area)


def _scaled(laws: Sequence[Law], motions: Sequence[FittedMotion]) -> list[Law]:
    """The laws with the largest force that they reach along the motions as their unit."""
    scaled = []
    for law in (replace(law, largest=1.0) for law in laws):
        everywhere = [np.abs(law.along(motion)) for motion in motions]
        largest = max(float(course.max()) for course in everywhere)
        seen = max(float(course[_grown(motion)].max()) for course, motion in zip(everywhere, motions, strict=True))
        if law.columns > 1:
            largest = 1.0
        elif law.kind in _OF_SPEED:
            largest = seen
        elif law.kind == "patch" and seen < 0.5 * largest:
            continue
        scaled.append(replace(law, largest=largest or 1.0))
    return scaled


def _grown(motion: FittedMotion) -> NDArray[np.bool_]:
    """Where a vine has left its start behind: what a law says of rest alone is not seen."""
    return motion.lead_position_m >= START * motion.lead_position_m.max()


def _reach(motions: Sequence[FittedMotion]) -> _Reach:
    return _Reach(
        max(float(motion.lead_position_m.max()) for motion in motions),
        max(float(np.quantile(motion.tail_velocity_m_s, 0.98)) for motion in motions),
        max(float(motion.time_s[-1]) for motion in motions),
    )
