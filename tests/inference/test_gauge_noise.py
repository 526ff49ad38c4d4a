"""The noise of a gauge is taken out of a recorded pressure, its corners are not."""

from __future__ import annotations

import numpy as np
import pytest
from lsoda_vine import as_track

from vinetrack.inference.gauge_noise import quiet_traces, without_noise
from vinetrack.inference.gauge_readings import gauge_readings, noise_correlation, noise_of, noises_of

TIMES_S = np.arange(0.0, 0.6, 1e-3)
PASSED_PA = 9.5e3 + 22.0  # half-way between two samples
LET_DOWN = np.interp(TIMES_S, [0.1, 0.12, 0.2, 0.5], [16e3, 3e3, 3e3, 16e3])


@pytest.mark.parametrize("sigma_Pa", [30.0, 100.0, 300.0])
def test_most_of_the_noise_goes(sigma_Pa: float):
    # A line through 33 samples leaves 1/√33 = 0.17 of the noise in its middle; corners keep more.
    lefts = []
    for seed in range(10):
        noisy = LET_DOWN + sigma_Pa * np.random.default_rng(seed).standard_normal(TIMES_S.size)
        assert noise_of(noisy) == pytest.approx(sigma_Pa, rel=0.15)
        lefts.append(without_noise(noisy) - LET_DOWN)
    assert np.sqrt(np.mean(np.square(lefts))) < 0.5 * sigma_Pa
    assert np.max(np.abs(lefts)) < 5 * sigma_Pa


def test_a_threshold_is_passed_where_the_pressure_passes_it():
    # On 43 Pa a sample noise of 100 Pa shows the first passage a sample early or more.
    early, kept = [], []
    rise = TIMES_S > 0.25
    true_s = TIMES_S[rise][np.argmax(LET_DOWN[rise] > PASSED_PA)]
    for seed in range(40):
        noisy = LET_DOWN + 100.0 * np.random.default_rng(seed).standard_normal(TIMES_S.size)
        early.append(TIMES_S[rise][np.argmax(noisy[rise] > PASSED_PA)] - true_s)
        kept.append(TIMES_S[rise][np.argmax(without_noise(noisy)[rise] > PASSED_PA)] - true_s)
    assert np.mean(early) < -1e-3
    assert abs(np.mean(kept)) < 0.5e-3


def test_a_pressure_that_hardly_changes_is_known_far_better_than_a_sample():
    falls = 20e3 * (1 + TIMES_S / 0.4) ** -0.3
    left = [
        without_noise(falls + 100.0 * np.random.default_rng(seed).standard_normal(TIMES_S.size)) - falls
        for seed in range(10)
    ]
    assert np.sqrt(np.mean(np.square(left))) < 40.0


def test_exact_pressures_stay_as_they_are():
    assert without_noise(LET_DOWN) is LET_DOWN
    fills = 16e3 * -np.expm1(-TIMES_S / 0.2)
    np.testing.assert_array_equal(without_noise(fills), fills)
    np.testing.assert_array_equal(without_noise(np.full(5, 3.0)), np.full(5, 3.0))


