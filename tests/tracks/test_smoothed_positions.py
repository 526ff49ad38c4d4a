"""Smoothed positions are distinguished from others; seeds 351 and up, which tuned nothing."""

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from lsoda_vine import as_track
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.tracks.position_noise import ar1_noise, detect_smoothing

TIME_S = np.arange(150) / 1000.0
TRIAL = Trial(name="t", capture_fps=1000.0)


def tracks(seed: int, rho: float = 0.0, smooth=lambda y: y) -> list[tuple[Trial, Track]]:
    """Eight, from rest at 20 ms, at up to 3 m/s."""
    draw, since = np.random.default_rng(seed), np.clip(TIME_S - 0.02, 0.0, None)
    grown_m = 3.0 * (since - 0.01 * (1 - np.exp(-since / 0.01)))
    noisy = [grown_m + ar1_noise(TIME_S.size, 1e-4, rho, draw) for _ in range(8)]
    return [(TRIAL, as_track(TIME_S, smooth(y))) for y in noisy]


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.85])
def test_noise_of_a_camera_is_not_smoothed(rho):
    assert all(detect_smoothing(tracks(seed, rho)) is None for seed in range(351, 371))


@pytest.mark.parametrize(("degree", "frames"), [(0, 3), (0, 5), (0, 9), (2, 7), (2, 11)])
def test_a_moving_average_and_a_polynomial_are_found_with_their_lengths(degree, frames):
    average, polynomial = (lambda y: uniform_filter1d(y, frames)), (lambda y: savgol_filter(y, frames, 3))
    found = detect_smoothing(tracks(352 + degree // 2, smooth=polynomial if degree else average))
    assert (found.window, found.degree) == (frames, degree)
    assert 1 < found.decimation < frames if degree else found.decimation == frames


def test_uneven_frames_and_recordings_are_not_smoothed(tmp_path):
    smoothed = tracks(355, smooth=lambda y: uniform_filter1d(y, 5))
    uneven_s = TIME_S + 3e-4 * np.sin(np.arange(TIME_S.size))
    assert detect_smoothing([(trial, as_track(uneven_s, track.lead_position_m)) for trial, track in smoothed]) is None
    filmed = Trial(name="t", video=tmp_path / "t.mp4", capture_fps=1000.0)
    assert detect_smoothing([(filmed, track) for _, track in smoothed]) is None
    assert detect_smoothing([]) is None


@pytest.mark.slow
def test_a_model_is_smoothed_as_its_positions_were(tmp_path):
    """Each release is rounded off by half a millimetre and more, ten times the noise."""
    shot = campaign("smoothed", 20616, (8, 8), weighed=False)
    write_experiment(shot, tmp_path / "laboratory")
    fit = vt.fit(vt.base_model(), tmp_path / "laboratory", profile=False)
    assert fit.chi2_per_dof < 1.2
    (n,) = (number for number in fit.numbers if number.key == "eversion_damping.n")
    truth = shot.truth["truths"]["eversion_damping.n"]  # type: ignore[index]
    assert n.low < truth < n.high
