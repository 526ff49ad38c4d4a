"""Columns that belong to one trial alone: its axis in the picture, the frames used, the point mass it is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.core.records import PictureAxis
from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.schema import COLUMNS, CellError, read_cell
from vinetrack.tracks.importers import TrackError, load_track, read_track

REAL = os.environ.get("VINETRACK_REAL_DATA", "")
HEADER = "trial,track,diameter_mm,payload_g,travel_ratio,frames_used,axis,point_mass\n"


def folder_with(tmp_path: Path, row: str) -> Path:
    rows = "".join(f"{k / 100},{0.05 * k**2 / 100:.5f}\n" for k in range(30))
    (tmp_path / "fall.csv").write_text("time_s,position_m\n" + rows)
    (tmp_path / "trials.csv").write_text(HEADER + row + "\n")
    return tmp_path


def test_a_sheet_gives_one_trial_its_own(tmp_path: Path) -> None:
    (trial,) = read_experiment(folder_with(tmp_path, 't1,fall.csv,40,2.7,1,5:20,"161,40:151.5,799:20",')).trials
    assert trial.axis is not None
    assert (trial.axis.from_px, trial.axis.to_px) == ((161.0, 40.0), (151.5, 799.0))
    assert trial.axis.width_m == pytest.approx(0.02)
    assert trial.frames_used == (5, 20)
    track = load_track(trial)
    assert np.flatnonzero(track.usable).tolist() == list(range(5, 21))
    assert track.flag[0] == "rejected"
    assert track.flag[-1] == "after_end"


def test_an_axis_may_go_through_more_points() -> None:
    axis = read_cell(COLUMNS["axis"], "161,40:170,300:151.5,799:20")
    assert isinstance(axis, PictureAxis)
    assert (axis.from_px, axis.via_px, axis.to_px) == ((161.0, 40.0), ((170.0, 300.0),), (151.5, 799.0))
    assert axis.width_m == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("column", "text", "said"),
    [
        ("axis", "161,40", "is not an axis"),
        ("axis", "161,40:165,40", "is shorter than 10 pixels"),
        ("axis", "161,40:151,799:0", "has a width that is not positive"),
        ("axis", "161,40:162,41:151,799", "has neighbouring points less than 2 pixels apart"),
        ("axis", "161,40:162:151,799", "is not an axis"),
        ("frames_used", "20:5", "ends before it starts"),
        ("frames_used", "a:5", "is not a range of frames"),
    ],
)
def test_what_cannot_be_read_is_said(column: str, text: str, said: str) -> None:
    with pytest.raises(CellError, match=said):
        read_cell(COLUMNS[column], text)


def test_a_table_has_no_point_mass_to_choose(tmp_path: Path) -> None:
    (trial,) = read_experiment(folder_with(tmp_path, "t1,fall.csv,40,2.7,1,,,ball")).trials
    with pytest.raises(TrackError, match="has no point masses to choose from: leave point_mass blank"):
        load_track(trial)


def test_none_of_these_stands_in_the_settings(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, "t1,fall.csv,40,2.7,1,,,")
    (folder / "experiment.yaml").write_text("frames_used: 3:9\n")
    with pytest.raises(ExperimentError):
        read_experiment(folder)


@pytest.mark.skipif(not REAL, reason="VINETRACK_REAL_DATA is unset: no real recordings to try")
def test_either_of_two_point_masses_of_a_real_project() -> None:
    path = Path(REAL) / "falling_cups" / "cups.trk"
    with pytest.raises(TrackError, match="no point mass named 'cup': point_mass is one of 'cup 3', 'cup 7'"):
        read_track(path, point_mass="cup")
    third, seventh = (read_track(path, point_mass=name) for name in ("cup 3", "Cup 7"))
    # The heavier stack falls further over the same frames.
    common = min(third.time_s.size, seventh.time_s.size) - 1
    assert seventh.time_s[common] == pytest.approx(third.time_s[common])
    assert np.ptp(seventh.lead_position_m[: common + 1]) > np.ptp(third.lead_position_m[: common + 1])
    assert not any("not used:" in note for note in seventh.notes)
    part = read_track(path, point_mass="cup 3", frames_used=(2, 8))
    assert 5 <= part.time_s.size < third.time_s.size
