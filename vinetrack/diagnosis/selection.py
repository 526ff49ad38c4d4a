"""Forward selection of missing effects: from a fitted model to the verdict of every round.

Misfit tests decide whether anything is missing. If so, candidates are fitted, compared by likelihood ratios, and those
that cannot be excluded form the answer set. A hypothesis counts only if the model passes every test once the hypothesis
is added: first single effects are tried, then sets of two to five. If no set passes either, the verdict is
`unexplained`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from typing import Any

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.diagnosis.hypotheses import (
    ANSWER_SET_DELTA_CHI2,
    OUT_OF_REACH,
    LikelihoodRatio,
    answer_set,
    best_of,
    between_fits,
    differences,
    full_fit,
    implausible,
    in_sigmas,
    likelihood_ratio,
    robust_ratio,
    significant,
    size_in_errors,
    sizes_of,
    stand_in,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    SEARCH_SIGMAS,
    CandidateShape,
    MisfitTests,
    exceeds_slow_errors,
    has_excess_scatter,
    level_of,
    misfit_tests,
    plausible_range,
    slip_of,
)
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    MISSING,
    TAIL_SLACK,
    UNEXPLAINED,
    Confounder,
)
from vinetrack.dynamics.model import Model, Value, probe
from vinetrack.effects import Effect, Parameter
from vinetrack.inference.errors import assemble
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit
from vinetrack.inference.optimiser import is_poor_fit
from vinetrack.inference.sensitivity import Predictor

# ------------------------------------------------------------------------------
# Fits of effects, and of sets of them by forward steps: from the best sets of k effects, those are added that the score
# tests predict to improve the fit most.

MAX_EFFECTS = 5  # Largest number of effects in a set (chosen)

Names = frozenset[str]

Report = Callable[[str], None]  # Called with a few words on what is being done


class Search:
    """Sets of effects fitted from one model, by their names: the best fit of each."""

    def __init__(self, tests: MisfitTests, report: Report) -> None:
        self.tests, self.before, self.report = tests, tests.fit, report
        self.fitted: dict[Names, LikelihoodRatio] = {}
        self.tried: set[tuple[Names, str]] = set()
        self.tests_by_fit: list[tuple[Fit, MisfitTests]] = []

    def of_size(self, size: int) -> list[LikelihoodRatio]:
        """Fitted sets of this many effects, the highest likelihood first."""
        of_size = [hypothesis for names, hypothesis in self.fitted.items() if len(names) == size]
        return sorted(of_size, key=lambda hypothesis: -hypothesis.fit.log_likelihood)

    def tests_after(self, fit: Fit) -> MisfitTests:
        """Run the misfit tests of one of the fits, at the level of later rounds."""
        for tested_fit, tests in self.tests_by_fit:
            if tested_fit is fit:
                return tests
        tests = misfit_tests(with_curves(fit), self.tests.effects, FALSE_ALARM_LEVEL_LATER_ROUNDS)
        if is_large(fit):
            self.tests_by_fit.clear()
        self.tests_by_fit.append((fit, tests))
        return tests

    def extend(
        self, base: LikelihoodRatio | None = None, most: int | None = None, *, every: bool = False
    ) -> list[LikelihoodRatio]:
        """Add candidates of large predicted gain to a set, at `most` so many, or every one: a model that has adapted to
        the lack of an effect may predict no gain for it, not even the right sign. Returns all sets of this size.
        """
        tests, effects = (self.tests_after(base.fit), base.effects) if base else (self.tests, ())
        if not self.tried and is_poor_fit(self.before.solution):
            self._fit_from_afar()
        gains = {name: tests.predicted_gain(name) for name in dict.fromkeys(tests.products.effects)}
        # By significance: of several sizes, or sizes that scatter, chance gains more.
        names, of_base = sorted(gains, key=lambda name: -tests.best_z(name)), frozenset(one.name for one in effects)
        if not every:
            # 0.2: share of the best predicted gain from which an effect is fitted (chosen)
            least = 0.2 * max(gains.values(), default=0.0)
            names = [name for name in names if gains[name] > least][:most]
        for name in names:
            if (of_base, name) not in self.tried:
                self.tried.add((of_base, name))
                self._fit_from_prediction(tests, effects, name)
        for best in self.of_size(len(effects) + 1)[:1]:
            self._fit_contained(best)
        return self.of_size(len(effects) + 1)

    def _fit_contained(self, hypothesis: LikelihoodRatio) -> None:
        """Fit what a set contains as a limit, unless known, from where that ended: its own starts may not get there."""
        values = hypothesis.fit.model.values
        for effect in hypothesis.effects:
            for limit in (one for one in self.tests.effects if one.name in effect.replaces):
                members = [limit if one is effect else one for one in hypothesis.effects]
                asked = frozenset(hypothesis.names), limit.name  # once, whether or not it succeeds
                if asked not in self.tried and frozenset(one.name for one in members) not in self.fitted:
                    self.tried.add(asked)
                    shared = [p.name for p in limit.parameters if f"{effect.name}.{p.name}" in values]
                    start = {f"{limit.name}.{name}": values[f"{effect.name}.{name}"] for name in shared}
                    self._refit(hypothesis.fit, members, start=start)

    def higher_base(self, hypotheses: Sequence[LikelihoodRatio]) -> Fit | None:
        """A likelier fit of the model itself, from the best hypothesis where that gains without a size beyond two
        errors: the fit had ended in a local maximum, and that in a higher one. None where ln L rises by less than 1.
        """
        gaining = [one for one in hypotheses if one.delta_chi2 > ANSWER_SET_DELTA_CHI2 and not one.split]
        if not gaining or size_in_errors((best := answer_set(gaining)[0][0]).effects[0], best.fit) >= 2:
            return None
        fit = full_fit(best.fit, self.before.model, between=self.before.predictor.layout.between)
        return fit if fit and fit.log_likelihood > self.before.log_likelihood + 1 else None

    def _fit_from_afar(self) -> None:
        """Fit effects from sizes that no prediction reaches, a wrong power of ten, held until all else has adapted."""
        fixed = self.before.options["fixed"]
        for effect, size in [(one, size) for one in self.tests.effects for p in one.parameters[:1] for size in p.tried]:
            key = f"{effect.name}.{effect.parameters[0].name}"
            held = full_fit(self.before, self.before.model + effect, start={key: size}, fixed=(*fixed, key))
            if held is not None and held.log_likelihood > self.before.log_likelihood:
                self._keep_best(likelihood_ratio(self.before, (effect,), full_fit(held, fixed=fixed) or held))

    def _fit_from_prediction(self, tests: MisfitTests, effects: Sequence[Effect], name: str) -> None:
        """Add an effect in its shapes of largest predicted gain, then from its defaults, until one gains what is
        predicted: far from the truth a prediction is too small, and a fit from there may end with no effect at all.
        """
        self.report(f"fitting {name}")
        shapes, by_gain = tests.products.shapes, dict[float, int]()
        for index in tests.ranked_shapes(name):  # A size that differs between vines is fitted so from any start.
            if all(shapes[k].other_values != shapes[index].other_values for k in by_gain.values()):
                by_gain.setdefault(round(float(tests.predicted_gains[index]), 3), index)
        # 2: shapes of an effect from which it is fitted, before its usual values (chosen)
        of_gain = list(by_gain.values())[:2]
        starts = [start_values(shapes[index], float(tests.scores.size[index])) for index in of_gain]
        effect = shapes[of_gain[0]].effect
        for start in [*starts, {}] if len(effect.parameters) > 1 else starts:
            # A hypothesis whose sizes are not credible, however well it fits, is no reason to abandon the others.
            credible = (known.fit for known in self.of_size(len(effects) + 1) if known.plausible and known.credible)
            near = (fit.log_likelihood for fit in credible if not is_poor_fit(fit.solution))
            best, model = max(near, default=-math.inf), tests.fit.model + effect
            fit = full_fit(tests.fit, model, start=start, best=best)
            gain = -math.inf if fit is None else 2 * (fit.log_likelihood - tests.fit.log_likelihood)
            if fit is not None and gain >= -1.0:  # up to rounding, no worse than without the effect (derived)
                self._keep_best(likelihood_ratio(self.before, (*effects, effect), fit))
            # 0.7: share of its predicted gain that a fit must reach for no other shape to be tried (chosen)
            if gain > 0.7 * tests.predicted_gain(name):
                break

    def grow(self, size: int) -> list[LikelihoodRatio]:
        """Fit sets of this many effects, built on the best sets of one fewer. What the others have made needless in the
        best is taken out again; what is left is built on where it is the best of its size (floating search: Pudil et
        al., Pattern Recognition Letters 15, 1119, 1994).
        """
        # 3, 2: best single effects from which pairs are built, and best sets from which larger ones are (chosen)
        bases = self.of_size(size - 1)[: 3 if size == 2 else 2]
        for base in bases:
            # 0.3: share of the best set's gain from which larger ones are built on a set (chosen)
            if base.delta_chi2 >= 0.3 * bases[0].delta_chi2:
                # 3: partners tried with each base (chosen)
                self.extend(base, 3)
        for best in self.of_size(size)[:1]:
            least = min(best.effects, key=partial(size_in_errors, after=best.fit))
            smaller = self.subset(best, [effect for effect in best.effects if effect is not least], again=True)
            if smaller is not None and smaller.fit.log_likelihood > bases[0].fit.log_likelihood:
                self.extend(smaller, 3)
        return self.of_size(size)

    def subset(
        self, hypothesis: LikelihoodRatio, effects: Sequence[Effect], *, again: bool = False
    ) -> LikelihoodRatio | None:
        """Some members of a set alone, refitted from the set unless known already; None where no fit succeeds. `again`:
        what is known may have ended in a local minimum and make the others look needed; the better of the two counts.
        """
        names = frozenset(effect.name for effect in effects)
        if again or names not in self.fitted:
            self._refit(hypothesis.fit, effects)
        known = self.fitted.get(names)
        return None if known is None else replace(known, fit=with_curves(known.fit))

    def _refit(self, fit: Fit, effects: Sequence[Effect], **how: Any) -> None:
        """Keep a set that is fitted from another one, unless no fit succeeds."""
        if after := full_fit(fit, reduce(Model.__add__, effects, self.before.model), **how):
            self._keep_best(likelihood_ratio(self.before, effects, after))

    @cached_property
    def of_one_force(self) -> float:
        """Ln L of the model with one unknown force that depends on one variable: a bump along growth, speed or time,
        its place and width free.
        """
        self.report("fitting one unknown force")
        tests, fixed = self.tests.of_probes, (*self.before.options["fixed"], "probe_force.kind")
        found = []
        for kind in (0.0, 1.0, 2.0):
            along = [k for k, shape in enumerate(tests.products.shapes) if shape.other_values[0] == kind]
            best = max(along, key=lambda k: tests.predicted_gains[k], default=None)
            if best is not None:
                start = start_values(tests.products.shapes[best], float(tests.scores.size[best]))
                found.append(full_fit(self.before, self.before.model + probe(), start=start, fixed=fixed))
        return max((fit.log_likelihood for fit in found if fit is not None), default=-math.inf)

    def superfluous(self, hypothesis: LikelihoodRatio) -> Remark:
        """Why several effects need not be: one unknown force is as likely; or, of three or more, the first member whose
        significance given the others is too low, or not known.
        """
        if self.of_one_force > hypothesis.fit.log_likelihood - 0.5 * ANSWER_SET_DELTA_CHI2 * hypothesis.inflation:
            return remark("one_force_is_as_likely")
        for effect in hypothesis.effects if len(hypothesis.effects) > 2 else ():
            self.report(f"taking out {effect.name}")
            others = [other for other in hypothesis.effects if other is not effect]
            smaller = self.subset(hypothesis, others, again=True)
            sigmas = 0.0 if smaller is None else _worth(hypothesis, smaller, (effect,))
            required = self.tests_after((smaller or hypothesis).fit).family[effect.name]
            if sigmas < required:
                return remark("too_weak_in_set", effect=effect.name, sigmas=sigmas, required=required)
        return Remark()

    def implausible(self, hypothesis: LikelihoodRatio) -> Remark:
        """Why sizes that lie in their plausible ranges only for their errors are not plausible: refitted within them,
        the hypothesis can be excluded. Wide errors of sizes that make up for each other do not show that.
        """
        reason = implausible(hypothesis.effects, hypothesis.fit, errors=0.0) if hypothesis.plausible else Remark()
        if not reason:
            return reason
        bounded = [
            replace(one, parameters=tuple(replace(each, bounds=plausible_range(each)) for each in one.parameters))
            for one in hypothesis.effects
        ]
        within = full_fit(hypothesis.fit, reduce(Model.__add__, bounded, self.before.model))
        lost = math.inf if within is None else 2 * (hypothesis.fit.log_likelihood - within.log_likelihood)
        return reason if lost > ANSWER_SET_DELTA_CHI2 * hypothesis.inflation else Remark()

    def is_better(self, hypothesis: LikelihoodRatio, smaller: LikelihoodRatio | None = None) -> bool:
        """Whether a set is better than a smaller one, by default the best of one effect fewer, by the threshold of what
        it has more than the best one within it: a stricter criterion where the smaller one is another.
        """
        smaller = smaller or self.of_size(len(hypothesis.effects) - 1)[0]
        within = self.best_within(hypothesis) or smaller
        added = [effect for effect in hypothesis.effects if effect.name not in within.names]
        family = self.tests_after(within.fit).family
        return _worth(hypothesis, smaller, added) >= max(family[effect.name] for effect in added)

    def best_within(self, hypothesis: LikelihoodRatio) -> LikelihoodRatio | None:
        """The best set that lacks one effect of this one; None where none was fitted."""
        smaller = self.of_size(len(hypothesis.effects) - 1)
        return next((one for one in smaller if set(one.names) < set(hypothesis.names)), None)

    def partial_steps(self) -> tuple[LikelihoodRatio, ...]:
        """Steps, one effect each, to the largest set of plausible sizes in which each additional effect is significant;
        empty where they remove little of the misfit.
        """
        best: LikelihoodRatio | None = None
        for size in range(1, MAX_EFFECTS + 1):
            plausible = [each for each in self.of_size(size) if each.plausible and each.credible]
            if not plausible or (best is not None and not self.is_better(plausible[0], best)):
                break
            best = plausible[0]
        # 0.5: share of the excess of χ² per degree of freedom over 1 that they must remove to be shown (chosen)
        if best is None or best.fit.chi2_per_dof - 1 >= 0.5 * (self.before.chi2_per_dof - 1):
            return ()
        steps = [self.subset(best, best.effects[: k + 1]) for k in range(len(best.effects))]
        return tuple(step for step in steps if step is not None)

    def _keep_best(self, hypothesis: LikelihoodRatio) -> None:
        """Keep a set unless a fit of the same effects with a higher likelihood is known."""
        names = frozenset(hypothesis.names)
        known = self.fitted.get(names)
        if known is None or hypothesis.fit.log_likelihood > known.fit.log_likelihood:
            fit = hypothesis.fit
            self.fitted[names] = replace(hypothesis, fit=without_curves(fit)) if is_large(fit) else hypothesis


def _worth(larger: LikelihoodRatio, smaller: LikelihoodRatio, added: Sequence[Effect]) -> float:
    """Significance of what a set has more than another, in standard deviations. The difference of −2 ln L is divided by
    the inflation of the sizes added: where they scatter between trials more widely than the noise model predicts,
    chance makes it larger by as much (Kent, Biometrika 69, 19, 1982). Each size is a degree of freedom (`sizes_of`).
    """
    delta_chi2 = 2 * (larger.fit.log_likelihood - smaller.fit.log_likelihood)
    inflation = robust_ratio(larger.fit, [effect.name for effect in added]) ** 2
    return in_sigmas(delta_chi2 / inflation, sizes_of(added, larger.fit))


def start_values(shape: CandidateShape, size: float) -> dict[str, Value]:
    """Values of an effect's parameters to start from: the predicted size, limited to what is possible. Returns by
    `effect.parameter`, SI.
    """
    effect = shape.effect
    if not effect.parameters:
        return {}
    parameter = shape.size
    low, high = parameter.bounds
    if shape.whole:
        size = shape.step
    elif parameter.plausible is not None:
        # A prediction far beyond the plausible range is an extrapolation of the linear model.
        reach = 3 * max(abs(bound - parameter.zero) for bound in parameter.plausible)
        size = float(np.clip(size, -reach, reach))
    if parameter.sign * size < 0 or size == 0:
        size = parameter.sign * abs(shape.step) or shape.step
    start = float(np.clip(parameter.zero + size, low, high))
    by_group = dict.fromkeys(shape.other_groups, parameter.zero) | {shape.group: start}
    values: tuple[Value, ...] = (by_group if shape.group else start, *shape.other_values)
    return {f"{effect.name}.{p.name}": value for p, value in zip(effect.parameters, values, strict=True)}


# ------------------------------------------------------------------------------
# Memory of a search about many trials. The curves of a fit to a thousand trials take some sixty megabytes, its misfit
# tests 700, and a search makes dozens of fits: they are kept without curves, which are computed again where needed.


def is_large(fit: Fit) -> bool:
    """Whether a fit has so many points that the fits of a search cannot be kept whole."""
    # 150_000: points of all trials from which curves are let go (chosen)
    return sum(trial_data.time_s.size for trial_data in fit.predictor.data) > 150_000


def without_curves(fit: Fit) -> Fit:
    """Return a fit without its curves: its numbers, its state and the residuals of each trial."""
    residuals = tuple(columns[:, -1:].copy() for columns in fit.solution.columns)
    return replace(fit, trials=(), solution=replace(fit.solution, columns=residuals))


def with_curves(fit: Fit) -> Fit:
    """Return a fit with its curves, computed again where they were dropped."""
    if fit.trials:
        return fit
    former, state = fit.predictor, fit.solution.state
    predictor = Predictor(former.layout, former.data, former.host).with_steps_of(former)
    columns = predictor.linearise(state.theta, state.trial_effects)
    # Cross products stay those of the fit, whose columns were computed with other steps.
    solution = replace(fit.solution, columns=tuple(columns))
    trials = assemble(solution, fit.left_out, fit.options).trials
    return replace(fit, trials=trials, solution=solution)


# ------------------------------------------------------------------------------
# Which hypotheses leave an adequate model: the misfit tests are repeated with each member of the answer set added.


def adequate_hypotheses(
    hypotheses: Sequence[LikelihoodRatio], search: Search
) -> tuple[list[LikelihoodRatio], dict[str, Remark], MisfitTests | None]:
    """Test the model with each hypothesis of the answer set added, and keep those that no test rejects; one that leaves
    a significant misfit no longer sets the likelihood that others are compared with. Returns adequate (the likeliest
    first, perhaps none), rejected (reason by label), after (tests of the model with the first adequate one added).
    """
    _, rejected = answer_set(hypotheses)
    best, by_likelihood = best_of(hypotheses), sorted(hypotheses, key=lambda ratio: -ratio.fit.log_likelihood)
    beyond_belief = [ratio for ratio in hypotheses if not ratio.credible]
    adequate: list[LikelihoodRatio] = []
    after: MisfitTests | None = None
    for hypothesis in by_likelihood:
        if hypothesis.label in rejected or hypothesis.deviance_excess(best) >= OUT_OF_REACH:
            continue
        if hypothesis not in answer_set([*adequate, hypothesis])[0]:
            continue
        # A size outside its plausible range is believed where nothing beyond belief fits better, but what contains it.
        others = [other for other in beyond_belief if not other.contains(hypothesis)]
        fits_best = all(other.deviance_excess(hypothesis) >= 0 for other in others)
        if not hypothesis.credible or not (hypothesis.plausible or fits_best):
            rejected[hypothesis.label] = hypothesis.reason
            continue
        if reason := search.implausible(hypothesis):
            rejected[hypothesis.label] = reason
            continue
        tests = search.tests_after(hypothesis.fit)
        hypothesis = replace(hypothesis, fit=tests.fit)
        if tests.rejects_model:
            rejected[hypothesis.label] = remark("misfit_remains")
        elif len(hypothesis.effects) > 1 and (reason := search.superfluous(hypothesis)):
            rejected[hypothesis.label] = reason
        else:
            adequate.append(hypothesis)
            after = after or tests
    return adequate, rejected, after


# ------------------------------------------------------------------------------
# How much of a fitted size, or of n and B, may belong to another, undetected effect: "this K includes up to … of drag".
#
# Once a model is adequate, the other candidates are too weak to be detected, but not zero: air is never absent, a gauge
# never perfect. If another effect were present with size s, a fitted θ would fall by L s, with L = I_θθ⁻¹ I_θs the
# coefficient of omitted-variable bias of the linear fit (`Scores.levers`). s may be anything up to its upper limit, or
# to the end of its plausible range where that is nearer: the interval stated is the hull of the fit's own and of that
# one shifted. Effects are considered one at a time and to first order.


def confounders_of(after: MisfitTests) -> tuple[Confounder, ...]:
    """Find, for each size of an effect in the model, the physical effects that it may include, and for n and B, faults
    of the measurement too, each in the shape that shifts it most. Returns for each those that could shift it by more
    than its standard error, the largest first.
    """
    shapes, chosen = after.products.shapes, list[Confounder]()
    of_numbers = zip(after.fit.numbers, after.fit.predictor.layout.free, after.scores.levers, strict=False)
    for number, free, scaled in of_numbers:
        name, lever = number.key.split(".")[0], scaled * free.derivative(number.value)
        is_size = name not in BASE_EFFECTS
        if not (is_size or number.key in (EXPONENT, DAMPING)) or not 0 < number.sigma < math.inf:
            continue
        largest: dict[str, tuple[float, Confounder]] = {}
        for k, shape in enumerate(shapes):
            # An effect that contains the added one as a limit is an alternative to it, no confounder.
            effect, sigma = shape.effect, float(after.scores.sigma[k])
            alternative = (is_size and effect.kind != "physical") or name in effect.replaces
            if alternative or not effect.parameters or shape.whole or not math.isfinite(sigma):
                continue
            possible = sizes_not_excluded(float(after.scores.size[k]), sigma, shape.size)
            shifts = [-float(lever[k]) * size for size in possible]
            most = max((0, 1), key=lambda end: abs(shifts[end]))
            # A shift of less than a standard error of the size is not reported (chosen)
            if abs(shifts[most]) > largest.get(effect.name, (number.sigma, None))[0]:
                known = (number.key, number.vine, effect.name, shape.size.symbol, shape.size.unit)
                ends = number.low + min(*shifts, 0.0), number.high + max(*shifts, 0.0)
                wider = np.clip(ends, number.lower, number.upper).tolist()
                largest[effect.name] = abs(shifts[most]), Confounder(*known, shape.size.zero + possible[most], *wider)
        # 3: confounders listed for each size (chosen)
        chosen += [found for _, found in sorted(largest.values(), key=lambda found: -found[0])[:3]]
    return tuple(chosen)


def sizes_not_excluded(estimate: float, sigma: float, size: Parameter) -> tuple[float, float]:
    """Ends of the sizes, from its absence, within two standard errors of an estimate, its plausible range, and the sign
    that it may have.
    """
    low, high = (end - size.zero for end in plausible_range(size))
    low, high = min(low, 0.0) * (size.sign <= 0), max(high, 0.0) * (size.sign >= 0)
    # 2.0: standard errors of a 95 % interval (derived)
    return min(max(estimate - 2.0 * sigma, low), high), min(max(estimate + 2.0 * sigma, low), high)


# ------------------------------------------------------------------------------
# The rule that a tail cannot push, as a hypothesis: the same model with `tail_slack: free`.
#
# Eq. (2) holds while the tail's tension T₁ = ½(P − P_y)A − ½Bẋⁿ − … is positive. It becomes negative where a payload
# falls faster than the tip everts: the real tail goes slack there, but the model predicts that it pushes. The rule
# has no parameter, so that any rise of the likelihood is due to it alone.


def slack_fit(fit: Fit, report: Report) -> LikelihoodRatio | None:
    """Refit the model with tails that may go slack; None where no taut tail has a payload that could run ahead, or the
    fit fails. Effects of trials that scatter much may have absorbed the misfit: the refit then starts without them.
    """
    trials = (one.trial for one in fit.trials)
    if not any(trial.payload_kg > 0 and trial.tail_slack != "free" and trial.travel_ratio != 1 for trial in trials):
        return None
    report("letting the tail go slack")
    data = [replace(one, trial=replace(one.trial, tail_slack="free")) for one in fit.predictor.data]
    predictor = Predictor(fit.predictor.layout, data, fit.predictor.host)
    slack = replace(fit, solution=replace(fit.solution, predictor=predictor))
    after = full_fit(slack, afresh=has_excess_scatter(fit))
    return None if after is None else likelihood_ratio(fit, (stand_in(TAIL_SLACK),), after)


@dataclass(frozen=True)
class SelectionStep:
    """One round of the selection: a model, its tests, and the hypotheses compared. Those of the `answer_set` cannot be
    excluded (of sets, what they add to the effects of earlier rounds); `rejected` are labels and reasons.
    """

    verdict: str
    tests: MisfitTests
    answer_set: tuple[LikelihoodRatio, ...] = ()
    fitted: tuple[LikelihoodRatio, ...] = ()
    rejected: tuple[tuple[str, Remark], ...] = ()
    answer_names: tuple[str, ...] = ()
    partial: tuple[LikelihoodRatio, ...] = ()
    unstated_differences: tuple[LikelihoodRatio, ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether nothing can be said: no test rejects the model, but its fit does not converge."""
        return self.verdict == UNEXPLAINED and not self.tests.fit.converged and not self.tests.rejects_model

    @property
    def slips(self) -> dict[str, str]:
        """The slips in the sheet that would produce the fitted sizes of the answer set, each with its effect."""
        found: dict[str, str] = {}
        for hypothesis in self.answer_set:
            parameters = {f"{effect.name}.{p.name}": p for effect in hypothesis.effects for p in effect.parameters}
            for entry in hypothesis.numbers:
                if entry.key in parameters and (slip := slip_of(parameters[entry.key], entry.value, entry.sigma)):
                    found.setdefault(slip[1], entry.key.split(".")[0])
        return found


