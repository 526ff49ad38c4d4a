"""A growth angle counted from the level is a fault of the measurement, or not testable where nothing weighs enough."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from grown import Pairs, grown, pairs_of

import vinetrack as vt
from vinetrack.diagnosis.result import NOT_TESTABLE, Diagnosis
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory.tracks import Vine, campaign

RIVALS = ("growth_angle", "payload_friction", "pressure_gauge", "leak")


def filmed(vine: Vine, pressures_kPa: tuple[float, ...], payload_g: float, stated_deg: float, true_deg: float) -> Pairs:
    """Three trials a pressure of a vine that grew in one direction and is stated in another."""
    trials = [
        replace(trial, growth_angle_rad=math.radians(true_deg)) for trial in campaign(vine, pressures_kPa, 3, payload_g)
    ]
    pairs = pairs_of(grown(with_names(trials), 61))
    return [(replace(trial, growth_angle_rad=math.radians(stated_deg)), track) for trial, track in pairs]


def asked(pairs: Pairs) -> Diagnosis:
    return vt.diagnose(pairs, candidates=RIVALS, ladder=False, advice=False)


@pytest.mark.parametrize(("stated_deg", "true_deg"), [(90, 0), (0, 90)], ids=["level for down", "blank for level"])
def test_a_loaded_vine_tells_that_its_angle_is_wrong(stated_deg: float, true_deg: float) -> None:
    told = asked(filmed(Vine(24, 200, 280), (14, 28, 41), 35.6, stated_deg, true_deg))
    assert (told.verdict, told.answer_set, told.effects) == ("artefact", ("growth_angle",), ())
    (slip,) = (number for row in told.ranking if row.effect == "growth_angle" for number in row.numbers)
    assert abs(slip.value - 1) < 4 * slip.sigma < 0.4


def test_a_right_angle_is_not_doubted() -> None:
    told = asked(filmed(Vine(24, 200, 280), (14, 28, 41), 35.6, 0, 0))
    assert told.verdict == "adequate"
    (row,) = (row for row in told.ranking if row.effect == "growth_angle")
    assert row.largest["growth_angle.f"] < 0.5


def test_a_bare_vine_of_light_film_cannot_tell() -> None:
    told = asked(filmed(Vine(12, 100, 140), (24, 30, 38, 48), 0, 90, 0))
    assert told.verdict == "adequate"
    (row,) = (row for row in told.ranking if row.effect == "growth_angle")
    assert row.status == NOT_TESTABLE
