"""The nouns that every stage hands on: a trial, its track, its kinematics.

Plain data in SI units, without files and without behaviour beyond what follows from the data themselves.
`lead_` is the leading edge (what a camera sees), `tail_` the tail and a payload riding on it; the tail moves
`travel_ratio` times as fast as the lead.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.constants import AMBIENT_PRESSURE_PA, FILM_DENSITY_KG_M3

Floats = NDArray[np.float64]
Indices = NDArray[np.int_]
Bools = NDArray[np.bool_]

FLAGS = ("before_release", "doubtful", "lost", "rejected", "duplicate", "corrected", "gap", "retimed", "after_end")
"""Every flag a point of a track can carry; several are joined by `;` in this order. `corrected`: a person has moved,
dropped or confirmed the point. `gap`: frames are missing before it; `retimed`: the times from it on were put right."""

_FORMER_RETIMED_FLAGS = "gap;corrected"
"""What releases before `retimed` wrote for `gap;retimed`; `corrected` stands before `gap` since, so that the two can be
told apart. Read for one release."""

UNUSABLE_FLAGS = frozenset({"lost", "rejected", "duplicate", "after_end"})
"""A point with one of these says nothing about where the leading edge was."""


CORRECTION_ACTIONS = ("move", "drop", "confirm")
"""What a person may do with a point of a track."""


@dataclass(frozen=True)
class Correction:
    """What a person says of one frame of a recording: one of CORRECTION_ACTIONS, and to where it is moved.

    `edge_px` counts along the growth axis of the trial, as the track's does; NaN where the point is not moved.
    """

    frame: int
    action: str
    edge_px: float = math.nan


POSITION_SYSTEMATIC_M = 1e-4
"""Standard deviation of a smooth error of position where nothing is known of the lens. Measured: with this allowance, a
smooth error of 0.11 mm was named as physics in 0 of 5 campaigns (5 of 6 without it), and neither depletion nor tail
friction was lost. At half of it such an error counts as 2 σ; at twice, errors of small effects grow with it."""


@dataclass(frozen=True)
class PictureAxis:
    """A line in the picture along which a trial moves: (x, y) of its ends, px; `width_m` is NaN where not given.

    `via_px` are the points between its ends through which a path that bends goes, in order.
    """

    from_px: tuple[float, float]
    to_px: tuple[float, float]
    width_m: float = math.nan
    via_px: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Bend:
    """A bend of the path: where it starts along the growth axis, its arc length and its radius, in metres."""

    start_m: float
    arc_m: float
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One row of the trial sheet, shared settings filled in, in SI units; NaN where the sheet is blank.

    `vine` names the trials of one diameter, thickness and length; `condition` the replicates: trials whose
    nominal settings are all the same. `specimen` is which tube of that vine it was, `day` the day or batch, blank
    where unknown; `order` the place of the trial among those made, counted from 1, NaN where unknown.
    """

    name: str
    vine: str = ""
    condition: str = ""
    video: Path | None = None
    track: Path | None = None
    pressure_trace: Path | None = None
    capture_fps: float = math.nan
    capture_fps_is_playback: bool = False
    compare_sizes: bool = True
    exposure_s: float = math.nan
    diameter_m: float = math.nan
    thickness_m: float = math.nan
    length_m: float = math.nan
    pressure_Pa: float = math.nan
    pressure_sigma_Pa: float = math.nan
    yield_pressure_Pa: float = math.nan
    yield_pressure_sigma_Pa: float = math.nan
    payload_kg: float = 0.0
    growth_angle_rad: float = 0.0
    chamber_m3: float = math.nan
    inlet_m: float = math.nan
    bends: tuple[Bend, ...] = ()
    film_density_kg_m3: float = FILM_DENSITY_KG_M3
    m_per_px: float = math.nan
    travel_ratio: float = 2.0
    steady_window_s: tuple[float, float] | None = None
    use: bool = True
    ambient_pressure_Pa: float = AMBIENT_PRESSURE_PA
    mass_loss: str = "geometric"
    tail_slack: str = "taut"
    tail_store: str = "body"
    position_systematic_m: float = math.nan  #: sd of smooth errors of position that no scatter shows; NaN: the default
    specimen: str = ""
    day: str = ""
    order: float = math.nan
    axis: PictureAxis | None = None
    frames_used: tuple[int, int] | None = None
    point_mass: str = ""
    corrections: tuple[Correction, ...] = ()

    def group(self, shared: str) -> str:
        """Name of the trials that have a number of their own together, where numbers are shared so.

        Parameters
        ----------
        shared : str
            `all`, `vine` or `day`.

        Returns
        -------
        str
            Blank for all, and where the day is unknown.
        """
        if shared == "day":
            return f"day {self.day}" if self.day else ""
        return self.vine if shared == "vine" else ""

    @property
    def area_m2(self) -> float:
        """Cross-section A = πD²/4."""
        return math.pi * self.diameter_m**2 / 4

    @property
    def linear_density_kg_m(self) -> float:
        """Film mass per metre λ = ρ_film π D t; 0 for a body that moves as a whole."""
        if self.travel_ratio == 1 and not math.isfinite(self.thickness_m):
            return 0.0
        return self.film_density_kg_m3 * math.pi * self.diameter_m * self.thickness_m

    @property
    def mass_loss_kg_m(self) -> float:
        """Mass c that the tail loses per metre of *tail* travel: λ(r−1)/r, or λ where the paper is taken literally."""
        if self.mass_loss == "as_printed":
            return self.linear_density_kg_m
        return self.linear_density_kg_m * (self.travel_ratio - 1) / self.travel_ratio

    def moving_mass_kg(self, lead_travel_m: Floats | float) -> Floats:
        """Mass of tail and payload m = λL + m_pay − c·x after `lead_travel_m` of growth (x = r·y), never negative.

        Parameters
        ----------
        lead_travel_m : array of any shape, m: growth since release.

        Returns
        -------
        array of that shape, kg.
        """
        length_m = self.length_m if math.isfinite(self.length_m) else 0.0
        film_kg = self.linear_density_kg_m * length_m
        tail_travel_m = self.travel_ratio * np.asarray(lead_travel_m, dtype=float)
        return np.maximum(film_kg - self.mass_loss_kg_m * tail_travel_m, 0.0) + self.payload_kg


