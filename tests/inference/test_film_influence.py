"""The predicted influence of the film mass on the numbers of a fit agrees with refits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import small_campaign

import vinetrack as vt
from vinetrack.core.tables import write_json
from vinetrack.inference.fit_summary import MATTERS, FitSummary, film_influence, film_messages, summary_of
from vinetrack.inference.robust_covariance import FILM_ERROR
from vinetrack.results.folder_layout import read_json


@pytest.fixture(scope="module")
def pairs():
    return small_campaign(11, damping=5e-3, pressure=1e-3)[0]


@pytest.fixture(scope="module")
def fit(pairs):
    return vt.fit(vt.base_model(), pairs, profile=False)


def refitted(pairs, vine):
    """The fit with the film of one vine heavier by its error."""
    heavier = [
        (replace(trial, film_density_kg_m3=trial.film_density_kg_m3 * (1 + FILM_ERROR * (trial.vine == vine))), track)
        for trial, track in pairs
    ]
    return vt.fit(vt.base_model(), heavier, profile=False)


def test_film_influence_agrees_with_refits_with_heavier_film(pairs, fit):
    squares = np.zeros(len(fit.numbers))
    for vine in dict.fromkeys(trial.vine for trial, _ in pairs):
        other = refitted(pairs, vine)
        squares += np.square([b.value - a.value for a, b in zip(fit.numbers, other.numbers, strict=True)])
    keys = [number.key for number in fit.numbers]
    moved, by_refit = film_influence(fit), np.sqrt(squares)
    of_law = [k for k, key in enumerate(keys) if key.startswith("eversion_damping")]
    assert moved[of_law] == pytest.approx(by_refit[of_law], rel=0.2)
    n = keys.index("eversion_damping.n")
    assert moved[n] > fit.numbers[n].sigma


def test_a_fitted_film_mass_has_no_influence(fit):
    with_film = vt.refit(fit, fit.model + "film_mass")
    assert not film_influence(with_film).any()
    assert summary_of(with_film).moved_by_film.shape == (len(with_film.numbers),)
    assert not any("mass of the film" in message for message in summary_of(with_film).messages)


def test_a_summary_contains_the_film_message_once(fit, tmp_path):
    summary = summary_of(fit)
    (said,) = [message for message in summary.messages if "mass of the film" in message]
    moved = dict(zip([number.key for number in fit.numbers], summary.moved_by_film, strict=True))
    assert f"n by {moved['eversion_damping.n']:.2g}" in said
    assert "thickness_um" in said
    write_json(tmp_path / "fit.json", summary.to_json())
    again = FitSummary.from_json(read_json(tmp_path / "fit.json"))
    assert again.moved_by_film == pytest.approx(summary.moved_by_film)
    assert FitSummary.from_json({"model": ["gravity"]}).moved_by_film.size == 0


def test_an_influence_below_the_errors_gives_no_message(fit):
    sigma = np.array([number.sigma for number in fit.numbers])
    assert film_messages(fit.numbers, 0.99 * MATTERS * sigma) == ()
    first = np.where(np.arange(sigma.size) == 0, 1.01 * MATTERS * sigma, 0.0)
    (said,) = film_messages(fit.numbers, first)
    assert fit.numbers[0].title in said
    assert fit.numbers[1].title not in said
    (every,) = film_messages([*fit.numbers, *fit.numbers], np.tile(2 * sigma, 2))
    assert f"and {2 * sigma.size - 4} more" in every
