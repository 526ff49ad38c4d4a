"""Laws of force that no catalogue has, as effects: their files do what the law says, and the right one is proposed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from grown import grown, hidden_force, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.missing_force import SeenLaw
from vinetrack.diagnosis.propose import effect_text, propose
from vinetrack.effects import own_effects

LAWS = [
    SeenLaw(Law("constant"), (-0.2,), 0.9, "a constant force"),
    SeenLaw(Law("position", largest=0.5), (-0.2,), 0.9, "a force in proportion to x"),
    SeenLaw(Law("speed", largest=9.0, by_area=3e-4), (-0.2,), 0.9, "a force in proportion to ẋ"),
    SeenLaw(Law("speed_squared", largest=81.0), (0.2,), 0.9, "a force in proportion to ẋ²"),
    SeenLaw(Law("pressure", largest=3e4), (-0.2,), 0.9, "a force in proportion to P"),
    SeenLaw(Law("time", largest=0.3), (-0.2,), 0.9, "a force that grows with time"),
    SeenLaw(Law("inverse_speed", scale=2.5, largest=1.7), (-0.2,), 0.9, "a force that falls as 1/ẋ"),
    SeenLaw(Law("falling_with_speed", shapes=1, scale=1.5), (-0.2,), 0.9, "a force that falls with speed"),
    SeenLaw(Law("fading_in_time", shapes=1, scale=0.04), (-0.2,), 0.9, "a force that fades in time"),
    SeenLaw(Law("fading_along", shapes=1, scale=0.07), (-0.2,), 0.9, "a force that fades along the growth"),
    SeenLaw(Law("patch", shapes=2, low=0.08, high=0.11), (-0.2,), 0.9, "a force between 80 and 110 mm"),
    SeenLaw(Law("position_squared", largest=0.25), (-0.2,), 0.9, "a force in proportion to x²"),
    SeenLaw(Law("beyond_a_place", shapes=1, scale=0.06, largest=0.1), (-0.2,), 0.9, "a force beyond 60 mm"),
    SeenLaw(Law("speed_cubed", largest=729.0), (-0.2,), 0.9, "a force in proportion to ẋ³"),
    SeenLaw(Law("beyond_a_speed", shapes=1, scale=1.2, largest=7.8), (-0.2,), 0.9, "a force beyond 1.2 m/s"),
    SeenLaw(Law("squared_beyond_a_speed", shapes=1, scale=1.2, largest=61.0), (-0.2,), 0.9, "a square beyond 1.2 m/s"),
    SeenLaw(Law("position", times="speed", largest=4.0), (-0.2,), 0.9, "a force in proportion to x ẋ"),
    SeenLaw(Law("patch", shapes=2, low=0.08, high=0.11, times="pressure", largest=3e4), (-0.2,), 0.9, "a patch by P"),
    SeenLaw(Law("falling_with_speed", shapes=1, scale=1.5, times="position"), (-0.2,), 0.9, "falling, by x"),
    SeenLaw(Law("speed_squared", times="pressure", largest=2e6, by_area=3e-4), (-0.2,), 0.9, "ẋ² by P"),
    SeenLaw(Law("periodic", columns=2, shapes=1, scale=0.03), (0.1, -0.2), 0.9, "a force every 30 mm"),
]


@pytest.mark.parametrize("seen", LAWS, ids=lambda seen: seen.law.name)
def test_the_file_of_a_law_does_what_the_law_says(seen: SeenLaw, tmp_path: Path) -> None:
    path = tmp_path / f"proposed_{seen.law.name}.py"
    path.write_text(effect_text(seen, "From 24 trials of a bench."), encoding="utf-8")
    # Its worked number comes from the law, its function from the formula: reading it holds one against the other.
    effect = own_effects([path])[path.stem]
    assert effect.worked[0].expected != 0
    assert "From 24 trials of a bench." in effect.text
    assert effect.formula.startswith("tail force")


@pytest.mark.parametrize(
    ("law", "unit"),
    [
        (Law("position", times="speed"), "N·s/m²"),
        (Law("speed_squared", times="pressure"), "N·s²/(m²·Pa)"),
        (Law("falling_with_speed", shapes=1, scale=1.5, times="position"), "N/m"),
        (Law("speed_cubed"), "N·s³/m³"),
    ],
)
def test_sizes_have_the_unit_that_makes_a_force(law: Law, unit: str) -> None:
    assert f'"{unit}"' in effect_text(SeenLaw(law, (-0.2,), 0.9, "a law"))


def test_a_force_that_grows_with_time_is_proposed_and_mends_left_out_conditions(tmp_path: Path) -> None:
    pairs = hidden_force(sheet((4,)), 101, "growing", -0.3, tmp_path)
    proposal = propose(vt.base_model(), pairs, lambda _: None)
    best = proposal.tied[0]
    assert best.effect.name == "proposed_time"
    rate = next(number for number in best.ratio.fit.numbers if number.key == "proposed_time.r")
    assert rate.low < -0.3 / 0.2 < rate.high
    assert best.rms_left_out_m < proposal.rms_left_out_m
    assert any("Proposed: a force that grows in proportion to time" in line for line in proposal.sentences())


def test_where_nothing_is_missing_nothing_is_proposed() -> None:
    proposal = propose(vt.base_model(), pairs_of(grown(sheet((4,)), 102)), lambda _: None)
    assert not proposal.tied
    assert "nothing is proposed" in proposal.sentences()[0]
    assert np.isfinite(proposal.rms_left_out_m)
