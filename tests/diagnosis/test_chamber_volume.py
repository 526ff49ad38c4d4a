"""A chamber that is larger than stated is a depletion with a γ that no gas has, and nothing else."""

from __future__ import annotations

import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt

pytestmark = pytest.mark.slow

RIVALS = ("reservoir_depletion", "supply_refill", "area_scale", "film_mass", "tail_friction", "leak")


@pytest.mark.parametrize(
    ("row", "seed", "words"), [("chamber_larger", 914, "at least"), ("chamber_smaller", 902, "at most")]
)
def test_a_chamber_that_was_misread_is_a_depletion_and_its_volume_is_told(tmp_path, row, seed, words):
    known = campaign(row, seed, (10, 14), weighed=False)
    write_experiment(known, tmp_path / "e")
    said = vt.diagnose(vt.read_experiment(tmp_path / "e"), candidates=RIVALS, ladder=False, advice=False)
    assert said.effects == ("reservoir_depletion",)
    assert said.final_verdict == "adequate"
    (gamma,) = [number for number in said.parameters if number.key == "reservoir_depletion.gamma"]
    assert gamma.value < 1.0 if row == "chamber_larger" else gamma.value > 1.4
    assert f"the chamber is {words}" in said.explanation
    assert ("count the hoses too" in said.explanation) == (row == "chamber_larger")
