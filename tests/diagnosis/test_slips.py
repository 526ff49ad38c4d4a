"""A slip in the whole sheet is named as what it is, however large the error that it leaves."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt
from vinetrack.diagnosis.candidates import RANGE_SHARE_BESIDE_SLIP, is_plausible, slip_of
from vinetrack.effects import catalogue
from vinetrack.effects._catalogue import explanation

FLAT = 2 / math.pi - 1
FAULTS = ("area_scale", "film_mass", "length_scale", "pressure_gain", "time_base", "inlet_loss", "air_drag")
DIAMETER = catalogue()["area_scale"].parameters[0]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """A campaign with nothing missing."""
    folder = tmp_path_factory.mktemp("slips") / "e"
    write_experiment(campaign("clean", 909, (10, 14)), folder)
    fit = vt.fit(vt.base_model(), folder, profile=False)
    return list(fit.pairs)


@pytest.mark.parametrize(
    ("slip", "named", "size", "words"),
    [
        ({"diameter_m": math.pi / 2}, "area_scale", FLAT, "the width of the flattened tube was taken for its diameter"),
        ({"diameter_m": 0.5}, "area_scale", 1.0, "the radius was taken for the diameter"),
        ({"thickness_m": 2.0}, "film_mass", -0.5, "the film was measured folded"),
    ],
    ids=["flat", "radius", "folded"],
)
def test_a_slip_in_a_column_is_named(pairs, slip, named, size, words):
    slipped = [
        (replace(trial, **{name: factor * getattr(trial, name) for name, factor in slip.items()}), track)
        for trial, track in pairs
    ]
    said = vt.diagnose(slipped, candidates=FAULTS, ladder=False, advice=False)
    assert said.verdict in ("artefact", "ambiguous")
    assert named in said.answer_set
    (row,) = [row for row in said.rounds[0].ranking if row.effect == named]
    assert all(abs(number.value - size) < 3 * number.sigma + 0.02 for number in row.numbers)
    assert row.plausible
    assert words in said.explanation


def test_what_is_left_beside_a_slip_must_be_an_ordinary_error():
    _, high = DIAMETER.plausible
    inside, outside = (
        (1 + part * high) * (1 + FLAT) - 1 for part in (0.9 * RANGE_SHARE_BESIDE_SLIP, 1.2 * RANGE_SHARE_BESIDE_SLIP)
    )
    assert slip_of(DIAMETER, inside, 0.0) == DIAMETER.slips[0]
    assert is_plausible(DIAMETER, inside, 0.0)
    assert slip_of(DIAMETER, outside, 0.0) is None
    assert not is_plausible(DIAMETER, outside, 0.0)
    assert slip_of(DIAMETER, outside, 0.01) is not None


def test_an_ordinary_error_is_no_slip():
    """But film a fifth too light is polyethylene sooner than too thin: film is sold to within a tenth."""
    for name, part in (("area_scale", 1.0), ("length_scale", 1.0), ("time_base", 1.0), ("film_mass", 0.5)):
        parameter = catalogue()[name].parameters[0]
        assert parameter.slips
        assert all(slip_of(parameter, part * error, 0.01) is None for error in (*parameter.plausible, 0.0))


def test_slips_are_told_of_an_effect():
    assert any("the radius was taken for the diameter" in line for line in explanation(catalogue()["area_scale"]))
