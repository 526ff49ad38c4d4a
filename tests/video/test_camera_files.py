"""Files of high-speed cameras: values, rate and exposure of capture exactly; what is not read is refused."""

from __future__ import annotations

import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_files import write_cine, write_mraw, write_side_file
from plain_scene import Plan, plain_scene, write_images

from vinetrack.core.records import Trial
from vinetrack.video.frames import PHANTOM_TABLE, RecordingError, Region, inspect_recording, iterate_frames, read_frames
from vinetrack.video.images import capture_exposure, capture_rate
from vinetrack.video.track import track_recording

RNG = np.random.default_rng(11)
DEEP = RNG.integers(0, 4096, (9, 24, 32)).astype(np.uint16)
TEN = RNG.integers(0, 1024, (9, 24, 32)).astype(np.uint16)
EIGHT = RNG.integers(0, 256, (9, 24, 32)).astype(np.uint8)


@pytest.mark.parametrize(
    ("frames", "options", "expected", "depth"),
    [
        (EIGHT, {"real_bits": 8}, EIGHT, 8),
        (DEEP, {}, DEEP, 12),
        (DEEP, {"pack": 1024, "annotation": b"12345678"}, DEEP, 12),
        (TEN, {"pack": 256}, PHANTOM_TABLE[TEN], 12),
    ],
    ids=["8 bit", "16 bit", "packed 12 bit", "packed 10 bit"],
)
def test_a_cine_gives_back_every_value(tmp_path, frames, options, expected, depth):
    path = write_cine(tmp_path / "a.cine", frames, **options)
    read = read_frames(path)
    assert np.array_equal(read.luma, expected)
    assert read.luma.dtype == expected.dtype
    assert (read.recording.bit_depth, read.recording.declared_frames, read.notes) == (depth, 9, ())
    assert np.array_equal(np.stack(list(iterate_frames(read.recording))), expected)
    region = Region(4, 2, 20, 15)
    assert np.array_equal(read_frames(path, region).luma, expected[:, 2:15, 4:20])


def test_the_table_of_packed_cines_is_that_of_the_vendor():
    """Ends, middle and checksum as another reader (pycine 0.3.2) has it."""
    known = {0: 2, 1: 5, 2: 6, 159: 154, 160: 156, 512: 998, 1014: 4064, 1015: 4095, 1023: 4095}
    assert PHANTOM_TABLE[list(known)].tolist() == list(known.values())
    assert zlib.crc32(PHANTOM_TABLE.astype("<u2").tobytes()) == 2008231938


def test_a_cine_states_rate_and_exposure(tmp_path):
    recording = inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, rate=10_000, exposure_ns=93_458))
    assert recording.capture_fps == 10_000
    assert recording.exposure_s == pytest.approx(93.458e-6)
    assert recording.playback_fps is None


def test_an_old_cine_states_its_exposure_in_microseconds(tmp_path):
    path = write_cine(tmp_path / "a.cine", EIGHT, exposure_ns=93_458, setup_bytes=1500)
    assert inspect_recording(path).exposure_s == pytest.approx(93e-6)


def test_time_stamps_show_missing_frames(tmp_path):
    times = np.delete(np.arange(10), 4) / 5000 + 0.7
    read = read_frames(write_cine(tmp_path / "a.cine", EIGHT, times_s=times, exposures_s=np.full(9, 40e-6)))
    assert read.slot.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert read.recording.capture_fps == 5000
    assert read.recording.exposure_s == pytest.approx(40e-6, rel=1e-4)
    assert "1 frames are missing according to the timestamps" in read.notes[0]


def test_frames_saved_one_in_four_have_their_own_rate(tmp_path):
    recording = inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, times_s=np.arange(9) / 1250))
    assert recording.capture_fps == pytest.approx(1250, rel=1e-6)
    assert "set to 5000 frames a second, but its frames are 1250 a second" in recording.notes[0]


