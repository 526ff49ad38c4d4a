"""Recordings read, those of high-speed cameras too, and written: every value, rate, exposure, and the event alone."""

import math
import struct
import subprocess
import sys
import threading
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import av
import av.logging
import cv2
import numpy as np
import pytest
from camera_files import write_cine, write_mraw, write_side_file
from plain_scene import Plan, plain_scene, write_images, write_video

from vinetrack.core.records import Track, Trial, with_flag
from vinetrack.laboratory.campaigns import Filming, GroundTruth, film, grow
from vinetrack.laboratory.render import Truth
from vinetrack.laboratory.scene import Camera
from vinetrack.report.build import write_clip
from vinetrack.video import frames as module
from vinetrack.video.axis import MARGIN_FRAMES, event_range, read_event
from vinetrack.video.frames import PHANTOM_TABLE, Frames, RecordingError, inspect_recording, read_frames
from vinetrack.video.images import capture_exposure, capture_rate
from vinetrack.video.strip import camera_unit
from vinetrack.video.track import track_frames, track_recording

RNG = np.random.default_rng(5)
FRAMES = (np.add.outer(np.arange(24) * 3, np.add.outer(np.arange(48), np.arange(64))) % 200 + 20).astype(np.uint8)
NOISE = RNG.integers(0, 255, (60, 96, 128)).astype(np.uint8)
DEEP = FRAMES.astype(np.uint16) * 17
BEFORE, AFTER = 300, 180  # Frames of rest beyond those of the scene
CAPTURE_FPS = 1069.0
KEY_FRAMES = (0, 30, 60)


@pytest.mark.parametrize(
    ("name", "given"), [("a.mkv", FRAMES), ("a.avi", FRAMES), ("a.mkv", DEEP), ("a.tif", DEEP), ("shots.png", FRAMES)]
)
def test_lossless_recordings_give_back_every_value(tmp_path, name, given):
    path = tmp_path / name
    if name == "a.tif":
        cv2.imwritemulti(str(path), list(given))
    elif name == "shots.png":
        write_images(path, given)
    else:
        write_video(path, given, codec="ffv1", pix_fmt="gray" if given is FRAMES else "gray16le")
    frames = read_frames(path)
    assert np.array_equal(frames.luma, given)
    assert frames.luma.dtype == given.dtype
    assert frames.notes == ()


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv"])
def test_h264_is_read_from_its_y_plane_at_a_rate_that_is_not_of_capture(tmp_path, name):
    frames = read_frames(write_video(tmp_path / name, FRAMES, options={"crf": "1"}, playback_fps=60))
    # Limited range squeezes 255 levels into 219; the bright end of a ramp stays the bright end.
    expected = 16 + FRAMES.astype(float) * 219 / 255
    assert frames.luma.shape == FRAMES.shape
    assert np.abs(frames.luma - expected).mean() < 1.5
    assert frames.recording.capture_fps is None
    assert name == "a.mkv" or frames.recording.declared_frames == len(FRAMES)


@pytest.mark.parametrize("kind", ["folder", "stack"])
def test_pictures_that_do_not_fit_in_memory_are_refused_before_they_are_read(tmp_path, kind, monkeypatch):
    path = write_images(tmp_path / "shots", FRAMES)
    if kind == "stack":
        cv2.imwritemulti(str(path := tmp_path / "stack.tif"), list(FRAMES))
    monkeypatch.setattr("vinetrack.video.frames.memory_for_pictures", lambda: FRAMES.nbytes - 1)
    monkeypatch.setattr("vinetrack.video.images._stack_pages", lambda _: map(pytest.fail, ["read"]))
    with pytest.raises(RecordingError, match="memory"):
        read_frames(path)


def test_one_hot_pixel_does_not_dim_a_picture_of_twelve_bit():
    luma = np.random.default_rng(4).integers(0, 4000, (9, 240, 320)).astype(np.uint16)
    luma[:, 120, 160] = 65_535
    assert camera_unit(luma) == pytest.approx(255 / 4000, rel=0.01)


