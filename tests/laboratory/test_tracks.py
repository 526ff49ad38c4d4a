"""Campaigns of laboratories, the package's own and those with faults in `benchmarks/hidden`, are what they say, their
truth is out of sight; an answer is judged by what is right to say."""

import math
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hidden.verdicts import Answer, Should, judge

from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory import campaigns
from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Ball, Camera, Door, Encoding, Light, Scene, Sensor, Tube, preset
from vinetrack.tracks.importers import load_track

ROOT = Path(__file__).parents[2]
EXACT = {"damping_scatter": 0.0, "pressure_scatter": 0.0, "noise_m": 0.0}
PAPER = ROOT / "data" / "paper"
LENS = Should(("artefact", "ambiguous", "adequate"), any_of=("lens",), true=("lens",))
WORN = Should(("artefact",), any_of=("*order*",), only=("*order*",), true=("*order*",))
BOTH = Should(("missing", "ambiguous"), ("drag",), all_of=("drag", "inlet"), true=("drag", "inlet"), holds=("drag.C",))
FILM, BEHIND = 52428.0, 6553.0  # Levels of `clean` film (0.8) and of what is behind it (0.1) in 16 bits


def few() -> list[Trial]:
    return list(with_names(campaigns.campaign(campaigns.isometric_vine(4), (14, 20, 28), 2, prefix="R4_")))


def nature(**changes: object) -> campaigns.GroundTruth:
    return campaigns.GroundTruth(values=campaigns.damping_values(few()), **changes)  # type: ignore[arg-type]


def test_a_seed_gives_a_trial_its_numbers_whatever_the_others_are_and_another_seed_others():
    def same(one: campaigns.VirtualTrial, other: campaigns.VirtualTrial) -> bool:
        moved = np.array_equal(one.track.lead_position_m, other.track.lead_position_m)
        return moved and (one.release_s, one.true) == (other.release_s, other.true)

    trials, hidden = few(), nature(seed=5, yield_error_kPa=0.2)
    whole = campaigns.grow(trials, hidden)
    rest = campaigns.grow([trial for i, trial in enumerate(trials) if i != 3], hidden)
    assert all(map(same, whole[:3] + whole[4:], rest))
    assert not any(map(same, whole, campaigns.grow(trials, replace(hidden, seed=4))))


def test_without_scatter_and_noise_a_track_is_the_model_seen_from_an_unknown_origin():
    hidden = nature(seed=1, **EXACT)
    for grown in campaigns.grow(few(), hidden):
        truth = simulate(hidden.model(), grown.stated, grown.track.time_s - grown.release_s)
        np.testing.assert_allclose(grown.track.lead_position_m - grown.origin_m, truth.lead_position_m, atol=1e-12)
        assert grown.true == grown.stated
        assert -0.05 <= grown.origin_m <= 0.05
        np.testing.assert_allclose(np.diff(grown.track.time_s), 1 / 1069, rtol=1e-9)
    # A hidden effect of the measurement shows in the track and not in the truth.
    values = {**campaigns.damping_values(few()), "length_scale.eps": 0.05}
    wrong = campaigns.GroundTruth(
        effects=(*campaigns.GroundTruth().effects, "length_scale"), values=values, seed=1, **EXACT
    )
    (grown,) = campaigns.grow(few()[:1], wrong)
    seen_m = grown.track.lead_position_m - grown.origin_m
    np.testing.assert_allclose(seen_m, 1.05 * grown.true_lead_position_m, atol=1e-12)


def test_scatter_of_damping_and_pressure_is_as_stated():
    """Standard deviations of 600 draws are good to 3 % (one sigma); the two do not go together."""
    trials = list(with_names(campaigns.campaign(campaigns.isometric_vine(4), (28,), 600)))
    grown = campaigns.grow(trials, nature(seed=7, longest_frames=50, release_frames=(15, 40)))
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


def test_a_recorded_pressure_is_what_drove_it_and_noise():
    trials = [replace(trial, chamber_m3=1e-3) for trial in few()]
    effects = (*campaigns.GroundTruth().effects, "reservoir_depletion")
    values = {**campaigns.damping_values(trials), "reservoir_depletion.gamma": 1.0}
    quiet = campaigns.GroundTruth(effects=effects, values=values, trace_sigma_kPa=0.0, seed=1)
    calm = campaigns.grow(trials, quiet)
    for grown in calm:
        volume = 1e-3 + math.pi * 0.012**2 * grown.true_lead_position_m
        truth = (grown.true.pressure_Pa + 101_325) * 1e-3 / volume - 101_325
        np.testing.assert_allclose(grown.track.pressure_Pa, truth, rtol=1e-9)
        assert truth[0] - truth[-1] > 1e3
    loud = campaigns.grow(trials[:1], replace(quiet, trace_sigma_kPa=0.1))[0]
    assert np.std(loud.track.pressure_Pa - calm[0].track.pressure_Pa) == pytest.approx(100, rel=0.3)


