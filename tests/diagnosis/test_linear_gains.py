"""Predicted gains of effects, compared with regressions."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vinetrack.diagnosis import score_test
from vinetrack.inference.mixed_effects import FitState


@pytest.mark.parametrize(("bound", "adapting"), [(math.nan, [0, 1]), (0.0, [0])])
def test_a_gain_is_that_of_regressions_in_which_parameters_at_a_bound_do_not_adapt(
    monkeypatch: pytest.MonkeyPatch, bound: float, adapting: list[int]
) -> None:
    draw = np.random.default_rng(5)
    n = 60
    columns = draw.standard_normal((n, 4))  # two parameters, the residual, one effect
    columns[:, 2] += 3 * columns[:, 1] + 0.5 * columns[:, 3]
    blocks = (columns.T @ columns)[None]
    monkeypatch.setattr(
        score_test, "products_without_trial_effects", lambda _fit, _products, state: blocks / state.variance[0]
    )
    problem = SimpleNamespace(
        index=np.array([[0, 1]]),
        places=np.array([[0, 1]]),
        prior_mean=np.zeros(2),
        prior_precision=np.zeros(2),
        free=np.ones(2, bool),
        points=np.array([float(n)]),
    )
    state = FitState(np.zeros(2), np.zeros((1, 4)), (1e-5, 1e-5), 0.0, np.ones(1))
    fit: Any = SimpleNamespace(
        solution=SimpleNamespace(state=state, problem=problem),
        numbers=[SimpleNamespace(bound=math.nan), SimpleNamespace(bound=bound)],
    )
    products: Any = SimpleNamespace(
        n_keys=2, n_shapes=1, n_tested=1, parts=[np.array([0])], tested_indices=np.array([[0]])
    )
    gain, size = score_test.linear_gains(fit, products, 0.0)

    def squares(of: list[int]) -> tuple[float, float]:
        found = np.linalg.lstsq(columns[:, of], columns[:, 2], rcond=None)
        return float(found[1][0]), float(found[0][-1])

    without, (with_effect, expected_size) = squares(adapting)[0], squares([*adapting, 3])
    assert gain[0] == pytest.approx(n * math.log(without / with_effect), rel=1e-6)
    assert size[0] == pytest.approx(expected_size, rel=1e-6)