def test_films_that_two_threads_decode_do_not_share_the_log_of_the_decoder():
    heard, decodes, ends = [], threading.Event(), threading.Event()

    def other() -> None:
        with module.quiet_log() as messages:
            decodes.set()
            ends.wait()
        heard.append(messages)

    thread = threading.Thread(target=other)
    with module.quiet_log() as before:
        for _ in range(3):
            av.logging.log(av.logging.ERROR, "vinetrack", "a fault of the first film")
    with module.quiet_log() as messages:
        thread.start()
        decodes.wait(0.3)
        av.logging.log(av.logging.ERROR, "vinetrack", "a fault of the first film")
        ends.set()
    thread.join()
    assert {text for *_, text in before} == {text for *_, text in messages} == {"a fault of the first film"}
    assert heard == [[]]


def test_a_picture_missing_by_its_number_leaves_a_gap_and_one_cut_short_is_damaged(tmp_path):
    folder = write_images(tmp_path / "shots", FRAMES, ".jpg", step=3)
    for file in list(folder.iterdir()):
        file.rename(folder / f"{file.stem}_cam2.jpg")
    (folder / "frame_0031_cam2.jpg").unlink()
    victim = folder / "frame_0013_cam2.jpg"
    victim.write_bytes(victim.read_bytes()[:-200])
    frames = read_frames(folder)
    assert frames.slot.tolist() == [i for i in range(24) if i != 10]
    assert frames.damaged.tolist() == [i == 4 for i in range(23)]


def test_dng_frames_carry_rate_exposure_and_values(tmp_path):
    """Minimal CinemaDNG frames: one strip of 16-bit mosaic, tags 33434 (exposure) and 51044 (rate)."""
    tags = [
        (256, 4, 1, 24), (257, 4, 1, 16), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 32803), (273, 4, 1, 174),
        (277, 3, 1, 1), (278, 4, 1, 16), (279, 4, 1, 768), (33434, 5, 1, 158), (50706, 1, 4, 0x00000401),
        (51044, 10, 1, 166),
    ]  # fmt: skip
    header = b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
    for i in range(4):
        picture = np.full((16, 24), 3000 + 10 * i, "<u2").tobytes()
        rationals = struct.pack("<IIII", 1, 5000, 1_069_000, 1000)
        (tmp_path / f"shot_{i:03d}.dng").write_bytes(header + bytes(4) + rationals + picture)
    frames = read_frames(tmp_path)
    assert frames.recording.capture_fps == pytest.approx(1069.0)
    assert frames.recording.exposure_s == pytest.approx(1 / 5000)
    assert frames.luma.dtype == np.uint16
    assert [int(picture[8, 12]) for picture in frames.luma] == [3000, 3010, 3020, 3030]


