"""The next experiment: the trials that best separate hypotheses which the trials so far cannot tell apart.

    found = next_experiment([fit_with_drag, fit_with_inlet_loss], limits)
    print(found.text)

Every trial within the limits is looked at by sensitivities, the best set of them found by exchange, and what it will
bring predicted by refitting simulated trials; then the trials are simulated once more, truth and all drawn anew, as a
check. Where no trials help, or only measurements are in doubt, it says what to measure instead.
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
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.settings import Limits
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.narrative.plan_text import calibration_for, entries, in_words, only_measurement, outlook
from vinetrack.narrative.verdict_summary import joined
from vinetrack.planning.design_simulation import Bench, expected, observed, separation
from vinetrack.planning.discriminating_design import RefitTerms, best_design, best_new_vines, refit_terms, worth
from vinetrack.planning.feasible_trials import NEW_VINE, OTHER_RIG, SAME_RIG, conditions
from vinetrack.planning.hypothesis_predictions import carry
from vinetrack.planning.simulated_tracks import camera_of, courses

__all__ = ["Limits", "NextExperiment", "next_experiment"]

SEPARATES = 3.0
"""Standard deviations below which trials are not worth making for the purpose."""

ENOUGH = 8.0
"""Standard deviations beyond which no more effort, such as a vine that has to be made, is asked for."""

MOST_HYPOTHESES = 5
"""Hypotheses that a design separates at most. Chosen for time: pairs grow with the square."""

NOTHING = "nothing more"
"""Name of the hypothesis that has no effect which others have not as well."""

DRAWS_OBSERVED = {2: 3, 3: 2}
"""Draws of the check by number of hypotheses, else one: every draw takes as many refits as that number squared."""

PLAIN = 20.0
"""Standard deviations beyond which one draw less will do."""

GAIN = 1.01
"""Gain in separation for which a trial is exchanged, and new vines tried at most. Chosen for time."""

MOST_VINES_TRIED = 2
"""Chosen for time, see above."""


@dataclass(frozen=True)
class NextExperiment:
    """What to do next.

    `trials` has an entry a condition: the columns of the sheet that may be chosen (`schema.LIMITED`; NaN where the
    sheet is blank), `replicates`, `vine`, `new_vine` and `changed`, the names of what differs from the rig so far.
    Empty where no trials are recommended.

    `separation_sigma` holds, by pair (`"a | b"`), the separation to expect once the trials are made and all are fitted
    together, in standard deviations: the smaller of what it is if a is true and if b is true, which `if_true_sigma`
    gives by pair and name. `simulated_sigma` holds mean and standard deviation of what the check by simulation gave, of
    the smaller again. `alternatives` are the next best sets of trials with their separations. `calibration` says what
    to measure, where that is needed or would do as well.
    """

    text: str
    trials: tuple[Mapping[str, Any], ...] = ()
    separation_sigma: Mapping[str, float] = field(default_factory=dict)
    if_true_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    simulated_sigma: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    alternatives: tuple[Mapping[str, Any], ...] = ()
    calibration: str | None = None

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it; what is not known is null."""
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
                "calibration": self.calibration,
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
    """A set of trials (places among the conditions, one a trial) and how −2 ln L should rise; see `expected`."""

    design: tuple[int, ...]
    rises: Floats

    @property
    def between(self) -> Floats:
        return separation(self.rises)

    @property
    def worth(self) -> float:
        return float(worth(self.between[None])[0])

    @property
    def weakest(self) -> float:
        return min(_by_pair(self.between).values())


