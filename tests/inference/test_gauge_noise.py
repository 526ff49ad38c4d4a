"""Gauge noise is removed from a recorded pressure; what it leaves is estimated and not taken for physics."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from lsoda_vine import as_track, small_campaign

import vinetrack as vt
from vinetrack.diagnosis.ladder import orthogonal_part
from vinetrack.inference import gauge_noise as gauge
from vinetrack.inference.errors import with_systematics
from vinetrack.inference.fit_data import prepare
from vinetrack.inference.optimiser import FixedTerms, solve_onward
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.systematics import systematics_of
from vinetrack.tracks.position_noise import ar1_noise

TIMES_S = np.arange(0.0, 0.6, 1e-3)
FRAMES = np.arange(TIMES_S.size)
LET_DOWN = np.interp(TIMES_S, [0.1, 0.12, 0.2, 0.5], [16e3, 3e3, 3e3, 16e3])
GROWTH_M = 0.3 * -np.expm1(-np.maximum(TIMES_S - 0.06, 0.0) / 0.3)


def without_noise(pressure_Pa: np.ndarray) -> np.ndarray:
    still = as_track(1e-3 * np.arange(pressure_Pa.size), np.zeros(pressure_Pa.size), pressure_Pa)
    return gauge.denoised_traces([still])[0].pressure_Pa


@pytest.mark.parametrize("sigma_Pa", [30.0, 300.0])
def test_most_of_the_noise_is_removed(sigma_Pa):
    # A line through 33 samples leaves 1/√33 = 0.17 of the noise in its middle; corners keep more.
    lefts = []
    for seed in range(10):
        noisy = LET_DOWN + sigma_Pa * np.random.default_rng(seed).standard_normal(TIMES_S.size)
        assert gauge.white_noise_sd(noisy) == pytest.approx(sigma_Pa, rel=0.15)
        lefts.append(without_noise(noisy) - LET_DOWN)
    assert np.sqrt(np.mean(np.square(lefts))) < 0.5 * sigma_Pa
    assert np.max(np.abs(lefts)) < 5 * sigma_Pa


def test_exact_pressures_are_unchanged_and_equal_readings_handled():
    for exact_Pa in (LET_DOWN, 16e3 * -np.expm1(-TIMES_S / 0.2), np.full(5, 3.0)):
        np.testing.assert_array_equal(without_noise(exact_Pa), exact_Pa)
    told_Pa = 20e3 + 100.0 * (np.arange(60) == 30)  # readings that are nearly all equal
    assert gauge.noise_correlations([told_Pa] * 4) == [0.0]
    assert np.isfinite(without_noise(told_Pa)).all()


def emptied(seed: int, noise_Pa: float = 50.0, beyond: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A chamber that a tube empties from 0.06 s on: pressure, so many frames beyond the last as well, the same with
    noise, and the growth.
    """
    rng = np.random.default_rng(seed)
    longer_s = 1e-3 * np.arange(TIMES_S.size + beyond)
    pressure_Pa = 127e3 * (1 + 0.03 * -np.expm1(-np.maximum(longer_s - 0.06, 0.0) / 0.3)) ** -1.4 - 101e3
    noise_Pa, noise_m = noise_Pa * rng.standard_normal(longer_s.size), 4e-5 * rng.standard_normal(TIMES_S.size)
    return pressure_Pa, pressure_Pa + noise_Pa, GROWTH_M + noise_m


@pytest.mark.parametrize(("offset", "lag"), [(12.4, 0.0), (-7.8, 0.0), (3.2, 9.0)])
def test_the_clock_and_the_lag_of_a_gauge_are_estimated_from_all_trials(offset, lag):
    truth_s, traces, growths, read_at = 1e-3 * np.array([offset, lag]), [], [], np.arange(0, FRAMES.size + 8, 8)
    for seed in range(12):
        shown_Pa, _, growth_m = emptied(seed)
        for k in range(1, FRAMES.size if lag else 0):
            shown_Pa[k] = shown_Pa[k - 1] + (shown_Pa[k] - shown_Pa[k - 1]) * -np.expm1(-1 / lag)
        readings_Pa = np.interp(read_at + offset, FRAMES, shown_Pa)
        readings_Pa += 50.0 * np.random.default_rng(100 + seed).standard_normal(read_at.size)
        traces.append(np.interp(FRAMES, read_at, readings_Pa))
        growths.append(gauge.Growth(growth_m, 1e-3))
    read = gauge.gauge_readings(traces)
    noises = gauge.noise_of_traces(read, 0.0)
    recorded = [gauge.Recorded(*one) for one in zip(read, [FRAMES.size] * 12, noises, growths, strict=True)]

    def squared_error(clock):
        """In units of both errors, which are independent along some axes: 2 on average."""
        return float(np.sum((np.linalg.pinv(clock.errors_s.T) @ (clock.at_s - truth_s)) ** 2))

    alone, together = [gauge.gauge_clock([one]) for one in recorded], gauge.gauge_clock(recorded)
    sizes_s = [np.linalg.norm(clock.errors_s) for clock in (together, *alone)]
    assert lag or 0.5 < np.mean(list(map(squared_error, alone))) < 3.5  # one trace alone shows no lag of nine frames
    assert 0.1e-3 < sizes_s[0] < 0.5 * np.median(sizes_s[1:])
    assert squared_error(together) < 9.2  # 99 % of two degrees of freedom


