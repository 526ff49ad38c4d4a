"""The next experiment: the trials that best separate hypotheses which the trials so far cannot tell apart.

    found = next_experiment([fit_with_drag, fit_with_inlet_loss], limits)
    print(found.text)

Every condition within the limits is rated by linear theory, and the best set of trials found by exchange. Its
separation is predicted by refitting simulated trials; as a check, the trials are simulated again with the true
parameters and all noise drawn anew. Where no trials help, or only measurements are in question, the advice is what to
measure instead.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.diagnosis.remarks import Remark, remark
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.experiment.settings import Limits
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.planning.discriminating_design import (
    NEW_VINE,
    OTHER_RIG,
    SAME_RIG,
    Condition,
    RefitTerms,
    best_design,
    best_new_vines,
    extend,
    feasible_conditions,
    growth_courses,
    refit_terms,
    sampling_of,
    worth,
)
from vinetrack.planning.simulated_campaigns import DesignProblem, mean_separation, simulated_rises

__all__ = ["Limits", "NextExperiment", "next_experiment"]


# Separation, in standard deviations, beyond which no further effort, such as making a new vine, is recommended (chosen)
SUFFICIENT_SEPARATION = 8.0


NO_FURTHER_EFFECT = "nothing more"  # Name of the hypothesis whose effects all other hypotheses share

CHECK_DRAWS = {2: 3, 3: 2}  # Draws of the check by number of hypotheses, otherwise one (chosen)


@dataclass(frozen=True)
class NextExperiment:
    """The recommended next trials. `trials` has an entry for each condition: the columns of the sheet that may be
    chosen (`schema.LIMITED`; NaN where the sheet is blank), `replicates`, `vine`, `new_vine` and `changed`, the names
    of what differs from the rig so far.
    """

    advice: Remark
    trials: tuple[Mapping[str, Any], ...] = ()
    separation_sigma: Mapping[str, float] = field(default_factory=dict)
    if_true_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    simulated_sigma: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    alternatives: tuple[Mapping[str, Any], ...] = ()
    measurement: Remark = field(default_factory=Remark)

    @property
    def text(self) -> str:
        """The advice in words."""
        return str(self.advice)

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it; unknown values are null."""
        content: dict[str, Any] = _without_nan(
            {
                "text": self.text,
                "trials": [dict(trial) for trial in self.trials],
                "separation_sigma": dict(self.separation_sigma),
                "if_true_sigma": {pair: dict(ways) for pair, ways in self.if_true_sigma.items()},
                "simulated_sigma": {
                    pair: {"mean": mean, "sd": sd} for pair, (mean, sd) in self.simulated_sigma.items()
                },
                "alternatives": [dict(other) for other in self.alternatives],
                "calibration": str(self.measurement) or None,
            }
        )
        return content


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class _Option:
    """A set of trials (indices of conditions, one a trial) and the expected rises of −2 ln L, see `simulated_rises`."""

    design: tuple[int, ...]
    rises: Floats

    @property
    def separations(self) -> Floats:
        return mean_separation(self.rises)

    @property
    def worth(self) -> float:
        return float(worth(self.separations[None])[0])

    @property
    def weakest(self) -> float:
        return min(_by_pair(self.separations).values())


@in_one_blas_thread
def next_experiment(tied: Sequence[Fit], limits: Limits | None = None, *, seed: int = 0) -> NextExperiment:
    """Recommend trials that separate hypotheses which fit the same trials equally well."""
    limits = limits or Limits()
    _check_fits(tied)
    # 5: most hypotheses that a design separates (chosen)
    tied = list(tied)[:5]
    names = _hypothesis_names(tied)
    measurement = _deciding_measurements(list(itertools.combinations(tied, 2)))
    if _only_measurement(tied):
        faults = [name for name in names if name != NO_FURTHER_EFFECT]
        return NextExperiment(remark("measure_first", faults=faults, measurement=measurement), measurement=measurement)
    bench, terms = _feasible_trials(tied, names, limits)
    options = _options(bench, terms, limits, seed)
    if not options:
        return NextExperiment(remark("no_feasible_trial", measurement=measurement), measurement=measurement)
    return _recommendation(bench, options, seed)


def effects_between(first: Fit, second: Fit) -> tuple[list[Effect], list[Effect]]:
    """Return the effects that only the first model has, and those that only the second has. Returns only_first,
    only_second : list of Effect.
    """
    return (
        [effect for effect in first.model if effect.name not in second.model],
        [effect for effect in second.model if effect.name not in first.model],
    )


def _only_measurement(tied: Sequence[Fit]) -> bool:
    """Return whether the hypotheses differ only in faults of the measurement."""
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    differ = [effect for fit in tied for effect in fit.model if effect.name not in common]
    return bool(differ) and all(effect.kind == "measurement" for effect in differ)


