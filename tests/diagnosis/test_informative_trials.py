"""Further trials where nothing is found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.further_trials import InformativeTrials, _alone_and_distinct, exploratory_trials
from vinetrack.diagnosis.linear_power import effect_power, power_of
from vinetrack.diagnosis.power import Power
from vinetrack.experiment.settings import Limits
from vinetrack.narrative.power_text import informative_text
from vinetrack.planning.simulated_campaigns import FilmingPlan

LIMITS = Limits(pressure_kPa=(14.0, 40.0), payload_g=(0.0, 0.0), inlet_mm=(5.5, 8.0), chamber_l=(3.7,), trials=4)
NAMES = ("inlet_loss", "linear_damping", "leak")


@pytest.fixture(scope="module")
def design() -> CampaignDesign:
    """Three trials of one vine at each of two pressures, through a connector that is always the same."""
    trials: list[Trial] = []
    for pressure in ("14", "24"):
        texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "200", "pressure_kPa": pressure}
        texts |= {"yield_pressure_kPa": "3", "chamber_l": "3.7", "inlet_mm": "8"}
        trial = vt.planned_trial(texts).trials[0]
        trials += [replace(trial, name=f"P{pressure}_{k}", position_systematic_m=0.0) for k in range(3)]
    count = len(trials)
    model, cameras = vt.predictive_inputs(trials[0]).model, (FilmingPlan(500.0, 1e-4),) * count
    return CampaignDesign(
        model, tuple(trials), cameras, (0.005, 0.02), (math.nan,) * count, (False,) * count, NAMES
    )  # fmt: skip


@pytest.fixture(scope="module")
def power(design: CampaignDesign) -> Power:
    return power_of(planned_tests(design)[0], nonlinear=True)


@pytest.fixture(scope="module")
def plan(design: CampaignDesign, power: Power) -> InformativeTrials:
    found = exploratory_trials(design, power, LIMITS)
    assert found is not None
    return found


def sizes_with(design: CampaignDesign, settings: list[tuple[float, float]]) -> np.ndarray:
    """Sizes of all effects found nine times in ten with trials at these pressures, kPa, and connectors, mm, as well."""
    like = design.trials[0]
    added = [
        replace(like, name=f"a{k}", pressure_Pa=1e3 * kPa, pressure_sigma_Pa=like.pressure_sigma_Pa, inlet_m=mm / 1e3)
        for k, (kPa, mm) in enumerate(settings)
    ]
    count = len(design.trials) + len(added)
    made = replace(
        design, trials=(*design.trials, *added), cameras=design.cameras[:1] * count,
        slow_error_m=(math.nan,) * count, has_trace=(False,) * count,
    )  # fmt: skip
    powers = [effect_power(planned_tests(made)[0], name) for name in NAMES]
    return np.array([power.size_at(0.9) for power in powers if power is not None])


def test_the_promised_sizes_are_those_of_a_sheet_with_these_trials(
    design: CampaignDesign, plan: InformativeTrials
) -> None:
    settings = [(t["pressure_kPa"], t["inlet_mm"]) for t in plan.trials for _ in range(t["replicates"])]
    assert len(settings) == 4
    promised = [plan.then[name].size_at(0.9) for name in NAMES]
    assert promised == pytest.approx(sizes_with(design, settings).tolist(), rel=0.03)


def test_what_is_recommended_reveals_more_than_repeats_do(design: CampaignDesign, plan: InformativeTrials) -> None:
    repeated = sizes_with(design, [(14.0, 8.0), (14.0, 8.0), (24.0, 8.0), (24.0, 8.0)])
    recommended = np.array([plan.then[name].size_at(0.9) for name in NAMES])
    # The loss of a connector shows once another connector is used, and what it is taken for with it; a leak is found
    # by either design at a thousandth of its largest plausible size.
    assert np.all(recommended[:2] < 0.1 * repeated[:2])
    assert recommended[2] < 1e-3 * plan.now["leak"].largest
    assert "inlet loss from K = " in informative_text(plan)


def test_nothing_is_recommended_where_nothing_can_be_made(design: CampaignDesign, power: Power) -> None:
    assert exploratory_trials(design, power, Limits(pressure_kPa=(1.0, 2.0), payload_g=(0.0, 0.0))) is None


def test_information_apart_from_the_most_similar_rival() -> None:
    alone, apart = _alone_and_distinct(np.array([[[4.0, 2.0, 1.0], [2.0, 5.0, 0.0], [1.0, 0.0, 0.5]]]))
    assert alone.tolist() == [[4.0, 5.0, 0.5]]
    assert apart[0] == pytest.approx([4 - 1 / 0.5, 5 - 4 / 4, 0.5 - 1 / 4])
