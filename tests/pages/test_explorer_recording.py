"""A recording in the explorer: positions of edges in its picture, and the message for a trial without one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from explorer_campaign import write_bars

from vinetrack.pages.campaign import Campaign
from vinetrack.pages.film_panel import DecodedRecording, RecordingView, recording_view
from vinetrack.results.folder_layout import Results
from vinetrack.video.axis import Axis


def write_clip(path: Path, count: int = 30, width: int = 320, height: int = 96) -> Path:
    """A bar whose right end moves by 8 px per frame."""
    return write_bars(path, 20 + 8.0 * np.arange(count), width, height)


def test_frames_come_back_as_they_were_filmed(tmp_path: Path) -> None:
    told: list[int] = []
    film = DecodedRecording(write_clip(tmp_path / "a.mp4")).decode(lambda one: told.append(one.count))
    assert film.complete
    assert film.error == ""
    assert (film.count, film.expected, film.shape, film.scale) == (30, 30, (96, 320), 1.0)
    assert told[0] == 1
    assert told[-1] == 30
    row = film.picture(10)[48]
    assert abs(int(np.argmax(row < 120)) - 100) <= 1


def test_a_wide_recording_is_kept_as_wide_as_the_page_shows_it(tmp_path: Path) -> None:
    film = DecodedRecording(write_clip(tmp_path / "a.mp4", count=4, width=1920, height=200)).decode()
    assert film.shape == (100, 960)
    assert film.scale == 0.5


def test_a_file_that_is_not_a_recording_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"not a film")
    film = DecodedRecording(tmp_path / "a.mp4").decode()
    assert film.complete
    assert film.count == 0
    assert "a.mp4" in film.error


def test_decoding_stops_when_cancelled(tmp_path: Path) -> None:
    film = DecodedRecording(write_clip(tmp_path / "a.mp4"))
    film.decode(lambda one: one.cancel())
    assert not film.complete
    assert film.count == 1


def view(angle: float = 0.0) -> RecordingView:
    frames = np.arange(20.0)
    edge_px = np.where(frames < 15, 10 + 5 * frames, np.nan)
    return RecordingView(
        trial="a",
        path=Path("a.mp4"),
        axis=Axis((100.0, 50.0), (100.0 + 300 * float(np.cos(angle)), 50.0 + 300 * float(np.sin(angle)))),
        half_width_px=10.0,
        time_s=frames / 1000,
        edge_px=edge_px,
        lead_position_m=1e-3 * (edge_px - 10),
        shake_px=np.where(frames == 3, 2.0, 0.0),
    )


def test_positions_of_the_model_are_mapped_to_pixels_by_the_track() -> None:
    one = view()
    along = one.along_px(np.array([0.0, 0.0125, 0.1, -0.01]))
    np.testing.assert_allclose(along, [10.0, 22.5, 110.0, 0.0], atol=1e-9)


def test_a_track_of_one_point_gives_no_pixels() -> None:
    bare = replace(view(), edge_px=np.full(20, np.nan))
    assert np.isnan(bare.along_px(np.array([0.0, 0.1]))).all()


def test_an_edge_is_drawn_across_the_axis() -> None:
    assert view().across(20.0) == ((120.0, 120.0), (60.0, 40.0))
    (xs, ys) = view(angle=np.pi / 2).across(20.0)
    np.testing.assert_allclose(xs, (90.0, 110.0))
    np.testing.assert_allclose(ys, (70.0, 70.0))


def test_an_edge_follows_a_shaken_picture() -> None:
    assert view().across(20.0, 3) == view().across(22.0)
    assert view().across(20.0, 4) == view().across(20.0)


def test_a_trial_with_only_a_track_is_reported_to_have_no_recording(campaign: Campaign) -> None:
    words = recording_view(Results(campaign.folder), campaign.trials[0].data.trial)
    assert isinstance(words, str)
    assert "came as a track (d24_24kPa_1.csv): there is no recording to show" in words


def test_a_recording_is_shown_with_the_axis_it_was_tracked_along(campaign: Campaign, tmp_path: Path) -> None:
    seen = campaign.trials[0]
    results = Results(tmp_path)
    trial = replace(seen.data.trial, video=tmp_path / "gone.mp4", track=None)
    assert "no longer exists" in str(recording_view(results, trial))
    trial = replace(trial, video=write_clip(tmp_path / "a.mp4", count=2))
    assert "does not exist" in str(recording_view(results, trial))
    results.track(trial.name).parent.mkdir()
    results.analysed(trial.name).parent.mkdir()
    results.track(trial.name).write_text(
        "frame,time_s,edge_px,lead_position_m,lead_position_sigma_m,flag\n0,0,5,0,0,\n"
    )
    results.analysed(trial.name).write_text("{}")
    assert "run snakemake again" in str(recording_view(results, trial))
    axis = {"from_px": [0, 10], "to_px": [300, 10], "width_px": None}
    results.analysed(trial.name).write_text(json.dumps({"axis": axis}))
    found = recording_view(results, trial)
    assert isinstance(found, RecordingView)
    assert found.half_width_px == pytest.approx(15.0)
    assert (found.axis.from_px, found.axis.to_px) == ((0.0, 10.0), (300.0, 10.0))
    bent = {"from_px": [0, 10], "via_px": [[100, 40]], "to_px": [300, 10], "width_px": 20}
    results.analysed(trial.name).write_text(json.dumps({"axis": bent}))
    found = recording_view(results, trial)
    assert isinstance(found, RecordingView)
    (x0, x1), (y0, y1) = found.across(0.5 * found.axis.length_px)
    middle, direction = found.axis.points(0.5 * found.axis.length_px), np.array([y0 - y1, x1 - x0]) / 30
    assert np.allclose([(x0 + x1) / 2, (y0 + y1) / 2], middle)
    assert np.allclose(direction, found.axis.direction_at(0.5 * found.axis.length_px), atol=1e-9)
