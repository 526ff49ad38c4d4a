"""The diagnosis of campaigns whose truth is known: one per verdict. Seeds from 7000 are used here alone."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hidden_truth import Pairs, grown, sheet
from lsoda_vine import as_track, small_campaign
from own_effect import NAME, write_effect

import vinetrack as vt
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.core.units import AIR_DENSITY_KG_M3, GRAVITY_M_S2
from vinetrack.diagnosis.force_inversion import ForceEstimate
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.missing_force import RankedLaw
from vinetrack.diagnosis.remarks import remark
from vinetrack.diagnosis.replicates import LostFrames, with_lost_frames
from vinetrack.diagnosis.result import DROPPED_FRAMES, NOT_TESTABLE, VERDICTS, Diagnosis
from vinetrack.diagnosis.selection import contradictions
from vinetrack.effects import EffectError, own_effects
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_result import Fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow
from vinetrack.tracks.importers import flag_end_of_motion

FEW = ("reservoir_depletion", "supply_refill", "tail_friction", "length_scale", "leak", "latch_release")


@pytest.fixture(scope="module")
def nothing_missing() -> Diagnosis:
    return vt.diagnose(grown(seed=7000))


@pytest.fixture(scope="module")
def depleted_pairs() -> Pairs:
    return grown({"reservoir_depletion.gamma": 1.25}, seed=7100)


@pytest.fixture(scope="module")
def depleted(depleted_pairs: Pairs) -> Diagnosis:
    return vt.diagnose(depleted_pairs, candidates=FEW)


def test_nothing_missing_is_adequate(nothing_missing: Diagnosis) -> None:
    assert nothing_missing.verdict == nothing_missing.final_verdict == "adequate"
    assert nothing_missing.effects == nothing_missing.answer_set == ()


def test_adequate_says_how_large_an_effect_could_still_be(nothing_missing: Diagnosis) -> None:
    ranking = {one.effect: one for one in nothing_missing.rounds[0].ranking}
    friction = ranking["tail_friction"]
    assert 0 < friction.largest["tail_friction.mu_w"] < 0.2
    scale = ranking["length_scale"]
    assert abs(scale.largest["length_scale.eps"]) < 0.05


def behind_a_known_lens(pairs: Pairs) -> Pairs:
    """The same tracks from a camera whose lens is known: no smooth error of position is allowed for."""
    return [(replace(trial, position_systematic_m=0.0), track) for trial, track in pairs]


@pytest.fixture(scope="module")
def largest() -> float:
    """Friction that could hide behind a known lens."""
    pairs = grown(seed=7000, trials=sheet()[::2])
    nothing = vt.diagnose(behind_a_known_lens(pairs), candidates=FEW, ladder=False, advice=False)
    return next(o for o in nothing.rounds[0].ranking if o.effect == "tail_friction").largest["tail_friction.mu_w"]


@pytest.mark.slow
def test_a_size_well_beyond_what_could_hide_would_have_been_seen(largest: float) -> None:
    """Behind a known lens. Where 0.1 mm of smooth error is allowed for, it takes six times the limit."""
    hidden = grown({"tail_friction.mu_w": 4 * largest}, seed=7000, trials=sheet()[::2])
    diagnosis = vt.diagnose(behind_a_known_lens(hidden), candidates=FEW, ladder=False, advice=False)
    assert diagnosis.verdict in ("missing", "ambiguous")
    assert "tail_friction" in diagnosis.answer_set


def test_what_these_conditions_cannot_show_is_not_testable(nothing_missing: Diagnosis) -> None:
    blind = {one.effect: one.reason for one in nothing_missing.rounds[0].ranking if one.status == NOT_TESTABLE}
    assert blind["inlet_loss"].facts["column"] == "inlet_mm"
    assert blind["payload_drag"].facts["column"] == "payload_g"
    assert "static_yield" in blind


def test_a_missing_effect_is_named_with_its_size(depleted: Diagnosis) -> None:
    assert (depleted.verdict, depleted.final_verdict) == ("missing", "adequate")
    assert depleted.effects == depleted.answer_set == ("reservoir_depletion",)
    gamma = depleted.fit["gamma"]
    assert abs(gamma.value - 1.25) < 3 * gamma.sigma
    assert gamma.sigma < 0.02


def test_the_ladder_falls_to_the_replicates(depleted: Diagnosis) -> None:
    ladder = depleted.ladder
    assert ladder is not None
    assert list(ladder["added"]) == ["", "reservoir_depletion"]
    before, after = ladder.iloc[0], ladder.iloc[1]
    assert after["rms_left_out_m"] < 0.5 * before["rms_left_out_m"]
    assert after["rms_in_sample_m"] < 2 * after["floor_m"]


def test_n_and_B_come_home(depleted: Diagnosis) -> None:
    before, after = depleted.fits[0]["n"], depleted.fits[1]["n"]
    assert abs(after.value - 0.37) < 4 * after.sigma
    assert abs(after.value - 0.37) < 0.5 * abs(before.value - 0.37)


def test_the_answer_can_be_written_as_json(depleted: Diagnosis, tmp_path: Path) -> None:
    from vinetrack.core.tables import write_json

    write_json(tmp_path / "diagnosis.json", depleted.to_json())
    read = json.loads((tmp_path / "diagnosis.json").read_text())
    assert read["verdict"] in VERDICTS
    assert read["effects"] == ["reservoir_depletion"]
    assert [one["verdict"] for one in read["rounds"]] == ["missing", "adequate"]
    assert read["rounds"][0]["ranking"][0]["effect"] == "reservoir_depletion"
    matrix = np.array(read["cosines"]["matrix"], dtype=float)
    assert matrix.shape == (len(read["cosines"]["effects"]),) * 2
    assert np.allclose(np.diag(matrix), 1)


@pytest.mark.slow
def test_a_wrong_scale_is_an_artefact_with_a_calibration_to_do() -> None:
    found = vt.diagnose(grown({"length_scale.eps": 0.06}, seed=7002, trials=sheet(35.6)[::2]), ladder=False)
    assert found.verdict == "artefact"
    assert "length_scale" in found.answer_set
    assert found.effects == ()
    assert found.next_experiment is not None
    assert found.next_experiment["calibration"]


@pytest.mark.slow
def test_missing_frames_are_said_first(depleted_pairs: Pairs) -> None:
    once = depleted_pairs[::2]  # one trial of every condition
    trial, track = next((trial, track) for trial, track in once if trial.pressure_Pa == 40e3)
    moving = int(np.searchsorted(track.lead_position_m, track.lead_position_m[0] + 0.05))
    keep = np.arange(track.time_s.size) != moving
    time_s = track.time_s[:-1]
    cut = replace(
        track,
        time_s=time_s,
        lead_position_m=track.lead_position_m[keep],
        lead_position_sigma_m=track.lead_position_sigma_m[keep],
        flag=track.flag[keep],
        edge_px=track.edge_px[keep],
    )
    others = [(one, other) for one, other in once if one.name != trial.name]
    few = ["reservoir_depletion", "tail_friction", "length_scale"]
    found = vt.diagnose([(trial, cut), *others], candidates=few, ladder=False, advice=False)
    assert (found.verdict, found.answer_set) == ("artefact", (DROPPED_FRAMES,))
    assert "reservoir_depletion" in found.notes[0].facts["explanation"]


def test_frames_that_may_be_missing_are_a_note_beside_the_verdict(depleted: Diagnosis) -> None:
    """A step that a few points with heavy tails may have made had been the verdict in place of `supply_pulsation`."""
    missing = LostFrames(("a", "b"))
    result = with_lost_frames(depleted, missing)
    assert (result.verdict, result.effects) == (depleted.verdict, depleted.effects)
    assert result.notes[-1].code == "frames_perhaps_missing"
    assert with_lost_frames(depleted, replace(missing, certain=("b",))).answer_set == (DROPPED_FRAMES,)
    assert with_lost_frames(depleted, LostFrames()) is depleted


@pytest.mark.slow
def test_a_users_own_effect_is_found_like_any_other(tmp_path: Path) -> None:
    own = own_effects([write_effect(tmp_path)])
    pairs = _with_own(own[NAME], "k", 1.5, seed=7003)
    found = vt.diagnose(pairs, user_effects=own, candidates=(*FEW, NAME), ladder=False, advice=False)
    assert found.verdict == "missing"
    assert found.effects == (NAME,)
    size = found.fit[f"{NAME}.k"]
    assert abs(size.value - 1.5) < 4 * size.sigma


def _with_own(effect: vt.effects.Effect, symbol: str, size: float, *, seed: int) -> Pairs:
    """Trials grown with an effect that only its file knows; their B and P scatter, release lies between frames."""
    draw = np.random.default_rng(seed)
    trials = sheet()[::2]
    coefficients = damping_values(trials)["eversion_damping.B"]
    pairs = []
    for trial in trials:
        B = coefficients[trial.vine] * math.exp(0.02 * draw.standard_normal())
        true = replace(trial, pressure_Pa=trial.pressure_Pa * (1 + 0.005 * draw.standard_normal()))
        model = (vt.base_model() + effect).with_values(
            {"eversion_damping.B": {trial.vine: B}, "eversion_damping.n": 0.37, f"{effect.name}.{symbol}": size}
        )
        since = np.arange(-20, 400) / trial.capture_fps + draw.uniform(0, 1) / trial.capture_fps
        y = vt.simulate(model, true, since).lead_position_m
        last = int(np.searchsorted(y, 0.9 * trial.length_m))
        position_m = 0.03 + y[:last] + 1e-4 * draw.standard_normal(last)
        nothing = np.full(last, np.nan)
        flags = np.full(last, "", dtype=object)
        pairs.append((trial, Track(since[:last] - since[0], position_m, nothing, flags, nothing)))
    return pairs


@pytest.mark.slow
def test_what_no_effect_explains_is_unexplained_and_drawn() -> None:
    pairs = []
    for trial, track in grown(seed=7004, trials=sheet()[:6:2]):  # one vine
        y = track.lead_position_m - track.lead_position_m[:5].mean()
        bump = 1.5e-3 * np.sin(2 * math.pi * np.clip(y, 0, None) / 0.05) * (y > 0.03)
        pairs.append((trial, replace(track, lead_position_m=track.lead_position_m + bump)))
    found = vt.diagnose(pairs, candidates=FEW, ladder=False)
    assert found.verdict == "unexplained"
    assert found.effects == ()
    assert found.missing_force is not None
    assert found.force_table is not None
    assert len(found.force_table)
    assert found.learned_table is not None


def test_an_unknown_candidate_is_an_error_that_suggests(depleted_pairs: Pairs) -> None:
    with pytest.raises(EffectError):
        vt.diagnose(depleted_pairs, candidates=["air_drage"])


@pytest.mark.slow
def test_a_measured_pressure_already_holds_what_happens_in_the_chamber() -> None:
    pairs = [
        (trial, replace(track, pressure_Pa=np.full(track.time_s.size, trial.pressure_Pa)))
        for trial, track in grown(seed=7005)
    ]
    found = vt.diagnose(pairs, ladder=False, advice=False)
    blind = {one.effect: one.reason for one in found.rounds[0].ranking if one.status == NOT_TESTABLE}
    assert blind["reservoir_depletion"].code == "in_measured_pressure"


# What the ladder of errors and drifting parameters say against a verdict reaches the reader.


@pytest.fixture(scope="module")
def plain() -> Fit:
    return fit(vt.base_model(), grown(seed=51), profile=False)


def exponents_apart(by: float) -> list[tuple[Trial, Track]]:
    """Two vines that the sheet lets share one n, and whose n differ."""
    pairs = []
    for prefix, change in (("a", -by / 2), ("b", by / 2)):
        trials = [trial for trial in sheet() if trial.name.startswith(prefix)]
        values = {**damping_values(trials), "eversion_damping.n": 0.37 + change}
        nature = GroundTruth(
            effects=BASE, values=values, damping_scatter=5e-3, pressure_scatter=1e-3, noise_m=3e-5, seed=9
        )
        pairs += [(one.stated, one.track) for one in grow(trials, nature)]
    return pairs


def errors(*left_out_m: float) -> pd.DataFrame:
    return pd.DataFrame({"rms_left_out_m": left_out_m})


def test_an_effect_that_predicts_no_condition_better_is_said_to(plain: Fit) -> None:
    (told,) = contradictions((plain,), ("latch_release",), errors(4.09e-3, 4.09e-3))
    assert told == remark("left_out_error_does_not_fall", name="latch_release", without_m=4.09e-3, with_m=4.09e-3)
    assert contradictions((plain,), ("latch_release",), errors(4.09e-3, 3.2e-3)) == ()
    assert contradictions((plain,), ("latch_release",), errors(4.09e-3, np.nan)) == ()


def test_a_model_that_holds_is_not_contradicted(plain: Fit) -> None:
    assert contradictions((plain,), (), None) == ()


@pytest.mark.slow
def test_n_that_differs_between_vines_contradicts_an_adequate_model() -> None:
    found = fit(vt.base_model(), exponents_apart(0.06), profile=False)
    assert {told.code for told in contradictions((found,), (), None)} == {"still_drifts"}


@pytest.mark.slow
def test_steps_and_values_of_a_fit_stay_through_its_diagnosis(plain: Fit) -> None:
    steps, pressure_step = plain.predictor.steps.copy(), plain.predictor.pressure_step.copy()
    theta = plain.solution.state.theta.copy()
    diagnosis = vt.diagnose(plain, candidates=["leak", "air_drag"], ladder=False, advice=False)
    assert not np.shares_memory(diagnosis.fits[0].predictor.steps, plain.predictor.steps)
    assert not np.shares_memory(diagnosis.fits[0].predictor.pressure_step, plain.predictor.pressure_step)
    np.testing.assert_array_equal(plain.predictor.steps, steps)
    np.testing.assert_array_equal(plain.predictor.pressure_step, pressure_step)
    np.testing.assert_array_equal(plain.solution.state.theta, theta)


# Bodies that move as a whole: what is missing from gravity is named, and nothing that only a tube can have.

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


@pytest.mark.slow
@pytest.mark.parametrize("model", [["gravity"], ["gravity", "payload_friction"]])
def test_the_drag_of_falling_balls_is_named(balls: list[tuple[Trial, Track]], model: list[str]) -> None:
    found = vt.diagnose(balls, model=vt.make_model(model), ladder=False, advice=False)
    assert (found.verdict, found.effects) == ("missing", ("air_drag",))
    drag = found.fits[-1]["C_D"]
    assert drag.low < DRAG < drag.high
    assert drag.sigma < 0.03 * DRAG
    untried = {row.effect for row in found.rounds[0].ranking if row.status == "not testable here"}
    assert untried >= TUBES_ALONE


@pytest.mark.slow
def test_vines_that_a_wall_stops_half_way_lack_nothing() -> None:
    draw, stopped = np.random.default_rng(1), []
    for trial, track in small_campaign(3)[0]:
        wall_m = track.lead_position_m[0] + 0.8 * np.ptp(track.lead_position_m)
        moving = int(np.argmax(track.lead_position_m > wall_m))
        time_s = np.concatenate([track.time_s[:moving], track.time_s[moving] + np.arange(15) / 1069])
        stands_m = wall_m + draw.normal(0, np.std(track.lead_position_m[:5]), 15)
        ended = plain_track(time_s, np.concatenate([track.lead_position_m[:moving], stands_m]))
        stopped.append((trial, flag_end_of_motion(trial, ended)))
    assert vt.diagnose(stopped, ladder=False, advice=False).verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize(("model", "verdict"), [(["gravity"], "missing"), (["gravity", "air_drag"], "adequate")])
def test_a_lens_that_is_off_by_centimetres_in_a_drop_of_47_m_is_no_fault_of_the_model(
    model: list[str], verdict: str
) -> None:
    time_s = np.arange(-8, 60) / 15
    drops = []
    for seed in (10, 11):
        (trial, _), noise_m = dropped(f"d{seed}", seed, 0.074, 0.145), np.random.default_rng(seed).normal(0, 5e-3, 68)
        limit_m_s = math.sqrt(2 * 0.145 * GRAVITY_M_S2 / (AIR_DENSITY_KG_M3 * trial.area_m2 * 0.5))
        fallen_m = limit_m_s**2 / GRAVITY_M_S2 * np.log(np.cosh(GRAVITY_M_S2 * np.maximum(time_s, 0) / limit_m_s))
        seen, part = fallen_m < 47, 2 * fallen_m / 47 - 1
        lens_m = 0.018 * (part**3 - 0.6 * part) + 0.01 * (part**2 - 1)
        drops.append((trial, plain_track(time_s[seen], (fallen_m + lens_m + noise_m)[seen])))
    found = vt.diagnose(drops, model=vt.make_model(model), ladder=False, advice=False)
    assert found.verdict == verdict
    assert abs(found.fits[-1]["C_D"].value - 0.5) < 3 * found.fits[-1]["C_D"].sigma


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
