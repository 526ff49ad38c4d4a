"""Checks of recordings, scales and sizes before any work."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_scene import write_video

from vinetrack.core.problems import Problem, format_problems
from vinetrack.core.records import Trial
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.scene import Tube, preset
from vinetrack.pipeline.stages import Job
from vinetrack.pipeline.trials import analyse_trials
from vinetrack.results.folder_layout import Results, read_json
from vinetrack.video import survey as module
from vinetrack.video.axis import Axis
from vinetrack.video.frames import RecordingError, inspect_recording
from vinetrack.video.images import capture_rate
from vinetrack.video.survey import (
    RecordingFacts,
    Surveyor,
    axis_notes,
    direction_notes,
    measure_recording,
    size_problems,
    tracked_facts,
)
from vinetrack.video.track import track_recording

HEADER = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa"
SCALE = "capture_fps: 1000\ncalibration: {kind: mm_per_px, mm_per_px: 0.3}\n"


def write_clip(path: Path, n_frames: int = 40, index_first: bool = True, codec: str = "libx264") -> None:
    """Grey noise of 96 × 64 px, so that frames are of some size; the index before or after them."""
    noise = np.random.default_rng(3).integers(0, 255, (n_frames, 64, 96), np.uint8)
    options = {"movflags": "+faststart"} if index_first and path.suffix == ".mp4" else {}
    write_video(path, noise, codec, "gray" if codec == "ffv1" else "yuv420p", container_options=options)


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "filmed"
    path.mkdir()
    return path


def check(folder: Path, *videos: str, settings: str = SCALE) -> list[Problem]:
    rows = [f"t{i},{video},24,200,280,28,3" for i, video in enumerate(videos)]
    (folder / "trials.csv").write_text("\n".join([HEADER, *rows, ""]))
    (folder / "experiment.yaml").write_text(settings)
    return check_experiment(folder, Surveyor())


def test_a_sound_recording_and_scale_give_no_problem(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    assert check(folder, "a.mp4") == []


@pytest.mark.parametrize(
    "fault", ["text", "index cut off", "three frames", "empty", "missing", "empty folder", "no images"]
)
def test_what_is_no_recording_is_an_error_at_its_place(folder: Path, fault: str) -> None:
    path = folder / "a.mp4"
    if fault == "text":
        path.write_text("not a film\n" * 50)
    elif fault == "empty":
        path.touch()
    elif fault in ("index cut off", "three frames"):
        write_clip(path, 3 if fault == "three frames" else 40, index_first=False)
        cut(path, 0.7 if fault == "index cut off" else 1.0)
    elif fault != "missing":
        path.mkdir()
        if fault == "no images":
            (path / "notes.txt").write_text("x")
    (problem,) = check(folder, "a.mp4")
    place = (problem.severity, problem.file, problem.line, problem.trial, problem.column, problem.value)
    assert place == ("error", "trials.csv", 2, "t0", "video", "a.mp4")


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.mkv", "ffv1")])
def test_fewer_frames_than_declared_are_counted_without_decoding(folder: Path, name: str, codec: str) -> None:
    write_clip(folder / name, 60, codec=codec)
    cut(folder / name, 0.6)
    (problem,) = check(folder, name)
    assert problem.severity == "warning"
    assert 25 <= int(problem.message.split(":")[1].split()[0]) <= 40


def test_a_rate_that_contradicts_the_frames_own_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_clip(folder / "a.mp4")
    inspect = module.inspect_recording
    monkeypatch.setattr(module, "inspect_recording", lambda path: replace(inspect(path), capture_fps=1069.0))
    (problem,) = check(folder, "a.mp4")
    assert (problem.column, problem.severity) == ("capture_fps", "error")


def test_without_any_scale_there_is_one_problem(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    shutil.copy(folder / "a.mp4", folder / "b.mp4")
    (problem,) = check(folder, "a.mp4", "b.mp4", settings="capture_fps: 1000\n")
    assert (problem.file, problem.column) == ("experiment.yaml", "calibration")


@pytest.mark.parametrize("size_px", [None, (50, 50), (64, 96)], ids=["missing", "another size", "no board"])
def test_a_picture_that_gives_no_scale_is_reported_once(folder: Path, size_px: tuple[int, int] | None) -> None:
    write_clip(folder / "a.mp4")
    shutil.copy(folder / "a.mp4", folder / "b.mp4")
    if size_px is not None:
        cv2.imwrite(str(folder / "board.png"), np.full(size_px, 90, np.uint8))
    board = "capture_fps: 1000\ncalibration: {kind: checkerboard, image: board.png, squares: [5, 5], square_mm: 5}\n"
    (problem,) = check(folder, "a.mp4", "b.mp4", settings=board)
    assert (problem.file, problem.column, problem.severity) == ("experiment.yaml", "calibration.image", "error")


@pytest.mark.parametrize(
    "given",
    [
        "from_px: [10, 30], to_px: [200, 30]",
        "from_px: [10, 30], via_px: [[50, 70]], to_px: [90, 30]",
        "from_px: [1, 55], via_px: [[30, 63], [70, 63]], to_px: [95, 55]",
        "from_px: [20, 20], via_px: [[60, 20]], to_px: [60, 50], width_mm: 30",
    ],
)
def test_an_axis_that_leaves_the_picture_or_bends_too_sharply_is_refused(folder: Path, given: str) -> None:
    write_clip(folder / "a.mp4")
    (problem,) = check(folder, "a.mp4", settings=SCALE + f"axis: {{{given}}}\n")
    assert (problem.file, problem.column, problem.severity) == ("experiment.yaml", "axis", "error")


def test_a_curve_within_the_picture_is_accepted(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    settings = SCALE + "axis: {from_px: [5, 30], via_px: [[50, 34]], to_px: [90, 50], width_mm: 2}\n"
    assert not [problem for problem in check(folder, "a.mp4", settings=settings) if problem.column == "axis"]


@pytest.mark.slow
def test_fifty_recordings_take_twenty_lines_however_many_are_bad(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    names = [f"v{i}.mp4" for i in range(50)]
    for i, name in enumerate(names):
        shutil.copy(folder / "a.mp4", folder / name)
        if i % 2:
            (folder / name).write_text("text")
    (folder / "a.mp4").unlink()
    problems = check(folder, *names)
    assert len(problems) == 25
    assert len(format_problems(problems)) == 20


# ---- sizes in the picture against the sheet ----

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


def test_swapped_diameter_and_length_are_named() -> None:
    swapped = replace(VINE, diameter_m=VINE.length_m, length_m=VINE.diameter_m)
    problems = size_problems(swapped, FACTS)
    assert [problem.column for problem in problems] == ["diameter_mm", "length_mm"]
    assert all(problem.severity == "error" for problem in problems)


def test_a_vine_that_grows_beyond_its_length_is_a_mistake() -> None:
    (problem,) = size_problems(VINE, replace(FACTS, growth_mm=168.0))
    assert (problem.column, problem.severity) == ("length_mm", "warning")


def test_sizes_of_a_body_or_with_compare_sizes_no_are_not_compared() -> None:
    wrong = replace(FACTS, tube_width_mm=120.0)
    assert size_problems(replace(VINE, travel_ratio=1), wrong) == []
    assert size_problems(replace(VINE, compare_sizes=False), wrong) == []


ALONG = {"level": Axis((10.0, 60.0), (300.0, 40.0)), "down": Axis((60.0, 10.0), (75.0, 200.0))}


@pytest.mark.parametrize(
    ("picture", "angle_deg", "blank", "noted"),
    [
        ("level", 0.0, False, False),
        ("down", 0.0, True, False),
        ("level", 90.0, False, False),
        ("down", 90.0, False, True),
        ("level", 0.0, True, True),
    ],
)
def test_growth_in_another_direction_than_stated_is_noted(
    picture: str, angle_deg: float, blank: bool, noted: bool
) -> None:
    trials = [replace(VINE, name=name, growth_angle_rad=np.radians(angle_deg)) for name in "ab"]
    notes = direction_notes([replace(FACTS, axis=ALONG[picture])] * 2, trials, ["a", "b"] if blank else [])
    assert len(notes) == noted


@pytest.mark.parametrize(("slopes_deg", "named"), [
    ([0, 1, -2, 179, 1], ""),
    ([0, 1, -2, 60, 1], "d"),
    ([0, 1, -2, 60, -35], "d first"),
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
    assert all(named in note for note in notes)
    given = [replace(trial, axis=Axis((100.0, 100.0), end)) for trial, end in zip(trials, ends, strict=True)]
    assert axis_notes(facts, given) == []


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


def test_the_rate_of_playback_is_refused_unless_it_is_said_to_be_that_of_capture(clip: Path) -> None:
    recording = inspect_recording(clip)
    assert recording.playback_fps == 60
    with pytest.raises(RecordingError):
        capture_rate(replace(VINE, capture_fps=60.0), recording)
    assert capture_rate(replace(VINE, capture_fps=60.0, capture_fps_is_playback=True), recording) == 60
    assert capture_rate(replace(VINE, capture_fps=61.0), recording) == 61


def tracked(clip: Path, exposure_frames: float) -> tuple[Trial, object]:
    trial = replace(VINE, video=clip, capture_fps=FPS, m_per_px=SCALE_MM / 1e3, exposure_s=exposure_frames / FPS)
    return trial, track_recording(trial)


SHEET = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
SETTINGS = "capture_fps: 1069\ngrowth_angle_deg: 0\ncalibration: {kind: mm_per_px, mm_per_px: 0.24}\n"


def surveyed(clip: Path, folder: Path, row: str, settings: str) -> tuple[list[str], Surveyor]:
    folder.mkdir()
    (folder / "a.mp4").symlink_to(clip)
    (folder / "trials.csv").write_text(SHEET + row)
    (folder / "experiment.yaml").write_text(settings)
    surveyor = Surveyor()
    return [f"{p.severity} {p.column}" for p in check_experiment(folder, surveyor)], surveyor


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_trial_with_a_scale_of_its_own_is_looked_at_by_it_as_in_a_run(clip: Path, tmp_path: Path) -> None:
    folder = tmp_path / "v"
    surveyed(clip, folder, "a,a.mp4,12,100,140,36,3\n", SETTINGS)
    row = "a.mp4,12,100,140,36,3"
    (folder / "trials.csv").write_text(f"{SHEET.strip()},mm_per_px\na,{row},\nb,{row},0.2\n")
    surveyor = Surveyor()
    check_experiment(folder, surveyor)
    assert {trial.name: facts.mm_per_px for trial, facts in surveyor.facts.items()} == pytest.approx(
        {"a": 0.24, "b": 0.2}
    )


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


@pytest.mark.slow
def test_a_scale_a_fifth_off_is_kept_with_the_trial_for_the_verdict(clip: Path, tmp_path: Path) -> None:
    folder = tmp_path / "vines"
    folder.mkdir()
    shutil.copy(clip, folder / "a.mp4")
    columns = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,mm_per_px,capture_fps"
    for name, scale in (("right", SCALE_MM), ("off", 0.8 * SCALE_MM)):
        (folder / "trials.csv").write_text(f"{columns}\n{name},a.mp4,12,100,140,60,3,{scale},{FPS}\n")
        analyse_trials(Job(read_experiment(folder), tmp_path / "out", run_settings({})))
    noted = {name: read_json(Results(tmp_path / "out").analysed(name)) for name in ("right", "off")}
    assert (noted["right"]["contradictions"], noted["right"]["row"]["status"]) == ([], "ok")
    (entry,) = noted["off"]["contradictions"]
    assert entry["column"] == "diameter_mm"
    assert noted["off"]["row"]["status"] == "warning"