def _deciding_measurements(pairs: Sequence[tuple[Fit, Fit]]) -> Remark:
    """What to measure in order to exclude one of each pair of hypotheses: the effects whose files say so. Where a fault
    of the measurement is among them, a calibration decides, and only the calibration is named.
    """
    trace_decides = False
    effects: dict[str, Effect] = {}
    for pair in pairs:
        only_first, only_second = effects_between(*pair)
        trace_decides |= any(e.in_trace for e in only_first) != any(e.in_trace for e in only_second)
        effects.update({effect.name: effect for effect in [*only_first, *only_second]})
    measured = [effect for effect in effects.values() if effect.kind == "measurement"]
    if not (trace_decides or effects):
        return Remark()
    facts = {"trace_decides": trace_decides, "effects": measured or list(effects.values())}
    return Remark("deciding_measurements", {**facts, "faults_only": bool(measured)})


def _check_fits(tied: Sequence[Fit]) -> None:
    if len(tied) < 2:
        raise FitError("A next experiment needs at least two hypotheses to separate: give at least two fits.")
    names = [[trial_data.trial.name for trial_data in fit.predictor.data] for fit in tied]
    if any(others != names[0] for others in names[1:]):
        raise FitError("The fits to separate are not of the same trials: fit all hypotheses to the same trials.")


def _hypothesis_names(tied: Sequence[Fit]) -> list[str]:
    """Each hypothesis named by the effects that not all of them have, numbered where that is ambiguous."""
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    names = [" + ".join(name for name in fit.model.names if name not in common) or NO_FURTHER_EFFECT for fit in tied]
    return [name if names.count(name) == 1 else f"{name} ({k + 1})" for k, name in enumerate(names)]


def _feasible_trials(
    tied: Sequence[Fit], names: Sequence[str], limits: Limits
) -> tuple[DesignProblem, list[RefitTerms]]:
    """The hypotheses and conditions that can be simulated, and the quadratic forms of −2 ln L of a trial of each."""
    data = tied[0].predictor.data
    feasible = feasible_conditions([trial_data.trial for trial_data in data], limits)
    if not feasible:
        return DesignProblem((), (), ()), []
    cameras = [sampling_of(data, condition.like) for condition in feasible]
    runs = growth_courses(
        [extend(fit, name, feasible) for fit, name in zip(tied, names, strict=True)], feasible, cameras
    )
    usable = [
        (condition, camera, run)
        for condition, camera, run in zip(feasible, cameras, runs, strict=True)
        if run is not None
    ]
    if not usable:
        return DesignProblem((), (), ()), []
    chosen, samplings, courses = (list(column) for column in zip(*usable, strict=True))
    hypotheses = [extend(fit, name, chosen) for fit, name in zip(tied, names, strict=True)]
    try:
        return DesignProblem(hypotheses, chosen, samplings), refit_terms(hypotheses, chosen, samplings, courses)
    except SimulationError as error:
        raise FitError(f"Further trials cannot be simulated under every hypothesis: {error}") from error


def _options(bench: DesignProblem, terms: list[RefitTerms], limits: Limits, seed: int) -> list[_Option]:
    """The best set of trials for each level of effort that gains over the lower ones, with its expected separation. One
    level beyond a sufficient one is computed as well, for comparison.
    """
    options: list[_Option] = []
    before = -math.inf
    for allowed in _conditions_by_effort(bench, terms, limits.trials):
        if any(option.weakest >= SUFFICIENT_SEPARATION for option in options[:-1]):
            break
        design, predicted = best_design(terms, allowed, limits.trials)
        # 1.01: factor by which the worth of a design must exceed that with less effort for it to be
        # considered (chosen)
        if predicted > 1.01 * before:
            before = predicted
            options.append(_Option(tuple(design.tolist()), simulated_rises(bench, design.tolist(), [0], seed)))
    return options


def _conditions_by_effort(bench: DesignProblem, terms: list[RefitTerms], trials: int) -> Iterator[NDArray[np.int_]]:
    """Conditions to choose from: with the rig so far, with another rig as well, and with one new vine as well."""
    efforts = np.array([condition.effort for condition in bench.conditions])
    for effort in (SAME_RIG, OTHER_RIG):
        if (efforts == effort).any():
            yield np.flatnonzero(efforts <= effort)
    new = np.flatnonzero(efforts == NEW_VINE)
    if new.size:
        vines = np.array([condition.trial.vine for condition in bench.conditions])
        # 2: new vines that are tried, at most (chosen)
        most = 2 if len(terms) == 2 else 1
        for vine in best_new_vines(terms, bench.conditions, new, trials, most):
            yield np.flatnonzero((efforts < NEW_VINE) | (vines == vine))


def _by_pair(separations: Floats) -> dict[tuple[int, int], float]:
    """The smaller separation of the two directions, by pair."""
    return {
        (a, b): float(min(separations[a, b], separations[b, a]))
        for a, b in itertools.combinations(range(len(separations)), 2)
    }


