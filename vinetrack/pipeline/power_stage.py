"""The command `vinetrack power`: statistical power of the trials of a sheet, an experiment or a results folder."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import SYSTEMATIC_OF_TRAVEL
from vinetrack.core.tables import PROVENANCE
from vinetrack.core.terminal import Progress, progress, waiting
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.campaign_power import (
    CampaignDesign,
    design_of_fit,
    fitted_tests,
    planned_tests,
    rates_of,
    simulated_diagnosis,
)
from vinetrack.diagnosis.further_trials import exploratory_trials, further_trials
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.power import Power, PowerInput, SimulatedRates, sheet_cells
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.dynamics.model import Model, host_for, make_model
from vinetrack.effects import BASE_EFFECTS
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.experiment.settings import Limits
from vinetrack.experiment.sheet import YIELD_SIGMA_KPA, PlannedTrials, expected_systematic_m, planned_sheet
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs, pairs_of
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit
from vinetrack.pipeline.effects_stage import effects_of
from vinetrack.pipeline.predict_stage import effects_of_plan
from vinetrack.pipeline.stages import map_unordered
from vinetrack.planning.predictive_inputs import StatedValues, predictive_inputs
from vinetrack.planning.simulated_campaigns import FilmingPlan
from vinetrack.results.folder_layout import Results, measured_trials, read_diagnosis, read_source_experiment


@dataclass(frozen=True)
class PowerRequest:
    """Options of the command; NaN and None for those not given. Between-trial standard deviations are relative.
    `effects` are names, or `name=size` in the unit of the parameter; `simulate` is the number of campaigns simulated
    with each.
    """

    target: Path
    effects: tuple[str, ...] = ()
    noise_mm: float = math.nan
    noise_correlation: float = math.nan
    spread_P: float = math.nan
    spread_B: float = math.nan
    capture_fps: float = math.nan
    systematic_mm: float = math.nan
    B: float = math.nan
    n: float = math.nan
    simulate: int = 0
    jobs: int = 1
    first_seed: int = 1
    reach: float = math.nan
    recommend: bool = False
    experiment: Path | None = None


def _assumptions(
    request: PowerRequest, noise: tuple[float, float], spreads: Sequence[float], otherwise: tuple[str, str]
) -> tuple[tuple[float, float], tuple[float, float], list[PowerInput]]:
    """Noise of a position, m, with its correlation, and standard deviations between trials of pressure and B: as
    stated, else those given, which have the origins `otherwise`. Returns noise, spreads, and both in words.
    """
    noise_stated = np.array([request.noise_mm / 1e3, request.noise_correlation])
    spreads_stated = np.array([request.spread_P, request.spread_B])
    noise_m, correlation = np.where(np.isnan(noise_stated), noise, noise_stated).tolist()
    pressure, damping = np.where(np.isnan(spreads_stated), spreads, spreads_stated).tolist()
    of_noise, of_spreads = (
        origin if np.isnan(stated).all() else "stated"
        for origin, stated in zip(otherwise, (noise_stated, spreads_stated), strict=True)
    )
    words = [
        PowerInput("noise of a position", f"{1e3 * noise_m:.3g} mm, correlation {correlation:.2f}", of_noise),
        PowerInput("spread of pressure from trial to trial", f"{100 * pressure:.2g} %", of_spreads),
        PowerInput("spread of B from trial to trial", f"{100 * damping:.2g} %", of_spreads),
    ]
    return (noise_m, correlation), (pressure, damping), words


@dataclass(frozen=True)
class PowerCampaign:
    """The power of a campaign by linear theory, its design for simulations, and constraints on further trials."""

    power: Power
    design: CampaignDesign
    limits: Limits = field(default_factory=Limits)


def campaign_of_target(request: PowerRequest) -> PowerCampaign:
    """Return the campaign of the measured trials of a results folder or an experiment; without any, of the planned."""
    target = request.target
    experiment: Experiment | None
    if (target / PROVENANCE).exists():
        results, experiment = Results(target), read_source_experiment(target, request.experiment)
        diagnosis = read_diagnosis(results)
        added = diagnosis.effects if diagnosis is not None and diagnosis.final_verdict == ADEQUATE else ()
        pairs: Pairs = measured_trials(experiment, results)[0]
    else:
        try:
            experiment = read_experiment(target) if target.is_dir() else None
        except ExperimentError:
            experiment = None  # recordings that do not exist yet: a plan
        if experiment is None or all(trial.track is None for trial in experiment.trials):
            return _planned_campaign(request, planned_sheet(target, every_row=True))
        pairs, added = pairs_of(experiment)[0], ()
    settings = experiment.settings
    names = dict.fromkeys((*settings.model, *added))
    model = make_model(names, effects_of(experiment.folder) if settings.effects else {})
    return _measured_campaign(request, model, pairs, settings.candidates, settings.limits)


def _measured_campaign(
    request: PowerRequest, model: Model, pairs: Pairs, candidates: Sequence[str] | None, limits: Limits
) -> PowerCampaign:
    """Return the campaign of measured trials, with noise and scatter from the options, else from a fit."""
    host = host_for(model, candidates_of(model, candidates, model.user_effects))
    fitted = fit(model, pairs, host=host, profile=False, thorough=False)
    noise, spreads, inputs = _assumptions(
        request, (fitted.noise_m, fitted.noise_correlation), fitted.state.spread, ("fit", "fit")
    )
    noise_stated, spreads_stated = (row.origin == "stated" for row in inputs[:2])
    if noise_stated or spreads_stated:
        of_trials, of_points = spreads if spreads_stated else None, noise if noise_stated else None
        fitted = fit(model, pairs, spreads=of_trials, noise=of_points, host=host, profile=False, thorough=False)
    tests, not_testable = fitted_tests(fitted, candidates)
    power = power_of(tests, not_testable, inputs if noise_stated or spreads_stated else (), nonlinear=True)
    return PowerCampaign(power, design_of_fit(fitted, candidates), limits)


def _planned_campaign(request: PowerRequest, planned: PlannedTrials) -> PowerCampaign:
    """Return the campaign of planned trials; B, n and yield pressure are stated, published, or from scaling laws."""
    default_noise_m, default_capture_fps = 1e-4, 1069.0  # Noise of a position, and frame rate, where not given (chosen)
    settings = planned.settings
    stated = StatedValues(B=request.B, n=request.n, model=settings.model, user_effects=effects_of_plan(planned))
    first_of_vine = {trial.vine: trial for trial in reversed(planned.trials)}
    vines = dict.fromkeys(trial.vine for trial in planned.trials)
    by_vine = {vine: predictive_inputs(first_of_vine[vine], stated) for vine in vines}
    first = next(iter(by_vine.values()))
    noise, spreads, inputs = _assumptions(
        request, (default_noise_m, 0.0), first.spreads, ("guess", "guess: a usual batch of vines")
    )
    systematic_m, systematic_origin = _planned_systematic(request, planned)
    trials, cameras = [], []
    for trial in planned.trials:
        if not math.isfinite(trial.yield_pressure_Pa):
            assumed_Pa = by_vine[trial.vine].trial.yield_pressure_Pa
            trial = replace(trial, yield_pressure_Pa=assumed_Pa, yield_pressure_sigma_Pa=1e3 * YIELD_SIGMA_KPA)
        trials.append(replace(trial, position_systematic_m=systematic_m))
        rates = (request.capture_fps, trial.capture_fps, default_capture_fps)
        cameras.append(FilmingPlan(next(fps for fps in rates if math.isfinite(fps)), *noise))
    is_in_sheet = all(math.isfinite(trial.capture_fps) for trial in trials)
    fps_origin = "stated" if math.isfinite(request.capture_fps) else "sheet" if is_in_sheet else "guess"
    inputs += [
        PowerInput("systematic error of positions", f"{1e3 * systematic_m:.3g} mm", systematic_origin),
        PowerInput("frame rate", f"{cameras[0].capture_fps:g} /s", fps_origin),
        *(
            PowerInput(f"{symbol} of {vine}", f"{of_vine.medians[key]:.3g}", str(of_vine.origins[key]))
            for vine, of_vine in by_vine.items()
            for symbol, key in (("B", DAMPING), ("n", EXPONENT))
        ),
    ]
    model = first.model.with_values({DAMPING: {vine: of_vine.medians[DAMPING] for vine, of_vine in by_vine.items()}})
    design = CampaignDesign(model, tuple(trials), tuple(cameras), spreads, settings.candidates)
    tests, not_testable = planned_tests(design)
    return PowerCampaign(power_of(tests, not_testable, inputs, nonlinear=True), design, settings.limits)


def _planned_systematic(request: PowerRequest, planned: PlannedTrials) -> tuple[float, str]:
    """Return the systematic error of positions of planned trials, m, and where it comes from."""
    if math.isfinite(request.systematic_mm):
        return request.systematic_mm / 1e3, "stated"
    systematic_m, stated_mm = expected_systematic_m(planned.settings), planned.settings.position_systematic_mm
    if math.isfinite(systematic_m):
        return systematic_m, "lens known from a target" if stated_mm is None else "experiment.yaml"
    longest_m = max((trial.length_m for trial in planned.trials if math.isfinite(trial.length_m)), default=0.0)
    return SYSTEMATIC_OF_TRAVEL * longest_m, "guess: positions by a scale, lens uncorrected"


@in_one_blas_thread
def power_of_target(request: PowerRequest, given: Fit | Pairs | None = None) -> Power:
    """Power of the trials by linear theory, and by simulated campaigns if asked; of `given` trials or fit if any."""
    with waiting("calculating the power of the trials"):
        if given is None:
            campaign = campaign_of_target(request)
        elif isinstance(given, Fit):
            tests, not_testable = fitted_tests(given)
            campaign = PowerCampaign(power_of(tests, not_testable, nonlinear=True), design_of_fit(given))
        else:
            campaign = _measured_campaign(request, make_model(BASE_EFFECTS), list(given), None, Limits())
    asked = [_asked(text, campaign.power) for text in request.effects]
    power = campaign.power
    if request.simulate:
        power = replace(power, simulated=tuple(_simulated_rates(request, campaign, asked)))
    if request.recommend:
        with waiting("searching for the trials to make next"):
            recommended = exploratory_trials(campaign.design, campaign.power, campaign.limits)
        power = replace(power, recommended=recommended)
    if math.isfinite(request.reach):
        for text, (name, value) in zip(request.effects, asked, strict=True):
            if name in power.not_testable:
                raise _refusal("cannot be tested with the columns of these trials", text, str(power.not_testable[name]))
            if not math.isfinite(value):
                raise _refusal("needs a size", text, "write the size to detect, such as leak=0.5")
            with waiting(f"searching for trials that detect {name}"):
                plan = further_trials(campaign.design, power[name], value, request.reach, campaign.limits)
            power = replace(power, further=(*power.further, plan))
    return power.of_effects([name for name, _ in asked])


def _asked(text: str, power: Power) -> tuple[str, float]:
    """Read `name` or `name=size`: the effect, and its size in SI, NaN where none is given."""
    name, _, size = text.partition("=")
    if name in power.not_testable:
        return name, math.nan
    known = {entry.effect: entry for entry in power.effects}
    if name not in known:
        candidates = sorted([*known, *power.not_testable])
        close = difflib.get_close_matches(name, candidates, 1, 0.6)
        remedy = f"did you mean {close[0]}?" if close else f"the candidates are {', '.join(candidates)}"
        in_model = name in power.model
        message = "is in the model already" if in_model else "is not a candidate for these trials"
        raise _refusal(message, name, remedy)
    if not size:
        return name, math.nan
    unit, factor = display_unit(known[name].unit)
    try:
        return name, float(size) / factor
    except ValueError:
        raise _refusal("is not a size", text, f"write a number in {unit or 'the unit of the parameter'}") from None


def _refusal(message: str, value: str, remedy: str) -> ExperimentError:
    return ExperimentError([Problem(message=message, column="--effect", value=value, remedy=remedy)])


def sheet_rows(power: Power) -> list[dict[str, object]]:
    """Return the rows of the sheet for the further trials."""
    return [
        {
            "trial": f"{plan.power.effect}_{k}" if len(power.further) > 1 else added.trial.name,
            **sheet_cells(added.trial),
        }
        for plan in power.further
        for k, added in enumerate(plan.trials, 1)
    ]


def _simulated_rates(
    request: PowerRequest, campaign: PowerCampaign, asked: Sequence[tuple[str, float]]
) -> Iterator[SimulatedRates]:
    """Simulate campaigns of the design and diagnose each in full; yield the rate of each kind, the null first."""
    power = campaign.power
    wanted: list[tuple[str, tuple[float, ...], float]] = [("", (math.nan,), power.false_alarm_rate)]
    for name, size in asked:
        if name not in power.not_testable:
            entry = power[name]
            sizes = [size] if math.isfinite(size) else [entry.size_at(0.5), entry.size_at(0.9)]
            known = filter(math.isfinite, sizes)
            wanted += [(name, (value, *entry.other_values), entry.probability_at(value)) for value in known]
    seeds = range(request.first_seed, request.first_seed + request.simulate)
    bar: Progress[None]
    with progress(len(wanted) * len(seeds), "simulating", unit="campaign") as bar:
        for effect, values, predicted_rate in wanted:
            diagnoses = []
            work = partial(simulated_diagnosis, campaign.design, effect, values)
            for answer in map_unordered(work, seeds, request.jobs):
                diagnoses.append(answer)
                bar.advance()
            yield rates_of(effect, diagnoses, values[0], predicted_rate)
