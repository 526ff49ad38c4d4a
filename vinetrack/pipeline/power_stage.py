"""The command `vinetrack power`: statistical power of the trials of a sheet, an experiment or a results folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import SYSTEMATIC_OF_TRAVEL
from vinetrack.core.tables import PROVENANCE
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.diagnosis.campaign_power import (
    CampaignDesign,
    design_of_fit,
    design_power,
    fit_power,
    rates_of,
    simulated_diagnosis,
)
from vinetrack.diagnosis.power import EffectPower, FurtherTrials, Power, PowerInput, SimulatedRates, sheet_cells
from vinetrack.effects import BASE_EFFECTS
from vinetrack.experiment.settings import Limits
from vinetrack.experiment.sheet import expected_systematic_m
from vinetrack.pipeline.trials import map_unordered
from vinetrack.planning.simulated_campaigns import FilmingPlan, joint_model

if TYPE_CHECKING:
    from vinetrack.core.records import Track, Trial
    from vinetrack.diagnosis.campaign_power import SimulatedDiagnosis
    from vinetrack.diagnosis.further_trials import InformativeTrials
    from vinetrack.effects import Effect
    from vinetrack.experiment.sheet import PlannedTrials
    from vinetrack.inference.fit_data import Pairs
    from vinetrack.inference.fit_result import Fit


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

    @property
    def noise(self) -> tuple[float, float]:
        """Stated noise of a position, m, and its correlation."""
        return self.noise_mm / 1e3, self.noise_correlation

    @property
    def spreads(self) -> tuple[float, float]:
        """Stated relative standard deviations between trials, of pressure and B."""
        return self.spread_P, self.spread_B


@dataclass(frozen=True)
class PowerCampaign:
    """The power of a campaign by linear theory, its design for simulations, and constraints on further trials."""

    power: Power
    design: CampaignDesign
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class MeasuredTrials:
    """Measured trials; `names` are the effects of the model, `added` those of them that a diagnosis added."""

    pairs: Sequence[tuple[Trial, Track]]
    names: tuple[str, ...]
    added: tuple[str, ...] = ()
    user_effects: Mapping[str, Effect] = field(default_factory=dict)
    candidates: Sequence[str] | None = None
    limits: Limits = field(default_factory=Limits)


def campaign_of_target(request: PowerRequest) -> PowerCampaign:
    """Return the campaign of the measured trials of the target; without any, that of the planned trials."""
    from vinetrack.experiment.sheet import planned_sheet

    measured = trials_of_target(request)
    if measured is not None:
        return measured_campaign(request, measured)
    return _planned_campaign(request, planned_sheet(request.target, every_row=True))


def trials_of_target(request: PowerRequest) -> MeasuredTrials | None:
    """Read the trials of a results folder or of an experiment with tracks."""
    from vinetrack.effects import own_effects
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.inference.fit_data import pairs_of

    if (request.target / PROVENANCE).exists():
        return _trials_of_results(request)
    if not request.target.is_dir():
        return None
    try:
        read = read_experiment(request.target)
    except ExperimentError:
        return None  # recordings that do not exist yet: a plan
    if all(trial.track is None for trial in read.trials):
        return None
    settings = read.settings
    user_effects = dict(own_effects([read.folder / path for path in settings.effects]))
    pairs, _ = pairs_of(read)
    return MeasuredTrials(pairs, tuple(settings.model), (), user_effects, settings.candidates, settings.limits)


def campaign_in_memory(request: PowerRequest, given: Fit | Pairs) -> PowerCampaign:
    """Return the campaign of a fit, or of trials in memory with the base model."""
    from vinetrack.inference.fit_result import Fit

    if isinstance(given, Fit):
        return PowerCampaign(fit_power(given), design_of_fit(given))
    return measured_campaign(request, MeasuredTrials(list(given), BASE_EFFECTS))


def _trials_of_results(request: PowerRequest) -> MeasuredTrials:
    from vinetrack.diagnosis.result import ADEQUATE
    from vinetrack.effects import own_effects
    from vinetrack.results.folder_layout import Results, measured_trials, read_diagnosis, read_source_experiment

    results = Results(request.target)
    experiment = read_source_experiment(request.target, request.experiment)
    settings = experiment.settings
    diagnosis = read_diagnosis(results)
    accepted = diagnosis.effects if diagnosis is not None and diagnosis.final_verdict == ADEQUATE else ()
    added = tuple(name for name in accepted if name not in settings.model)
    user_effects = dict(own_effects([experiment.folder / path for path in settings.effects]))
    pairs = measured_trials(experiment, results)[0]
    return MeasuredTrials(pairs, (*settings.model, *added), added, user_effects, settings.candidates, settings.limits)


def measured_campaign(request: PowerRequest, measured: MeasuredTrials) -> PowerCampaign:
    """Return the campaign of measured trials, with noise and scatter from the options, else from a fit."""
    from vinetrack.diagnosis.ladder import candidates_of
    from vinetrack.dynamics.model import host_for, make_model
    from vinetrack.inference.fit import fit

    pairs, candidates = measured.pairs, measured.candidates
    model = make_model(measured.names, measured.user_effects)
    host = host_for(model, candidates_of(model, candidates, measured.user_effects))
    first = fit(model, pairs, host=host, profile=False, thorough=False)
    stated = _stated(request.noise, (first.noise_m, first.noise_correlation))
    spreads = _stated(request.spreads, (float(first.state.spread[0]), float(first.state.spread[1])))
    inputs: list[PowerInput] = []
    if stated is not None or spreads is not None:
        first = fit(model, pairs, spreads=spreads, noise=stated, host=host, profile=False, thorough=False)
        inputs = _input_rows(
            first.noise_m, first.noise_correlation, tuple(first.state.spread),
            ("stated" if stated else "fit", "stated" if spreads else "fit"),
        )  # fmt: skip
    return PowerCampaign(fit_power(first, candidates, inputs), design_of_fit(first, candidates), measured.limits)


def _stated(given: tuple[float, float], otherwise: tuple[float, float]) -> tuple[float, float] | None:
    """Two numbers of which those not given are taken from elsewhere; None if neither is given."""
    first, second = (other if math.isnan(one) else one for one, other in zip(given, otherwise, strict=True))
    return None if math.isnan(given[0]) and math.isnan(given[1]) else (first, second)


def _input_rows(
    noise_m: float, correlation: float, spreads: Sequence[float], origins: tuple[str, str]
) -> list[PowerInput]:
    return [
        PowerInput("noise of a position", f"{1e3 * noise_m:.3g} mm, correlation {correlation:.2f}", origins[0]),
        PowerInput("spread of pressure from trial to trial", f"{100 * spreads[0]:.2g} %", origins[1]),
        PowerInput("spread of B from trial to trial", f"{100 * spreads[1]:.2g} %", origins[1]),
    ]


def _planned_campaign(request: PowerRequest, planned: PlannedTrials) -> PowerCampaign:
    """Return the campaign of planned trials; B, n and yield pressure are stated, published, or from scaling laws."""
    from vinetrack.effects import own_effects
    from vinetrack.inference.fit_result import DAMPING, EXPONENT
    from vinetrack.planning.predictive_inputs import StatedValues, predictive_inputs

    default_noise_mm, default_capture_fps = 0.1, 1069.0  # Default noise of a position, and default frame rate (chosen)
    folder, settings = planned.folder or Path(), planned.settings
    user_effects = dict(own_effects([folder / path for path in settings.effects]))
    stated = StatedValues(B=request.B, n=request.n, model=settings.model, user_effects=user_effects)
    by_vine = {}
    for trial in planned.trials:
        if trial.vine not in by_vine:
            by_vine[trial.vine] = predictive_inputs(trial, stated)
    vine_inputs = list(by_vine.values())
    first = vine_inputs[0]
    noise = _stated(request.noise, (default_noise_mm / 1e3, 0.0))
    noise_m, correlation = noise or (default_noise_mm / 1e3, 0.0)
    spreads = _stated(request.spreads, first.spreads)
    systematic_m, systematic_origin = _planned_systematic(request, planned)
    trials = tuple(
        replace(_with_yield(trial, by_vine[trial.vine].trial), position_systematic_m=systematic_m)
        for trial in planned.trials
    )
    filmed_fps = [request.capture_fps if math.isfinite(request.capture_fps) else trial.capture_fps for trial in trials]
    cameras = tuple(
        FilmingPlan(fps if math.isfinite(fps) else default_capture_fps, noise_m, correlation) for fps in filmed_fps
    )
    origins = ("stated" if noise else "guess", "stated" if spreads else "guess: a usual batch of vines")
    inputs = [
        *_input_rows(noise_m, correlation, spreads or first.spreads, origins),
        PowerInput("systematic error of positions", f"{1e3 * systematic_m:.3g} mm", systematic_origin),
        PowerInput("frame rate", f"{cameras[0].capture_fps:g} /s", _fps_origin(request, trials)),
        *(
            PowerInput(f"{symbol} of {vine}", f"{of_vine.medians[key]:.3g}", of_vine.origins[key])
            for vine, of_vine in by_vine.items()
            for symbol, key in (("B", DAMPING), ("n", EXPONENT))
        ),
    ]  # fmt: skip
    design = CampaignDesign(
        model=joint_model(vine_inputs),
        trials=trials,
        cameras=cameras,
        spreads=spreads or first.spreads,
        slow_error_m=(math.nan,) * len(trials),
        has_trace=(False,) * len(trials),
        candidates=settings.candidates,
    )
    return PowerCampaign(design_power(design, inputs), design, settings.limits)


def _planned_systematic(request: PowerRequest, planned: PlannedTrials) -> tuple[float, str]:
    """Return the systematic error of positions of planned trials, m, and where it comes from."""
    if math.isfinite(request.systematic_mm):
        return request.systematic_mm / 1e3, "stated"
    systematic_m, stated_mm = expected_systematic_m(planned.settings), planned.settings.position_systematic_mm
    if math.isfinite(systematic_m):
        return systematic_m, "lens known from a target" if stated_mm is None else "experiment.yaml"
    longest_m = max((trial.length_m for trial in planned.trials if math.isfinite(trial.length_m)), default=0.0)
    return SYSTEMATIC_OF_TRAVEL * longest_m, "guess: positions by a scale, lens uncorrected"


def _fps_origin(request: PowerRequest, trials: Sequence[Trial]) -> str:
    if math.isfinite(request.capture_fps):
        return "stated"
    return "sheet" if all(math.isfinite(trial.capture_fps) for trial in trials) else "guess"


def _with_yield(trial: Trial, of_vine: Trial) -> Trial:
    """Return the trial with the assumed yield pressure of its vine and the default error, if it states none."""
    from vinetrack.experiment.sheet import YIELD_SIGMA_KPA

    if math.isfinite(trial.yield_pressure_Pa):
        return trial
    default_Pa = 1e3 * YIELD_SIGMA_KPA
    return replace(trial, yield_pressure_Pa=of_vine.yield_pressure_Pa, yield_pressure_sigma_Pa=default_Pa)


@in_one_blas_thread
def power_of_target(request: PowerRequest, given: Fit | Pairs | None = None) -> Power:
    """Calculate the power of the trials by linear theory and, if requested, by diagnoses of simulated campaigns."""
    from vinetrack.core.terminal import waiting

    with waiting("calculating the power of the trials"):
        campaign = campaign_of_target(request) if given is None else campaign_in_memory(request, given)
    names = [text.partition("=")[0] for text in request.effects]
    power = campaign.power
    for name in names:
        if name not in power.not_testable and name not in {entry.effect for entry in power.effects}:
            _refuse_effect(name, power)
    if request.simulate:
        power = replace(power, simulated=tuple(_simulated_rates(request, campaign)))
    if request.recommend:
        power = replace(power, recommended=_recommended_trials(campaign))
    if math.isfinite(request.reach):
        power = replace(power, further=tuple(_further_trials(request, campaign)))
    return power.of_effects(names)


def _further_trials(request: PowerRequest, campaign: PowerCampaign) -> Iterator[FurtherTrials]:
    """Determine the fewest further trials that detect each requested effect of given size."""
    from vinetrack.core.terminal import waiting
    from vinetrack.diagnosis.further_trials import further_trials

    for text in request.effects:
        name, _, size = text.partition("=")
        if not size or name in campaign.power.not_testable:
            remedy = (
                "write the size to detect, such as leak=0.5" if not size else str(campaign.power.not_testable[name])
            )
            message = "needs a size" if not size else "cannot be tested with the columns of these trials"
            raise ExperimentError([Problem(message=message, column="--effect", value=text, remedy=remedy)])
        value = _size_of(text, campaign.power[name])
        with waiting(f"searching for trials that detect {name}"):
            yield further_trials(campaign.design, campaign.power[name], value, request.reach, campaign.limits)


def _recommended_trials(campaign: PowerCampaign) -> InformativeTrials | None:
    """The further trials that would reveal most of what could be missing; None where none can be recommended."""
    from vinetrack.core.terminal import waiting
    from vinetrack.diagnosis.further_trials import exploratory_trials

    with waiting("searching for the trials to make next"):
        return exploratory_trials(campaign.design, campaign.power, campaign.limits)


def sheet_rows(power: Power) -> list[dict[str, object]]:
    """Return the rows of the sheet for the further trials."""
    return [
        {"trial": f"{plan.effect}_{k}" if len(power.further) > 1 else added.trial.name, **sheet_cells(added.trial)}
        for plan in power.further
        for k, added in enumerate(plan.trials, 1)
    ]


def _refuse_effect(name: str, power: Power) -> None:
    """Raise an ExperimentError: the effect is in the model already, or is not a candidate."""
    import difflib

    candidates = [*(entry.effect for entry in power.effects), *power.not_testable]
    close = difflib.get_close_matches(name, candidates, 1, 0.6)
    remedy = f"did you mean {close[0]}?" if close else f"the candidates are {', '.join(sorted(candidates))}"
    in_model = name in power.model
    message = "is in the model already" if in_model else "is not a candidate for these trials"
    raise ExperimentError([Problem(message=message, column="--effect", value=name, remedy=remedy)])


def _simulated_sizes(request: PowerRequest, campaign: PowerCampaign) -> list[tuple[str, float, float]]:
    """Return effect, size in SI and predicted rate of every kind of campaign to simulate, the null campaign first."""
    power = campaign.power
    wanted = [("", math.nan, power.false_alarm_rate)]
    for text in request.effects:
        name, _, size = text.partition("=")
        if name in power.not_testable:
            continue
        entry = power[name]
        sizes = [_size_of(text, entry)] if size else [entry.size_at(0.5), entry.size_at(0.9)]
        wanted += [(name, value, entry.probability_at(value)) for value in sizes if math.isfinite(value)]
    return wanted


def _size_of(text: str, entry: EffectPower) -> float:
    """Read the size in `name=size`; return it in SI."""
    from vinetrack.core.units import display_unit

    unit, factor = display_unit(entry.unit)
    try:
        return float(text.partition("=")[2]) / factor
    except ValueError:
        remedy = f"write a number in {unit or 'the unit of the parameter'}"
        problem = Problem(message="is not a size", column="--effect", value=text, remedy=remedy)
        raise ExperimentError([problem]) from None


def _simulated_rates(request: PowerRequest, campaign: PowerCampaign) -> Iterator[SimulatedRates]:
    """Simulate campaigns of the design and diagnose each in full; yield the rate of each kind."""
    from vinetrack.core.terminal import Progress, progress

    design = replace(
        campaign.design, other_values={entry.effect: entry.other_values for entry in campaign.power.effects}
    )
    seeds = range(request.first_seed, request.first_seed + request.simulate)
    wanted = _simulated_sizes(request, campaign)
    bar: Progress[None]
    with progress(len(wanted) * len(seeds), "simulating", unit="campaign") as bar:
        for effect, value, predicted_rate in wanted:
            diagnoses = []
            for answer in map_unordered(_diagnosed, [(design, effect, value, seed) for seed in seeds], request.jobs):
                diagnoses.append(answer)
                bar.advance()
            yield rates_of(diagnoses, predicted_rate)


def _diagnosed(task: tuple[CampaignDesign, str, float, int]) -> SimulatedDiagnosis:
    return simulated_diagnosis(*task)
