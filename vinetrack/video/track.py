"""From a recording to a track: decode, find the axis, cut the strip, follow edge or body, judge each point."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Indices, Track, Trial
from vinetrack.video.axis import Axis, FrontShare, centred_on_motion, find_axis
from vinetrack.video.capture_clock import capture_exposure, capture_rate
from vinetrack.video.curve_search import find_growth_axis
from vinetrack.video.curved_axis import CurvedAxis
from vinetrack.video.curved_strip import (
    check_curve,
    curve_note,
    front_share_function,
    front_share_on_curve,
    path_error_px,
    shake_along,
)
from vinetrack.video.event_frames import read_event
from vinetrack.video.follow import Positions, follow
from vinetrack.video.frame_faults import odd_frames, repeated_frames
from vinetrack.video.frames import Frames, RecordingError, inspect_recording
from vinetrack.video.hand_corrections import corrected_by_hand
from vinetrack.video.motion_end import body_end_note, growth_end_notes, is_grown, truncation_notes
from vinetrack.video.point_quality import (
    FLOOR_PX,
    LARGEST_BODY_FACTOR,
    LARGEST_FACTOR,
    LOST_SIGMA_PX,
    PointQuality,
    assess_points,
    calibrated_sigma,
)
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.sound_frames import sound_stretch
from vinetrack.video.strip import Strip
from vinetrack.video.track_scale import in_metres

if TYPE_CHECKING:
    from vinetrack.video.calibration import AxisScale


FEWEST_FRAMES = 5
"""Derived: fourth differences take five."""

ROOM = 0.08
"""Width added to a given axis, as a part of its length. Derived: the far end of an axis 2.3 degrees off lies off by
0.04 of it, on either side."""
MOVING_PX = 0.3
"""Step of a frame from which the roughness of the track is judged there. Chosen: at rest compression freezes it."""
MOSTLY_LOST = 0.5
"""Part of the frames without an edge from which a recording is not one where nothing moves. Chosen: the majority; it
decides which of two messages is given."""

STEADIED_PX = 0.1
"""Error of a camera's shake taken off by what stands still: measured 0.1-0.15 px, mostly of its slow part."""


@dataclass(frozen=True)
class Tracking:
    """A track and what a figure of it needs.

    `kymograph`, shape (n_frames, n_along), is the strip's mean brightness across in grey levels; column j lies
    `j` px from `axis.from_px`. `edge_px` of the track counts along the same axis. `pictures` are (frame number,
    picture) of the first, middle and last moving frame, full region, as the camera wrote them. `shake_px`, shape
    (n_frames,), is how far along the axis a shaken camera moved each picture: what is drawn on it goes along.
    `tube_width_px` is the width of the tube behind the edge and `tube_width_sigma_px` its standard error, NaN for a
    body and for a tube that leaves the axis; `seen_exposure_frames`, `fast_px_per_frame` see `edge.EdgeFit`.
    `strip_frames` are the frames that are the rows of `kymograph`, None for all.
    """

    track: Track
    axis: Axis
    kymograph: NDArray[np.float32]
    pictures: tuple[tuple[int, NDArray[Any]], ...]
    blur_px: float
    exposure_frames: float
    shake_px: Floats
    tube_width_px: float = math.nan
    tube_width_sigma_px: float = math.nan
    seen_exposure_frames: float = math.nan
    fast_px_per_frame: float = math.nan
    strip_frames: Indices | None = None

    @property
    def strip_rows(self) -> Indices:
        """Frame of each row of `kymograph`, shape (n_rows,)."""
        return np.arange(len(self.track.time_s)) if self.strip_frames is None else self.strip_frames


