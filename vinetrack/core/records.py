"""Records passed between stages: trial, track, kinematics.

Plain data in SI units, without file access. `lead_` is the leading edge (what a camera sees), `tail_` the tail and a
payload riding on it; the tail moves `travel_ratio` times as fast as the leading edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.units import AMBIENT_PRESSURE_PA, pressure_text

Floats = NDArray[np.float64]
Indices = NDArray[np.int_]
Bools = NDArray[np.bool_]

# Flags of a point of a track; several are joined by `;` in this order
FLAGS = ("before_release", "doubtful", "lost", "rejected", "duplicate", "corrected", "gap", "retimed", "after_end")

# Flags of points that are not measurements of the leading edge
UNUSABLE_FLAGS = frozenset({"lost", "rejected", "duplicate", "after_end"})

SIDE_FILES = (".cih", ".cihx")  # Suffixes of headers that lie beside a Photron `.mraw`
# Suffixes of files of high-speed cameras, which state the capture rate
CAMERA_FILES = frozenset({".cine", ".mraw", *SIDE_FILES})
# Suffixes of recordings: films, and pictures of which a folder or a stack is one
CONTAINERS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mts", ".ts"}) | CAMERA_FILES - {*SIDE_FILES}
IMAGES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".dng", ".bmp", ".pgm"})


@dataclass(frozen=True)
class Correction:
    """A correction of one frame by hand: `move` to `edge_px` along the growth axis, else NaN, `drop` or `confirm`."""

    frame: int
    action: str
    edge_px: float = math.nan


END_FRACTION = 0.95  # Growth beyond this fraction of the length is left out: the moving mass vanishes there (chosen)


@dataclass(frozen=True)
class PictureAxis:
    """Growth axis of a trial in the picture: (x, y) of its ends and of points between, px; NaN for no width."""

    from_px: tuple[float, float]
    to_px: tuple[float, float]
    width_m: float = math.nan
    via_px: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Bend:
    """A bend of the path: start along the growth axis, arc length and radius, in metres."""

    start_m: float
    arc_m: float
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One row of the trial sheet with shared settings filled in, SI; NaN for blank cells. `vine` is common to trials of
    one diameter, thickness and length; `condition` to replicates, with the same nominal settings.
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
    pressure_unit: str = "kPa"  #: that of the sheet, in which people read the pressure
    pressure_sigma_Pa: float = math.nan
    yield_pressure_Pa: float = math.nan
    yield_pressure_sigma_Pa: float = math.nan
    payload_kg: float = 0.0
    growth_angle_rad: float = 0.0
    chamber_m3: float = math.nan
    inlet_m: float = math.nan
    bends: tuple[Bend, ...] = ()
    film_density_kg_m3: float = 1200.0  #: thermoplastic polyurethane, 1100 to 1250 (chosen)
    m_per_px: float = math.nan
    travel_ratio: float = 2.0
    steady_window_s: tuple[float, float] | None = None
    use: bool = True
    ambient_pressure_Pa: float = AMBIENT_PRESSURE_PA
    mass_loss: str = "geometric"
    tail_slack: str = "taut"
    tail_store: str = "body"
    position_systematic_m: float = math.nan  #: standard deviation of smooth position errors; NaN where it is not stated
    systematic_of_travel: float = 4e-4  #: that where it is not stated, of the longest travel; lens unknown (chosen)
    specimen: str = ""
    day: str = ""
    order: float = math.nan
    axis: PictureAxis | None = None
    frames_used: tuple[int, int] | None = None
    point_mass: str = ""
    corrections: tuple[Correction, ...] = ()

    def group(self, shared: str) -> str:
        """Return the group of this trial by a column of the sheet, blank for `all`; a specimen is one of its vine."""
        if shared in ("vine", "specimen"):
            return f"{self.vine}, {self.specimen}" if shared == "specimen" and self.specimen else self.vine
        return f"{shared} {value}" if (value := getattr(self, shared, "")) else ""

    @property
    def yield_group(self) -> str:
        """Vine and stated yield pressure: trials with one P_y, where a vine has several."""
        return f"{self.vine}, {pressure_text(self.yield_pressure_Pa, self.pressure_unit, 6)}"

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
        """Mass c that the tail loses per metre of *tail* travel: λ(r−1)/r, or λ as printed in the paper."""
        if self.mass_loss == "as_printed":
            return self.linear_density_kg_m
        return self.linear_density_kg_m * (self.travel_ratio - 1) / self.travel_ratio

    def moving_mass_kg(self, lead_travel_m: Floats | float) -> Floats:
        """Return the mass of tail and payload, m = max(λL − c·x, 0) + m_pay, after growth y, with x = r·y."""
        length_m = self.length_m if math.isfinite(self.length_m) else 0.0
        film_kg = self.linear_density_kg_m * length_m
        tail_travel_m = self.travel_ratio * np.asarray(lead_travel_m, dtype=float)
        return np.maximum(film_kg - self.mass_loss_kg_m * tail_travel_m, 0.0) + self.payload_kg


def join_flags(*flags: str) -> str:
    """Join flags by `;` in the order of FLAGS, without repetitions and blanks."""
    present = ";".join(flags).split(";")
    return ";".join(flag for flag in FLAGS if flag in present)


def with_flag(flags: Iterable[str], *names: str) -> NDArray[np.bool_]:
    """Return the mask of points that carry one of these flags. Shape (n_frames,)."""
    texts = np.asarray(flags, dtype=str).tolist()
    carrying = {text for text in set(texts) if not set(names).isdisjoint(text.split(";"))}
    return np.array([text in carrying for text in texts], dtype=bool)


@dataclass(frozen=True)
class Track:
    """The leading edge at each frame of one trial, shapes (n_frames,); its position is NaN where it was not found."""

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
        """Mask, shape (n_frames,), of points that are measurements of the leading edge."""
        measured = np.isfinite(self.lead_position_m) & np.isfinite(self.time_s)
        return measured & ~with_flag(self.flag, *UNUSABLE_FLAGS)

    def flagged(self, rows: Indices | Bools | list[int], flags: str, *notes: str) -> Track:
        """Return the track with flags, joined by `;`, added to some of its rows, and with more notes."""
        flag = self.flag.astype("<U80")
        flag[rows] = [join_flags(str(old), flags) for old in flag[rows]]
        return replace(self, flag=flag, notes=(*self.notes, *notes))


def plain_track(time_s: Floats, lead_position_m: Floats, **known: Any) -> Track:
    """Make a track of positions, and of other fields as far as they are `known`. Shapes of all arrays (n_frames,)."""
    unknown = np.full(len(time_s), np.nan)
    no_flag = np.full(len(time_s), "", dtype=f"<U{len(';'.join(FLAGS))}")
    return replace(Track(time_s, lead_position_m, unknown, no_flag, unknown.copy()), **known)


@dataclass(frozen=True)
class Kinematics:
    """Motion of the leading edge at the usable points of a track, SI, shapes (n,). `window_points` is the width of the
    smoothing window at each; `noise_m` the standard deviation of a position, `noise_correlation` at lag one.
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