def join_flags(*flags: str) -> str:
    """`;`-join flags in the order of FLAGS, each once, blanks dropped."""
    present = {part for flag in flags for part in split_flags(flag)}
    return ";".join(flag for flag in FLAGS if flag in present)


def split_flags(flag: str) -> list[str]:
    """The flags of one point.

    Parameters
    ----------
    flag : as a track holds it, joined by `;`; `gap;corrected` of an earlier release is read as `gap;retimed`.

    Returns
    -------
    list of str : without blanks.

    >>> split_flags("doubtful;gap;corrected"), split_flags("corrected;gap")
    (['doubtful', 'gap', 'retimed'], ['corrected', 'gap'])
    """
    return [part for part in flag.replace(_FORMER_RETIMED_FLAGS, "gap;retimed").split(";") if part]


def with_flag(flags: Iterable[str], name: str) -> NDArray[np.bool_]:
    """Mask, shape (n_frames,), of points that carry a flag.

    Parameters
    ----------
    flags : of every frame, joined by `;`.
    name : one of FLAGS.

    Returns
    -------
    array of bool, shape (n_frames,)
    """
    return np.array([name in split_flags(str(flag)) for flag in flags], dtype=bool)


def hand_corrected(flags: Iterable[str]) -> NDArray[np.bool_]:
    """Mask, shape (n_frames,), of points that a person has moved, dropped or confirmed.

    Parameters
    ----------
    flags : of every frame, joined by `;`.

    Returns
    -------
    array of bool, shape (n_frames,)
    """
    return with_flag(flags, "corrected")


@dataclass(frozen=True)
class Track:
    """Where the leading edge was at each frame of one trial. All arrays have shape (n_frames,).

    `lead_position_m` is NaN where there is none; `lead_position_sigma_m` the random error of that point alone (NaN
    where unknown), `lead_position_systematic_m` that of its slow error, which neighbouring frames share and an average
    over frames keeps (None or NaN where nothing is known of it). `flag` holds strings, see FLAGS; `pressure_Pa` is the
    gauge pressure measured along with it, if any; `notes` are sentences about the track as a whole that a person should
    read. `tracked_px` is `edge_px` as the tracker saw it, before anything was corrected by hand, None where nothing
    was.
    """

    time_s: Floats
    lead_position_m: Floats
    lead_position_sigma_m: Floats
    flag: NDArray[np.str_]
    edge_px: Floats
    pressure_Pa: Floats | None = None
    notes: tuple[str, ...] = ()
    tracked_px: Floats | None = None
    lead_position_systematic_m: Floats | None = None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Mask, shape (n_frames,): points that say where the leading edge was."""
        usable = np.isfinite(self.lead_position_m) & np.isfinite(self.time_s)
        for flag in {str(flag) for flag in self.flag[self.flag != ""]}:
            if UNUSABLE_FLAGS.intersection(flag.split(";")):
                usable &= self.flag != flag
        return usable


def plain_track(
    time_s: Floats, lead_position_m: Floats, *, sigma_m: Floats | None = None, pressure_Pa: Floats | None = None
) -> Track:
    """Positions of which nothing else is known: no flag, no pixels, and no error unless it is given.

    Parameters
    ----------
    time_s, lead_position_m : shape (n_frames,), s and m.
    sigma_m : shape (n_frames,), random error of each point, m.
    pressure_Pa : shape (n_frames,), gauge pressure measured along with it, Pa.

    Returns
    -------
    Track
    """
    unknown = np.full(len(time_s), np.nan)
    no_flag = np.full(len(time_s), "", dtype=f"<U{len(';'.join(FLAGS))}")
    return Track(time_s, lead_position_m, unknown if sigma_m is None else sigma_m, no_flag, unknown.copy(), pressure_Pa)


@dataclass(frozen=True)
class Kinematics:
    """Motion of the leading edge at the usable points of a track. All arrays have shape (n,), SI units.

    `window_points` is the width of the smoothing window chosen at each point; `noise_m` the standard deviation of a
    single position and `noise_correlation` its lag-one autocorrelation.
    """

    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    lead_velocity_sigma_m_s: Floats
    lead_acceleration_m_s2: Floats
    window_points: NDArray[np.int_]
    noise_m: float
    noise_correlation: float
    travel_ratio: float

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Speed of the tail: `travel_ratio` times that of the leading edge, shape (n,)."""
        return self.travel_ratio * self.lead_velocity_m_s


@dataclass(frozen=True)
class Window:
    """A stretch of a trial judged for steadiness by one rule, with the verdict and why.

    `rule` is `gated`, `paper` or `user`; `x_ss_m_s` the mean **tail** speed in the window and `x_ss_sigma_m_s` its
    standard error; `drift` the relative change of speed across the window with its 95 % interval `drift_95`; `cv` the
    coefficient of variation of the velocities in it. Numbers are NaN where there is no window.
    """

    rule: str
    accepted: bool
    reason: str
    from_s: float = math.nan
    to_s: float = math.nan
    n_points: int = 0
    x_ss_m_s: float = math.nan
    x_ss_sigma_m_s: float = math.nan
    drift: float = math.nan
    drift_95: tuple[float, float] = field(default=(math.nan, math.nan))
    cv: float = math.nan