def test_automatic_exposure_is_reported(tmp_path):
    recording = inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, exposures_s=np.linspace(2, 4, 9) * 1e-5))
    assert "exposure changes from frame to frame, 20 to 40 µs" in recording.notes[0]


def test_a_mosaic_of_colours_is_levelled(tmp_path):
    """A grey scene behind filters that pass 1/2, 1 and 1/4 comes out even."""
    mosaic = np.full((9, 24, 32), 800, np.uint16)
    mosaic[:, ::2, ::2] = 400
    mosaic[:, 1::2, 1::2] = 200
    luma = read_frames(write_cine(tmp_path / "a.cine", mosaic, compression=2, colour_filter=3)).luma
    assert np.unique(luma[:, 2:-2, 2:-2]).tolist() == [550]


@pytest.mark.parametrize(
    "options",
    [{"version": 3}, {"compression": 1}, {"compression": 2, "colour_filter": 0x80000003}, {"bit_count": 24}],
)
def test_an_unsupported_cine_is_refused(tmp_path, options):
    with pytest.raises(RecordingError, match=r"a\.cine: .* is not read"):
        inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, **options))


@pytest.mark.parametrize("keep", [30, 100, 900, 2000, 5900])
def test_a_cine_truncated_in_its_header_is_refused_in_one_sentence(tmp_path, keep):
    whole = write_cine(tmp_path / "a.cine", EIGHT).read_bytes()
    (tmp_path / "a.cine").write_bytes(whole[:keep])
    with pytest.raises(RecordingError, match="copy it from the camera again"):
        read_frames(tmp_path / "a.cine")


def test_a_truncated_cine_gives_its_whole_frames(tmp_path):
    path = write_cine(tmp_path / "a.cine", EIGHT)
    path.write_bytes(path.read_bytes()[:-1500])
    read = read_frames(path)
    assert np.array_equal(read.luma, EIGHT[:7])
    assert "the file holds 7 frames but declares 9: cut short" in read.notes[-1]


@pytest.mark.parametrize("side", [".cih", ".cihx"])
@pytest.mark.parametrize(("bits", "frames"), [(8, EIGHT), (12, DEEP), (16, DEEP)])
def test_an_mraw_gives_back_every_value_rate_and_exposure(tmp_path, bits, frames, side):
    path = write_mraw(tmp_path / "a.mraw", frames, bits, side, depth=min(bits, 12))
    read = read_frames(path)
    assert np.array_equal(read.luma, frames)
    assert (read.recording.capture_fps, read.recording.bit_depth) == (20000, min(bits, 12))
    assert read.recording.exposure_s == pytest.approx(25e-6)
    assert np.array_equal(read_frames(path.with_suffix(side)).luma, frames)


@pytest.mark.parametrize("shutter", ["1/40000", "0.000025", "2.5e-05", "40000"])
def test_an_exposure_is_read_as_any_of_their_programs_writes_it(tmp_path, shutter):
    assert inspect_recording(write_mraw(tmp_path / "a.mraw", DEEP, shutter=shutter)).exposure_s == pytest.approx(25e-6)


def test_an_exposure_longer_than_a_frame_is_ignored(tmp_path):
    assert inspect_recording(write_mraw(tmp_path / "a.mraw", DEEP, shutter="1.000000")).exposure_s is None


def test_frames_saved_one_in_five_have_a_fifth_of_the_rate(tmp_path):
    recording = inspect_recording(write_mraw(tmp_path / "a.mraw", DEEP, step=5))
    assert recording.capture_fps == 4000
    assert "every 5th frame was saved" in recording.notes[0]


@pytest.mark.parametrize("options", [{"bits": 10}, {"colour": "Color", "bits": 24}, {"form": "AVI"}, {"total": 0}])
def test_an_unsupported_mraw_is_refused(tmp_path, options):
    path = write_mraw(tmp_path / "a.mraw", DEEP)
    write_side_file(path.with_suffix(".cih"), DEEP, **options)
    with pytest.raises(RecordingError, match=r"a\.cih"):
        inspect_recording(path)


