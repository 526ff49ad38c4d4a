"""The fewest further trials that give an effect of some size a target power, by linear theory.

With trial effects eliminated, the cross products of free parameters, shared systematic errors and the shape of the
effect add up over trials. Of a design with n_c trials of condition c, and the trials so far,

    M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa

is the information about the size a with all other unknowns ν free. One trial of every condition is therefore simulated
once, and designs are evaluated by linear algebra: pairs of replicates are added one by one, each the one with the
largest I, then exchanged until none gains (Fedorov 1972, Theory of Optimal Experiments). The power of each of these
designs is computed by `vinetrack.diagnosis.linear_power` among all candidates: with thresholds, the scatter of single
trials, and what the fit without the effect takes for scatter.
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
from vinetrack.diagnosis.shape_products import products_without_trial_effects
from vinetrack.dynamics.model import Value
from vinetrack.experiment.settings import Limits
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.sensitivity import Predictor
from vinetrack.planning.campaign_information import FEWEST_GROWTH_FRAMES
from vinetrack.planning.feasible_trials import NEW_VINE, OTHER_RIG, SAME_RIG, Condition, feasible_conditions
from vinetrack.planning.scaling_priors import damping_prior

MAX_ADDED_TRIALS = 48
"""Most further trials considered where `limits.trials` is not stated. Chosen: a day of filming; at half some effects
that a day would reveal are given up, at twice nobody films them."""

UNLIMITED_TRIALS = 1000
"""Trials of each condition that stand for unlimited replicates. Chosen: what scatters from trial to trial is then
thirty times smaller; at half or twice what is left is the shared error all the same."""

REPLICATES = 2
"""Trials of a condition that are added at a time. Chosen: a single trial has no replicate to confirm it; with three a
plan is up to two trials longer than needed, with two up to one."""

PAIRS_PER_STEP = (1, 2)
"""Pairs of one condition that are added at a time; the best gain a pair counts. Chosen: the first trials of a vine
mainly determine its B."""

MAX_EXCHANGE_PASSES, LEAST_INFORMATION_GAIN = 3, 1.002
"""Most passes of the exchange, and the ratio of information from which a trial is exchanged. Chosen: the exchange
usually ends after two passes; a gain of 0.2 % is 0.1 % of a detectable size."""

NOMINAL_PRECISION = 1e-6
"""Prior precision of parameters that no trial determines yet, such as B of a vine that has not been made. Chosen: a
standard deviation of a thousand, in ln B, is uninformative."""

TYPICAL_REQUIRED_SCORE = 4.7
"""Score that a size needs where the trials so far have no information about it. Derived: threshold of a candidate at
0.3 % for the family, about 3.4, and 1.28 for a power of 90 %."""

EFFORT_WORDS = {SAME_RIG: "on the rig so far", OTHER_RIG: "with another rig", NEW_VINE: "with a new vine"}
"""What further trials need, in order of effort."""

SEARCH_ROUNDS = 3
"""Searches, each with the required information corrected by the shortfall of the one before. Chosen: thresholds and
scatter change with the trials by a tenth, after two rounds by a hundredth."""

MAX_VINES_TRIED = 2
"""New vines that are tried, one at a time. Chosen for time."""


def further_trials(
    design: CampaignDesign, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Find the fewest further trials that give an effect of some size a target power.

    Parameters
    ----------
    design : of the trials so far, or of a sheet.
    now : power of these trials for the effect.
    value : float
        Of its parameter, SI.
    target : float
        Power to reach, below 1.
    limits : Limits, optional
        Within which further trials can be made; what they leave open is as in the trials so far. `limits.trials` counts
        where it is stated.

    Returns
    -------
    FurtherTrials

    Raises
    ------
    FitError
        If further trials cannot be simulated.
    """
    limits = limits or Limits()
    most = limits.trials if "trials" in limits.model_fields_set else MAX_ADDED_TRIALS
    before = now.probability_at(value)
    plan = FurtherTrials(now.effect, now.parameter, now.symbol, now.unit, value, target, before, power=now)
    feasible = feasible_conditions(design.trials, limits)
    if before >= target or not feasible:
        return replace(plan, unlimited=before)
    search = _Search(design, feasible, now.effect)
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


