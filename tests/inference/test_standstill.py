"""A model in which nothing moves, or nothing has mass, is refused with one sentence and a remedy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import as_track, small_campaign

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.inference.fit_data import FitError


@pytest.fixture
def fallen() -> tuple[Trial, Track]:
    """A ball of 20 g that falls from rest."""
    trial = Trial(name="ball", diameter_m=0.1, pressure_Pa=0.0, yield_pressure_Pa=0.0, payload_kg=20e-3, travel_ratio=1)
    time_s = np.arange(80) / 120
    fallen_m = 0.5 * 9.81 * np.maximum(time_s - 0.1, 0.0) ** 2
    return trial, as_track(time_s, fallen_m + np.random.default_rng(20400).normal(0, 1e-3, time_s.size))


@pytest.mark.parametrize("angle_deg", [90, 180])
def test_gravity_alone_moves_nothing_sideways_or_up(fallen: tuple[Trial, Track], angle_deg: float) -> None:
    trial = replace(fallen[0], growth_angle_rad=math.radians(angle_deg))
    with pytest.raises(FitError, match=rf"gravity moves no trial: at a growth angle of {angle_deg}° .* Check growth_a"):
        vt.diagnose([(trial, fallen[1])], model=vt.make_model(["gravity"]))


def test_a_body_without_mass(fallen: tuple[Trial, Track]) -> None:
    weightless = replace(fallen[0], payload_kg=0.0)
    with pytest.raises(FitError, match="ball: it has no mass: fill in payload_g"):
        vt.fit(vt.make_model(["gravity"]), [(weightless, fallen[1])])


def test_pressures_below_those_of_the_yield() -> None:
    pairs, _ = small_campaign(seed=8, replicates=1)
    held = [(replace(trial, yield_pressure_Pa=1.5 * trial.pressure_Pa), track) for trial, track in pairs]
    with pytest.raises(FitError, match="lies below the yield pressure"):
        vt.fit(vt.base_model(), held)


def test_free_trial_effects_are_named_only_where_they_exist(fallen: tuple[Trial, Track]) -> None:
    trial, track = fallen
    steep = replace(track, lead_position_m=2.0 * track.lead_position_m)
    messages = " ".join(vt.fit(vt.make_model(["gravity"]), [(trial, steep)]).messages)
    assert "times the noise of the tracks: an effect is missing" in messages
    assert "B and pressure" not in messages
