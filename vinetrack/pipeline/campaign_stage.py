"""The command `vinetrack design campaign`: a design that reaches given standard errors of n and B, with simulations."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import write_csv
from vinetrack.narrative.campaign_text import campaign_lines, simulation_lines
from vinetrack.pipeline.design_stage import read_list, read_range
from vinetrack.pipeline.predict_stage import (
    PredictionRequest,
    check_figure,
    inputs_of,
    name_missing_option,
    read_basis,
    write_figure,
)
from vinetrack.results.folder_layout import ResultsError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.planning.campaign_design import Candidates, Plan, Planned, Scope
    from vinetrack.planning.campaign_information import FilmingPlan
    from vinetrack.planning.predictive_inputs import PredictiveInputs
    from vinetrack.planning.simulated_campaigns import SimulatedCampaigns

_VINE = re.compile(r"\s*([^x×]+)[x×]([^x×]+)[x×]([^x×]+)\s*")
PLACEHOLDER_KPA = "100"  # Placeholder that lets a vine be read before the pressures of the campaign are chosen


@dataclass(frozen=True)
class CampaignRequest:
    """Options of the command: wanted standard errors (that of B relative), and constraints on the campaign. `power`
    requests the power for effects that are not in the model.
    """

    vines: tuple[str, ...]
    pressure: str | None
    payloads: str
    n_error: float
    B_error: float
    capture_fps: float
    noise_mm: float
    correlation: float
    longest_s: float
    pressures: tuple[int, int]
    replicates: tuple[int, int]
    most_trials: int
    burst_share: float
    check: int
    seed: int
    power: bool = False


def _read_vine(text: str) -> dict[str, str]:
    """Read a vine from `diameter×wall×length` in mm, µm, mm; return its cells by column.

    >>> _read_vine("24x200x280")
    {'diameter_mm': '24', 'thickness_um': '200', 'length_mm': '280'}
    """
    match = _VINE.fullmatch(text)
    if match is None:
        remedy = "write diameter, wall and length in mm, µm, mm, such as 24x200x280"
        raise ExperimentError([Problem(message="is not a vine", column="--vine", value=text, remedy=remedy)])
    return dict(
        zip(("diameter_mm", "thickness_um", "length_mm"), (part.strip() for part in match.groups()), strict=True)
    )


def design_campaign(
    request: PredictionRequest, wanted: CampaignRequest, *, sheet: Path | None = None, figure: Path | None = None
) -> list[str]:
    """Design a campaign; write its sheet and figure if requested."""
    from vinetrack.core.terminal import waiting
    from vinetrack.dynamics.simulate import SimulationError
    from vinetrack.effects import EffectError
    from vinetrack.inference.fit_data import FitError
    from vinetrack.planning.campaign_design import CampaignError, candidates, plan
    from vinetrack.planning.campaign_information import FilmingPlan

    check_figure(figure)
    vine_inputs = _vine_inputs(request, wanted)
    scope = _scope(wanted)
    camera = FilmingPlan(wanted.capture_fps, wanted.noise_mm / 1e3, wanted.correlation, wanted.longest_s)
    try:
        with waiting("choosing conditions"):
            planned = plan(candidates(vine_inputs, scope, camera), scope, wanted.n_error, wanted.B_error)
        simulated = _simulated_campaigns(planned, vine_inputs, camera, wanted)
    except EffectError as error:
        raise name_missing_option(error) from None
    except (SimulationError, FitError, CampaignError) as error:
        raise ResultsError(str(error)) from None
    lines = list(campaign_lines(planned, vine_inputs, camera, wanted.n_error, wanted.B_error, wanted.most_trials))
    if simulated is not None:
        lines += simulation_lines(planned, simulated)
    shown = planned.best or planned.nearest
    if wanted.power:
        lines += _power_lines(planned.candidates, shown, vine_inputs, camera)
    if sheet is not None:
        write_csv(sheet, _film_sheet(planned.candidates, shown, wanted))
        lines.append(f"Sheet, in random order: {sheet}")
    if figure is not None:
        write_figure(_picture(planned.candidates, shown, wanted.longest_s), figure)
        lines.append(f"Figure: {figure}")
    return lines


def _vine_inputs(request: PredictionRequest, wanted: CampaignRequest) -> list[PredictiveInputs]:
    """Return the predictive inputs of each vine."""
    if not wanted.vines:
        raise ExperimentError(
            [Problem(message="is missing", column="--vine", remedy="name one or more, such as 24x200x280")]
        )
    vine_inputs = []
    for text in dict.fromkeys(wanted.vines):
        cells = {**request.cells, **_read_vine(text), "pressure_kPa": PLACEHOLDER_KPA}
        vine_inputs += inputs_of(read_basis(replace(request, cells=cells)))
    return vine_inputs


def _scope(wanted: CampaignRequest) -> Scope:
    from vinetrack.planning.campaign_design import Scope

    pressure = (math.nan, math.nan) if wanted.pressure is None else read_range("pressure_kPa", wanted.pressure)
    return Scope(
        pressure_Pa=pressure,
        payloads_kg=read_list("payload_g", wanted.payloads),
        pressures=wanted.pressures,
        replicates=wanted.replicates,
        most_trials=wanted.most_trials,
        burst_share=wanted.burst_share,
    )


def _simulated_campaigns(
    planned: Planned, vine_inputs: Sequence[PredictiveInputs], camera: FilmingPlan, wanted: CampaignRequest
) -> SimulatedCampaigns | None:
    """Simulate and fit the campaign repeatedly; None if no design reaches the goal, or no simulation is requested."""
    from vinetrack.core.terminal import Progress, progress
    from vinetrack.planning.campaign_design import trials_of
    from vinetrack.planning.simulated_campaigns import simulate_campaign

    if planned.best is None or wanted.check == 0:
        return None
    trials = trials_of(planned.candidates, planned.best)
    bar: Progress[None]
    with progress(wanted.check, "simulating", unit="campaign") as bar:
        return simulate_campaign(
            planned.candidates.model,
            trials,
            camera,
            vine_inputs[0].spreads,
            campaigns=wanted.check,
            seed=wanted.seed,
            watch=bar.advance,
        )


def _power_lines(
    shown: Candidates, design: Plan, vine_inputs: Sequence[PredictiveInputs], camera: FilmingPlan
) -> list[str]:
    """Return lines about the power of the campaign for effects that are not in its model."""
    from vinetrack.core.terminal import waiting
    from vinetrack.diagnosis.campaign_power import CampaignDesign, design_power
    from vinetrack.inference.fit_data import FitError
    from vinetrack.narrative.power_text import seen_lines
    from vinetrack.planning.campaign_design import trials_of

    trials = tuple(trials_of(shown, design))
    count = len(trials)
    campaign = CampaignDesign(
        model=shown.model,
        trials=trials,
        cameras=(camera,) * count,
        spreads=vine_inputs[0].spreads,
        slow_error_m=(math.nan,) * count,
        has_trace=(False,) * count,
    )
    try:
        with waiting("calculating the power of the campaign"):
            return ["", *seen_lines(design_power(campaign))]
    except FitError as error:
        raise ResultsError(str(error)) from None


def _film_sheet(shown: Candidates, design: Plan, wanted: CampaignRequest) -> pd.DataFrame:
    """Return the trial sheet of the campaign in random order, so that a drift is not confounded with pressure."""
    import pandas as pd

    from vinetrack.planning.campaign_design import trials_of

    trials = trials_of(shown, design)
    order = np.random.default_rng(wanted.seed).permutation(len(trials))
    rows: list[Mapping[str, object]] = [
        {
            "trial": trials[k].name,
            "video": f"videos/{trials[k].name}.mp4",
            "capture_fps": wanted.capture_fps,
            "diameter_mm": float(f"{1e3 * trials[k].diameter_m:.6g}"),
            "thickness_um": float(f"{1e6 * trials[k].thickness_m:.6g}"),
            "length_mm": float(f"{1e3 * trials[k].length_m:.6g}"),
            "pressure_kPa": float(f"{trials[k].pressure_Pa / 1e3:.6g}"),
            "yield_pressure_kPa": float(f"{trials[k].yield_pressure_Pa / 1e3:.6g}"),
            "payload_g": float(f"{1e3 * trials[k].payload_kg:.6g}"),
        }
        for k in order
    ]
    return pd.DataFrame(rows)


def _picture(shown: Candidates, design: Plan, longest_s: float) -> Figure:
    from vinetrack.figures.prediction_figures import draw_campaign
    from vinetrack.planning.campaign_design import trials_of
    from vinetrack.planning.campaign_information import final_lead_speeds

    trials = trials_of(shown, design)
    speeds = final_lead_speeds(shown.model, trials, longest_s)
    points = [
        (trial.vine, trial.pressure_Pa / 1e3, trial.payload_kg * 1e3, float(speed))
        for trial, speed in zip(trials, speeds, strict=True)
    ]
    return draw_campaign(points, design.n_error, design.B_errors)