def test_fewer_frames_than_declared_are_reported(tmp_path):
    path = write_video(tmp_path / "a.mp4", NOISE, options={"g": "5"}, container_options={"movflags": "+faststart"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = read_frames(path)
    assert 5 < len(frames) < 60
    assert frames.notes


TWELVE, TEN, EIGHT = (
    np.random.default_rng(11).integers(0, 2**bits, (9, 24, 32)).astype(np.uint16 if bits > 8 else np.uint8)
    for bits in (12, 10, 8)
)


CINES = {
    "8 bit": (EIGHT, {"real_bits": 8}, EIGHT, 8),
    "16 bit": (TWELVE, {}, TWELVE, 12),
    "packed 12 bit": (TWELVE, {"pack": 1024, "annotation": b"12345678"}, TWELVE, 12),
    "packed 10 bit": (TEN, {"pack": 256}, PHANTOM_TABLE[TEN], 12),
}


@pytest.mark.parametrize("kind", CINES)
def test_a_cine_gives_back_every_value(tmp_path, kind):
    frames, options, expected, depth = CINES[kind]
    path = write_cine(tmp_path / "a.cine", frames, **options)
    read = read_frames(path)
    assert np.array_equal(read.luma, expected)
    assert read.luma.dtype == expected.dtype
    assert (read.recording.bit_depth, read.recording.declared_frames, read.notes) == (depth, 9, ())
    assert np.array_equal(np.stack(list(module.iterate_frames(read.recording))), expected)


def test_the_table_of_packed_cines_is_that_of_the_vendor():
    """Ends, middle and checksum as another reader (pycine 0.3.2) has it."""
    known = {0: 2, 1: 5, 2: 6, 159: 154, 160: 156, 512: 998, 1014: 4064, 1015: 4095, 1023: 4095}
    assert PHANTOM_TABLE[list(known)].tolist() == list(known.values())
    assert zlib.crc32(PHANTOM_TABLE.astype("<u2").tobytes()) == 2008231938


def test_time_stamps_show_missing_frames(tmp_path):
    times = np.delete(np.arange(10), 4) / 5000 + 0.7
    read = read_frames(write_cine(tmp_path / "a.cine", EIGHT, times_s=times, exposures_s=np.full(9, 40e-6)))
    assert read.slot.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert read.recording.capture_fps == 5000
    assert read.recording.exposure_s == pytest.approx(40e-6, rel=1e-4)


def test_a_mosaic_of_colours_is_levelled(tmp_path):
    """A grey scene behind filters that pass 1/2, 1 and 1/4 comes out even."""
    mosaic = np.full((9, 24, 32), 800, np.uint16)
    mosaic[:, ::2, ::2] = 400
    mosaic[:, 1::2, 1::2] = 200
    luma = read_frames(write_cine(tmp_path / "a.cine", mosaic, compression=2, colour_filter=3)).luma
    assert np.unique(luma[:, 2:-2, 2:-2]).tolist() == [550]


@pytest.mark.parametrize(
    "options",
    [{"version": 3}, {"compression": 1}, {"compression": 2, "colour_filter": 0x80000003}, {"bit_count": 24}]
    + [{"keep": keep} for keep in (30, 100, 900, 2000, 5900)],
)
def test_an_unsupported_or_truncated_cine_is_refused(tmp_path, options):
    keep = options.pop("keep", None)
    path = write_cine(tmp_path / "a.cine", EIGHT, **options)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError):
        read_frames(path)


@pytest.mark.parametrize("write", [write_cine, write_mraw])
def test_a_truncated_recording_of_a_camera_gives_its_whole_frames(tmp_path, write):
    path = write(tmp_path / f"a.{write.__name__[6:]}", TWELVE)
    path.write_bytes(path.read_bytes()[:-1500])
    assert np.array_equal(read_frames(path).luma, TWELVE[:8])


@pytest.mark.parametrize("side", [".cih", ".cihx"])
@pytest.mark.parametrize(("bits", "frames"), [(8, EIGHT), (12, TWELVE), (16, TWELVE)])
def test_an_mraw_gives_back_every_value_rate_and_exposure(tmp_path, bits, frames, side):
    path = write_mraw(tmp_path / "a.mraw", frames, bits, side, depth=min(bits, 12))
    read = read_frames(path)
    assert np.array_equal(read.luma, frames)
    assert (read.recording.capture_fps, read.recording.bit_depth) == (20000, min(bits, 12))
    assert read.recording.exposure_s == pytest.approx(25e-6)
    assert np.array_equal(read_frames(path.with_suffix(side)).luma, frames)


@pytest.mark.parametrize("shutter", ["1/40000", "0.000025", "2.5e-05", "40000"])
def test_an_exposure_is_read_as_any_of_their_programs_writes_it(tmp_path, shutter):
    path = write_mraw(tmp_path / "a.mraw", TWELVE, shutter=shutter)
    assert inspect_recording(path).exposure_s == pytest.approx(25e-6)


@pytest.mark.parametrize("options", [{"bits": 10}, {"colour": "Color", "bits": 24}, {"form": "AVI"}, {"total": 0}])
def test_an_unsupported_mraw_is_refused(tmp_path, options):
    path = write_mraw(tmp_path / "a.mraw", TWELVE)
    write_side_file(path.with_suffix(".cih"), TWELVE, **options)
    with pytest.raises(RecordingError):
        inspect_recording(path)


def test_pictures_have_rate_and_exposure_of_their_own_side_file(tmp_path):
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(TWELVE))
    assert inspect_recording(tmp_path / "a.tif").capture_fps is None
    write_side_file(tmp_path / "a.cih", TWELVE, form="Tiff", rate=750, shutter="1/1000")
    recording = inspect_recording(tmp_path / "a.tif")
    assert (recording.capture_fps, recording.exposure_s, recording.bit_depth) == (750, 1e-3, 12)
    folder = write_images(tmp_path / "shots", TWELVE, ".tif")
    for other in ({"total": 8}, {"width": 30}, {"form": "MRaw"}):
        write_side_file(folder / "shots.cih", TWELVE, **({"form": "Tiff"} | other))
        assert inspect_recording(folder).capture_fps is None


