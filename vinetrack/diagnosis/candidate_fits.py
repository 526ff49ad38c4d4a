"""Every effect alone: which hypotheses are worth a fit, and their fits. Several together: `effect_sets`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vinetrack.diagnosis.held_fits import MAX_WHOLE_TESTS, holds_many, let_go, with_curves
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    MAX_INFLATION,
    LikelihoodRatio,
    best_of,
    likelihood_ratio,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    SEARCH_CHI2_PER_DOF,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.multi_start import (
    SubsetFit,
    SubsetFitter,
    best_subset_fit,
    distinct_starts,
    full_fit,
    sheet_slip_starts,
    start_values,
)
from vinetrack.diagnosis.nested_forms import NestedForm, simpler_forms
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import FitError, refit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import POOR_FIT, is_poor_fit

Report = Callable[[str], None]
"""Told in a few words what is being done."""

LINEAR_PREDICTION_LIMIT = 100.0
"""Δχ² up to which what the sensitivities predict is good to a per cent: hypotheses are then fitted without a climb.
Measured in trials of the method: for weak effects the linear Δχ² predicts the refitted one to 0.1 %, for strong ones
√LR 22 against 25, 65 against 17."""

MIN_SHARE_OF_SUBSET_GAIN = 0.1
"""Part of what a climb gained that a fit to all trials must gain, or it is begun again. Chosen: a fit to all trials
gains a multiple of what a part gains; at half fewer, at twice more fits are begun again (time)."""

FAILED_FIT_DELTA_CHI2 = -1.0
"""An effect added can do no harm: Δχ² below this is a fit that has lost its way. Derived: nested models cannot be
worse; 1 is rounding and unsettled iterations."""

SAME_MINIMUM_PER_POINT = 0.01
"""Δχ² per point below which two fits far off the tracks end in the same place. Derived: −2 ln L of n points with noise
s is n ln s², so they then miss by the same to half a per cent; such fits end before they have settled. At half more
starts are tried (time), at twice fewer."""

LINEAR_REACH = 16.0
"""Fall of −2 ln L behind the best within which an effect is worth a fit; cosine from which two effects count as alike;
part of the best promise worth a subset fit. Chosen: √16 is four standard deviations for what the linear prediction may
err by; 0.95 leaves a tenth of the information (1 − 0.95²)."""

ALIKE_COSINE = 0.95
"""See above; chosen."""

MIN_SHARE_OF_BEST_PREDICTION = 0.2
"""See above; chosen. At half more climbs cost time, at twice an effect whose linear promise errs is missed."""

MIN_SUBSET_FITS, HIGHEST_SCORES = 5, 4
"""The most promising and those with the largest scores: what is left of a fit far off may show in either way alone.
Chosen for time: 5 and 4 of about 20 candidates."""

SUBSET_REACH, SUBSET_REACH_SHARE, ALIKE_REACH_FACTOR = 40.0, 0.1, 5.0
"""How far behind the best in −2 ln L a climb may end to be worth a fit: this, or this part of what the best gains, and
so many times further where the two look alike. Chosen: the subset holds a third of the trials, so 40 there may be 13
short of it in all. At half a right answer may be dropped, at twice time grows."""

MAX_FULL_FITS = 7
"""Full fits at most, and starts of each. Chosen for time."""

STARTS_PER_EFFECT = 3
"""Chosen for time, see above."""

HOPELESS_GAIN_SHARE = 0.5
"""Part of the best gain below which a hypothesis that still misses a visible part of the growth is not begun from its
other shapes, if climbs tried them. Chosen for time: most fits of a model far off are such; at half fewer are spared, at
twice every poor one is."""


@dataclass
class CandidateFits:
    """Hypotheses tried so far from one fit. Climbs and fits are made once each.

    `begun` are the starts of fits (effects, values, whether with nothing taken over) and whether each was led on;
    `simpler` the hypotheses that came of larger ones, `asked` what simpler forms were fitted.
    """

    tests: MisfitTests
    report: Report
    subset_fits: dict[str, SubsetFit] = field(default_factory=dict)
    fitted: dict[str, LikelihoodRatio] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    same_minimum: set[str] = field(default_factory=set)
    started: dict[tuple[tuple[str, ...], str, bool], bool] = field(default_factory=dict)
    nested_checked: list[Fit] = field(default_factory=list)
    nested_labels: set[str] = field(default_factory=set)
    nested_tried: set[NestedForm] = field(default_factory=set)
    tests_by_fit: list[tuple[Fit, bool, MisfitTests]] = field(default_factory=list)
    max_full_fits: int = MAX_FULL_FITS

    def __post_init__(self) -> None:
        self.subset_fitter = SubsetFitter(self.tests.fit)
        self.best_deviance = math.inf
        self.null_deviance = -math.inf

    @property
    def linear_prediction_holds(self) -> bool:
        """Whether predictions from sensitivities are good enough to choose by."""
        settled = not self.tests.far_off and not self.tests.needs_search
        return settled and max(map(self.tests.predicted_gain, self.names), default=0.0) < LINEAR_PREDICTION_LIMIT

    @property
    def names(self) -> list[str]:
        """Effects that may be missing, the most promising first."""
        names = dict.fromkeys(self.tests.sensitivities.effects)
        return sorted(names, key=lambda name: -self.tests.predicted_gain(name))

    @property
    def credible_fits(self) -> list[LikelihoodRatio]:
        """Fitted hypotheses of plausible sizes."""
        return [known for known in self.fitted.values() if known.plausible and known.credible]

    @property
    def has_adequate_fit(self) -> bool:
        """Whether a hypothesis explains the tracks: what still stays far off once it is fitted is no rival.

        Those that came near it on a part of the trials are led on all the same.
        """
        return any(hypothesis.fit.chi2_per_dof < SEARCH_CHI2_PER_DOF for hypothesis in self.fitted.values())

    def tests_after(self, fit: Fit, *, film: bool = False) -> MisfitTests:
        """What one of its fits leaves; asked once, or, of many trials, again where other fits were asked since.

        Parameters
        ----------
        fit : one of the hypotheses' fits.
        film : whether the film of each vine may weigh a little other than stated.

        Returns
        -------
        MisfitTests
        """
        for known, with_film, tests in self.tests_by_fit:
            if known is fit and with_film == film:
                return tests
        tests = misfit_tests(with_curves(fit), self.tests.effects, FALSE_ALARM_LEVEL_LATER_ROUNDS, film=film)
        if holds_many(fit):
            del self.tests_by_fit[: max(len(self.tests_by_fit) - MAX_WHOLE_TESTS + 1, 0)]
        self.tests_by_fit.append((fit, film, tests))
        return tests

    def fit_singles(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
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
        if self.linear_prediction_holds:
            return self._fit_weak(all_of_them=all_of_them)
        self._climb_all(self.names if all_of_them else self._worth_a_climb())
        leaders = sorted(
            self.subset_fits.values(), key=lambda subset_fit: (subset_fit.far_beyond_plausible, subset_fit.deviance)
        )
        if not leaders:
            return []
        best = leaders[0]
        base = self.subset_fitter.fit_hypothesis((), {}, iterations=4)
        self.null_deviance = base.deviance if base else best.deviance
        gain = max(self.null_deviance - best.deviance, 0.0)
        reach = max(SUBSET_REACH, SUBSET_REACH_SHARE * gain)
        alike = [c for c in leaders if self.tests.cosine(c.names[0], best.names[0]) > ALIKE_COSINE]
        near = [
            leader
            for leader in leaders
            if leader.deviance - best.deviance < (ALIKE_REACH_FACTOR * reach if leader in alike else reach)
        ]
        chosen = [subset_fit for subset_fit in near if not subset_fit.far_beyond_plausible] or near
        for climb in chosen if all_of_them else chosen[: self.max_full_fits]:
            self._fit(climb)
        self._fit_what_is_contained()
        self._begin_from_the_best()
        return list(self.fitted.values())

    def fit_to_all_trials(self, *, all_of_them: bool = False) -> list[LikelihoodRatio]:
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
        top = self.tests.predicted_gain(self.names[0]) if self.names else 0.0
        for name in self.names:
            near = all_of_them or self.tests.predicted_gain(name) > MIN_SHARE_OF_BEST_PREDICTION * top
            if near and name not in self.fitted and name not in self.failed:
                self._fit_from_prediction(name)
        self._fit_what_is_contained()
        return list(self.fitted.values())

    def _begin_from_the_best(self) -> None:
        """Fit rivals that the best would exclude from where it ended: releases found there may serve them too.

        Where trials begin slowly a fit may settle in another minimum by a hair's breadth of its start.
        """
        believed = self.credible_fits
        if not believed or is_poor_fit((best := best_of(believed)).fit.predictor, best.fit.solution):
            return
        rivals = [
            known
            for known in believed
            if ANSWER_SET_DELTA_CHI2 < known.deviance_excess(best) < SUBSET_REACH * ALIKE_REACH_FACTOR
        ]
        for rival in sorted(rivals, key=lambda known: known.deviance_excess(best))[:STARTS_PER_EFFECT]:
            model = self.tests.fit.model.with_effects(rival.effects)
            values = {
                key: rival.fit.model.values[key] for key in model.parameter_names if key.split(".")[0] in rival.names
            }
            with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
                fit = refit(best.fit, model, start=values, thorough=False)
                if fit.log_likelihood > rival.fit.log_likelihood - FAILED_FIT_DELTA_CHI2:
                    self.fitted[rival.label] = likelihood_ratio(self.tests.fit, rival.effects, fit)

    def _fit_what_is_contained(self) -> None:
        """An effect that holds a simpler one as a limit stands only once that was fitted too, from where it ended."""
        base_fit = self.tests.fit
        best = max((fitted_one.fit.log_likelihood for fitted_one in self.fitted.values()), default=0.0)
        for fitted_one in list(self.fitted.values()):
            # The simpler is in the larger one, and can be no better.
            behind = 2 * (best - fitted_one.fit.log_likelihood) > ANSWER_SET_DELTA_CHI2 * MAX_INFLATION
            if behind or any(known is fitted_one.fit for known in self.nested_checked):
                continue
            self.nested_checked.append(fitted_one.fit)
            for both, fit in simpler_forms(base_fit, fitted_one, self.tests.effects, self.nested_tried):
                simpler = likelihood_ratio(base_fit, both, fit)
                self.nested_labels.add(simpler.label)
                known = self.fitted.get(simpler.label)
                if known is None or simpler.delta_chi2 > max(known.delta_chi2, FAILED_FIT_DELTA_CHI2):
                    self.fitted[simpler.label] = simpler

    def _worth_a_climb(self) -> list[str]:
        top = self.tests.predicted_gain(self.names[0]) if self.names else 0.0
        loudest = self._loudest()
        return [
            name
            for k, name in enumerate(self.names)
            if k < MIN_SUBSET_FITS
            or name in loudest
            or self.tests.predicted_gain(name) > MIN_SHARE_OF_BEST_PREDICTION * top
            or self.tests.cosine(name, self.names[0]) > ALIKE_COSINE
        ]

    def _loudest(self) -> list[str]:
        return sorted(self.names, key=lambda name: -self.tests.best_z(name)[0])[:HIGHEST_SCORES]

    def _climb_all(self, names: Iterable[str]) -> None:
        for name in names:
            if name in self.subset_fits or name in self.failed:
                continue
            self.report(f"trying {name}")
            places = self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]
            sizes = self.tests.predicted_gains[1]
            shapes = self.tests.sensitivities.shapes
            starts = distinct_starts((shapes[i], float(sizes[i])) for i in places) + sheet_slip_starts(
                shapes[places[0]].effect
            )
            climb = best_subset_fit(self.subset_fitter, starts, self.best_deviance, search=True)
            if climb is None:
                self.failed.add(name)
                continue
            self.best_deviance = min(self.best_deviance, climb.deviance)
            self.subset_fits[name] = climb

    def _fit_weak(self, *, all_of_them: bool) -> list[LikelihoodRatio]:
        names = self.names
        if not names:
            return []
        top, loudest = self.tests.predicted_gain(names[0]), self._loudest()[:1]
        for name in names:
            near = self.tests.predicted_gain(name) > max(min(top - LINEAR_REACH, 0.6 * top), 0.25 * top)
            alike = self.tests.cosine(name, names[0]) > ALIKE_COSINE or name in loudest
            if (near or alike or all_of_them) and name not in self.fitted and name not in self.failed:
                self.report(f"fitting {name}")
                self._fit_from_prediction(name)
        self._fit_what_is_contained()
        return list(self.fitted.values())

    def _fit_from_prediction(self, name: str) -> None:
        """The best fit from the shapes that promise most."""
        sizes = self.tests.predicted_gains[1]
        for place in self.tests.ranked_shapes(name)[:STARTS_PER_EFFECT]:
            shape = self.tests.sensitivities.shapes[place]
            self._fit(SubsetFit((shape.effect,), math.nan, start_values(shape, float(sizes[place]))))
            if name in self.fitted and self.fitted[name].delta_chi2 > 0.7 * self.tests.predicted_gain(name):
                break
            if self._is_hopeless(name):
                break

    def _is_hopeless(self, name: str) -> bool:
        """Whether a hypothesis is out of the running from its most promising shape, where climbs tried the others."""
        known = self.fitted.get(name)
        if known is None or name not in self.subset_fits:
            return False
        best = max(hypothesis.delta_chi2 for hypothesis in self.fitted.values())
        return known.delta_chi2 < HOPELESS_GAIN_SHARE * best and is_poor_fit(known.fit.predictor, known.fit.solution)

    def _negligible_sizes(self, effects: Sequence[Effect]) -> dict[str, Value]:
        """Values at which the effects hardly act."""
        values: dict[str, Value] = {}
        for effect in effects:
            places = self.tests.ranked_shapes(effect.name)
            if places:
                shape = self.tests.sensitivities.shapes[places[0]]
                values |= start_values(
                    shape, math.copysign(abs(shape.step), float(self.tests.predicted_gains[1][places[0]]))
                )
        return values

    def _fit(self, climb: SubsetFit) -> None:
        name = "+".join(climb.names)
        if name in self.fitted and not math.isnan(climb.deviance):
            return
        self.report(f"fitting {name}")
        # What fits best at a size that nobody believes is no reason to give up what is behind it.
        best = max((known.fit.log_likelihood for known in self.credible_fits), default=-math.inf)
        led = math.isfinite(climb.deviance) or not self.has_adequate_fit
        if not self._is_new_start(climb, led=led):
            return
        hypothesis = self._fit_from(climb, best, led=led)
        promised = max(self.null_deviance - climb.deviance, 0.0) if math.isfinite(climb.deviance) else 0.0
        if hypothesis is not None and hypothesis.delta_chi2 < (
            MIN_SHARE_OF_SUBSET_GAIN * promised or -_same_place(hypothesis.fit)
        ):
            hypothesis = self._restarted(climb, hypothesis, best, led=led)
        if hypothesis is None or hypothesis.delta_chi2 < FAILED_FIT_DELTA_CHI2:
            self.failed.add(name)
        elif name not in self.fitted or hypothesis.delta_chi2 > self.fitted[name].delta_chi2:
            self.fitted[name] = hypothesis
            let_go(self.fitted)

    def _restarted(self, climb: SubsetFit, hypothesis: LikelihoodRatio, best: float, *, led: bool) -> LikelihoodRatio:
        """The best of other starts of a hypothesis that did worse than the model without it, or than part of the data.

        It may have been led astray by its start. First from where it hardly acts (where it began there, with nothing
        taken over); if that ends in the same place, no start is to blame: a model far off is then as far off with it,
        and it is not begun again from anywhere else.
        """
        name = "+".join(climb.names)
        if name in self.same_minimum:
            return hypothesis
        smallest = SubsetFit(climb.effects, math.nan, self._negligible_sizes(climb.effects))
        starts = [(smallest, False), (climb, True)] if smallest.values != climb.values else [(climb, True)]
        ends = [hypothesis]
        for start, afresh in starts:
            if not self._is_new_start(start, afresh=afresh, led=led):
                if start is climb:
                    self.same_minimum.add(name)
                continue
            other = self._fit_from(start, best, afresh=afresh, led=led)
            if other is not None:
                ends.append(other)
                if abs(other.delta_chi2 - hypothesis.delta_chi2) < _same_place(other.fit, hypothesis.fit):
                    self.same_minimum.add(name)
                    break
        return max(ends, key=lambda hypothesis: hypothesis.delta_chi2)

    def _is_new_start(self, climb: SubsetFit, *, led: bool, afresh: bool = False) -> bool:
        """Whether no fit was begun there yet; a model far off takes nothing over, see `refit`."""
        key = climb.names, repr(sorted(climb.values.items())), afresh or self.tests.fit.chi2_per_dof > POOR_FIT
        if key in self.started and (self.started[key] or not led):
            return False
        self.started[key] = led
        return True

    def _fit_from(self, climb: SubsetFit, best: float, *, led: bool, afresh: bool = False) -> LikelihoodRatio | None:
        fit = full_fit(self.tests.fit, climb, best, afresh=afresh, led=led)
        return None if fit is None else likelihood_ratio(self.tests.fit, climb.effects, fit)


def _same_place(*fits: Fit) -> float:
    """By how much less in −2 ln L two fits of one hypothesis end in the same place."""
    if not all(is_poor_fit(fit.predictor, fit.solution) for fit in fits):
        return -FAILED_FIT_DELTA_CHI2
    return max(
        -FAILED_FIT_DELTA_CHI2, SAME_MINIMUM_PER_POINT * sum(trial.time_s.size for trial in fits[0].predictor.data)
    )
