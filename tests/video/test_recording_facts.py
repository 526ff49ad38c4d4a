"""Sizes in the picture against the sheet: each mistake is caught, correct campaigns are not reported."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.scene import Tube, preset
from vinetrack.pipeline.recordings_stage import analyse_recording
from vinetrack.results.folder_layout import Results, read_json
from vinetrack.video.axis import Axis
from vinetrack.video.frames import RecordingError, inspect_recording, read_frames
from vinetrack.video.images import capture_rate
from vinetrack.video.survey import (
    RecordingFacts,
    Surveyor,
    axis_notes,
    direction_notes,
    exposure_problems,
    measure_recording,
    proposed_axis,
    size_problems,
    tracked_facts,
)
from vinetrack.video.track import track_recording

FPS, SCALE_MM = 1069.0, 0.24
VINE = Trial(name="a", diameter_m=0.012, length_m=0.14)
FACTS = RecordingFacts(
    trial="a", n_frames=100, capture_fps=FPS, playback_fps=60.0, mm_per_px=SCALE_MM, picture_mm=230.0, axis=None,
    tube_width_mm=12.1, tube_width_sigma_mm=0.25, growth_mm=138.0,
)  # fmt: skip


def test_matching_sizes_give_no_problem() -> None:
    assert size_problems(VINE, FACTS) == []


@pytest.mark.parametrize(("scale", "severity"), [(0.1, "error"), (0.8, "warning"), (1.2, "warning"), (10, "error")])
def test_a_wrong_scale_is_named_once_with_numbers_and_factor(scale: float, severity: str) -> None:
    facts = replace(FACTS, tube_width_mm=12 * scale, tube_width_sigma_mm=0.25 * scale, growth_mm=139 * scale)
    (problem,) = size_problems(VINE, facts)
    assert problem.severity == severity
    assert f"a factor {max(scale, 1 / scale):.3g}" in problem.message
    assert "check the scale" in problem.remedy


def test_swapped_diameter_and_length_are_named() -> None:
    swapped = replace(VINE, diameter_m=VINE.length_m, length_m=VINE.diameter_m)
    problems = size_problems(swapped, FACTS)
    assert [problem.column for problem in problems] == ["diameter_mm", "length_mm"]
    assert all(problem.severity == "error" for problem in problems)
    assert all("are swapped" in problem.remedy for problem in problems)


def test_a_vine_that_stops_early_is_not_a_mistake() -> None:
    assert size_problems(VINE, replace(FACTS, growth_mm=60.0)) == []


def test_a_vine_that_grows_beyond_its_length_is_a_mistake() -> None:
    (problem,) = size_problems(VINE, replace(FACTS, growth_mm=168.0))
    assert (problem.column, problem.severity) == ("length_mm", "warning")


def test_sizes_of_a_body_or_with_compare_sizes_no_are_not_compared() -> None:
    wrong = replace(FACTS, tube_width_mm=120.0)
    assert size_problems(replace(VINE, travel_ratio=1), wrong) == []
    assert size_problems(replace(VINE, compare_sizes=False), wrong) == []


ALONG = {"level": Axis((10.0, 60.0), (300.0, 40.0)), "down": Axis((60.0, 10.0), (75.0, 200.0))}


@pytest.mark.parametrize(
    ("picture", "angle_deg", "blank", "words"),
    [
        ("level", 0.0, False, None),
        ("down", 0.0, True, None),
        ("level", 90.0, False, None),
        (
            "down",
            90.0,
            False,
            "growth runs up or down in the picture (2 recordings, a first) and the sheet",
        ),
        ("level", 0.0, True, "growth runs level in the picture (2 recordings, a first) and a blank growth_angle_deg"),
    ],
)
def test_growth_in_another_direction_than_stated_is_noted(
    picture: str, angle_deg: float, blank: bool, words: str | None
) -> None:
    trials = [replace(VINE, name=name, growth_angle_rad=np.radians(angle_deg)) for name in "ab"]
    notes = direction_notes([replace(FACTS, axis=ALONG[picture])] * 2, trials, ["a", "b"] if blank else [])
    assert [note.startswith(words or "") for note in notes] == ([True] if words else [])


@pytest.mark.parametrize(("slopes_deg", "named"), [
    ([0, 1, -2, 179, 1], ""),
    ([0, 1, -2, 60, 1], "d"),
    ([0, 1, -2, 60, -35], "2 recordings, d first"),
    ([0, 1, 60, 61], ""),
    ([0, 60], ""),
    ([88, 90, -89, 0], "d"),
])  # fmt: skip
def test_an_axis_that_most_recordings_do_not_have_is_named(slopes_deg: list[float], named: str) -> None:
    trials = [replace(VINE, name=name) for name in "abcdefgh"[: len(slopes_deg)]]
    ends = [(100 + 200 * np.cos(np.radians(s)), 100 + 200 * np.sin(np.radians(s))) for s in slopes_deg]
    facts = [
        replace(FACTS, trial=trial.name, axis=Axis((100.0, 100.0), end))
        for trial, end in zip(trials, ends, strict=True)
    ]
    notes = axis_notes(facts, trials)
    assert len(notes) == bool(named)
    assert all(f"recordings was found ({named}): where" in note for note in notes)
    given = [replace(trial, axis=Axis((100.0, 100.0), end)) for trial, end in zip(trials, ends, strict=True)]
    assert axis_notes(facts, given) == []


def test_axes_are_compared_among_trials_that_grow_at_the_same_angle() -> None:
    trials = [
        replace(VINE, name=name, growth_angle_rad=angle)
        for name, angle in zip("abcdefg", [0.0] * 4 + [1.5] * 3, strict=True)
    ]
    ends = [(300.0, 100.0)] * 3 + [(200.0, 260.0)] + [(100.0, 300.0)] * 3
    facts = [
        replace(FACTS, trial=trial.name, axis=Axis((100.0, 100.0), end))
        for trial, end in zip(trials, ends, strict=True)
    ]
    (note,) = axis_notes(facts, trials)
    assert "that of 3 recordings was found (d)" in note


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tube of 12 mm that grows 140 mm at 6 m/s, with an exposure of half a frame, as a film of 60 a second."""
    scene = preset("half_frame_exposure")
    assert isinstance(scene.subject, Tube)
    tube = replace(scene.subject, diameter_m=0.012, length_m=0.14)
    scene = replace(scene, subject=tube, camera=replace(scene.camera, m_per_px=SCALE_MM / 1e3))
    path = tmp_path_factory.mktemp("clip") / "a.mp4"
    motion = np.linspace(0, 0.06, 400), np.clip(6.0 * (np.linspace(0, 0.06, 400) - 0.015), 0, 0.14)
    render_recording(scene, motion, n_frames=60, capture_fps=FPS, out_path=path, seed=20950)
    return path


