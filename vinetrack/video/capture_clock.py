"""Rate and exposure of capture: what the recording states, else the sheet; never the playback rate."""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.video.frames import Recording, RecordingError

SAME_RATE = 0.005  # Relative difference within which two rates are the same (derived)

SAME_EXPOSURE = 0.02  # Relative difference within which exposures of sheet and recording are the same (chosen)


def capture_rate(trial: Trial, recording: Recording) -> float:
    """Return the capture rate: the recording's where it states one, else the sheet's."""
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
    """Return the exposure of a frame: the recording's where it states one, else the sheet's."""
    true_s, stated_s = recording.exposure_s, trial.exposure_s
    if true_s is None:
        return stated_s
    if np.isfinite(stated_s) and abs(stated_s / true_s - 1) > SAME_EXPOSURE:
        raise RecordingError(
            f"{trial.name}: exposure_us is {1e6 * stated_s:.4g} in the sheet but {1e6 * true_s:.4g} in the recording; "
            "correct the sheet"
        )
    return true_s