class _Search:
    """Designs evaluated by the information about one effect with everything else free.

    `conditions` are those that can be filmed; `each`, shape (n_conditions, n, n), is what a pair of trials of each
    adds.
    """

    def __init__(self, design: CampaignDesign, every: Sequence[Condition], effect: str) -> None:
        tests = _tests_of(design, every, (effect,))
        names = [trial.name for trial in tests.fit.trials]
        moving = [trial_data.time_s.size - trial_data.n_rest for trial_data in tests.fit.predictor.data]
        blocks = _products_by_trial(tests, effect)
        before = {trial.name for trial in design.trials}
        filmed = {name: k for k, name in enumerate(names) if name not in before and moving[k] >= FEWEST_GROWTH_FRAMES}
        self.conditions = tuple(condition for condition in every if condition.trial.name in filmed)
        self.each = REPLICATES * blocks[[filmed[condition.trial.name] for condition in self.conditions]]
        done = [k for k, name in enumerate(names) if name in before]
        self.so_far = _prior_precision(tests) + blocks[done].sum(axis=0)
        self.efforts = np.array([condition.effort for condition in self.conditions])
        self.vines = np.array([condition.trial.vine for condition in self.conditions])

    def information(self, chosen: Sequence[int]) -> float:
        """Information about the size from these trials and those so far."""
        return float(_effect_information(self._total(chosen)[None])[0])

    def _total(self, chosen: Sequence[int]) -> Floats:
        return np.asarray(self.so_far + self.each[list(chosen)].sum(axis=0))

    def unlimited_information(self) -> float:
        """Information with unlimited trials of all conditions."""
        return float(_effect_information((self.so_far + UNLIMITED_TRIALS * self.each.sum(axis=0))[None])[0])

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
        for k in np.argsort(-_effect_information(np.stack(unlimited)))[:MAX_VINES_TRIED]:
            yield np.flatnonzero((self.efforts < NEW_VINE) | (self.vines == new[k]))

    def _design(self, allowed: NDArray[np.intp], wanted: float, most: int) -> list[int]:
        """Pairs added one by one up to the wanted information, exchanged, and removed where not needed."""
        chosen: list[int] = []
        information = self.information(())
        while information < wanted and len(chosen) < most:
            total = self._total(chosen)
            gains = [
                (_effect_information(total + count * self.each[allowed]) - information) / count
                for count in PAIRS_PER_STEP
            ]
            step, index = np.unravel_index(int(np.argmax(gains)), (len(PAIRS_PER_STEP), allowed.size))
            if not gains[step][index] > 0:
                break
            chosen += [int(allowed[index])] * min(PAIRS_PER_STEP[step], most - len(chosen))
            information = self.information(chosen)
        chosen = self._exchanged(chosen, allowed)
        while len(chosen) > 1:
            least = self._least_informative(chosen)
            fewer = self._exchanged(chosen[:least] + chosen[least + 1 :], allowed)
            if self.information(fewer) < wanted:
                break
            chosen = fewer
        return self._most_informative_first(chosen)

    def _least_informative(self, chosen: Sequence[int]) -> int:
        total = self._total(chosen)
        return int(np.argmax(_effect_information(total - self.each[list(chosen)])))

    def _exchanged(self, chosen: list[int], allowed: NDArray[np.intp]) -> list[int]:
        """The same number of trials, each exchanged for a better one until none gains."""
        chosen = list(chosen)
        now = self.information(chosen)
        for _ in range(MAX_EXCHANGE_PASSES):
            before = now
            for k in range(len(chosen)):
                others = _effect_information(self._total(chosen[:k] + chosen[k + 1 :]) + self.each[allowed])
                if np.max(others) > LEAST_INFORMATION_GAIN * now:
                    chosen[k], now = int(allowed[int(np.argmax(others))]), float(np.max(others))
            if now <= before:
                break
        return chosen

    def _most_informative_first(self, chosen: Sequence[int]) -> list[int]:
        """The same trials, in order of the information they add."""
        remaining: list[int] = list(chosen)
        order: list[int] = []
        while remaining:
            gains = _effect_information(self._total(order) + self.each[remaining])
            order.append(remaining.pop(int(np.argmax(gains))))
        return order


def _tests_of(design: CampaignDesign, added: Sequence[Condition], candidates: tuple[str, ...] | None) -> MisfitTests:
    """Misfit tests of a noise-free design with one trial of each condition added."""
    longest_s = max(camera.longest_s for camera in design.cameras)
    values: dict[str, Value] = {}
    stated_B = design.model.values.get(DAMPING)
    new = {c.trial.vine: c for c in added if c.trial.vine not in {trial.vine for trial in design.trials}}
    if new and stated_B is not None:
        B = (
            dict(stated_B)
            if isinstance(stated_B, Mapping)
            else {trial.vine: float(stated_B) for trial in design.trials}
        )
        for vine, condition in new.items():
            like, trial = design.trials[condition.like], condition.trial
            scaled = [damping_prior(sized.diameter_m, sized.thickness_m) for sized in (trial, like)]
            B[vine] = B[like.vine] * scaled[0] / scaled[1]
        values = {DAMPING: B}
    like_trials = [condition.like for condition in added]
    extended = replace(
        design,
        model=design.model.with_values(values),
        trials=(*design.trials, *(condition.trial for condition in added)),
        cameras=(
            *design.cameras,
            *(replace(design.cameras[k], stops_s=math.inf, longest_s=longest_s) for k in like_trials),
        ),
        slow_error_m=(*design.slow_error_m, *(design.slow_error_m[k] for k in like_trials)),
        has_trace=(*design.has_trace, *(design.has_trace[k] for k in like_trials)),
        candidates=candidates,
    )
    return planned_tests(extended)[0]