def test_what_is_written_reads_back_without_a_word(tmp_path):
    grown = campaigns.grow(few(), nature(seed=1, trace_sigma_kPa=0.05))
    campaigns.write_experiment(grown, tmp_path / "e", "chamber_l: 3.7\n")
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


def test_the_papers_nature_has_the_printed_numbers():
    """B of a printed diameter is in proportion to the wall; of the 25 mm vine it is 6.44 × ½ × (25/24)^0.75 = 3.320."""
    trials = read_experiment(PAPER).trials
    assert len(trials) == 365
    hidden = campaigns.read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    B = hidden.values["eversion_damping.B"]
    assert hidden.values["eversion_damping.n"] == 0.37
    assert set(B) == {trial.vine for trial in trials}
    assert B["12mm-100um-140mm"] == 1.83
    assert B["12mm-200um-140mm"] == pytest.approx(2 * 1.83)
    assert B["24mm-150um-280mm"] == pytest.approx(0.75 * 6.44)
    assert B["25mm-100um-400mm"] == pytest.approx(3.320, abs=5e-4)


def test_tracks_are_put_before_a_camera_on_request(tmp_path):
    filming = campaigns.make_filming({"target": {"squares": [14, 5], "square_m": 0.015, "marker_m": 0.011}})
    filmed = campaigns.recording_experiment(read_experiment(PAPER), filming, tmp_path / "filmed")
    assert [trial.name for trial in filmed.trials] == [trial.name for trial in read_experiment(PAPER).trials]
    for trial in filmed.trials:
        assert trial.video == tmp_path / "filmed" / "videos" / f"{trial.name}.mp4"
        assert trial.track is None
        assert trial.exposure_s == pytest.approx(0.1 / 1069, rel=1e-4)
    assert filmed.settings.calibration.square_mm == pytest.approx(15)
    with pytest.raises(ValueError, match="recordings already"):
        campaigns.recording_experiment(read_experiment(ROOT / "data" / "demo"), filming, tmp_path / "again")


def answer(verdict: str, *names: str, size: tuple[float, float] | None = None) -> Answer:
    sizes = {"drag.C": {"value": sum(size) / 2, "low_95": size[0], "high_95": size[1]}} if size else {}
    return Answer(verdict, names, names[:1] if verdict == "missing" else (), numbers=sizes)


