"""The campaign that pins n and B to a wanted error, with as few trials as possible.

A campaign grows every vine at K pressures, in equal ratios of the drive P − P_y (n is a slope in logarithms), with one
payload or each of several, r times. K of two would be the cheapest for n, and blind to a model that fails in between:
so there are a fewest and a most. What the cheapest allocation without that rule would cost stands beside it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model
from vinetrack.experiment.naming import with_names
from vinetrack.planning.campaign_information import FilmingPlan, Information, filmed, information, joint_model
from vinetrack.planning.predictive_inputs import PredictiveInputs
from vinetrack.planning.scaling_priors import burst_pressure_Pa

LEVELS = 13
"""Pressures looked at for each vine. Chosen: neighbours differ by a factor 1.4 of the drive where the drive spans 50.
Reasoned: at half no campaign of eight pressures is evenly spaced, at twice the search takes twice as long."""

SLOWEST_DRIVE = 0.02
"""Of the largest drive, where no lowest pressure is given; the slowest that can be filmed decides then. Chosen: with it
the speed of an n of 0.4 spans four decades, more than can be filmed. At half or twice the same trials are left by the
camera's limits."""

MEASURED_YIELD_SIGMA_PA = 200.0
"""Error of a yield pressure that will be measured with the campaign, as a sheet takes it where it says nothing. Chosen
with that default."""

ENDLESS = 1e7
"""Trials a condition in a campaign without end. Chosen: errors are then 3000 times smaller than those of one trial, so
that only what trials cannot tell remains."""


class CampaignError(ValueError):
    """A campaign that cannot be: one sentence with a remedy."""


@dataclass(frozen=True)
class Scope:
    """What a campaign may consist of; pressures in Pa (NaN: as low, or high, as can be), payloads in kg."""

    pressure_Pa: tuple[float, float] = (math.nan, math.nan)
    payloads_kg: tuple[float, ...] = (0.0,)
    pressures: tuple[int, int] = (4, 8)
    replicates: tuple[int, int] = (2, 12)
    most_trials: int = 200
    burst_share: float = 0.9


@dataclass(frozen=True)
class Candidates:
    """Conditions that can be filmed, what one trial of each says, and the model they stand on.

    `vine`, `payload` and `level` index each condition; `rejected` counts those that cannot be filmed.
    """

    model: Model
    trials: tuple[Trial, ...]
    information: Information
    vine: tuple[str, ...]
    payload_kg: Floats
    rejected: int


@dataclass(frozen=True)
class Plan:
    """A campaign: how many trials of each candidate condition, and the standard errors it is expected to leave.

    `n_error` is absolute, `B_errors` by vine are relative.
    """

    counts: np.ndarray
    n_error: float
    B_errors: dict[str, float]
    pressures: int = 0
    replicates: int = 0
    payloads_kg: tuple[float, ...] = ()

    @property
    def n_trials(self) -> int:
        """All trials."""
        return int(np.sum(self.counts))

    @property
    def B_error(self) -> float:
        """That of the vine known least."""
        return max(self.B_errors.values(), default=0.0)

    def meets(self, n_error: float, B_error: float) -> bool:
        """Whether both errors are as small as wanted.

        Parameters
        ----------
        n_error, B_error : float
            Largest standard errors wanted: of n, absolute; of every B, relative.

        Returns
        -------
        bool
        """
        return self.n_error <= n_error and self.B_error <= B_error


@dataclass(frozen=True)
class Planned:
    """What was found: `best`, or None where no campaign within the scope will do; `others` in order of cost.

    `cheapest` is the allocation without a rule on pressures and replicates, `endless` what trials without end of the
    largest campaign would leave.
    """

    candidates: Candidates
    best: Plan | None
    others: tuple[Plan, ...]
    cheapest: Plan | None
    endless: Plan
    nearest: Plan


