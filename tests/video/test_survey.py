"""Checks of recordings, scales and sizes before any work."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_scene import write_video

from vinetrack.core.records import PictureAxis, Trial
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.laboratory.campaigns import render_recording
from vinetrack.laboratory.scene import Tube, preset
from vinetrack.video import survey as module
from vinetrack.video.axis import askew_trials
from vinetrack.video.frames import RecordingError, inspect_recording
from vinetrack.video.images import capture_rate
from vinetrack.video.survey import RecordingFacts, Surveyor

HEADER = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa"
ROW = "24,200,280,28,3"
SCALE = "capture_fps: 1000\ncalibration: {kind: mm_per_px, mm_per_px: 0.3}\n"
FILMED = "capture_fps: 1069\ngrowth_angle_deg: 0\ncalibration: {kind: mm_per_px, mm_per_px: 0.24}\n"
RIGHT = "12,100,140,36,3"
BOARD = "calibration: {kind: checkerboard, image: board.png, squares: [5, 5], square_mm: 5}\n"
NO_SCALES = {
    "no scale": ("", None, "error calibration"),
    "no picture": (BOARD, None, "error calibration.image"),
    "picture of another size": (BOARD, (50, 50), "error calibration.image"),
    "no board": (BOARD, (64, 96), "error calibration.image"),
}
FPS, SCALE_MM = 1069.0, 0.24
VINE = Trial(name="a", diameter_m=0.012, length_m=0.14)
FACTS = RecordingFacts(
    trial="a", n_frames=100, capture_fps=FPS, playback_fps=60.0, mm_per_px=SCALE_MM, picture_mm=230.0, axis=None,
    tube_width_mm=12.1, tube_width_sigma_mm=0.25, growth_mm=138.0,
)  # fmt: skip


SWAPPED = replace(VINE, diameter_m=VINE.length_m, length_m=VINE.diameter_m)
SLOPES_DEG = [([0, 1, -2, 179, 1], ""), ([0, 1, -2, 60, 1], "d"), ([0, 1, -2, 60, -35], "de")]
SLOPES_DEG += [([0, 1, 60, 61], ""), ([0, 60], ""), ([88, 90, -89, 0], "d")]


def write_clip(path: Path, n_frames: int = 40, index_first: bool = True, share: float = 1.0) -> None:
    """Grey noise of 96 × 64 px, so that frames are of some size, cut short; the index before or after them."""
    noise = np.random.default_rng(3).integers(0, 255, (n_frames, 64, 96), np.uint8)
    options = {"movflags": "+faststart"} if index_first and path.suffix == ".mp4" else {}
    codec, kind = ("ffv1", "gray") if path.suffix == ".mkv" else ("libx264", "yuv420p")
    write_video(path, noise, codec, kind, container_options=options)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def check(folder: Path, *videos: str, settings: str = SCALE, header: str = HEADER, row: str = ROW) -> list[str]:
    """Severity, file, trial and column of every problem."""
    rows = [f"t{i},{video},{row}" for i, video in enumerate(videos)]
    (folder / "trials.csv").write_text("\n".join([header, *rows, ""]))
    (folder / "experiment.yaml").write_text(settings)
    return [" ".join(filter(None, (p.severity, p.trial, p.column))) for p in check_experiment(folder, Surveyor())]


@pytest.mark.parametrize("fault", ["text", "empty", "cut off", "three frames", "missing", "empty folder", "no images"])
def test_what_is_no_recording_is_an_error_at_its_place(tmp_path, fault):
    path = tmp_path / "a.mp4"
    if fault in ("text", "empty"):
        path.write_text("not a film\n" * 50 if fault == "text" else "")
    elif fault == "cut off":
        write_clip(path, 40, index_first=False, share=0.7)
    elif fault == "three frames":
        write_clip(path, 3, index_first=False)
    elif fault != "missing":
        path.mkdir()
        if fault == "no images":
            (path / "notes.txt").write_text("x")
    assert check(tmp_path, "a.mp4") == ["error t0 video"]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_fewer_frames_than_declared_are_counted_without_decoding(tmp_path, name):
    write_clip(tmp_path / name, 60, share=0.6)
    assert check(tmp_path, name) == ["warning t0 video", "error t0 video"]  # noise, in which nothing grows
    problem, _ = check_experiment(tmp_path, Surveyor())
    assert 25 <= int(problem.message.split(":")[1].split()[0]) <= 40
    write_clip(tmp_path / name, 60, share=0.08)  # fewer than a track needs
    assert [(one.code, one.severity) for one in check_experiment(tmp_path, Surveyor())] == [("cut_short", "error")]


@pytest.mark.parametrize("case", NO_SCALES)
def test_what_gives_no_scale_is_reported_once(tmp_path, case):
    scale, size_px, found = NO_SCALES[case]
    for name in ("a.mp4", "b.mp4"):
        write_clip(tmp_path / name)
    if size_px is not None:
        cv2.imwrite(str(tmp_path / "board.png"), np.full(size_px, 90, np.uint8))
    assert check(tmp_path, "a.mp4", "b.mp4", settings="capture_fps: 1000\n" + scale) == [found]


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("from_px: [10, 30], to_px: [200, 30]", ["error axis"]),
        ("from_px: [10, 30], via_px: [[50, 70]], to_px: [90, 30]", ["error axis"]),
        ("from_px: [1, 55], via_px: [[30, 63], [70, 63]], to_px: [95, 55]", ["error axis"]),
        ("from_px: [20, 20], via_px: [[60, 20]], to_px: [60, 50], width_mm: 30", ["error axis"]),
        ("from_px: [5, 30], via_px: [[50, 34]], to_px: [90, 50], width_mm: 2", ["error t0 video"]),
    ],
)
def test_an_axis_that_leaves_the_picture_or_bends_too_sharply_is_refused(tmp_path, given, found):
    write_clip(tmp_path / "a.mp4")
    assert check(tmp_path, "a.mp4", settings=SCALE + f"axis: {{{given}}}\n") == found


@pytest.mark.parametrize(
    ("trial", "scale", "grown_mm", "found"),
    [
        (VINE, 1.0, 138.0, []),
        (VINE, 0.1, 13.9, ["error diameter_mm"]),
        (VINE, 0.8, 111.0, ["warning diameter_mm"]),
        (VINE, 1.2, 167.0, ["warning diameter_mm"]),
        (VINE, 10.0, 1390.0, ["error diameter_mm"]),
        (VINE, 1.0, 168.0, ["warning length_mm"]),
        (SWAPPED, 1.0, 138.0, ["error diameter_mm", "error length_mm"]),
        (replace(VINE, travel_ratio=1), 10.0, 138.0, []),
        (replace(VINE, compare_sizes=False), 10.0, 138.0, []),
    ],
)
def test_sizes_that_contradict_the_sheet_are_named_once(trial, scale, grown_mm, found):
    facts = replace(FACTS, tube_width_mm=12.1 * scale, tube_width_sigma_mm=0.25 * scale, growth_mm=grown_mm)
    assert [f"{problem.severity} {problem.column}" for problem in module.size_problems(trial, facts)] == found


@pytest.mark.parametrize(("slopes_deg", "named"), SLOPES_DEG)
def test_an_axis_that_most_recordings_do_not_have_is_named(slopes_deg, named):
    found, trials = {}, [replace(VINE, name=name) for name in "abcde"]
    for name, slope in zip("abcde", np.radians(slopes_deg), strict=False):
        found[name] = {"from_px": (20.0, 30.0), "to_px": (20.0 + 90.0 * np.cos(slope), 30.0 + 90.0 * np.sin(slope))}
    given = PictureAxis((0.0, 0.0), (50.0, 0.0))
    assert askew_trials(found, [replace(trial, axis=given) for trial in trials]) == {}
    assert askew_trials(found, trials) == dict.fromkeys(named, len(slopes_deg) - len(named))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A tube of 12 mm that grows 140 mm at 6 m/s, with an exposure of half a frame, as a film of 60 a second."""
    scene = preset("half_frame_exposure")
    assert isinstance(scene.subject, Tube)
    tube = replace(scene.subject, diameter_m=0.012, length_m=0.14)
    scene = replace(scene, subject=tube, camera=replace(scene.camera, m_per_px=SCALE_MM / 1e3))
    path = tmp_path_factory.mktemp("clip") / "a.mp4"
    grown = lambda time_s: np.clip(6.0 * (time_s - 0.015), 0, 0.14)  # noqa: E731
    render_recording(scene, grown, n_frames=60, capture_fps=FPS, out_path=path, seed=20950)
    return path


