"""The strip of a recording, from arrays written by hand: position of the edge, and marks of flagged frames."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.core.records import Track
from vinetrack.figures.overlay import MAX_STRIP_PX, draw_strip, flagged, shrunk
from vinetrack.figures.style import render
from vinetrack.report.section import inline_picture
from vinetrack.video.axis import Axis
from vinetrack.video.track import Tracking

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


def axes(figure: object) -> list:
    return [ax for part in figure.subfigs for ax in part.axes]  # type: ignore[attr-defined]


def test_frames_at_rest_are_no_flagged_ones() -> None:
    mask = flagged(tracking().track.flag)
    assert np.flatnonzero(mask).tolist() == [20, 30]


def test_the_edge_and_flagged_frames_are_counted_apart() -> None:
    kymograph = axes(draw_strip("a", tracking(), 1e-3))[0]
    labels = [line.get_label() for line in kymograph.lines]
    assert labels == ["leading edge, N = 38", "flagged, N = 2"]
    crosses = kymograph.lines[1]
    assert crosses.get_xdata().tolist() == [160.0]
    assert crosses.get_ydata() == pytest.approx([30.0])


def test_time_runs_downwards_from_the_first_frame_to_the_last() -> None:
    kymograph = axes(draw_strip("a", tracking(), 1e-3))[0]
    (image,) = kymograph.images
    assert image.get_extent() == pytest.approx([-0.5, 299.5, 39.5, -0.5])


def test_each_frame_shows_the_edge_across_the_axis_where_it_was() -> None:
    frames = axes(draw_strip("a", tracking(), 1e-3))[1:]
    titles = [ax.get_title(loc="left") for ax in frames]
    assert titles == ["frame 10, 10.0 ms", "frame 25, 25.0 ms", "frame 39, 39.0 ms"]
    for ax, at in zip(frames, (20, 125, 223), strict=True):
        (line,) = ax.lines
        assert line.get_xdata() == pytest.approx([at, at])
        assert sorted(line.get_ydata()) == pytest.approx([15, 45])


def test_a_frame_without_an_edge_shows_the_picture_alone() -> None:
    from dataclasses import replace

    made = tracking()
    frames = axes(draw_strip("a", replace(made, pictures=((20, made.pictures[0][1]),)), 1e-3))[1:]
    assert [len(ax.lines) for ax in frames] == [0]


def test_large_pictures_are_drawn_small() -> None:
    figure = draw_strip("a", tracking(n_along=1900, height=1200), 1e-3)
    shapes = [image.get_array().shape for ax in axes(figure) for image in ax.images]
    assert max(size for shape in shapes for size in shape) <= MAX_STRIP_PX


def test_a_smaller_picture_holds_the_means_of_the_larger() -> None:
    picture = np.arange(50.0).reshape(5, 10)
    picture[4, 9] = picture[0, 3] = np.nan
    small = shrunk(picture, 4)
    assert small.shape == (3, 4)
    assert small[0, 0] == pytest.approx(picture[:2, :3].mean())
    assert np.isnan(small[2, 3])
    assert np.isfinite(small[0, 1])
    assert shrunk(picture, 10) is picture


def test_a_strip_is_small_in_a_page() -> None:
    body = inline_picture(render(draw_strip("a", tracking(900, 320), 1e-3), ["svg"])["svg"].decode(), "p", "strip")
    assert len(body) < 60_000
    assert "matrix(" in body


def test_it_can_be_written_as_png_and_svg() -> None:
    files = render(draw_strip("a", tracking(), 1e-3), ("png", "svg"), 60)
    assert files["png"].startswith(b"\x89PNG")
    assert b"<svg" in files["svg"]