def _products_by_trial(tests: MisfitTests, effect: str) -> Floats:
    """Cross products of each trial: free parameters, shared systematic errors and the effect, in this order."""
    fit, products, problem = tests.fit, tests.products, tests.fit.solution.problem
    blocks = products_without_trial_effects(fit, products, fit.state)
    keys, free, n = products.n_keys, problem.prior_mean.size, len(blocks)
    shape = keys + 1 + typical_shape_index(tests, effect)
    systematics = np.arange(keys + 1 + products.n_shapes, blocks.shape[1])
    columns = np.concatenate([np.arange(keys), systematics, [shape]])
    selected = blocks[:, columns[:, None], columns]
    size = free + products.n_systematics + 1
    # Unknowns that a trial does not depend on are collected in a last row and column, which is dropped.
    of_systematics = np.where(products.places < products.n_systematics, free + products.places, size)
    of_effect = np.full((n, 1), size - 1)
    index = np.concatenate([np.where(problem.index < 0, size, problem.index), of_systematics, of_effect], axis=1)
    aligned = np.zeros((n, size + 1, size + 1))
    np.add.at(aligned, (np.arange(n)[:, None, None], index[:, :, None], index[:, None, :]), selected)
    return aligned[:, :size, :size]


def _prior_precision(tests: MisfitTests) -> Floats:
    """Prior precision of the same unknowns: systematic errors have standard deviation 1."""
    free = tests.fit.solution.problem.prior_precision
    return np.diag(np.concatenate([np.maximum(free, NOMINAL_PRECISION), np.ones(tests.products.n_systematics), [0.0]]))


def _effect_information(totals: Floats) -> Floats:
    """Information about the last unknown with all others free, shape (n_designs,)."""
    cross = totals[:, :-1, -1]
    solved = np.linalg.solve(totals[:, :-1, :-1], cross[:, :, None])[:, :, 0]
    return np.asarray(np.maximum(totals[:, -1, -1] - np.sum(cross * solved, axis=1), 0.0))


def _evaluated(design: CampaignDesign, search: _Search, plan: FurtherTrials, chosen: Sequence[int]) -> FurtherTrials:
    """The plan with as many of these trials as needed, and the power after each."""
    unique = list(dict.fromkeys(chosen))
    tests = _tests_of(design, [search.conditions[k] for k in unique], design.candidates)
    index_of = {trial.name: k for k, trial in enumerate(tests.fit.trials)}
    so_far = [index_of[trial.name] for trial in design.trials if trial.name in index_of]
    trials: list[AddedTrial] = []
    power, probability = plan.power, plan.before
    for count, k in enumerate(chosen, 1):
        condition = search.conditions[k]
        added = [index_of[search.conditions[j].trial.name] for j in chosen[:count] for _ in range(REPLICATES)]
        power = effect_power(_with_trials(tests, [*so_far, *added]), plan.effect) or power
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


def _with_trials(tests: MisfitTests, indices: Sequence[int]) -> MisfitTests:
    """The same tests for some of the trials, which may be repeated."""
    where = list(indices)
    fit, problem, state = tests.fit, tests.fit.solution.problem, tests.fit.state
    layout = tests.fit.predictor.layout
    predictor = Predictor(
        replace(layout, index=layout.index[where], base=layout.base[where]),
        [fit.predictor.data[k] for k in where],
        fit.predictor.host,
    )
    predictor.steps = fit.predictor.steps.copy()
    predictor.pressure_step = fit.predictor.pressure_step[where]
    problem = replace(
        problem,
        index=problem.index[where],
        has_deviation=problem.has_deviation[where],
        gauge_error=problem.gauge_error[where],
        release_origin_mean=problem.release_origin_mean[where],
        release_origin_precision=problem.release_origin_precision[where],
        points=problem.points[where],
        stretches=problem.stretches[where],
    )
    state = replace(state, trial_effects=state.trial_effects[where], variance=state.variance[where])
    solution = replace(
        fit.solution,
        state=state,
        problem=problem,
        cross_products=fit.solution.cross_products[where],
        columns=tuple(fit.solution.columns[k] for k in where),
    )
    part = replace(fit, predictor=predictor, solution=solution, trials=tuple(fit.trials[k] for k in where), smooth=None)
    products = tests.products.of(where)
    sensitivities = replace(tests.sensitivities, columns=[tests.sensitivities.columns[k] for k in where])
    return replace(tests, fit=part, products=products, sensitivities=sensitivities, scores=scores_of(part, products))