def track_recording(
    trial: Trial,
    axis: Axis | None = None,
    *,
    m_per_px: float | None = None,
    position_m: Callable[[Floats], Floats] | None = None,
) -> Tracking:
    """Track the leading edge (travel ratio 1: the body) of one recording.

    Parameters
    ----------
    trial : its `video`, `capture_fps`, `exposure_s`, `travel_ratio` and, unless given here, `m_per_px` are used.
    axis : growth axis in the picture; found from the motion where None. It is centred on what moves along it.
    m_per_px : scale; that of the trial where None. Without any, positions in metres are NaN and pixels remain.
    position_m : metres along the axis of picture points (x, y), shape (n, 2): a calibration that knows distortion and
        tilt.

    Returns
    -------
    the track, and what the report shows of it.

    Raises
    ------
    RecordingError
        In one sentence, where the recording holds no track.
    """
    if trial.video is None:
        raise RecordingError(f"{trial.name}: no recording is named; fill in the column video")
    recording = inspect_recording(trial.video)
    capture_fps = capture_rate(trial, recording)
    frames = read_event(recording, trial.frames_used)
    return track_frames(frames, trial, capture_fps, axis, m_per_px=m_per_px, position_m=position_m)


def track_frames(
    frames: Frames,
    trial: Trial,
    capture_fps: float,
    axis: Axis | None = None,
    *,
    m_per_px: float | None = None,
    position_m: Callable[[Floats], Floats] | None = None,
    along_path: Callable[[Axis], AxisScale] | None = None,
) -> Tracking:
    """Track frames that are in memory already; see `track_recording`.

    Parameters
    ----------
    frames : decoded, with their capture periods.
    trial, axis, m_per_px, position_m : as in `track_recording`.
    capture_fps : frames a second.
    along_path : a calibration's scale along the axis, in place of `position_m` and of `m_per_px`, then its mean scale.

    Returns
    -------
    the track, and what the report shows of it.

    Raises
    ------
    RecordingError
        In one sentence, where the frames hold no track.
    """
    name = frames.recording.path.name
    exposure_s = capture_exposure(trial, frames.recording)
    if len(frames) < FEWEST_FRAMES:
        raise RecordingError(f"{name}: only {len(frames)} frames can be decoded; at least {FEWEST_FRAMES} are needed")
    rejected = odd_frames(frames.luma) if frames.first == 0 else np.zeros(len(frames), dtype=bool)
    first, last = trial.frames_used or (0, frames.n_recorded - 1)
    number = frames.first + np.arange(len(frames))
    used = (number >= first) & (number <= last)
    if used.sum() < FEWEST_FRAMES:
        raise RecordingError(f"{name}: frames_used leaves {int(used.sum())} of {len(frames)} frames; widen it")
    sound = sound_stretch(frames, used)
    rejected &= sound
    kept = np.flatnonzero(sound & ~rejected)
    luma = frames.luma if len(kept) == len(frames) else frames.luma[kept]
    try:
        given, (axis, order) = axis is not None, locate_axis(luma, axis, trial, m_per_px)
        strip, edge_fit = follow(luma, trial, axis, exposure_s * capture_fps, order)
    except RecordingError as error:
        raise RecordingError(f"{name}: {error}") from error
    repeated = repeated_frames(strip, edge_fit.edge_px)
    moving = np.gradient(edge_fit.edge_px) > MOVING_PX if len(kept) > 1 else np.ones(len(kept), bool)
    largest = LARGEST_BODY_FACTOR if trial.travel_ratio == 1 else LARGEST_FACTOR
    known = np.isfinite(edge_fit.edge_px)
    noise = calibrated_sigma(edge_fit.edge_px, edge_fit.sigma_px, moving & known, largest=largest)
    # Roughness and the bands' disagreement tell of the same noise; the larger also of what the other is blind to.
    sigma = np.maximum(np.hypot(noise, FLOOR_PX), np.hypot(edge_fit.apart_sigma_px, FLOOR_PX))
    sigma = np.hypot(sigma, STEADIED_PX if strip.steadied else 0.0)
    end_px = strip.axis.length_px - edge_fit.reach_px
    verdict = assess_points(
        edge_fit.edge_px, sigma, frames.slot[kept], number[kept], unsure=edge_fit.unsure, repeated=repeated,
        end_px=end_px,
    )  # fmt: skip
    sigma = np.where(sigma < LOST_SIGMA_PX, np.minimum(np.hypot(sigma, verdict.departure_px), LOST_SIGMA_PX), sigma)
    noise = np.minimum(np.hypot(np.maximum(noise, edge_fit.bands_sigma_px), verdict.departure_px), LOST_SIGMA_PX)
    slow = np.hypot(np.broadcast_to(edge_fit.slow_px, noise.shape), STEADIED_PX if strip.steadied else 0.0)
    slow = np.hypot(slow, path_error_px(strip.axis))
    slow = np.minimum(slow, LOST_SIGMA_PX)
    if verdict.last_moving < 0:
        if np.mean(~(sigma < LOST_SIGMA_PX)) > MOSTLY_LOST:
            raise RecordingError(
                f"{name}: something moves, but its edge is too vague to be followed: film it nearer, with more light or"
                " contrast, or at more frames a second"
            )
        raise RecordingError(f"{name}: nothing moves along the axis; check the recording, or give the axis")
    scale = trial.m_per_px if m_per_px is None else m_per_px
    if along_path is not None:
        along = along_path(strip.axis)
        scale, position_m = along.m_per_px, along.position_m
    notes = [*frames.notes, *verdict.notes]
    if edge_fit.end is not None:
        notes.append(f"{name}: {body_end_note(edge_fit.end, number[kept])}")
    elif not is_grown(edge_fit.edge_px, verdict, trial.length_m / scale):
        notes += growth_end_notes(luma, verdict, edge_fit.edge_px, name, number[kept])
        if trial.travel_ratio == 2 and trial.frames_used is None and number[kept[-1]] == frames.n_recorded - 1:
            notes += truncation_notes(edge_fit.edge_px, verdict, trial.length_m / scale, name)
    if isinstance(strip.axis, CurvedAxis) and not given:
        notes.append(f"{name}: {curve_note(strip.axis)}")
    if not edge_fit.is_edge:
        notes.append(
            f"{name}: the vine bends or sweeps away from the axis; only how far along it its tip has come is followed, "
            "to about a pixel"
        )
    if sound.sum() < used.sum():
        notes.append(
            f"{name}: {int(sound.sum())} of {len(frames)} frames are used, {number[kept[0]]} to {number[kept[-1]]}: "
            "damaged ones, and those beyond them or beyond lost ones, do not count until their edge is placed in "
            "corrections.csv"
        )
    if rejected.any():
        first = int(number[rejected][0])
        notes.append(f"{name}: {int(rejected.sum())} frames are unlike all others and rejected, first frame {first}")
    track = _assemble(frames, kept, edge_fit, (noise, slow), verdict, capture_fps, exposure_s, notes)
    track = corrected_by_hand(track, trial.corrections)
    track = in_metres(track, strip.axis, scale, position_m)
    chosen = [verdict.first_moving, (verdict.first_moving + verdict.last_moving) // 2, verdict.last_moving]
    pictures = tuple((int(number[kept[i]]), luma[i].copy()) for i in chosen)
    shake_px = np.zeros(frames.n_recorded)
    shake_px[number[kept]] = shake_along(strip, edge_fit.edge_px) if strip.steadied else 0.0
    return Tracking(
        track, strip.axis, _kymograph(strip), pictures, edge_fit.blur_px, edge_fit.exposure_frames, shake_px,
        *edge_fit.width_px, *edge_fit.seen_exposure, strip_frames=number[kept],
    )  # fmt: skip


def locate_axis(luma: NDArray[Any], axis: Axis | None, trial: Trial, m_per_px: float | None) -> tuple[Axis, FrontShare]:
    """The axis, with a width, and how to ask how much of what changes along it is one front that passes once and stays.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width).
    axis : in the picture, px; found from the motion where None.
    trial : its diameter or the axis gives the width; its travel ratio decides what is looked for.
    m_per_px : scale; None where unknown.

    Returns
    -------
    axis, px; and a function of an axis of its kind, straight or curved: the share of what changes along it that is one
    front, less than `axis.LEAST_FRONT_SHARE` where the vine bends or sweeps away.
    """
    given = axis is not None
    if isinstance(axis, CurvedAxis):
        return _along_given_curve(luma, axis, trial, m_per_px)
    small = SmallPictures(luma)
    if axis is None and trial.travel_ratio == 2:
        axis = find_growth_axis(small, luma)
    axis = axis if axis is not None else find_axis(small, grows=False)
    axis = replace(axis, width_px=2 * _half_width(axis, trial, m_per_px))
    if given and not axis.bends:
        # Room for an axis that is a few degrees off; it is centred on what moves, here or by `tube_strip`.
        axis = replace(axis, width_px=axis.width_px + ROOM * axis.length_px)
        if trial.travel_ratio == 1:
            axis = centred_on_motion(small, axis)
    return axis, front_share_function(small, luma)


def _along_given_curve(
    luma: NDArray[Any], axis: CurvedAxis, trial: Trial, m_per_px: float | None
) -> tuple[CurvedAxis, FrontShare]:
    """A given curve with a width, that of its strip at most; see `locate_axis`."""
    half = _half_width(axis, trial, m_per_px)
    known = np.isfinite(axis.width_px) or np.isfinite(trial.diameter_m * (m_per_px or trial.m_per_px))
    check_curve(axis, half if known else math.nan, luma.shape[1:])
    wide = min(2 * half + ROOM * axis.length_px, 2 * axis.largest_half_px)
    axis = replace(axis, width_px=max(wide, 2 * half) if known else wide)
    return axis, partial(front_share_on_curve, luma)


def _half_width(axis: Axis, trial: Trial, m_per_px: float | None) -> float:
    """Half the width of the tube, px: the axis's own, or by the sheet's diameter and scale, or a tenth of the axis."""
    if np.isfinite(axis.width_px):
        return axis.width_px / 2
    scale = trial.m_per_px if m_per_px is None else m_per_px
    if np.isfinite(trial.diameter_m) and np.isfinite(scale):
        return trial.diameter_m / scale / 2
    return 0.1 * axis.length_px


def _assemble(
    frames: Frames, kept: NDArray[np.int_], edge_fit: Positions, errors_px: tuple[Floats, Floats],
    verdict: PointQuality, capture_fps: float, exposure_s: float, notes: list[str],
) -> Track:  # fmt: skip
    """A row for every decoded frame; those rejected, or after the end of what follows the axis, have no position."""
    n = len(frames)
    edge, noise, slow = np.full((3, n), np.nan)
    flag = np.full(n, "rejected", dtype="<U64")
    flag[int(kept[-1]) + 1 :] = "after_end"
    flag[frames.damaged] = "rejected"
    slot = frames.slot.astype(float)
    edge[kept] = np.where(verdict.unseen, np.nan, edge_fit.edge_px)
    noise[kept], slow[kept] = np.where(verdict.unseen, np.nan, errors_px)
    flag[kept] = verdict.flag
    slot[kept] = verdict.slot
    # Frames that were not decoded, since nothing moves in them, have rows as well.
    before, after = frames.slots_before, frames.slots_after
    slot = np.concatenate([before, slot, after + (slot[-1] - frames.slot[-1])])
    flag = np.concatenate([np.full(len(before), "before_release"), flag, np.full(len(after), "after_end")])
    edge, noise, slow = np.pad([edge, noise, slow], ((0, 0), (len(before), len(after))), constant_values=np.nan)
    time = slot / capture_fps + (exposure_s / 2 if np.isfinite(exposure_s) else 0.0)
    return Track(
        time, np.full(len(edge), np.nan), noise, flag.astype("<U64"), edge, notes=tuple(notes),
        lead_position_systematic_m=slow,
    )  # fmt: skip


def _kymograph(strip: Strip) -> NDArray[np.float32]:
    mean = strip.values.mean(axis=1, dtype=np.float32)
    return (mean * strip.scale[:, None] + strip.offset[:, None]).astype(np.float32)
