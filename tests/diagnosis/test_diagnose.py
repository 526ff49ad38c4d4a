"""The diagnosis of campaigns whose truth is known: one per verdict. Seeds from 7000 are used here alone.

Where no scatter of replicates is asked about, `sheet()[::2]` has each condition once. What the whole catalogue answers
`test_hidden_effects` asks, and here what needs all of it; the others ask `FEW`.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hidden_truth import Pairs, grown, sheet
from own_effect import NAME, write_effect

import vinetrack as vt
from vinetrack.core.records import Track
from vinetrack.diagnosis.odd_trials import LostFrames, with_lost_frames
from vinetrack.diagnosis.result import DROPPED_FRAMES, NOT_TESTABLE, VERDICTS, Diagnosis
from vinetrack.effects import EffectError, own_effects
from vinetrack.laboratory.tracks import damping_values

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


@pytest.mark.parametrize("times", [4, 5])
def test_a_size_well_beyond_what_could_hide_would_have_been_seen(largest: float, times: int) -> None:
    """Behind a known lens. Where 0.1 mm of smooth error is allowed for, it takes six times the limit."""
    hidden = grown({"tail_friction.mu_w": times * largest}, seed=7000, trials=sheet()[::2])
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


def test_the_larger_effect_that_holds_it_is_set_aside_and_says_why(depleted: Diagnosis) -> None:
    refill = next(one for one in depleted.rounds[0].ranking if one.effect == "supply_refill")
    assert not refill.in_answer_set
    assert refill.reason.facts["name"] == "reservoir_depletion"


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


def test_printed_it_begins_with_the_verdict(depleted: Diagnosis) -> None:
    text = str(depleted)
    assert text.startswith("missing: reservoir_depletion is missing")
    assert "γ = " in text
    assert "position error" in text


def test_a_fit_can_be_questioned_and_stays_as_it_is(depleted_pairs: Pairs) -> None:
    fit = vt.fit(vt.base_model() + vt.effects.reservoir_depletion, depleted_pairs, profile=False)
    before = fit["n"].value
    found = vt.diagnose(fit, ladder=False, advice=False)
    assert found.verdict == "adequate"
    assert fit["n"].value == before


def test_a_wrong_scale_is_an_artefact_with_a_calibration_to_do() -> None:
    found = vt.diagnose(grown({"length_scale.eps": 0.06}, seed=7002, trials=sheet(35.6)[::2]), ladder=False)
    assert found.verdict == "artefact"
    assert "length_scale" in found.answer_set
    assert found.effects == ()
    assert found.next_experiment is not None
    assert found.next_experiment["calibration"]


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
    assert trial.name in found.explanation
    assert "reservoir_depletion" in found.notes[0].facts["explanation"]


def test_frames_that_may_be_missing_are_a_note_beside_the_verdict(depleted: Diagnosis) -> None:
    """A step that a few points with heavy tails may have made had been the verdict in place of `supply_pulsation`."""
    missing = LostFrames(("a", "b"))
    result = with_lost_frames(depleted, missing)
    assert (result.verdict, result.effects) == (depleted.verdict, depleted.effects)
    assert result.notes[-1].code == "frames_perhaps_missing"
    assert with_lost_frames(depleted, replace(missing, certain=("b",))).answer_set == (DROPPED_FRAMES,)
    assert with_lost_frames(depleted, LostFrames()) is depleted


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
    with pytest.raises(EffectError, match="air_drag"):
        vt.diagnose(depleted_pairs, candidates=["air_drage"])


def test_a_measured_pressure_already_holds_what_happens_in_the_chamber() -> None:
    pairs = [
        (trial, replace(track, pressure_Pa=np.full(track.time_s.size, trial.pressure_Pa)))
        for trial, track in grown(seed=7005)
    ]
    found = vt.diagnose(pairs, ladder=False, advice=False)
    blind = {one.effect: one.reason for one in found.rounds[0].ranking if one.status == NOT_TESTABLE}
    assert blind["reservoir_depletion"].code == "in_measured_pressure"
