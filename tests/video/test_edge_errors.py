"""Stated errors of the edge against its true ones, in pictures drawn here and by other code; seeds 331 and up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plain_scene import Plan, plain_scene
from scipy.special import ndtr

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.edge_repair import BANDS, BLUR_SIGMA_PART, dwell_error_px
from vinetrack.video.frames import Frames, Recording, Region
from vinetrack.video.track import Tracking, track_frames

SHORT = {"width": 520, "height": 160, "from_px": (20.0, 80.0), "start_px": 50.0, "end_px": 430.0, "radius": 24.0}
ROWS, COLUMNS, TUBE = 120, 460, 40
SUB_INSTANTS = 60


def tracked(luma: np.ndarray, exposure: float, axis: Axis | None = None) -> Tracking:
    """One tenth of a millimetre a pixel, a thousand frames a second."""
    n, height, width = luma.shape
    recording = Recording(path=Path("drawn.mp4"), kind="container", width=width, height=height, bit_depth=8,
                          declared_frames=n)  # fmt: skip
    frames = Frames(recording, Region(0, 0, width, height), luma, np.arange(n), np.zeros(n, dtype=bool))
    trial = Trial(name="t", capture_fps=1000.0, exposure_s=exposure / 1000.0, m_per_px=1e-4)
    return track_frames(frames, trial, 1000.0, axis)


def step_frames(edge_px: np.ndarray, noise: float = 2.0, seed: int = 331) -> np.ndarray:
    """A straight front between background of 60 and film of 160, blurred by 1 px, averaged over instants.

    `edge_px` has shape (n_frames, n_instants) or (n_frames, n_instants, n_bands): a front for each band of rows.
    """
    bands = edge_px if edge_px.ndim == 3 else edge_px[:, :, None]
    cover = ndtr(bands[..., None] - np.arange(COLUMNS)).mean(axis=1)
    luma = np.full((len(edge_px), ROWS, COLUMNS), 60.0)
    top = (ROWS - TUBE) // 2
    luma[:, top : top + TUBE] += 100 * np.repeat(cover, TUBE // cover.shape[1], axis=1)
    luma += np.random.default_rng(seed).normal(0, noise, luma.shape)
    return np.rint(np.clip(luma, 0, 255)).astype(np.uint8)


def grown_px(frames: np.ndarray, start_px: float = 60.0, rest: int = 12, speed: float = 4.0) -> np.ndarray:
    """Rest, then one speed, at these times in frames."""
    return start_px + speed * np.maximum(frames - rest, 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"wall_sd": 30.0, "tail_sd": 30.0},
        {"wall_sd": 5.0, "tail_sd": 45.0},
        {"background_sd": 30.0},
        {"door": True},
    ],
)
def test_stated_errors_match_the_true_errors(changes: dict[str, float]) -> None:
    """Random errors show in second differences of the errors: Σ(1, −2, 1)² = 6."""
    pulls = []
    for seed in (331, 332):
        plan = Plan(**{**SHORT, **changes, "seed": seed})
        scene = plain_scene(plan)
        tracking = tracked(scene.frames, plan.exposure)
        error = tracking.track.edge_px + tracking.axis.from_px[0] - plan.from_px[0] - scene.edge_px
        sigma = tracking.track.lead_position_sigma_m * 1e4
        use = scene.moving & tracking.track.usable
        error, sigma = error[use], sigma[use]
        pulls.append(np.diff(error, 2) / np.sqrt(sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2))
    assert 0.6 < np.sqrt(np.mean(np.concatenate(pulls) ** 2)) < 1.3


@pytest.mark.parametrize("periods", [(11, 17), (43, 67)])
def test_slow_errors_of_bands_are_stated_though_the_track_is_smooth(periods: tuple[int, int]) -> None:
    """By root mean squares over three draws: that of one, with four bands of which two mirror two, is known to half.

    Waves of eleven frames are part noise and part slow error, and both together are judged; long ones are slow.
    """
    frames = np.arange(100.0)
    true, moves = grown_px(frames), (frames > 12)[:, None]
    errors, noises, shares = [], [], []
    for seed in (333, 334, 335):
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, BANDS))
        # Two waves for every band, which its neighbours do not have: differences of the track hardly see any of them.
        waves = [0.6 * np.sin(2 * np.pi * frames[:, None] / T + p) for T, p in zip(periods, phase, strict=True)]
        luma = step_frames((true[:, None] + np.sum(waves, axis=0) * moves)[:, None, :])
        tracking = tracked(luma, 0.05, Axis((20.0, 59.5), (440.0, 59.5), 40.0))
        use = (frames > 25) & (frames < 95) & tracking.track.usable
        assert use.sum() > 60
        error = (tracking.track.edge_px + tracking.axis.from_px[0] - true)[use]
        errors.append(error.var())
        assert tracking.track.lead_position_systematic_m is not None
        noises.append(np.mean((tracking.track.lead_position_sigma_m[use] * 1e4) ** 2))
        shares.append(np.mean((tracking.track.lead_position_systematic_m[use] * 1e4) ** 2))
    assert 0.6 < np.sqrt(np.mean(errors) / (np.mean(noises) + np.mean(shares))) < 1.8
    if min(periods) > 40:
        assert 0.6 < np.sqrt(np.mean(errors) / np.mean(shares)) < 1.9


@pytest.mark.parametrize("exposure", [0.1, 0.9])
def test_an_edge_that_speeds_up_is_placed_where_it_was_at_mid_exposure(exposure: float) -> None:
    """At 4 px a frame² its mean over 0.9 frames lies aτ²/24 = 0.135 px ahead of where it was in their middle."""
    frames = np.arange(32.0)
    instants = frames[:, None] + exposure * (np.arange(SUB_INSTANTS) + 0.5 - SUB_INSTANTS / 2) / SUB_INSTANTS

    def place(time: np.ndarray) -> np.ndarray:
        return 60.0 + 2.0 * np.clip(time - 12.0, 0.0, 13.0) ** 2

    tracking = tracked(step_frames(place(instants), noise=1.0), exposure, Axis((20.0, 59.5), (440.0, 59.5), 40.0))
    use = (frames > 15) & (frames < 24) & tracking.track.usable
    assert use.sum() >= 7
    error = (tracking.track.edge_px + tracking.axis.from_px[0] - place(frames))[use]
    assert abs(error.mean()) < 0.05


def test_an_edge_that_stops_within_an_exposure_has_the_error_of_its_dwell() -> None:
    """Half of an exposure at 20 px a frame, half at rest: seen on average vτ/8 behind where it is in the middle."""
    frames, exposure, stop = np.arange(36.0), 0.5, 380.0
    instants = frames[:, None] + exposure * (np.arange(SUB_INSTANTS) + 0.5 - SUB_INSTANTS / 2) / SUB_INSTANTS

    def place(time: np.ndarray) -> np.ndarray:
        return np.minimum(60.0 + 20.0 * np.clip(time - 12.0, 0.0, None), stop)

    tracking = tracked(step_frames(place(instants), noise=1.0), exposure, Axis((20.0, 59.5), (440.0, 59.5), 40.0))
    error = tracking.track.edge_px + tracking.axis.from_px[0] - place(frames)
    sigma = tracking.track.lead_position_sigma_m * 1e4
    last = int(np.flatnonzero(place(frames) >= stop)[0])
    assert 0.8 * 20.0 * exposure / 8 < sigma[last] < 3.0  # by the edge as measured, which is behind itself
    assert np.abs(error[14 : last + 1] / np.hypot(sigma, 0.1)[14 : last + 1]).max() < 4.0
    assert sigma[16 : last - 4].max() < 0.5


def test_a_noisier_picture_has_a_larger_error() -> None:
    """Every fourth picture has five times the noise, as where a coder spares bits."""
    frames = np.arange(95.0)
    true = grown_px(frames)
    moves = (frames > 20) & (frames < 92)
    noisy = moves & (frames % 4 == 0)
    errors, stated, chosen = [], [], []
    for seed in (342, 343, 344, 345):
        luma = step_frames(true[:, None], seed=seed).astype(float)
        luma[noisy] += np.random.default_rng(seed).normal(0, 10, luma[noisy].shape)
        tracking = tracked(
            np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, Axis((20.0, 59.5), (440.0, 59.5), 40.0)
        )
        use = moves & tracking.track.usable
        errors.append((tracking.track.edge_px + tracking.axis.from_px[0] - true)[use])
        stated.append(tracking.track.lead_position_sigma_m[use] * 1e4)
        chosen.append(noisy[use])
    error, sigma, which = map(np.concatenate, (errors, stated, chosen))
    assert 0.7 < np.sqrt(np.mean(sigma[which] ** 2) / np.mean(error[which] ** 2)) < 2.0
    assert 0.8 < np.sqrt(np.mean(sigma[~which] ** 2) / np.mean(error[~which] ** 2)) < 1.25


@pytest.mark.parametrize("door_grey", [30, 60, 90])
def test_an_edge_behind_a_sliding_door_is_lost(door_grey: int) -> None:
    """A striped door slides by in front of the first 80 px of growth; the tip comes out from behind it and is seen."""
    frames, columns = np.arange(80.0), np.arange(COLUMNS)
    true = grown_px(frames)
    luma = step_frames(true[:, None]).astype(float)
    noise = np.random.default_rng(336).normal(0, 2, luma.shape)
    stripes = np.sin(2 * np.pi * (columns + 6 * np.minimum(frames, 40)[:, None]) / 30)
    luma[:, :, :140] = (door_grey + 40 * stripes[:, None, :] + noise)[:, :, :140]
    tracking = tracked(np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, Axis((20.0, 59.5), (440.0, 59.5), 40.0))
    usable = tracking.track.usable
    assert not usable[(frames > 12) & (true < 138)].any()
    assert usable[true > 150].all()
    error = tracking.track.edge_px + tracking.axis.from_px[0] - true
    assert np.abs(error[usable]).max() < 0.1


@pytest.mark.parametrize("exposure", [0.9, 0.5, 0.1])
@pytest.mark.parametrize("stop", [-0.2, 0.0, 0.04, 0.3])
@pytest.mark.parametrize("sense", [1, -1])
def test_the_error_of_dwell_is_the_mean_place_over_the_exposure(exposure: float, stop: float, sense: int) -> None:
    """At 20 px a frame, stopping so many frames from the middle of frame 20's exposure; or setting off then."""
    middle = np.arange(41.0)
    instants = middle[:, None] + exposure * np.linspace(-0.5, 0.5, 2001)
    place = 20.0 * np.minimum(sense * (instants - 20.0), sense * stop).mean(axis=1)
    edge = 20.0 * np.minimum(sense * (middle - 20.0), sense * stop)
    unsure_px = BLUR_SIGMA_PART * exposure / 4 * np.abs(np.diff(np.pad(edge, 1, mode="edge"), 2))
    assert dwell_error_px(edge, exposure)[2:-2] == pytest.approx(np.hypot(edge - place, unsure_px)[2:-2], abs=0.01)


def test_uniform_motion_has_no_dwell_error_and_acceleration_hardly_any() -> None:
    frames = np.arange(40.0)
    assert dwell_error_px(7.0 * frames, 0.5)[2:-2].max() < 1e-9
    assert dwell_error_px(0.5 * (frames + 3) ** 2, 0.5)[2:-2].max() < 0.04