@pytest.mark.slow
@pytest.mark.parametrize(("exponent", "noise_Pa"), [(1.0, 5.0), (1.4, 5.0), (1.0, 50.0), (1.4, 50.0)])
def test_the_exponent_of_a_chamber_is_estimated_from_all_trials(exponent, noise_Pa):
    """The error that twenty traces share is no larger than their noise makes it."""
    pressure_Pa = 115e3 * (1 + 0.3 * GROWTH_M / exponent) ** -exponent - 101_325.0
    draws = [np.random.default_rng(300 + seed).standard_normal(TIMES_S.size) for seed in range(20)]
    quiet = gauge.denoised_traces([as_track(TIMES_S, GROWTH_M, pressure_Pa + noise_Pa * draw) for draw in draws])
    off = np.array([trace.pressure_Pa - pressure_Pa for trace in quiet])
    assert np.std(np.mean(off, axis=0)) < 0.3 + 0.02 * noise_Pa


def test_a_corner_between_two_readings_is_where_the_growth_begins():
    """Of a gauge that is read 67 times a second, with 10 Pa of noise; lines between its readings cut the corner."""
    tracks, true_Pa, cut_Pa = [], [], []
    for seed in range(12):
        longer_Pa, _, growth_m = emptied(seed, beyond=15)
        pressure_Pa = longer_Pa[: FRAMES.size]
        read_at = np.arange(seed, FRAMES.size + 15, 15) - 12
        readings_Pa = np.interp(read_at, np.arange(longer_Pa.size), longer_Pa)
        cut_Pa.append(np.max(np.abs(np.interp(FRAMES, read_at, readings_Pa) - pressure_Pa)))
        readings_Pa += 10.0 * np.random.default_rng(200 + seed).standard_normal(read_at.size)
        tracks.append(as_track(TIMES_S, growth_m, np.interp(FRAMES, read_at, readings_Pa)))
        true_Pa.append(pressure_Pa)
    off_Pa = np.array([trace.pressure_Pa for trace in gauge.denoised_traces(tracks)]) - true_Pa
    assert np.max(cut_Pa) > 50.0
    assert np.max(np.abs(off_Pa)) < 0.5 * np.max(cut_Pa)


def test_exact_traces_and_one_that_no_curve_explains_do_not_change_the_others():
    """Noise behind a filter, beside six exact pressures and one that jumps."""
    draw, growth_m = np.random.default_rng(8), GROWTH_M[:400]
    noisy = [20e3 + ar1_noise(400, 60.0, 0.7, draw) for _ in range(6)]
    jump = 20e3 + 3e3 * (np.arange(400) > 200) + ar1_noise(400, 60.0, 0.7, draw)
    of = [as_track(TIMES_S[:400], growth_m, each) for each in (*noisy, *[np.full(400, 15e3)] * 6, jump)]
    alone, together = (gauge.denoised_traces(tracks)[:6] for tracks in (of[:6], of))
    for one, other in zip(alone, together, strict=True):
        assert other.pressure_Pa == pytest.approx(one.pressure_Pa, abs=8.0)
        assert np.std(other.pressure_Pa) < 12.0
        assert other.mean_error_Pa == pytest.approx(60.0 * np.sqrt(1.7 / 0.3 / 400), rel=0.4)