def test_an_mraw_and_its_side_file_need_each_other(tmp_path):
    path = write_mraw(tmp_path / "a.mraw", DEEP)
    path.with_suffix(".cih").rename(tmp_path / "b.cih")
    with pytest.raises(RecordingError, match=r"\.cih or \.cihx is missing"):
        inspect_recording(path)
    with pytest.raises(RecordingError, match=r"its \.mraw is missing"):
        inspect_recording(tmp_path / "b.cih")


def test_a_truncated_mraw_gives_its_whole_frames(tmp_path):
    path = write_mraw(tmp_path / "a.mraw", DEEP)
    path.write_bytes(path.read_bytes()[:-10])
    read = read_frames(path)
    assert np.array_equal(read.luma, DEEP[:8])
    assert "the file holds 8 frames but declares 9" in read.notes[0]


def test_a_stack_has_rate_and_exposure_of_its_side_file(tmp_path):
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(DEEP))
    assert inspect_recording(tmp_path / "a.tif").capture_fps is None
    write_side_file(tmp_path / "a.cih", DEEP, form="Tiff", rate=750, shutter="1/1000")
    recording = inspect_recording(tmp_path / "a.tif")
    assert (recording.capture_fps, recording.exposure_s, recording.bit_depth) == (750, 1e-3, 12)


def test_a_folder_of_pictures_has_rate_and_exposure_of_its_side_file(tmp_path):
    folder = write_images(tmp_path / "shots", DEEP, ".tif")
    write_side_file(folder / "shots.cihx", DEEP, form="TIFF", rate=750, shutter="0.001")
    recording = inspect_recording(folder)
    assert (recording.capture_fps, recording.exposure_s) == (750, 1e-3)


@pytest.mark.parametrize("other", [{"total": 8}, {"width": 30}, {"form": "MRaw"}])
def test_a_side_file_of_other_pictures_is_ignored(tmp_path, other):
    folder = write_images(tmp_path / "shots", DEEP, ".tif")
    write_side_file(folder / "shots.cih", DEEP, **({"form": "Tiff"} | other))
    assert inspect_recording(folder).capture_fps is None


def test_a_sheet_that_contradicts_the_recording_is_refused(tmp_path):
    recording = inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, rate=5000, exposure_ns=40_000))
    trial = Trial(name="t")
    assert (capture_rate(trial, recording), capture_exposure(trial, recording)) == (5000, pytest.approx(40e-6))
    stated = replace(trial, capture_fps=5000.0, exposure_s=40.4e-6)
    assert (capture_rate(stated, recording), capture_exposure(stated, recording)) == (5000, pytest.approx(40e-6))
    with pytest.raises(RecordingError, match="capture_fps is 1000 in the sheet but 5000 in the recording"):
        capture_rate(replace(trial, capture_fps=1000.0), recording)
    with pytest.raises(RecordingError, match="exposure_us is 400 in the sheet but 40 in the recording"):
        capture_exposure(replace(trial, exposure_s=400e-6), recording)


def test_a_packed_recording_is_tracked_as_well_as_it_is_filmed(tmp_path):
    """The square root of the packing, undone, leaves the edge where it was."""
    scene = plain_scene(Plan(seed=20941, width=480, height=120, from_px=(30.0, 60.0), end_px=400.0, radius=18.0))
    brightness = scene.frames.astype(float) * 15.0
    ten = np.abs(PHANTOM_TABLE[None, :1015].astype(float) - np.arange(4096)[:, None]).argmin(axis=1)[
        brightness.astype(int)
    ]
    trial = Trial(
        name="t", video=write_cine(tmp_path / "a.cine", ten.astype(np.uint16), pack=256, rate=1000, exposure_ns=200_000)
    )
    track = track_recording(trial).track
    off = (track.edge_px - scene.edge_px)[scene.moving]
    off -= np.median(off)
    assert np.diff(track.time_s) == pytest.approx(1e-3)
    assert np.median(np.abs(off)) < 0.2
