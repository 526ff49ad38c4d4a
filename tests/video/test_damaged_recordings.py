"""Damaged recordings: frames that a decoder fills in never count, and what is left is right or refused in a sentence.

The truth is the motion that the virtual laboratory filmed, and the same recording undamaged.
"""

import math
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
import pytest
from plain_scene import write_video

from vinetrack.core.records import Trial, with_flag
from vinetrack.laboratory.filming import Filming, film
from vinetrack.laboratory.render import Truth
from vinetrack.laboratory.scene import Camera
from vinetrack.laboratory.tracks import GroundTruth, grow
from vinetrack.video.axis import Axis
from vinetrack.video.edge import outline
from vinetrack.video.frames import Frames, RecordingError, read_frames, slots_from_times, torn_frames
from vinetrack.video.strip import Strip
from vinetrack.video.track import track_frames, track_recording

CAPTURE_FPS = 1069.0
KEY_FRAMES = (0, 30, 60)


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
    frames = replace(clip.frames, luma=clip.frames.luma[kept], slot=np.arange(70), damaged=np.arange(70) >= 50)
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


def test_a_frame_unlike_those_around_it_along_a_row_of_blocks_is_torn(clip):
    luma = clip.frames.luma.astype(np.int16)
    assert not torn_frames(luma.astype(np.uint8)).any()
    for torn in ({0: (3, 30)}, {35: (8, 30)}, {70: (15, 30)}, {30: (8, 30), 31: (8, 50)}):
        wrong = luma.copy()
        for frame, (row, by) in torn.items():
            wrong[frame, 16 * row : 16 * row + 16, 300:] += by
        assert np.flatnonzero(torn_frames(np.clip(wrong, 0, 255).astype(np.uint8))).tolist() == list(torn)


def test_moving_patches_and_flicker_are_not_torn_frames(clip):
    lit = clip.frames.luma.astype(float) * np.where(np.arange(len(clip.frames.luma)) % 2, 1.0, 0.96)[:, None, None]
    assert not torn_frames(np.rint(lit).astype(np.uint8)).any()
    crossed = clip.frames.luma.copy()
    for i in range(20, 40):  # a dark door 100 px wide that swings along the tube by 30 px a frame
        crossed[i, :, 30 * (i - 20) : 30 * (i - 20) + 100] = 20
    assert not torn_frames(crossed).any()


def test_frames_known_to_be_lost_leave_gaps_in_the_times_however_many():
    times = np.delete(np.arange(60.0), np.arange(20, 30))
    assert np.array_equal(slots_from_times(times)[0], np.arange(50))
    assert np.array_equal(slots_from_times(times, known_missing=10)[0], times)
    in_milliseconds = np.round(np.delete(np.arange(71.0), np.arange(30, 51)) / 60, 3)
    assert slots_from_times(in_milliseconds, known_missing=21)[0][[29, 30]].tolist() == [29, 51]


def test_frames_beyond_lost_ones_are_not_used(clip):
    kept = np.delete(np.arange(len(clip.frames)), np.arange(48, 58))
    frames = replace(clip.frames, luma=clip.frames.luma[kept], slot=kept, damaged=np.zeros(len(kept), dtype=bool))
    track = track_frames(frames, clip.trial, CAPTURE_FPS).track
    assert not track.usable[48:].any()
    error = track.lead_position_m[:48] - clip.truth.lead_position_m[:48]
    assert np.max(np.abs(error - np.median(error))) < 1e-3


def test_a_tube_of_two_widths_has_one_of_them():
    n, rows, columns = 60, 81, 240
    values = np.random.default_rng(6).normal(60, 2, (n, rows, columns))
    inside = np.abs(np.arange(rows) - rows // 2)[:, None] <= np.where(np.arange(columns) < 120, 8, 30)
    for i in range(n):
        values[i] += 90 * ((np.arange(columns) < 5 * (i - 8)) & inside)
    luma, axis = np.clip(values, 0, 255).astype(np.uint8), Axis((0, 40), (columns - 1, 40), 40)
    sides = outline(Strip(luma, np.ones(n), np.zeros(n), np.zeros((n, 2)), 2.0, axis, False))
    assert np.isfinite([sides.shift_px, sides.slope, sides.width_px]).all()


GIVEN_UP = """
import sys
from pathlib import Path
import numpy as np
from vinetrack.video import frames

for _ in range(60):
    seen = iter([np.zeros((320, 960), np.uint8)] * 2)
    frames.luma_plane = lambda frame: next(seen)
    try:
        frames.decode_container(Path(sys.argv[1]), (320, 960))
    except (StopIteration, RuntimeError):
        pass
"""
"""A decoder left after two frames, sixty times over."""


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
