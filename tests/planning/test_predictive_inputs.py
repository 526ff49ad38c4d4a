"""Predictive inputs: which source a number comes from, and that draws have the spread and covariance that are said."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.experiment.planned import planned_trial
from vinetrack.planning.predictive_inputs import (
    PRESSURE,
    YIELD,
    Size,
    StatedValues,
    fit_numbers,
    predictive_inputs,
    read_sizes,
)

B, N = "eversion_damping.B", "eversion_damping.n"
VINE = "24mm-200um-280mm"


def trial(**values: object) -> Trial:
    known = {"diameter_mm": 25, "thickness_um": 100, "length_mm": 400, "pressure_kPa": 62, **values}
    return planned_trial({name: str(value) for name, value in known.items()}).trials[0]


def number(key: str, vine: str, value: float, sigma: float, half: float = 1.959964) -> dict[str, Any]:
    return {
        "parameter": key,
        "vine": vine,
        "symbol": key.split(".")[1],
        "unit": "",
        "value": value,
        "sigma": sigma,
        "low_95": value - half * sigma,
        "high_95": value + half * sigma,
        "interval": "linear",
        "bound": None,
    }


def fitted(half: float = 1.959964, **changes: Any) -> dict[str, Any]:
    """A fit.json by hand: B 6 ± 0.06, n 0.4 ± 0.01, correlation −0.8; P_y 3.2 ± 0.1 kPa by itself."""
    entry = {
        "model": ["pressure_drive", "gravity", "eversion_damping", "yield_pressure"],
        "refused": None,
        "numbers": [
            {**number(B, VINE, 6.0, 0.06), "low_95": 6 * math.exp(-half * 0.01), "high_95": 6 * math.exp(half * 0.01)},
            number(N, "", 0.4, 0.01, half),
            number("yield_pressure.P_y", VINE, 3200.0, 100.0, half),
        ],
        "covariance": [[0.0036, -0.00048, 0.0], [-0.00048, 1e-4, 0.0], [0.0, 0.0, 1e4]],
        "spreads": {"pressure": {"value": 0.02, "estimated": True}, "B": {"value": 0.05, "estimated": True}},
        "trials": {"a": {}, "b": {}},
        **changes,
    }
    return json.loads(json.dumps(entry))


def vine_of_the_fit(**values: object) -> Trial:
    return trial(**{"diameter_mm": 24, "thickness_um": 200, "length_mm": 280, "pressure_kPa": 28, **values})


def test_what_a_person_says_goes_before_the_fit_and_the_fit_before_the_guess() -> None:
    numbers = fit_numbers(fitted(), "results/a")
    assert predictive_inputs(vine_of_the_fit(), StatedValues(B=5.0), numbers).medians[B] == 5.0
    assert predictive_inputs(vine_of_the_fit(), None, numbers).medians[B] == pytest.approx(6.0)
    assert predictive_inputs(trial()).medians[B] == pytest.approx(3.32, abs=0.005)


def test_a_yield_pressure_that_nobody_gives_is_guessed_with_nine_of_ten_within_a_factor_three() -> None:
    draws = predictive_inputs(trial()).draw(40_000, seed=1)[YIELD]
    assert np.quantile(draws, (0.05, 0.5, 0.95)) == pytest.approx([1e3, 3e3, 9e3], rel=0.03)


def test_draws_from_a_fit_have_its_covariance() -> None:
    inputs = predictive_inputs(vine_of_the_fit(), StatedValues(spreads=(0.0, 0.0)), fit_numbers(fitted(), "a"))
    draws = inputs.draw(40_000, seed=3)
    found = np.cov([np.log(draws[B]), draws[N], draws[YIELD] / 1e5])
    # ln B has 0.06/6 = 1 %, and n the correlation −0.00048/(0.06 × 0.01) = −0.8 with it.
    expected = [[1e-4, -0.8e-4, 0.0], [-0.8e-4, 1e-4, 0.0], [0.0, 0.0, 1e-6]]
    assert found == pytest.approx(np.array(expected), abs=3e-6)


def test_spreads_from_trial_to_trial_are_those_of_the_fit_with_the_doubt_of_few_trials() -> None:
    """Scale σ of Student's t with 13 trials less 3 numbers: its standard deviation is σ √(10/8)."""
    content = fitted(trials={str(k): {} for k in range(13)})
    content["spreads"]["B"]["estimated"] = False
    inputs = predictive_inputs(vine_of_the_fit(), None, fit_numbers(content, "a"))
    draws = inputs.draw(100_000, 1, only=["P from trial to trial", "B from trial to trial"])
    assert np.std(draws[PRESSURE]) == pytest.approx(0.02 * 28e3 * np.sqrt(10 / 8), rel=0.02)
    assert np.std(np.log(draws[B])) == pytest.approx(0.05, rel=0.02)


def test_a_vine_that_was_not_fitted_carries_b_over_with_the_error_of_the_guess() -> None:
    inputs = predictive_inputs(trial(diameter_mm=24, thickness_um=100, length_mm=280), None, fit_numbers(fitted(), "a"))
    assert inputs.medians[B] == pytest.approx(3.0)  # half the wall, half of B
    assert any("carried over from 24mm-200um-280mm" in words for words in inputs.notes)
    assert {"guess of B", "t against D", "guess of P_y"} <= {one.name for one in inputs.uncertainties}


def test_a_sheet_that_contradicts_the_fitted_yield_pressure_is_believed() -> None:
    numbers = fit_numbers(fitted(), "a")
    assert predictive_inputs(vine_of_the_fit(yield_pressure_kPa=3), None, numbers).medians[YIELD] == 3200.0
    assert predictive_inputs(vine_of_the_fit(yield_pressure_kPa=8), None, numbers).medians[YIELD] == 8000.0


def test_the_same_seed_gives_the_same_draws_and_vines_share_what_they_have_in_common() -> None:
    one, other = predictive_inputs(trial()), predictive_inputs(trial(length_mm=300))
    assert np.array_equal(one.draw(50, 7)[B], one.draw(50, 7)[B])
    assert np.array_equal(one.draw(50, 7)[N], other.draw(50, 7)[N])
    assert not np.array_equal(one.draw(50, 7, ["guess of B"])[B], other.draw(50, 7, ["guess of B"])[B])


def test_a_fit_from_python_is_believed_as_its_file_is() -> None:
    from lsoda_vine import small_campaign

    found = vt.fit(vt.base_model(), small_campaign(seed=5)[0])
    inputs = predictive_inputs(vine_of_the_fit(), None, found)
    n = found["n"]
    draws = inputs.draw(20_000, 1)
    assert (np.mean(draws[N]), np.std(draws[N])) == pytest.approx((n.value, (n.high - n.low) / 3.92), rel=0.05)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("air_drag", {}),
        ("air_drag=0.8", {"air_drag.C_D": Size(0.8, 0.8)}),
        ("reservoir_depletion=1.4:1", {"reservoir_depletion.gamma": Size(1.0, 1.4)}),
        ("supply_refill=0.1, 1:1.4", {"supply_refill.tau": Size(0.1, 0.1), "supply_refill.gamma": Size(1.0, 1.4)}),
    ],
)
def test_sizes_of_effects_are_numbers_or_ranges(text: str, sizes: dict[str, Size]) -> None:
    assert read_sizes(text)[1] == sizes