@pytest.mark.parametrize(
    ("said", "should", "right", "wrong_name"),
    [
        (answer("adequate"), LENS, True, False),
        (answer("ambiguous", "lens", "latch_release"), LENS, True, False),
        (answer("missing", "latch_release"), LENS, False, True),
        (answer("adequate"), WORN, False, False),
        (answer("artefact", "drift_with_order"), WORN, True, False),
        (answer("artefact", "drift_with_order", "pressure_gain"), WORN, False, False),
        (answer("ambiguous", "drag", "inlet"), BOTH, True, False),
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


# The pictures show what the truth says, measured by area, centroid and correlation, never by a tracker.
FPS = 1000.0
CLEAN = preset("clean")
SMALL = Camera(width_px=480, height_px=128)
NO_NOISE = Sensor(noise=False, fixed_pattern=0, bit_depth=16)
EVEN = Light(vignetting=0)


def steadily(lead_m_s: float, from_s: float = 0.0):
    return lambda time_s: lead_m_s * np.clip(np.asarray(time_s) - from_s, 0, None)


def renderer(scene: Scene, motion=None, n_frames: int = 60, **settings) -> FrameRenderer:
    return FrameRenderer(scene, motion or steadily(2.0), n_frames=n_frames, capture_fps=FPS, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("exposure_s", [1e-6, 9.9e-4])
def test_tip_is_where_the_area_says_at_any_exposure(exposure_s):
    scene = replace(CLEAN, camera=SMALL)
    shots = renderer(scene, exposure_s=exposure_s)
    truth = shots.truth(np.arange(60))
    # Rows in which the tip's outline is flat, with 5 px to spare
    flat_px = scene.subject.diameter_m / 2 / SMALL.m_per_px * (1 - scene.subject.tip_roundness) - 5
    rows = slice(math.ceil(SMALL.centre_px[1] - flat_px), math.floor(SMALL.centre_px[1] + flat_px) + 1)
    for index in (3, 17, 41, 55):
        across = (shots.frame(index)[rows].astype(float).mean(axis=0) - BEHIND) / (FILM - BEHIND)
        assert 60.0 + across.sum() == pytest.approx(truth.tip_x_px[index], abs=0.01)


@pytest.mark.parametrize("angle_deg", [0, 37, 90, 215])
def test_growth_in_any_direction_adds_the_tubes_width_times_its_travel(angle_deg):
    scene = replace(CLEAN, camera=Camera(width_px=360, height_px=360), growth_angle_deg=angle_deg)
    shots = renderer(scene, exposure_s=3e-4)
    truth = shots.truth(np.array([4, 22]))
    radius_px = scene.subject.diameter_m / 2 / scene.camera.m_per_px
    early, late = (shots.frame(index).astype(float) for index in (4, 22))
    travel_px = (late - early).sum() / (FILM - BEHIND) / (2 * radius_px)
    assert travel_px == pytest.approx(np.diff(truth.lead_px)[0], abs=0.01)
    step = np.array([np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]])
    angle = math.radians(angle_deg)
    assert step == pytest.approx(np.diff(truth.lead_px)[0] * np.array([math.cos(angle), math.sin(angle)]), abs=1e-9)


def test_truth_is_in_metres_along_the_growth_and_at_mid_exposure():
    truth = renderer(replace(CLEAN, camera=SMALL), steadily(3.0, 0.01), exposure_s=4e-4).truth(np.arange(60))
    mid_s = np.arange(60) / FPS + 2e-4
    assert truth.time_s == pytest.approx(mid_s)
    assert truth.lead_position_m == pytest.approx(3.0 * np.clip(mid_s - 0.01, 0, None), abs=1e-12)
    assert truth.release_s == pytest.approx(0.01, abs=2e-4)
    assert np.diff(truth.lead_px) == pytest.approx(np.diff(truth.lead_position_m) / SMALL.m_per_px, abs=1e-9)


def test_distorted_and_tilted_tip_is_where_opencv_projects_it():
    camera = Camera(focal_px=900, k1=-0.3, k2=0.1, tilt_x_deg=6, tilt_y_deg=-9)
    scene = replace(CLEAN, camera=camera, growth_angle_deg=20)
    truth = renderer(scene).truth(np.arange(60))
    ux, uy = scene.direction
    offset_px = np.array(scene.origin) + truth.lead_px[:, None] * np.array([ux, uy]) - camera.centre_px
    about_x, _ = cv2.Rodrigues(np.radians([camera.tilt_x_deg, 0, 0]))
    about_y, _ = cv2.Rodrigues(np.radians([0, camera.tilt_y_deg, 0]))
    turn, _ = cv2.Rodrigues(about_y @ about_x)
    away_m = np.array([0, 0, camera.focal_px * camera.m_per_px])
    spatial_m = np.column_stack([offset_px * camera.m_per_px, np.zeros(len(offset_px))])
    f, (cx, cy) = camera.focal_px, camera.centre_px
    matrix = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(spatial_m, turn, away_m, matrix, np.array([camera.k1, camera.k2, 0, 0, 0]))
    assert np.column_stack([truth.tip_x_px, truth.tip_y_px]) == pytest.approx(expected[:, 0], abs=1e-6)


@pytest.mark.slow
def test_tail_moves_at_twice_the_speed_of_the_tip():
    tube = Tube(opacity=0.0, brightness=0.8, tail_opacity=0.9, tail_texture=0.4, texture=0, specular=0, tip_glow=0)
    scene = replace(CLEAN, camera=SMALL, subject=replace(tube, length_m=0.16))
    shots = renderer(scene, exposure_s=1e-6)
    truth = shots.truth(np.array([40, 41]))
    window = slice(150, 270)
    early, late = (shots.frame(index)[58:70, window].astype(np.float32) for index in (40, 41))
    (shift, _), response = cv2.phaseCorrelate(early, late, cv2.createHanningWindow((120, 12), cv2.CV_32F))
    assert response > 0.3
    assert shift == pytest.approx(2 * np.diff(truth.lead_px)[0], abs=0.3)


def test_payload_leaves_at_the_end_and_flies_on_at_the_speed_of_the_tail():
    tube = replace(CLEAN.subject, length_m=0.05, payload_diameter_m=0.008, payload_brightness=0.45)
    scene = replace(CLEAN, camera=SMALL, subject=tube)
    shots = renderer(scene, lambda t: np.minimum(2.0 * np.asarray(t), 0.05), n_frames=60, exposure_s=3e-4)
    ahead = [shots.frame(index)[:, 255:].astype(float) - BEHIND for index in (34, 38)]
    places = [(one.sum(axis=0) @ np.arange(255, 480)) / one.sum() for one in ahead]
    assert places[1] - places[0] == pytest.approx(4 * 4.0 / FPS / scene.camera.m_per_px, abs=0.02)
    assert shots.truth(np.array([40])).lead_position_m[0] == pytest.approx(0.05)


def test_evenly_bright_ball_has_its_centroid_at_the_truth():
    camera = Camera(width_px=160, height_px=400, m_per_px=1 / 3000)
    scene = replace(CLEAN, camera=camera, subject=Ball(diameter_m=0.015), growth_angle_deg=90)
    shots = renderer(scene, lambda t: 0.5 * 9.81 * np.asarray(t) ** 2, n_frames=160, exposure_s=9e-4)
    shots._subject._surface[:] = 0.9
    truth = shots.truth(np.array([130]))
    extra = shots.frame(130).astype(float) - BEHIND
    row = (extra.sum(axis=1) @ np.arange(400)) / extra.sum()
    assert row == pytest.approx(truth.tip_y_px[0] - 0.0075 * 3000, abs=0.01)


def test_door_is_closed_until_the_release_then_swings_out_of_the_way():
    scene = replace(CLEAN, door=Door(lead_s=0.0, swing_s=0.01), camera=Camera(width_px=480, height_px=256))
    shots = renderer(scene, steadily(0.05, from_s=0.02), n_frames=60)
    frames = [shots.frame(index).astype(float) for index in (2, 15, 26, 50)]
    assert (frames[0] == frames[1]).all()
    before_tip = (slice(100, 156), slice(98, 110))
    assert frames[0][before_tip].max() > 0.5 * 65535
    assert np.abs(frames[2] - frames[0]).max() > 0.3 * 65535
    assert frames[3][130:156, 112:140].max() < 0.11 * 65535  # nothing left across the path below the axis


def test_shake_moves_the_background_as_the_truth_says():
    scene = replace(preset("shake"), shake_px=0.6, sensor=NO_NOISE, light=EVEN, door=None, subject=replace(Tube()))
    shots = renderer(scene, np.zeros_like, n_frames=40)
    truth = shots.truth(np.array([3, 30]))
    window = (slice(10, 110), slice(300, 700))
    early, late = (shots.frame(index)[window].astype(np.float32) for index in (3, 30))
    _, warp = cv2.findTransformECC(early, late, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION)
    moved = np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]
    assert 1 < math.hypot(*moved) < 3
    assert warp[:, 2] == pytest.approx(moved, abs=0.02)
    assert truth.lead_position_m == pytest.approx([0, 0])


def test_noise_has_the_variance_of_shot_and_read_noise():
    sensor = Sensor(full_well_e=4000, read_noise_e=30, fixed_pattern=0, bit_depth=16)
    shots = renderer(replace(CLEAN, sensor=sensor), np.zeros_like)
    frames = np.array([shots.frame(index)[:100, 300:900] for index in range(12)]) / 65535
    expected = (0.1 * 4000 + 30**2) / 4000**2
    assert frames.mean() == pytest.approx(0.1, abs=1e-4)
    assert frames.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.01)


