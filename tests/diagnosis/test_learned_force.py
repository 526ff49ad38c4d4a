"""A force learned as a smooth function: its algebra against closed forms, and a hidden force with its variables."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from grown import effect_file, grown, pairs_of, sheet
from scipy.stats import multivariate_normal

import vinetrack as vt
from vinetrack.diagnosis.force_surface import AMPLITUDES, KEPT, LENGTHS, Domain, Surface, covariance_root, curves
from vinetrack.diagnosis.learned_force import LEARNED_COLUMNS, _Posterior, _weighed
from vinetrack.diagnosis.learned_variables import following
from vinetrack.diagnosis.missing_force import MissingForce, missing_force

GROWTH = Domain(("growth",), (0.0,), (0.25,), (12,), (math.inf,))
BOTH = Domain(("growth", "speed"), (0.0, 0.0), (0.25, 8.0), (12, 8), (math.inf, math.inf))


def test_the_process_has_the_covariance_it_says() -> None:
    directions, variances = covariance_root(12, 0.4)
    covariance = (directions * variances) @ directions.T
    assert np.diag(covariance) == pytest.approx(np.ones(12))
    # First and last splines lie at the ends: one whole apart.
    assert covariance[0, -1] == pytest.approx(math.exp(-0.5 / 0.4**2))


@pytest.mark.parametrize("domain", [GROWTH, BOTH])
def test_splines_add_up_to_one_and_are_constant_beyond_what_was_visited(domain: Domain) -> None:
    inside = [np.linspace(low, high, 7) for low, high in zip(domain.low, domain.high, strict=True)]
    assert domain.basis(inside).sum(axis=1) == pytest.approx(np.ones(7))
    beyond = [np.array([high, 2 * high]) for high in domain.high]
    at_end, further = domain.basis(beyond)
    assert at_end == pytest.approx(further)


def test_speeds_are_taken_as_logarithms_beyond_what_is_usual() -> None:
    (parts,) = replace(GROWTH, usual=(0.01,)).parts([np.array([0.0, 0.01 * (math.sqrt(26) - 1), 0.25])])
    assert parts == pytest.approx([0.0, 0.5, 1.0])


def test_a_surface_follows_the_function_whose_values_its_coefficients_are() -> None:
    """A function linear in both variables is held exactly by its values at the places of the splines."""
    u, v = (np.linspace(0, 1, count) for count in (101, 101))
    places = [np.linalg.lstsq(curves(u, count), u, rcond=None)[0] for count in BOTH.counts]
    coefficients = (2 * places[0][:, None] - 3 * places[1]).ravel()
    motion = SimpleNamespace(lead_position_m=0.25 * u, tail_velocity_m_s=8.0 * v[::-1])
    force = Surface(BOTH, coefficients[:, None]).along(motion)[:, 0]  # type: ignore[arg-type]
    assert force == pytest.approx(2 * u - 3 * v[::-1])


def test_a_variable_that_follows_from_those_named_is_told_and_one_that_varies_freely_is_not() -> None:
    """Trials that grow evenly, each at its own speed: time is growth over speed; speed is no function of growth."""
    duration_s = np.linspace(0, 1, 80)
    motions = [
        SimpleNamespace(
            time_s=(0.25 / speed) * duration_s,
            counts_until_s=math.inf,
            lead_position_m=0.25 * duration_s,
            tail_velocity_m_s=np.full(80, speed),
        )
        for speed in (2.0, 3.0, 4.5, 6.0, 7.5)
    ]
    time, speed = (replace(GROWTH, variables=(name,), high=(high,)) for name, high in (("time", 0.125), ("speed", 8.0)))
    assert following(BOTH, [GROWTH, time, speed], motions) == ["time"]  # type: ignore[arg-type]
    assert following(GROWTH, [GROWTH, speed], motions) == []  # type: ignore[arg-type]


def test_the_marginal_likelihood_is_that_of_the_normal_distribution() -> None:
    draw = np.random.default_rng(3)
    design = curves(draw.uniform(0, 1, 60), 12)
    positions = design @ draw.standard_normal(12) + draw.standard_normal(60)
    posterior = _Posterior(design.T @ design, design.T @ positions, float(positions @ positions), 0.0, 0.0)
    logs = []
    for length in LENGTHS:
        directions, variances = covariance_root(12, length)
        variances = np.where(variances > KEPT * variances.max(), variances, 0.0)
        unit = design @ (directions * variances) @ directions.T @ design.T
        logs += [multivariate_normal(cov=np.eye(60) + a**2 * unit).logpdf(positions) for a in 2.0 * AMPLITUDES]
    constant = -30 * math.log(2 * math.pi)
    chosen = _weighed(GROWTH, posterior, 1.0, 2.0)
    assert chosen.log_evidence + constant == pytest.approx(float(np.log(np.mean(np.exp(logs)))), abs=1e-6)
    assert chosen.lengths == (LENGTHS[int(np.argmax(logs)) // AMPLITUDES.size],)
    assert np.all(np.linalg.eigvalsh(chosen.covariance) > -1e-12)


def test_noise_that_is_wider_than_thought_widens_the_band() -> None:
    design = curves(np.linspace(0, 1, 60), 12)
    posterior = _Posterior(design.T @ design, design.T @ np.sin(np.linspace(0, 6, 60)), 30.0, 0.0, 0.0)
    at = [np.array([0.1])]
    (_, narrow), (_, wide) = (_weighed(GROWTH, posterior, inflation, 2.0).force(at) for inflation in (1.0, 4.0))
    assert narrow[0] < wide[0]


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> MissingForce:
    """Vines that felt waves along the growth which become shorter."""
    hidden = effect_file(
        tmp_path_factory.mktemp("waves"), "hidden", ["np.sin(2 * np.pi * (s.lead_position / 0.12) ** 1.5)"]
    )
    values = {"hidden.a": -0.3, "hidden.kind": 0.0}
    return missing_force(
        vt.fit(vt.base_model(), pairs_of(grown(sheet((4,)), 131, own=[hidden], values=values)), profile=False)
    )


def test_waves_along_the_growth_are_learned_with_their_variable_and_their_size(waves: MissingForce) -> None:
    learned = waves.learned
    assert learned is not None
    assert learned.variables == ("growth",)
    assert sum(learned.weights.values()) == pytest.approx(1.0)
    assert tuple(learned.table.columns) == LEARNED_COLUMNS
    grid = learned.table[(learned.table["condition"] == "") & (learned.table["trials"] > 0)]
    y = grid["lead_position_m"].to_numpy(float)
    middle = (y > np.quantile(y, 0.05)) & (y < np.quantile(y, 0.95))
    true_N = -0.3 * np.sin(2 * math.pi * (y / 0.12) ** 1.5)
    # A constant is taken over by the yield pressure.
    off = grid["force_N"].to_numpy(float) - true_N
    assert np.mean(np.abs(off - np.median(off))[middle] < 0.06) > 0.8
    assert np.isnan(grid["pressure_Pa"]).all()


def test_it_says_what_it_depends_on_and_goes_into_a_file(waves: MissingForce) -> None:
    content = json.loads(json.dumps(waves.to_json()))["learned"]
    assert content["variables"] == ["growth"]
    assert "is described by the growth" in content["sentence"]
    assert set(content["length_scales"]) == {"growth"}
    without = replace(waves, learned=None).to_json()
    assert without["learned"] is None


def test_where_nothing_is_missing_no_force_is_learned() -> None:
    fit = vt.fit(vt.base_model(), pairs_of(grown(sheet((4,)), 132)), profile=False)
    assert missing_force(fit).learned is None
