"""The fewest further trials that make an effect of some size show itself with a wanted probability, by linear theory.

With trial effects eliminated, the cross products of free numbers, shared systematic errors and the shape of the effect
add up over trials. Of a design with n_c trials of condition c, and the trials so far,

    M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa

is the information about the size a beside all other numbers ν. So one trial of every condition is simulated once, and
designs are judged by linear algebra: pairs of replicates are added one by one, each the one with the largest I, then
exchanged until none gains (Fedorov 1972, Theory of Optimal Experiments). The probability of each of these designs comes
from `vinetrack.diagnosis.linear_power`, with all candidates beside the effect: thresholds, scatter of single trials,
and what the fit without the effect takes for scatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.linear_power import effect_power, typical_shape_index
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.power import AddedTrial, EffectPower, FurtherTrials
from vinetrack.diagnosis.score_test import scores_of
from vinetrack.diagnosis.shape_products import blocks_of
from vinetrack.dynamics.model import Value
from vinetrack.experiment.settings import Limits
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.sensitivity import Predictor
from vinetrack.planning.campaign_information import FEWEST_GROWTH_FRAMES
from vinetrack.planning.feasible_trials import NEW_VINE, OTHER_RIG, SAME_RIG, Condition, conditions
from vinetrack.planning.scaling_priors import damping_prior

MOST_ADDED = 48
"""Further trials that are looked at where `limits.trials` says nothing. Chosen: a day of filming; at half some effects
that a day would show are given up, at twice nobody films them."""

ENDLESS = 1000
"""Trials of each condition in a campaign without end. Chosen: what scatters from trial to trial is then thirty times
smaller; at half or twice what is left is the shared error all the same."""

REPLICATES = 2
"""Trials of a condition that are asked for at a time. Chosen: what one trial shows alone, no replicate bears out; at
three a plan is up to two trials longer than it need be, at two up to one."""

AT_ONCE = (1, 2)
"""Pairs of one condition that are added at a time, the best gain a pair counting. Chosen: the first trials of a vine
pin its B and show little besides."""

MOST_PASSES, GAIN = 3, 1.002
"""Passes of exchange, and the gain in information for which a trial is exchanged. Chosen: exchange usually ends after
two passes; a gain of 0.2 % is 0.1 % of a detectable size."""

UNSEEN = 1e-6
"""Precision given to numbers that no trial feels yet, such as B of a vine that is not made. Chosen: a standard
deviation of a thousand, in ln B, is none."""

FIRST_GUESS = 4.7
"""Score that a size needs where the trials so far say nothing of it. Derived: threshold of a candidate at 0.3 % for the
family, about 3.4, and 1.28 for nine times in ten."""

EFFORT_WORDS = {SAME_RIG: "on the rig so far", OTHER_RIG: "with another rig", NEW_VINE: "with a new vine"}
"""What further trials ask for, in order of effort."""

ROUNDS = 3
"""Searches, each with the information that the one before fell short by. Chosen: thresholds and scatter change with the
trials by a tenth, after two rounds by a hundredth."""

MOST_VINES_TRIED = 2
"""New vines that are tried, one at a time. Chosen for time."""


def further_trials(
    design: CampaignDesign, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Look for the fewest further trials with which an effect of some size is found with a wanted probability.

    Parameters
    ----------
    design : of the trials so far, or of a sheet.
    now : power of these trials for the effect.
    value : float
        Of its parameter, SI.
    target : float
        Wanted probability, below 1.
    limits : Limits, optional
        Within what further trials can be made; what they leave open follows the trials so far. `limits.trials` counts
        where it is stated.

    Returns
    -------
    FurtherTrials

    Raises
    ------
    FitError
        If what further trials would show cannot be followed.
    """
    limits = limits or Limits()
    most = limits.trials if "trials" in limits.model_fields_set else MOST_ADDED
    before = now.probability_at(value)
    plan = FurtherTrials(now.effect, now.parameter, now.symbol, now.unit, value, target, before, power=now)
    every = conditions(design.trials, limits)
    if before >= target or not every:
        return replace(plan, unlimited=before)
    search = _Search(design, every, now.effect)
    away = abs(value - now.zero)
    wanted = search.information(()) * (abs(now.size_at(target) - now.zero) / away) ** 2
    if not math.isfinite(wanted):
        wanted = (FIRST_GUESS / away) ** 2
    for _ in range(ROUNDS):
        chosen, needed = search.fewest(wanted, most // REPLICATES)
        plan = _judged(design, search, replace(plan, n_conditions=len(search.conditions), needed=needed), chosen)
        assert plan.power is not None
        short = abs(plan.power.size_at(target) - now.zero) / away
        if plan.is_reached or not math.isfinite(short) or len(chosen) >= most // REPLICATES:
            break
        wanted = 1.02 * search.information(chosen) * short**2
    return plan


class _Search:
    """Designs judged by the information about one effect beside everything else.

    `conditions` are those that can be filmed; `each`, shape (n_conditions, n, n), what a pair of trials of each adds.
    """

    def __init__(self, design: CampaignDesign, every: Sequence[Condition], effect: str) -> None:
        asked = _questions(design, every, (effect,))
        names = [trial.name for trial in asked.fit.trials]
        moving = [trial_data.time_s.size - trial_data.n_rest for trial_data in asked.fit.predictor.data]
        blocks = _wide(asked, effect)
        before = {trial.name for trial in design.trials}
        filmed = {name: k for k, name in enumerate(names) if name not in before and moving[k] >= FEWEST_GROWTH_FRAMES}
        self.conditions = tuple(condition for condition in every if condition.trial.name in filmed)
        self.each = REPLICATES * blocks[[filmed[condition.trial.name] for condition in self.conditions]]
        self.so_far = _prior(asked) + blocks[[k for k, name in enumerate(names) if name in before]].sum(axis=0)
        self.efforts = np.array([condition.effort for condition in self.conditions])
        self.vines = np.array([condition.trial.vine for condition in self.conditions])

    def information(self, chosen: Sequence[int]) -> float:
        """About the size, with these trials beside those so far."""
        return float(_left(self._total(chosen)[None])[0])

    def _total(self, chosen: Sequence[int]) -> Floats:
        return np.asarray(self.so_far + self.each[list(chosen)].sum(axis=0))

    def unlimited_information(self) -> float:
        """Information with all conditions made without end."""
        return float(_left((self.so_far + ENDLESS * self.each.sum(axis=0))[None])[0])

    def fewest(self, wanted: float, most: int) -> tuple[list[int], dict[str, int]]:
        """The fewest pairs that have the wanted information, else the best `most`; and how many by what they ask."""
        options: dict[str, list[int]] = {}
        for effort, words in EFFORT_WORDS.items():
            best: list[list[int]] = []
            for allowed in self._allowed(effort):
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

    def _allowed(self, effort: int) -> Iterator[NDArray[np.intp]]:
        """Places to choose from at this effort: one new vine at a time, the most telling ones."""
        if not (self.efforts == effort).any():
            return
        if effort < NEW_VINE:
            yield np.flatnonzero(self.efforts <= effort)
            return
        new = list(dict.fromkeys(self.vines[self.efforts == NEW_VINE]))
        many = [self.so_far + ENDLESS * self.each[self.vines == vine].sum(axis=0) for vine in new]
        for k in np.argsort(-_left(np.stack(many)))[:MOST_VINES_TRIED]:
            yield np.flatnonzero((self.efforts < NEW_VINE) | (self.vines == new[k]))

    def _design(self, allowed: NDArray[np.intp], wanted: float, most: int) -> list[int]:
        """Pairs added one by one until they have the wanted information, exchanged, and left out where not needed."""
        chosen: list[int] = []
        now = self.information(())
        while now < wanted and len(chosen) < most:
            total = self._total(chosen)
            gains = [(_left(total + count * self.each[allowed]) - now) / count for count in AT_ONCE]
            at_once, place = np.unravel_index(int(np.argmax(gains)), (len(AT_ONCE), allowed.size))
            if not gains[at_once][place] > 0:
                break
            chosen += [int(allowed[place])] * min(AT_ONCE[at_once], most - len(chosen))
            now = self.information(chosen)
        chosen = self._exchanged(chosen, allowed)
        while len(chosen) > 1:
            least = self._least_telling(chosen)
            fewer = self._exchanged(chosen[:least] + chosen[least + 1 :], allowed)
            if self.information(fewer) < wanted:
                break
            chosen = fewer
        return self._ordered(chosen)

    def _least_telling(self, chosen: Sequence[int]) -> int:
        total = self._total(chosen)
        return int(np.argmax(_left(total - self.each[list(chosen)])))

    def _exchanged(self, chosen: list[int], allowed: NDArray[np.intp]) -> list[int]:
        """The same number of trials, exchanged one after the other for better ones until none gains."""
        chosen = list(chosen)
        now = self.information(chosen)
        for _ in range(MOST_PASSES):
            before = now
            for k in range(len(chosen)):
                others = _left(self._total(chosen[:k] + chosen[k + 1 :]) + self.each[allowed])
                if np.max(others) > GAIN * now:
                    chosen[k], now = int(allowed[int(np.argmax(others))]), float(np.max(others))
            if now <= before:
                break
        return chosen

    def _ordered(self, chosen: Sequence[int]) -> list[int]:
        """The same trials, the most telling first."""
        left: list[int] = list(chosen)
        order: list[int] = []
        while left:
            gains = _left(self._total(order) + self.each[left])
            order.append(left.pop(int(np.argmax(gains))))
        return order


def _questions(design: CampaignDesign, added: Sequence[Condition], candidates: tuple[str, ...] | None) -> MisfitTests:
    """A design with one trial of each condition, without noise, held against the candidates."""
    longest_s = max(camera.longest_s for camera in design.cameras)
    values: dict[str, Value] = {}
    known = design.model.values.get(DAMPING)
    new = {c.trial.vine: c for c in added if c.trial.vine not in {trial.vine for trial in design.trials}}
    if new and known is not None:
        B = dict(known) if isinstance(known, Mapping) else {trial.vine: float(known) for trial in design.trials}
        for vine, condition in new.items():
            like, trial = design.trials[condition.like], condition.trial
            printed = [damping_prior(sized.diameter_m, sized.thickness_m) for sized in (trial, like)]
            B[vine] = B[like.vine] * printed[0] / printed[1]
        values = {DAMPING: B}
    places = [condition.like for condition in added]
    extended = replace(
        design,
        model=design.model.with_values(values),
        trials=(*design.trials, *(condition.trial for condition in added)),
        cameras=(
            *design.cameras,
            *(replace(design.cameras[k], stops_s=math.inf, longest_s=longest_s) for k in places),
        ),
        slow_error_m=(*design.slow_error_m, *(design.slow_error_m[k] for k in places)),
        has_trace=(*design.has_trace, *(design.has_trace[k] for k in places)),
        candidates=candidates,
    )
    return planned_tests(extended)[0]


def _wide(asked: MisfitTests, effect: str) -> Floats:
    """Cross products of each trial among free numbers, shared systematic errors and the effect, in this order."""
    fit, sums, problem = asked.fit, asked.products, asked.fit.solution.problem
    blocks = blocks_of(fit, sums, fit.state)
    keys, free, n = sums.n_keys, problem.prior_mean.size, len(blocks)
    shape = keys + 1 + typical_shape_index(asked, effect)
    systematics = np.arange(keys + 1 + sums.n_shapes, blocks.shape[1])
    columns = np.concatenate([np.arange(keys), systematics, [shape]])
    taken = blocks[:, columns[:, None], columns]
    size = free + sums.n_doubts + 1
    # What a trial does not feel, number or error, goes into a last row and column that is thrown away.
    felt = np.where(sums.places < sums.n_doubts, free + sums.places, size)
    index = np.concatenate([np.where(problem.index < 0, size, problem.index), felt, np.full((n, 1), size - 1)], axis=1)
    wide = np.zeros((n, size + 1, size + 1))
    np.add.at(wide, (np.arange(n)[:, None, None], index[:, :, None], index[:, None, :]), taken)
    return wide[:, :size, :size]


def _prior(asked: MisfitTests) -> Floats:
    """What is known of the same numbers beforehand: systematic errors have standard deviation 1."""
    free = asked.fit.solution.problem.prior_precision
    return np.diag(np.concatenate([np.maximum(free, UNSEEN), np.ones(asked.products.n_doubts), [0.0]]))


def _left(totals: Floats) -> Floats:
    """Information about the last number beside all others, shape (n_designs,)."""
    across = totals[:, :-1, -1]
    solved = np.linalg.solve(totals[:, :-1, :-1], across[:, :, None])[:, :, 0]
    return np.asarray(np.maximum(totals[:, -1, -1] - np.sum(across * solved, axis=1), 0.0))


def _judged(design: CampaignDesign, search: _Search, plan: FurtherTrials, chosen: Sequence[int]) -> FurtherTrials:
    """The plan with these trials, as many as it takes, and the probability after each."""
    distinct = list(dict.fromkeys(chosen))
    asked = _questions(design, [search.conditions[k] for k in distinct], design.candidates)
    places = {trial.name: k for k, trial in enumerate(asked.fit.trials)}
    so_far = [places[trial.name] for trial in design.trials if trial.name in places]
    trials: list[AddedTrial] = []
    power, probability = plan.power, plan.before
    for count, k in enumerate(chosen, 1):
        condition = search.conditions[k]
        made = [places[search.conditions[j].trial.name] for j in chosen[:count] for _ in range(REPLICATES)]
        power = effect_power(_of_trials(asked, [*so_far, *made]), plan.effect) or power
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
    endless = power.probability_at(power.zero + ratio * (plan.value - power.zero))
    return replace(plan, trials=tuple(trials), power=power, unlimited=max(endless, probability))


def _of_trials(asked: MisfitTests, places: Sequence[int]) -> MisfitTests:
    """The same questions of some of the trials, some of them several times."""
    where = list(places)
    fit, problem, state = asked.fit, asked.fit.solution.problem, asked.fit.state
    layout = asked.fit.predictor.layout
    predictor = Predictor(
        replace(layout, index=layout.index[where], base=layout.base[where]),
        [fit.predictor.data[k] for k in where],
        fit.predictor.host,
    )
    predictor.steps = fit.predictor.steps.copy()
    predictor.pressure_step = fit.predictor.pressure_step[where]
    smaller = replace(
        problem,
        index=problem.index[where],
        has_deviation=problem.has_deviation[where],
        gauge_error=problem.gauge_error[where],
        release_origin_mean=problem.release_origin_mean[where],
        release_origin_precision=problem.release_origin_precision[where],
        points=problem.points[where],
        stretches=problem.stretches[where],
    )
    here = replace(state, trial_effects=state.trial_effects[where], variance=state.variance[where])
    solution = replace(
        fit.solution,
        state=here,
        problem=smaller,
        cross_products=fit.solution.cross_products[where],
        columns=tuple(fit.solution.columns[k] for k in where),
    )
    part = replace(fit, predictor=predictor, solution=solution, trials=tuple(fit.trials[k] for k in where), smooth=None)
    sums = asked.products.of(where)
    answers = replace(asked.sensitivities, columns=[asked.sensitivities.columns[k] for k in where])
    return replace(asked, fit=part, products=sums, sensitivities=answers, scores=scores_of(part, sums))