def test_lamps_flicker_by_what_is_left_after_the_exposure():
    light = Light(flicker=0.2, flicker_Hz=100.0, vignetting=0)
    shots = renderer(replace(CLEAN, light=light), np.zeros_like, exposure_s=9e-4, n_frames=100)
    levels = np.array([shots.frame(index)[:20, 400:].mean() for index in range(0, 100)]) / 6553.5
    spectrum = np.abs(np.fft.rfft(levels - 1)) / 50
    begin_s = np.arange(20000) * 9e-4 / 20000
    left = abs(np.exp(2j * np.pi * 100 * begin_s).mean())
    assert spectrum[10] == pytest.approx(0.2 * left, rel=1e-3)
    assert np.delete(spectrum, 10).max() < 1e-3


def test_h264_holds_every_frame_at_the_rendered_levels_in_the_limited_range(tmp_path):
    scene = replace(preset("demo"), camera=Camera(width_px=320, height_px=128), encoding=Encoding(gop=8))
    shot = {"n_frames": 24, "capture_fps": 1069.0, "seed": 7}
    truth = campaigns.render_recording(scene, steadily(2.0, 0.005), out_path=tmp_path / "trial.mp4", **shot)
    with av.open(str(tmp_path / "trial.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(60)
        frames = list(container.decode(video=0))
    assert len(frames) == truth.time_s.size == 24
    assert [index for index, frame in enumerate(frames) if frame.key_frame] == [0, 8, 16]
    levels = 16 + 219 * FrameRenderer(scene, steadily(2.0, 0.005), **shot).frame(10).astype(float) / 255
    error = frames[10].to_ndarray(format="yuv420p")[:128] - levels
    assert abs(error.mean()) < 0.2
    assert 10 * np.log10(219**2 / (error**2).mean()) > 36
