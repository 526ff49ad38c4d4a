"""What speaks against a vine: one case a hazard, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.dynamics.model import make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.planned import planned_trial
from vinetrack.planning.prediction import VinePrediction, design_checks, neglected, predict_vine, typical_sizes
from vinetrack.planning.predictive_inputs import StatedValues, predictive_inputs

SAFE = {
    "diameter_mm": "18",
    "thickness_um": "150",
    "length_mm": "250",
    "pressure_kPa": "24",
    "yield_pressure_kPa": "3",
    "growth_angle_deg": "180",
    "chamber_l": "50",
}


def prediction(said: StatedValues | None = None, tail_slack: str = "taut", **values: object) -> VinePrediction:
    from dataclasses import replace

    trial = planned_trial({**SAFE, **{name: str(value) for name, value in values.items()}}).trials[0]
    return predict_vine(predictive_inputs(replace(trial, tail_slack=tail_slack), said), samples=60)


def test_a_sound_vine_has_no_hazard() -> None:
    assert design_checks(prediction()) == ()


@pytest.mark.parametrize(("pressure_kPa", "words"), [(129, "about to burst"), (131, "would burst")])
def test_a_wall_near_its_burst_stress_and_beyond_it(pressure_kPa: float, words: str) -> None:
    # PD/2t = 7.8 MPa at 2 × 150 µm × 7.8 MPa/18 mm = 130 kPa.
    found = design_checks(prediction(pressure_kPa=pressure_kPa))
    assert any(words in one and "130 kPa" in one for one in found)


def test_a_pressure_below_the_yield_pressure() -> None:
    found = design_checks(prediction(pressure_kPa=2.5))
    assert any("2.5 kPa lies below the yield pressure" in one and "raise the pressure" in one for one in found)


def test_a_tail_that_would_have_to_push() -> None:
    found = design_checks(
        prediction(diameter_mm=24, thickness_um=200, payload_g=35.6, pressure_kPa=14, growth_angle_deg=0)
    )
    (sentence,) = (one for one in found if "predicts compression in the tail" in one)
    assert "in every draw" in sentence


def test_a_tail_that_may_go_slack_does() -> None:
    loose = prediction(
        tail_slack="free", diameter_mm=24, thickness_um=200, payload_g=35.6, pressure_kPa=14, growth_angle_deg=0
    )
    found = design_checks(loose)
    assert loose.final.name == "speed of the leading edge"
    with pytest.raises(KeyError):
        loose["ejection speed of the payload"]
    assert any("the tail goes slack on the way in every draw" in one for one in found)
    assert not any("predicts compression in the tail" in one for one in found)


def test_a_reservoir_that_sags() -> None:
    # 60 cm³ of vine at y/L = 0.95 in 1 L: 125.3 kPa/1.060 is 7.1 kPa less, 30 % of 24 kPa; γ = 1.4 makes 41 %.
    found = design_checks(prediction(chamber_l=1))
    assert any("reservoir of 1 L loses 30% (slow) to 41% (fast)" in one for one in found)


def test_what_an_effect_left_out_would_do_is_what_it_does_when_put_in() -> None:
    inputs = prediction().inputs
    drag = next(one for one in neglected(inputs, 0.95) if one.effect == "air_drag")
    model = make_model([*inputs.model.names, "air_drag"]).with_values(inputs.model.values)
    found = simulate(model, inputs.trial, np.linspace(0, 2.0, 20_001))
    speed = np.interp(0.95 * 0.25, found.lead_position_m, found.lead_velocity_m_s)
    assert drag.final_m_s == pytest.approx(speed, rel=1e-3)
    assert drag.change < 0


def test_effects_in_the_model_and_those_whose_columns_are_blank_are_not_among_those_left_out() -> None:
    from vinetrack.planning.predictive_inputs import read_sizes

    said = StatedValues(effects=("air_drag",), sizes=read_sizes("air_drag=1")[1])
    names = {one.effect for one in neglected(prediction(said).inputs, 0.95)}
    assert "air_drag" not in names
    assert "inlet_loss" not in names  # no inlet in the sheet
    assert "payload_drag" not in names  # no payload
    assert {"reservoir_depletion", "fold_inertia", "gas_inertia"} <= names


def test_wall_stretch_follows_from_the_wall() -> None:
    # (1 − ν/4) D/(2Et) = 0.875 × 18 mm/(2 × 25 MPa × 150 µm) = 2.1e-6 1/Pa.
    trial = prediction().inputs.trial
    assert typical_sizes("wall_stretch", trial)["wall_stretch.kappa"] == pytest.approx(2.1e-6)