@pytest.mark.slow
def test_stated_errors_cover_the_actual_errors():
    made = [emptied(seed, 200.0) for seed in range(40)]
    quiet = gauge.denoised_traces([as_track(TIMES_S, growth_m, noisy_Pa) for _, noisy_Pa, growth_m in made])
    sizes = []
    for trace, (pressure_Pa, _, _) in zip(quiet, made, strict=True):
        assert trace.mean_error_Pa == pytest.approx(200.0 / np.sqrt(TIMES_S.size), rel=0.25)
        wrong_Pa = trace.pressure_Pa - pressure_Pa
        along, stated_Pa, _ = np.linalg.svd(trace.errors_Pa, full_matrices=False)
        tells = stated_Pa > 0.01 * stated_Pa[0]
        sizes += list((along.T @ wrong_Pa / stated_Pa)[tells])
    assert len(sizes) >= 40
    # What all trials have together, clock and exponent, is stated √n times in each.
    assert 0.45 < np.sqrt(np.mean(np.square(sizes))) < 1.5


@pytest.mark.parametrize("digit_Pa", [0.01, 1.0, 10.0])
@pytest.mark.parametrize("per_reading", [5.0, 40.0])
def test_readings_are_recovered_from_samples_rounded_after_interpolation(per_reading, digit_Pa):
    draw = np.random.default_rng(11)
    read_at = np.arange(0.3, 600.0, per_reading)
    readings_Pa = 20e3 + 100.0 * draw.standard_normal((8, read_at.size))
    frames = np.arange(int(read_at[0]) + 1, int(read_at[-1]))
    traces = [digit_Pa * np.round(np.interp(frames, read_at, each) / digit_Pa) for each in readings_Pa]
    told = gauge.gauge_readings(traces)
    assert np.mean([noise.sigma_Pa for noise in gauge.noise_of_traces(told, 0.0)]) == pytest.approx(100.0, rel=0.15)
    for trace, each in zip(traces, told, strict=True):
        assert each.places.size < 1.1 * trace.size / per_reading + 2
        off_Pa = np.interp(np.arange(trace.size), each.places, each.values_Pa) - trace
        assert np.sqrt(np.mean(off_Pa**2)) < 0.6 * digit_Pa
        assert np.max(np.abs(off_Pa)) < 2 * digit_Pa


@pytest.mark.parametrize("per_reading", [5.3, 13.4])
def test_readings_in_coarse_steps_are_recovered_although_many_are_equal(per_reading):
    draw = np.random.default_rng(13)
    read_at = np.arange(0.3, 600.0, per_reading)
    readings_Pa = 100.0 * np.round((20e3 + 60.0 * draw.standard_normal(read_at.size)) / 100.0)
    frames = np.arange(int(read_at[1]) + 1, int(read_at[-1]))
    (held,) = gauge.gauge_readings([readings_Pa[np.searchsorted(read_at, frames, side="right") - 1]])
    (joined,) = gauge.gauge_readings([np.interp(frames, read_at, readings_Pa)])
    places = held.places + frames[0]
    which = np.argmin(np.abs(places[:, None] - read_at), axis=1)
    assert np.max(np.abs(places - read_at[which])) < 1.0
    np.testing.assert_array_equal(held.values_Pa, readings_Pa[which])
    rounded_Pa = np.hypot(60.0, 100.0 / np.sqrt(12))
    assert gauge.noise_of_traces([held], 0.0)[0].sigma_Pa == pytest.approx(rounded_Pa, rel=0.2)
    # Lines that stand still for several readings are one: the noise is that of readings that differ.
    assert joined.places.size > 0.6 * read_at.size
    assert rounded_Pa < gauge.noise_of_traces([joined], 0.0)[0].sigma_Pa < 1.6 * rounded_Pa


def test_a_fall_in_steps_coarser_than_its_noise_is_smooth_to_a_fraction_of_a_step():
    tracks, true_Pa, draw = [], [], np.random.default_rng(14)
    for _ in range(20):
        growth_m = 0.3 * np.clip((TIMES_S[:400] - 0.05) / 0.3, 0.0, 1.0) * draw.uniform(0.8, 1.2)
        pressure_Pa = draw.uniform(10e3, 12e3) - 1000.0 * growth_m
        true_Pa.append(pressure_Pa)
        told_Pa = 50.0 * np.round((pressure_Pa + 5.0 * draw.standard_normal(400)) / 50.0)
        tracks.append(as_track(TIMES_S[:400], growth_m, told_Pa))
    off, stated = [], []
    for quiet, pressure_Pa in zip(gauge.denoised_traces(tracks), true_Pa, strict=True):
        off.append(quiet.pressure_Pa - pressure_Pa)
        stated.append(np.hypot(np.linalg.norm(quiet.errors_Pa, axis=1), quiet.mean_error_Pa))
    assert np.max(np.abs(np.diff(off))) < 10.0  # no step is left
    assert np.sqrt(np.mean(np.square(off))) < 50.0 / np.sqrt(12)
    assert np.sqrt(np.mean(np.square(off) / np.square(stated))) < 1.5


