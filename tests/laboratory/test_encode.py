"""What is written can be read again by other software, is what was rendered, and is broken where it should be."""

from __future__ import annotations

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest
import tifffile

from vinetrack.laboratory.render import FrameRenderer, render_recording
from vinetrack.laboratory.scene import Camera, Encoding, Faults, Scene, Sensor, preset

SMALL = Camera(width_px=320, height_px=128)
DEMO = replace(preset("demo"), camera=SMALL)
SETTINGS = {"n_frames": 24, "capture_fps": 1069.0, "seed": 7}


def growth_m(time_s):
    return 2.0 * np.clip(np.asarray(time_s) - 0.005, 0, None)


def film(scene: Scene, path):
    return render_recording(scene, growth_m, out_path=path, **SETTINGS)


def rendered(scene: Scene, index: int) -> np.ndarray:
    return FrameRenderer(scene, growth_m, **SETTINGS).frame(index)


def decoded(path) -> list[av.VideoFrame]:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


@pytest.mark.parametrize("ending", [".mp4", ".mov", ".mkv", ".avi"])
def test_h264_holds_every_frame_and_claims_60_fps(tmp_path, ending):
    path = tmp_path / f"trial{ending}"
    truth = film(DEMO, path)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert float(stream.average_rate) == pytest.approx(60)
        assert len(list(container.decode(stream))) == 24
    assert truth.time_s.size == 24


def test_h264_shows_the_rendered_levels_in_the_limited_range(tmp_path):
    path = tmp_path / "trial.mp4"
    film(DEMO, path)
    frame = decoded(path)[10]
    shown = frame.to_ndarray(format="yuv420p")[:128].astype(float)
    expected = 16 + 219 * rendered(DEMO, 10).astype(float) / 255
    error = shown - expected
    assert abs(error.mean()) < 0.2
    assert 10 * np.log10(219**2 / (error**2).mean()) > 36


def test_full_range_is_said_in_the_stream(tmp_path):
    path = tmp_path / "trial.mp4"
    film(replace(DEMO, encoding=Encoding(limited_range=False)), path)
    frame = decoded(path)[10]
    assert frame.color_range == av.video.reformatter.ColorRange.JPEG
    plane = np.frombuffer(frame.planes[0], dtype=np.uint8).reshape(-1, frame.planes[0].line_size)[:128, :320]
    assert abs((plane.astype(float) - rendered(DEMO, 10)).mean()) < 0.2


def test_bitrate_is_kept_at_the_containers_rate(tmp_path):
    path = tmp_path / "trial.mp4"
    scene = replace(DEMO, encoding=Encoding(bitrate_Mbit_s=3.0))
    render_recording(scene, growth_m, out_path=path, n_frames=120, capture_fps=1069.0)
    rate_Mbit_s = path.stat().st_size * 8 / (120 / 60) / 1e6
    assert rate_Mbit_s == pytest.approx(3.0, rel=0.2)


def test_key_frames_come_every_gop(tmp_path):
    path = tmp_path / "trial.mp4"
    film(replace(DEMO, encoding=Encoding(gop=8)), path)
    assert [index for index, frame in enumerate(decoded(path)) if frame.key_frame] == [0, 8, 16]


@pytest.mark.parametrize(("bit_depth", "name"), [(8, "gray"), (10, "gray10le"), (12, "gray12le"), (16, "gray16le")])
def test_ffv1_loses_nothing(tmp_path, bit_depth, name):
    scene = replace(DEMO, sensor=Sensor(bit_depth=bit_depth), encoding=Encoding(codec="ffv1"))
    path = tmp_path / "trial.mkv"
    film(scene, path)
    frame = decoded(path)[9]
    assert frame.format.name == name
    plane = np.frombuffer(frame.planes[0], dtype=np.uint8 if bit_depth == 8 else np.uint16)
    row = frame.planes[0].line_size // plane.itemsize
    assert (plane.reshape(-1, row)[:128, :320] == rendered(scene, 9)).all()


@pytest.mark.parametrize("codec", ["mjpeg", "raw"])
def test_other_codecs_in_an_avi(tmp_path, codec):
    path = tmp_path / "trial.avi"
    film(replace(DEMO, encoding=Encoding(codec=codec)), path)
    frames = decoded(path)
    assert len(frames) == 24
    shown = np.frombuffer(frames[9].planes[0], dtype=np.uint8).reshape(-1, frames[9].planes[0].line_size)[:128, :320]
    assert np.abs(shown.astype(float) - rendered(DEMO, 9)).mean() < (4 if codec == "mjpeg" else 1e-9)


@pytest.mark.parametrize(("codec", "bit_depth"), [("png", 8), ("png", 16), ("tiff", 12)])
def test_folder_of_pictures_loses_nothing(tmp_path, codec, bit_depth):
    scene = replace(DEMO, sensor=Sensor(bit_depth=bit_depth), encoding=Encoding(codec=codec))
    film(scene, tmp_path / "trial")
    pictures = sorted((tmp_path / "trial").iterdir())
    assert [picture.name for picture in pictures][:2] == [f"frame_000000.{codec}", f"frame_000001.{codec}"]
    assert len(pictures) == 24
    assert (cv2.imread(str(pictures[9]), cv2.IMREAD_UNCHANGED) == rendered(scene, 9)).all()


