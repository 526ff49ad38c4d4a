"""The smallest campaign that determines n and B with the standard errors wanted.

A campaign grows every vine at K pressures, spaced in equal ratios of the drive P − P_y (n is a slope in logarithms),
with one payload or each of several, r times. K = 2 would be cheapest for n, but could not reveal a model that fails in
between, so K has a lower and an upper limit. The cheapest allocation without these limits is given for comparison.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model
from vinetrack.experiment.schema import with_names
from vinetrack.planning.campaign_information import FilmingPlan, Information, filmed, information, joint_model
from vinetrack.planning.predictive_inputs import PredictiveInputs, burst_pressure_Pa

CANDIDATE_PRESSURES = 13  # Candidate pressures of each vine (chosen)

# Lowest drive considered, as a fraction of the highest, where no lowest pressure is given (chosen)
LOWEST_DRIVE_FRACTION = 0.02

MEASURED_YIELD_SIGMA_PA = 200.0  # Standard error of a yield pressure that will be measured with the campaign, Pa

UNLIMITED_REPLICATES = 1e7  # Trials of each condition in a campaign of unlimited size (chosen)


class CampaignError(ValueError):
    """An impossible campaign: one sentence with a remedy."""


@dataclass(frozen=True)
class Scope:
    """Limits of a campaign: pressures in Pa (NaN: as low, or as high, as possible), payloads in kg. `pressures`,
    `replicates` : fewest and most. `burst_share` : largest fraction of the burst pressure.
    """

    pressure_Pa: tuple[float, float] = (math.nan, math.nan)
    payloads_kg: tuple[float, ...] = (0.0,)
    pressures: tuple[int, int] = (4, 8)
    replicates: tuple[int, int] = (2, 12)
    most_trials: int = 200
    burst_share: float = 0.9


@dataclass(frozen=True)
class Candidates:
    """Conditions that can be filmed, the information of one trial of each, and the model at its assumed values. `vine`
    and `payload_kg` are those of each condition; `rejected` counts conditions that cannot be filmed.
    """

    model: Model
    trials: tuple[Trial, ...]
    information: Information
    vine: tuple[str, ...]
    payload_kg: Floats
    rejected: int


@dataclass(frozen=True)
class Plan:
    """A campaign: number of trials of each candidate condition, and the expected standard errors of n and B. `n_error`
    is absolute, `B_errors` by vine are relative.
    """

    counts: np.ndarray
    n_error: float
    B_errors: dict[str, float]
    pressures: int = 0
    replicates: int = 0
    payloads_kg: tuple[float, ...] = ()

    @property
    def n_trials(self) -> int:
        """Number of trials of all conditions."""
        return int(np.sum(self.counts))

    @property
    def B_error(self) -> float:
        """Largest relative standard error of B among the vines."""
        return max(self.B_errors.values(), default=0.0)

    def meets(self, n_error: float, B_error: float) -> bool:
        """Whether the expected standard errors are as small as wanted."""
        return self.n_error <= n_error and self.B_error <= B_error


@dataclass(frozen=True)
class Planned:
    """Result of the search: `best`, or None where no campaign within the scope suffices; `others` in order of cost.
    `cheapest` is the allocation without limits on pressures and replicates, `nearest` the campaign that misses the
    wanted errors least, `endless` the largest campaign with unlimited replicates.
    """

    candidates: Candidates
    best: Plan | None
    others: tuple[Plan, ...]
    cheapest: Plan | None
    endless: Plan
    nearest: Plan


def candidates(vine_inputs: Sequence[PredictiveInputs], scope: Scope, filming: FilmingPlan) -> Candidates:
    """Return every condition that can be filmed, with the information of a trial of it."""
    trials = with_names([trial for inputs in vine_inputs for trial in _conditions(inputs, scope)])
    model = joint_model(vine_inputs)
    data = filmed(model, trials, filming)
    can_be_filmed = [trial_data for trial_data in data if trial_data is not None]
    if not can_be_filmed:
        raise CampaignError(
            f"No trial of the campaign could be filmed: none finishes growing within {filming.longest_s:g} s and shows "
            "a dozen frames of growth or more; widen the range of pressures, or change --capture-fps or --longest-s."
        )
    feasible = tuple(trial_data.trial for trial_data in can_be_filmed)
    return Candidates(
        model=model,
        trials=feasible,
        information=information(model, can_be_filmed, filming, vine_inputs[0].spreads),
        vine=tuple(trial.vine for trial in feasible),
        payload_kg=np.array([trial.payload_kg for trial in feasible]),
        rejected=len(data) - len(can_be_filmed),
    )


def _conditions(inputs: PredictiveInputs, scope: Scope) -> Iterator[Trial]:
    """The candidate trials of a vine: pressures in equal ratios of the drive, with every payload."""
    trial = inputs.trial
    onset = trial.yield_pressure_Pa
    burst = scope.burst_share * burst_pressure_Pa(trial.diameter_m, trial.thickness_m)
    high = burst if math.isnan(scope.pressure_Pa[1]) else min(scope.pressure_Pa[1], burst)
    low = onset + LOWEST_DRIVE_FRACTION * (high - onset) if math.isnan(scope.pressure_Pa[0]) else scope.pressure_Pa[0]
    if not onset < low < high:
        return
    sigma = trial.yield_pressure_sigma_Pa
    for pressure_Pa, payload_kg in itertools.product(
        onset + np.geomspace(low - onset, high - onset, CANDIDATE_PRESSURES), scope.payloads_kg
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
    """Find the campaign with the fewest trials whose expected standard errors are as small as wanted."""
    designs = [_fewest_replicates(candidate_set, scope, s, n_error, B_error) for s in _shapes(candidate_set, scope)]
    sufficient = [d for d in designs if d.meets(n_error, B_error) and d.n_trials <= scope.most_trials]
    sufficient.sort(key=lambda design: (design.n_trials, -design.pressures))
    largest = max(designs, key=lambda design: np.count_nonzero(design.counts))
    endless = _with_errors(candidate_set, np.where(largest.counts > 0, UNLIMITED_REPLICATES, 0.0))
    affordable = [design for design in designs if design.n_trials <= scope.most_trials] or designs
    return Planned(
        candidates=candidate_set,
        best=sufficient[0] if sufficient else None,
        others=tuple(sufficient[1:]),
        cheapest=_cheapest(candidate_set, scope.most_trials, n_error, B_error),
        endless=endless,
        nearest=min(affordable, key=lambda design: max(design.n_error / n_error, design.B_error / B_error)),
    )


@dataclass(frozen=True)
class _Shape:
    """A set of conditions: number of pressures, payloads, and a mask of the candidates."""

    pressures: int
    payloads_kg: tuple[float, ...]
    chosen: np.ndarray


def _shapes(candidate_set: Candidates, scope: Scope) -> Iterator[_Shape]:
    """Every number of pressures, with each single payload and with all payloads together."""
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
                chosen[[places[i] for i in _evenly_spaced(len(places), pressures)]] = True
        if chosen.tobytes() not in seen and chosen.any():
            seen.add(chosen.tobytes())
            yield _Shape(pressures, loads, chosen)


def _evenly_spaced(count: int, wanted: int) -> list[int]:
    """Indices below `count`, evenly spaced, the ends included."""
    return sorted(set(np.rint(np.linspace(0, count - 1, min(wanted, count))).astype(int).tolist()))


def _fewest_replicates(candidate_set: Candidates, scope: Scope, shape: _Shape, n_error: float, B_error: float) -> Plan:
    """The fewest replicates of a shape that suffice; the most allowed where none do."""
    design = None
    affordable = scope.most_trials // int(np.count_nonzero(shape.chosen))
    for replicates in range(scope.replicates[0], max(min(scope.replicates[1], affordable), scope.replicates[0]) + 1):
        counts = replicates * shape.chosen.astype(float)
        design = replace(
            _with_errors(candidate_set, counts),
            pressures=shape.pressures,
            replicates=replicates,
            payloads_kg=shape.payloads_kg,
        )
        if design.meets(n_error, B_error):
            break
    assert design is not None
    return design


def _with_errors(candidate_set: Candidates, counts: Floats) -> Plan:
    """The campaign of these counts with its expected standard errors."""
    n, B = candidate_set.information.errors(counts)
    return Plan(counts, n, B)


def _cheapest(candidate_set: Candidates, most_trials: int, n_error: float, B_error: float) -> Plan | None:
    """Greedy design: one trial at each end of every vine's range, then one at a time where it helps most."""
    counts = np.zeros(len(candidate_set.trials))
    for vine in dict.fromkeys(candidate_set.vine):
        places = [k for k, name in enumerate(candidate_set.vine) if name == vine]
        drives = [candidate_set.trials[k].pressure_Pa for k in places]
        counts[[places[int(np.argmin(drives))], places[int(np.argmax(drives))]]] = 1
    while np.sum(counts) <= most_trials:
        design = _with_errors(candidate_set, counts)
        if design.meets(n_error, B_error):
            return design
        one_more = np.eye(len(counts))
        losses = [_loss(_with_errors(candidate_set, counts + extra), n_error, B_error) for extra in one_more]
        counts = counts + one_more[int(np.argmin(losses))]
    return None


def _loss(design: Plan, n_error: float, B_error: float) -> float:
    """Squared ratios of the errors to those wanted, summed where above 1, and a little of all to break ties."""
    ratios = np.array([design.n_error / n_error, *(error / B_error for error in design.B_errors.values())])
    return float(np.sum(np.maximum(ratios, 1.0) ** 2) + 1e-3 * np.sum(ratios**2))


def trials_of(candidate_set: Candidates, design: Plan) -> list[Trial]:
    """Return every trial of a campaign with a name, replicates next to each other."""
    trials = []
    for trial, count in zip(candidate_set.trials, design.counts.astype(int), strict=True):
        size = f"{1e3 * trial.diameter_m:g}mm_{1e6 * trial.thickness_m:g}um"
        load = f"_{1e3 * trial.payload_kg:g}g" if trial.payload_kg > 0 else ""
        stem = f"{size}_{trial.pressure_Pa / 1e3:g}kPa{load}".replace(".", "p")
        trials += [replace(trial, name=f"{stem}_{k + 1}") for k in range(count)]
    return trials