def candidates(vine_inputs: Sequence[PredictiveInputs], scope: Scope, filming: FilmingPlan) -> Candidates:
    """Every condition that can be filmed, with what a trial of it would say.

    Parameters
    ----------
    vine_inputs : predictive inputs, one for each vine, all of one model.
    scope : pressures, payloads and limits to stay within.
    filming : camera of the campaign; decides which conditions can be filmed.

    Returns
    -------
    Candidates
        In the order of `vine_inputs`, then of rising pressure.

    Raises
    ------
    CampaignError
        If no condition can be filmed.
    """
    trials = with_names([trial for inputs in vine_inputs for trial in _conditions(inputs, scope)])
    model = joint_model(vine_inputs)
    data = filmed(model, trials, filming)
    kept = [trial_data for trial_data in data if trial_data is not None]
    if not kept:
        raise CampaignError(
            f"No trial of the campaign could be filmed: none grows within {filming.longest_s:g} s and in a dozen "
            "frames or more; widen the range of pressures, or change --capture-fps or --longest-s."
        )
    shown = tuple(trial_data.trial for trial_data in kept)
    return Candidates(
        model=model,
        trials=shown,
        information=information(model, kept, filming, vine_inputs[0].spreads),
        vine=tuple(trial.vine for trial in shown),
        payload_kg=np.array([trial.payload_kg for trial in shown]),
        rejected=len(data) - len(kept),
    )


def _conditions(inputs: PredictiveInputs, scope: Scope) -> Iterator[Trial]:
    """Pressures in equal ratios of the drive, with every payload."""
    trial = inputs.trial
    onset = trial.yield_pressure_Pa
    burst = scope.burst_share * burst_pressure_Pa(trial.diameter_m, trial.thickness_m)
    high = burst if math.isnan(scope.pressure_Pa[1]) else min(scope.pressure_Pa[1], burst)
    low = onset + SLOWEST_DRIVE * (high - onset) if math.isnan(scope.pressure_Pa[0]) else scope.pressure_Pa[0]
    if not onset < low < high:
        return
    sigma = trial.yield_pressure_sigma_Pa
    for pressure_Pa, payload_kg in itertools.product(
        onset + np.geomspace(low - onset, high - onset, LEVELS), scope.payloads_kg
    ):
        rounded = float(f"{pressure_Pa:.3g}")
        yield replace(
            trial,
            name=f"{len(trial.vine)}",
            pressure_Pa=rounded,
            pressure_sigma_Pa=inputs.spreads[0] * rounded,
            payload_kg=payload_kg,
            yield_pressure_sigma_Pa=sigma if math.isfinite(sigma) else MEASURED_YIELD_SIGMA_PA,
        )


def plan(candidate_set: Candidates, scope: Scope, n_error: float, B_error: float) -> Planned:
    """The campaign with the fewest trials that leaves no more than these standard errors.

    Parameters
    ----------
    candidate_set : from `candidates`.
    scope : fewest and most pressures and replicates, and most trials.
    n_error : float
        Standard error wanted of n, absolute.
    B_error : float
        Standard error wanted of every B, relative.

    Returns
    -------
    Planned
    """
    tried = [_smallest(candidate_set, scope, design, n_error, B_error) for design in _shapes(candidate_set, scope)]
    good = [design for design in tried if design.meets(n_error, B_error) and design.n_trials <= scope.most_trials]
    good.sort(key=lambda design: (design.n_trials, -design.pressures))
    largest = max(tried, key=lambda design: np.count_nonzero(design.counts))
    endless = _judged(candidate_set, np.where(largest.counts > 0, ENDLESS, 0.0))
    affordable = [design for design in tried if design.n_trials <= scope.most_trials] or tried
    return Planned(
        candidates=candidate_set,
        best=good[0] if good else None,
        others=tuple(good[1:]),
        cheapest=_cheapest(candidate_set, scope.most_trials, n_error, B_error),
        endless=endless,
        nearest=min(affordable, key=lambda design: max(design.n_error / n_error, design.B_error / B_error)),
    )


@dataclass(frozen=True)
class _Shape:
    """Which conditions: how many pressures, which payloads, and a mark for each candidate."""

    pressures: int
    payloads_kg: tuple[float, ...]
    chosen: np.ndarray


