"""The command `vinetrack power`: statistical power of the trials of a sheet, an experiment or a results folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.blas_threads import in_one_blas_thread
from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.diagnosis.campaign_power import design_of_fit
from vinetrack.diagnosis.null_calibration import NullCalibration, calibrate, p_values_of
from vinetrack.diagnosis.power import EffectPower, FurtherTrials, Power, SimulatedRates, sheet_cells
from vinetrack.diagnosis.simulated_power import rates_of
from vinetrack.effects import BASE_EFFECTS
from vinetrack.experiment.provenance import PROVENANCE
from vinetrack.pipeline.power_campaigns import (
    MeasuredTrials,
    PowerCampaign,
    PowerRequest,
    campaign_in_memory,
    campaign_of_target,
    measured_campaign,
    trials_of_target,
)
from vinetrack.pipeline.simulated_answers import Simulation, simulate_answers, simulate_null_tests, size_key

if TYPE_CHECKING:
    from vinetrack.diagnosis.stopping import CampaignLook
    from vinetrack.inference.fit_data import Pairs
    from vinetrack.inference.fit_result import Fit


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
    if request.calibrate:
        power = replace(power, calibration=_null_calibration(request, given))
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
            remedy = "write the size to detect, such as leak=0.5" if not size else campaign.power.not_testable[name]
            message = "needs a size" if not size else "cannot be tested with the columns of these trials"
            raise ExperimentError([Problem(message=message, column="--effect", value=text, remedy=remedy)])
        value = _size_of(text, campaign.power[name])
        with waiting(f"searching for trials that detect {name}"):
            yield further_trials(campaign.design, campaign.power[name], value, request.reach, campaign.limits)


def recommended_trials(target: Path, experiment: Path | None, look: CampaignLook) -> str:
    """Recommend the further trials of a campaign that goes on, in words; blank where none can be recommended."""
    from vinetrack.core.terminal import waiting
    from vinetrack.diagnosis.informative_trials import confirming_trials, exploratory_trials
    from vinetrack.narrative.further_text import informative_text

    request = PowerRequest(target=target, experiment=experiment)
    measured = trials_of_target(request)
    if measured is None:
        return ""
    names = tuple(name for name in measured.names if name not in look.names)
    with waiting("searching for the trials to make next"):
        campaign = measured_campaign(request, replace(measured, names=names))
        design, power = campaign.design, campaign.power
        named = look.names[0] if look.names else ""
        rival = look.rival if look.rival in {entry.effect for entry in power.effects} else ""
        if named:
            plan = confirming_trials(design, power, named, rival, campaign.limits)
        else:
            plan = exploratory_trials(design, power, campaign.limits)
    return "" if plan is None else informative_text(plan, named, rival)


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
    """Simulate and diagnose campaigns; yield the rate of each kind. Answers of an earlier run are reused."""
    wanted = _simulated_sizes(request, campaign)
    simulation = Simulation(
        request.simulate, request.first_seed, request.jobs, request.answers or _answers_file(request.target)
    )
    design = replace(
        campaign.design, other_values={entry.effect: entry.other_values for entry in campaign.power.effects}
    )
    answers = simulate_answers(design, [(effect, value) for effect, value, _ in wanted], simulation)
    for effect, value, predicted_rate in wanted:
        yield rates_of([answers[effect, size_key(value), seed] for seed in simulation.seeds], predicted_rate)


def _null_calibration(request: PowerRequest, given: Fit | Pairs | None) -> NullCalibration:
    """Calibrate the tests of the first model of measured trials with simulated null campaigns of the same design."""
    from vinetrack.diagnosis.candidates import testable
    from vinetrack.diagnosis.initial_fit import candidates_of, initial_fit, with_host
    from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, misfit_tests
    from vinetrack.dynamics.host import host_for
    from vinetrack.dynamics.model import make_model
    from vinetrack.inference.fit_result import Fit

    candidates: Sequence[str] | None = None
    if isinstance(given, Fit):
        questioned = candidates_of(given.model, None, given.model.user_effects)
        fitted = with_host(given, host_for(given.model, questioned))
    else:
        measured = trials_of_target(request) if given is None else MeasuredTrials(list(given), BASE_EFFECTS)
        if measured is None:
            problem = Problem(
                message="needs measured trials", column="--calibrate", value=str(request.target),
                remedy="run the trials first, or estimate the false-alarm rate with --simulate",
            )  # fmt: skip
            raise ExperimentError([problem])
        names = tuple(name for name in measured.names if name not in measured.added)
        model, candidates = make_model(names, measured.user_effects), measured.candidates
        questioned = candidates_of(model, candidates, measured.user_effects)
        fitted = initial_fit(model, measured.pairs, questioned, profile=False)
    effects, _ = testable(questioned, fitted.predictor.data)
    observed = p_values_of(misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND))
    path = request.answers or _answers_file(request.target)
    path = path.with_name(f"{path.stem}_calibration.csv")
    simulation = Simulation(request.calibrate, request.first_seed, request.jobs, path)
    return calibrate(observed, simulate_null_tests(design_of_fit(fitted, candidates), simulation), fitted.model.names)


def _answers_file(target: Path) -> Path:
    """Return the file of simulated answers: in the results folder, else in the working directory."""
    if (target / PROVENANCE).exists():
        return target / "power_answers.csv"
    name = target.resolve().name if target.is_dir() else target.stem
    return Path(f"power_answers_{name}.csv")
