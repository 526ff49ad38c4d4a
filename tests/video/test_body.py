"""A body registered against itself: a disc drawn at known places, bright, dark on dark, falling with known g."""

import cv2
import numpy as np
import pytest
from pictures import in_memory

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.body import hops_between_bodies
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


BALL = Trial(name="ball", capture_fps=RATE, m_per_px=0.5e-3, travel_ratio=1)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_neighbour_in_a_wide_strip_is_not_followed():
    """Another disc, 60 px beside the first, falls later: the wide axis drawn by hand along the first holds both."""
    frames, row = falling_disc(305)
    other, _ = falling_disc(306, rest=40)
    both = np.concatenate([frames[:, :, 30:130], other[:, :, 50:110]], axis=2)
    track = track_frames(in_memory(both), BALL, RATE, Axis((54.0, 0.0), (50.0, 419.0), 120.0)).track
    used = track.usable & (row > 90) & (row < 340)
    assert used.sum() > 70
    assert (track.edge_px[used] - row[used]).std() < 0.15


@pytest.mark.slow
def test_a_bounce_ends_the_track():
    frames, row = falling_disc(307, n=185)
    impact = int(np.argmax(row > 340))
    there_and_back = np.concatenate([frames[: impact + 1], frames[impact - 1 : 90 : -1]])
    track = track_frames(in_memory(there_and_back), BALL, RATE).track
    assert not track.usable[impact + 2 :].any()
    assert all("after_end" in flag for flag in track.flag[impact + 2 :])
    assert not any("gap" in flag for flag in track.flag)
    used = np.flatnonzero(track.usable & (np.arange(len(track.flag)) > 60))
    assert np.abs(track.edge_px[used] - row[used]).max() < 1


def test_places_that_hop_between_bodies_are_refused():
    fall, seen = 0.3 * np.arange(30.0) ** 2, np.ones(40, dtype=bool)
    assert not hops_between_bodies(fall + np.random.default_rng(309).normal(0, 0.1, 30), seen[:30])
    turns = np.random.default_rng(310).random(30) < 0.5
    assert hops_between_bodies(np.where(turns, fall + 25, fall), seen[:30])
    for stops_or_bounces in (np.minimum(9 * np.arange(40.0), 180), 180 - np.abs(9 * np.arange(40.0) - 180)):
        assert not hops_between_bodies(stops_or_bounces, seen)


@pytest.mark.slow
def test_a_body_that_disappears_is_lost():
    frames, _ = falling_disc(308, n=150)
    empty = np.concatenate([frames[:60, 210:], frames[:60, 210:]], axis=1)[:, : SHAPE[0]]
    track = track_frames(in_memory(np.concatenate([frames, empty, empty])), BALL, RATE).track
    assert track.usable[60:145].all()
    assert not track.usable[151:].any()


@pytest.mark.slow
def test_body_that_leaves_the_picture_ends_the_track():
    frames, row = falling_disc(303, n=215)
    track = track_frames(in_memory(frames), BALL, RATE).track
    assert "after_end" in track.flag[-1]
    assert track.usable[(row > 90) & (row < 350)].all()
