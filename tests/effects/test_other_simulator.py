"""Another simulator, written from the equations alone, says the same of every effect; its campaigns are what they say.

It lives in `benchmarks/hidden` and shares no code with the model; what it makes is diagnosed in
`tests/diagnosis/test_campaign_verdicts.py` and scored by `benchmarks/hidden_effects.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden import EFFECTS, OUTSIDERS, make, write_folder
from hidden.motion import Physics, Tube, follow
from hidden.questions import outsider_values, true_effects
from hidden.verify import FRAME_S, SIZES, ours, trials

import vinetrack as vt
from vinetrack.dynamics.model import host_for
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import catalogue
from vinetrack.inference.fit_data import pairs_of

B, N = 6.44, 0.37
DAMPING = {"eversion_damping.B": B, "eversion_damping.n": N}
WRITTEN_OUT = ("growth_angle", "lens", "moving_average", "rolling_shutter", "supply_rise", "trace_clock")
"""Effects that are held against a vine written out by hand instead (`test_by_hand`)."""

TIMES = FRAME_S * np.arange(-3, 1200)


def test_every_candidate_that_a_release_can_show_is_hidden_in_some_campaign():
    candidates = {name for name, effect in catalogue().items() if effect.kind != "base"}
    assert candidates - set(EFFECTS) == {"static_yield", *WRITTEN_OUT}
    assert set(SIZES) == {"", *EFFECTS}


@pytest.mark.parametrize("effect", SIZES, ids=lambda effect: effect or "base")
def test_two_simulators_agree(effect):
    size = {f"{effect}.{name}": value for name, value in SIZES[effect][1].items()}
    model = (vt.base_model() + effect if effect else vt.base_model()).with_values(DAMPING | size)
    host = host_for(model)  # the compiled model of the diagnoses, all its other effects at rest
    for rig in ("payload, down", "horizontal, slow", "bent", "reel"):
        trial = trials()[rig]
        theirs = simulate_many(model, [trial], [TIMES], host=host, relative_tolerance=1e-7)[0].observed_position_m
        other = ours(effect, trial, TIMES, B, N)
        seen = np.isfinite(other)
        assert np.nanmax(other) > 0.2 * trial.length_m
        np.testing.assert_allclose(other[seen], theirs[seen], atol=1e-8)


OUTSIDE = {
    "rough_patch": {"patch_F": 0.8, "patch_y": 0.1, "patch_width": 0.01},
    "ripple": {"ripple_F": 0.4, "ripple_length": 0.05, "ripple_phase": 1.0},
    "cubic": {"cubic": 1e-3},
    "beyond_a_speed": {"beyond": 0.02, "beyond_speed": 2.0},
    "growing_friction": {"growing_F": 0.8, "growing_s": 0.2},
    "changed_film": {"step_B": 0.1, "step_y": 0.12},
    "slip": {"slip_F": 0.8, "slip_x": 0.5, "slip_speed": 1.5},
    "chirp": {"chirp_F": 0.4, "chirp_length": 0.12, "chirp_phase": 1.0},
    "squeeze": {"squeeze_F": 0.5, "squeeze_Pa": 2e4, "squeeze_y": 0.1, "squeeze_width": 0.03},
}


@pytest.mark.parametrize("name", OUTSIDERS)
def test_a_force_of_no_catalogue_is_the_one_that_scoring_knows(name):
    trial = trials()["bare, down"]
    physics = Physics(B=B, n=N, **OUTSIDE[name])
    rig = ("pressure_Pa", "yield_pressure_Pa", "diameter_m", "thickness_m", "length_m")
    tube = Tube(*(getattr(trial, name) for name in rig), 0.0, 1.0)
    other, _ = follow(TIMES, tube, physics, np.empty((0, 3)))
    truth = replace(make("null:few_trials", 900).truth, outsider=name, physics=physics)
    model = (vt.base_model() + true_effects((), name)[0]).with_values(DAMPING | outsider_values(truth))
    # In one compiled model for all of them.
    host = vt.Model((*vt.base_model(), *(true_effects((), outsider)[0] for outsider in OUTSIDERS)))
    theirs = simulate_many(model, [trial], [TIMES], host=host, relative_tolerance=1e-7)[0].lead_position_m
    seen = other[:, 1] < 0.95 * trial.length_m
    plain, _ = follow(TIMES, tube, Physics(B=B, n=N), np.empty((0, 3)))
    assert np.max(np.abs(other[seen, 1] - plain[seen, 1])) > 1e-3
    # A film that changes from one millimetre to the next is a corner to one integrator and a step to the other.
    np.testing.assert_allclose(other[seen, 1], theirs[seen], atol=2e-6 if name == "changed_film" else 1e-7)


def test_a_campaign_written_to_a_folder_is_read_back(tmp_path):
    campaign = make("bends:capstan_friction", 903)
    write_folder(campaign, tmp_path)
    experiment = vt.read_experiment(tmp_path)
    assert not experiment.failed
    pairs, left_out = pairs_of(experiment)
    assert not left_out
    for (trial, track), (read, read_track) in zip(campaign.pairs, pairs, strict=True):
        for name in ("diameter_m", "pressure_Pa", "payload_kg", "chamber_m3", "inlet_m", "growth_angle_rad", "vine"):
            assert getattr(read, name) == pytest.approx(getattr(trial, name), nan_ok=True)
        assert len(read.bends) == len(trial.bends) > 0
        np.testing.assert_allclose(read_track.lead_position_m, track.lead_position_m, atol=1e-7)