def test_the_axis_proposed_runs_along_the_middle_of_the_tube_as_tracked(clip: Path) -> None:
    axis = proposed_axis(read_frames(clip).luma)
    tracked_axis = track_recording(replace(VINE, video=clip, capture_fps=FPS, m_per_px=SCALE_MM / 1e3)).axis
    assert axis.from_px[1] == pytest.approx(tracked_axis.from_px[1], abs=1.5)
    assert axis.to_px[1] == pytest.approx(tracked_axis.to_px[1], abs=1.5)
    assert axis.width_px * SCALE_MM == pytest.approx(12, rel=0.1)


def test_the_rate_of_playback_is_refused_unless_it_is_said_to_be_that_of_capture(clip: Path) -> None:
    recording = inspect_recording(clip)
    assert recording.playback_fps == 60
    with pytest.raises(RecordingError, match="the rate at which the file plays"):
        capture_rate(replace(VINE, capture_fps=60.0), recording)
    assert capture_rate(replace(VINE, capture_fps=60.0, capture_fps_is_playback=True), recording) == 60
    assert capture_rate(replace(VINE, capture_fps=61.0), recording) == 61


def tracked(clip: Path, exposure_frames: float) -> tuple[Trial, object]:
    trial = replace(VINE, video=clip, capture_fps=FPS, m_per_px=SCALE_MM / 1e3, exposure_s=exposure_frames / FPS)
    return trial, track_recording(trial)


def test_an_exposure_that_agrees_with_the_blur_gives_no_problem(clip: Path) -> None:
    trial, tracking = tracked(clip, 0.5)
    assert exposure_problems(trial, tracking) == []
    assert tracking.tube_width_px * SCALE_MM == pytest.approx(12, rel=0.05)


