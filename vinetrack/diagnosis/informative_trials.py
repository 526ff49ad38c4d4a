"""Further trials for a campaign that goes on: those that reveal most where nothing is found, or confirm
what is named.

A size a of an effect is detected with probability Φ(a √I − c), with I the information about it (`design_information`)
and c the threshold of its score. Averaged over sizes spread evenly in their logarithm over the decade below the largest
plausible one, and summed over all candidates, that is the expected number of effects that a design would detect if each
were missing in turn. With I_ee − I_ef² / I_ff in place of I, for the most similar other candidate f, it is the expected
number that it would tell from every other. The design with the largest sum of both is found by adding pairs of trials
one by one and exchanging them (Fedorov 1972, Theory of Optimal Experiments).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

from vinetrack.core.records import Floats
from vinetrack.diagnosis.campaign_power import CampaignDesign
from vinetrack.diagnosis.design_information import (
    REPLICATES,
    DesignInformation,
    Worth,
    tests_with_conditions,
    with_trials,
)
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.power import Power
from vinetrack.experiment.settings import Limits
from vinetrack.narrative.plan_text import trial_entries
from vinetrack.planning.feasible_trials import Condition, feasible_conditions

# Sizes of an effect that are averaged over, relative to its largest plausible one (chosen)
SIZES = np.geomspace(0.1, 1.0, 9)


@dataclass(frozen=True)
class InformativeTrials:
    """Recommended trials, and what they would show. `trials` are entries as of a next experiment
    (`plan_text.trial_entries`); `now` and `then` are the power of the trials so far, and of these together with those
    recommended.
    """

    trials: tuple[Mapping[str, Any], ...]
    now: Power
    then: Power


def exploratory_trials(design: CampaignDesign, power: Power, limits: Limits | None = None) -> InformativeTrials | None:
    """Find the further trials that would reveal most of what could be missing."""
    return _most_informative(design, power, [entry.effect for entry in power.effects], limits, named="")


def confirming_trials(
    design: CampaignDesign, power: Power, name: str, rival: str = "", limits: Limits | None = None
) -> InformativeTrials | None:
    """Find the further trials that tell most about one effect, apart from a rival."""
    known = {entry.effect for entry in power.effects}
    if name not in known:
        return None
    return _most_informative(design, power, [name, *({rival} & known)], limits, named=name)


def _most_informative(
    design: CampaignDesign, power: Power, effects: Sequence[str], limits: Limits | None, *, named: str
) -> InformativeTrials | None:
    """The design of largest worth within the limits, about one named effect or about all."""
    limits = limits or Limits()
    feasible = feasible_conditions(design.trials, limits.model_copy(update={"new_vines": False}))
    if not feasible or not effects:
        return None
    search = _Search(design, feasible, power, effects)
    if not search.conditions or not search.effects or named not in ("", search.effects[0]):
        return None
    worth = search.distinct_information if named else search.expected_discoveries
    chosen = search.best(max(limits.trials // REPLICATES, 1), worth)
    before, after = search.total(())[None], search.total(chosen)[None]
    if not worth(after)[0] > worth(before)[0]:
        return None
    groups = [k for k in chosen for _ in range(min(REPLICATES, limits.trials))]
    return InformativeTrials(
        trial_entries(search.conditions, groups), power, _power_with(design, [search.conditions[k] for k in groups])
    )


def _power_with(design: CampaignDesign, added: Sequence[Condition]) -> Power:
    """Power of the trials so far and of trials of these conditions, some of which are the same."""
    unique = list({condition.trial.name: condition for condition in added}.values())
    tests = tests_with_conditions(design, unique, design.candidates)
    index_of = {trial.name: k for k, trial in enumerate(tests.fit.trials)}
    names = [*(trial.name for trial in design.trials), *(condition.trial.name for condition in added)]
    return power_of(with_trials(tests, [index_of[name] for name in names if name in index_of]), nonlinear=True)


class _Search(DesignInformation):
    """The design that is worth most."""

    def __init__(
        self, design: CampaignDesign, every: Sequence[Condition], power: Power, effects: Sequence[str]
    ) -> None:
        super().__init__(design, every, effects)
        self.largest = np.array([abs(power[name].largest - power[name].zero) for name in self.effects])
        self.required = power.threshold

    def distinct_information(self, totals: Floats) -> Floats:
        """Information about the first effect with its rival free, shape (n_designs,)."""
        return np.asarray(_alone_and_distinct(self.information_of(totals))[1][:, 0])

    def expected_discoveries(self, totals: Floats) -> Floats:
        """Expected numbers of effects that are detected, and that are told from all others, added up."""
        alone, distinct = _alone_and_distinct(self.information_of(totals))
        return self._expected(alone) + self._expected(distinct)

    def _expected(self, information: Floats) -> Floats:
        """Expected number of effects detected with this information about each, shape (n_designs,)."""
        scores = SIZES[:, None, None] * self.largest * np.sqrt(information)
        return np.asarray(ndtr(scores - self.required).mean(axis=0).sum(axis=1))

    def best(self, count: int, worth: Worth) -> list[int]:
        """As many groups of trials, added one by one and exchanged."""
        chosen: list[int] = []
        for _ in range(count):
            chosen.append(int(np.argmax(worth(self.total(chosen) + self.each))))
        return self.exchanged(chosen, np.arange(len(self.conditions)), worth)


def _alone_and_distinct(information: Floats) -> tuple[Floats, Floats]:
    """Information about each effect, alone and with its most similar rival free, shape (n_designs, n_effects)."""
    alone = np.maximum(np.diagonal(information, axis1=1, axis2=2), 0.0)
    shared = information**2 / np.maximum(alone, 1e-300)[:, None, :]
    diagonal = np.arange(alone.shape[1])
    shared[:, diagonal, diagonal] = 0.0
    return alone, np.maximum(alone - shared.max(axis=2), 0.0)