def emptied(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A chamber that a tube empties from 0.06 s on: pressure, the same with 50 Pa of noise, and the growth."""
    rng = np.random.default_rng(seed)
    growth_m = 0.3 * -np.expm1(-np.maximum(TIMES_S - 0.06, 0.0) / 0.3)
    pressure_Pa = 127e3 * (1 + 0.1 * growth_m) ** -1.4 - 101e3
    noise_Pa, noise_m = 50.0 * rng.standard_normal(TIMES_S.size), 4e-5 * rng.standard_normal(TIMES_S.size)
    return pressure_Pa, pressure_Pa + noise_Pa, growth_m + noise_m


@pytest.mark.parametrize("late_frames", [0, 12, -12])
def test_the_growth_tells_where_a_chamber_begins_to_empty_whatever_the_gauges_clock(late_frames: int):
    # What moves a vine is the time integral of the pressure. That of the noise wanders by σ √n = 1.2 kPa samples
    # before the best curve is taken out; a corner rounded by 70 Pa over 40 samples is worth more than twice that.
    wanders, at_corner = [], []
    for seed in range(20):
        pressure_Pa, noisy_Pa, growth_m = emptied(seed)
        place = np.clip(np.arange(TIMES_S.size) + late_frames, 0, TIMES_S.size - 1)
        left = without_noise(noisy_Pa, growth_m[place]) - pressure_Pa
        wanders.append(np.ptp(np.cumsum(left)))
        at_corner.append(left[60])
    assert np.mean(wanders) < 1.5 * 50.0 * np.sqrt(TIMES_S.size)
    assert abs(np.mean(at_corner)) < 15.0


def test_without_the_growth_such_a_corner_is_rounded():
    left = [without_noise(noisy_Pa)[60] - pressure_Pa[60] for pressure_Pa, noisy_Pa, _ in map(emptied, range(20))]
    assert np.mean(left) < -25.0


def test_a_bend_that_few_of_many_steady_traces_show_by_chance_is_noise():
    draw = np.random.default_rng(8)
    noisy = [20e3 + 100.0 * draw.standard_normal(150) for _ in range(60)]
    growth_m = np.cumsum(np.linspace(0.0, 1.0, 150)) * 2e-3
    alone = [without_noise(pressure_Pa, growth_m) for pressure_Pa in noisy]
    assert sum(np.ptp(curve) > 0 for curve in alone) > 3
    together = quiet_traces([as_track(TIMES_S[:150], growth_m, pressure_Pa) for pressure_Pa in noisy])
    bent = sum(trace is None or np.ptp(trace.pressure_Pa) > 1e-6 for trace in together)
    # Of sixty traces each is refused every curve by chance once in a few hundred, and left to straight lines.
    assert bent <= 2


def test_errors_that_are_stated_cover_those_that_are_made():
    """Of chambers that empty: what is left of the noise, along each error, is as large as stated."""
    made = [emptied(seed) for seed in range(40)]
    quiet = quiet_traces([as_track(TIMES_S, growth_m, noisy_Pa) for _, noisy_Pa, growth_m in made])
    sizes = []
    for trace, (pressure_Pa, _, _) in zip(quiet, made, strict=True):
        assert trace is not None
        assert trace.mean_error_Pa == pytest.approx(50.0 / np.sqrt(TIMES_S.size), rel=0.25)
        wrong_Pa = trace.pressure_Pa - pressure_Pa
        sizes += list(trace.errors_Pa.T @ wrong_Pa / np.sum(trace.errors_Pa**2, axis=0))
    assert len(sizes) >= 40
    assert 0.7 < np.sqrt(np.mean(np.square(sizes))) < 1.5


@pytest.mark.parametrize("per_reading", [3.4, 5.0, 18.0])
def test_readings_between_which_a_trace_was_filled_up_are_told(per_reading: float):
    draw = np.random.default_rng(3)
    read_at = np.arange(0.3, 400.0, per_reading)
    readings_Pa = 20e3 + 100.0 * draw.standard_normal(read_at.size)
    frames = np.arange(int(read_at[0]) + 1, int(read_at[-1]))
    told = gauge_readings(np.interp(frames, read_at, readings_Pa))
    assert told is not None
    # All but the first and the last, for which the ends of the trace stand.
    np.testing.assert_allclose(told[0][1:-1] + frames[0], read_at[1:-1], atol=1e-4)
    np.testing.assert_allclose(told[1][1:-1], readings_Pa[1:-1], rtol=1e-8)
    held = gauge_readings(readings_Pa[np.searchsorted(read_at, frames, side="right") - 1])
    assert held is not None
    assert np.isin(held[1], readings_Pa).all()
    assert np.max(np.abs(held[0] + frames[0] - read_at[: held[0].size])) <= 1.0


def test_white_noise_and_exact_courses_are_not_filled_up():
    draw = np.random.default_rng(3)
    assert gauge_readings(20e3 + 100.0 * draw.standard_normal(200)) is None
    assert gauge_readings(16e3 * -np.expm1(-TIMES_S / 0.2)) is None
    assert gauge_readings(np.full(50, 20e3)) is None


def test_noise_behind_a_filter_is_told_by_how_it_differs_over_four_readings():
    draw = np.random.default_rng(5)
    for rho in (0.0, 0.5, 0.85):
        traces = []
        for _ in range(24):
            new = np.sqrt(1 - rho**2) * draw.standard_normal(300)
            noise = np.zeros(300)
            for i in range(1, 300):
                noise[i] = rho * noise[i - 1] + new[i]
            traces.append(20e3 * (1 + TIMES_S[:300] / 0.4) ** -0.3 + 100.0 * noise)
        told = noise_correlation(traces)
        assert told == pytest.approx(rho, abs=0.05)
        sigmas = [noise.sigma_Pa for noise in noises_of(traces, told)]
        assert np.mean(sigmas) == pytest.approx(100.0 * np.sqrt(1 - rho**2), rel=0.1)


@pytest.mark.parametrize("per_reading", [1, 6])
def test_of_steady_pressures_hardly_any_course_is_left(per_reading: int):
    """By a gauge that is read at every frame, or at every sixth and joined by lines."""
    draw = np.random.default_rng(6)
    tracks = []
    for _ in range(30):
        frames = np.arange(int(draw.integers(60, 300)))
        read_at = np.arange(-1.0, frames.size + per_reading, per_reading)
        readings_Pa = 8e3 + 100.0 * draw.standard_normal(read_at.size)
        tracks.append(as_track(frames / 500, frames**2 * 1e-6, np.interp(frames, read_at, readings_Pa)))
    off = [trace.pressure_Pa - 8e3 for trace in quiet_traces(tracks) if trace is not None]
    assert len(off) == 30
    assert sum(float(np.ptp(each)) > 1e-6 for each in off) <= 1
    stated = [trace.mean_error_Pa for trace in quiet_traces(tracks) if trace is not None]
    assert 0.7 < np.sqrt(np.mean((np.array([each.mean() for each in off]) / stated) ** 2)) < 1.4
