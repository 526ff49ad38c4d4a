"""Equal shares of the false alarms: thresholds of candidates that are tried in one shape, or in many."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from vinetrack.diagnosis import score_test as module
from vinetrack.diagnosis.score_test import family_test

SIZES = (1,) * 12 + (30, 6)
NAMES = [f"effect_{k}" for k, size in enumerate(SIZES) for _ in range(size)]
SIGNS = [(-1, 0, 1)[k % 3] for k, size in enumerate(SIZES) for _ in range(size)]


def alike_within() -> np.ndarray:
    """Correlations of shapes, those of one effect alike."""
    draw = np.random.default_rng(20620)
    own = draw.standard_normal((len(SIZES), 40))[np.repeat(range(len(SIZES)), SIZES)]
    shapes = own + draw.standard_normal((len(NAMES), 40))
    shapes /= np.linalg.norm(shapes, axis=1)[:, None]
    return np.asarray(shapes @ shapes.T)


@pytest.mark.parametrize(("sign", "tails"), [(0, 2.0), (1, 1.0)])
@pytest.mark.parametrize("level", [0.02, 1e-4])
def test_the_threshold_of_one_candidate_is_the_quantile_of_the_normal(sign: int, tails: float, level: float) -> None:
    family = family_test(np.eye(1), [sign], ["only"], level)
    assert family.threshold("only") == pytest.approx(norm.isf(level / tails), abs=0.01)


def test_independent_candidates_share_as_sidak_says() -> None:
    family = family_test(np.eye(20), [0] * 20, [str(k) for k in range(20)], 3e-3)
    assert family.candidate_level == pytest.approx(1 - (1 - 3e-3) ** (1 / 20), rel=0.02)


@pytest.mark.parametrize("shapes", [2, 30])
def test_shapes_that_are_the_same_curve_count_once(shapes: int) -> None:
    family = family_test(np.ones((shapes, shapes)), [0] * shapes, ["only"] * shapes, 3e-3)
    assert family.threshold("only") == pytest.approx(norm.isf(3e-3 / 2), abs=0.02)


def test_any_candidate_exceeds_its_threshold_at_the_level_and_each_at_its_share() -> None:
    """Against two million draws from another generator."""
    cosines, level = alike_within(), 3e-3
    family = family_test(cosines, SIGNS, NAMES, level)
    limits, signs = np.array([family.threshold(name) for name in NAMES]), np.array(SIGNS)
    draw, root = np.random.default_rng(20621), np.linalg.cholesky(cosines + 1e-9 * np.eye(len(NAMES)))
    alarms, total, by_many = 0, 0, 0
    for _ in range(40):
        z = draw.standard_normal((50_000, len(NAMES))) @ root.T
        beyond = np.where(signs == 0, np.abs(z), z * signs) > limits
        alarms, total = alarms + int(beyond.any(axis=1).sum()), total + len(z)
        by_many += int(beyond[:, [name == "effect_12" for name in NAMES]].any(axis=1).sum())
    assert alarms / total == pytest.approx(level, rel=0.05)
    assert by_many / total == pytest.approx(family.candidate_level, rel=0.25)
    assert family.threshold("effect_12") > family.threshold("effect_1") + 0.4


def test_a_candidate_of_many_shapes_hardly_lifts_the_threshold_of_the_others() -> None:
    cosines = alike_within()
    few = [k for k, name in enumerate(NAMES) if name != "effect_12"]
    without = family_test(cosines[np.ix_(few, few)], [SIGNS[k] for k in few], [NAMES[k] for k in few], 3e-3)
    family = family_test(cosines, SIGNS, NAMES, 3e-3)
    assert 0 < family.threshold("effect_1") - without.threshold("effect_1") < 0.05


def test_thresholds_do_not_hang_on_the_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    for level in (3e-3, 1e-4):
        limits = []
        for seed in range(5):
            monkeypatch.setattr(module, "SEED", seed)
            family = family_test(alike_within(), SIGNS, NAMES, level)
            limits.append([family.threshold(name) for name in dict.fromkeys(NAMES)])
        assert np.std(limits, axis=0).max() < 0.01


def test_shapes_that_the_data_say_nothing_of_take_no_share() -> None:
    cosines = np.eye(3)
    cosines[2, 2] = 0.0
    family = family_test(cosines, [0, 0, 0], ["a", "b", "silent"], 3e-3)
    assert family.threshold("a") == pytest.approx(norm.isf(3e-3 / 4), abs=0.01)
