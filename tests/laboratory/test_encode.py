"""What is written can be read again by other software, and is what was rendered."""

from __future__ import annotations

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Camera, Encoding, Scene, Sensor, preset

DEMO = replace(preset("demo"), camera=Camera(width_px=320, height_px=128))
SETTINGS = {"n_frames": 24, "capture_fps": 1069.0, "seed": 7}


def growth_m(time_s):
    return 2.0 * np.clip(np.asarray(time_s) - 0.005, 0, None)


def film(scene: Scene, path):
    return render_recording(scene, growth_m, out_path=path, **SETTINGS)


def rendered(scene: Scene, index: int) -> np.ndarray:
    return FrameRenderer(scene, growth_m, **SETTINGS).frame(index)


def test_h264_holds_every_frame_at_the_rendered_levels_in_the_limited_range(tmp_path):
    truth = film(replace(DEMO, encoding=Encoding(gop=8)), tmp_path / "trial.mp4")
    with av.open(str(tmp_path / "trial.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(60)
        frames = list(container.decode(video=0))
    assert len(frames) == truth.time_s.size == 24
    assert [index for index, frame in enumerate(frames) if frame.key_frame] == [0, 8, 16]
    error = frames[10].to_ndarray(format="yuv420p")[:128].astype(float) - (
        16 + 219 * rendered(DEMO, 10).astype(float) / 255
    )
    assert abs(error.mean()) < 0.2
    assert 10 * np.log10(219**2 / (error**2).mean()) > 36


def test_bitrate_is_kept_at_the_containers_rate(tmp_path):
    scene = replace(DEMO, encoding=Encoding(bitrate_Mbit_s=3.0))
    render_recording(scene, growth_m, out_path=tmp_path / "trial.mp4", n_frames=120, capture_fps=1069.0)
    rate_Mbit_s = (tmp_path / "trial.mp4").stat().st_size * 8 / (120 / 60) / 1e6
    assert rate_Mbit_s == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_ffv1_and_pictures_lose_nothing(tmp_path, bit_depth):
    scene = replace(DEMO, sensor=Sensor(bit_depth=bit_depth), encoding=Encoding(codec="ffv1"))
    film(scene, tmp_path / "trial.mkv")
    with av.open(str(tmp_path / "trial.mkv")) as container:
        plane = list(container.decode(video=0))[9].planes[0]
    levels = np.frombuffer(plane, dtype=np.uint8 if bit_depth == 8 else np.uint16)
    row = plane.line_size // levels.itemsize
    assert (levels.reshape(-1, row)[:128, :320] == rendered(scene, 9)).all()
    for _ in range(2):  # the second replaces the first
        film(scene, tmp_path / "trial")
    pictures = sorted((tmp_path / "trial").iterdir())
    assert len(pictures) == 24
    assert (cv2.imread(str(pictures[9]), cv2.IMREAD_UNCHANGED) == rendered(scene, 9)).all()


def test_twelve_bits_do_not_fit_into_h264(tmp_path):
    with pytest.raises(ValueError, match="12"):
        film(replace(DEMO, sensor=Sensor(bit_depth=12)), tmp_path / "trial.mp4")
    assert not (tmp_path / "trial.mp4").exists()
