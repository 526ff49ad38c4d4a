"""Stated errors of the edge against its true ones; seeds 311, 331, 1811 and up, which tuned nothing."""

import numpy as np
import pictures
import pytest
from plain_scene import Plan, plain_scene
from scipy.special import ndtr

from vinetrack.video.axis import Axis
from vinetrack.video.edge import BANDS, leap_error_px
from vinetrack.video.track import Tracking

COLUMNS = 460
AXIS = Axis((20.0, 59.5), (440.0, 59.5), 40.0)


def errors(luma: np.ndarray, exposure: float, true: np.ndarray) -> tuple[np.ndarray, Tracking, np.ndarray, np.ndarray]:
    """Tracked minus true edge, px, the tracking along AXIS, and its stated random and slow errors, px."""
    found = pictures.tracked(luma, exposure, AXIS, m_per_px=1e-4)
    error = found.track.edge_px + found.axis.from_px[0] - true
    return error, found, found.track.lead_position_sigma_m * 1e4, found.track.lead_position_systematic_m * 1e4


def instants(frames: np.ndarray, exposure: float) -> np.ndarray:
    """Sixty moments of each exposure, in frames, shape (n_frames, 60)."""
    return frames[:, None] + exposure * (np.arange(60) - 29.5) / 60


def step_frames(edge_px: np.ndarray, noise: float = 2.0, seed: int = 331) -> np.ndarray:
    """A straight front between background of 60 and film of 160, blurred by 1 px, averaged over instants.

    `edge_px` has shape (n_frames, n_instants) or (n_frames, n_instants, n_bands): a front for each band of rows.
    """
    bands = edge_px if edge_px.ndim == 3 else edge_px[:, :, None]
    cover = ndtr(bands[..., None] - np.arange(COLUMNS)).mean(axis=1)
    luma = np.full((len(edge_px), 120, COLUMNS), 60.0)
    luma[:, 40:80] += 100 * np.repeat(cover, 40 // cover.shape[1], axis=1)
    luma += np.random.default_rng(seed).normal(0, noise, luma.shape)
    return np.rint(np.clip(luma, 0, 255)).astype(np.uint8)


def grown_px(frames: np.ndarray, start_px: float = 60.0, rest: int = 12, speed: float = 4.0) -> np.ndarray:
    """Rest, then one speed, at these times in frames."""
    return start_px + speed * np.maximum(frames - rest, 0.0)


GRAINS = [{}, {"wall_sd": 30.0, "tail_sd": 30.0}, {"wall_sd": 5.0, "tail_sd": 45.0}, {"background_sd": 30.0}]


@pytest.mark.slow
@pytest.mark.parametrize("changes", [*GRAINS, {"door": True}])
def test_stated_errors_match_the_true_errors(changes):
    """Random errors show in second differences of the errors: Σ(1, −2, 1)² = 6."""
    short = {"width": 520, "height": 160, "from_px": (20.0, 80.0), "start_px": 50.0, "end_px": 430.0, "radius": 24.0}
    pulls = []
    for seed in (331, 332):
        scene = plain_scene(Plan(**{**short, **changes, "seed": seed}))
        tracking = pictures.tracked(scene.frames, scene.plan.exposure)
        use = scene.moving & tracking.track.usable
        error = (tracking.track.edge_px + tracking.axis.from_px[0] - scene.edge_px)[use]
        sigma = tracking.track.lead_position_sigma_m[use] * 1e3
        pulls.append(np.diff(error, 2) / np.sqrt(sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2))
    assert 0.6 < np.sqrt(np.mean(np.concatenate(pulls) ** 2)) < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("periods", [(11, 17), (43, 67)])
def test_slow_errors_of_bands_are_stated_though_the_track_is_smooth(periods):
    """By root mean squares over three draws: that of one, with four bands of which two mirror two, is known to half.

    Waves of eleven frames are part noise and part slow error, and both together are judged; long ones are slow.
    """
    frames = np.arange(100.0)
    true, moves = grown_px(frames), (frames > 12)[:, None]
    found = []
    for seed in (333, 334, 335):
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, BANDS))
        # Two waves for every band, which its neighbours do not have: differences of the track hardly see any of them.
        waves = [0.6 * np.sin(2 * np.pi * frames[:, None] / T + p) for T, p in zip(periods, phase, strict=True)]
        luma = step_frames((true[:, None] + np.sum(waves, axis=0) * moves)[:, None, :])
        error, tracking, sigma, slow = errors(luma, 0.05, true)
        use = (frames > 25) & (frames < 95) & tracking.track.usable
        assert use.sum() > 60
        found.append((error[use].var(), np.mean(sigma[use] ** 2), np.mean(slow[use] ** 2)))
    variance, noise, share = np.mean(found, axis=0)
    assert 0.6 < np.sqrt(variance / (noise + share)) < 1.8
    if min(periods) > 40:
        assert 0.6 < np.sqrt(variance / share) < 1.9


