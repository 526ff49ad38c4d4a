"""Bodies that move as a whole: what is missing from gravity is named, and nothing that only a tube can have."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lsoda_vine import as_track

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.core.units import AIR_DENSITY_KG_M3, GRAVITY_M_S2
from vinetrack.diagnosis.force_inversion import ForceEstimate
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.missing_force import RankedLaw

REAL = os.environ.get("VINETRACK_REAL_DATA", "")
DRAG = 0.5
NOISE_M = 2e-3
TUBES_ALONE = {"capstan_friction", "gas_inertia", "tail_friction", "latch_release", "fold_inertia", "wall_stretch"}


def dropped(name: str, seed: int, diameter_m: float, mass_kg: float) -> tuple[Trial, Track]:
    """A ball that falls in air, y = (v²/g) ln cosh(g t/v) with the terminal speed v = √(2 m g / (ρ A C_D)), filmed."""
    trial = Trial(
        name=name,
        condition=f"{1e3 * mass_kg:g} g",
        diameter_m=diameter_m,
        pressure_Pa=0.0,
        yield_pressure_Pa=0.0,
        payload_kg=mass_kg,
        travel_ratio=1.0,
    )
    terminal_m_s = math.sqrt(2 * mass_kg * GRAVITY_M_S2 / (AIR_DENSITY_KG_M3 * trial.area_m2 * DRAG))
    time_s = np.arange(100) / 120
    fallen_s = np.maximum(time_s - 0.0513, 0.0)
    fallen_m = terminal_m_s**2 / GRAVITY_M_S2 * np.log(np.cosh(GRAVITY_M_S2 * fallen_s / terminal_m_s))
    noise_m = np.random.default_rng(seed).normal(0, NOISE_M, time_s.size)
    return trial, as_track(time_s, fallen_m + 0.004 + noise_m)


@pytest.fixture(scope="module")
def balls() -> list[tuple[Trial, Track]]:
    kinds = ((0.04, 2.7e-3), (0.1, 20e-3), (0.038, 60e-3))
    return [
        dropped(f"d{kind}_{repeat}", 20100 + 10 * kind + repeat, *size)
        for kind, size in enumerate(kinds)
        for repeat in range(3)
    ]


@pytest.mark.parametrize("model", [["gravity"], ["gravity", "payload_friction"]])
def test_the_drag_of_falling_balls_is_named(balls: list[tuple[Trial, Track]], model: list[str]) -> None:
    found = vt.diagnose(balls, model=vt.make_model(model), ladder=False, advice=False)
    assert (found.verdict, found.effects) == ("missing", ("air_drag",))
    drag = found.fits[-1]["C_D"]
    assert drag.low < DRAG < drag.high
    assert drag.sigma < 0.03 * DRAG
    untried = {row.effect for row in found.rounds[0].ranking if row.status == "not testable here"}
    assert untried >= TUBES_ALONE


@pytest.mark.skipif(not REAL, reason="VINETRACK_REAL_DATA is unset: no real recordings to try")
def test_the_drag_of_eight_real_paper_cups_is_named() -> None:
    found = vt.diagnose(Path(REAL) / "falling_cups", ladder=False, advice=False)
    assert (found.verdict, found.effects) == ("missing", ("air_drag",))
    assert found.fits[-1]["C_D"].value == pytest.approx(1.24, abs=0.03)


def test_a_local_force_narrower_than_a_millimetre_is_not_named() -> None:
    assert Law("patch", n_shapes=2, low=-2e-3, high=4e-4).is_unresolved
    assert not Law("patch", n_shapes=2, low=0.02, high=0.04).is_unresolved


def test_a_force_far_beyond_drive_and_weight_is_not_named() -> None:
    estimate = ForceEstimate(100.0, np.array([-1.6e6]), 10.0, np.empty(0), 1)
    law = Law("patch", n_shapes=2, low=0.274, high=0.294)
    assert not RankedLaw(law, estimate, 0.0, largest_N=50.0).is_detected
    assert RankedLaw(law, replace(estimate, amplitude=np.array([-20.0]), sigma=1.0), 0.0, largest_N=50.0).is_detected
