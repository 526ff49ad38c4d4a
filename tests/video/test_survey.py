"""Checks of recordings and calibration before any work: every problem is reported, and fast."""

from __future__ import annotations

import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from vinetrack.core.problems import Problem, format_problems
from vinetrack.experiment.folder import check_experiment
from vinetrack.video.survey import survey

HEADER = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa"
SCALE = "capture_fps: 1000\ncalibration: {kind: mm_per_px, mm_per_px: 0.3}\n"


def write_clip(path: Path, n_frames: int = 40, index_first: bool = True, codec: str = "libx264") -> None:
    """Grey noise of 96 × 64 px, so that frames are of some size; the index before or after them."""
    draw = np.random.default_rng(3)
    options = {"movflags": "+faststart"} if index_first and path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height = 96, 64
        stream.pix_fmt = "gray" if codec == "ffv1" else "yuv420p"
        stream.time_base = Fraction(1, 30)
        for i in range(n_frames):
            frame = av.VideoFrame.from_ndarray(draw.integers(0, 255, (64, 96), np.uint8), format="gray")
            frame.pts = i
            container.mux(stream.encode(frame.reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


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
    return check_experiment(folder, survey)


def test_a_sound_recording_and_scale_give_no_problem(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    assert check(folder, "a.mp4") == []


def test_a_text_file_called_mp4_is_no_video(folder: Path) -> None:
    (folder / "a.mp4").write_text("not a film\n" * 50)
    (problem,) = check(folder, "a.mp4")
    assert (problem.severity, problem.file, problem.line, problem.trial) == ("error", "trials.csv", 2, "t0")
    assert (problem.column, problem.value) == ("video", "a.mp4")
    assert "not a video" in str(problem)


def test_a_file_that_lost_the_index_at_its_end_is_cut_short(folder: Path) -> None:
    write_clip(folder / "a.mp4", index_first=False)
    cut(folder / "a.mp4", 0.7)
    (problem,) = check(folder, "a.mp4")
    assert problem.severity == "error"
    assert "cut short" in problem.message


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.mkv", "ffv1")])
def test_fewer_frames_than_declared_are_counted_without_decoding(folder: Path, name: str, codec: str) -> None:
    write_clip(folder / name, 60, codec=codec)
    cut(folder / name, 0.6)
    (problem,) = check(folder, name)
    assert problem.severity == "warning"
    assert "of the 60 frames that it declares" in problem.message
    count = int(problem.message.split(":")[1].split()[0])
    assert 25 <= count <= 40


def test_a_recording_of_three_frames_is_refused(folder: Path) -> None:
    write_clip(folder / "a.mp4", 3)
    (problem,) = check(folder, "a.mp4")
    assert (problem.severity, problem.message, problem.remedy) == ("error", "has 3 frames", "at least 5 are needed")


def test_an_empty_folder_a_missing_file_and_an_empty_file_have_different_messages(folder: Path) -> None:
    (folder / "frames").mkdir()
    (folder / "b.mp4").write_bytes(b"")
    found = check(folder, "frames", "b.mp4", "c.mp4")
    assert [problem.message for problem in found] == ["is an empty folder", "is an empty file", "does not exist"]


def test_a_folder_without_pictures_is_no_recording(folder: Path) -> None:
    (folder / "frames").mkdir()
    (folder / "frames" / "notes.txt").write_text("x")
    (problem,) = check(folder, "frames")
    assert "holds no images" in str(problem)


def test_a_rate_that_contradicts_the_frames_own_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    import vinetrack.video.survey as module

    write_clip(folder / "a.mp4")
    inspect = module.inspect_recording
    monkeypatch.setattr(module, "inspect_recording", lambda path: replace(inspect(path), capture_fps=1069.0))
    (problem,) = check(folder, "a.mp4")
    assert (problem.column, problem.severity) == ("capture_fps", "error")
    assert "1000 in the sheet but 1069 in the recording: correct the sheet" in str(problem)


def test_without_any_scale_there_is_one_problem(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    shutil.copy(folder / "a.mp4", folder / "b.mp4")
    (problem,) = check(folder, "a.mp4", "b.mp4", settings="capture_fps: 1000\n")
    assert (problem.file, problem.column) == ("experiment.yaml", "calibration")
    assert "no recording has a scale" in problem.message


def board_settings(image: str) -> str:
    return f"capture_fps: 1000\ncalibration: {{kind: checkerboard, image: {image}, squares: [5, 5], square_mm: 5}}\n"


def test_a_picture_of_another_size_than_the_recordings_is_refused_once(folder: Path) -> None:
    import cv2

    write_clip(folder / "a.mp4")
    shutil.copy(folder / "a.mp4", folder / "b.mp4")
    cv2.imwrite(str(folder / "board.png"), np.zeros((50, 50), np.uint8))
    (problem,) = check(folder, "a.mp4", "b.mp4", settings=board_settings("board.png"))
    assert (problem.file, problem.column, problem.severity) == ("experiment.yaml", "calibration.image", "error")
    assert "50 × 50 pixels but the recordings are 96 × 64" in problem.message


def test_a_picture_that_shows_no_board_is_refused(folder: Path) -> None:
    import cv2

    write_clip(folder / "a.mp4")
    cv2.imwrite(str(folder / "board.png"), np.full((64, 96), 90, np.uint8))
    (problem,) = check(folder, "a.mp4", settings=board_settings("board.png"))
    assert problem.column == "calibration.image"
    assert problem.severity == "error"


def test_a_missing_picture_is_reported_once(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    (problem,) = check(folder, "a.mp4", settings=board_settings("board.png"))
    assert (problem.column, problem.message) == ("calibration.image", "does not exist")


def test_an_axis_outside_the_picture_is_refused(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    (problem,) = check(folder, "a.mp4", settings=SCALE + "axis: {from_px: [10, 30], to_px: [200, 30]}\n")
    assert (problem.file, problem.column) == ("experiment.yaml", "axis")
    assert "leaves the picture of a.mp4, 96 × 64 pixels" in problem.message


@pytest.mark.parametrize(
    ("given", "said", "remedy"),
    [
        (
            "from_px: [10, 30], via_px: [[50, 70]], to_px: [90, 30]",
            "leaves the picture of a.mp4",
            "give points inside it",
        ),
        (
            "from_px: [1, 55], via_px: [[30, 63], [70, 63]], to_px: [95, 55]",
            "leaves the picture, 96 × 64",
            "give points inside it",
        ),
        (
            "from_px: [20, 20], via_px: [[60, 20]], to_px: [60, 50], width_mm: 30",
            "bends with a radius of",
            "fewer points",
        ),
    ],
)
def test_a_curve_that_leaves_the_picture_or_bends_too_sharply_is_refused(
    folder: Path, given: str, said: str, remedy: str
) -> None:
    write_clip(folder / "a.mp4")
    (problem,) = check(folder, "a.mp4", settings=SCALE + f"axis: {{{given}}}\n")
    assert (problem.file, problem.column, problem.severity) == ("experiment.yaml", "axis", "error")
    assert said in problem.message
    assert remedy in problem.remedy


def test_a_curve_within_the_picture_is_accepted(folder: Path) -> None:
    write_clip(folder / "a.mp4")
    settings = SCALE + "axis: {from_px: [5, 30], via_px: [[50, 34]], to_px: [90, 50], width_mm: 2}\n"
    assert not [problem for problem in check(folder, "a.mp4", settings=settings) if problem.column == "axis"]


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