def test_a_sheet_that_contradicts_the_recording_is_refused(tmp_path):
    recording = inspect_recording(write_cine(tmp_path / "a.cine", EIGHT, rate=5000, exposure_ns=40_000))
    trial = Trial(name="t")
    assert (capture_rate(trial, recording), capture_exposure(trial, recording)) == (5000, pytest.approx(40e-6))
    stated = replace(trial, capture_fps=5000.0, exposure_s=40.4e-6)
    assert (capture_rate(stated, recording), capture_exposure(stated, recording)) == (5000, pytest.approx(40e-6))
    with pytest.raises(RecordingError):
        capture_rate(replace(trial, capture_fps=1000.0), recording)
    with pytest.raises(RecordingError):
        capture_exposure(replace(trial, exposure_s=400e-6), recording)


@pytest.fixture(scope="module")
def filmed():
    """A scene, and its frames with rest before and after it, each frame of rest with grain of its own."""
    scene = plain_scene(
        Plan(seed=20942, width=384, height=96, from_px=(24.0, 48.0), end_px=320.0, radius=14.0, speed=9.0)
    )
    first, last = np.repeat(scene.frames[:1], BEFORE, 0), np.repeat(scene.frames[-1:], AFTER, 0)
    frames, rng = np.concatenate([first, scene.frames, last]), np.random.default_rng(20943)
    for rest in (slice(None, BEFORE), slice(-AFTER, None)):
        grain = np.rint(rng.normal(0, 2.0, frames[rest].shape))
        frames[rest] = np.clip(frames[rest] + grain, 0, 255).astype(np.uint8)
    return scene, frames


def tracked(path: Path, **stated: object) -> Track:
    return track_recording(replace(Trial(name="t", video=path, capture_fps=1000.0, exposure_s=2e-4), **stated)).track


@pytest.mark.slow
@pytest.mark.parametrize("key_frames", ["30", "5000", "1"])
def test_of_a_long_film_the_event_is_decoded_and_no_more(filmed, tmp_path, monkeypatch, key_frames):
    """With a key frame every 30, with one, and with key frames alone; tracked as the whole film is."""
    scene, long_frames = filmed
    film = write_video(tmp_path / "long.mp4", long_frames, options={"crf": "14", "g": key_frames})
    whole, whole_track = read_frames(film), tracked(film)
    monkeypatch.setattr("vinetrack.video.axis.MAX_BYTES_WHOLE", 0)
    frames, part = read_event(inspect_recording(film)), tracked(film)
    moving = np.flatnonzero(scene.moving) + BEFORE
    assert frames.first <= moving[0] - 40
    assert frames.first + len(frames) > moving[-1] + 40
    assert len(frames) < len(moving) + 2 * (MARGIN_FRAMES + 60)
    assert len(frames.slots) == len(long_frames)
    same = slice(frames.first, frames.first + len(frames))
    assert np.array_equal(frames.luma, whole.luma[same])
    assert np.array_equal(frames.slot, whole.slot[same])
    assert len(part.time_s) == len(whole_track.time_s)
    assert part.time_s == pytest.approx(whole_track.time_s)
    known = np.isfinite(part.edge_px[moving]) & np.isfinite(whole_track.edge_px[moving])
    assert known.mean() > 0.95
    assert np.std((part.edge_px - whole_track.edge_px)[moving][known]) < 0.05
    assert set(part.flag[: BEFORE - 150]) == {"before_release"}
    assert set(part.flag[-100:]) == {"after_end"}
    assert np.std(part.edge_px[moving][known] - scene.edge_px[moving - BEFORE][known]) < 0.3
    # Frames that the sheet names are those that are decoded.
    wanted = (BEFORE - 20, BEFORE + len(scene.frames) - 1)
    frames = read_event(inspect_recording(film), wanted)
    assert (frames.first, frames.first + len(frames) - 1) == wanted
    made = tracked(film, frames_used=wanted)
    assert np.isfinite(made.edge_px).sum() > 0.9 * scene.moving.sum()
    assert not np.isfinite(made.edge_px[: wanted[0]]).any()


