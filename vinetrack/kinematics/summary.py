"""Analysis of one trial from its track to a row of results, and the damping law under a fitted model.

The velocity of the leading edge is that of cubics fitted to windows of which the width is chosen for each point. As a
chamber empties, the speed falls: with the set pressure no window is then steady, or the force in it is too large and n
and B are biased. Under a model with the effect on the pressure, the same tracks give the law again. Windows that do not
depend on the model are found once for all models.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Indices, Kinematics, Track, Trial
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.dynamics.model import Model
from vinetrack.effects import EffectError
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.damping import LEAST_STEADY_SHARE, fit_laws, mark_half_steady
from vinetrack.kinematics.steady import (
    SteadyForce,
    TrialMotion,
    Window,
    find_release,
    flag_rest,
    gated_window,
    known_pressure,
    paper_force_N,
    paper_window,
    quasi_steady_window,
    steady_force,
    user_window,
    why_not_in_fit,
)
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.tracks.position_noise import correlated, position_noise

# ------------------------------------------------------------------------------
# Velocity of the leading edge by Savitzky–Golay smoothing with a window chosen for each point.
#
# Around every point a cubic is fitted to windows of increasing width, centred or to one side. Windows in which the
# cubic does not fit the points (release, end of growth) are excluded. Of the centred windows the widest is kept whose
# velocity agrees with all narrower ones (Lepski 1991, Theory Probab. Appl. 35:454); of all windows that agree with it,
# the one with the smallest standard error is used: wide windows on plateaus, narrow or one-sided ones at the release.
# Position, velocity and acceleration always come from the same fit.
#
# For even spacing the fit is a convolution (Savitzky and Golay 1964, Anal. Chem. 36:1627); windows with a gap or
# uneven spacing are fitted individually by least squares of the same order.


@dataclass(frozen=True)
class WindowFits:
    """Polynomials fitted to all m = n − width + 1 windows of `width` points, in powers of u = (t − middle)/half, middle
    and half (m,): `coefficients` (order + 1, m), their `covariance` (order + 1, order + 1, m) for noise of 1 m.
    """

    width: int
    coefficients: Floats
    middle_s: Floats
    half_s: Floats
    covariance: Floats
    misfit: Floats

    def at(self, time_s: Floats, window: Indices) -> tuple[Floats, Floats]:
        """Evaluate the polynomials of given windows at given times. Returns position, velocity, acceleration, shape (3,
        k), SI; standard error of the velocity for noise of 1 m, shape (k,),: 1/s. Shapes: time_s, window (k,).
        """
        half = self.half_s[window]
        u = (time_s - self.middle_s[window]) / half
        # Powers of u and their first and second derivatives, each (terms, k)
        k = np.arange(self.coefficients.shape[0])[:, None]
        value = u**k
        slope, curve = np.zeros_like(value), np.zeros_like(value)
        slope[1:] = k[1:] * value[:-1]
        curve[2:] = k[2:] * (k[2:] - 1) * value[:-2]
        c = self.coefficients[:, window]
        values = np.array([(c * value).sum(axis=0), (c * slope).sum(axis=0) / half, (c * curve).sum(axis=0) / half**2])
        variance = np.einsum("ik,ijk,jk->k", slope, self.covariance[:, :, window], slope)
        return values, np.sqrt(np.maximum(variance, 0.0)) / half

    def velocities(self, time_s: Floats, side: float) -> tuple[Indices, Floats, Floats]:
        """Evaluate the velocity at every point, from the window in which the point has a given position. Returns number
        of the window, velocity, m/s, and its standard error for noise of 1 m, 1/s; each of shape (n,).
        """
        offset = round((1 + side) / 2 * (self.width - 1))
        window = np.clip(np.arange(time_s.size) - offset, 0, self.coefficients.shape[1] - 1)
        values, gain = self.at(time_s, window)
        return window, values[1], gain


def fit_all_windows(time_s: Floats, position_m: Floats, width: int, order: int, rho: float) -> WindowFits:
    """Fit a polynomial to every window of `width` consecutive points. Shapes: time_s, position_m (n,)."""
    m = time_s.size - width + 1
    last = np.arange(m) + width - 1
    middle, half = (time_s[:m] + time_s[last]) / 2, (time_s[last] - time_s[:m]) / 2
    weights, even_covariance = _scaled(_even_design(width, order), order, rho)
    covariance = np.repeat(even_covariance[0][:, :, None], m, axis=2)
    results = np.array([np.convolve(position_m, row[::-1], mode="valid") for row in weights[0]])
    # Odd windows contain a spacing different from the median, by more than 1 % (chosen).
    spacing = np.diff(time_s)
    uneven = np.concatenate([[0], np.cumsum(np.abs(spacing / np.median(spacing) - 1) > 0.01)])
    odd = uneven[width - 1 :] > uneven[: uneven.size - width + 1]
    if odd.any():
        take = np.flatnonzero(odd)[:, None] + np.arange(width)
        u = (time_s[take] - middle[odd, None]) / half[odd, None]
        uneven_weights, uneven_covariance = _scaled(_solve_design(u, order), order, rho)
        results[:, odd] = np.einsum("mkw,mw->km", uneven_weights, position_m[take])
        covariance[:, :, odd] = uneven_covariance.transpose(1, 2, 0)
    misfit = np.sum(results[order + 1 :] ** 2, axis=0)
    return WindowFits(width, results[: order + 1], middle, half, covariance, misfit)


def _scaled(weights: Floats, order: int, rho: float) -> tuple[Floats, Floats]:
    """Weights with the misfits scaled to unit variance, and the covariance of the coefficients, under AR(1) noise."""
    coefficients, extra = weights[:, : order + 1], weights[:, order + 1 :]
    covariance = correlated(coefficients, rho) @ coefficients.transpose(0, 2, 1)
    spread = np.sqrt(np.sum(correlated(extra, rho) * extra, axis=2, keepdims=True))
    return np.concatenate([coefficients, extra / np.maximum(spread, 1e-12)], axis=1), covariance


@lru_cache(maxsize=64)
def _even_design(width: int, order: int) -> Floats:
    """The design shared by all evenly spaced windows of a width."""
    return _solve_design(np.linspace(-1, 1, width)[None, :], order)


def _solve_design(u: Floats, order: int) -> Floats:
    """Weights of the coefficients and of the next orthonormal polynomials, (s, order + 1 + terms, w)."""
    # 4: orthogonal polynomials of the next higher orders that are tested in the residuals (chosen)
    terms = min(4, u.shape[1] - order - 1)
    q, _ = np.linalg.qr(np.polynomial.legendre.legvander(u, order + terms))
    q = q.transpose(0, 2, 1)
    inside = q[:, : order + 1]
    coefficients = np.linalg.solve(inside @ (u[:, :, None] ** np.arange(order + 1)), inside)
    return np.concatenate([coefficients, q[:, order + 1 :]], axis=1)


WINDOWS = (5, 7, 9, 13, 19, 27, 39, 57, 83, 119, 171, 247)  # Widths of windows, in points (chosen)


def estimate_kinematics(track: Track, *, travel_ratio: float, order: int = 3, kappa: float = 3.0) -> Kinematics:
    """Estimate the motion of the leading edge at the usable points of a track, two or more, whose times increase."""
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    noise_m, rho = position_noise(time_s, position_m)
    origin_m = float(position_m[0])
    values, sigma, widths = smooth(time_s, position_m - origin_m, noise_m, rho, order=order, kappa=kappa)
    return Kinematics(
        time_s=time_s,
        lead_position_m=values[0] + origin_m,
        lead_velocity_m_s=values[1],
        lead_velocity_sigma_m_s=sigma,
        lead_acceleration_m_s2=values[2],
        window_points=widths,
        noise_m=noise_m,
        noise_correlation=rho,
        travel_ratio=travel_ratio,
    )


def smooth(
    time_s: Floats, position_m: Floats, noise_m: float, rho: float, *, order: int = 3, kappa: float = 3.0
) -> tuple[Floats, Floats, Indices]:
    """Estimate position, velocity and acceleration at every point for known noise. A window is used only if the next
    wider one at the same position agrees too: the widest that agrees is about to disagree, and its bias may be several
    times its error. Each step in width changes their ratio by 1.45^5.5 = 8. Returns position, velocity and
    acceleration, (3, n), SI; standard error of the velocity, m/s, and points in the window used, (n,) each.
    """
    n = time_s.size
    least = min(n, max(WINDOWS[0], order + 2))
    widths = [least, *(width for width in WINDOWS if least < width <= n)]
    fits = [fit_all_windows(time_s, position_m, width, min(order, width - 1), rho) for width in widths]
    # Largest misfit of a window that fits its points, by the points that it has beyond its coefficients (derived)
    limits = (np.inf, 12.0, 15.3, 18.0, 20.5)
    fits_points = [fit.misfit <= noise_m**2 * limits[min(fit.width - len(fit.coefficients), 4)] for fit in fits]
    centred = [fit.velocities(time_s, 0.0) for fit in fits]
    # Range of velocities on which the centred windows agree, from the narrowest up, and the least error; unbounded
    # where not even the narrowest window fits its points: then one-sided windows decide.
    low, high, centred_error = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n)
    all_agree = np.ones(n, dtype=bool)
    for (window, velocity, gain), good in zip(centred, fits_points, strict=True):
        half_width = kappa * noise_m * gain
        lower, upper = np.maximum(low, velocity - half_width), np.minimum(high, velocity + half_width)
        all_agree &= good[window] & (lower <= upper)
        low, high = np.where(all_agree, lower, low), np.where(all_agree, upper, high)
        centred_error = np.where(all_agree, noise_m * gain, centred_error)
    # The narrowest window is used where no wider one is; its error is that of the noise, or of its misfit if larger.
    window_used, _, gain = centred[0]
    window_used, good = window_used.copy(), fits_points[0][window_used]
    # 2.5: factor on the misfit, taken as noise, for the error of the velocity where no window fits (derived)
    sigma = np.where(good, noise_m, np.maximum(noise_m, 2.5 * np.sqrt(fits[0].misfit[window_used]))) * gain
    best = np.where(good, sigma, np.inf)
    fit_used = np.zeros(n, dtype=int)
    for side in (0.0, -0.5, 0.5, -1.0, 1.0):  # positions of the point in its window (chosen)
        wider_agrees = np.full(n, len(fits) == 1)
        for k in reversed(range(len(fits))):
            window, velocity, gain = centred[k] if side == 0 else fits[k].velocities(time_s, side)
            error = noise_m * gain
            tolerance = kappa * error
            agrees = fits_points[k][window] & (velocity >= low - tolerance) & (velocity <= high + tolerance)
            better = agrees & wider_agrees & (error < (1 - 1e-6) * best)  # rounding must not decide between sides
            wider_agrees = agrees
            fit_used[better], window_used[better] = k, window[better]
            sigma[better] = best[better] = error[better]
    values = np.empty((3, n))
    for k, fit in enumerate(fits):
        points = np.flatnonzero(fit_used == k)
        values[:, points] = fit.at(time_s[points], window_used[points])[0]
    # 0.5: least standard error of a one-sided window, relative to that of the centred ones (chosen)
    return values, np.maximum(sigma, 0.5 * centred_error), np.array(widths)[fit_used]


# ------------------------------------------------------------------------------
# Means over replicates of each condition with standard errors: steady speed, final speed, efficiency.
#
# The standard error of a mean comes from the replicate scatter; for a single trial it is its own, NaN where unknown.
# Errors that all trials share (scale, yield pressure) are not included: they change all conditions together.

CONDITION_COLUMNS = (
    *("condition", "vine", "diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "payload_g", "growth_angle_deg"),
    *("n_trials", "n_steady", "x_ss_m_s", "x_ss_sigma_m_s", "x_ss_over_diameter_1_s", "x_ss_over_diameter_sigma_1_s"),
    *("n_final", "final_at_mm", "final_lead_velocity_m_s", "final_lead_velocity_sigma_m_s", "n_efficiency"),
    *("efficiency_at_mm", "efficiency", "efficiency_sigma", "efficiency_payload", "efficiency_payload_sigma"),
    *("efficiency_with_weight", "efficiency_with_weight_sigma", "weight_share"),
)


def condition_table(
    trials: pd.DataFrame, known: Sequence[Trial], *, final_at_fraction: float, efficiency_at_mm: float
) -> pd.DataFrame:
    """Return a row for each condition, columns `CONDITION_COLUMNS`, in the order of the sheet."""
    measured = trials[trials["status"].isin(["ok", "warning"])]
    first = {trial.condition: trial for trial in reversed(known)}
    tables = {name: group.set_index("trial") for name, group in measured.groupby("condition", sort=False)}
    rows = [
        _row(first[condition], tables[condition], final_at_fraction, efficiency_at_mm)
        for condition in dict.fromkeys(trial.condition for trial in known)
        if condition in tables
    ]
    return pd.DataFrame(rows, columns=list(CONDITION_COLUMNS))


def _row(trial: Trial, group: pd.DataFrame, final_at_fraction: float, efficiency_at_mm: float) -> dict[str, object]:
    speed, speed_sigma, n_steady = mean_with_error(*(group[f"x_ss_{of}m_s"].to_numpy(float) for of in ("", "sigma_")))
    if n_steady < LEAST_STEADY_SHARE * len(group):
        speed = speed_sigma = math.nan
    final, final_sigma, n_final = mean_with_error(group["final_lead_velocity_m_s"].to_numpy(float))
    mean, sigma, count = mean_with_error(group["efficiency"].to_numpy(float))
    payload, weight = efficiency_shares(trial, efficiency_at_mm / 1e3)
    shares = (("", 1.0), ("_payload", payload), ("_with_weight", 1 / (1 + weight)))
    return {
        "condition": trial.condition,
        "vine": trial.vine,
        "diameter_mm": 1e3 * trial.diameter_m,
        "thickness_um": 1e6 * trial.thickness_m,
        "length_mm": 1e3 * trial.length_m,
        "pressure_kPa": 1e-3 * trial.pressure_Pa,
        "payload_g": 1e3 * trial.payload_kg,
        "growth_angle_deg": math.degrees(trial.growth_angle_rad),
        "n_trials": len(group),
        "n_steady": n_steady,
        "x_ss_m_s": speed,
        "x_ss_sigma_m_s": speed_sigma,
        "x_ss_over_diameter_1_s": speed / trial.diameter_m,
        "x_ss_over_diameter_sigma_1_s": speed_sigma / trial.diameter_m,
        "n_final": n_final,
        "final_at_mm": 1e3 * final_at_fraction * trial.length_m,
        "final_lead_velocity_m_s": final,
        "final_lead_velocity_sigma_m_s": final_sigma,
        "n_efficiency": count,
        "efficiency_at_mm": efficiency_at_mm if count else math.nan,
        **{f"efficiency{name}": mean * factor for name, factor in shares},
        **{f"efficiency{name}_sigma": sigma * factor for name, factor in shares},
        "weight_share": weight if count else math.nan,
    }


def mean_with_error(values: Floats, sigmas: Floats | None = None) -> tuple[float, float, int]:
    """Return the mean of the known values, its standard error, and their number: NaN, NaN, 0 without known values, and
    an error of NaN for a single value without one. Shapes: values, sigmas (n,).
    """
    known = np.isfinite(values)
    count = int(known.sum())
    if count == 0:
        return math.nan, math.nan, 0
    mean = float(np.mean(values[known]))
    if count == 1:
        return mean, math.nan if sigmas is None else float(sigmas[known][0]), 1
    return mean, float(np.std(values[known], ddof=1)) / math.sqrt(count), count


def lead_velocity_at(lead_position_m: Floats, lead_velocity_m_s: Floats, target_m: float) -> float:
    """Lead velocity where the edge first passes a position, linear between points; NaN if it does not. Shapes (n,)."""
    beyond = np.flatnonzero(lead_position_m >= target_m)
    if beyond.size == 0 or beyond[0] == 0:
        return math.nan
    passing = slice(beyond[0] - 1, beyond[0] + 1)
    return float(np.interp(target_m, lead_position_m[passing], lead_velocity_m_s[passing]))


def energy_efficiency(trial: Trial, lead_travel_m: float, lead_velocity_m_s: float) -> float:
    """Kinetic energy over the work of the gas, ½ m(x) ẋ² / (P₀ A y), at one point of the growth, with the moving mass
    of tail and payload, ẋ = r·ẏ; NaN without work. Source: Alvarez et al. (2025), section IV-D, and their Eq. (1).
    """
    work_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    if not work_J > 0:
        return math.nan
    tail_velocity_m_s = trial.travel_ratio * lead_velocity_m_s
    return float(0.5 * trial.moving_mass_kg(lead_travel_m) * tail_velocity_m_s**2 / work_J)


def efficiency_shares(trial: Trial, lead_travel_m: float) -> tuple[float, float]:
    """Return the payload's fraction of the moving mass, and the work of the weight over that of the gas: efficiency ×
    the first is that of the payload alone, efficiency / (1 + the second) counts both works. The weight does work on
    tail and payload along the travel of the tail x = r·y: g cosθ ∫ m dx, the third term of Eq. (2) of Alvarez et al.
    (2025). NaN where there is no mass, or no work.
    """
    mass_kg = float(trial.moving_mass_kg(lead_travel_m))
    gas_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    # ∫ m(x) dx from the release, kg·m: the mass of film decreases linearly until none is left.
    film_kg = trial.linear_density_kg_m * (trial.length_m if math.isfinite(trial.length_m) else 0.0)
    loss_kg_m, tail_m = trial.mass_loss_kg_m, trial.travel_ratio * lead_travel_m
    until_m = min(tail_m, film_kg / loss_kg_m) if loss_kg_m > 0 else tail_m
    mass_kg_m = trial.payload_kg * tail_m + film_kg * until_m - 0.5 * loss_kg_m * until_m**2
    weight_J = GRAVITY_M_S2 * math.cos(trial.growth_angle_rad) * mass_kg_m
    return trial.payload_kg / mass_kg if mass_kg > 0 else math.nan, weight_J / gas_J if gas_J > 0 else math.nan


@dataclass(frozen=True)
class TrialResult(TrialMotion):
    """Results of one trial under a model: its `row` of `trials.csv`, and its `point` of the damping fit."""

    row: Mapping[str, object]
    point: Mapping[str, object]


@dataclass(frozen=True)
class Steadiness:
    """Windows by rule under one model, the one whose values are reported, NaN where there is none, and its force."""

    windows: Mapping[str, Window]
    window: Window
    force: SteadyForce | None


def look_at_motion(trial: Trial, track: Track, settings: RunSettings) -> TrialMotion:
    """Find velocity, release and the windows that do not depend on a model."""
    usable = int(track.usable.sum())
    if usable < FEWEST_POINTS:
        raise UserError(f"{usable} usable points; at least {FEWEST_POINTS} are needed.")
    kinematics = estimate_kinematics(
        track, travel_ratio=trial.travel_ratio, order=settings.velocity.order, kappa=settings.velocity.kappa
    )
    release = find_release(track, kinematics)
    track = flag_rest(track, release)
    limits, ratio = settings.steady, trial.travel_ratio
    windows = {
        "gated": gated_window(track, kinematics, limits, length_m=trial.length_m),
        "paper": paper_window(track, travel_ratio=ratio, cv_limit=limits.paper_cv, min_points=limits.paper_points),
    }
    if trial.steady_window_s is not None:
        windows["user"] = user_window(track, kinematics, trial.steady_window_s, limits, trial.length_m)
    return TrialMotion(trial, track, kinematics, release, windows)


def steadiness_under(motion: TrialMotion, model: Model) -> Steadiness:
    """Find the steady window of a trial and the force in it, with the pressure of a model."""
    windows = dict(motion.windows)
    chosen = _chosen(windows)
    if chosen is None and "user" not in windows and why_not_in_fit(motion.trial) == "":
        pressure_Pa = known_pressure(motion, model)
        if pressure_Pa is not None:
            windows["quasi_steady"] = quasi_steady_window(motion, pressure_Pa)
            chosen = _chosen(windows)
    force = steady_force(motion, chosen, model) if chosen else None
    return Steadiness(windows, chosen or Window("", False, ""), force)


def summarise_trial(trial: Trial, track: Track, settings: RunSettings, model: Model) -> TrialResult:
    """Compute velocity, steady windows by every rule, force, final speed and efficiency of one trial."""
    motion = look_at_motion(trial, track, settings)
    steady = steadiness_under(motion, model)
    track, kinematics, windows, window = motion.track, motion.kinematics, steady.windows, steady.window
    moved_m = track.lead_position_m[track.usable]
    # Speed at the set fraction of the length, and efficiency at the set growth; NaN where growth did not get there
    travel_m, at_m = kinematics.lead_position_m - motion.release.lead_position_m, settings.efficiency_at_mm / 1e3
    final = float(kinematics.lead_velocity_m_s[-1])
    if math.isfinite(trial.length_m):
        final_m = settings.final_at_fraction * trial.length_m
        final = lead_velocity_at(travel_m, kinematics.lead_velocity_m_s, final_m)
    warnings = list(track.notes)
    release, notes = motion.release, list[str]()
    if release.time_s < track.time_s[0]:  # before the first point, as where a tip comes out of a launcher's mouth
        notes.append(release.reason)
    elif release.moving_from_start or not math.isfinite(release.time_s):
        warnings.append(release.reason)
    if "user" in windows and (windows["user"].doubtful or not windows["user"].accepted):
        warnings.append(windows["user"].reason)
    notes = [*warnings, *notes, *([] if steady.force else [f"no steady window: {windows['gated'].reason}"])]
    row = {
        "trial": trial.name,
        "vine": trial.vine,
        "condition": trial.condition,
        "status": "warning" if warnings else "ok",
        "reason": "; ".join(notes),
        "n_frames": track.time_s.size,
        "mm_per_px": trial.m_per_px * 1e3,
        "scale_rel_sigma": math.nan,
        "noise_m": kinematics.noise_m,
        "steady_from_s": window.from_s,
        "steady_to_s": window.to_s,
        "steady_rule": window.rule,
        "x_ss_m_s": window.x_ss_m_s,
        "x_ss_sigma_m_s": window.x_ss_sigma_m_s,
        "x_ss_paper_m_s": windows["paper"].x_ss_m_s,
        "cv": window.cv,
        "force_N": steady.force.force_N if steady.force else math.nan,
        "final_lead_velocity_m_s": final,
        "efficiency": energy_efficiency(trial, at_m, lead_velocity_at(travel_m, kinematics.lead_velocity_m_s, at_m)),
        "tube_width_mm": math.nan,
        "growth_mm": 1e3 * float(moved_m.max() - motion.release.lead_position_m) if moved_m.size else math.nan,
    }
    return TrialResult(**vars(motion) | {"windows": windows, "row": row, "point": damping_point(trial, steady)})


def _chosen(windows: Mapping[str, Window]) -> Window | None:
    """The window whose values are reported: the user's, else the gated, else the quasi-steady one if accepted."""
    for rule in ("user", "gated", "quasi_steady"):
        window = windows.get(rule)
        if window is not None and (window.accepted or rule == "user"):
            return window if window.accepted and window.x_ss_m_s > 0 else None
    return None