def next_experiment(tied: Sequence[Fit], limits: Limits | None = None, *, seed: int = 0) -> NextExperiment:
    """What to do to tell hypotheses apart that the same trials fit alike.

    Parameters
    ----------
    tied : sequence of Fit
        Fits of two hypotheses or more to the same trials, most likely first; of more than five the first five count.
    limits : Limits, optional
        Within what further trials can be made; what it leaves open follows the trials so far.
    seed : int
        Of the random numbers of the simulated trials.

    Returns
    -------
    NextExperiment

    Raises
    ------
    FitError
        If there are fewer than two fits, they are not of the same trials, or what they say of further trials cannot be
        simulated.
    """
    limits = limits or Limits()
    _judge(tied)
    tied = list(tied)[:MOST_HYPOTHESES]
    names = _hypothesis_names(tied)
    if only_measurement(tied):
        advice = calibration_for(list(itertools.combinations(tied, 2)))
        faults = [name for name in names if name != NOTHING]
        are = "are errors" if len(faults) > 1 else "is an error"
        text = f"Measure before making more trials: {joined(faults)} {are} of measurement. {advice}"
        return NextExperiment(text=text, calibration=advice)
    bench, sides = _bench(tied, names, limits)
    options = _options(bench, sides, limits, seed)
    if not options:
        advice = calibration_for(list(itertools.combinations(tied, 2)))
        return NextExperiment(text=f"No trial within the limits can be made and followed. {advice}", calibration=advice)
    return _conclude(bench, options, seed)


def _judge(tied: Sequence[Fit]) -> None:
    if len(tied) < 2:
        raise FitError("A next experiment needs two hypotheses to tell apart: give the fits of at least two.")
    names = [[trial_data.trial.name for trial_data in fit.predictor.data] for fit in tied]
    if any(others != names[0] for others in names[1:]):
        raise FitError("The fits to tell apart are not of the same trials: fit all of them to one set.")


def _hypothesis_names(tied: Sequence[Fit]) -> list[str]:
    """Each hypothesis by the effects that not all of them have, numbered where that is not enough."""
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    names = [" + ".join(name for name in fit.model.names if name not in common) or NOTHING for fit in tied]
    return [name if names.count(name) == 1 else f"{name} ({k + 1})" for k, name in enumerate(names)]


def _bench(tied: Sequence[Fit], names: Sequence[str], limits: Limits) -> tuple[Bench, list[RefitTerms]]:
    """Hypotheses, every condition worth filming, and what a trial of each would answer."""
    data = tied[0].predictor.data
    every = conditions([trial_data.trial for trial_data in data], limits)
    if not every:
        return Bench((), (), ()), []
    cameras = [camera_of(data, condition.like) for condition in every]
    runs = courses([carry(fit, name, every) for fit, name in zip(tied, names, strict=True)], every, cameras)
    kept = [
        (condition, lens, run) for condition, lens, run in zip(every, cameras, runs, strict=True) if run is not None
    ]
    if not kept:
        return Bench((), (), ()), []
    chosen, lenses, ways = (list(column) for column in zip(*kept, strict=True))
    hypotheses = [carry(fit, name, chosen) for fit, name in zip(tied, names, strict=True)]
    try:
        return Bench(hypotheses, chosen, lenses), refit_terms(hypotheses, chosen, lenses, ways)
    except SimulationError as error:
        raise FitError(f"Further trials cannot be followed by every hypothesis: {error}") from error


def _options(bench: Bench, sides: list[RefitTerms], limits: Limits, seed: int) -> list[_Option]:
    """The best set of trials by every effort that gains over the lesser ones, with what to expect of it.

    One effort beyond what is enough is looked at, to have something to compare with.
    """
    options: list[_Option] = []
    before = -math.inf
    for allowed in _by_effort(bench, sides, limits.trials):
        if any(option.weakest >= ENOUGH for option in options[:-1]):
            break
        design, predicted = best_design(sides, allowed, limits.trials)
        if predicted > GAIN * before:
            before = predicted
            options.append(_Option(tuple(design.tolist()), expected(bench, design.tolist(), [0], seed)))
    return options


def _by_effort(bench: Bench, sides: list[RefitTerms], trials: int) -> Iterator[NDArray[np.int_]]:
    """Conditions to choose from: on the rig so far, on others too, and with one or another new vine besides."""
    efforts = np.array([condition.effort for condition in bench.conditions])
    for effort in (SAME_RIG, OTHER_RIG):
        if (efforts == effort).any():
            yield np.flatnonzero(efforts <= effort)
    new = np.flatnonzero(efforts == NEW_VINE)
    if new.size:
        vines = np.array([condition.trial.vine for condition in bench.conditions])
        most = MOST_VINES_TRIED if len(sides) == 2 else 1
        for vine in best_new_vines(sides, bench.conditions, new, trials, most):
            yield np.flatnonzero((efforts < NEW_VINE) | (vines == vine))