@pytest.mark.slow
def test_of_a_long_cine_the_event_is_read_and_no_more(filmed, tmp_path, monkeypatch):
    scene, long_frames = filmed
    monkeypatch.setattr("vinetrack.video.axis.MAX_BYTES_WHOLE", 0)
    missing = np.delete(np.arange(len(long_frames) + 1), BEFORE + 30) / 1000 + 0.2
    deep = long_frames.astype(np.uint16) * 16
    path = write_cine(tmp_path / "long.cine", deep, rate=1000, exposure_ns=200_000, times_s=missing)
    frames = read_event(inspect_recording(path))
    same = slice(frames.first, frames.first + len(frames))
    assert len(frames) < len(scene.frames) + 2 * (MARGIN_FRAMES + 20)
    assert np.array_equal(frames.luma, deep[same])
    assert np.array_equal(frames.slot, np.rint((missing - 0.2) * 1000)[same])
    made = tracked(path, capture_fps=np.nan, exposure_s=np.nan)
    assert len(made.time_s) == len(long_frames)
    assert made.time_s[-1] == pytest.approx(len(long_frames) / 1000 + 1e-4)


def test_the_event_lies_between_the_pictures_that_differ_from_either_end():
    rng = np.random.default_rng(8)
    pictures = [rng.normal(80, 1.5, (48, 64)).clip(0, 255).astype(np.uint8) for _ in range(60)]
    for i in range(20, 60):
        pictures[i][20:30, : min(60, 4 * (i - 19))] = 170
    numbers = np.arange(60) * 50
    # From picture 19, the last at rest, to 34, the first at the end, and a margin of MARGIN_FRAMES.
    assert event_range(pictures, numbers, 3000) == (19 * 50 - 40, 34 * 50 + 40)
    assert event_range(pictures[:20], numbers[:20], 1000) is None


def clip_pictures(n: int, height: int = 64, width: int = 96) -> list[np.ndarray]:
    made = []
    for i in range(n):
        picture = np.full((height, width, 3), 60, np.uint8)
        picture[:, 8 * i : 8 * i + 8] = (240, 228, 66)
        made.append(picture)
    return made


def test_pictures_come_back_in_order_and_in_colour(tmp_path):
    path = tmp_path / "overlays" / "a.mp4"
    assert write_clip(path, iter(clip_pictures(10)), 12.5) == 10
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == 12.5
        back = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(back) == 10
    for i, picture in enumerate(back):
        middle = picture[20:40, 8 * i + 2 : 8 * i + 6].astype(float).mean(axis=(0, 1))
        assert middle == pytest.approx([240, 228, 66], abs=14)


