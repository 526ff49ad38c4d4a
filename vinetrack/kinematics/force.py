"""Driving force of a vine in its steady window, and whether the trial enters the damping fit.

    F = (P_w − P_y) A + r m̄ g cosθ

In a window that is only quasi-steady, `r m̄ g cosθ` becomes `r m̄ (g cosθ − ẍ)`.

P_w is the gauge pressure in the window (measured, else that of the model in use) and m̄ the mean moving mass there. The
rule of the paper, Eq. (3), uses the set pressure and neglects the weight: noise-free data with n = 0.37 then give 0.38.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats, Kinematics, Track, Trial, Window
from vinetrack.dynamics.force_terms import pressure_along
from vinetrack.dynamics.model import Model
from vinetrack.kinematics.release import Release


@dataclass(frozen=True)
class SteadyForce:
    """Force in a steady window, N, its random standard error, and `yield_sigma_N`, the error due to the yield pressure.
    The latter is shared by all trials of a vine. `paper_N` is the force by the published rule: set pressure, no weight.
    """

    force_N: float
    sigma_N: float
    yield_sigma_N: float
    paper_N: float
    window_pressure_Pa: float
    pressure_source: str  #: `trace` where it was measured in the window, else `set`


def steady_force(
    trial: Trial, track: Track, kinematics: Kinematics, release: Release, window: Window, model: Model
) -> SteadyForce:
    """Compute the force of a trial in one window."""
    inside = (kinematics.time_s >= window.from_s) & (kinematics.time_s <= window.to_s)
    travel_m = np.maximum(kinematics.lead_position_m[inside] - release.lead_position_m, 0.0)
    pressure_Pa, sigma_Pa, source = _window_pressure(trial, track, kinematics, release, window, model, inside)
    mass_kg = float(np.mean(trial.moving_mass_kg(travel_m)))
    weight_N = trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)
    if window.rule == "quasi_steady":
        weight_N -= trial.travel_ratio * mass_kg * window.drift * window.x_ss_m_s / (window.to_s - window.from_s)
    return SteadyForce(
        force_N=(pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2 + weight_N,
        sigma_N=sigma_Pa * trial.area_m2,
        yield_sigma_N=trial.yield_pressure_sigma_Pa * trial.area_m2,
        paper_N=paper_force_N(trial),
        window_pressure_Pa=pressure_Pa,
        pressure_source=source,
    )


def paper_force_N(trial: Trial) -> float:
    """Return the force by the published rule, (P − P_y)A with the set pressure and without weight."""
    return (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2


def known_pressure(trial: Trial, track: Track, kinematics: Kinematics, release: Release, model: Model) -> Floats | None:
    """Return the gauge pressure at the points of the kinematics; None where only the set pressure is known. It is the
    measured pressure, else that of a model with an effect on the pressure. Shape (n,).
    """
    if track.pressure_Pa is not None and np.isfinite(track.pressure_Pa).sum() > 1:
        measured = np.isfinite(track.pressure_Pa)
        return np.interp(kinematics.time_s, track.time_s[measured], track.pressure_Pa[measured])
    if not any({"pressure", "chamber_rate"} & set(effect.functions) for effect in model):
        return None
    return _modelled_pressure(trial, kinematics, release, model)


def _modelled_pressure(trial: Trial, kinematics: Kinematics, release: Release, model: Model) -> Floats:
    start_s = release.time_s if math.isfinite(release.time_s) else kinematics.time_s[0]
    travel_m = np.maximum(kinematics.lead_position_m - release.lead_position_m, 0.0)
    since_s = np.maximum(kinematics.time_s - start_s, 0.0)
    return pressure_along(model, trial, since_s, travel_m, np.maximum(kinematics.lead_velocity_m_s, 0.0))


def _window_pressure(
    trial: Trial,
    track: Track,
    kinematics: Kinematics,
    release: Release,
    window: Window,
    model: Model,
    inside: np.ndarray,
) -> tuple[float, float, str]:
    """Mean gauge pressure in the window, its random error, Pa, and whether it comes from a `trace` or was `set`."""
    if track.pressure_Pa is not None:
        measured = track.pressure_Pa[(track.time_s >= window.from_s) & (track.time_s <= window.to_s)]
        measured = measured[np.isfinite(measured)]
        if measured.size:
            return float(measured.mean()), _mean_error(measured), "trace"
    along = _modelled_pressure(trial, kinematics, release, model)[inside]
    return float(np.mean(along)), trial.pressure_sigma_Pa, "set"


def _mean_error(measured_Pa: Floats) -> float:
    """Standard error of the mean of a trace, from the scatter about its linear trend, which is not an error."""
    if measured_Pa.size < 4:
        return 0.0
    steps = np.arange(measured_Pa.size)
    residual = measured_Pa - np.polyval(np.polyfit(steps, measured_Pa, 1), steps)
    return float(np.sqrt(np.sum(residual**2) / (measured_Pa.size - 2) / measured_Pa.size))


def why_not_in_fit(trial: Trial) -> str:
    """Return why a trial cannot enter the damping fit whatever its motion; blank if it can."""
    if trial.travel_ratio != 2:
        return "a body that moves as a whole has no eversion damping"
    if trial.payload_kg > 0:
        return f"carries a payload of {trial.payload_kg * 1e3:g} g"
    return ""


def why_not_force(force: SteadyForce | None) -> str:
    """Return why a force cannot enter the damping fit; blank if it can."""
    if force is None:
        return "no steady window"
    if not force.force_N > 0:
        return f"the force in the window is {force.force_N:.3g} N: the pressure does not exceed the yield pressure"
    return ""