@pytest.mark.parametrize("digit_Pa", [1.0, 100.0])
def test_noise_of_about_a_digit_is_not_taken_for_readings(digit_Pa):
    draw = np.random.default_rng(12)
    falls = 20e3 * (1 + TIMES_S / 0.4) ** -0.01
    for sigma_Pa in (0.0, 0.3 * digit_Pa, digit_Pa, 100.0 * digit_Pa):
        noisy = falls + sigma_Pa * draw.standard_normal((8, falls.size))
        traces = list(digit_Pa * np.round(noisy / digit_Pa))
        for told, trace in zip(gauge.gauge_readings(traces), traces, strict=True):
            assert told.edges is not None or told.values_Pa.size == trace.size


def test_noise_behind_a_filter_is_detected_as_correlated():
    draw = np.random.default_rng(5)
    for rho in (0.0, 0.5, 0.85):
        falls = 20e3 * (1 + TIMES_S[:300] / 0.4) ** -0.3
        traces = [falls + ar1_noise(300, 100.0, rho, draw) for _ in range(24)]
        told = gauge.noise_correlations(traces)
        assert told[0] == pytest.approx(rho, abs=0.05)
        assert told[-1] == 0.0
        sigmas = [noise.sigma_Pa for noise in gauge.noise_of_traces(gauge.gauge_readings(traces), rho)]
        assert np.mean(sigmas) == pytest.approx(100.0 * np.sqrt(1 - rho**2), rel=0.1)


def test_noise_that_lasts_for_many_samples_leaves_no_waves():
    draw, tracks = np.random.default_rng(26), []
    for count in range(100, 800, 20):
        pressure_Pa = 8e3 + ar1_noise(count, 100.0, 0.85, draw)
        tracks.append(as_track(np.arange(count) / 1500, np.linspace(0.0, 0.2, count), pressure_Pa))
    quiet = gauge.denoised_traces(tracks)
    assert np.mean([np.std(trace.pressure_Pa) for trace in quiet]) < 2.0
    assert np.mean([trace.errors_Pa.shape[1] for trace in quiet]) < 3


@pytest.mark.slow
@pytest.mark.parametrize("per_reading", [1, 6])
def test_steady_pressures_stay_nearly_constant(per_reading):
    tracks, draw = [], np.random.default_rng(6)
    for _ in range(30):
        frames = np.arange(int(draw.integers(60, 300)))
        read_at = np.arange(-1.0, frames.size + per_reading, per_reading)
        readings_Pa = 8e3 + 100.0 * draw.standard_normal(read_at.size)
        tracks.append(as_track(frames / 500, frames**2 * 1e-6, np.interp(frames, read_at, readings_Pa)))
    quiet = gauge.denoised_traces(tracks)
    off = [trace.pressure_Pa - 8e3 for trace in quiet]
    assert all(np.std(each) < 0.5 * trace.mean_error_Pa for each, trace in zip(off, quiet, strict=True))
    assert per_reading > 1 or np.mean([trace.errors_Pa.shape[1] for trace in quiet]) < 1
    z = [each.mean() / trace.mean_error_Pa for each, trace in zip(off, quiet, strict=True)]
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_pressure_is_extrapolated_linearly_but_not_below_ambient():
    times_s = np.linspace(0.0, 0.2, 201)
    falls = np.where(times_s < 0.1, 30e3, 30e3 - 50e3 * (times_s - 0.1))
    errors = np.column_stack([np.full(201, 20.0), 100 * times_s])
    longer = gauge.DenoisedTrace(times_s, falls, 5.0, errors).extended()
    assert longer.time_s[-1] == pytest.approx(0.24)
    assert [longer.pressure_Pa[-1], *longer.errors_Pa[-1]] == pytest.approx([25e3 - 50e3 * 0.04, 20.0, 24.0])
    let_out = np.maximum(20e3 - 1e5 * times_s, 0.0)
    assert gauge.DenoisedTrace(times_s, let_out, 0.0, np.zeros((201, 0))).extended().pressure_Pa[-1] == 0.0


