"""The trials of a campaign as a fit sees them, and what only all of them together say of their noise.

One track may not show how far its points err: whether positions are rounded, smoothed, or err with their speed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, prepare_trial
from vinetrack.inference.gauge_noise import quiet_traces
from vinetrack.tracks.noise_shape import correlated_gain, noise_shape
from vinetrack.tracks.position_noise import common_rounding_noise
from vinetrack.tracks.smoothed_positions import detect_smoothing


def prepare(pairs: Pairs, *, weighted: bool = True) -> tuple[list[FitTrial], dict[str, str]]:
    """Trials that can be fitted, and for the others the reason why not, by name.

    Parameters
    ----------
    pairs : iterable of (Trial, Track)
    weighted : bool
        Whether points are weighted where the noise of positions varies from one to the next.

    Returns
    -------
    data : list of FitTrial
    left_out : dict
        Reason by name of trial.
    """
    data, left_out = [], {}
    pairs = list(pairs)
    # A track of few points, or at one speed, may happen to show nothing of it.
    rounding_m = common_rounding_noise(
        [track.lead_position_m[track.usable] for trial, track in pairs if trial.video is None]
    )
    smoothing = detect_smoothing(pairs, rounding_m)
    for (trial, track), quiet in zip(pairs, quiet_traces([track for _, track in pairs]), strict=True):
        try:
            data.append(prepare_trial(trial, track, quiet, smoothing, rounding_m))
        except FitError as error:
            left_out[trial.name] = str(error)
    return _with_noise_shape(data) if weighted else data, left_out


def _with_noise_shape(data: list[FitTrial]) -> list[FitTrial]:
    """The trials with their points weighted, where the noise of positions that somebody else measured varies.

    A tracker's own points are left as they are: it states what each errs by, and leaves out the worst.
    """
    places = [i for i, trial_data in enumerate(data) if trial_data.slow_m is None]
    shape = noise_shape(
        [data[i].time_s for i in places], [data[i].lead_position_m for i in places], [data[i].stated_m for i in places]
    )
    if shape is None:
        return data
    # One correlation for all, as in a fit: that of a single track with unequal noise is hardly known.
    correlation = np.average([data[i].correlation for i in places], weights=[data[i].time_s.size for i in places])
    gain = correlated_gain(float(correlation))
    weighted = list(data)
    for i, sd_m in zip(places, shape.sd_m, strict=True):
        typical_m = math.exp(float(np.mean(np.log(sd_m))))
        weighted[i] = replace(
            data[i],
            relative_sd=sd_m / typical_m,
            noise_m=typical_m / gain,
            correlation=float(correlation),
            blur_s=shape.blur_s,
        )
    return weighted