@pytest.mark.parametrize("stated", [0.05, 1.0])
def test_an_exposure_that_the_blur_contradicts_is_named(clip: Path, stated: float) -> None:
    (problem,) = exposure_problems(*tracked(clip, stated))
    assert problem.column == "exposure_us"
    assert "where it moves" in problem.message


SHEET = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
SETTINGS = "capture_fps: 1069\ngrowth_angle_deg: 0\ncalibration: {kind: mm_per_px, mm_per_px: 0.24}\n"


def surveyed(clip: Path, folder: Path, row: str, settings: str) -> tuple[list[str], Surveyor]:
    folder.mkdir()
    (folder / "a.mp4").symlink_to(clip)
    (folder / "trials.csv").write_text(SHEET + row)
    (folder / "experiment.yaml").write_text(settings)
    surveyor = Surveyor()
    return [f"{p.severity} {p.column}" for p in check_experiment(folder, surveyor)], surveyor


def test_check_reports_the_facts_of_a_correct_recording(clip: Path, tmp_path: Path) -> None:
    problems, surveyor = surveyed(clip, tmp_path / "v", "a,a.mp4,12,100,140,36,3\n", SETTINGS)
    assert problems == []
    (facts,) = surveyor.facts.values()
    assert (facts.n_frames, facts.capture_fps, facts.playback_fps) == (60, 1069, 60)
    assert facts.picture_mm == pytest.approx(0.24 * 960)
    assert facts.tube_width_mm == pytest.approx(12, rel=0.04)
    assert facts.growth_mm == pytest.approx(140, rel=0.04)
    assert facts.mean_speed_m_s == pytest.approx(6, rel=0.1)
    experiment = read_experiment(tmp_path / "v")
    tracked = tracked_facts(
        experiment.trials[0], measure_recording(experiment.trials[0], experiment.settings, experiment.folder)
    )
    assert repr(facts) == repr(tracked)  # what the tracker says, to the last digit


@pytest.mark.parametrize(
    ("row", "settings", "expected"),
    [
        ("a,a.mp4,12,100,140,36,3\n", SETTINGS.replace("1069", "60"), ["error capture_fps"]),
        ("a,a.mp4,12,100,140,36,3\n", SETTINGS.replace("0.24", "0.024"), ["error diameter_mm"]),
        ("a,a.mp4,12,100,140,36,3\n", SETTINGS.replace("0.24", "0.288"), ["warning diameter_mm"]),
        ("a,a.mp4,140,100,12,36,3\n", SETTINGS, ["error diameter_mm", "error length_mm"]),
        ("a,a.mp4,12,100,140,36,3\n", SETTINGS + "exposure_us: 0.0935\n", 2 * ["warning exposure_us"]),
        ("a,a.mp4,12,100,140,36,3\n", SETTINGS + "exposure_ms: 93.5\n", ["warning exposure_ms", "error exposure_us"]),
    ],
    ids=["rate", "scale ×10", "scale 20 %", "sizes swapped", "ms as µs", "µs as ms"],
)
def test_check_catches_a_mistake(clip: Path, tmp_path: Path, row: str, settings: str, expected: list[str]) -> None:
    assert surveyed(clip, tmp_path / "v", row, settings)[0] == expected


def test_a_scale_a_fifth_off_is_kept_with_the_trial_for_the_verdict(clip: Path, tmp_path: Path) -> None:
    folder = tmp_path / "vines"
    folder.mkdir()
    shutil.copy(clip, folder / "a.mp4")
    columns = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,mm_per_px,capture_fps"
    for name, scale in (("right", SCALE_MM), ("off", 0.8 * SCALE_MM)):
        (folder / "trials.csv").write_text(f"{columns}\n{name},a.mp4,12,100,140,60,3,{scale},{FPS}\n")
        analyse_recording(read_experiment(folder), name, tmp_path / "out", run_settings({}))
    noted = {name: read_json(Results(tmp_path / "out").analysed(name)) for name in ("right", "off")}
    assert (noted["right"]["contradictions"], noted["right"]["row"]["status"]) == ([], "ok")
    (entry,) = noted["off"]["contradictions"]
    assert entry["column"] == "diameter_mm"
    assert "check the scale" in entry["reason"]
    assert noted["off"]["row"]["status"] == "warning"