def test_a_trace_keeps_the_samples_whose_lines_give_all_others():
    pressure_Pa, _, _ = emptied(0)
    errors_Pa = np.column_stack([np.full(TIMES_S.size, 20.0), 30.0 * np.sin(20 * TIMES_S)])
    few = gauge.DenoisedTrace(TIMES_S, pressure_Pa, 5.0, errors_Pa).thinned()
    assert few.time_s.size < 120
    for all_Pa, of_few_Pa in zip([pressure_Pa, *errors_Pa.T], [few.pressure_Pa, *few.errors_Pa.T], strict=True):
        assert np.max(np.abs(np.interp(TIMES_S, few.time_s, of_few_Pa) - all_Pa)) < 1.1e-5 * np.median(pressure_Pa)
    assert np.isin(few.pressure_Pa, pressure_Pa).all()
    still = gauge.DenoisedTrace(TIMES_S, np.full(TIMES_S.size, 8e3), 5.0, np.zeros((TIMES_S.size, 0))).thinned()
    assert still.time_s.tolist() == [TIMES_S[0], TIMES_S[-1]]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """Twelve trials that empty their chambers, a gauge of 50 Pa noise read some 150 times a second; camera noise, m."""
    shot = campaign("gauge_slow_depletion", 20602, (12, 12), weighed=False)
    folder = tmp_path_factory.mktemp("gauge") / "laboratory"
    write_experiment(shot, folder)
    return folder, float(shot.truth["camera"]["noise_m"])  # type: ignore[index]


@pytest.fixture(scope="module")
def fit(laboratory):
    return vt.fit(vt.base_model(), laboratory[0])


def test_residuals_are_position_noise_and_errors_have_their_stated_size(fit, laboratory):
    assert fit.noise_m == pytest.approx(laboratory[1], rel=0.1)
    assert fit.chi2_per_dof < 1.1
    sizes = fit.with_errors.trial_effects[:, N_TRIAL_EFFECTS:]
    sizes = sizes[sizes != 0.0]
    assert sizes.size >= 12
    assert 0.4 < np.sqrt(np.mean(sizes**2)) < 1.6
    assert 0.0 < fit["n"].shared["gauge"] < fit["n"].sigma


def test_an_error_of_a_trace_is_estimated(fit):
    """A trace bent by two of its standard deviations, in the trial that its bend moves most, is bent back: by all but
    what release, origin and deviations of the trial do as well.
    """
    shapes = systematics_of(fit.solution, ["gauge"])
    assert not shapes.sources
    moves_m = [np.max(np.abs(columns[:, 1])) for columns in shapes.own]
    which = int(np.argmax(np.array(moves_m) / [each.noise_m for each in fit.predictor.data]))
    data = list(fit.predictor.data)
    clock_s, pressure_Pa = data[which].trace
    data[which] = replace(data[which], trace=(clock_s, pressure_Pa + 2.0 * data[which].trace_errors_Pa[:, 1]))
    moved = Predictor(fit.predictor.layout, data, fit.predictor.host)
    solution = solve_onward(moved, fit.solution, fit.solution.state.theta, FixedTerms())
    estimates = with_systematics(solution).solution.state.trial_effects - fit.with_errors.trial_effects
    bend_m, back_m = 2.0 * shapes.own[which][:, 1], shapes.own[which] @ estimates[which, N_TRIAL_EFFECTS:]
    effects = fit.solution.columns[which][:, :N_TRIAL_EFFECTS]
    left_m, told_m = (np.linalg.norm(orthogonal_part(each, effects)) for each in (bend_m + back_m, bend_m))
    assert left_m < 0.3 * told_m


def test_trace_errors_suggest_no_exponent_per_vine(fit):
    apart = vt.refit(fit, shared={"eversion_damping.n": "vine"})
    assert 2 * (apart.log_likelihood - fit.log_likelihood) < 15


def test_a_pressure_deviates_by_the_noise_of_its_gauge():
    """Give or take 0.1 kPa a sample, of as many samples as there are since the release."""
    pairs, truth = small_campaign(seed=21)
    draw, seen = np.random.default_rng(21), []
    for trial, track in pairs:
        gauge_Pa = trial.pressure_Pa + 100.0 * draw.standard_normal(track.time_s.size)
        seen.append((trial, as_track(track.time_s, track.lead_position_m, gauge_Pa)))
    for item, true in zip(prepare(seen)[0], truth, strict=True):
        samples = np.count_nonzero(item.time_s >= true["release_s"])
        assert item.gauge_error == pytest.approx(100.0 / np.sqrt(samples) / item.trial.pressure_Pa, rel=0.4)
