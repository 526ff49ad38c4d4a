"""The data of all trials of a campaign, including properties of the noise that only the trials together show.

A single track may not show whether its positions are rounded, smoothed, or have an error that grows with speed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, prepare_trial
from vinetrack.inference.gauge_noise import denoised_traces
from vinetrack.tracks.noise_shape import ar1_difference_gain, noise_shape
from vinetrack.tracks.position_noise import common_rounding_noise
from vinetrack.tracks.smoothed_positions import detect_smoothing


def prepare(pairs: Pairs, *, weighted: bool = True) -> tuple[list[FitTrial], dict[str, str]]:
    """Data of the trials that can be fitted, and the reason for each that cannot, by name. Returns data, left_out
    (reason by name of trial).
    """
    data, left_out = [], {}
    pairs = list(pairs)
    # Estimated from all tracks: one with few points, or at constant speed, may not show it.
    rounding_m = common_rounding_noise(
        [track.lead_position_m[track.usable] for trial, track in pairs if trial.video is None]
    )
    smoothing = detect_smoothing(pairs, rounding_m)
    for (trial, track), denoised in zip(pairs, denoised_traces([track for _, track in pairs]), strict=True):
        try:
            data.append(prepare_trial(trial, track, denoised, smoothing, rounding_m))
        except FitError as error:
            left_out[trial.name] = str(error)
    return _with_weighted_points(data) if weighted else data, left_out


def _with_weighted_points(data: list[FitTrial]) -> list[FitTrial]:
    """The trials with weighted points, where the noise of imported positions varies from point to point. Points of this
    package's tracker keep equal weights: it states the error of each and leaves out the worst.
    """
    imported = [i for i, trial_data in enumerate(data) if trial_data.slow_m is None]
    shape = noise_shape(
        [data[i].time_s for i in imported],
        [data[i].lead_position_m for i in imported],
        [data[i].stated_m for i in imported],
    )
    if shape is None:
        return data
    # One correlation for all trials, as in a fit: a single track with unequal noise hardly determines it.
    correlation = np.average([data[i].correlation for i in imported], weights=[data[i].time_s.size for i in imported])
    gain = ar1_difference_gain(float(correlation))
    weighted = list(data)
    for i, sd_m in zip(imported, shape.sd_m, strict=True):
        typical_m = math.exp(float(np.mean(np.log(sd_m))))
        weighted[i] = replace(
            data[i],
            relative_sd=sd_m / typical_m,
            noise_m=typical_m / gain,
            correlation=float(correlation),
            blur_s=shape.blur_s,
        )
    return weighted
