"""Clips, strips and the histogram within a pixel: every edge at its position and in its colour."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text
from plain_scene import Plan, plain_scene

from vinetrack.core.records import Correction, Track, Trial, hand_corrected
from vinetrack.figures.overlay import (
    AFTER,
    BEFORE,
    TRACKED,
    ClipView,
    Edge,
    compose,
    draw_pixel_places,
    draw_strip,
    levels,
    periodic_error,
    subpixel_positions,
)
from vinetrack.figures.style import render
from vinetrack.report.section import inline_picture
from vinetrack.video.axis import Axis
from vinetrack.video.frames import Frames, Recording
from vinetrack.video.track import Tracking, track_frames

# Frames of a clip: every edge at its position and in its colour, with scale, time and names.


SIZE = (640, 200)


def rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def view(axis: Axis | None = None, width_px: int = 640) -> ClipView:
    return ClipView("a", axis or Axis((20.0, 100.0), (620.0, 100.0)), 40.0, SIZE, 0.25, 30.0, width_px)


def edges(tracked: float = 200.0, before: float = 300.0, after: float = 210.0) -> list[Edge]:
    return [
        Edge("tracked edge", TRACKED, np.array([math.nan, tracked])),
        Edge("initial model", BEFORE, np.array([0.0, before]), np.array([0.0, 25.0])),
        Edge("with air drag", AFTER, np.array([0.0, after]), np.array([0.0, math.nan])),
    ]


def columns_of(picture: np.ndarray, colour: str, height: int = SIZE[1]) -> np.ndarray:
    """Columns of the picture, without the bar above it, in which a colour stands."""
    return np.flatnonzero((picture[-height:] == rgb(colour)).all(axis=2).any(axis=0))


def grey() -> np.ndarray:
    return np.full(SIZE[::-1], 90, np.uint8)


def test_each_edge_stands_where_it_is_along_the_axis() -> None:
    picture = compose(view(), grey(), 1, 12.0, edges())
    for colour, place in ((TRACKED, 220), (BEFORE, 320), (AFTER, 230)):
        assert np.mean(columns_of(picture, colour)) == pytest.approx(place, abs=1)


def test_an_edge_that_was_not_seen_is_not_drawn() -> None:
    picture = compose(view(), grey(), 0, 0.0, edges())
    assert not columns_of(picture, TRACKED).size
    assert columns_of(picture, BEFORE).size


def test_places_scale_with_the_size_of_the_clip() -> None:
    picture = compose(view(width_px=960), grey(), 1, 0.0, edges())
    assert picture.shape[1] == 960
    assert np.mean(columns_of(picture, BEFORE, 300)) == pytest.approx(320.5 * 1.5 - 0.5, abs=1)


def test_an_axis_down_the_picture_has_its_edges_across_it() -> None:
    down = ClipView("a", Axis((100.0, 10.0), (100.0, 190.0)), 40.0, (200, 200), 0.25, 30.0, 200)
    picture = compose(down, np.full((200, 200), 90, np.uint8), 1, 0.0, edges(90, 140, 60))
    rows = np.flatnonzero((picture[-200:] == rgb(TRACKED)).all(axis=2).any(axis=1))
    assert np.mean(rows) == pytest.approx(100, abs=1)


def test_the_scale_bar_has_the_length_it_names() -> None:
    picture = compose(view(), grey(), 1, 0.0, [])
    white = (picture[-SIZE[1] :] == 255).all(axis=2)
    longest = max(int(row.sum()) for row in white)
    # A sixth of 640 px is 26.7 mm; the round length below it is 20 mm, or 80 px.
    assert longest == pytest.approx(80, abs=2)


def test_grey_levels_are_stretched_and_clipped() -> None:
    assert levels(np.array([[10, 60, 110, 200]], np.uint16), 10, 110).tolist() == [[0, 128, 255, 255]]


# The strip of a recording, from arrays written by hand: position of the edge, and marks of flagged frames.


N = 40


def tracking(n_along: int = 300, height: int = 60) -> Tracking:
    """An edge at 10 px a frame from frame 10 on; frame 20 is lost, frame 30 doubtful."""
    flag = np.array(["before_release"] * 10 + [""] * 30, dtype="<U64")
    flag[20], flag[30] = "lost", "doubtful;gap"
    edge = np.maximum(np.arange(N) - 10, 0) * 7.0 + 20
    edge[20] = np.nan
    kymograph = np.where(np.arange(n_along)[None] < np.nan_to_num(edge)[:, None], 40, 180).astype(np.float32)
    picture = np.full((height, n_along), 128, np.uint8)
    track = Track(np.arange(N) / 1000, edge * 1e-3, np.full(N, 1e-5), flag, edge)
    pictures = ((10, picture), (25, picture), (39, picture))
    return Tracking(track, Axis((0.0, 30.0), (n_along - 1.0, 30.0), 20.0), kymograph, pictures, 1.0, 0.1, np.zeros(N))


def test_the_edge_and_flagged_frames_are_counted_apart() -> None:
    kymograph = draw_strip("a", tracking(), 1e-3).axes[0]
    labels = [line.get_label() for line in kymograph.lines]
    assert labels == ["leading edge, N = 38", "flagged, N = 2"]
    crosses = kymograph.lines[1]
    assert crosses.get_xdata().tolist() == [160.0]
    assert crosses.get_ydata() == pytest.approx([30.0])


def test_each_frame_shows_the_edge_across_the_axis_where_it_was() -> None:
    frames = draw_strip("a", tracking(), 1e-3).axes[2:]
    titles = [ax.get_title(loc="left") for ax in frames]
    assert titles == ["frame 10, 10.0 ms", "frame 25, 25.0 ms", "frame 39, 39.0 ms"]
    for ax, at in zip(frames, (20, 125, 223), strict=True):
        (line,) = ax.lines
        assert line.get_xdata() == pytest.approx([at, at])
        assert sorted(line.get_ydata()) == pytest.approx([15, 45])


def test_a_strip_is_small_in_a_page() -> None:
    body = inline_picture(render(draw_strip("a", tracking(900, 320), 1e-3), ["svg"])["svg"].decode(), "p", "strip")
    assert len(body) < 60_000
    assert "matrix(" in body


# Pixel locking is distinguished from a uniform distribution of edges within a pixel.


def places(amplitude_px: float, count: int = 4000, seed: int = 971) -> np.ndarray:
    """Edges anywhere, estimated with an error that repeats with every pixel."""
    edge = np.random.default_rng(seed).uniform(0, 500, count)
    return np.mod(edge - amplitude_px * np.sin(2 * np.pi * edge), 1.0)


@pytest.mark.parametrize("amplitude_px", [0.02, 0.05, 0.1])
def test_the_amplitude_of_a_periodic_error_is_found(amplitude_px: float) -> None:
    found, chance = periodic_error(places(amplitude_px))
    assert found == pytest.approx(amplitude_px, abs=1.5 * chance)
    assert chance == pytest.approx(math.sqrt(math.log(20) / 4000) / math.pi)


def test_edges_that_fall_anywhere_exceed_chance_once_in_twenty() -> None:
    above = [np.greater(*periodic_error(places(0.0, 500, seed))) for seed in range(3000, 3400)]
    assert 8 <= sum(above) <= 34  # 20 expected, binomial to three standard deviations


def test_only_sound_moving_frames_of_recordings_count() -> None:
    filmed = pd.DataFrame(
        {"edge_px": [10.25, 11.5, 12.75, np.nan, 14.0], "flag": ["", np.nan, "doubtful", "lost", "after_end"]}
    )
    elsewhere = pd.DataFrame({"edge_px": [np.nan, np.nan], "flag": [np.nan, np.nan]})
    assert subpixel_positions({"a": filmed, "b": elsewhere}).tolist() == [0.25, 0.5]
    assert len(subpixel_positions({})) == 0


@pytest.mark.parametrize(("amplitude_px", "words"), [(0.1, "more than chance"), (0.0, "no more than chance")])
def test_the_histogram_holds_every_edge_and_says_what_it_shows(amplitude_px: float, words: str) -> None:
    figure = draw_pixel_places(places(amplitude_px, 600, seed=972))
    (ax,) = figure.axes
    assert sum(bar.get_height() for bar in ax.patches[:10]) == 600
    said = " ".join(text.get_text() for text in figure.findobj(Text)).replace("\n", " ")
    assert f"px, {words}" in said
    assert "N = 600 frames" in said


# Points corrected by hand are marked in the figures that show points.


@pytest.fixture(scope="module")
def tracking_points() -> Tracking:
    from pathlib import Path

    luma = plain_scene(
        Plan(width=480, height=160, from_px=(20, 80), start_px=40, end_px=400, speed=14, radius=20)
    ).frames
    recording = Recording(Path("a.mp4"), "container", 480, 160, 8, len(luma))
    frames = Frames(recording, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))
    given = (Correction(20, "move", 150.0), Correction(22, "confirm"))
    return track_frames(frames, Trial(name="a", capture_fps=1000.0, m_per_px=2.5e-4, corrections=given), 1000.0)


def words(tracking_points: Tracking) -> str:
    figure = draw_strip("a", tracking_points, 2.5e-4)
    return " ".join(text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text")))


def test_the_strip_says_how_many_points_were_corrected(tracking_points: Tracking) -> None:
    assert "corrected by hand, N = 2" in words(tracking_points)


def test_a_corrected_time_does_not_count_as_a_point_corrected_by_hand() -> None:
    flags = ["corrected", "gap;retimed", "", "rejected;corrected", "corrected;gap;retimed"]
    assert list(hand_corrected(flags)) == [True, False, False, True, True]
