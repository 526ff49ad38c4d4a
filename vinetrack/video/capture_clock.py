"""Rate and exposure of capture: what the recording states, else the sheet; never the playback rate."""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.video.frames import Recording, RecordingError

SAME_RATE = 0.005
"""Relative difference within which two rates are the same. Derived: 29.97 and 30 frames a second differ by 0.1 %,
23.976 and 24 likewise; a rate of capture that is no playback rate but within 0.5 % of one is 30.1 for 30, which no
camera offers."""

SAME_EXPOSURE = 0.02
"""Relative difference within which exposures of sheet and recording are the same. Chosen: cameras round to a
microsecond of 50, sheets to two digits. By reasoning: at half some rounded ones are refused; at twice one of 96 µs for
100 passes, which moves no position."""


def capture_rate(trial: Trial, recording: Recording) -> float:
    """Return the capture rate: the recording's where it states one, else the sheet's.

    Parameters
    ----------
    trial : its `capture_fps` is that of the sheet, NaN where blank.
    recording : from `inspect_recording`.

    Returns
    -------
    frames a second.

    Raises
    ------
    RecordingError
        Where there is none, where sheet and recording differ, and where it is the file's rate of playback.
    """
    true_fps, stated = recording.capture_fps, trial.capture_fps
    if true_fps is not None:
        if np.isfinite(stated) and abs(stated / true_fps - 1) > 1e-3:
            raise RecordingError(
                f"{trial.name}: capture_fps is {stated:g} in the sheet but {true_fps:g} in the recording; "
                "correct the sheet"
            )
        return true_fps
    if not np.isfinite(stated):
        raise RecordingError(f"{trial.name}: capture_fps is missing; the file knows its playback rate only")
    playback = recording.playback_fps
    if playback and abs(stated / playback - 1) < SAME_RATE and not trial.capture_fps_is_playback:
        raise RecordingError(
            f"{trial.name}: capture_fps is {stated:g} in the sheet, the rate at which the file plays ({playback:.4g}); "
            "write the rate of capture, or capture_fps_is_playback: yes where the film plays as fast as it was captured"
        )
    return stated


def capture_exposure(trial: Trial, recording: Recording) -> float:
    """Return the exposure of a frame: the recording's where it states one, else the sheet's.

    Parameters
    ----------
    trial : its `exposure_s` is that of the sheet, NaN where blank.
    recording : from `inspect_recording`.

    Returns
    -------
    s; NaN where neither knows it.

    Raises
    ------
    RecordingError
        Where both do and differ.
    """
    true_s, stated_s = recording.exposure_s, trial.exposure_s
    if true_s is None:
        return stated_s
    if np.isfinite(stated_s) and abs(stated_s / true_s - 1) > SAME_EXPOSURE:
        raise RecordingError(
            f"{trial.name}: exposure_us is {1e6 * stated_s:.4g} in the sheet but {1e6 * true_s:.4g} in the recording; "
            "correct the sheet"
        )
    return true_s
