"""Laws of force outside the catalogue, as effects: their files reproduce the laws, and the right one is proposed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from grown import grown, hidden_force, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.missing_force import DetectedLaw
from vinetrack.diagnosis.propose import effect_text, propose
from vinetrack.effects import own_effects

LAWS = [
    DetectedLaw(Law("constant"), (-0.2,), 0.9, "a constant force"),
    DetectedLaw(Law("position", peak=0.5), (-0.2,), 0.9, "a force in proportion to x"),
    DetectedLaw(Law("speed", peak=9.0, reference_area_m2=3e-4), (-0.2,), 0.9, "a force in proportion to ẋ"),
    DetectedLaw(Law("speed_squared", peak=81.0), (0.2,), 0.9, "a force in proportion to ẋ²"),
    DetectedLaw(Law("pressure", peak=3e4), (-0.2,), 0.9, "a force in proportion to P"),
    DetectedLaw(Law("time", peak=0.3), (-0.2,), 0.9, "a force that grows with time"),
    DetectedLaw(Law("inverse_speed", scale=2.5, peak=1.7), (-0.2,), 0.9, "a force that falls as 1/ẋ"),
    DetectedLaw(Law("falling_with_speed", n_shapes=1, scale=1.5), (-0.2,), 0.9, "a force that falls with speed"),
    DetectedLaw(Law("fading_in_time", n_shapes=1, scale=0.04), (-0.2,), 0.9, "a force that fades in time"),
    DetectedLaw(Law("fading_along", n_shapes=1, scale=0.07), (-0.2,), 0.9, "a force that fades along the growth"),
    DetectedLaw(Law("patch", n_shapes=2, low=0.08, high=0.11), (-0.2,), 0.9, "a force between 80 and 110 mm"),
    DetectedLaw(Law("position_squared", peak=0.25), (-0.2,), 0.9, "a force in proportion to x²"),
    DetectedLaw(Law("beyond_a_place", n_shapes=1, scale=0.06, peak=0.1), (-0.2,), 0.9, "a force beyond 60 mm"),
    DetectedLaw(Law("speed_cubed", peak=729.0), (-0.2,), 0.9, "a force in proportion to ẋ³"),
    DetectedLaw(Law("beyond_a_speed", n_shapes=1, scale=1.2, peak=7.8), (-0.2,), 0.9, "a force beyond 1.2 m/s"),
    DetectedLaw(
        Law("squared_beyond_a_speed", n_shapes=1, scale=1.2, peak=61.0), (-0.2,), 0.9, "a square beyond 1.2 m/s"
    ),
    DetectedLaw(Law("position", factor="speed", peak=4.0), (-0.2,), 0.9, "a force in proportion to x ẋ"),
    DetectedLaw(
        Law("patch", n_shapes=2, low=0.08, high=0.11, factor="pressure", peak=3e4), (-0.2,), 0.9, "a patch by P"
    ),
    DetectedLaw(Law("falling_with_speed", n_shapes=1, scale=1.5, factor="position"), (-0.2,), 0.9, "falling, by x"),
    DetectedLaw(Law("speed_squared", factor="pressure", peak=2e6, reference_area_m2=3e-4), (-0.2,), 0.9, "ẋ² by P"),
    DetectedLaw(Law("periodic", n_amplitudes=2, n_shapes=1, scale=0.03), (0.1, -0.2), 0.9, "a force every 30 mm"),
]


@pytest.mark.parametrize("seen", LAWS, ids=lambda seen: seen.law.name)
def test_the_effect_file_of_a_law_reproduces_the_law(seen: DetectedLaw, tmp_path: Path) -> None:
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
        (Law("position", factor="speed"), "N·s/m²"),
        (Law("speed_squared", factor="pressure"), "N·s²/(m²·Pa)"),
        (Law("falling_with_speed", n_shapes=1, scale=1.5, factor="position"), "N/m"),
        (Law("speed_cubed"), "N·s³/m³"),
    ],
)
def test_sizes_have_the_unit_that_gives_a_force(law: Law, unit: str) -> None:
    assert f'"{unit}"' in effect_text(DetectedLaw(law, (-0.2,), 0.9, "a law"))


def test_a_force_that_grows_with_time_is_proposed_and_predicts_left_out_conditions(tmp_path: Path) -> None:
    pairs = hidden_force(sheet((4,)), 101, "growing", -0.3, tmp_path)
    proposal = propose(vt.base_model(), pairs, lambda _: None)
    best = proposal.tied[0]
    assert best.effect.name == "proposed_time"
    rate = next(number for number in best.ratio.fit.numbers if number.key == "proposed_time.r")
    assert rate.low < -0.3 / 0.2 < rate.high
    assert best.rms_left_out_m < proposal.rms_left_out_m
    assert any("Proposed: a force that grows in proportion to time" in line for line in proposal.sentences())


def test_nothing_is_proposed_where_nothing_is_missing() -> None:
    proposal = propose(vt.base_model(), pairs_of(grown(sheet((4,)), 102)), lambda _: None)
    assert not proposal.tied
    assert "nothing is proposed" in proposal.sentences()[0]
    assert np.isfinite(proposal.rms_left_out_m)