def damping_point(trial: Trial, steady: Steadiness) -> dict[str, object]:
    """Return the row of a trial in the damping fit, with `used` and the `reason` if not."""
    window, force = steady.window, steady.force
    reason, nan = why_not_in_fit(trial), math.nan
    if force is None:
        reason = reason or "no steady window"
    elif not reason and not force.force_N > 0:
        reason = f"the force in the window is {force.force_N:.3g} N: the pressure does not exceed the yield pressure"
    return {
        "trial": trial.name,
        "vine": trial.vine,
        "condition": trial.condition,
        "diameter_mm": trial.diameter_m * 1e3,
        "thickness_um": trial.thickness_m * 1e6,
        "pressure_kPa": trial.pressure_Pa / 1e3,
        "window_pressure_kPa": force.window_pressure_Pa / 1e3 if force else nan,
        "x_ss_m_s": window.x_ss_m_s,
        "x_ss_sigma_m_s": window.x_ss_sigma_m_s,
        "force_N": force.force_N if force else nan,
        "force_sigma_N": force.sigma_N if force else nan,
        "yield_force_sigma_N": force.yield_sigma_N if force else nan,
        "pressure_source": force.pressure_source if force else "",
        "x_ss_paper_m_s": steady.windows["paper"].x_ss_m_s,
        "force_paper_N": paper_force_N(trial),
        "eligible": not why_not_in_fit(trial),
        "used": not reason,
        "reason": reason,
    }