def _shapes(candidate_set: Candidates, scope: Scope) -> Iterator[_Shape]:
    """Every number of pressures with one payload alone, or all of them."""
    payloads: list[tuple[float, ...]] = [(payload,) for payload in scope.payloads_kg]
    if len(scope.payloads_kg) > 1:
        payloads.append(scope.payloads_kg)
    seen = set()
    for pressures, loads in itertools.product(range(scope.pressures[0], scope.pressures[1] + 1), payloads):
        chosen = np.zeros(len(candidate_set.trials), dtype=bool)
        for vine, load in itertools.product(dict.fromkeys(candidate_set.vine), loads):
            places = [
                k for k, name in enumerate(candidate_set.vine) if name == vine and candidate_set.payload_kg[k] == load
            ]
            if places:
                chosen[[places[i] for i in _spread(len(places), pressures)]] = True
        if chosen.tobytes() not in seen and chosen.any():
            seen.add(chosen.tobytes())
            yield _Shape(pressures, loads, chosen)


def _spread(count: int, wanted: int) -> list[int]:
    """Evenly spread places among `count`, the ends included."""
    return sorted(set(np.rint(np.linspace(0, count - 1, min(wanted, count))).astype(int).tolist()))


def _smallest(candidate_set: Candidates, scope: Scope, shape: _Shape, n_error: float, B_error: float) -> Plan:
    """The fewest replicates of a shape that will do, or as many as there may be."""
    design = None
    affordable = scope.most_trials // int(np.count_nonzero(shape.chosen))
    for replicates in range(scope.replicates[0], max(min(scope.replicates[1], affordable), scope.replicates[0]) + 1):
        counts = replicates * shape.chosen.astype(float)
        design = replace(
            _judged(candidate_set, counts),
            pressures=shape.pressures,
            replicates=replicates,
            payloads_kg=shape.payloads_kg,
        )
        if design.meets(n_error, B_error):
            break
    assert design is not None
    return design


def _judged(candidate_set: Candidates, counts: Floats) -> Plan:
    n, B = candidate_set.information.errors(counts)
    return Plan(counts, n, B)


def _cheapest(candidate_set: Candidates, most_trials: int, n_error: float, B_error: float) -> Plan | None:
    """Trials added one by one where they help most, from one at each end of every vine's range."""
    counts = np.zeros(len(candidate_set.trials))
    for vine in dict.fromkeys(candidate_set.vine):
        places = [k for k, name in enumerate(candidate_set.vine) if name == vine]
        drives = [candidate_set.trials[k].pressure_Pa for k in places]
        counts[[places[int(np.argmin(drives))], places[int(np.argmax(drives))]]] = 1
    while np.sum(counts) <= most_trials:
        now = _judged(candidate_set, counts)
        if now.meets(n_error, B_error):
            return now
        step = np.eye(len(counts))
        tried = [_short_by(_judged(candidate_set, counts + extra), n_error, B_error) for extra in step]
        counts = counts + step[int(np.argmin(tried))]
    return None


def _short_by(design: Plan, n_error: float, B_error: float) -> float:
    """By how much a campaign misses what is wanted; all misses count, so that none is traded for nothing."""
    ratios = np.array([design.n_error / n_error, *(error / B_error for error in design.B_errors.values())])
    return float(np.sum(np.maximum(ratios, 1.0) ** 2) + 1e-3 * np.sum(ratios**2))


def trials_of(candidate_set: Candidates, design: Plan) -> list[Trial]:
    """Every trial of a campaign, named, replicates one after the other.

    Parameters
    ----------
    candidate_set : what the campaign was chosen from.
    design : the campaign: trials of each condition.

    Returns
    -------
    list of Trial
        `design.n_trials` of them.
    """
    trials = []
    for trial, count in zip(candidate_set.trials, design.counts.astype(int), strict=True):
        size = f"{1e3 * trial.diameter_m:g}mm_{1e6 * trial.thickness_m:g}um"
        load = f"_{1e3 * trial.payload_kg:g}g" if trial.payload_kg > 0 else ""
        stem = f"{size}_{trial.pressure_Pa / 1e3:g}kPa{load}".replace(".", "p")
        trials += [replace(trial, name=f"{stem}_{k + 1}") for k in range(count)]
    return trials
