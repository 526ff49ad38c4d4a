"""A body registered against itself: a disc drawn at known places, bright, dark on dark, falling with known g."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.body import hops_between_bodies, track_body
from vinetrack.video.frames import Frames, Recording, RecordingError, Region
from vinetrack.video.strip import cut_strip
from vinetrack.video.track import track_frames

RATE = 1000.0
G_PX = 9.81 / 0.5e-3 / RATE**2  # px a frame², at 0.5 mm a pixel
SHAPE = (420, 160)


def falling_disc(seed, body=150.0, back=70.0, marks=25.0, rest=8, n=185):
    """Frames (n, height, width), uint8, of a marked disc falling from rest, and its true row (n,)."""
    rng = np.random.default_rng(seed)
    backdrop = back + cv2.GaussianBlur(rng.standard_normal(SHAPE).astype(np.float32), (0, 0), 3) * 40
    pattern = cv2.GaussianBlur(rng.standard_normal((61, 61)).astype(np.float32), (0, 0), 3)
    pattern = marks * pattern / pattern.std()
    t = np.clip(np.arange(n) - rest, 0, None)
    row = 50 + 0.5 * G_PX * t**2
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    frames = np.empty((n, *SHAPE), np.uint8)
    for i in range(n):
        distance = np.hypot(y - row[i], x - 80)
        cover = np.clip(24 - distance + 0.5, 0, 1)
        matrix = np.array([[1, 0, 80 - 30], [0, 1, row[i] - 30]], np.float32)
        drawn = cv2.warpAffine(pattern, matrix, SHAPE[::-1], flags=cv2.INTER_CUBIC)
        picture = cv2.GaussianBlur(backdrop + cover * (body + drawn - backdrop), (0, 0), 0.8)
        frames[i] = np.clip(np.rint(picture + rng.normal(0, 2, SHAPE)), 0, 255)
    return frames, row


def in_memory(luma):
    recording = Recording(Path("fall.mp4"), "container", luma.shape[2], luma.shape[1], 8, len(luma))
    return Frames(recording, recording.whole, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))


BALL = Trial(name="ball", capture_fps=RATE, m_per_px=0.5e-3, travel_ratio=1)


@pytest.mark.parametrize(("body", "back"), [(150.0, 70.0), (60.0, 55.0)], ids=["bright", "dark on dark"])
def test_falling_disc(body, back):
    frames, row = falling_disc(301, body, back)
    track = track_frames(in_memory(frames), BALL, RATE).track
    used = track.usable & (row > 90) & (row < 340)
    error = track.edge_px[used] - row[used]
    assert used.sum() > 70
    assert error.std() < 0.12
    fall = np.polyfit(track.time_s[used], track.lead_position_m[used], 2)
    assert 2 * fall[0] == pytest.approx(9.81, rel=0.01)


def test_a_neighbour_in_a_wide_strip_is_not_followed():
    """Another disc, 60 px beside the first, falls later: the wide axis drawn by hand along the first holds both."""
    frames, row = falling_disc(305)
    other, _ = falling_disc(306, rest=40)
    both = np.concatenate([frames[:, :, 30:130], other[:, :, 50:110]], axis=2)
    track = track_frames(in_memory(both), BALL, RATE, Axis((54.0, 0.0), (50.0, 419.0), 120.0)).track
    used = track.usable & (row > 90) & (row < 340)
    assert used.sum() > 70
    assert (track.edge_px[used] - row[used]).std() < 0.15


def test_a_bounce_ends_the_track():
    frames, row = falling_disc(307, n=185)
    impact = int(np.argmax(row > 340))
    there_and_back = np.concatenate([frames[: impact + 1], frames[impact - 1 : 90 : -1]])
    track = track_frames(in_memory(there_and_back), BALL, RATE).track
    assert not track.usable[impact + 2 :].any()
    assert all("after_end" in flag for flag in track.flag[impact + 2 :])
    assert not any("gap" in flag for flag in track.flag)
    assert any("turns back" in note for note in track.notes)
    used = np.flatnonzero(track.usable & (np.arange(len(track.flag)) > 60))
    assert np.abs(track.edge_px[used] - row[used]).max() < 1


def test_the_note_on_a_body_end_names_the_frame_of_the_recording():
    frames, row = falling_disc(307, n=185)
    impact = int(np.argmax(row > 340))
    there_and_back = np.concatenate([frames[: impact + 1], frames[impact - 1 : 90 : -1]])
    later = replace(BALL, frames_used=(20, len(there_and_back) - 1))
    notes = track_frames(in_memory(there_and_back), later, RATE).track.notes
    assert any(f"turns back after frame {impact}:" in note for note in notes)


def test_places_that_hop_between_bodies_are_refused():
    number = np.arange(30.0)
    seen = np.ones(30, dtype=bool)
    fall = 0.3 * number**2
    assert not hops_between_bodies(fall + np.random.default_rng(309).normal(0, 0.1, 30), seen)
    neighbour = fall + 25
    turns = np.random.default_rng(310).random(30) < 0.5
    assert hops_between_bodies(np.where(turns, neighbour, fall), seen)


def test_a_bounce_or_a_stop_is_not_a_hop():
    number = np.arange(40.0)
    seen = np.ones(40, dtype=bool)
    assert not hops_between_bodies(np.minimum(9 * number, 180), seen)
    assert not hops_between_bodies(180 - np.abs(9 * number - 180), seen)


def tipping_block(seed, spin_deg, n=130):
    """A marked block that slides, tips over at column 330 and falls out of the picture; its column, and its angle."""
    rng = np.random.default_rng(seed)
    shape = (160, 520)
    backdrop = 70 + cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 3) * 40
    marks = cv2.GaussianBlur(rng.standard_normal((34, 60)).astype(np.float32), (0, 0), 3)
    drawn, cover = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    drawn[63:97, 30:90], cover[63:97, 30:90] = 165 + 25 * marks / marks.std(), 1
    column = 60 + 0.06 * np.clip(np.arange(n) - 10, 0, None) ** 2
    beyond = np.clip(np.arange(n) - int(np.argmax(column > 330)), 0, None)
    frames = np.empty((n, *shape), np.uint8)
    for i in range(n):
        turn = cv2.getRotationMatrix2D((60, 80), -spin_deg * float(beyond[i]), 1.0)
        turn[:, 2] += column[i] - 60, 0.15 * beyond[i] ** 2
        here = cv2.warpAffine(cover, turn, shape[::-1])
        picture = backdrop * (1 - here) + cv2.warpAffine(drawn, turn, shape[::-1])
        picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 2, shape)
        frames[i] = np.clip(np.rint(picture), 0, 255)
    return frames, column, spin_deg * beyond


def test_a_block_that_tips_over_ends_its_motion():
    frames, column, angle_deg = tipping_block(311, 6.0)
    track = track_frames(in_memory(frames), BALL, RATE).track
    sliding = (angle_deg == 0) & (column > 70)
    assert track.usable[sliding].all()
    assert (track.edge_px - column)[sliding].std() < 0.15
    assert not track.usable[angle_deg > 45].any()
    assert any("not recognised after frame" in note for note in track.notes)


def test_a_body_that_disappears_is_lost():
    """Taken away in mid-fall: nothing that remains is followed in its place."""
    frames, _ = falling_disc(308, n=185)
    empty = np.concatenate([frames[:60, 210:], frames[:60, 210:]], axis=1)[:, : SHAPE[0]]
    gone = np.concatenate([frames[:150], empty, empty])
    track = track_frames(in_memory(gone), BALL, RATE).track
    assert track.usable[60:145].all()
    assert not track.usable[151:].any()
    assert any("not recognised after frame" in note for note in track.notes)


def test_body_strip_directly_along_a_given_axis():
    frames, row = falling_disc(302)
    strip = cut_strip(frames, Axis((80.0, 0.0), (80.0, 419.0), 48.0), 40)
    fit = track_body(strip)
    inside = ~fit.unsure
    assert inside.sum() > 120
    assert (fit.position_px - row)[inside].std() < 0.12
    assert np.abs(np.median(fit.across_px)) < 1.0


def test_body_that_leaves_the_picture_ends_the_track():
    frames, row = falling_disc(303, n=215)
    track = track_frames(in_memory(frames), BALL, RATE).track
    assert any("leaves the picture" in note for note in track.notes)
    assert "after_end" in track.flag[-1]
    assert track.usable[(row > 90) & (row < 350)].all()


def test_a_recording_without_motion_is_refused():
    frames, _ = falling_disc(304, n=12, rest=20)
    strip = cut_strip(np.repeat(frames[:1], 12, axis=0), Axis((80.0, 0.0), (80.0, 419.0), 48.0), 40)
    with pytest.raises(RecordingError, match="nothing moves"):
        track_body(strip)


def test_region_of_a_recording_is_its_whole_picture():
    assert in_memory(np.zeros((3, 20, 30), np.uint8)).region == Region(0, 0, 30, 20)
