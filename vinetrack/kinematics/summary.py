"""Analysis of one trial from its track to a row of results, and the damping law under a fitted model.

As a chamber empties, the speed falls: with the set pressure no window is then steady, or the force in it is too large
and n and B are biased. Under a model with the effect on the pressure, the same tracks give the law again. Windows that
do not depend on the model are found once for all models.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.records import Kinematics, Track, Trial, Window
from vinetrack.dynamics.model import Model
from vinetrack.effects import EffectError
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.conditions import energy_efficiency, lead_velocity_at
from vinetrack.kinematics.damping import fit_laws, mark_left_out
from vinetrack.kinematics.force import (
    SteadyForce,
    known_pressure,
    paper_force_N,
    steady_force,
    why_not_force,
    why_not_in_fit,
)
from vinetrack.kinematics.quasi_steady import quasi_steady_window
from vinetrack.kinematics.release import Release, find_release, flag_rest
from vinetrack.kinematics.steady import gated_window, paper_window, user_window
from vinetrack.kinematics.velocity import estimate_kinematics
from vinetrack.tracks.frame_timing import correct_frames

if TYPE_CHECKING:
    import pandas as pd

FEWEST_POINTS = 5  # Fewest usable points of a track (derived)


class TrialError(ValueError):
    """A trial that cannot be analysed; the message is a sentence for its `reason`."""


@dataclass(frozen=True)
class TrialResult:
    """Results of one trial: its corrected track, motion, windows by rule, and its rows of results. `row` has the
    columns of `trials.csv`, `point` those of the damping fit, with `used` and the `reason` if not.
    """

    track: Track
    kinematics: Kinematics
    release: Release
    windows: Mapping[str, Window]
    row: Mapping[str, object]
    point: Mapping[str, object]


@dataclass(frozen=True)
class TrialMotion:
    """Model-independent results of a trial: its corrected track, motion, release, and windows by rule."""

    trial: Trial
    track: Track
    kinematics: Kinematics
    release: Release
    windows: Mapping[str, Window]


@dataclass(frozen=True)
class Steadiness:
    """Windows by rule under one model, the chosen one, whose values are reported, and the force in it."""

    windows: Mapping[str, Window]
    chosen: Window | None
    force: SteadyForce | None


def look_at_motion(trial: Trial, track: Track, settings: RunSettings) -> TrialMotion:
    """Find velocity, release and the windows that do not depend on a model."""
    usable = int(track.usable.sum())
    if usable < FEWEST_POINTS:
        raise TrialError(f"{usable} usable points; at least {FEWEST_POINTS} are needed.")
    track = correct_frames(track)
    kinematics = estimate_kinematics(
        track, travel_ratio=trial.travel_ratio, order=settings.velocity.order, kappa=settings.velocity.kappa
    )
    release = find_release(track, kinematics)
    track = flag_rest(track, release)
    return TrialMotion(trial, track, kinematics, release, _windows(trial, track, kinematics, settings))


def steadiness_under(motion: TrialMotion, model: Model) -> Steadiness:
    """Find the steady window of a trial and the force in it, with the pressure of a model."""
    trial, track, kinematics, release = motion.trial, motion.track, motion.kinematics, motion.release
    windows = dict(motion.windows)
    chosen = _chosen(windows)
    if chosen is None and "user" not in windows and why_not_in_fit(trial) == "":
        pressure_Pa = known_pressure(trial, track, kinematics, release, model)
        if pressure_Pa is not None:
            windows["quasi_steady"] = quasi_steady_window(trial, track, kinematics, release, pressure_Pa)
            chosen = _chosen(windows)
    force = steady_force(trial, track, kinematics, release, chosen, model) if chosen else None
    return Steadiness(windows, chosen, force)


def summarise_trial(trial: Trial, track: Track, settings: RunSettings, model: Model) -> TrialResult:
    """Compute velocity, steady windows by every rule, force, final speed and efficiency of one trial."""
    motion = look_at_motion(trial, track, settings)
    try:
        steady = steadiness_under(motion, model)
    except EffectError as error:
        raise TrialError(str(error)) from error
    track, kinematics, windows = motion.track, motion.kinematics, steady.windows
    warnings = _warnings(track, motion.release, windows)
    notes = [*warnings, *([] if steady.chosen else [f"no steady window: {windows['gated'].reason}"])]
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
        **_steady_columns(steady.chosen, windows["paper"], steady.force),
        **_end_columns(trial, kinematics, motion.release, settings),
        "tube_width_mm": math.nan,
        "growth_mm": 1e3 * _growth_m(motion),
    }
    return TrialResult(track, kinematics, motion.release, windows, row, damping_point(trial, steady))


def _growth_m(motion: TrialMotion) -> float:
    """Growth from release to the furthest usable position, m."""
    position_m = motion.track.lead_position_m[motion.track.usable]
    return float(position_m.max() - motion.release.lead_position_m) if position_m.size else math.nan


def _windows(trial: Trial, track: Track, kinematics: Kinematics, settings: RunSettings) -> dict[str, Window]:
    steady = settings.steady
    windows = {
        "gated": gated_window(
            track,
            kinematics,
            length_m=trial.length_m,
            drift_limit=steady.drift_limit,
            start_fraction=steady.start_fraction,
            start_sigmas=steady.start_sigmas,
        ),
        "paper": paper_window(
            track, travel_ratio=trial.travel_ratio, cv_limit=steady.paper_cv, min_points=steady.paper_points
        ),
    }
    if trial.steady_window_s is not None:
        try:
            windows["user"] = user_window(track, kinematics, trial.steady_window_s, trial.length_m)
        except ValueError as error:
            windows["user"] = Window("user", False, str(error))
    return windows


def _chosen(windows: Mapping[str, Window]) -> Window | None:
    """The window whose values are reported: the user's, else the gated, else the quasi-steady one if accepted."""
    for rule in ("user", "gated", "quasi_steady"):
        window = windows.get(rule)
        if window is not None and (window.accepted or rule == "user"):
            return window if window.accepted and window.x_ss_m_s > 0 else None
    return None


