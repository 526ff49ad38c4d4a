"""Frames of a clip: every edge at its position and in its colour, with scale, time and names."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack.figures.overlay import AFTER, BEFORE, TRACKED, ClipView, Edge, compose, levels
from vinetrack.video.axis import Axis

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


def test_edges_that_agree_are_all_visible() -> None:
    picture = compose(view(), grey(), 1, 12.0, edges(200.0, 200.0, 200.0))
    for colour in (TRACKED, BEFORE, AFTER):
        assert np.mean(columns_of(picture, colour)) == pytest.approx(220, abs=1)


def test_an_edge_that_was_not_seen_is_not_drawn() -> None:
    picture = compose(view(), grey(), 0, 0.0, edges())
    assert not columns_of(picture, TRACKED).size
    assert columns_of(picture, BEFORE).size


def test_places_scale_with_the_size_of_the_clip() -> None:
    picture = compose(view(width_px=960), grey(), 1, 0.0, edges())
    assert picture.shape[1] == 960
    assert np.mean(columns_of(picture, BEFORE, 300)) == pytest.approx(320.5 * 1.5 - 0.5, abs=1)


def test_a_small_recording_is_enlarged_twice_at_most() -> None:
    assert compose(view(width_px=3840), grey(), 1, 0.0, edges()).shape[1] == 1280


def test_sides_are_even_whatever_comes_in() -> None:
    odd = ClipView("a", Axis((20.0, 50.0), (290.0, 50.0)), 20.0, (301, 97), 0.25, 30.0, 333)
    height, width, _ = compose(odd, np.full((97, 301), 90, np.uint8), 1, 0.0, edges(100, 120, 140)).shape
    assert (height % 2, width % 2) == (0, 0)


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


def test_without_a_scale_there_is_no_bar() -> None:
    blind = ClipView("a", Axis((20.0, 100.0), (620.0, 100.0)), 40.0, SIZE, math.nan, 30.0, 640)
    assert not (compose(blind, grey(), 1, 0.0, [])[-SIZE[1] :] == 255).all(axis=2).any()


def test_the_bar_above_has_a_row_for_each_edge_and_changes_with_time() -> None:
    early, late = (compose(view(), grey(), 1, time_ms, edges())[: -SIZE[1]] for time_ms in (1.0, 99.0))
    for colour in (TRACKED, BEFORE, AFTER):
        assert (early == rgb(colour)).all(axis=2).any()
    assert (early != late).any()


def test_long_names_are_cut_to_their_room() -> None:
    long = "with " + " and ".join(f"an_effect_of_the_users_own_{i}" for i in range(9))
    unseen = np.full(2, math.nan)
    bars = []
    for name in (long, "b"):
        picture = compose(view(), grey(), 1, 0.0, [*edges()[:2], Edge(name, AFTER, unseen, unseen)])
        bars.append(picture[: -SIZE[1]])
    differs = np.flatnonzero((bars[0] != bars[1]).any(axis=(0, 2)))
    assert 200 < differs.max() < 0.5 * 640


def test_grey_levels_are_stretched_and_clipped() -> None:
    assert levels(np.array([[10, 60, 110, 200]], np.uint16), 10, 110).tolist() == [[0, 128, 255, 255]]
