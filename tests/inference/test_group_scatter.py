"""Errors clustered by specimen or day where the sheet states enough of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from lsoda_vine import small_campaign

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.inference.robust_covariance import coarsest_groups, group_scatter, robust_covariance


def trials(specimens: int, days: int = 0, count: int = 24) -> list[Trial]:
    return [
        Trial(
            name=f"t{i}", vine="v", specimen=f"s{i % specimens}" if specimens else "", day=f"{i % days}" if days else ""
        )
        for i in range(count)
    ]


def test_the_coarsest_sufficient_groups_are_used() -> None:
    assert len(set(coarsest_groups(trials(8, days=12)))) == 8
    assert len(set(coarsest_groups(trials(3, days=12)))) == 12
    assert len(set(coarsest_groups(trials(0)))) == 24
    assert len(set(coarsest_groups(trials(2, days=3)))) == 24


def test_errors_shared_by_a_group_enter_the_covariance() -> None:
    generator = np.random.default_rng(7)
    groups = [f"s{i % 12}" for i in range(48)]
    seen = []
    for _ in range(400):
        shared = dict(zip(sorted(set(groups)), generator.standard_normal(12), strict=True))
        single = np.array([[shared[group]] for group in groups]) + 0.1 * generator.standard_normal((48, 1))
        seen.append(group_scatter(single - single.mean(axis=0), groups, 1)[0, 0])
    # 12 groups of 4 with a shared error of variance 1 and single ones of 0.01: 12 · 16 + 48 · 0.01.
    assert abs(np.mean(seen) / 192.5 - 1) < 0.05


def test_groups_of_one_are_single_trials() -> None:
    single = np.random.default_rng(1).standard_normal((10, 2))
    single -= single.mean(axis=0)
    names = [str(i) for i in range(10)]
    np.testing.assert_allclose(group_scatter(single, names, 3), single.T @ single * 10 / 7)


def test_correlated_errors_of_a_day_enlarge_the_standard_errors() -> None:
    """The same tracks, once with their days told: eight days of two trials, whose bends are those of the day."""
    pairs, _ = small_campaign(20710, damping=1e-3, pressure=1e-3)
    bends_m = np.repeat(4e-4 * np.random.default_rng(20710).standard_normal(8), 2)
    bent = []
    for (trial, track), bend in zip(pairs, bends_m, strict=True):
        part = (track.lead_position_m - track.lead_position_m[0]) / np.ptp(track.lead_position_m)
        bent.append((trial, replace(track, lead_position_m=track.lead_position_m + bend * np.sin(6 * part))))
    found = vt.fit(vt.base_model(), bent, profile=False)
    alone = np.diag(robust_covariance(found.predictor, found.solution)[1])
    found.predictor.data = [
        replace(data, trial=replace(data.trial, day=f"{k // 2}")) for k, data in enumerate(found.predictor.data)
    ]
    by_day = np.diag(robust_covariance(found.predictor, found.solution)[1])
    assert np.all(by_day >= alone)
    assert np.max(by_day / alone) > 1.2