def _by_pair(between: Floats) -> dict[tuple[int, int], float]:
    """The smaller separation of both directions, by pair."""
    return {(a, b): float(min(between[a, b], between[b, a])) for a, b in itertools.combinations(range(len(between)), 2)}


def _choice(options: Sequence[_Option]) -> _Option:
    """The least effort that is enough, else the best."""
    for option in options:
        if option.weakest >= ENOUGH:
            return option
    return max(options, key=lambda option: option.worth)


def _conclude(bench: Bench, options: Sequence[_Option], seed: int) -> NextExperiment:
    best = _choice(options)
    best = _Option(best.design, np.concatenate([best.rises, expected(bench, best.design, [1], seed)]))
    names = [hypothesis.name for hypothesis in bench.hypotheses]
    to_expect = _by_pair(best.between)
    worth_it = max(to_expect.values()) >= SEPARATES
    draws = max(DRAWS_OBSERVED.get(len(names), 1) - (min(to_expect.values()) > PLAIN), 1)
    checked = _checked(observed(bench, best.design, range(draws), seed)) if worth_it else {}
    left = [place for place, sigma in to_expect.items() if min(sigma, checked.get(place, (sigma,))[0]) < SEPARATES]
    worth_it = worth_it and len(left) < len(to_expect)
    fits = [hypothesis.fit for hypothesis in bench.hypotheses]
    advice = calibration_for([(fits[a], fits[b]) for a, b in left or _measured(fits)])
    sigmas = {_pair(names, place): sigma for place, sigma in to_expect.items()}
    seen = {_pair(names, place): both for place, both in checked.items()}
    trials = entries(bench.conditions, best.design)
    if_true = {
        _pair(names, (a, b)): {names[a]: float(best.between[a, b]), names[b]: float(best.between[b, a])}
        for a, b in to_expect
    }
    return NextExperiment(
        text=in_words(
            trials,
            outlook(if_true, seen),
            [_pair(names, place) for place in left],
            advice,
            worth_it=worth_it,
            least=SEPARATES,
        ),
        trials=trials if worth_it else (),
        separation_sigma=sigmas,
        if_true_sigma=if_true,
        simulated_sigma=seen,
        alternatives=tuple(
            {
                "trials": [dict(entry) for entry in entries(bench.conditions, option.design)],
                "separation_sigma": {_pair(names, p): s for p, s in _by_pair(option.between).items()},
            }
            for option in sorted(options, key=lambda ranked: -ranked.worth)
            if option.design != best.design
        ),
        calibration=advice or None,
    )


def _measured(fits: Sequence[Fit]) -> list[tuple[int, int]]:
    """Pairs of which a measurement would decide as well as trials: those with a measurement effect in one of them."""
    kinds = [{effect.kind for effect in fit.model} for fit in fits]
    pairs = itertools.combinations(range(len(fits)), 2)
    return [(a, b) for a, b in pairs if "measurement" in kinds[a] ^ kinds[b]]


def _checked(rises: Floats) -> dict[tuple[int, int], tuple[float, float]]:
    """Mean and standard deviation of the separations observed, by pair, of the direction that separates less."""
    sigma = np.sqrt(np.maximum(rises, 0.0))
    checked = {}
    for a, b in itertools.combinations(range(rises.shape[1]), 2):
        ways = [draws[np.isfinite(draws)] for draws in (sigma[:, a, b], sigma[:, b, a])]
        ways = [way for way in ways if way.size]
        if ways:
            least = min(ways, key=lambda draws: float(np.mean(draws)))
            checked[(a, b)] = (float(np.mean(least)), float(np.std(least, ddof=1)) if least.size > 1 else math.nan)
    return checked


def _pair(names: Sequence[str], place: tuple[int, int]) -> str:
    return f"{names[place[0]]} | {names[place[1]]}"
