"""The recordings as they were published, and what can be read straight off them without any model of motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

from vinetrack.core.records import Floats

PA_PER_PSI = 6894.757
DIAMETER_M, THICKNESS_M = 25.4e-3, 50.8e-6
AREA_M2 = np.pi * DIAMETER_M**2 / 4

GOES_M_S, STANDS_M_S = 0.06, 0.03
"""Speeds of the leading edge above which the tube counts as growing and below which as standing, apart enough for the
encoder's steps (0.5 mm in 20 ms would be 0.025 m/s) to start and stop nothing."""

GRID_S, WINDOW = 0.02, 7
"""Samples come every 12–28 ms: speeds are taken from quadratics through 7 points of an even grid."""


@dataclass(frozen=True)
class Event:
    """A start or a stop of growth: when, how far grown, gauge pressure, Pa."""

    kind: str
    time_s: float
    lead_position_m: float
    pressure_Pa: float


@dataclass(frozen=True)
class Recording:
    """One recording; arrays of shape (n_samples,). `lead_position_m` is the length by the reel's encoder."""

    name: str
    tube: str
    friction: str
    supply_Pa: float
    time_s: Floats
    lead_position_m: Floats
    pressure_Pa: Floats

    @cached_property
    def even(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Time, position from the first, pressure, speed and acceleration of the leading edge on an even grid."""
        time_s = np.arange(self.time_s[0], self.time_s[-1], GRID_S)
        y = np.interp(time_s, self.time_s, self.lead_position_m - self.lead_position_m[0])
        speed, acceleration = (savgol_filter(y, WINDOW, 2, deriv=k, delta=GRID_S) for k in (1, 2))
        return time_s, y, np.interp(time_s, self.time_s, self.pressure_Pa), speed, acceleration

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Starts and stops of growth in order of time."""
        found, growing = [], False
        for t, y, pressure, speed, _ in np.column_stack(self.even):
            if speed > GOES_M_S if not growing else speed < STANDS_M_S:
                growing = not growing
                found.append(Event("start" if growing else "stop", t, y, pressure))
        return tuple(found)

    @property
    def travel_m(self) -> float:
        """How far the reel let the tube grow."""
        return float(np.ptp(self.lead_position_m))

    @cached_property
    def growing(self) -> np.ndarray:
        """Places on the even grid where the tube grows."""
        return self.even[3] > GOES_M_S

    @property
    def lowest_growing_Pa(self) -> float:
        """Lowest gauge pressure at which it was seen to grow."""
        return float(np.min(self.even[2][self.growing]))


def read_recordings(folder: Path) -> list[Recording]:
    """All recordings of the folder, by tube and trial.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    files = sorted(folder.glob("eversion_*_tube-*_trial-*.csv"), key=lambda path: path.stem.split("tube-")[1])
    if not files:
        raise FileNotFoundError(f"{folder} holds no recordings named eversion_*_tube-*_trial-*.csv")
    return [_read(path) for path in files]


def _read(path: Path) -> Recording:
    table = pd.read_csv(path)
    tube, trial = path.stem.split("tube-")[1].split("_trial-")
    friction = str(table["fric_level"].iloc[0])
    return Recording(
        name=f"tube{tube}_{friction}_{trial}",
        tube=tube,
        friction=friction,
        supply_Pa=float(table["supply_psi"].iloc[0]) * PA_PER_PSI,
        time_s=table["time_sec"].to_numpy(float),
        lead_position_m=table["reel_lin_mm_1"].to_numpy(float) / 1e3,
        pressure_Pa=table["press_psi_1"].to_numpy(float) * PA_PER_PSI,
    )


TERMS = ("constant_kPa", "length_kPa_m", "speed_kPa_s_m", "inertia_kg", "left_kPa")


def balance(one: Recording) -> dict[str, float]:
    """Pressure while growing as a sum: a constant, a part by length, one by tail speed, one by tail acceleration.

    ½ A P = c + a y + b ẋ + M ẍ by least squares over the points at which the tube grows: a balance of forces read off
    the recording, no equation of motion solved. All but M are given as pressures; `left_kPa` is what is left, RMS.
    """
    _, y, pressure, speed, acceleration = one.even
    pick = one.growing
    columns = np.column_stack([np.ones(pick.sum()), y[pick], 2 * speed[pick], 2 * acceleration[pick]])
    drive = 0.5 * AREA_M2 * pressure[pick]
    found, *_ = np.linalg.lstsq(columns, drive, rcond=None)
    left = float(np.std(drive - columns @ found))
    kPa = 2e-3 / AREA_M2
    return dict(zip(TERMS, (*(found[:3] * kPa).tolist(), float(found[3]), left * kPa), strict=True))


def thresholds(one: Recording, kind: str) -> tuple[float, float] | None:
    """Line through the pressures of all starts or all stops against length: kPa at 0, kPa/m; None with under three."""
    found = [event for event in one.events if event.kind == kind]
    if len(found) < 3:
        return None
    slope, at_zero = np.polyfit([e.lead_position_m for e in found], [e.pressure_Pa / 1e3 for e in found], 1)
    return float(at_zero), float(slope)
