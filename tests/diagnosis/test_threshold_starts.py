"""A pressure to start above the yield pressure is found though its answer jumps: starts lie close enough to it."""

from __future__ import annotations

import itertools

import numpy as np

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis.candidates import whole_shapes
from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import find_effect

P_S_TRUE, P_Y, B_TRUE, N_TRUE, NOISE_M = 11e3, 6e3, 6.0, 0.4, 1e-4
TIMES_S = np.linspace(-0.05, 0.9, 191)


def trial(k: int, pressure_Pa: float) -> Trial:
    return Trial(
        name=f"stop{k}", capture_fps=200.0, diameter_m=0.024, thickness_m=2e-4, length_m=0.9, pressure_Pa=pressure_Pa,
        pressure_sigma_Pa=1e-2 * pressure_Pa, yield_pressure_Pa=P_Y, yield_pressure_sigma_Pa=200.0,
        growth_angle_rad=np.pi / 2,
    )  # fmt: skip


def interrupted(k: int, pressure_Pa: float) -> tuple[Trial, Track]:
    """Released at full pressure, which is let down after some growth and comes back slowly."""
    one = trial(k, pressure_Pa)
    stop_s = 0.12 + 0.02 * k
    pressure = np.interp(
        TIMES_S, [stop_s, stop_s + 0.02, stop_s + 0.1, stop_s + 0.5], [pressure_Pa, 2e3, 2e3, pressure_Pa]
    )
    truth = (vt.base_model() + vt.effects.static_yield).with_values(
        {"eversion_damping.B": B_TRUE, "eversion_damping.n": N_TRUE, "static_yield.P_s": P_S_TRUE}
    )
    y = simulate(truth, one, TIMES_S, trace=(TIMES_S, pressure)).lead_position_m
    noise = NOISE_M * np.random.default_rng(70 + k).standard_normal(TIMES_S.size)
    blank = np.full(TIMES_S.size, np.nan)
    flags = np.full(TIMES_S.size, "", dtype="<U32")
    return one, Track(
        time_s=TIMES_S, lead_position_m=y + noise, lead_position_sigma_m=blank, flag=flags, edge_px=blank,
        pressure_Pa=pressure,
    )  # fmt: skip


def test_a_threshold_is_begun_within_a_factor_of_two_of_any_plausible_size():
    sizes = [shape.step for shape in whole_shapes(find_effect("static_yield", {}))]
    assert sizes[0] <= 1e3
    assert all(after <= 2 * before for before, after in itertools.pairwise(sizes))


def test_a_static_yield_far_above_the_yield_pressure_is_found():
    pairs = [interrupted(k, pressure_Pa) for k, pressure_Pa in enumerate((14e3, 14e3, 18e3, 18e3, 22e3, 22e3))]
    asked = ("static_yield", "tail_friction", "air_drag")
    said = vt.diagnose(pairs, candidates=asked, ladder=False, advice=False)
    assert said.verdict == "missing"
    assert said.effects == ("static_yield",)
    assert abs(said.fits[-1]["P_s"].value - P_S_TRUE) < 100.0