def select_effects(fit: Fit, effects: Sequence[Effect], report: Report) -> list[SelectionStep]:
    """Select the effects that a model lacks."""
    report("testing the model")
    tests = misfit_tests(fit, effects, level_of(fit.model))
    trial_differences = differences(fit)
    differing = significant(trial_differences, tests.level)
    nothing_rejects = not tests.rejects_model and not any(difference.stated for difference in differing)
    passed = ADEQUATE if fit.converged else UNEXPLAINED
    if nothing_rejects and not tests.needs_search:
        return [SelectionStep(passed, tests, unstated_differences=tuple(between_fits(fit, differing, 0.0, report)))]

    # The most promising single effects, a tail that may go slack, and differences between trials.
    search = Search(tests, report)
    search.extend()
    slack = slack_fit(fit, report) if tests.rejects_model else None
    alone = [] if slack is None else [slack]
    best_gain = max((hypothesis.delta_chi2 for hypothesis in (*search.of_size(1), *alone)), default=0.0)
    between = between_fits(fit, trial_differences, best_gain, report)
    unstated_names = {difference.name for difference in differing if not difference.stated}
    unstated = tuple(hypothesis for hypothesis in between if hypothesis.names[0] in unstated_names)
    alone += between
    if (higher := search.higher_base([*search.of_size(1), *alone])) is not None:
        return select_effects(higher, effects, report)

    def nothing_found(verdict: str = passed) -> list[SelectionStep]:
        differ = unstated if verdict == ADEQUATE else ()
        return [SelectionStep(verdict, tests, fitted=tuple(hypotheses), unstated_differences=differ)]

    def is_significant(hypothesis: LikelihoodRatio) -> bool:
        return hypothesis.sigma >= tests.family[hypothesis.names[-1]]

    # All single effects where better ones may exist: linear predictions rank candidates well near the truth, not far
    # from it. Nothing is left to gain once the best has a plausible size, its residuals are no larger than the errors
    # of the tracks, and trials scatter no more than careful work allows.
    for every in (False, True):
        hypotheses = [*search.extend(every=every), *alone]
        best = answer_set(hypotheses)[0][0] if hypotheses else None
        if not every and nothing_rejects and (best is None or best.sigma < SEARCH_SIGMAS):
            return nothing_found()
        if best is None or (not every and not best.plausible):
            continue
        if not every and (exceeds_slow_errors(best.fit) or has_excess_scatter(with_curves(best.fit))):
            continue
        if any(map(is_significant, answer_set(hypotheses)[0])):
            adequate, rejected, after = adequate_hypotheses(hypotheses, search)
            if after is not None:
                return _rounds(search, hypotheses, adequate, rejected, after)
    if not tests.rejects_model and not tests.needs_search:
        return nothing_found()

    # Sets of effects.
    credible = [hypothesis for hypothesis in search.of_size(1) if hypothesis.credible]
    if not any(map(is_significant, answer_set(credible)[0] if credible else ())):
        # A score that no refit confirms counts only if another test rejects the model too.
        hypotheses = search.of_size(1)
        return nothing_found(UNEXPLAINED if tests.omnibus_rejects or exceeds_slow_errors(fit) else passed)
    return _effect_set_rounds(search, alone)