@pytest.mark.parametrize("exposure", [0.1, 0.9])
def test_an_edge_that_speeds_up_is_placed_where_it_was_at_mid_exposure(exposure):
    """At 4 px a frame² its mean over 0.9 frames lies aτ²/24 = 0.135 px ahead of where it was in their middle."""
    frames = np.arange(32.0)
    at, true = (60.0 + 2.0 * np.clip(t - 12.0, 0.0, 13.0) ** 2 for t in (instants(frames, exposure), frames))
    error, tracking, *_ = errors(step_frames(at, noise=1.0), exposure, true)
    use = (frames > 15) & (frames < 24) & tracking.track.usable
    assert use.sum() >= 7
    assert abs(error[use].mean()) < 0.05


def test_an_edge_that_stops_within_an_exposure_has_the_error_of_its_dwell():
    """Half of an exposure at 20 px a frame, half at rest: seen on average vτ/8 behind where it is in the middle."""
    frames, exposure = np.arange(36.0), 0.5
    at, true = (
        np.minimum(60.0 + 20.0 * np.clip(t - 12.0, 0.0, None), 380.0) for t in (instants(frames, exposure), frames)
    )
    error, _, sigma, _ = errors(step_frames(at, noise=1.0), exposure, true)
    last = int(np.argmax(true >= 380.0))
    assert 0.8 * 20.0 * exposure / 8 < sigma[last] < 3.0  # by the edge as measured, which is behind itself
    assert np.abs(error[14 : last + 1] / np.hypot(sigma, 0.1)[14 : last + 1]).max() < 4.0
    assert sigma[16 : last - 4].max() < 0.5


@pytest.mark.slow
def test_a_noisier_picture_has_a_larger_error():
    """Every fourth picture has five times the noise, as where a coder spares bits."""
    frames = np.arange(95.0)
    true = grown_px(frames)
    moves = (frames > 20) & (frames < 92)
    noisy = moves & (frames % 4 == 0)
    found = []
    for seed in (342, 343, 344, 345):
        luma = step_frames(true[:, None], seed=seed).astype(float)
        luma[noisy] += np.random.default_rng(seed).normal(0, 10, luma[noisy].shape)
        error, tracking, sigma, _ = errors(np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, true)
        use = moves & tracking.track.usable
        found.append(np.array([error, sigma, noisy])[:, use])
    error, sigma, which = np.concatenate(found, axis=1)
    for chosen, low, high in ((which == 1, 0.7, 2.0), (which == 0, 0.8, 1.25)):
        assert low < np.sqrt(np.mean(sigma[chosen] ** 2) / np.mean(error[chosen] ** 2)) < high


@pytest.mark.parametrize("door_grey", [30, 60, 90])
def test_an_edge_behind_a_sliding_door_is_lost(door_grey):
    """A striped door slides by in front of the first 80 px of growth; the tip comes out from behind it and is seen."""
    frames, columns = np.arange(80.0), np.arange(COLUMNS)
    true = grown_px(frames)
    luma = step_frames(true[:, None]).astype(float)
    noise = np.random.default_rng(336).normal(0, 2, luma.shape)
    stripes = np.sin(2 * np.pi * (columns + 6 * np.minimum(frames, 40)[:, None]) / 30)
    luma[:, :, :140] = (door_grey + 40 * stripes[:, None, :] + noise)[:, :, :140]
    error, tracking, *_ = errors(np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, true)
    usable = tracking.track.usable
    assert not usable[(frames > 12) & (true < 138)].any()
    assert usable[true > 150].all()
    assert np.abs(error[usable]).max() < 0.1


def test_a_followed_door_is_off_by_its_distance_from_the_extrapolated_motion_and_a_tip_by_nothing():
    """Hidden frames that do not lead up to the motion after them, and those that do: a tip followed from rest."""
    frames, noise = np.arange(40.0), np.random.default_rng(351).normal(0, 0.1, 40)
    for frame in (8.0, 8.99, 8.3):
        moved = np.clip(frames - frame, 0.0, None)  # at rest at 100 px until a moment between frames
        true = 100.0 + 0.5 * 3.0 * moved**2
        for tip in (true + noise, 100.0 + 20.0 * moved):
            assert leap_error_px(tip, frames < 14).max() == 0.0
    edge = np.where(frames < 14, 130.0 + 0.8 * frames, true)  # the tip comes out at frame 14, at 149 px
    error = leap_error_px(edge, frames < 16)
    assert error[14:].max() == 0.0
    assert error[:14] == pytest.approx(np.abs(edge - true)[:14], abs=6.0)
    assert error[:10].min() > 20.0
