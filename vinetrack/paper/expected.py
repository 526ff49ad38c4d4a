"""What Eq. (2) says of the fast vine and of air drag, and what the published rule would find in its motions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.constants import AIR_DENSITY_KG_M3
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.dynamics.simulate import Trajectory, simulate, simulate_many
from vinetrack.kinematics.conditions import lead_velocity_at
from vinetrack.kinematics.damping import fit_laws
from vinetrack.kinematics.force import paper_force_N
from vinetrack.kinematics.steady import paper_window
from vinetrack.paper.departures import NONE, Departure, paper_trial
from vinetrack.planning.scaling_priors import damping_prior

SLOWEST_S = 10.0
"""For as long the steady motions are followed; the slowest takes 2.3 s."""


def fast_vine_speeds(fractions: Sequence[float]) -> list[float]:
    """Speed of the fast vine's leading edge at fractions of its length by Eq. (2) with a guessed B, m/s."""
    fast = published.FAST_VINE
    trial = paper_trial(fast["diameter_mm"], fast["thickness_um"], fast["length_mm"], fast["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    found = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    return [lead_velocity_at(found.lead_position_m, found.lead_velocity_m_s, f * trial.length_m) for f in fractions]


def drag_shares(fractions: Sequence[float]) -> Iterator[tuple[float, float, float]]:
    """The paper's example of air drag: fraction of the length, drag over drive by mechanics, and as it is printed.

    By mechanics the air meets the head at ẏ and the pulley halves it: ¼ρ A C_D ẏ² over ½PA; printed is ½ρ A C_D ẋ².
    Speeds by Eq. (2) with a guessed B, without drag.
    """
    case = published.DRAG_EXAMPLE
    trial = paper_trial(case["diameter_mm"], case["thickness_um"], case["length_mm"], case["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    found = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    for fraction in fractions:
        lead = lead_velocity_at(found.lead_position_m, found.lead_velocity_m_s, fraction * trial.length_m)
        share = 0.5 * AIR_DENSITY_KG_M3 * published.DRAG_COEFFICIENT * lead**2 / trial.pressure_Pa
        yield fraction, share, 8 * share


def rule_on_noise_free(gamma: float | None, trials: Sequence[Trial]) -> tuple[float, dict[int, float]]:
    """What the published rule finds in noise-free motions of these trials, made with the printed B and n.

    Parameters
    ----------
    gamma
        Of a chamber that nothing refills; None for one that is kept full.
    trials
        One a vine and pressure, without payload; those of other sizes than the printed scales are passed over.

    Returns
    -------
    n : float
    B : dict, by scale, N·(s/m)ⁿ
    """
    departure = Departure("", "", gamma=gamma)
    time_s = np.arange(0, SLOWEST_S, 1 / published.CAPTURE_FPS)
    rows = []
    for scale, B in published.DAMPING_B.items():
        own = [
            replace(trial, chamber_m3=published.CHAMBER_L / 1e3, yield_pressure_Pa=1e3 * published.YIELD_PRESSURE_KPA)
            for trial in trials
            if published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m) == scale
        ]
        runs = simulate_many(departure.model(B), own, [time_s] * len(own))
        rows += [_point(scale, trial, moved) for trial, moved in zip(own, runs, strict=True)]
    law = fit_laws(pd.DataFrame(rows), resamples=100)["paper"]
    return float(law["n"]), {int(vine): float(one["B"]) for vine, one in law["vines"].items()}


def _point(scale: int, trial: Trial, moved: Trajectory) -> dict[str, object]:
    """A row of the damping fit that only the published rule has a say in."""
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
    nothing: Floats = np.full(time_s.size, math.nan)
    track = Track(time_s, position_m, nothing, np.full(time_s.size, ""), nothing)
    window = paper_window(
        track, travel_ratio=travel_ratio, cv_limit=published.STEADY_CV, min_points=published.STEADY_FEWEST_POINTS
    )
    return window.x_ss_m_s if window.accepted else math.nan