def test_stack_loses_nothing(tmp_path):
    scene = replace(DEMO, sensor=Sensor(bit_depth=12))
    film(scene, tmp_path / "trial.tif")
    stack = tifffile.imread(tmp_path / "trial.tif")
    assert stack.shape == (24, 128, 320)
    assert (stack[9] == rendered(scene, 9)).all()


def test_dng_carries_the_true_rate_and_exposure(tmp_path):
    scene = replace(DEMO, sensor=Sensor(bit_depth=12), encoding=Encoding(codec="dng"))
    truth = film(scene, tmp_path / "trial")
    with tifffile.TiffFile(tmp_path / "trial" / "frame_000009.dng") as file:
        tags = file.pages[0].tags
        ticks, period = tags[51044].value
        seconds, parts = tags[33434].value
        assert (file.pages[0].asarray() == rendered(scene, 9)).all()
    assert ticks / period == pytest.approx(1069.0, rel=1e-5)
    assert seconds / parts == pytest.approx(truth.exposure_s, rel=1e-4)


def test_colour_keeps_the_brightness_and_adds_a_tint(tmp_path):
    scene = replace(DEMO, sensor=Sensor(colour=True))
    film(scene, tmp_path / "trial")
    picture = cv2.imread(str(tmp_path / "trial" / "frame_000009.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (128, 320, 3)
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(float)
    assert np.abs(grey - rendered(scene, 9)).mean() < 1.5
    assert picture[60, 300].max() - picture[60, 300].min() > 5


def test_frame_written_twice_is_the_same_picture_and_a_missed_one_is_gone(tmp_path):
    scene = replace(DEMO, faults=Faults(dropped=(5,), repeated=(8,)), encoding=Encoding(codec="ffv1"))
    truth = film(scene, tmp_path / "trial.mkv")
    frames = [np.frombuffer(frame.planes[0], dtype=np.uint8) for frame in decoded(tmp_path / "trial.mkv")]
    assert truth.source_frame.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 8, *range(9, 24)]
    assert (frames[7] == frames[8]).all()
    assert (frames[6] != frames[7]).any()
    assert np.diff(truth.time_s)[4] == pytest.approx(2 / 1069)


def test_file_cut_short_holds_fewer_frames_than_it_declares(tmp_path):
    film(replace(DEMO, faults=Faults(keep_fraction=0.6)), tmp_path / "trial.mp4")
    count = 0
    with av.open(str(tmp_path / "trial.mp4")) as container:
        assert container.streams.video[0].frames == 24
        try:
            for _ in container.decode(video=0):
                count += 1
        except av.error.FFmpegError:
            pass
    assert 4 < count < 20


def test_damaged_bytes_change_what_is_shown(tmp_path):
    film(DEMO, tmp_path / "whole.mp4")
    film(replace(DEMO, faults=Faults(damaged_fraction=0.02)), tmp_path / "damaged.mp4")
    whole, damaged = ((tmp_path / name).read_bytes() for name in ("whole.mp4", "damaged.mp4"))
    assert len(whole) == len(damaged)
    differing = np.frombuffer(whole, np.uint8) != np.frombuffer(damaged, np.uint8)
    assert 0.01 < differing.mean() < 0.03
    assert not differing[: len(whole) // 10].any()


def test_corrupt_first_frame_is_rubbish_and_the_rest_is_not(tmp_path):
    scene = replace(DEMO, faults=Faults(corrupt_first_frame=True), encoding=Encoding(codec="png"))
    truth = film(scene, tmp_path / "trial")
    first, second = (cv2.imread(str(tmp_path / "trial" / f"frame_00000{k}.png"), 0).astype(float) for k in (0, 1))
    assert np.isnan(truth.lead_position_m[0])
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.2
    assert (second == rendered(scene, 1)).all()


def test_truth_goes_where_it_is_told_and_reads_back(tmp_path):
    path = tmp_path / "elsewhere" / "trial.csv"
    truth = render_recording(DEMO, growth_m, out_path=tmp_path / "videos" / "trial.mp4", truth_path=path, **SETTINGS)
    assert [item.name for item in (tmp_path / "videos").iterdir()] == ["trial.mp4"]
    table = np.genfromtxt(path, delimiter=",", names=True)
    assert table["lead_position_m"] == pytest.approx(truth.lead_position_m, abs=1e-9)
    assert table["tip_x_px"] == pytest.approx(truth.tip_x_px, abs=1e-6)


def test_writing_again_replaces_a_folder(tmp_path):
    for n_frames in (6, 3):
        render_recording(DEMO, growth_m, out_path=tmp_path / "trial", n_frames=n_frames, capture_fps=1000.0)
    assert len(list((tmp_path / "trial").iterdir())) == 3
    assert [item.name for item in tmp_path.iterdir()] == ["trial"]


@pytest.mark.parametrize(
    ("name", "scene", "match"),
    [
        ("trial.mp4", replace(DEMO, sensor=Sensor(bit_depth=12)), "holds 8 bits, not 12; use ffv1 or TIFF"),
        ("trial.avi", replace(DEMO, encoding=Encoding(codec="h265")), "Unknown codec 'h265'; choose one of h264"),
        ("trial.xyz", DEMO, "end it in .mp4"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, name, scene, match):
    with pytest.raises(ValueError, match=match):
        film(scene, tmp_path / name)
    assert not (tmp_path / name).exists()
