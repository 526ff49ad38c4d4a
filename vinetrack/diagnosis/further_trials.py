"""The fewest further trials that give an effect of some size a target power, by linear theory.

Designs are evaluated by their information about the size (`design_information`): pairs of replicates are added one by
one, each the one with the largest information, then exchanged until none gains (Fedorov 1972, Theory of Optimal
Experiments). The power of each of these designs is computed by `vinetrack.diagnosis.linear_power` among all candidates:
with thresholds, the scatter of single trials, and what the fit without the effect takes for scatter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from vinetrack.core.records import Floats
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.linear_power import effect_power, power_of, typical_shape_index
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.next_experiment import trial_entries
from vinetrack.diagnosis.power import AddedTrial, EffectPower, FurtherTrials, Power
from vinetrack.diagnosis.score_test import products_without_trial_effects, scores_of
from vinetrack.dynamics.model import Value
from vinetrack.experiment.settings import Limits
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.sensitivity import Predictor
from vinetrack.planning.discriminating_design import NEW_VINE, OTHER_RIG, SAME_RIG, Condition, feasible_conditions
from vinetrack.planning.predictive_inputs import damping_prior
from vinetrack.planning.simulated_campaigns import FEWEST_GROWTH_FRAMES

# ------------------------------------------------------------------------------
# Information of candidate designs about the sizes of effects, by linear theory.
#
# With trial effects eliminated, the cross products of free parameters, shared systematic errors and the shapes of the
# effects add up over trials. Of a design with n_c trials of condition c, and the trials so far,
#
#     M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa
#
# is the information about the sizes a with all other unknowns ν free: its diagonal is about each effect alone, and
# I_ee − I_ef² / I_ff about effect e with effect f free as well. One trial of every condition is therefore simulated
# once, and designs are evaluated by linear algebra.

REPLICATES = 2  # Trials of a condition that are added at a time (chosen)

UNLIMITED_TRIALS = 1000  # Trials of each condition that stand for unlimited replicates (chosen)


Worth = Callable[[Floats], Floats]  # Worth of designs, shape (n_designs,), from their cross products, shape


class DesignInformation:
    """Information of designs about the sizes of some effects with everything else free. `conditions` are those that can
    be filmed; `efforts` and `vines`, shape (n_conditions,), are theirs; `each`, shape (n_conditions, n, n), is what a
    group of `REPLICATES` trials of each adds, the effects last.
    """

    def __init__(self, design: CampaignDesign, every: Sequence[Condition], effects: Sequence[str]) -> None:
        tests = tests_with_conditions(design, every, tuple(effects))
        shapes = {name: typical_shape_index(tests, name) for name in effects if name in tests.sensitivities.effects}
        indices = {name: index for name, index in shapes.items() if index is not None}
        self.effects = list(indices)
        names = [trial.name for trial in tests.fit.trials]
        moving = [trial_data.time_s.size - trial_data.n_rest for trial_data in tests.fit.predictor.data]
        blocks = _products_by_trial(tests, list(indices.values()))
        before = {trial.name for trial in design.trials}
        filmed = {name: k for k, name in enumerate(names) if name not in before and moving[k] >= FEWEST_GROWTH_FRAMES}
        self.conditions = tuple(condition for condition in every if condition.trial.name in filmed)
        self.each = REPLICATES * blocks[[filmed[condition.trial.name] for condition in self.conditions]]
        done = [k for k, name in enumerate(names) if name in before]
        self.so_far = _prior_precision(tests, len(self.effects)) + blocks[done].sum(axis=0)
        self.efforts = np.array([condition.effort for condition in self.conditions])
        self.vines = np.array([condition.trial.vine for condition in self.conditions])

    def total(self, chosen: Sequence[int]) -> Floats:
        """Cross products of the trials so far and of a design. Shape (n, n)."""
        return np.asarray(self.so_far + self.each[list(chosen)].sum(axis=0))

    def information_of(self, totals: Floats) -> Floats:
        """Information about the sizes of the effects with all other unknowns free. Shapes: totals (n_designs, n, n) →
        (n_designs, n_effects, n_effects).
        """
        count = len(self.effects)
        cross = totals[:, :-count, -count:]
        solved = np.linalg.solve(totals[:, :-count, :-count], cross)
        return np.asarray(totals[:, -count:, -count:] - np.swapaxes(cross, 1, 2) @ solved)

    def exchanged(self, chosen: Sequence[int], allowed: NDArray[np.intp], worth: Worth) -> list[int]:
        """The same number of groups, each exchanged for a better one until none gains."""
        chosen = list(chosen)
        now = float(worth(self.total(chosen)[None])[0])
        # 3, 1.002: most passes of the exchange, and the ratio of worth from which a trial is exchanged (chosen)
        for _ in range(3):
            before = now
            for k in range(len(chosen)):
                others = worth(self.total(chosen[:k] + chosen[k + 1 :]) + self.each[allowed])
                if np.max(others) > 1.002 * now:
                    chosen[k], now = int(allowed[int(np.argmax(others))]), float(np.max(others))
            if now <= before:
                break
        return chosen

    def first_information(self, totals: Floats) -> Floats:
        """Information about the first effect alone, shape (n_designs,)."""
        return np.asarray(np.maximum(self.information_of(totals)[:, 0, 0], 0.0))


def tests_with_conditions(
    design: CampaignDesign, added: Sequence[Condition], candidates: tuple[str, ...] | None
) -> MisfitTests:
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


def _products_by_trial(tests: MisfitTests, indices: Sequence[int]) -> Floats:
    """Cross products of each trial: free parameters, shared systematic errors and effects of these shapes, in order."""
    fit, products, problem = tests.fit, tests.products, tests.fit.solution.problem
    blocks = products_without_trial_effects(fit, products, fit.state)
    keys, free, n = products.n_keys, problem.prior_mean.size, len(blocks)
    shapes = [keys + 1 + index for index in indices]
    systematics = np.arange(keys + 1 + products.n_shapes, blocks.shape[1])
    columns = np.concatenate([np.arange(keys), systematics, shapes])
    selected = blocks[:, columns[:, None], columns]
    size = free + products.n_systematics + len(shapes)
    # Unknowns that a trial does not depend on are collected in a last row and column, which is dropped.
    of_systematics = np.where(products.places < products.n_systematics, free + products.places, size)
    of_effects = np.tile(np.arange(size - len(shapes), size), (n, 1))
    index = np.concatenate([np.where(problem.index < 0, size, problem.index), of_systematics, of_effects], axis=1)
    aligned = np.zeros((n, size + 1, size + 1))
    np.add.at(aligned, (np.arange(n)[:, None, None], index[:, :, None], index[:, None, :]), selected)
    return aligned[:, :size, :size]


def _prior_precision(tests: MisfitTests, n_effects: int) -> Floats:
    """Prior precision of the same unknowns: systematic errors have standard deviation 1, sizes of effects none."""
    # 1e-6: prior precision of parameters that no trial determines yet, such as B of a vine that has not been made
    # (chosen)
    free = np.maximum(tests.fit.solution.problem.prior_precision, 1e-6)
    return np.diag(np.concatenate([free, np.ones(tests.products.n_systematics), np.zeros(n_effects)]))


def with_trials(tests: MisfitTests, indices: Sequence[int]) -> MisfitTests:
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


# What further trials need, in order of effort
EFFORT_WORDS = {SAME_RIG: "on the rig so far", OTHER_RIG: "with another rig", NEW_VINE: "with a new vine"}


def further_trials(
    design: CampaignDesign, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Find the fewest further trials that give an effect of some size a target power."""
    limits = limits or Limits()
    # 48: most further trials considered where `limits.trials` is not stated (chosen)
    most = limits.trials if "trials" in limits.model_fields_set else 48
    before = now.probability_at(value)
    plan = FurtherTrials(now.effect, now.parameter, now.symbol, now.unit, value, target, before, power=now)
    feasible = feasible_conditions(design.trials, limits)
    if before >= target or not feasible:
        return replace(plan, unlimited=before)
    search = _Search(design, feasible, (now.effect,))
    deviation = abs(value - now.zero)
    wanted = search.information(()) * (abs(now.size_at(target) - now.zero) / deviation) ** 2
    if not math.isfinite(wanted):
        # 4.7: score that a size needs where the trials so far have no information about it (derived)
        wanted = (4.7 / deviation) ** 2
    # 3: searches, each with the required information corrected by the shortfall of the one before (chosen)
    for _ in range(3):
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
        # 2: new vines that are tried, one at a time (chosen)
        for k in np.argsort(-self.first_information(np.stack(unlimited)))[:2]:
            yield np.flatnonzero((self.efforts < NEW_VINE) | (self.vines == new[k]))

    def _design(self, allowed: NDArray[np.intp], wanted: float, most: int) -> list[int]:
        """Pairs added one by one up to the wanted information, exchanged, and removed where not needed."""
        pairs_per_step = (1, 2)  # Pairs of one condition that are added at a time; the best gain a pair counts (chosen)
        chosen: list[int] = []
        information = self.information(())
        while information < wanted and len(chosen) < most:
            total = self.total(chosen)
            gains = [
                (self.first_information(total + count * self.each[allowed]) - information) / count
                for count in pairs_per_step
            ]
            step, index = np.unravel_index(int(np.argmax(gains)), (len(pairs_per_step), allowed.size))
            if not gains[step][index] > 0:
                break
            chosen += [int(allowed[index])] * min(pairs_per_step[step], most - len(chosen))
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


