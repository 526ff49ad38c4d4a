"""The command `vinetrack power`: statistical power of the trials of a sheet, an experiment or a results folder."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from vinetrack.core.problems import ExperimentError, Remark
from vinetrack.core.records import SYSTEMATIC_OF_TRAVEL
from vinetrack.core.tables import PROVENANCE
from vinetrack.core.terminal import progress, waiting
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.campaign_power import (
    fitted_tests,
    planned_tests,
    rates_of,
    simulated_diagnosis,
)
from vinetrack.diagnosis.further_trials import further_trials
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.power import Power, PowerInput, SimulatedRates
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.dynamics.model import Model, host_for, make_model
from vinetrack.effects import BASE_EFFECTS
from vinetrack.experiment.folder import Experiment, planned_sheet, read_experiment
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import Limits
from vinetrack.experiment.sheet import YIELD_SIGMA_KPA, expected_systematic_m
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs, pairs_of
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit
from vinetrack.pipeline.effects_stage import effects_of
from vinetrack.pipeline.predict_stage import effects_of_plan, refusal
from vinetrack.pipeline.stages import map_unordered
from vinetrack.planning.predictive_inputs import StatedValues, predictive_inputs
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
    experiment: Path | None = None

    def scatter(
        self, noise: Sequence[float], of_noise: str, spreads: Sequence[float], of_spreads: str
    ) -> tuple[tuple[float, float], tuple[float, float], list[PowerInput]]:
        """Noise of a position, m, with its correlation, and standard deviations of pressure and B between trials: each
        as stated, else as given here; and both in words with where they come from.
        """
        stated = np.array([[self.noise_mm / 1e3, self.noise_correlation], [self.spread_P, self.spread_B]])
        (sigma_m, correlation), (of_P, of_B) = np.where(np.isnan(stated), [noise, spreads], stated).tolist()
        origins = np.where(np.isnan(stated).all(axis=1), [of_noise, of_spreads], "stated").tolist()
        inputs = [
            PowerInput("noise of a position", f"{1e3 * sigma_m:.3g} mm, correlation {correlation:.2f}", origins[0]),
            PowerInput("spread of pressure from trial to trial", f"{100 * of_P:.2g} %", origins[1]),
            PowerInput("spread of B from trial to trial", f"{100 * of_B:.2g} %", origins[1]),
        ]
        return (sigma_m, correlation), (of_P, of_B), inputs


# Tests, what cannot be tested and why, the quantities assumed, and constraints on further trials
Campaign = tuple[MisfitTests, Mapping[str, Remark], list[PowerInput], Limits]


def _campaign_of_target(request: PowerRequest) -> Campaign:
    """Return the campaign of the measured trials of a results folder or an experiment; without any, of the planned."""
    target, added = request.target, tuple[str, ...]()
    experiment: Experiment | None = None
    if (target / PROVENANCE).exists():
        results, experiment = Results(target), read_source_experiment(target, request.experiment)
        diagnosis = read_diagnosis(results)
        if diagnosis is not None and diagnosis.final_verdict == ADEQUATE:
            added = diagnosis.effects
        pairs: Pairs = measured_trials(experiment, results)[0]
    else:
        with suppress(ExperimentError):  # recordings that do not exist yet: a plan
            experiment = read_experiment(target) if target.is_dir() else None
        if experiment is None or all(trial.track is None for trial in experiment.trials):
            return _planned_campaign(request, planned_sheet(target, every_row=True))
        pairs = pairs_of(experiment)[0]
    settings = experiment.settings
    names = dict.fromkeys((*settings.model, *added))
    model = make_model(names, effects_of(experiment.folder) if settings.effects else {})
    return _measured_campaign(request, model, pairs, settings.candidates, settings.limits)


def _measured_campaign(
    request: PowerRequest, model: Model, pairs: Pairs, candidates: Sequence[str] | None, limits: Limits
) -> Campaign:
    """Return the campaign of measured trials, with noise and scatter from the options, else from a fit."""
    host = host_for(model, candidates_of(model, candidates, model.user_effects))
    fitted = fit(model, pairs, host=host, profile=False, thorough=False)
    noise, spreads, inputs = request.scatter(
        (fitted.noise_m, fitted.noise_correlation), "fit", fitted.state.spread, "fit"
    )
    of_points = noise if inputs[0].origin == "stated" else None
    of_trials = spreads if inputs[1].origin == "stated" else None
    if of_points or of_trials:
        fitted = fit(model, pairs, spreads=of_trials, noise=of_points, host=host, profile=False, thorough=False)
    else:
        inputs = []
    return *fitted_tests(fitted, candidates), inputs, limits


def _planned_campaign(request: PowerRequest, planned: Experiment) -> Campaign:
    """Return the campaign of planned trials; B, n and yield pressure are stated, published, or from scaling laws."""
    settings = planned.settings
    stated = StatedValues(B=request.B, n=request.n, model=settings.model, user_effects=effects_of_plan(planned))
    of_vines = {trial.vine: trial for trial in reversed(planned.trials)}
    by_vine = {trial.vine: predictive_inputs(of_vines[trial.vine], stated) for trial in planned.trials}
    first = next(iter(by_vine.values()))
    # 1e-4: noise of a position, m (chosen)
    usual = "guess: a usual batch of vines"
    noise, spreads, inputs = request.scatter((1e-4, 0.0), "guess", first.spreads, usual)
    systematic_m, systematic_origin = _planned_systematic(request, planned)
    trials, rates = [], []
    for trial in planned.trials:
        if not math.isfinite(trial.yield_pressure_Pa):
            assumed_Pa = by_vine[trial.vine].trial.yield_pressure_Pa
            trial = replace(trial, yield_pressure_Pa=assumed_Pa, yield_pressure_sigma_Pa=1e3 * YIELD_SIGMA_KPA)
        trials.append(replace(trial, position_systematic_m=systematic_m))
        known = (request.capture_fps, trial.capture_fps, 1069.0)  # the last: chosen
        rates.append(next(filter(math.isfinite, known)))
    is_in_sheet = all(math.isfinite(trial.capture_fps) for trial in trials)
    fps_origin = "stated" if math.isfinite(request.capture_fps) else "sheet" if is_in_sheet else "guess"
    inputs += [
        PowerInput("systematic error of positions", f"{1e3 * systematic_m:.3g} mm", systematic_origin),
        PowerInput("frame rate", f"{rates[0]:g} /s", fps_origin),
        *(
            PowerInput(f"{symbol} of {vine}", f"{of_vine.medians[key]:.3g}", str(of_vine.origins[key]))
            for vine, of_vine in by_vine.items()
            for symbol, key in (("B", DAMPING), ("n", EXPONENT))
        ),
    ]
    model = first.model.with_values({DAMPING: {vine: of_vine.medians[DAMPING] for vine, of_vine in by_vine.items()}})
    return *planned_tests(model, trials, rates, spreads, noise, settings.candidates), inputs, settings.limits


def _planned_systematic(request: PowerRequest, planned: Experiment) -> tuple[float, str]:
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
            campaign = _campaign_of_target(request)
        elif isinstance(given, Fit):
            campaign = (*fitted_tests(given), [], Limits())
        else:
            campaign = _measured_campaign(request, make_model(BASE_EFFECTS), list(given), None, Limits())
        tests, not_testable, inputs, limits = campaign
        now = power_of(tests, not_testable, inputs, nonlinear=True)
    power, asked = now, [_asked(text, now) for text in request.effects]
    if request.simulate:
        power = replace(power, simulated=tuple(_simulated_rates(request, tests, now, asked)))
    if math.isfinite(request.reach):
        for text, (name, value) in zip(request.effects, asked, strict=True):
            if name in power.not_testable:
                why = str(power.not_testable[name])
                raise refusal("--effect", text, "cannot be tested with the columns of these trials", why)
            if not math.isfinite(value):
                raise refusal("--effect", text, "needs a size", "write the size to detect, such as leak=0.5")
            with waiting(f"searching for trials that detect {name}"):
                plan = further_trials(tests, power[name], value, request.reach, limits)
            power = replace(power, further=(*power.further, plan))
    return power.of_effects([name for name, _ in asked])


def _asked(text: str, power: Power) -> tuple[str, float]:
    """Read `name` or `name=size`: the effect, and its size in SI, NaN where none is given."""
    name, _, size = text.partition("=")
    if name in power.not_testable:
        return name, math.nan
    known = {entry.effect: entry.unit for entry in power.effects}
    if name not in known:
        candidates = sorted([*known, *power.not_testable])
        close = difflib.get_close_matches(name, candidates, 1, 0.6)
        remedy = f"did you mean {close[0]}?" if close else f"the candidates are {', '.join(candidates)}"
        message = "is in the model already" if name in power.model else "is not a candidate for these trials"
        raise refusal("--effect", name, message, remedy)
    unit, factor = display_unit(known[name])
    try:
        return name, float(size or "nan") / factor
    except ValueError:
        remedy = f"write a number in {unit or 'the unit of the parameter'}"
        raise refusal("--effect", text, "is not a size", remedy) from None


def sheet_rows(power: Power) -> list[dict[str, object]]:
    """Return the rows of the sheet for the further trials."""
    return [
        {
            "trial": f"{plan.power.effect if len(power.further) > 1 else 'added'}_{k}",
            **{name: value for name, value in trial.items() if name in COLUMNS},
        }
        for plan in power.further
        for k, trial in enumerate(plan.trials, 1)
    ]


def _simulated_rates(
    request: PowerRequest, tests: MisfitTests, power: Power, asked: Sequence[tuple[str, float]]
) -> Iterator[SimulatedRates]:
    """Simulate campaigns like that of the tests, diagnose each in full; yield the rate of each kind, the null first."""
    wanted: list[tuple[str, tuple[float, ...], float]] = [("", (math.nan,), power.false_alarm_rate)]
    for entry, size in ((power[name], size) for name, size in asked if name not in power.not_testable):
        sizes = [size] if math.isfinite(size) else [entry.size_at(0.5), entry.size_at(0.9)]
        known = filter(math.isfinite, sizes)
        wanted += [(entry.effect, (value, *entry.other_values), entry.probability_at(value)) for value in known]
    seeds = range(request.first_seed, request.first_seed + request.simulate)
    for effect, values, predicted_rate in wanted:
        done = map_unordered(partial(simulated_diagnosis, tests, effect, values), seeds, request.jobs)
        diagnoses = list(progress(done, f"campaigns with {effect or 'nothing missing'}", len(seeds)))
        yield rates_of(effect, diagnoses, values[0], predicted_rate)
