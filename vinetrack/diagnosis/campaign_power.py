"""Power of a campaign: of trials that were fitted, or of planned ones.

A planned campaign is simulated without noise, and tested with the noise and between-trial scatter expected of it. As a
check, campaigns like it are simulated with all of these and diagnosed in full: every trial has its own pressure and B,
every vine a misread yield pressure, release falls between frames and positions are noisy; the truth may have one effect
more.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.problems import Remark
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.diagnosis.diagnose import diagnose
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.power import SimulatedRates
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.diagnosis.score_test import testable
from vinetrack.dynamics.model import Model, host_for, make_model
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.effects import EffectError
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.marginal_likelihood import DEVIATION_COLUMNS, trial_deviation_sd
from vinetrack.inference.sensitivity import RELEASE
from vinetrack.planning.candidate_trials import tracks_of
from vinetrack.tracks.position_noise import ar1_noise


def fitted_tests(fitted: Fit, candidates: Sequence[str] | None = None) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a fit with all candidates, and the reasons by name of those that cannot act with this sheet."""
    tried = candidates_of(fitted.model, candidates, fitted.model.user_effects)
    effects, not_testable = testable(tried, fitted.predictor.data)
    return misfit_tests(fitted, effects, FALSE_ALARM_LEVEL_FIRST_ROUND), not_testable


def planned_tests(
    model: Model,
    trials: Sequence[Trial],
    capture_fps: Sequence[float],
    spreads: tuple[float, float],
    noise: tuple[float, float],
    candidates: Sequence[str] | None = None,
) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a noise-free campaign, under the noise of its positions, m, with its lag-one correlation, and the
    between-trial standard deviations of pressure and B: its scores are zero but for rounding, its information is what
    the campaign would have. `model` has the true values.
    """
    host = host_for(model, candidates_of(model, candidates, model.user_effects))
    rest_frames, longest_s = 20, 8.0  # Frames at rest before release, and growth after which filming ends, s (chosen)
    # Trials are released at different parts of a frame, evenly.
    begins = (np.arange(len(trials)) + 0.5) / len(trials) - rest_frames
    since_release = [
        np.arange(begin, longest_s * fps) / fps for begin, fps in zip(begins.tolist(), capture_fps, strict=True)
    ]
    # 1e-3: part of the stated noise that the noise-free campaign has (chosen)
    draw, rest_m = np.random.default_rng(0), 1e-3 * noise[0]
    pairs: list[tuple[Trial, Track]] = []
    motions = simulate_many(model, trials, since_release, host=host)
    for trial, time_s, moved in zip(trials, since_release, motions, strict=True):
        time_s = time_s[time_s < moved.end_time_s] if moved.status == "ended" else time_s
        position_m = moved.observed_position_m[: time_s.size] + ar1_noise(time_s.size, rest_m, 0.0, draw)
        pairs.append((trial, plain_track(time_s - time_s[0], position_m)))
    to_fit = make_model(model.names, model.user_effects)
    fitted = fit(to_fit, pairs, spreads=spreads, noise=noise, host=host, profile=False)
    return fitted_tests(fitted, candidates)


# ------------------------------------------------------------------------------
# Simulated campaigns like a fitted one, diagnosed in full as measured ones are: a check on linear theory.


def filmed_again(
    fitted: Fit, draw: np.random.Generator, effect: str = "", values: Sequence[float] = ()
) -> list[tuple[Trial, Track]]:
    """The trials of a fit as its model would have them made once more, with an effect of these values unless it is
    blank; at most as long as they were recorded.
    """
    predictor, state, trials = fitted.predictor, fitted.state, [trial.trial for trial in fitted.trials]
    trial_effects, problem = state.trial_effects.copy(), fitted.solution.problem
    deviations = trial_deviation_sd(problem, state.spread) * draw.standard_normal((len(trials), 2))
    trial_effects[:, DEVIATION_COLUMNS] = np.where(problem.has_deviation, deviations, 0.0)
    trial_effects[:, RELEASE] -= draw.uniform(size=len(trials)) * predictor.frames_s
    jobs = predictor.jobs(state.theta, trial_effects)
    misread = {vine: draw.standard_normal() for vine in dict.fromkeys(trial.vine for trial in trials)}
    stated, wrong = np.transpose([(t.yield_pressure_Pa, t.yield_pressure_sigma_Pa * misread[t.vine]) for t in trials])
    true_Pa = np.where(np.isnan(jobs.yield_pressure_Pa), stated, jobs.yield_pressure_Pa)
    jobs = replace(jobs, yield_pressure_Pa=np.maximum(true_Pa + np.nan_to_num(wrong), 0.0))
    model = fitted.model
    if effect:
        model, jobs = model + effect, jobs.with_effect(values)
    recorded_s = [track.time_s for trial, track in fitted.pairs if trial.name in {one.name for one in trials}]
    return tracks_of(predictor, replace(state, trial_effects=trial_effects), jobs, draw, recorded_s, model)


# What a diagnosis named, blank for nothing, and whether the effect was among it or was added later; None for no verdict
Outcome = tuple[str, bool] | None


def simulated_diagnosis(tests: MisfitTests, effect: str, values: Sequence[float], seed: int) -> Outcome:
    """Simulate one campaign like that of the tests, with an effect of these values unless it is blank, and diagnose it
    in full.
    """
    model, candidates = tests.fit.model, [candidate.name for candidate in tests.effects]
    try:
        pairs = filmed_again(tests.fit, np.random.default_rng([seed, 77]), effect, values)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            diagnosis = diagnose(
                pairs, model=make_model(model.names, model.user_effects), candidates=candidates, ladder=False,
                advice=False, user_effects=model.user_effects,
            )  # fmt: skip
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError):
        return None
    named = "" if diagnosis.verdict == ADEQUATE else " or ".join(diagnosis.answer_set) or diagnosis.verdict
    return named, effect in (*diagnosis.answer_set, *diagnosis.effects)


def rates_of(effect: str, outcomes: Sequence[Outcome], value: float, promised: float) -> SimulatedRates:
    """Count the outcomes of campaigns with one effect, of this size; with none where it is blank."""
    known = [outcome for outcome in outcomes if outcome is not None]
    named = Counter(name for name, _ in known if name)
    return SimulatedRates(
        effect=effect,
        value=value,
        promised=promised,
        alarms=named.total(),
        count=sum(found for _, found in known) if effect else named.total(),
        campaigns=len(known),
        named=tuple(named.most_common()),
        failed=len(outcomes) - len(known),
    )
