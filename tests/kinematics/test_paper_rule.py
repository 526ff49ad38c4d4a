"""The paper's literal rule against a search by brute force, and the misfires it is known for."""

from __future__ import annotations

import numpy as np
import pytest
from vine_truth import ar1, make_track

from vinetrack.kinematics.steady import paper_window


def longest_by_brute_force(velocity: np.ndarray) -> int:
    """Length of the longest run of at least three with sample deviation below 3 % of the mean; 0 for none."""
    for length in range(velocity.size, 2, -1):
        for start in range(velocity.size - length + 1):
            run = velocity[start : start + length]
            if np.std(run, ddof=1) < 0.03 * abs(np.mean(run)):
                return length
    return 0


@pytest.mark.parametrize("seed", range(1000, 1040))
def test_the_run_is_the_longest_there_is(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 70))
    time_s = np.arange(n) / 1000
    speed = np.where(np.arange(n) < rng.integers(0, n), rng.uniform(0, 1), 1.0)
    y = np.cumsum(speed) / 1000 + rng.choice([1e-6, 1e-5, 5e-5]) * rng.standard_normal(n)
    window = paper_window(make_track(time_s, y), travel_ratio=2)
    velocity = (y[2:] - y[:-2]) / 0.002
    assert window.n_points == longest_by_brute_force(velocity)
    assert window.accepted == (window.n_points > 0)
    if window.accepted:
        inside = (time_s[1:-1] >= window.from_s - 1e-9) & (time_s[1:-1] <= window.to_s + 1e-9)
        assert window.x_ss_m_s == pytest.approx(2 * velocity[inside].mean())
        assert window.cv == pytest.approx(np.std(velocity[inside], ddof=1) / abs(velocity[inside].mean()))


def test_constant_speed_is_one_run_in_tail_speed():
    time_s = np.arange(50) / 1000
    window = paper_window(make_track(time_s, 0.4 * time_s), travel_ratio=2)
    assert window.n_points == 48
    assert window.x_ss_m_s == pytest.approx(0.8)
    assert (window.from_s, window.to_s) == (time_s[1], time_s[-2])


def test_exact_stillness_has_no_coefficient_of_variation():
    assert not paper_window(make_track(np.arange(50) / 1000, np.zeros(50)), travel_ratio=2).accepted


def test_steady_acceleration_passes_for_steady_speed():
    time_s = np.arange(200) / 1000
    window = paper_window(make_track(time_s, 0.5 * 9.81 * time_s**2), travel_ratio=1)
    assert window.accepted
    assert window.drift > 0.05


def test_still_frames_pass_for_steady_speed_by_chance():
    found = 0
    for seed in range(1000, 1040):
        y = ar1(400, 1e-4, 0.0, np.random.default_rng(seed))
        found += paper_window(make_track(np.arange(400) / 1069, y), travel_ratio=2).accepted
    assert found > 0


def test_too_few_points_are_refused_in_words():
    window = paper_window(make_track(np.arange(4) / 1000, np.arange(4.0)), travel_ratio=2)
    assert not window.accepted
    assert window.reason == "4 points are too few for 3 central differences"