def verdict_of(adequate: Sequence[LikelihoodRatio]) -> str:
    """Verdict that follows from an answer set: `artefact` where it holds no physics, else `missing` or `ambiguous`."""
    if all(effect.kind in ("measurement", BETWEEN_TRIALS) for hypothesis in adequate for effect in hypothesis.effects):
        return ARTEFACT
    return MISSING if len(adequate) == 1 else AMBIGUOUS


def _effect_set_rounds(search: Search, alone: Sequence[LikelihoodRatio]) -> list[SelectionStep]:
    """Rounds in which a set of effects explains the misfit, smallest set first; else the verdict `unexplained`. A set
    that ends higher once it is fitted from a larger one is tested again, beside hypotheses that stand `alone`.
    """
    best_so_far, rejected = search.of_size(1)[0], dict[str, Remark]()
    for size in range(2, MAX_EFFECTS + 1):
        search.report(f"{size} effects together")
        of_this_size, smaller = search.grow(size), search.of_size(size - 1)
        if smaller[0].fit.log_likelihood > best_so_far.fit.log_likelihood:
            adequate, of_these, after = adequate_hypotheses([*smaller, *(alone if size == 2 else ())], search)
            if after is not None:
                return _rounds(search, (*search.fitted.values(), *alone), adequate, of_these, after)
        if not of_this_size or not any(hypothesis.credible for hypothesis in of_this_size):
            break
        adequate, of_these, after = adequate_hypotheses(of_this_size, search)
        if after is not None and (base := search.best_within(adequate[0])):
            # Those in its place may be likelier than the few that were tried.
            adequate, of_these, after = adequate_hypotheses(search.extend(base), search)
        rejected |= of_these
        if after is not None:
            if any(map(search.is_better, adequate)):
                return _rounds(search, tuple(search.fitted.values()), adequate, rejected, after)
            rejected[adequate[0].label] = remark("gain_within_chance")
        if not search.is_better(of_this_size[0]):
            break
        best_so_far = of_this_size[0]
    # Of the best hypothesis of each size, why it is no explanation
    reasons = {
        best.label: rejected.get(best.label, remark("misfit_remains")) if best.credible else best.reason
        for best in (*search.of_size(1)[:1], *search.of_size(2)[:1], best_so_far)
    }
    fitted, steps = tuple(search.fitted.values()), search.partial_steps()
    return [SelectionStep(UNEXPLAINED, search.tests, (), fitted, tuple(reasons.items()), partial=steps)]