@pytest.mark.parametrize(
    ("given", "error"),
    [([], ValueError), ([np.zeros((63, 96, 3), "u1")], ValueError), (map(clip_pictures(1).pop, (0, 0)), IndexError)],
    ids=["nothing", "odd", "broken_off"],
)
def test_a_failed_write_leaves_the_old_clip_and_no_other_file(tmp_path: Path, given, error) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "a.mp4"
    path.write_bytes(b"the old one")
    with pytest.raises(error):
        write_clip(path, given, 10)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert path.read_bytes() == b"the old one"


@pytest.mark.slow
def test_the_same_pictures_are_the_same_bytes_whatever_the_memory_held(tmp_path):
    draw = np.random.default_rng(20701)
    noisy = [np.clip(p + draw.normal(0, 12, p.shape), 0, 255).astype(np.uint8) for p in clip_pictures(30, 198, 480)]
    written = []
    for k in range(6):
        held = [draw.bytes(int(draw.integers(1, 2_000_000))) for _ in range(20)]
        del held
        write_clip(tmp_path / f"{k}.mp4", iter(noisy), 9.0)
        written.append((tmp_path / f"{k}.mp4").read_bytes())
    assert len(set(written)) == 1


@dataclass(frozen=True)
class Clip:
    """A sound recording of the laboratory: H.264, a key frame in 30."""

    trial: Trial
    truth: Truth
    frames: Frames

    def damaged_at(self, folder: Path, *frames: int) -> Path:
        """A copy with ten bytes of each of these frames' packets changed."""
        rng = np.random.default_rng(2030)
        data = np.fromfile(self.trial.video, np.uint8)
        with av.open(str(self.trial.video)) as container:
            places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
        for frame in frames:
            start, size = places[frame]
            # Past the header of the slice, where a fault is met while macroblocks are decoded.
            data[start + 40 + rng.choice(size - 40, 10, replace=False)] ^= 0x5A
        path = folder / "damaged.mp4"
        data.tofile(path)
        return path

    def errors_m(self, track) -> np.ndarray:
        """Error of every usable point, m, but for the arbitrary origin."""
        use = track.usable & np.isfinite(track.lead_position_m)
        error = track.lead_position_m[use] - self.truth.lead_position_m[use]
        return error - np.median(error)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    stated = Trial(
        name="p36", video=folder / "a.mp4", diameter_m=0.012, thickness_m=100e-6, length_m=0.14, pressure_Pa=36e3,
        yield_pressure_Pa=3e3, growth_angle_rad=math.pi / 2, m_per_px=2.4e-4, capture_fps=CAPTURE_FPS,
        exposure_s=93.5e-6, vine="v",
    )  # fmt: skip
    nature = GroundTruth(
        values={"eversion_damping.n": 0.37, "eversion_damping.B": {"v": 1.83}},
        damping_scatter=0.0, pressure_scatter=0.0, release_frames=(14, 20), seed=411,
    )  # fmt: skip
    grown = grow([stated], nature)[0]
    truth = film(grown, Filming(camera=Camera(m_per_px=2.4e-4)), grown.stated.video, seed=41)
    return Clip(grown.stated, truth, read_frames(grown.stated.video))


def test_frames_after_a_damaged_one_are_damaged_up_to_the_next_key_frame(clip, tmp_path):
    frames = read_frames(clip.damaged_at(tmp_path, 40))
    wrong = np.abs(frames.luma.astype(float) - clip.frames.luma).max(axis=(1, 2)) > 8
    assert wrong[40:60].all()  # what the decoder shows of them is wrong indeed
    assert frames.damaged.tolist() == [40 <= i < KEY_FRAMES[2] for i in range(len(frames))]


def test_a_recording_that_is_damaged_throughout_fails_in_one_sentence(clip, tmp_path):
    path = clip.damaged_at(tmp_path, *KEY_FRAMES)
    with pytest.raises(RecordingError):
        track_recording(replace(clip.trial, video=path))


