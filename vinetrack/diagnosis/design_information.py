"""Information of candidate designs about the sizes of effects, by linear theory.

With trial effects eliminated, the cross products of free parameters, shared systematic errors and the shapes of the
effects add up over trials. Of a design with n_c trials of condition c, and the trials so far,

    M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa

is the information about the sizes a with all other unknowns ν free: its diagonal is about each effect alone, and I_ee −
I_ef² / I_ff about effect e with effect f free as well. One trial of every condition is therefore simulated once, and
designs are evaluated by linear algebra.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.linear_power import typical_shape_index
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.score_test import scores_of
from vinetrack.diagnosis.shape_products import products_without_trial_effects
from vinetrack.dynamics.model import Value
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.sensitivity import Predictor
from vinetrack.planning.campaign_information import FEWEST_GROWTH_FRAMES
from vinetrack.planning.feasible_trials import Condition
from vinetrack.planning.scaling_priors import damping_prior

REPLICATES = 2  # Trials of a condition that are added at a time (chosen)

UNLIMITED_TRIALS = 1000  # Trials of each condition that stand for unlimited replicates (chosen)

# Prior precision of parameters that no trial determines yet, such as B of a vine that has not been made (chosen)
NOMINAL_PRECISION = 1e-6

# Most passes of the exchange, and the ratio of worth from which a trial is exchanged (chosen)
MAX_EXCHANGE_PASSES, LEAST_GAIN = 3, 1.002

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
        for _ in range(MAX_EXCHANGE_PASSES):
            before = now
            for k in range(len(chosen)):
                others = worth(self.total(chosen[:k] + chosen[k + 1 :]) + self.each[allowed])
                if np.max(others) > LEAST_GAIN * now:
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
    free = np.maximum(tests.fit.solution.problem.prior_precision, NOMINAL_PRECISION)
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
