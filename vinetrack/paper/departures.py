"""Departures from the paper's assumptions, simulated for its own trials: differences of the motions from Eq. (2).

The departures are a chamber that is not refilled, from slow (isothermal) to fast (adiabatic), a tail that cannot carry
compression, and both. They bound the effect of such a departure, with the printed B, n and P_y, and do not explain what
was measured: neither the rate at which the regulator refills nor the lengths of the vines are printed, and a payload
that has fallen to the tip rests there without pushing it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from vinetrack import effects
from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import Model, base_model
from vinetrack.dynamics.simulate import Trajectory, simulate
from vinetrack.kinematics.conditions import lead_velocity_at

# Fraction of the length up to which positions are compared (chosen)
WITHIN = 0.95

LASTS_S = 60.0  # Duration of the simulated motions, s; the slowest, at 7 kPa, takes 7 s by Eq. (2) (chosen)


@dataclass(frozen=True)
class Departure:
    """A departure from Eq. (2): `gamma` of a chamber that is not refilled (None: refilled), and a slack tail."""

    name: str
    words: str
    gamma: float | None = None
    slack: bool = False

    def model(self, B: float) -> Model:
        """Return Eq. (2) with the printed n and this departure."""
        model = base_model()
        if self.gamma is not None:
            model = (model + effects.reservoir_depletion).with_values({"reservoir_depletion.gamma": self.gamma})
        return model.with_values({"eversion_damping.B": B, "eversion_damping.n": published.EXPONENT})

    def trial(self, trial: Trial) -> Trial:
        """Return the trial, whose tail may go slack if the departure says so."""
        return replace(trial, tail_slack="free" if self.slack else "taut")


NONE = Departure("eq2", "Eq. (2)")
DEPARTURES = (
    Departure("depletion_slow", "chamber not refilled, isothermal", gamma=1.0),
    Departure("depletion_fast", "chamber not refilled, adiabatic", gamma=1.4),
    Departure("slack", "tail that cannot push", slack=True),
    Departure("depletion_slow_slack", "both, isothermal", gamma=1.0, slack=True),
    Departure("depletion_fast_slack", "both, adiabatic", gamma=1.4, slack=True),
)

DEPARTURE_COLUMNS = (
    "figure",
    "pressure_kPa",
    "departure",
    "rms_position_m",
    "rms_final_lead_velocity_m_s",
    "slack_from_s",
)
MOTION_COLUMNS = ("pressure_kPa", "departure", "time_s", "lead_position_m")


def paper_trial(
    diameter_mm: float, thickness_um: float, length_mm: float, pressure_kPa: float, payload_g: float = 0.0
) -> Trial:
    """Return a trial of the paper's rig: downwards, 3.7 L, P_y 3 kPa."""
    return Trial(
        name=f"{diameter_mm:g} mm × {thickness_um:g} µm at {pressure_kPa:g} kPa",
        capture_fps=published.CAPTURE_FPS,
        diameter_m=diameter_mm / 1e3,
        thickness_m=thickness_um / 1e6,
        length_m=length_mm / 1e3,
        pressure_Pa=1e3 * pressure_kPa,
        yield_pressure_Pa=1e3 * published.YIELD_PRESSURE_KPA,
        payload_kg=payload_g / 1e3,
        chamber_m3=published.CHAMBER_L / 1e3,
    )


def position_trials() -> list[Trial]:
    """Return the trials of the paper's Fig. 4: the 24 mm × 200 µm vine, as long as the longest, with its payload."""
    size = (published.DIAMETER_MM[4], published.THICKNESS_UM[4], published.LONGEST_VINE_MM)
    return [paper_trial(*size, pressure_kPa, published.PAYLOAD_G) for pressure_kPa in published.POSITION_RMS_CM]