@pytest.mark.slow
@pytest.mark.parametrize("frame", [50, 62])
def test_only_the_sound_frames_before_the_damage_are_tracked(clip, tmp_path, frame):
    """Beyond it, from the key frame 60 on, the tracker would have to leap, and errs by centimetres when it does."""
    track = track_recording(replace(clip.trial, video=clip.damaged_at(tmp_path, frame))).track
    assert np.isfinite(track.edge_px[20:frame]).all()
    assert with_flag(track.flag, "rejected")[frame : 60 if frame < 60 else None].all()
    assert not np.isfinite(track.edge_px[frame:]).any()
    assert np.abs(clip.errors_m(track)).max() < 0.5e-3


@pytest.mark.parametrize("unused", ["frames_used", "damaged tail"])
def test_frames_that_are_not_used_keep_their_distance_in_time_after_a_dropped_one(clip, unused):
    kept = np.delete(np.arange(len(clip.frames)), 35)
    frames = replace(clip.frames, luma=clip.frames.luma[kept], slots=np.arange(70), damaged=np.arange(70) >= 50)
    trial = clip.trial
    if unused == "frames_used":
        frames, trial = replace(frames, damaged=np.zeros(70, dtype=bool)), replace(trial, frames_used=(0, 49))
    track = track_frames(frames, trial, CAPTURE_FPS).track
    assert np.rint((track.time_s - track.time_s[0]) * CAPTURE_FPS).tolist() == kept.tolist()


def test_frames_that_a_lossless_recording_checks_are_damaged_where_the_check_fails(clip, tmp_path):
    path = write_video(tmp_path / "a.mkv", clip.frames.luma[:12], "ffv1", "gray", options={"g": "1"})
    data = bytearray(path.read_bytes())
    data[int(0.55 * len(data))] ^= 0xFF
    path.write_bytes(bytes(data))
    frames = read_frames(path)
    wrong = np.any(frames.luma != clip.frames.luma[:12], axis=(1, 2))
    assert wrong.sum() == 1
    assert frames.damaged.tolist() == wrong.tolist()


def test_frames_known_to_be_lost_leave_gaps_in_the_times_however_many():
    times = np.delete(np.arange(60.0), np.arange(20, 30))
    assert np.array_equal(module.slots_from_times(times)[0], np.arange(50))
    assert np.array_equal(module.slots_from_times(times, known_missing=10)[0], times)
    in_milliseconds = np.round(np.delete(np.arange(71.0), np.arange(30, 51)) / 60, 3)
    assert module.slots_from_times(in_milliseconds, known_missing=21)[0][[29, 30]].tolist() == [29, 51]


def test_frames_beyond_lost_ones_are_not_used(clip):
    kept = np.delete(np.arange(len(clip.frames)), np.arange(48, 58))
    frames = replace(clip.frames, luma=clip.frames.luma[kept], slots=kept, damaged=np.zeros(len(kept), dtype=bool))
    track = track_frames(frames, clip.trial, CAPTURE_FPS).track
    assert not track.usable[48:].any()
    error = track.lead_position_m[:48] - clip.truth.lead_position_m[:48]
    assert np.max(np.abs(error - np.median(error))) < 1e-3


GIVEN_UP = """
import sys
import numpy as np
from vinetrack.video import frames

film = frames.inspect_recording(sys.argv[1])
for _ in range(60):
    seen = iter([np.zeros((320, 960), np.uint8)] * 2)
    frames.luma_plane = lambda frame: next(seen)
    try:
        frames.read_frames(film)
    except (StopIteration, RuntimeError):
        pass
"""  # A decoder left after two frames, sixty times over


@pytest.mark.slow
def test_a_damaged_recording_that_is_given_up_lets_go_of_its_decoder(tmp_path):
    draw = np.random.default_rng(0)
    noise = draw.integers(0, 255, (60, 320, 960), dtype=np.uint8)
    path = write_video(tmp_path / "noise.mp4", noise, options={"g": "30", "bf": "0"})
    content = bytearray(path.read_bytes())
    for place in draw.integers(3000, len(content) - 20_000, 3000):
        content[place] ^= int(draw.integers(1, 255))
    path.write_bytes(content)
    subprocess.run([sys.executable, "-c", GIVEN_UP, str(path)], check=True, timeout=120)
