"""Reading recordings: brightness unchanged, every frame, the file's faults said in one sentence each."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from plain_scene import write_images, write_video

from vinetrack.video.frames import (
    RecordingError,
    Region,
    inspect_recording,
    iterate_frames,
    read_frames,
    slots_from_times,
)

RNG = np.random.default_rng(5)
FRAMES = (np.add.outer(np.arange(24) * 3, np.add.outer(np.arange(48), np.arange(64))) % 200 + 20).astype(np.uint8)
NOISE = RNG.integers(0, 255, (60, 96, 128)).astype(np.uint8)


@pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
def test_ffv1_gives_back_every_value(tmp_path, name):
    path = write_video(tmp_path / name, FRAMES, codec="ffv1", pix_fmt="gray")
    frames = read_frames(path)
    assert np.array_equal(frames.luma, FRAMES)
    assert frames.luma.dtype == np.uint8
    assert frames.notes == ()


def test_sixteen_bit_ffv1_gives_back_every_value(tmp_path):
    deep = FRAMES.astype(np.uint16) * 251
    path = write_video(tmp_path / "deep.mkv", deep, codec="ffv1", pix_fmt="gray16le")
    frames = read_frames(path)
    assert frames.luma.dtype == np.uint16
    assert np.array_equal(frames.luma, deep)


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv"])
def test_h264_is_read_from_its_y_plane(tmp_path, name):
    path = write_video(tmp_path / name, FRAMES, options={"crf": "1"})
    frames = read_frames(path)
    # Limited range squeezes 255 levels into 219; the bright end of a ramp stays the bright end.
    expected = 16 + FRAMES.astype(float) * 219 / 255
    assert frames.luma.shape == FRAMES.shape
    assert np.abs(frames.luma - expected).mean() < 1.5


def test_region_is_the_same_pixels_of_the_whole(tmp_path):
    path = write_video(tmp_path / "a.mkv", FRAMES, codec="ffv1", pix_fmt="gray")
    region = Region(left=10, top=4, right=50, bottom=30)
    assert np.array_equal(read_frames(path, region).luma, FRAMES[:, 4:30, 10:50])


def test_frames_iterated_are_the_frames_read(tmp_path):
    path = write_video(tmp_path / "a.mkv", FRAMES, codec="ffv1", pix_fmt="gray")
    one_by_one = np.stack(list(iterate_frames(inspect_recording(path))))
    assert np.array_equal(one_by_one, FRAMES)


def test_playback_rate_is_never_taken_for_the_capture_rate(tmp_path):
    recording = inspect_recording(write_video(tmp_path / "a.mp4", FRAMES, playback_fps=60))
    assert recording.capture_fps is None
    assert recording.declared_frames == len(FRAMES)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_numbered_folder_gives_back_every_value(tmp_path, suffix):
    frames = read_frames(write_images(tmp_path / "shots", FRAMES, suffix))
    assert np.array_equal(frames.luma, FRAMES)


def test_sixteen_bit_folder_keeps_its_depth(tmp_path):
    deep = FRAMES.astype(np.uint16) * 200
    assert np.array_equal(read_frames(write_images(tmp_path / "shots", deep, ".png")).luma, deep)


def test_jpeg_folder_is_read(tmp_path):
    smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), 4) for frame in FRAMES])
    frames = read_frames(write_images(tmp_path / "shots", smooth, ".jpg"))
    assert np.abs(frames.luma.astype(float) - smooth).mean() < 2


def test_colour_pictures_become_brightness(tmp_path):
    folder = tmp_path / "colour"
    folder.mkdir()
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[..., 1] = 200
    for i in range(6):
        cv2.imwrite(str(folder / f"c{i}.png"), picture)
    luma = read_frames(folder).luma
    assert luma.shape == (6, 20, 30)
    assert np.all(np.abs(luma.astype(int) - 117) <= 1)  # 0.587 · 200


def test_tiff_stack_gives_back_every_page(tmp_path):
    path = tmp_path / "stack.tif"
    cv2.imwritemulti(str(path), list(FRAMES.astype(np.uint16) * 17))
    assert np.array_equal(read_frames(path).luma, FRAMES.astype(np.uint16) * 17)


def test_picture_missing_by_its_number_leaves_a_gap(tmp_path):
    folder = write_images(tmp_path / "shots", FRAMES, step=3)
    (folder / "frame_0031.png").unlink()
    frames = read_frames(folder)
    assert len(frames) == 23
    assert frames.slot.tolist() == [i for i in range(24) if i != 10]
    assert "1 pictures are missing by their numbers" in frames.notes[0]


def test_picture_named_otherwise_is_left_out_and_named(tmp_path):
    folder = write_images(tmp_path / "shots", FRAMES)
    cv2.imwrite(str(folder / "background.png"), FRAMES[0])
    frames = read_frames(folder)
    assert len(frames) == 24
    assert "background.png" in frames.notes[0]


def test_picture_cut_short_is_marked_damaged(tmp_path):
    folder = write_images(tmp_path / "shots", FRAMES, ".jpg")
    victim = folder / "frame_0005.jpg"
    victim.write_bytes(victim.read_bytes()[:-200])
    frames = read_frames(folder)
    assert frames.damaged.tolist() == [i == 4 for i in range(24)]
    assert "frame_0005.jpg" in frames.notes[0]


def write_dng(path, picture, fps):
    """A minimal CinemaDNG frame: one strip of 16-bit mosaic, tags 33434 (exposure) and 51044 (rate)."""
    height, width = picture.shape
    data = picture.astype("<u2").tobytes()
    entries = [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 32803),
        (273, 4, 1, None), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, len(data)),
        (33434, 5, 1, (1, 5000)), (50706, 1, 4, 0x00000401), (51044, 10, 1, (round(fps * 1000), 1000)),
    ]  # fmt: skip
    directory = 8 + 2 + 12 * len(entries) + 4
    rationals, blob = directory, b""
    body = struct.pack("<H", len(entries))
    for tag, kind, count, value in entries:
        if isinstance(value, tuple):
            body += struct.pack("<HHII", tag, kind, count, rationals + len(blob))
            blob += struct.pack("<II", *value)
        elif value is None:
            body += struct.pack("<HHII", tag, kind, count, directory + 16)
        elif kind == 3:
            body += struct.pack("<HHIHH", tag, kind, count, value, 0)
        else:
            body += struct.pack("<HHII", tag, kind, count, value)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + body + struct.pack("<I", 0) + blob + data)


def test_dng_frames_carry_rate_exposure_and_values(tmp_path):
    folder = tmp_path / "dng"
    folder.mkdir()
    flat = np.full((16, 24), 3000, np.uint16)
    for i in range(4):
        write_dng(folder / f"shot_{i:03d}.dng", flat + 10 * i, 1069.0)
    frames = read_frames(folder)
    assert frames.recording.capture_fps == pytest.approx(1069.0)
    assert frames.recording.exposure_s == pytest.approx(1 / 5000)
    assert frames.luma.dtype == np.uint16
    assert [int(picture[8, 12]) for picture in frames.luma] == [3000, 3010, 3020, 3030]


def test_video_whose_index_was_never_written_is_cut_short(tmp_path):
    path = write_video(tmp_path / "a.mp4", NOISE)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(RecordingError, match=r"a\.mp4: cut short"):
        read_frames(path)


def test_fewer_frames_than_declared_are_reported(tmp_path):
    path = write_video(tmp_path / "a.mp4", NOISE, options={"g": "5"}, container_options={"movflags": "+faststart"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = read_frames(path)
    assert 5 < len(frames) < 60
    assert any(f"{len(frames)} frames decoded where the file declares 60" in note for note in frames.notes)


def test_a_truncated_avi_is_reported(tmp_path):
    path = write_video(tmp_path / "a.avi", NOISE, codec="ffv1", pix_fmt="gray")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = read_frames(path)
    assert 5 < len(frames) < 60
    assert any("where the file declares 60" in note for note in frames.notes)


def test_damaged_bytes_are_reported_and_marked(tmp_path):
    path = write_video(tmp_path / "a.mp4", NOISE)
    data = bytearray(path.read_bytes())
    for at in RNG.integers(len(data) // 4, len(data) // 2, 60):
        data[at] ^= 0xFF
    path.write_bytes(bytes(data))
    frames = read_frames(path)
    assert any("damaged" in note for note in frames.notes)
    assert frames.damaged.any()


def test_an_empty_file_is_refused(tmp_path):
    path = tmp_path / "a.mp4"
    path.touch()
    with pytest.raises(RecordingError, match="the file is empty"):
        inspect_recording(path)


def test_text_is_not_a_video(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_text("velocity against time " * 100)
    with pytest.raises(RecordingError, match="not a video"):
        inspect_recording(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="no such file"):
        inspect_recording(tmp_path / "none.mp4")


def test_a_folder_without_images_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="holds no images"):
        inspect_recording(tmp_path)


def test_even_timestamps_are_the_index():
    slot, said = slots_from_times(np.round(np.arange(50) / 60, 3))
    assert slot.tolist() == list(range(50))
    assert said == ""


def test_timestamp_gap_is_a_missing_frame():
    times = np.delete(np.arange(50) / 60, 20)
    slot, said = slots_from_times(times)
    assert slot.tolist() == [i for i in range(50) if i != 20]
    assert "1 frames are missing" in said


def test_variable_rate_falls_back_to_the_index():
    times = np.cumsum(RNG.uniform(0.01, 0.03, 50))
    slot, said = slots_from_times(times)
    assert slot.tolist() == list(range(50))
    assert "varies" in said


def test_repeated_timestamps_fall_back_to_the_index():
    times = np.arange(50) / 60
    times[7] = times[6]
    slot, said = slots_from_times(times)
    assert slot.tolist() == list(range(50))
    assert "repeat" in said
