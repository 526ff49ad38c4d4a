"""Clips, strips and the histogram within a pixel: every edge at its position and in its colour."""

import math

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from vinetrack.core.records import Track
from vinetrack.figures import overlay
from vinetrack.figures.overlay import AFTER, BEFORE, TRACKED, draw_strip, periodic_error
from vinetrack.figures.style import render
from vinetrack.report.build import inline_picture
from vinetrack.video.axis import Axis
from vinetrack.video.track import Tracking


def rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


EDGES = [
    overlay.Edge("tracked edge", TRACKED, np.array([math.nan, 200.0])),
    overlay.Edge("initial model", BEFORE, np.array([0.0, 300.0]), np.array([0.0, 25.0])),
    overlay.Edge("with air drag", AFTER, np.array([0.0, 210.0]), np.array([0.0, math.nan])),
]


@pytest.mark.parametrize(
    ("axis", "size", "width_px"),
    [
        (Axis((20.0, 100.0), (620.0, 100.0)), (640, 200), 640),
        (Axis((20.0, 100.0), (620.0, 100.0)), (640, 200), 960),
        (Axis((100.0, 20.0), (100.0, 620.0)), (200, 640), 200),
    ],
    ids=["along", "larger", "down"],
)
def test_each_edge_stands_where_it_is_along_the_axis_with_a_scale_bar_of_the_length_it_names(axis, size, width_px):
    view, grey = overlay.ClipView("a", axis, 40.0, size, 0.25, 30.0, width_px), np.full(size[::-1], 90, np.uint8)
    zoom = width_px / size[0]
    unseen, picture = (overlay.compose(view, grey, frame, 12.0, EDGES)[-round(zoom * size[1]) :] for frame in (0, 1))
    assert picture.shape[1] == width_px
    across = 0 if axis.from_px[1] == axis.to_px[1] else 1
    for colour, place in ((TRACKED, 220), (BEFORE, 320), (AFTER, 230)):
        seen = np.flatnonzero((picture == rgb(colour)).all(axis=2).any(axis=across))
        assert np.mean(seen) == pytest.approx((place + 0.5) * zoom - 0.5, abs=1)
    assert not (unseen == rgb(TRACKED)).all(axis=2).any()
    assert (unseen == rgb(BEFORE)).all(axis=2).any()
    if size[0] == 640:
        # A sixth of 640 px is 26.7 mm; the round length below it is 20 mm, or 80 px.
        assert max(int(row.sum()) for row in (picture == 255).all(axis=2)) == pytest.approx(80 * zoom, abs=2)
    assert overlay.levels(np.array([[10, 60, 110, 200]], np.uint16), 10, 110).tolist() == [[0, 128, 255, 255]]


# The strip of a recording, from arrays written by hand: position of the edge, and marks of flagged frames.
N = 40


def tracking(n_along: int = 300, height: int = 60) -> Tracking:
    """An edge at 7 px a frame from frame 10 on; frame 20 is lost, 25 moved by hand, 26 retimed, 30 doubtful."""
    flag = np.array(["before_release"] * 10 + [""] * 30, dtype="<U64")
    flag[20], flag[25], flag[26], flag[30] = "lost", "corrected", "gap;retimed", "doubtful;gap"
    edge = np.maximum(np.arange(N) - 10, 0) * 7.0 + 20
    edge[20] = np.nan
    kymograph = np.where(np.arange(n_along)[None] < np.nan_to_num(edge)[:, None], 40, 180).astype(np.float32)
    picture = np.full((height, n_along), 128, np.uint8)
    track = Track(np.arange(N) / 1000, edge * 1e-3, np.full(N, 1e-5), flag, edge)
    pictures = ((10, picture), (25, picture), (39, picture))
    return Tracking(track, Axis((0.0, 30.0), (n_along - 1.0, 30.0), 20.0), kymograph, pictures, 1.0, 0.1, np.zeros(N))


def test_the_edge_and_flagged_frames_are_counted_apart_and_frames_show_the_edge_where_it_was():
    kymograph, _, *frames = draw_strip("a", tracking(), 1e-3).axes
    shown = {line.get_label(): line for line in kymograph.lines if not line.get_label().startswith("_")}
    assert list(shown) == ["leading edge, N = 36", "flagged, N = 3", "corrected by hand, N = 1"]
    for label, px, ms in (("flagged, N = 3", [132, 160], [26, 30]), ("corrected by hand, N = 1", [125], [25])):
        assert shown[label].get_xdata().tolist() == px
        assert shown[label].get_ydata() == pytest.approx(ms)
    titles = [ax.get_title(loc="left") for ax in frames]
    assert titles == ["frame 10, 10.0 ms", "frame 25, 25.0 ms", "frame 39, 39.0 ms"]
    for ax, at in zip(frames, (20, 125, 223), strict=True):
        (line,) = ax.lines
        assert line.get_xdata() == pytest.approx([at, at])
        assert sorted(line.get_ydata()) == pytest.approx([15, 45])


def test_a_strip_is_small_in_a_page():
    body = inline_picture(render(draw_strip("a", tracking(900, 320), 1e-3), ["svg"])["svg"].decode(), "p", "strip")
    assert len(body) < 60_000
    assert "matrix(" in body


# Pixel locking is distinguished from a uniform distribution of edges within a pixel.
def places(amplitude_px: float, count: int = 4000, seed: int = 971) -> np.ndarray:
    """Edges anywhere, estimated with an error that repeats with every pixel."""
    edge = np.random.default_rng(seed).uniform(0, 500, count)
    return np.mod(edge - amplitude_px * np.sin(2 * np.pi * edge), 1.0)


@pytest.mark.parametrize("amplitude_px", [0.02, 0.05, 0.1])
def test_the_amplitude_of_a_periodic_error_is_found(amplitude_px):
    found, chance = periodic_error(places(amplitude_px))
    assert found == pytest.approx(amplitude_px, abs=1.5 * chance)
    assert chance == pytest.approx(math.sqrt(math.log(20) / 4000) / math.pi)


def test_edges_that_fall_anywhere_exceed_chance_once_in_twenty():
    above = [np.greater(*periodic_error(places(0.0, 500, seed))) for seed in range(3000, 3400)]
    assert 8 <= sum(above) <= 34  # 20 expected, binomial to three standard deviations


def test_only_sound_moving_frames_of_recordings_count():
    filmed = pd.DataFrame(
        {"edge_px": [10.25, 11.5, 12.75, np.nan, 14.0], "flag": ["", np.nan, "doubtful", "lost", "after_end"]}
    )
    elsewhere = pd.DataFrame({"edge_px": [np.nan, np.nan], "flag": [np.nan, np.nan]})
    assert overlay.subpixel_positions({"a": filmed, "b": elsewhere}).tolist() == [0.25, 0.5]
    assert len(overlay.subpixel_positions({})) == 0


@pytest.mark.parametrize(("amplitude_px", "words"), [(0.1, "more than chance"), (0.0, "no more than chance")])
def test_the_histogram_holds_every_edge_and_says_what_it_shows(amplitude_px, words):
    figure = overlay.draw_pixel_places(places(amplitude_px, 600, seed=972))
    (ax,) = figure.axes
    assert sum(bar.get_height() for bar in ax.patches[:10]) == 600
    said = " ".join(text.get_text() for text in figure.findobj(Text)).replace("\n", " ")
    assert f"px, {words}" in said
    assert "N = 600 frames" in said
