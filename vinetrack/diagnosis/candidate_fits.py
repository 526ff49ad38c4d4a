"""Every effect alone: which hypotheses are worth a fit, and their fits. Several together: `effect_sets`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from vinetrack.diagnosis.held_fits import TESTS_HELD, holds_many, let_go, with_curves
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET, MOST_INFLATION, LikelihoodRatio, best_of, likelihood_ratio
from vinetrack.diagnosis.misfit_tests import LATER_LEVEL, SUSPECT, MisfitTests, misfit_tests
from vinetrack.diagnosis.multi_start import (
    SubsetFit,
    SubsetFitter,
    best_subset_fit,
    full_fit,
    slip_starts,
    start_of,
    starts_of,
)
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import FitError, refit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import POOR_FIT, is_poor_fit

Report = Callable[[str], None]
"""Told in a few words what is being done."""

WEAK = 100.0
"""Δχ² up to which what the sensitivities predict is good to a per cent: hypotheses are then fitted without a climb.
Measured in trials of the method: for weak effects the linear Δχ² predicts the refitted one to 0.1 %, for strong ones
√LR 22 against 25, 65 against 17."""

PART_KEPT = 0.1
"""Part of what a climb gained that a fit to all trials must gain, or it is begun again. Chosen: a fit to all trials
gains a multiple of what a part gains; at half fewer, at twice more fits are begun again (time)."""

WORSE = -1.0
"""An effect added can do no harm: Δχ² below this is a fit that has lost its way. Derived: nested models cannot be
worse; 1 is rounding and unsettled iterations."""

SAME_MISFIT = 0.01
"""Δχ² per point below which two fits far off the tracks end in the same place. Derived: −2 ln L of n points with noise
s is n ln s², so they then miss by the same to half a per cent; such fits end before they have settled. At half more
starts are tried (time), at twice fewer."""

WITHIN_REACH = 16.0
"""Fall of −2 ln L behind the best within which an effect is worth a fit; cosine from which two effects count as alike;
part of the best promise worth a subset fit. Chosen: √16 is four standard deviations for what the linear prediction may
err by; 0.95 leaves a tenth of the information (1 − 0.95²)."""

ALIKE = 0.95
"""See above; chosen."""

SHARE_WORTH_A_CLIMB = 0.2
"""See above; chosen. At half more climbs cost time, at twice an effect whose linear promise errs is missed."""

FEWEST_CLIMBED, LOUDEST = 5, 4
"""The most promising and those with the largest scores: what is left of a fit far off may show in either way alone.
Chosen for time: 5 and 4 of about 20 candidates."""

REACH_OF_CLIMBS, SHARE_OF_REACH, ALIKE_REACH = 40.0, 0.1, 5.0
"""How far behind the best in −2 ln L a climb may end to be worth a fit: this, or this part of what the best gains, and
so many times further where the two look alike. Chosen: the subset holds a third of the trials, so 40 there may be 13
short of it in all. At half a right answer may be dropped, at twice time grows."""

MOST_FITTED = 7
"""Full fits at most, and starts of each. Chosen for time."""

STARTS_EACH = 3
"""Chosen for time, see above."""

HOPELESS_PART = 0.5
"""Part of the best gain below which a hypothesis that still misses a visible part of the growth is not begun from its
other shapes, if climbs tried them. Chosen for time: most fits of a model far off are such; at half fewer are spared, at
twice every poor one is."""

SURELY = 6.0
"""Standard deviations from nothing beyond which a number is there. Chosen: six standard errors, beyond doubt even with
errors half as large as they should be."""


Asked = tuple[str, float, str, str]
"""A hypothesis and its ln L, one of its effects, and the simpler form of that which was asked for."""


@dataclass
class CandidateFits:
    """Hypotheses tried so far from one fit. Climbs and fits are made once each.

    `begun` are the starts of fits (effects, values, whether with nothing taken over) and whether each was led on;
    `simpler` the hypotheses that came of larger ones, `asked` what simpler forms were fitted.
    """

    questions: MisfitTests
    report: Report
    climbs: dict[str, SubsetFit] = field(default_factory=dict)
    fitted: dict[str, LikelihoodRatio] = field(default_factory=dict)
    silent: set[str] = field(default_factory=set)
    same_end: set[str] = field(default_factory=set)
    begun: dict[tuple[tuple[str, ...], str, bool], bool] = field(default_factory=dict)
    simplified: list[Fit] = field(default_factory=list)
    simpler: set[str] = field(default_factory=set)
    asked: set[Asked] = field(default_factory=set)
    tested: list[tuple[Fit, bool, MisfitTests]] = field(default_factory=list)
    most_fitted: int = MOST_FITTED

    def __post_init__(self) -> None:
        self.slope = SubsetFitter(self.questions.fit)
        self.goal = math.inf
        self.base = -math.inf

    @property
    def weak(self) -> bool:
        """Whether predictions from sensitivities are good enough to choose by."""
        settled = not self.questions.far_off and not self.questions.suspect
        return settled and max(map(self.questions.promise, self.names), default=0.0) < WEAK

    @property
    def names(self) -> list[str]:
        """Effects that may be missing, the most promising first."""
        names = dict.fromkeys(self.questions.answers.effects)
        return sorted(names, key=lambda name: -self.questions.promise(name))

    @property
    def believed(self) -> list[LikelihoodRatio]:
        """Fitted hypotheses of plausible sizes."""
        return [known for known in self.fitted.values() if known.plausible and known.credible]

    @property
    def explained(self) -> bool:
        """Whether a hypothesis explains the tracks: what still stays far off once it is fitted is no rival.

        Those that came near it on a part of the trials are led on all the same.
        """
        return any(hypothesis.fit.chi2_per_dof < SUSPECT for hypothesis in self.fitted.values())

    def after(self, fit: Fit, *, film: bool = False) -> MisfitTests:
        """What one of its fits leaves; asked once, or, of many trials, again where other fits were asked since.

        Parameters
        ----------
        fit : one of the hypotheses' fits.
        film : whether the film of each vine may weigh a little other than stated.

        Returns
        -------
        MisfitTests
        """
        for known, with_film, tests in self.tested:
            if known is fit and with_film == film:
                return tests
        tests = misfit_tests(with_curves(fit), self.questions.effects, LATER_LEVEL, film=film)
        if holds_many(fit):
            del self.tested[: max(len(self.tested) - TESTS_HELD + 1, 0)]
        self.tested.append((fit, film, tests))
        return tests

    def singles(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit the hypotheses that may be the best or near it, each effect alone.

        With `all_of_them` every candidate is fitted to one trial of every condition, and to all trials unless that
        leaves it out of reach of the best.

        Parameters
        ----------
        all_of_them : bool
            Fit every candidate to one trial of each condition.

        Returns
        -------
        list of LikelihoodRatio
        """
        if self.weak:
            return self._fit_weak(all_of_them=all_of_them)
        self._climb_all(self.names if all_of_them else self._worth_a_climb())
        leaders = sorted(self.climbs.values(), key=lambda subset_fit: (subset_fit.hopeless, subset_fit.deviance))
        if not leaders:
            return []
        best = leaders[0]
        base = self.slope.climb((), {}, iterations=4)
        self.base = base.deviance if base else best.deviance
        gain = max(self.base - best.deviance, 0.0)
        reach = max(REACH_OF_CLIMBS, SHARE_OF_REACH * gain)
        alike = [c for c in leaders if self.questions.cosine(c.names[0], best.names[0]) > ALIKE]
        near = [
            leader
            for leader in leaders
            if leader.deviance - best.deviance < (ALIKE_REACH * reach if leader in alike else reach)
        ]
        chosen = [subset_fit for subset_fit in near if not subset_fit.hopeless] or near
        for climb in chosen if all_of_them else chosen[: self.most_fitted]:
            self._fit(climb)
        self._fit_what_is_contained()
        self._begin_from_the_best()
        return list(self.fitted.values())

    def fit_in_full(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
        """Fit candidates in full whatever their climbs came to: those that promise much, or all.

        A climb on a part of the trials may end in a local minimum, and a fit that has bent its numbers to do without an
        effect may promise nothing for it, not even the right sign.

        Parameters
        ----------
        all_of_them : also those whose linear promise is a small part of the best one's.

        Returns
        -------
        list of LikelihoodRatio
            All hypotheses fitted so far.
        """
        top = self.questions.promise(self.names[0]) if self.names else 0.0
        for name in self.names:
            near = all_of_them or self.questions.promise(name) > SHARE_WORTH_A_CLIMB * top
            if near and name not in self.fitted and name not in self.silent:
                self._fit_from_prediction(name)
        self._fit_what_is_contained()
        return list(self.fitted.values())

    def _begin_from_the_best(self) -> None:
        """Fit rivals that the best would exclude from where it ended: releases found there may serve them too.

        Where trials begin slowly a fit may settle in another minimum by a hair's breadth of its start.
        """
        believed = self.believed
        if not believed or is_poor_fit((best := best_of(believed)).fit.predictor, best.fit.solution):
            return
        rivals = [known for known in believed if ANSWER_SET < known.behind(best) < REACH_OF_CLIMBS * ALIKE_REACH]
        for rival in sorted(rivals, key=lambda known: known.behind(best))[:STARTS_EACH]:
            model = self.questions.fit.model.with_effects(rival.effects)
            values = {
                key: rival.fit.model.values[key] for key in model.parameter_names if key.split(".")[0] in rival.names
            }
            with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
                fit = refit(best.fit, model, start=values, thorough=False)
                if fit.log_likelihood > rival.fit.log_likelihood - WORSE:
                    self.fitted[rival.label] = likelihood_ratio(self.questions.fit, rival.effects, fit)

    def _fit_what_is_contained(self) -> None:
        """An effect that holds a simpler one as a limit stands only once that was fitted too, from where it ended."""
        base_fit = self.questions.fit
        best = max((fitted_one.fit.log_likelihood for fitted_one in self.fitted.values()), default=0.0)
        for fitted_one in list(self.fitted.values()):
            # The simpler is in the larger one, and can be no better.
            behind = 2 * (best - fitted_one.fit.log_likelihood) > ANSWER_SET * MOST_INFLATION
            if behind or any(known is fitted_one.fit for known in self.simplified):
                continue
            self.simplified.append(fitted_one.fit)
            for both, fit in simpler_forms(base_fit, fitted_one, self.questions.effects, self.asked):
                simpler = likelihood_ratio(base_fit, both, fit)
                self.simpler.add(simpler.label)
                known = self.fitted.get(simpler.label)
                if known is None or simpler.delta_chi2 > max(known.delta_chi2, WORSE):
                    self.fitted[simpler.label] = simpler

    def _worth_a_climb(self) -> list[str]:
        top = self.questions.promise(self.names[0]) if self.names else 0.0
        loudest = self._loudest()
        return [
            name
            for k, name in enumerate(self.names)
            if k < FEWEST_CLIMBED
            or name in loudest
            or self.questions.promise(name) > SHARE_WORTH_A_CLIMB * top
            or self.questions.cosine(name, self.names[0]) > ALIKE
        ]

    def _loudest(self) -> list[str]:
        return sorted(self.names, key=lambda name: -self.questions.best_z(name)[0])[:LOUDEST]

    def _climb_all(self, names: Iterable[str]) -> None:
        for name in names:
            if name in self.climbs or name in self.silent:
                continue
            self.report(f"trying {name}")
            places = self.questions.of(name)[:STARTS_EACH]
            sizes = self.questions.gains[1]
            shapes = self.questions.answers.shapes
            starts = starts_of((shapes[i], float(sizes[i])) for i in places) + slip_starts(shapes[places[0]].effect)
            climb = best_subset_fit(self.slope, starts, self.goal, search=True)
            if climb is None:
                self.silent.add(name)
                continue
            self.goal = min(self.goal, climb.deviance)
            self.climbs[name] = climb

    def _fit_weak(self, *, all_of_them: bool) -> list[LikelihoodRatio]:
        names = self.names
        if not names:
            return []
        top, loudest = self.questions.promise(names[0]), self._loudest()[:1]
        for name in names:
            near = self.questions.promise(name) > max(min(top - WITHIN_REACH, 0.6 * top), 0.25 * top)
            alike = self.questions.cosine(name, names[0]) > ALIKE or name in loudest
            if (near or alike or all_of_them) and name not in self.fitted and name not in self.silent:
                self.report(f"fitting {name}")
                self._fit_from_prediction(name)
        self._fit_what_is_contained()
        return list(self.fitted.values())

    def _fit_from_prediction(self, name: str) -> None:
        """The best fit from the shapes that promise most."""
        sizes = self.questions.gains[1]
        for place in self.questions.of(name)[:STARTS_EACH]:
            shape = self.questions.answers.shapes[place]
            self._fit(SubsetFit((shape.effect,), math.nan, start_of(shape, float(sizes[place]))))
            if name in self.fitted and self.fitted[name].delta_chi2 > 0.7 * self.questions.promise(name):
                break
            if self._is_hopeless(name):
                break

    def _is_hopeless(self, name: str) -> bool:
        """Whether a hypothesis is out of the running from its most promising shape, where climbs tried the others."""
        known = self.fitted.get(name)
        if known is None or name not in self.climbs:
            return False
        best = max(hypothesis.delta_chi2 for hypothesis in self.fitted.values())
        return known.delta_chi2 < HOPELESS_PART * best and is_poor_fit(known.fit.predictor, known.fit.solution)

    def _smallest(self, effects: Sequence[Effect]) -> dict[str, Value]:
        """Values at which the effects hardly act."""
        values: dict[str, Value] = {}
        for effect in effects:
            places = self.questions.of(effect.name)
            if places:
                shape = self.questions.answers.shapes[places[0]]
                values |= start_of(shape, math.copysign(abs(shape.step), float(self.questions.gains[1][places[0]])))
        return values

    def _fit(self, climb: SubsetFit) -> None:
        name = "+".join(climb.names)
        if name in self.fitted and not math.isnan(climb.deviance):
            return
        self.report(f"fitting {name}")
        # What fits best at a size that nobody believes is no reason to give up what is behind it.
        best = max((known.fit.log_likelihood for known in self.believed), default=-math.inf)
        led = math.isfinite(climb.deviance) or not self.explained
        if not self._is_new(climb, led=led):
            return
        hypothesis = self._from_climb(climb, best, led=led)
        promised = max(self.base - climb.deviance, 0.0) if math.isfinite(climb.deviance) else 0.0
        if hypothesis is not None and hypothesis.delta_chi2 < (PART_KEPT * promised or -_same_place(hypothesis.fit)):
            hypothesis = self._begun_again(climb, hypothesis, best, led=led)
        if hypothesis is None or hypothesis.delta_chi2 < WORSE:
            self.silent.add(name)
        elif name not in self.fitted or hypothesis.delta_chi2 > self.fitted[name].delta_chi2:
            self.fitted[name] = hypothesis
            let_go(self.fitted)

    def _begun_again(self, climb: SubsetFit, hypothesis: LikelihoodRatio, best: float, *, led: bool) -> LikelihoodRatio:
        """The best of other starts of a hypothesis that did worse than the model without it, or than part of the data.

        It may have been led astray by its start. First from where it hardly acts (where it began there, with nothing
        taken over); if that ends in the same place, no start is to blame: a model far off is then as far off with it,
        and it is not begun again from anywhere else.
        """
        name = "+".join(climb.names)
        if name in self.same_end:
            return hypothesis
        smallest = SubsetFit(climb.effects, math.nan, self._smallest(climb.effects))
        starts = [(smallest, False), (climb, True)] if smallest.values != climb.values else [(climb, True)]
        ends = [hypothesis]
        for start, afresh in starts:
            if not self._is_new(start, afresh=afresh, led=led):
                if start is climb:
                    self.same_end.add(name)
                continue
            other = self._from_climb(start, best, afresh=afresh, led=led)
            if other is not None:
                ends.append(other)
                if abs(other.delta_chi2 - hypothesis.delta_chi2) < _same_place(other.fit, hypothesis.fit):
                    self.same_end.add(name)
                    break
        return max(ends, key=lambda hypothesis: hypothesis.delta_chi2)

    def _is_new(self, climb: SubsetFit, *, led: bool, afresh: bool = False) -> bool:
        """Whether no fit was begun there yet; a model far off takes nothing over, see `refit`."""
        key = climb.names, repr(sorted(climb.values.items())), afresh or self.questions.fit.chi2_per_dof > POOR_FIT
        if key in self.begun and (self.begun[key] or not led):
            return False
        self.begun[key] = led
        return True

    def _from_climb(self, climb: SubsetFit, best: float, *, led: bool, afresh: bool = False) -> LikelihoodRatio | None:
        fit = full_fit(self.questions.fit, climb, best, afresh=afresh, led=led)
        return None if fit is None else likelihood_ratio(self.questions.fit, climb.effects, fit)


def _same_place(*fits: Fit) -> float:
    """By how much less in −2 ln L two fits of one hypothesis end in the same place."""
    if not all(is_poor_fit(fit.predictor, fit.solution) for fit in fits):
        return -WORSE
    return max(-WORSE, SAME_MISFIT * sum(trial.time_s.size for trial in fits[0].predictor.data))


def simpler_forms(
    before: Fit, pair: LikelihoodRatio, effects: Sequence[Effect], asked: set[Asked]
) -> Iterator[tuple[tuple[Effect, ...], Fit]]:
    """Give a hypothesis with one of its effects in the simpler form that it contains, fitted from where it ended.

    Parameters
    ----------
    before : the fit that is questioned.
    pair : the hypothesis, of one effect or several.
    effects : sequence of Effect
        All candidates.
    asked : set
        What was fitted already, and is not again; added to.

    Yields
    ------
    effects : tuple of Effect
    fit : Fit
    """
    for held in pair.effects:
        for simpler in effects:
            if simpler.name not in held.replaces or simpler.name in pair.names or _needs_more(pair.fit, held, simpler):
                continue
            key = "+".join(sorted(pair.names)), pair.fit.log_likelihood, held.name, simpler.name
            if key in asked:
                continue
            asked.add(key)
            both = tuple(simpler if effect is held else effect for effect in pair.effects)
            model = before.model.with_effects(both)
            values = pair.fit.model.values
            sizes = {f"{simpler.name}.{p.name}": values.get(f"{held.name}.{p.name}") for p in simpler.parameters}
            start = {key: size for key, size in sizes.items() if size is not None}
            with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
                yield both, refit(pair.fit, model, start=start, thorough=False)


def _needs_more(fit: Fit, held: Effect, simpler: Effect) -> bool:
    """Whether a number that only the larger form has is known so well that it cannot lie where the two are one."""
    extra = {p.name for p in held.parameters} - {p.name for p in simpler.parameters}
    numbers = [n for n in fit.numbers if n.key.split(".")[0] == held.name and n.key.split(".")[1] in extra]
    return any(
        math.isfinite(n.sigma) and not math.isfinite(n.bound) and abs(n.value) > SURELY * n.sigma for n in numbers
    )