def _recommended(options: Sequence[_Option]) -> _Option:
    """The option of least effort that is sufficient, else the best."""
    for option in options:
        if option.weakest >= SUFFICIENT_SEPARATION:
            return option
    return max(options, key=lambda option: option.worth)


def _recommendation(bench: DesignProblem, options: Sequence[_Option], seed: int) -> NextExperiment:
    least_separation = 3.0  # Separation, in standard deviations, below which trials are not recommended (chosen)
    best = _recommended(options)
    best = _Option(best.design, np.concatenate([best.rises, simulated_rises(bench, best.design, [1], seed)]))
    names = [hypothesis.name for hypothesis in bench.hypotheses]
    expected_sigma = _by_pair(best.separations)
    worth_it = max(expected_sigma.values()) >= least_separation
    # 20.0: separation, in standard deviations, beyond which the check takes one draw less (chosen)
    draws = max(CHECK_DRAWS.get(len(names), 1) - (min(expected_sigma.values()) > 20.0), 1)
    simulated = {}
    if worth_it:
        simulated = _simulated_separations(simulated_rises(bench, best.design, range(draws), seed, thorough=True))
    unresolved = [
        pair
        for pair, sigma in expected_sigma.items()
        if min(sigma, simulated.get(pair, (sigma,))[0]) < least_separation
    ]
    worth_it = worth_it and len(unresolved) < len(expected_sigma)
    fits = [hypothesis.fit for hypothesis in bench.hypotheses]
    pairs = [(fits[a], fits[b]) for a, b in unresolved or _separable_by_measurement(fits)]
    measurement = _deciding_measurements(pairs)
    sigmas = {_pair_name(names, pair): sigma for pair, sigma in expected_sigma.items()}
    simulated_by_name = {_pair_name(names, pair): mean_and_sd for pair, mean_and_sd in simulated.items()}
    trials = trial_entries(bench.conditions, best.design)
    if_true = {
        _pair_name(names, (a, b)): {names[a]: float(best.separations[a, b]), names[b]: float(best.separations[b, a])}
        for a, b in expected_sigma
    }
    return NextExperiment(
        advice=remark(
            "trials_to_make" if worth_it else "no_trials_separate",
            trials=trials,
            if_true=if_true,
            simulated=simulated_by_name,
            unresolved=[_pair_name(names, pair) for pair in unresolved],
            measurement=measurement,
            least_sigma=least_separation,
        ),
        trials=trials if worth_it else (),
        separation_sigma=sigmas,
        if_true_sigma=if_true,
        simulated_sigma=simulated_by_name,
        alternatives=tuple(
            {
                "trials": [dict(entry) for entry in trial_entries(bench.conditions, option.design)],
                "separation_sigma": {_pair_name(names, p): s for p, s in _by_pair(option.separations).items()},
            }
            for option in sorted(options, key=lambda ranked: -ranked.worth)
            if option.design != best.design
        ),
        measurement=measurement,
    )


def _separable_by_measurement(fits: Sequence[Fit]) -> list[tuple[int, int]]:
    """Pairs that a measurement would decide as well as trials: those with a measurement effect in only one of them."""
    kinds = [{effect.kind for effect in fit.model} for fit in fits]
    pairs = itertools.combinations(range(len(fits)), 2)
    return [(a, b) for a, b in pairs if "measurement" in kinds[a] ^ kinds[b]]


def _simulated_separations(rises: Floats) -> dict[tuple[int, int], tuple[float, float]]:
    """Mean and standard deviation of the simulated separations by pair, in the direction that separates less."""
    sigma = np.sqrt(np.maximum(rises, 0.0))
    simulated = {}
    for a, b in itertools.combinations(range(rises.shape[1]), 2):
        directions = [draws[np.isfinite(draws)] for draws in (sigma[:, a, b], sigma[:, b, a])]
        directions = [draws for draws in directions if draws.size]
        if directions:
            least = min(directions, key=lambda draws: float(np.mean(draws)))
            simulated[(a, b)] = (float(np.mean(least)), float(np.std(least, ddof=1)) if least.size > 1 else math.nan)
    return simulated


def _pair_name(names: Sequence[str], pair: tuple[int, int]) -> str:
    return f"{names[pair[0]]} | {names[pair[1]]}"


def trial_entries(every: Sequence[Condition], design: Sequence[int]) -> tuple[dict[str, Any], ...]:
    """Return the trials of a design as entries of `next_experiment`, one for each condition."""
    return tuple(
        _entry(every[index], int(count))
        for index, count in zip(*np.unique(np.array(design), return_counts=True), strict=True)
    )


def _entry(condition: Condition, replicates: int) -> dict[str, Any]:
    trial = condition.trial
    settings = {name: COLUMNS[name].of_trial(trial) for name in (*LIMITED["range"], *LIMITED["choice"])}
    return {
        **{name: float(f"{value:.6g}") for name, value in settings.items()},
        "replicates": replicates,
        "vine": trial.vine,
        "new_vine": condition.effort == NEW_VINE,
        "changed": list(condition.changed),
    }