def _rounds(
    search: Search,
    fitted: Sequence[LikelihoodRatio],
    adequate: Sequence[LikelihoodRatio],
    rejected: dict[str, Remark],
    after: MisfitTests,
) -> list[SelectionStep]:
    """Rounds from adequate effects or sets of them: one for each effect that all share, then one for the alternatives.
    Physics comes before faults of the measurement, and within both the effect with the largest gain alone. A distortion
    of the picture whose leading term gains nearly everything comes first: the rest of the set may be its next term.
    """
    fitted, reasons = tuple(fitted), tuple(rejected.items())
    gains = {single.names[0]: single.delta_chi2 for single in fitted if len(single.names) == 1}
    kinds = {effect.name: effect.kind for hypothesis in adequate for effect in hypothesis.effects}
    best = adequate[0]
    # ("lens", "perspective"), 0.95: effects that are the leading term of a series in the image position (derived)
    leading = {name for name in ("lens", "perspective") if gains.get(name, 0.0) > 0.95 * best.delta_chi2}

    def order(name: str) -> tuple[bool, bool, float]:
        return name not in leading, kinds[name] == "measurement", -gains.get(name, 0.0)

    common = sorted(set.intersection(*(set(hypothesis.names) for hypothesis in adequate)), key=order)
    steps: list[SelectionStep] = []
    added: tuple[Effect, ...] = ()
    round_tests, alternatives = search.tests, tuple(adequate)
    for name in common if len(adequate) > 1 else common[:-1]:
        verdict = ARTEFACT if kinds[name] == "measurement" else MISSING
        remaining = sorted((one for one in best.effects if one not in added), key=lambda one: one.name != name)
        together = likelihood_ratio(round_tests.fit, remaining, best.fit)
        subset = search.subset(best, (*added, remaining[0])) if added or verdict == MISSING else None
        if added:
            alone = [] if subset is None else [likelihood_ratio(round_tests.fit, remaining[:1], subset.fit)]
            fitted, reasons = (*alone, together), ()
        steps.append(SelectionStep(verdict, round_tests, (together,), fitted, reasons, (name,)))
        if verdict == ARTEFACT:
            return steps
        added = (*added, remaining[0])
        round_tests = search.tests_after(subset.fit if subset else best.fit)
    if added:
        # What each set adds to the effects that are in the model already
        names_added = {effect.name for effect in added}
        remainders = ([one for one in ratio.effects if one.name not in names_added] for ratio in adequate)
        alternatives = tuple(
            likelihood_ratio(round_tests.fit, remainder, ratio.fit)
            for ratio, remainder in zip(adequate, remainders, strict=True)
        )
        fitted, reasons = alternatives, ()
    verdict = verdict_of(alternatives)
    names = tuple(sorted(dict.fromkeys(name for hypothesis in alternatives for name in hypothesis.names), key=order))
    last = SelectionStep(verdict, round_tests, alternatives, fitted, reasons, names)
    return [*steps, last, SelectionStep(ADEQUATE, after)] if verdict == MISSING else [*steps, last]
