"""Campaigns of laboratories, the package's own and those with faults in `benchmarks/hidden`, are what they say, their
truth is out of sight; an answer is judged by what is right to say."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from by_hand import followed
from hidden.balls import fallen
from hidden.motion import AIR, G
from hidden.verdicts import Answer, Should, judge

from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory import tracks
from vinetrack.laboratory.filming import make_filming, recording_experiment
from vinetrack.laboratory.tracks import GroundTruth, campaign, damping_values, grow, isometric_vine
from vinetrack.tracks.importers import load_track

ROOT = Path(__file__).parents[2]


def few() -> list[Trial]:
    return list(with_names(campaign(isometric_vine(4), (14, 20, 28), 2, prefix="R4_")))


def nature(**changes: object) -> GroundTruth:
    return GroundTruth(values=damping_values(few()), **changes)  # type: ignore[arg-type]


EXACT = {"damping_scatter": 0.0, "pressure_scatter": 0.0, "noise_m": 0.0}


def test_a_seed_gives_a_trial_its_numbers_whatever_the_others_are_and_another_seed_others():
    def same(one: tracks.VirtualTrial, other: tracks.VirtualTrial) -> bool:
        moved = np.array_equal(one.track.lead_position_m, other.track.lead_position_m)
        return moved and (one.release_s, one.true) == (other.release_s, other.true)

    trials, hidden = few(), nature(seed=5, yield_error_kPa=0.2)
    whole = grow(trials, hidden)
    rest = grow([trial for i, trial in enumerate(trials) if i != 3], hidden)
    assert all(map(same, whole[:3] + whole[4:], rest))
    assert not any(map(same, whole, grow(trials, replace(hidden, seed=4))))


def test_without_scatter_and_noise_a_track_is_the_model_seen_from_an_unknown_origin():
    hidden = nature(seed=1, **EXACT)
    for grown in grow(few(), hidden):
        truth = simulate(hidden.model(), grown.stated, grown.track.time_s - grown.release_s)
        np.testing.assert_allclose(grown.track.lead_position_m - grown.origin_m, truth.lead_position_m, atol=1e-12)
        assert grown.true == grown.stated
        assert -0.05 <= grown.origin_m <= 0.05
        np.testing.assert_allclose(np.diff(grown.track.time_s), 1 / 1069, rtol=1e-9)
    # A hidden effect of the measurement shows in the track and not in the truth.
    values = {**damping_values(few()), "length_scale.eps": 0.05}
    wrong = GroundTruth(effects=(*GroundTruth().effects, "length_scale"), values=values, seed=1, **EXACT)
    (grown,) = grow(few()[:1], wrong)
    seen_m = grown.track.lead_position_m - grown.origin_m
    np.testing.assert_allclose(seen_m, 1.05 * grown.true_lead_position_m, atol=1e-12)


def test_scatter_of_damping_and_pressure_is_as_stated():
    """Standard deviations of 600 draws are good to 3 % (one sigma); the two do not go together."""
    trials = list(with_names(campaign(isometric_vine(4), (28,), 600)))
    grown = grow(trials, nature(seed=7, longest_frames=50, release_frames=(15, 40)))
    column = grown[0].model.parameter_names.index("eversion_damping.B")
    B = np.array([one.model.parameters_of(one.true)[column] for one in grown]) / 6.44 - 1
    P = np.array([one.true.pressure_Pa for one in grown]) / 28e3 - 1
    assert B.std() == pytest.approx(0.03, rel=0.1)
    assert P.std() == pytest.approx(0.01, rel=0.1)
    assert abs(B.mean()) < 4 * 0.03 / math.sqrt(600)
    assert abs(P.mean()) < 4 * 0.01 / math.sqrt(600)
    assert abs(np.corrcoef(B, P)[0, 1]) < 4 / math.sqrt(600)
    release = np.array([one.release_s for one in grown]) * 1069
    assert release.min() >= 14
    assert release.max() <= 40
    assert np.std(release % 1) == pytest.approx(math.sqrt(1 / 12), rel=0.1)


def test_noise_has_the_stated_deviation_and_correlation():
    """Rest frames alone, 4000 of them: errors of 2 % for the deviation (or more), 0.016 for the latter."""
    at_rest = {"release_frames": (4000, 4000), "longest_frames": 4000}
    hidden = nature(seed=11, noise_m=2e-4, noise_correlation=0.6, **at_rest)
    noise = grow(few()[:1], hidden)[0]
    assert (noise.true_lead_position_m == 0).all()
    residual = noise.track.lead_position_m - noise.origin_m
    assert residual.std() == pytest.approx(2e-4, rel=0.08)
    assert abs(residual.mean()) < 2e-5
    centred = residual - residual.mean()
    assert centred[1:] @ centred[:-1] / (centred @ centred) == pytest.approx(0.6, abs=0.06)
    assert centred[2:] @ centred[:-2] / (centred @ centred) == pytest.approx(0.36, abs=0.08)


def test_a_recorded_pressure_is_what_drove_it_and_noise():
    trials = [replace(trial, chamber_m3=1e-3) for trial in few()]
    effects = (*GroundTruth().effects, "reservoir_depletion")
    values = {**damping_values(trials), "reservoir_depletion.gamma": 1.0}
    quiet = GroundTruth(effects=effects, values=values, trace_sigma_kPa=0.0, seed=1)
    calm = grow(trials, quiet)
    for grown in calm:
        volume = 1e-3 + math.pi * 0.012**2 * grown.true_lead_position_m
        truth = (grown.true.pressure_Pa + 101_325) * 1e-3 / volume - 101_325
        np.testing.assert_allclose(grown.track.pressure_Pa, truth, rtol=1e-9)
        assert truth[0] - truth[-1] > 1e3
    loud = grow(trials[:1], replace(quiet, trace_sigma_kPa=0.1))[0]
    assert np.std(loud.track.pressure_Pa - calm[0].track.pressure_Pa) == pytest.approx(100, rel=0.3)


def test_what_is_written_reads_back_without_a_word(tmp_path):
    grown = grow(few(), nature(seed=1, trace_sigma_kPa=0.05))
    tracks.write_experiment(grown, tmp_path / "e", "chamber_l: 3.7\n")
    assert check_experiment(tmp_path / "e") == []
    experiment = read_experiment(tmp_path / "e", strict=True)
    for trial, one in zip(experiment.trials, grown, strict=True):
        told = one.stated.name, one.stated.vine, one.stated.condition
        assert (trial.name, trial.vine, trial.condition) == told
        assert trial.pressure_Pa == pytest.approx(one.stated.pressure_Pa, rel=1e-12)
        track = load_track(trial)
        np.testing.assert_allclose(track.lead_position_m, one.track.lead_position_m, atol=1e-8)
        np.testing.assert_allclose(np.diff(track.time_s), np.diff(one.track.time_s), atol=2e-9)
        assert track.pressure_Pa is not None


PAPER = ROOT / "data" / "paper"


def test_the_papers_nature_has_the_printed_numbers():
    """B of a printed diameter is in proportion to the wall; of the 25 mm vine it is 6.44 × ½ × (25/24)^0.75 = 3.320."""
    trials = read_experiment(PAPER).trials
    assert len(trials) == 365
    hidden = tracks.read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    B = hidden.values["eversion_damping.B"]
    assert hidden.values["eversion_damping.n"] == 0.37
    assert set(B) == {trial.vine for trial in trials}
    assert B["12mm-100um-140mm"] == 1.83
    assert B["12mm-200um-140mm"] == pytest.approx(2 * 1.83)
    assert B["24mm-150um-280mm"] == pytest.approx(0.75 * 6.44)
    assert B["25mm-100um-400mm"] == pytest.approx(3.320, abs=5e-4)


def test_tracks_are_put_before_a_camera_on_request(tmp_path):
    filming = make_filming({"target": {"squares": [14, 5], "square_m": 0.015, "marker_m": 0.011}})
    filmed = recording_experiment(read_experiment(PAPER), filming, tmp_path / "filmed")
    assert [trial.name for trial in filmed.trials] == [trial.name for trial in read_experiment(PAPER).trials]
    for trial in filmed.trials:
        assert trial.video == tmp_path / "filmed" / "videos" / f"{trial.name}.mp4"
        assert trial.track is None
        assert trial.exposure_s == pytest.approx(0.1 / 1069, rel=1e-4)
    assert filmed.settings.calibration.square_mm == pytest.approx(15)
    with pytest.raises(ValueError, match="recordings already"):
        recording_experiment(read_experiment(ROOT / "data" / "demo"), filming, tmp_path / "again")


def test_a_ball_falls_as_the_equation_of_motion_has_it():
    mass, diameter, C_D = 2.7e-3, 0.04, 0.5
    drag = 0.5 * AIR * math.pi * diameter**2 / 4 * C_D
    times = np.linspace(0, 0.8, 50)
    found = followed(lambda _t, _x, v: G - drag * v**2 / mass, 3.0)
    assert fallen(times, mass, diameter, C_D) == pytest.approx(found(times), abs=1e-8)
    assert np.all(fallen(np.array([-1.0, 0.0]), mass, diameter, C_D) == 0)


LENS = Should(("artefact", "ambiguous", "adequate"), any_of=("lens",), true=("lens",))
WORN = Should(("artefact",), any_of=("*order*",), only=("*order*",), true=("*order*",))
BOTH = Should(("missing", "ambiguous"), ("drag",), all_of=("drag", "inlet"), true=("drag", "inlet"), holds=("drag.C",))


def answer(verdict: str, *names: str, size: tuple[float, float] | None = None) -> Answer:
    sizes = {"drag.C": {"value": sum(size) / 2, "low_95": size[0], "high_95": size[1]}} if size else {}
    return Answer(verdict, names, names[:1] if verdict == "missing" else (), numbers=sizes)


@pytest.mark.parametrize(
    ("said", "should", "right", "wrong_name"),
    [
        (answer("adequate"), LENS, True, False),
        (answer("ambiguous", "lens", "latch_release"), LENS, True, False),
        (answer("ambiguous", "latch_release", "leak"), LENS, False, False),
        (answer("missing", "latch_release"), LENS, False, True),
        (answer("artefact", "length_scale"), LENS, False, True),
        (answer("unexplained"), LENS, False, False),
        (answer("adequate"), WORN, False, False),
        (answer("artefact", "drift_with_order"), WORN, True, False),
        (answer("artefact", "drift_with_order", "pressure_gain"), WORN, False, False),
        (answer("ambiguous", "drag", "inlet"), BOTH, True, False),
        (answer("ambiguous", "drag", "leak"), BOTH, False, False),
        (answer("missing", "drag", size=(0.9, 1.1)), BOTH, True, False),
        (answer("missing", "drag", size=(1.1, 1.2)), BOTH, False, False),
    ],
)
def test_an_answer_is_judged_by_what_is_right_to_say(said, should, right, wrong_name):
    judged = judge(said, should, {"drag.C": 1.0})
    assert (judged.right, judged.wrong_name, bool(judged.why)) == (right, wrong_name, not right)


def test_a_fault_that_hardly_shows_need_not_be_named():
    should = Should(("artefact",), any_of=("lens",), true=("lens",))
    assert [judge(answer("adequate"), should, {"visible_sigma": size}).right for size in (3.0, 30.0)] == [True, False]
