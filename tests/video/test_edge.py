"""The leading edge against the truth of recordings drawn by other code; seeds 201 and up, which tuned nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plain_scene import Plan, plain_scene, write_video

from vinetrack.core.records import FLAGS, Trial, with_flag
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.video.axis import Axis
from vinetrack.video.frames import Frames, Recording, RecordingError, Region
from vinetrack.video.point_quality import assess_points, calibrated_sigma, moving_range
from vinetrack.video.track import track_frames, track_recording

SHORT = {"width": 520, "height": 160, "from_px": (20.0, 80.0), "start_px": 50.0, "end_px": 430.0, "radius": 24.0}


def in_memory(luma, slot=None):
    n, height, width = luma.shape
    recording = Recording(path=__import__("pathlib").Path("scene.mp4"), kind="container", width=width, height=height,
                          bit_depth=8, declared_frames=n)  # fmt: skip
    slot = np.arange(n) if slot is None else slot
    return Frames(recording, Region(0, 0, width, height), luma, slot, np.zeros(n, dtype=bool))


def trial(plan, **changes):
    return Trial(name="t", capture_fps=1000.0, exposure_s=plan.exposure / 1000.0, m_per_px=1e-3, **changes)


def errors(plan, tracking, scene):
    """Tracked minus true edge of the moving frames, px, and the stated errors."""
    direction = np.array([np.cos(np.radians(plan.angle_deg)), np.sin(np.radians(plan.angle_deg))])
    origin = (np.asarray(tracking.axis.from_px) - plan.from_px) @ direction
    used = scene.moving & tracking.track.usable
    assert used.sum() == scene.moving.sum()  # no moving frame lost
    error = tracking.track.edge_px + origin - scene.edge_px
    return error[used], tracking.track.lead_position_sigma_m[used] * 1e3


def tracked(**changes):
    plan = Plan(**{**SHORT, **changes})
    scene = plain_scene(plan)
    return plan, scene, track_frames(in_memory(scene.frames), trial(plan), 1000.0)


@pytest.mark.parametrize(
    ("name", "changes", "sd_px", "bias_px"),
    [
        ("bright tube", {}, 0.12, 0.15),
        ("dark tube", {"film": 15.0}, 0.2, 0.3),
        ("door", {"door": True}, 0.15, 0.2),
        ("flicker", {"flicker": 0.06}, 0.15, 0.2),
        ("low contrast", {"film": 100.0, "wall_sd": 4.0, "tail_sd": 3.0}, 0.2, 0.25),
        ("half-frame exposure", {"speed": 30.0, "exposure": 0.5, "rise_frames": 4.0}, 0.3, 0.35),
        ("sway", {"wobble": 2.0}, 0.15, 0.2),
        ("payload flies ahead", {"payload": True}, 0.15, 0.2),
        ("contrast changes sign", {"gradient": 110.0, "film": 125.0}, 0.5, 0.5),
        ("no rest at the start", {"rest_frames": 0}, 0.15, 0.2),
    ],
)
def test_edge_of(name, changes, sd_px, bias_px):
    del name
    plan, scene, tracking = tracked(seed=201, **changes)
    error, stated = errors(plan, tracking, scene)
    assert error.std() < sd_px
    assert abs(error.mean()) < bias_px
    assert 0.5 < error.std() / np.sqrt(np.mean(stated**2)) < 2.0


@pytest.mark.parametrize("angle", [90.0, 180.0, 200.0])
def test_edge_in_any_direction_of_growth(angle):
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    start = np.array([210.0, 210.0]) - 180 * direction
    plan, scene, tracking = tracked(
        seed=202, width=420, height=420, from_px=tuple(start), angle_deg=angle, end_px=320.0, radius=18.0, tip_depth=5.0
    )
    error, _ = errors(plan, tracking, scene)
    assert error.std() < 0.2
    assert abs(error.mean()) < 0.3


def test_a_given_axis_two_degrees_off_is_centred():
    plan = Plan(seed=203, **SHORT)
    scene = plain_scene(plan)
    tilt = np.tan(np.radians(2.0)) * 470
    axis = Axis((20.0, 80.0 - tilt / 2), (490.0, 80.0 + tilt / 2), 48.0)
    tracking = track_frames(in_memory(scene.frames), trial(plan), 1000.0, axis)
    assert abs(tracking.axis.direction[1]) < 0.01
    error, _ = errors(plan, tracking, scene)
    assert error.std() < 0.2


def test_compressed_as_cameras_do(tmp_path):
    plan = Plan(seed=204, **SHORT)
    scene = plain_scene(plan)
    path = write_video(tmp_path / "a.mp4", scene.frames, bit_rate=6_000_000)
    tracking = track_recording(trial(plan, video=path))
    error, stated = errors(plan, tracking, scene)
    assert error.std() < 0.2
    assert 0.5 < error.std() / np.sqrt(np.mean(stated**2)) < 2.0
    assert tracking.kymograph.shape[0] == len(scene.frames)
    assert len(tracking.pictures) == 3


def test_sixteen_bit_frames_give_the_same_track():
    plan = Plan(seed=205, **SHORT)
    scene = plain_scene(plan)
    eight = track_frames(in_memory(scene.frames), trial(plan), 1000.0).track.edge_px
    deep = track_frames(in_memory(scene.frames.astype(np.uint16) * 257), trial(plan), 1000.0).track.edge_px
    assert np.abs(deep - eight)[scene.moving].max() < 0.1


def test_time_is_mid_exposure_and_flags_are_known():
    plan, scene, tracking = tracked(seed=206)
    track = tracking.track
    assert track.time_s[0] == pytest.approx(plan.exposure / 2000)
    assert np.diff(track.time_s) == pytest.approx(np.full(len(track.time_s) - 1, 1e-3))
    assert all(part in FLAGS for flag in track.flag for part in flag.split(";") if part)
    assert all("before_release" in flag for flag in track.flag[: plan.rest_frames - 1])
    assert all("after_end" in flag for flag in track.flag[-plan.end_frames + 2 :])
    assert not any("before_release" in f or "after_end" in f for f in track.flag[scene.moving][3:])


def test_growth_out_of_the_picture_ends_the_track_with_a_note():
    plan = Plan(**{**SHORT, "seed": 207, "end_px": 620.0})
    scene = plain_scene(plan)
    track = track_frames(in_memory(scene.frames), trial(plan), 1000.0).track
    assert any("leaves the picture" in note for note in track.notes)
    assert all("after_end" in flag for flag in track.flag[-plan.end_frames :])
    inside = scene.moving & (scene.edge_px < 450)
    assert track.usable[inside].all()


@pytest.mark.parametrize("speed", [6.0, 20.0])
def test_a_recording_that_ends_in_motion_says_how_far_the_vine_had_grown(speed):
    plan = Plan(**{**SHORT, "seed": 213, "speed": speed})
    scene = plain_scene(plan)
    count = int(np.argmax(scene.edge_px > 300))
    tracking = track_frames(in_memory(scene.frames[:count]), trial(plan, length_m=0.38), 1000.0)
    said = [note for note in tracking.track.notes if "ends while the leading edge moves" in note]
    grown = (scene.edge_px[count - 1] - plan.start_px) / 380
    assert len(said) == 1
    assert f"after {grown:.0%} of the vine's length" in said[0]
    by_hand = trial(plan, length_m=0.38, frames_used=(0, count - 1))
    notes = track_frames(in_memory(scene.frames[:count]), by_hand, 1000.0).track.notes
    assert not any("ends while" in note for note in notes)


@pytest.mark.parametrize("speed", [6.0, 20.0])
def test_two_frames_of_rest_at_the_end_are_not_growth(speed):
    plan = Plan(**{**SHORT, "seed": 214, "speed": speed, "end_px": 330.0})
    scene = plain_scene(plan)
    count = int(np.flatnonzero(scene.moving)[-1]) + 3
    track = track_frames(in_memory(scene.frames[:count]), trial(plan), 1000.0).track
    assert not with_flag(track.flag, "after_end")[: count - 2].any()
    assert with_flag(track.flag, "after_end")[count - 2 :].all()
    assert not any("ends while" in note for note in track.notes)


def test_a_pause_of_one_frame_in_slow_growth_is_not_a_stop():
    edge = np.concatenate([np.full(8, 50.0), 50 + 1.0 * np.arange(1, 30), [79.0]])
    assert moving_range(edge, np.full(edge.size, 0.05)) == (8, edge.size - 1)


def test_a_still_recording_is_refused():
    plan = Plan(seed=208, **SHORT)
    still = np.repeat(plain_scene(plan).frames[:1], 20, axis=0)
    with pytest.raises(RecordingError, match="nothing moves"):
        track_frames(in_memory(still), trial(plan), 1000.0)


def test_too_few_frames_are_refused():
    plan = Plan(seed=209, **SHORT)
    with pytest.raises(RecordingError, match="only 4 frames"):
        track_frames(in_memory(plain_scene(plan).frames[:4]), trial(plan), 1000.0)


def test_capture_rate_must_come_from_the_user(tmp_path):
    path = write_video(tmp_path / "a.mp4", np.zeros((8, 64, 96), np.uint8))
    with pytest.raises(RecordingError, match="capture_fps is missing"):
        track_recording(Trial(name="t", video=path))


def test_a_wrong_second_frame_is_rejected():
    plan = Plan(seed=210, **SHORT)
    scene = plain_scene(plan)
    luma = scene.frames.copy()
    luma[1] = scene.frames[-3]
    track = track_frames(in_memory(luma), trial(plan), 1000.0).track
    assert track.flag[1] == "rejected"
    assert np.isnan(track.edge_px[1])
    assert any("unlike all others" in note for note in track.notes)
    assert not with_flag(track.flag, "gap").any()


def test_a_repeated_frame_is_dropped_and_the_times_stay():
    plan = Plan(seed=211, **SHORT)
    scene = plain_scene(plan)
    luma = scene.frames.copy()
    luma[25] = luma[24]
    track = track_frames(in_memory(luma), trial(plan), 1000.0).track
    assert "duplicate" in track.flag[25]
    assert [i for i, flag in enumerate(track.flag) if "duplicate" in flag] == [25]
    assert track.time_s[26] - track.time_s[24] == pytest.approx(2e-3)


def test_a_missing_frame_is_flagged_and_the_times_are_corrected():
    plan = Plan(seed=212, **SHORT)
    scene = plain_scene(plan)
    track = track_frames(in_memory(np.delete(scene.frames, 26, axis=0)), trial(plan), 1000.0).track
    assert track.flag[26] == "gap;retimed"
    assert track.time_s[26] - track.time_s[25] == pytest.approx(2e-3)
    assert track.time_s[27] - track.time_s[26] == pytest.approx(1e-3)
    told = [note for note in correct_frames(track).notes if "missing" in note]
    assert told == ["1 frame is missing before frame 26 (the step there is too long): later times moved on"]


def test_frames_in_notes_are_those_of_the_recording():
    plan = Plan(seed=212, **SHORT)
    scene = plain_scene(plan)
    late = replace(trial(plan), frames_used=(5, len(scene.frames) - 2))
    track = track_frames(in_memory(np.delete(scene.frames, 26, axis=0)), late, 1000.0).track
    assert track.flag[26] == "gap;retimed"
    assert any("missing before frame 26 " in note for note in track.notes)


def test_stated_errors_follow_the_roughness():
    rng = np.random.default_rng(213)
    noise = rng.normal(0, 0.5, 400)
    position = 0.02 * np.arange(400.0) ** 2 + noise
    scaled = calibrated_sigma(position, np.full(400, 0.2), np.ones(400, dtype=bool))
    assert scaled.mean() == pytest.approx(0.5, rel=0.15)


def test_moving_range_of_rest_run_and_rest():
    edge = np.concatenate([np.full(10, 5.0), 5 + 3.0 * np.arange(1, 21), np.full(8, 65.0)])
    assert moving_range(edge, np.full(38, 0.1)) == (10, 28)


def test_a_lost_point_among_moving_ones_is_flagged():
    edge = np.concatenate([np.full(5, 5.0), 5 + 3.0 * np.arange(1, 21), np.full(5, 65.0)])
    edge[12] = np.nan
    nothing = np.zeros(30, dtype=bool)
    masks = {"unsure": nothing, "repeated": nothing}
    verdict = assess_points(edge, np.full(30, 0.1), np.arange(30), np.arange(30), **masks, end_px=99)
    assert verdict.flag[12] == "lost"
    assert any("lost in 1 moving frames" in note for note in verdict.notes)
