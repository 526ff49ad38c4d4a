"""The paper's campaign as it is shipped: its sheet, what is true in it, and its trials before a camera."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory import __main__ as command
from vinetrack.laboratory.filming import make_filming, recording_experiment
from vinetrack.laboratory.tracks import read_ground_truth
from vinetrack.laboratory.vine_campaigns import paper_campaign, paper_values

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "data" / "paper"


def test_the_papers_sheet_is_its_campaign() -> None:
    """Four scales at ten pressures, three more walls at eight, 24 kPa, two diameters with four walls, payloads, one."""
    stated, meant = read_experiment(PAPER).trials, paper_campaign()
    assert len(stated) == 4 * 10 * 4 + 3 * 8 * 4 + 4 * 4 + 2 * 4 * 4 + (3 + 4 * 3) * 4 + 1
    assert [trial.name for trial in stated] == [trial.name for trial in meant]
    for one, other in zip(stated, meant, strict=True):
        assert (one.vine, one.condition) == (other.vine, other.condition)
        assert one.yield_pressure_Pa == pytest.approx(3e3)
        assert one.capture_fps == pytest.approx(1069)


def test_the_papers_nature_has_the_printed_numbers() -> None:
    """B of a printed diameter is in proportion to the wall; of the 25 mm vine it is 6.44 × ½ × (25/24)^0.75 = 3.320."""
    hidden = read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    trials = paper_campaign()
    assert hidden.values == paper_values(trials)
    B = hidden.values["eversion_damping.B"]
    assert hidden.values["eversion_damping.n"] == 0.37
    assert [B[name] for name in ("6mm-50um-70mm", "12mm-100um-140mm", "18mm-150um-210mm", "24mm-200um-280mm")] == [
        0.57,
        1.83,
        4.54,
        6.44,
    ]
    assert B["12mm-200um-140mm"] == pytest.approx(2 * 1.83)
    assert B["24mm-150um-280mm"] == pytest.approx(0.75 * 6.44)
    assert B["25mm-100um-400mm"] == pytest.approx(3.320, abs=5e-4)
    assert hidden.effects == ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")


def test_tracks_are_put_before_a_camera_on_request(tmp_path: Path) -> None:
    chosen = ["fig4_28kPa_1", "fast_62kPa_1"]
    filming = make_filming({"target": {"squares": [14, 5], "square_m": 0.015, "marker_m": 0.011}})
    filmed = recording_experiment(read_experiment(PAPER), chosen, filming, tmp_path / "filmed")
    assert [trial.name for trial in filmed.trials] == sorted(chosen, key=lambda name: filmed.lines[name])
    assert {trial.name for trial in filmed.trials} == set(chosen)
    for trial in filmed.trials:
        assert trial.video == tmp_path / "filmed" / "videos" / f"{trial.name}.mp4"
        assert trial.track is None
        assert trial.exposure_s == pytest.approx(0.1 / 1069, rel=1e-4)
    assert filmed.settings.calibration.square_mm == pytest.approx(15)
    assert filmed.settings.calibration.image == "calibration/board.png"
    assert filmed.settings.chamber_l == pytest.approx(3.7)


def test_an_experiment_of_recordings_is_not_filmed_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="recordings already"):
        recording_experiment(read_experiment(ROOT / "data" / "demo"), [], make_filming({}), tmp_path / "filmed")
    with pytest.raises(ValueError, match="name another folder"):
        recording_experiment(read_experiment(PAPER), [], make_filming({}), PAPER)


def test_a_pattern_that_no_trial_matches_is_said(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        command.main([str(PAPER), "--only", "fig3_*"])
    assert "no trial of" in capsys.readouterr().err