# ------------------------------------------------------------------------------
# Further trials for a campaign that goes on: those that reveal most where nothing is found, or confirm what is named.
#
# A size a of an effect is detected with probability Φ(a √I − c), with I the information about it
# (`design_information`) and c the threshold of its score. Averaged over sizes spread evenly in their logarithm over
# the decade below the largest plausible one, and summed over all candidates, that is the expected number of effects
# that a design would detect if each were missing in turn. With I_ee − I_ef² / I_ff in place of I, for the most
# similar other candidate f, it is the expected number that it would tell from every other. The design with the
# largest sum of both is found by adding pairs of trials one by one and exchanging them (Fedorov 1972, Theory of
# Optimal Experiments).

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
    """Find the further trials within the limits that would reveal most of what could be missing."""
    limits = limits or Limits()
    feasible = feasible_conditions(design.trials, limits.model_copy(update={"new_vines": False}))
    if not feasible or not power.effects:
        return None
    search = _InformativeTrialsSearch(design, feasible, power)
    if not search.conditions or not search.effects:
        return None
    chosen = search.best(max(limits.trials // REPLICATES, 1))
    before, after = search.total(())[None], search.total(chosen)[None]
    if not search.expected_discoveries(after)[0] > search.expected_discoveries(before)[0]:
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


class _InformativeTrialsSearch(DesignInformation):
    """The design that is worth most."""

    def __init__(self, design: CampaignDesign, every: Sequence[Condition], power: Power) -> None:
        super().__init__(design, every, [entry.effect for entry in power.effects])
        self.largest = np.array([abs(power[name].largest - power[name].zero) for name in self.effects])
        self.required = power.threshold

    def expected_discoveries(self, totals: Floats) -> Floats:
        """Expected numbers of effects that are detected, and that are told from all others, added up."""
        alone, distinct = _alone_and_distinct(self.information_of(totals))
        return self._expected(alone) + self._expected(distinct)

    def _expected(self, information: Floats) -> Floats:
        """Expected number of effects detected with this information about each, shape (n_designs,)."""
        scores = SIZES[:, None, None] * self.largest * np.sqrt(information)
        return np.asarray(ndtr(scores - self.required).mean(axis=0).sum(axis=1))

    def best(self, count: int) -> list[int]:
        """As many groups of trials, added one by one and exchanged."""
        chosen: list[int] = []
        for _ in range(count):
            chosen.append(int(np.argmax(self.expected_discoveries(self.total(chosen) + self.each))))
        return self.exchanged(chosen, np.arange(len(self.conditions)), self.expected_discoveries)


def _alone_and_distinct(information: Floats) -> tuple[Floats, Floats]:
    """Information about each effect, alone and with its most similar rival free, shape (n_designs, n_effects)."""
    alone = np.maximum(np.diagonal(information, axis1=1, axis2=2), 0.0)
    shared = information**2 / np.maximum(alone, 1e-300)[:, None, :]
    diagonal = np.arange(alone.shape[1])
    shared[:, diagonal, diagonal] = 0.0
    return alone, np.maximum(alone - shared.max(axis=2), 0.0)