def _warnings(track: Track, release: Release, windows: Mapping[str, Window]) -> list[str]:
    warnings = list(track.notes)
    if release.moving_from_start or not math.isfinite(release.time_s):
        warnings.append(release.reason)
    if "user" in windows and ("warning" in windows["user"].reason or not windows["user"].accepted):
        warnings.append(windows["user"].reason)
    return warnings


def _steady_columns(window: Window | None, paper: Window, force: SteadyForce | None) -> dict[str, object]:
    return {
        "steady_from_s": window.from_s if window else math.nan,
        "steady_to_s": window.to_s if window else math.nan,
        "steady_rule": window.rule if window else "",
        "x_ss_m_s": window.x_ss_m_s if window else math.nan,
        "x_ss_sigma_m_s": window.x_ss_sigma_m_s if window else math.nan,
        "x_ss_paper_m_s": paper.x_ss_m_s if paper.accepted else math.nan,
        "cv": window.cv if window else math.nan,
        "force_N": force.force_N if force else math.nan,
    }


def _end_columns(trial: Trial, kinematics: Kinematics, release: Release, settings: RunSettings) -> dict[str, object]:
    """Speed at the set fraction of the length, and efficiency at the set growth; NaN where growth did not get there."""
    travel_m = kinematics.lead_position_m - release.lead_position_m
    velocity_m_s = kinematics.lead_velocity_m_s
    if math.isfinite(trial.length_m):
        final = lead_velocity_at(travel_m, velocity_m_s, settings.final_at_fraction * trial.length_m)
    else:
        final = float(velocity_m_s[-1])
    at_m = settings.efficiency_at_mm / 1e3
    efficiency = energy_efficiency(trial, at_m, lead_velocity_at(travel_m, velocity_m_s, at_m))
    return {"final_lead_velocity_m_s": final, "efficiency": efficiency}


def damping_point(trial: Trial, steady: Steadiness) -> dict[str, object]:
    """Return the row of a trial in the damping fit, with `used` and the `reason` if not."""
    window, paper, force = steady.chosen, steady.windows["paper"], steady.force
    reason = why_not_in_fit(trial) or why_not_force(force)
    nan = math.nan
    return {
        "trial": trial.name,
        "vine": trial.vine,
        "condition": trial.condition,
        "diameter_mm": trial.diameter_m * 1e3,
        "thickness_um": trial.thickness_m * 1e6,
        "pressure_kPa": trial.pressure_Pa / 1e3,
        "window_pressure_kPa": force.window_pressure_Pa / 1e3 if force else nan,
        "x_ss_m_s": window.x_ss_m_s if window else nan,
        "x_ss_sigma_m_s": window.x_ss_sigma_m_s if window else nan,
        "force_N": force.force_N if force else nan,
        "force_sigma_N": force.sigma_N if force else nan,
        "yield_force_sigma_N": force.yield_sigma_N if force else nan,
        "pressure_source": force.pressure_source if force else "",
        "x_ss_paper_m_s": paper.x_ss_m_s if paper.accepted else nan,
        "force_paper_N": paper_force_N(trial),
        "eligible": not why_not_in_fit(trial),
        "used": not reason,
        "reason": reason,
    }


LAW_COLUMNS = ("model", "method", "vine", "n", "n_low_95", "n_high_95", "B", "B_low_95", "B_high_95", "n_trials")


@dataclass(frozen=True)
class DampingLaw:
    """The damping law under one model: `points` as in `damping_points.csv`, `laws` as in `damping.json`. `left_out`
    maps trials that cannot be analysed under the model to the reason.
    """

    points: pd.DataFrame
    laws: Mapping[str, Any]
    left_out: Mapping[str, str]


def look_at_motions(pairs: Iterable[tuple[Trial, Track]], settings: RunSettings | None = None) -> list[TrialMotion]:
    """Find velocity, release and windows of every track; trials with too few points are skipped."""
    settings, motions = settings or RunSettings(), []
    for trial, track in pairs:
        try:
            motions.append(look_at_motion(trial, track, settings))
        except TrialError:
            continue
    return motions


def redo_damping(model: Model, motions: Sequence[TrialMotion], settings: RunSettings | None = None) -> DampingLaw:
    """Find steady windows and the damping law with the pressure of a model."""
    import pandas as pd

    settings = settings or RunSettings()
    rows, left_out = [], {}
    for motion in motions:
        try:
            rows.append(damping_point(motion.trial, steadiness_under(motion, model)))
        except EffectError as error:
            left_out[motion.trial.name] = str(error)
    if not rows:
        raise ValueError(
            f"no trial can be analysed under this model: {'; '.join(left_out.values()) or 'there is none'}"
        )
    points = mark_left_out(pd.DataFrame(rows))
    laws = fit_laws(points, resamples=settings.damping.resamples, seed=settings.damping.seed)
    return DampingLaw(points, laws, left_out)


def law_table(laws: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return laws under several models as one table: a row for each model, method and vine, columns
    `LAW_COLUMNS`; SI.
    """
    import pandas as pd

    rows = [
        (name, method, vine, law["n"], *law["n_95"], vine_law["B"], *vine_law["B_95"], vine_law["n_trials"])
        for name, methods in laws.items()
        for method, law in methods.items()
        for vine, vine_law in law["vines"].items()
    ]
    return pd.DataFrame(rows, columns=list(LAW_COLUMNS))