def test_the_rate_of_playback_is_refused_unless_it_is_said_to_be_that_of_capture(clip):
    recording = inspect_recording(clip)
    assert recording.playback_fps == 60
    with pytest.raises(RecordingError):
        capture_rate(replace(VINE, capture_fps=60.0), recording)
    assert capture_rate(replace(VINE, capture_fps=60.0, capture_fps_is_playback=True), recording) == 60
    assert capture_rate(replace(VINE, capture_fps=61.0), recording) == 61


@pytest.mark.slow
def test_check_reports_the_facts_of_a_correct_recording(clip, tmp_path):
    """Of two trials, the second of which has a scale of its own."""
    for name in (names := ("a.mp4", "b.mp4")):
        (tmp_path / name).symlink_to(clip)
    found = check(tmp_path, *names, settings=FILMED, header=f"{HEADER},mm_per_px", row=RIGHT + ",")
    assert found == []
    sheet = tmp_path / "trials.csv"
    sheet.write_text(sheet.read_text().removesuffix("\n") + "0.2\n")
    surveyor = Surveyor()
    check_experiment(tmp_path, surveyor)
    facts, other = surveyor.facts.values()
    assert other.mm_per_px == pytest.approx(0.2)
    assert (facts.n_frames, facts.capture_fps, facts.playback_fps) == (60, 1069, 60)
    assert facts.picture_mm == pytest.approx(0.24 * 960)
    assert facts.tube_width_mm == pytest.approx(12, rel=0.04)
    assert facts.growth_mm == pytest.approx(140, rel=0.04)
    assert facts.mean_speed_m_s == pytest.approx(6, rel=0.1)
    experiment = read_experiment(tmp_path)
    trial = experiment.trials[0]
    tracked = module.tracked_facts(trial, module.measure_recording(trial, experiment.settings, experiment.folder))
    assert repr(facts) == repr(tracked)  # what the tracker says, to the last digit


@pytest.mark.parametrize(
    ("row", "settings", "expected"),
    [
        (RIGHT, FILMED.replace("1069", "60"), ["error t0 capture_fps"]),
        (RIGHT, FILMED.replace("0.24", "0.024"), ["error t0 diameter_mm"]),
        (RIGHT, FILMED + "exposure_us: 0.0935\n", ["warning exposure_us", "warning t0 exposure_us"]),
        (RIGHT, FILMED + "exposure_ms: 93.5\n", ["note exposure_ms", "error t0 exposure_us"]),
    ],
    ids=["rate", "scale ×10", "ms as µs", "µs as ms"],
)
def test_check_catches_a_mistake(clip, tmp_path, row, settings, expected):
    (tmp_path / "a.mp4").symlink_to(clip)
    assert check(tmp_path, "a.mp4", settings=settings, row=row) == expected
