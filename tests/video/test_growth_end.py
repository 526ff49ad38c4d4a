"""Where growth ends when a payload flies on, on strips and recordings drawn here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_scene import Plan, plain_scene

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.frames import Frames, Recording, Region
from vinetrack.video.point_quality import growth_end
from vinetrack.video.strip import Strip
from vinetrack.video.track import track_frames

END_PX, SPEED = 200, 5.0


def grown(flies, rows=40, columns=330, n=60, flight=2.0):
    """Film of brightness 160 on 60 that stops at END_PX; a dark body 24 px long leaves it at `flight` times the speed.

    At twice the speed, that of the tail, it comes out bit by bit; a slower one has come out whole a frame later.
    """
    rng = np.random.default_rng(301)
    time = np.arange(n, dtype=float)
    edge = np.minimum(20 + SPEED * time, END_PX)
    end = (END_PX - 20) / SPEED
    out = 0.0 if flight > 1.5 else 24.0
    body = np.where(time > end, END_PX + out + flight * SPEED * (time - end), -100.0)
    background, film = rng.normal(60, 6, (rows, columns)), rng.normal(160, 8, (rows, columns))
    s = np.arange(columns)
    values = np.where(s < edge[:, None, None], film, background)
    if flies:
        values = np.where((np.abs(s - body[:, None, None] + 12) < 12) & (s >= END_PX), 15.0, values)
    values = values + rng.normal(0, 2, values.shape)
    strip = Strip(
        np.clip(values, 0, 255).astype(np.uint8), np.ones(n), np.zeros(n), np.zeros((n, 2)), 2.0,
        Axis((0.0, 0.0), (columns - 1.0, 0.0), float(rows)), False,
    )  # fmt: skip
    return strip, np.minimum(np.maximum(edge, body) if flies else edge, columns)


@pytest.mark.parametrize("flight", [2.0, 1.0, 0.5])
def test_a_payload_that_flies_on_ends_growth(flight):
    strip, path = grown(flies=True, flight=flight)
    assert abs(growth_end(strip, path, (20, int(path[-1]))) - END_PX) <= 3


def test_a_payload_that_flies_on_over_lengths_of_the_tube_ends_growth():
    strip, path = grown(flies=True, columns=1000, n=120)
    assert path[-1] > 900
    assert abs(growth_end(strip, path, (20, int(path[-1]))) - END_PX) <= 3


def test_film_that_stays_ends_where_the_path_does():
    strip, path = grown(flies=False)
    assert growth_end(strip, path, (20, END_PX)) == END_PX


def test_accelerating_growth_is_not_a_flying_payload():
    strip, path = grown(flies=False)
    time = np.arange(len(path), dtype=float)
    quick = np.minimum(20 + 0.0513 * time**2, END_PX)
    s = np.arange(strip.values.shape[2])
    film = strip.values[-1]
    values = np.where(s < quick[:, None, None], film, strip.values[0][:, ::-1])
    faster = Strip(values, strip.scale, strip.offset, strip.shift_px, strip.noise, strip.axis, False)
    assert growth_end(faster, quick, (20, int(quick[-1]))) == int(quick[-1])


@pytest.mark.parametrize("flight", [2.0, 1.0])
def test_a_track_does_not_follow_the_payload(flight):
    plan = Plan(seed=302, width=520, height=160, from_px=(20.0, 80.0), start_px=50.0, end_px=330.0, radius=24.0)
    scene = plain_scene(plan)
    luma = scene.frames.copy()
    last = int(np.flatnonzero(scene.moving)[-1])
    speed = scene.edge_px[last - 1] - scene.edge_px[last - 2]
    for t in range(last - 1, len(luma)):
        x = plan.from_px[0] + plan.end_px + (28 if flight < 2 else 0) + flight * speed * (t - last + 1)
        disc = cv2.circle(np.zeros_like(luma[t], np.float32), (round(x), 80), 14, 1.0, -1, cv2.LINE_AA)
        luma[t] = np.rint(luma[t] * (1 - disc) + 12 * disc).astype(np.uint8)
    n, height, width = luma.shape
    recording = Recording(Path("scene.mp4"), "container", width, height, 8, n)
    frames = Frames(recording, Region(0, 0, width, height), luma, np.arange(n), np.zeros(n, dtype=bool))
    trial = Trial(name="t", capture_fps=1000.0, exposure_s=plan.exposure / 1000.0, m_per_px=1e-3)
    tracking = track_frames(frames, trial, 1000.0)
    track = tracking.track
    error = track.edge_px + tracking.axis.from_px[0] - plan.from_px[0] - scene.edge_px
    assert np.abs(error[track.usable]).max() < 2.0
    assert all("after_end" in flag for flag in track.flag[last + 2 :])
    assert not any("missing" in note for note in track.notes)
