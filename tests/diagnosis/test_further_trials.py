"""The fewest further trials that give an effect of some size a target power."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.further_trials import further_trials
from vinetrack.diagnosis.linear_power import effect_power, power_of
from vinetrack.diagnosis.power import FurtherTrials, Power
from vinetrack.experiment.settings import Limits
from vinetrack.narrative.power_text import further_lines
from vinetrack.pipeline.power_stage import sheet_rows
from vinetrack.planning.simulated_campaigns import FilmingPlan

LIMITS = Limits(pressure_kPa=(14.0, 40.0), new_vines=False, payload_g=(0.0, 0.0))


def design_of(replicates: int, pressures: tuple[str, ...] = ("14", "24")) -> CampaignDesign:
    """So many trials of one vine at each of some pressures."""
    trials: list[Trial] = []
    for pressure in pressures:
        texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "200", "pressure_kPa": pressure}
        trial = vt.planned_trial({**texts, "yield_pressure_kPa": "3"}).trials[0]
        trials += [replace(trial, name=f"P{pressure}_{k}", position_systematic_m=0.0) for k in range(replicates)]
    count = len(trials)
    model, cameras = vt.predictive_inputs(trials[0]).model, (FilmingPlan(500.0, 1e-4),) * count
    names = ("air_drag", "tail_friction", "leak")
    return CampaignDesign(
        model, tuple(trials), cameras, (0.01, 0.03), (math.nan,) * count, (False,) * count, names
    )  # fmt: skip


@pytest.fixture(scope="module")
def design() -> CampaignDesign:
    return design_of(2)


@pytest.fixture(scope="module")
def power(design: CampaignDesign) -> Power:
    return power_of(planned_tests(design)[0], nonlinear=True)


@pytest.fixture(scope="module")
def plan(design: CampaignDesign, power: Power) -> FurtherTrials:
    return further_trials(design, power["leak"], 0.6 * power["leak"].size_at(0.9), 0.9, LIMITS)


def test_the_power_of_a_plan_is_that_of_a_sheet_with_its_trials(design: CampaignDesign, plan: FurtherTrials) -> None:
    assert plan.before < 0.9 <= plan.after
    added = tuple(added.trial for added in plan.trials)
    count = len(design.trials) + len(added)
    made = replace(
        design, trials=(*design.trials, *added), cameras=design.cameras[:1] * count,
        slow_error_m=(math.nan,) * count, has_trace=(False,) * count,
    )  # fmt: skip
    again = effect_power(planned_tests(made)[0], "leak")
    assert again is not None
    assert plan.power is not None
    assert again.size_at(0.9) == pytest.approx(plan.power.size_at(0.9), rel=0.02)


def test_one_pair_less_is_not_enough(plan: FurtherTrials) -> None:
    fewer = [added.probability for added in plan.trials if added.probability < plan.target]
    assert len(fewer) == len(plan.trials) - 2


def test_trials_stay_within_the_limits_and_come_in_pairs(plan: FurtherTrials) -> None:
    pressures = [added.trial.pressure_Pa for added in plan.trials]
    assert all(14e3 <= pressure <= 40e3 for pressure in pressures)
    assert not any(added.new_vine for added in plan.trials)
    assert all(count % 2 == 0 for count in np.unique(pressures, return_counts=True)[1])


def test_no_trials_are_added_where_none_are_needed(design: CampaignDesign, power: Power) -> None:
    enough = further_trials(design, power["leak"], 1.5 * power["leak"].size_at(0.98), 0.9, LIMITS)
    assert enough.trials == ()
    assert "none need be added" in further_lines(enough)[0]


def test_a_target_out_of_reach_within_the_limits_is_reported(design: CampaignDesign, power: Power) -> None:
    tight = LIMITS.model_copy(update={"trials": 4})
    never = further_trials(design, power["air_drag"], 0.05, 0.9, Limits(**tight.model_dump()))
    assert not never.is_reached
    assert never.unlimited < 0.9
    assert any(line.startswith("No number of trials within `limits` suffices") for line in further_lines(never))


def test_rows_of_the_sheet_give_the_same_trials(power: Power, plan: FurtherTrials) -> None:
    rows = sheet_rows(replace(power, further=(plan,)))
    assert len({row["trial"] for row in rows}) == len(plan.trials)
    texts = {name: str(cell) for name, cell in rows[0].items() if name != "trial"}
    read = vt.planned_trial(texts).trials[0]
    assert read.pressure_Pa == pytest.approx(plan.trials[0].trial.pressure_Pa)
    assert read.vine == plan.trials[0].trial.vine


def test_the_table_of_a_plan_ends_with_its_power(plan: FurtherTrials) -> None:
    lines = further_lines(plan)
    assert f"{100 * plan.after:.2g} %" in "\n".join(lines)
