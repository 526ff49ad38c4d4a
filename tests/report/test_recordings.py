"""Recordings and calibrations in the report, from entries written by hand."""

from __future__ import annotations

import math

import pytest
from test_report import EVIL, SVG, Tags, page, trials

from vinetrack.report import build as report_trials
from vinetrack.report.build import (
    MAX_CLIP_BYTES,
    SHARED_ERROR,
    Clip,
    TrackedRecording,
    calibration_table,
    count_frames,
)
from vinetrack.report.section import inline_picture

BOARD = {
    "kind": "charuco",
    "image": "calibration/board.png",
    "mm_per_px": 0.2407,
    "scale_rel_sigma": 9e-5,
    "reprojection_px": 0.031,
    "n_corners": 52,
    "n_pictures": 1,
    "notes": ["the target spans only 40 % of the picture"],
}


def recording(**changes: object) -> TrackedRecording:
    return TrackedRecording(SVG, ["before_release", "", "", "doubtful"], {**BOARD, **changes})


def test_strip_and_motion_stand_side_by_side_and_the_motion_once() -> None:
    html = page(recordings={"a": recording()}, trial_figures={"a": SVG})
    assert html.count('<div class="pair">') == 1
    assert html.count('aria-label="Strip of a with its tracked edge"') == 1
    assert html.count('aria-label="Motion of a"') == 1
    assert 'id="trial-a"' in html
    assert 'href="#trial-a"' in html
    assert not Tags(html).wrong


def test_how_edge_and_scale_were_found_is_said_where_there_are_recordings() -> None:
    html = page(recordings={"a": recording()})
    assert "<h3>Edge</h3>" in html
    assert "<h3>Edge</h3>" not in page()


def test_the_calibration_is_listed_with_its_error_and_what_it_rests_on() -> None:
    html = page(recordings={"a": recording()})
    for words in ("ChArUco board", "calibration/board.png", "0.240700", "0.0090 %", "0.031 px", "52 in 1", "40 %"):
        assert words in html
    assert SHARED_ERROR.replace("'", "&#39;") in html


def test_recordings_of_one_target_share_a_row_and_its_largest_error() -> None:
    shared = {"a": recording(), "b": recording(mm_per_px=0.2409, scale_rel_sigma=2e-4)}
    (row,) = calibration_table(shared)
    assert (row["trials"], row["mm_per_px"], row["error"]) == ("2 recordings", "0.240700 to 0.240900", "0.020 %")


def test_a_scale_of_the_sheet_has_an_unknown_error_and_a_row_for_each_value() -> None:
    own: dict[str, object] = dict.fromkeys(("image", "scale_rel_sigma", "reprojection_px"))
    own |= {"kind": "sheet", "n_corners": 0, "notes": []}
    table = calibration_table({"a": recording(**own, mm_per_px=0.3), "b": recording(**own, mm_per_px=0.4)})
    assert [(row["trials"], row["error"], row["reprojection"]) for row in table] == [
        ("a", "unknown", "–"),
        ("b", "unknown", "–"),
    ]


@pytest.mark.parametrize("unknown", [None, math.nan])
def test_an_unknown_error_is_stated_as_unknown(unknown: float | None) -> None:
    (row,) = calibration_table({"a": recording(scale_rel_sigma=unknown)})
    assert row["error"] == "unknown"


def test_a_failed_recording_shows_its_reason_and_no_picture() -> None:
    failed = trials("a", status="failed", reason="a.mp4: not a video")
    html = page(trials=failed, recordings={"a": TrackedRecording(SVG, [])}, trial_figures={"a": SVG})
    assert "a.mp4: not a video" in html
    assert '<div class="pair">' not in html


def test_pictures_too_many_for_one_page_stay_files_and_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("a", "b", "c")
    recordings = {name: recording() for name in names}
    weight = len(inline_picture(SVG, "s-a", "Strip of a with its tracked edge"))
    monkeypatch.setattr(report_trials, "MAX_TRIAL_FIGURES_BYTES", 2 * weight)
    html = page(trials=trials(*names), recordings=recordings)
    assert html.count('aria-label="Strip of') == 2
    assert "The figures of 1 trials are left out here" in html
    assert html.count("4 frames: 1 before release, 1 doubtful") == 3


def test_a_clip_beside_the_page_is_linked_and_one_plays_in_it() -> None:
    html = page(clips={"a": "overlays/a.mp4"}, clip=Clip("a", b"film", EVIL, b"frame"))
    assert html.count("data:image/webp;base64,ZnJhbWU=") == 2
    assert '<a href="overlays/a.mp4">Clip (separate file)</a>' in html
    assert 'src="data:video/mp4;base64,ZmlsbQ=="' in html
    assert EVIL not in html


def test_a_clip_too_large_for_the_page_does_not_play_in_it() -> None:
    assert "<video" not in page(clip=Clip("a", bytes(MAX_CLIP_BYTES + 1), "c"))


def test_frames_are_counted_by_their_flags() -> None:
    assert count_frames(["", "lost;gap", "lost"]) == "3 frames: 2 without the edge, 1 gap"
    assert count_frames([]) == "0 frames"


def test_what_a_user_wrote_is_escaped() -> None:
    html = page(recordings={"a": recording(notes=[EVIL], image=EVIL)})
    assert EVIL not in html