def departure_table(payloads_g: Sequence[float]) -> pd.DataFrame:
    """Compute the differences of each departure from Eq. (2), columns `DEPARTURE_COLUMNS`."""
    rows: list[tuple[object, ...]] = []
    for trial in position_trials():
        plain = follow(trial, NONE, published.DAMPING_B[4])
        for departure in DEPARTURES:
            moved = follow(trial, departure, published.DAMPING_B[4])
            rms_m = position_rms_m(plain, moved, trial)
            rows.append(("Fig. 4", trial.pressure_Pa / 1e3, departure.name, rms_m, math.nan, moved.slack_from_s))
    for pressure_kPa in published.FINAL_SPEED_RMS_M_S:
        for departure in DEPARTURES:
            off = [_speed_change_m_s(pressure_kPa, payload_g, departure) for payload_g in payloads_g]
            rms_m_s = math.sqrt(float(np.mean(np.square(off)))) if off else math.nan
            rows.append(("Fig. 5", float(pressure_kPa), departure.name, math.nan, rms_m_s, math.nan))
    return pd.DataFrame(rows, columns=list(DEPARTURE_COLUMNS))


def follow(trial: Trial, departure: Departure, B: float) -> Trajectory:
    """Simulate the motion at the camera's frames, until it ends or for `LASTS_S`."""
    time_s = np.arange(0, LASTS_S, 1 / published.CAPTURE_FPS)
    return simulate(departure.model(B), departure.trial(trial), time_s)


def position_rms_m(plain: Trajectory, moved: Trajectory, trial: Trial) -> float:
    """Return the root mean square difference of two positions from release until Eq. (2) has grown to 95 %."""
    stop = int(np.searchsorted(plain.lead_position_m, WITHIN * trial.length_m))
    return math.sqrt(float(np.mean((moved.lead_position_m[:stop] - plain.lead_position_m[:stop]) ** 2)))


def _speed_trial(pressure_kPa: float, payload_g: float) -> tuple[Trial, float]:
    """A trial of the paper's Fig. 5 and its B, which is not printed and taken as proportional to the wall."""
    wall_um = published.FINAL_SPEED_THICKNESS_UM
    B = published.DAMPING_B[4] * wall_um / published.THICKNESS_UM[4]
    return paper_trial(published.DIAMETER_MM[4], wall_um, published.LONGEST_VINE_MM, pressure_kPa, payload_g), B


def _speed_change_m_s(pressure_kPa: float, payload_g: float, departure: Departure) -> float:
    """Change of the leading edge's speed at the paper's 12 cm against Eq. (2)."""
    trial, B = _speed_trial(pressure_kPa, payload_g)
    at_m = published.FINAL_SPEED_AT_MM / 1e3
    speeds = []
    for assumed in (departure, NONE):
        moved = follow(trial, assumed, B)
        speeds.append(lead_velocity_at(moved.lead_position_m, moved.lead_velocity_m_s, at_m))
    return speeds[0] - speeds[1] if math.isfinite(speeds[0]) else -speeds[1]


def motion_table(instants: int = 200) -> pd.DataFrame:
    """Simulate the motions of Fig. 4 by Eq. (2) and with each departure, columns `MOTION_COLUMNS`."""
    parts = []
    for trial in position_trials():
        for departure in (NONE, *DEPARTURES):
            moved = follow(trial, departure, published.DAMPING_B[4])
            end_s = moved.end_time_s if math.isfinite(moved.end_time_s) else LASTS_S
            time_s = np.linspace(0, end_s, instants)
            position_m = np.interp(time_s, moved.time_s, moved.lead_position_m)
            columns = (trial.pressure_Pa / 1e3, departure.name, time_s, position_m)
            parts.append(pd.DataFrame(dict(zip(MOTION_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True)


def pressure_table(instants: int = 60) -> pd.DataFrame:
    """Compute the remaining gauge pressure along the growth of Fig. 4's vine."""
    from vinetrack.paper.arithmetic import area_m2, gauge_left

    rows = []
    for trial in position_trials():
        for departure in DEPARTURES[:2]:
            for y in np.linspace(0, trial.length_m, instants):
                change = area_m2(1e3 * trial.diameter_m) * float(y) / trial.chamber_m3
                left = gauge_left(trial.pressure_Pa, change, departure.gamma or 1.0)
                rows.append((trial.pressure_Pa / 1e3, departure.name, float(y), left))
    return pd.DataFrame(rows, columns=["pressure_kPa", "departure", "lead_position_m", "gauge_left"])