def look_at_motions(pairs: Iterable[tuple[Trial, Track]], settings: RunSettings) -> list[TrialMotion]:
    """Find velocity, release and windows of every track; trials with too few points are skipped."""
    motions = []
    for trial, track in pairs:
        with suppress(UserError):
            motions.append(look_at_motion(trial, track, settings))
    return motions


def redo_damping(model: Model, motions: Sequence[TrialMotion], settings: RunSettings) -> Mapping[str, Any]:
    """The damping law, as in `damping.json`, with the pressure of a model, of all trials it can be computed for."""
    rows = []
    for motion in motions:
        with suppress(EffectError):
            rows.append(damping_point(motion.trial, steadiness_under(motion, model)))
    if not rows:
        raise ValueError("no trial can be analysed under this model")
    points = mark_half_steady(pd.DataFrame(rows))
    return fit_laws(points, resamples=settings.damping.resamples, seed=settings.damping.seed)


def law_table(laws: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return laws under several models as one table: a row for each model, method and vine; SI."""
    rows = [
        (name, method, vine, law["n"], *law["n_95_total"], vine_law["B"], *vine_law["B_95_total"], vine_law["n_trials"])
        for name, methods in laws.items()
        for method, law in methods.items()
        for vine, vine_law in law["vines"].items()
    ]
    columns = ("model", "method", "vine", "n", "n_low_95", "n_high_95", "B", "B_low_95", "B_high_95", "n_trials")
    return pd.DataFrame(rows, columns=list(columns))
