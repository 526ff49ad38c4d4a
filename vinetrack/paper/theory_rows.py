"""Rows of the table that follow from Eq. (2) with the paper's own numbers, by simulation and without an experiment.

They cover the fast vine, air drag, and the published rule applied to simulated motions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.constants import AIR_DENSITY_KG_M3
from vinetrack.core.records import Trial, plain_track
from vinetrack.dynamics.simulate import Trajectory, simulate, simulate_many
from vinetrack.kinematics.conditions import lead_velocity_at
from vinetrack.kinematics.damping import fit_laws
from vinetrack.kinematics.force import paper_force_N
from vinetrack.kinematics.steady import paper_window
from vinetrack.paper.departures import DEPARTURES, NONE, Departure, paper_trial
from vinetrack.paper.rows import COMPUTED, NOT_CHECKABLE, PaperRow
from vinetrack.planning.scaling_priors import damping_prior

FAST_AT = (0.90, 0.95, 0.98, 0.99)  # Fractions of the length at which the speed of the fast vine is evaluated (chosen)

DRAG_AT = (0.50, 0.95, 0.99)  # Fractions of the length at which drag is evaluated (chosen)


def theory_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """Compute the rows on the fast vine, on air drag, and on the published rule for noise-free motions."""
    yield from _fast_rows()
    yield from _drag_rows()
    yield from _rule_rows(trials)


def _fast_rows() -> Iterator[PaperRow]:
    fast = published.FAST_VINE
    B = damping_prior(fast["diameter_mm"] / 1e3, fast["thickness_um"] / 1e6)
    size = f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm × {fast['length_mm']:g} mm"
    for fraction, speed in zip(FAST_AT, fast_vine_speeds(FAST_AT), strict=True):
        yield PaperRow(
            row=f"fast_vine_predicted_{100 * fraction:.0f}",
            where="Section IV-E",
            quantity="speed of the leading edge by Eq. (2)",
            setting=f"{size}, {fast['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="m/s",
            published=published.FAST_VINE_PREDICTED_M_S,
            ours=speed,
            mark=NOT_CHECKABLE,
            how=f"its B is not printed; with a guess, B = {B:.2f}; fold and gas are the least that moves",
            beside="in Eq. (2) the speed of a bare vine has no limit at its end: the place where it is taken decides",
        )


def _drag_rows() -> Iterator[PaperRow]:
    case = published.DRAG_EXAMPLE
    size = f"{case['diameter_mm']:g} mm × {case['thickness_um']:g} µm × {case['length_mm']:g} mm"
    for fraction, share, printed in drag_shares(DRAG_AT):
        yield PaperRow(
            row=f"drag_share_{100 * fraction:.0f}",
            where="Section II",
            quantity="air drag over drive, C_D = 0.82",
            setting=f"{size}, {case['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="%",
            published=100 * published.DRAG_SHARE,
            as_printed=f"{100 * published.DRAG_SHARE:g}, not before {case['pressure_kPa']:g} kPa",
            ours=100 * share,
            mark=NOT_CHECKABLE,
            how="¼ρ A C_D ẏ² over ½PA: the air meets the head at ẏ, and the pulley halves it; its B is a guess",
            beside=f"{100 * printed:.0f} % by the printed ½ρ A C_D ẋ²: the place along the growth decides",
        )


def _rule_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """Bias of the published rule in noise-free motions, with a full and with a depleting chamber."""
    chosen: dict[str, Trial] = {}
    for trial in trials:
        scale = published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m)
        if scale is not None and trial.payload_kg == 0 and trial.travel_ratio == 2:
            chosen.setdefault(trial.condition, trial)
    if len(chosen) < len(published.DAMPING_B):
        return
    cases = (
        ("rule_bias_n", None, "chamber kept full", "the weight of the film, which Eq. (3) leaves out, lifts n"),
        ("rule_n_depletion_slow", 1.0, "chamber not refilled, isothermal", "set pressure in place of what is left"),
        ("rule_n_depletion_fast", 1.4, "chamber not refilled, adiabatic", "set pressure in place of what is left"),
    )
    for row, gamma, setting, how in cases:
        n, B = rule_on_noise_free(gamma, list(chosen.values()))
        of_scales = ", ".join(f"{B[scale]:.2f}" for scale in sorted(B))
        yield PaperRow(
            row=row,
            where="Fig. 6",
            quantity="n that the published rule finds in noise-free motions with the printed n",
            setting=setting,
            published=published.EXPONENT,
            ours=n,
            mark=COMPUTED,
            how=f"{len(chosen)} pressures and vines, Eq. (2) with the printed B, no noise or scatter; {how}",
            beside=f"and B = {of_scales} for R = {', '.join(str(scale) for scale in sorted(B))}",
        )


def departures_in_words(table: pd.DataFrame, figure: str, pressure_kPa: float) -> str:
    """Describe the effect of departures from Eq. (2) in a sentence: positions in cm, speeds in m/s."""
    lines = table[(table["figure"] == figure) & (abs(table["pressure_kPa"] - pressure_kPa) < 1e-6)]
    column, factor, unit = (
        ("rms_position_m", 100.0, "cm") if figure == "Fig. 4" else ("rms_final_lead_velocity_m_s", 1.0, "m/s")
    )
    size = {row.departure: factor * float(getattr(row, column)) for row in lines.itertuples()}
    if not size:
        return ""
    slow, fast, slack, both_slow, both_fast = (size[departure.name] for departure in DEPARTURES)
    return (
        f"not in it: a chamber that nothing refills would cause {slow:.2f} to {fast:.2f} {unit}, a tail that "
        f"cannot push {slack:.2f}, both {both_slow:.2f} to {both_fast:.2f}"
    )


SLOWEST_S = 10.0  # Duration of the simulated motions, s (chosen)


def fast_vine_speeds(fractions: Sequence[float]) -> list[float]:
    """Compute the speed of the fast vine's leading edge by Eq. (2) with B from the scaling prior."""
    fast = published.FAST_VINE
    trial = paper_trial(fast["diameter_mm"], fast["thickness_um"], fast["length_mm"], fast["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    motion = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    return [lead_velocity_at(motion.lead_position_m, motion.lead_velocity_m_s, f * trial.length_m) for f in fractions]


def drag_shares(fractions: Sequence[float]) -> Iterator[tuple[float, float, float]]:
    """Compute the ratio of drag to drive in the paper's example of air drag, by mechanics and as printed. By mechanics
    the air meets the head at ẏ and the pulley halves the force: ¼ρ A C_D ẏ² over ½PA; printed is ½ρ A C_D ẋ². Speeds
    are those of Eq. (2) without drag, with B from the scaling prior.
    """
    case = published.DRAG_EXAMPLE
    trial = paper_trial(case["diameter_mm"], case["thickness_um"], case["length_mm"], case["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    motion = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    for fraction in fractions:
        lead = lead_velocity_at(motion.lead_position_m, motion.lead_velocity_m_s, fraction * trial.length_m)
        share = 0.5 * AIR_DENSITY_KG_M3 * published.DRAG_COEFFICIENT * lead**2 / trial.pressure_Pa
        yield fraction, share, 8 * share


def rule_on_noise_free(gamma: float | None, trials: Sequence[Trial]) -> tuple[float, dict[int, float]]:
    """Apply the published rule to noise-free motions of these trials, simulated with the printed B and n.
    Returns n, B.
    """
    departure = Departure("", "", gamma=gamma)
    time_s = np.arange(0, SLOWEST_S, 1 / published.CAPTURE_FPS)
    rows = []
    for scale, B in published.DAMPING_B.items():
        of_scale = [
            replace(trial, chamber_m3=published.CHAMBER_L / 1e3, yield_pressure_Pa=1e3 * published.YIELD_PRESSURE_KPA)
            for trial in trials
            if published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m) == scale
        ]
        runs = simulate_many(departure.model(B), of_scale, [time_s] * len(of_scale))
        rows += [_point(scale, trial, moved) for trial, moved in zip(of_scale, runs, strict=True)]
    law = fit_laws(pd.DataFrame(rows), resamples=100)["paper"]
    return float(law["n"]), {int(vine): float(vine_law["B"]) for vine, vine_law in law["vines"].items()}


def _point(scale: int, trial: Trial, moved: Trajectory) -> dict[str, object]:
    """A row of the damping fit that only the published rule uses."""
    unknown = dict.fromkeys(("x_ss_m_s", "x_ss_sigma_m_s", "force_N", "force_sigma_N"), math.nan)
    return {
        "trial": trial.name,
        "vine": str(scale),
        "diameter_mm": 1e3 * trial.diameter_m,
        "thickness_um": 1e6 * trial.thickness_m,
        **unknown,
        "yield_force_sigma_N": 0.0,
        "x_ss_paper_m_s": _published_window(moved, trial.travel_ratio),
        "force_paper_N": paper_force_N(trial),
        "eligible": True,
        "used": False,
    }


def _published_window(moved: Trajectory, travel_ratio: float) -> float:
    """Steady tail speed by the published rule in a motion without noise, m/s."""
    stop = int(np.searchsorted(moved.time_s, moved.end_time_s)) if math.isfinite(moved.end_time_s) else None
    time_s, position_m = moved.time_s[:stop], moved.lead_position_m[:stop]
    track = plain_track(time_s, position_m)
    window = paper_window(
        track, travel_ratio=travel_ratio, cv_limit=published.STEADY_CV, min_points=published.STEADY_FEWEST_POINTS
    )
    return window.x_ss_m_s if window.accepted else math.nan
