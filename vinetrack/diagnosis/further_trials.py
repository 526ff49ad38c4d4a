"""The fewest further trials that give an effect of some size a target power, by linear theory.

Designs are evaluated by their information about the size (`design_information`): pairs of replicates are added one by
one, each the one with the largest information, then exchanged until none gains (Fedorov 1972, Theory of Optimal
Experiments). The power of each of these designs is computed by `vinetrack.diagnosis.linear_power` among all candidates:
with thresholds, the scatter of single trials, and what the fit without the effect takes for scatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.diagnosis.campaign_power import CampaignDesign
from vinetrack.diagnosis.design_information import (
    REPLICATES,
    UNLIMITED_TRIALS,
    DesignInformation,
    tests_with_conditions,
    with_trials,
)
from vinetrack.diagnosis.linear_power import effect_power
from vinetrack.diagnosis.power import AddedTrial, EffectPower, FurtherTrials
from vinetrack.experiment.settings import Limits
from vinetrack.planning.feasible_trials import NEW_VINE, OTHER_RIG, SAME_RIG, feasible_conditions

MAX_ADDED_TRIALS = 48  # Most further trials considered where `limits.trials` is not stated (chosen)

PAIRS_PER_STEP = (1, 2)  # Pairs of one condition that are added at a time; the best gain a pair counts (chosen)

TYPICAL_REQUIRED_SCORE = 4.7  # Score that a size needs where the trials so far have no information about it (derived)

# What further trials need, in order of effort
EFFORT_WORDS = {SAME_RIG: "on the rig so far", OTHER_RIG: "with another rig", NEW_VINE: "with a new vine"}

SEARCH_ROUNDS = 3  # Searches, each with the required information corrected by the shortfall of the one before (chosen)

MAX_VINES_TRIED = 2  # New vines that are tried, one at a time (chosen)


def further_trials(
    design: CampaignDesign, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Find the fewest further trials that give an effect of some size a target power."""
    limits = limits or Limits()
    most = limits.trials if "trials" in limits.model_fields_set else MAX_ADDED_TRIALS
    before = now.probability_at(value)
    plan = FurtherTrials(now.effect, now.parameter, now.symbol, now.unit, value, target, before, power=now)
    feasible = feasible_conditions(design.trials, limits)
    if before >= target or not feasible:
        return replace(plan, unlimited=before)
    search = _Search(design, feasible, (now.effect,))
    deviation = abs(value - now.zero)
    wanted = search.information(()) * (abs(now.size_at(target) - now.zero) / deviation) ** 2
    if not math.isfinite(wanted):
        wanted = (TYPICAL_REQUIRED_SCORE / deviation) ** 2
    for _ in range(SEARCH_ROUNDS):
        chosen, needed = search.fewest(wanted, most // REPLICATES)
        plan = _evaluated(design, search, replace(plan, n_conditions=len(search.conditions), needed=needed), chosen)
        assert plan.power is not None
        shortfall = abs(plan.power.size_at(target) - now.zero) / deviation
        if plan.is_reached or not math.isfinite(shortfall) or len(chosen) >= most // REPLICATES:
            break
        wanted = 1.02 * search.information(chosen) * shortfall**2
    return plan


class _Search(DesignInformation):
    """The smallest design that has the wanted information about one effect."""

    def information(self, chosen: Sequence[int]) -> float:
        """Information about the size from these trials and those so far."""
        return float(self.first_information(self.total(chosen)[None])[0])

    def unlimited_information(self) -> float:
        """Information with unlimited trials of all conditions."""
        return float(self.first_information((self.so_far + UNLIMITED_TRIALS * self.each.sum(axis=0))[None])[0])

    def fewest(self, wanted: float, most: int) -> tuple[list[int], dict[str, int]]:
        """The fewest pairs that reach the wanted information, else the best `most`; and how many trials by effort."""
        options: dict[str, list[int]] = {}
        for effort, words in EFFORT_WORDS.items():
            best: list[list[int]] = []
            for allowed in self._feasible(effort):
                best.append(self._design(allowed, wanted, most))
            if best:
                options[words] = min(best, key=lambda chosen: self._cost(chosen, wanted))
        if not options:
            return [], {}
        words = min(options, key=lambda name: self._cost(options[name], wanted))
        reached = {
            name: REPLICATES * len(chosen) for name, chosen in options.items() if self.information(chosen) >= wanted
        }
        return options[words], reached

    def _cost(self, chosen: Sequence[int], wanted: float) -> tuple[float, float]:
        information = self.information(chosen)
        return (len(chosen), 0.0) if information >= wanted else (math.inf, -information)

    def _feasible(self, effort: int) -> Iterator[NDArray[np.intp]]:
        """Indices of the conditions available at this effort: one new vine at a time, the most informative first."""
        if not (self.efforts == effort).any():
            return
        if effort < NEW_VINE:
            yield np.flatnonzero(self.efforts <= effort)
            return
        new = list(dict.fromkeys(self.vines[self.efforts == NEW_VINE]))
        unlimited = [self.so_far + UNLIMITED_TRIALS * self.each[self.vines == vine].sum(axis=0) for vine in new]
        for k in np.argsort(-self.first_information(np.stack(unlimited)))[:MAX_VINES_TRIED]:
            yield np.flatnonzero((self.efforts < NEW_VINE) | (self.vines == new[k]))

    def _design(self, allowed: NDArray[np.intp], wanted: float, most: int) -> list[int]:
        """Pairs added one by one up to the wanted information, exchanged, and removed where not needed."""
        chosen: list[int] = []
        information = self.information(())
        while information < wanted and len(chosen) < most:
            total = self.total(chosen)
            gains = [
                (self.first_information(total + count * self.each[allowed]) - information) / count
                for count in PAIRS_PER_STEP
            ]
            step, index = np.unravel_index(int(np.argmax(gains)), (len(PAIRS_PER_STEP), allowed.size))
            if not gains[step][index] > 0:
                break
            chosen += [int(allowed[index])] * min(PAIRS_PER_STEP[step], most - len(chosen))
            information = self.information(chosen)
        chosen = self.exchanged(chosen, allowed, self.first_information)
        while len(chosen) > 1:
            least = self._least_informative(chosen)
            fewer = self.exchanged(chosen[:least] + chosen[least + 1 :], allowed, self.first_information)
            if self.information(fewer) < wanted:
                break
            chosen = fewer
        return self._most_informative_first(chosen)

    def _least_informative(self, chosen: Sequence[int]) -> int:
        total = self.total(chosen)
        return int(np.argmax(self.first_information(total - self.each[list(chosen)])))

    def _most_informative_first(self, chosen: Sequence[int]) -> list[int]:
        """The same trials, in order of the information they add."""
        remaining: list[int] = list(chosen)
        order: list[int] = []
        while remaining:
            gains = self.first_information(self.total(order) + self.each[remaining])
            order.append(remaining.pop(int(np.argmax(gains))))
        return order


def _evaluated(design: CampaignDesign, search: _Search, plan: FurtherTrials, chosen: Sequence[int]) -> FurtherTrials:
    """The plan with as many of these trials as needed, and the power after each."""
    unique = list(dict.fromkeys(chosen))
    tests = tests_with_conditions(design, [search.conditions[k] for k in unique], design.candidates)
    index_of = {trial.name: k for k, trial in enumerate(tests.fit.trials)}
    so_far = [index_of[trial.name] for trial in design.trials if trial.name in index_of]
    trials: list[AddedTrial] = []
    power, probability = plan.power, plan.before
    for count, k in enumerate(chosen, 1):
        condition = search.conditions[k]
        added = [index_of[search.conditions[j].trial.name] for j in chosen[:count] for _ in range(REPLICATES)]
        power = effect_power(with_trials(tests, [*so_far, *added]), plan.effect) or power
        assert power is not None
        probability = power.probability_at(plan.value)
        for _ in range(REPLICATES):
            trial = replace(condition.trial, name=f"added_{len(trials) + 1}")
            trials.append(AddedTrial(trial, condition.changed, condition.effort == NEW_VINE, probability))
        if probability >= plan.target:
            break
    assert power is not None
    ratio = math.sqrt(
        search.unlimited_information() / max(search.information(chosen[: len(trials) // REPLICATES]), 1e-300)
    )
    unlimited = power.probability_at(power.zero + ratio * (plan.value - power.zero))
    return replace(plan, trials=tuple(trials), power=power, unlimited=max(unlimited, probability))
