"""Outlying trials: a row of the sheet that belongs to another recording, or a typing error.

One such trial among thirty causes a misfit that no effect explains, and the verdict is `unexplained`. Outliers are
detected without the model that failed: over the middle of the growth damping roughly balances the force,

    ln F_j = ln B_vine + n ln v_j + c (ln v_j)²,    F = (P − P_y) A + r m̄ g cos θ

with a curvature c for a force of another power of speed. The residual of a trial from a robust fit of these curves is
compared with the residuals of the others. An effect that the model lacks changes all trials of a condition alike; a
pressure with its digits swapped does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track, Trial, plain_track, with_flag
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.remarks import Remark, remark
from vinetrack.diagnosis.result import ADEQUATE, ARTEFACT, DROPPED_FRAMES, UNEXPLAINED, Diagnosis, Round
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import middle_speed
from vinetrack.tracks.frame_timing import correct_frames, frames_surely_missing

Indices = NDArray[np.int_]


LEAST_SCATTER = 0.02  # Lower limit of the scatter of ln F: the scatter of careful trials (chosen)

CHANCE = 1e-4  # Probability that normal scatter makes any trial of a campaign an outlier (chosen)


# Slope and curvature of the fitted curves, common to all vines, besides a level for each vine (derived)
CURVE_SHAPE_PARAMETERS = 2

# Number of trials from which outliers are looked for, and the largest fraction that may be outliers (chosen)
FEWEST_TRIALS, LARGEST_SHARE = 8, 0.125


@dataclass(frozen=True)
class OddTrial:
    """An outlying trial, with its stated pressure and the pressure that its motion implies, Pa. `implied_pressure_Pa`
    is NaN where it is not known.
    """

    name: str
    stated_Pa: float
    implied_pressure_Pa: float


def odd_trials(data: Sequence[FitTrial]) -> list[OddTrial]:
    """Find trials whose speed contradicts the sheet although the other trials agree with it."""
    trials = [trial_data.trial for trial_data in data]
    if len(data) < FEWEST_TRIALS or any(trial.travel_ratio != 2 for trial in trials):
        return []
    speed = np.array([middle_speed(trial_data) for trial_data in data])
    stated = [_stated_Pa(trial_data) for trial_data in data]
    force = np.array([_force_N(trial, pressure_Pa) for trial, pressure_Pa in zip(trials, stated, strict=True)])
    driven = force > 0
    if np.count_nonzero(driven) < FEWEST_TRIALS:
        return []
    names = [trial.vine for trial in trials]
    vines, vine_index = np.unique(
        [name for name, is_driven in zip(names, driven, strict=True) if is_driven], return_inverse=True
    )
    remaining = int(np.count_nonzero(driven)) - vines.size - CURVE_SHAPE_PARAMETERS
    if remaining < 1:
        return []
    curves = _fit_curves(np.log(force[driven]), np.log(speed[driven]), vine_index)
    index_of = {vine: k for k, vine in enumerate(vines)}
    residual = np.full(len(data), -np.inf)
    residual[driven] = np.log(force[driven]) - curves(np.log(speed[driven]), vine_index)
    # Fitted curves follow the trials: the scatter about them is smaller by the degrees of freedom that they take.
    median_deviation = float(np.median(np.abs(residual[driven]))) / 0.6745
    scatter = max(median_deviation * math.sqrt(np.count_nonzero(driven) / remaining), LEAST_SCATTER)
    allowed = _limit(len(data), remaining) * scatter
    replicates = [[j for j, other in enumerate(trials) if other.condition == trial.condition and j != k]
             for k, trial in enumerate(trials)]  # fmt: skip
    # Where a replicate deviates as much, the cause is physics of the condition.
    odd = [
        k
        for k in np.flatnonzero(np.abs(residual) > allowed).tolist()
        if all(abs(residual[j]) < allowed < abs(residual[k] - residual[j]) for j in replicates[k])
    ]
    if len(odd) > max(2, int(LARGEST_SHARE * len(data))):
        return []
    expected = {
        k: float(curves(np.log(speed[k]), index_of[names[k]])) if names[k] in index_of else math.nan for k in odd
    }
    return [OddTrial(trials[k].name, stated[k], _implied_pressure_Pa(trials[k], math.exp(expected[k]))) for k in odd]


def _limit(count: int, remaining: int) -> float:
    """Residual, in standard deviations, beyond which one of so many trials is an outlier (Bonferroni). `remaining` are
    the degrees of freedom that the fitted curves leave to the residuals.
    """
    from scipy.stats import t

    # 0.37, 1.0: efficiency of a standard deviation from the median absolute deviation, relative to that from the
    # mean square, and degrees of freedom added to so many times those that the fitted curves leave (derived)
    return float(t.isf(CHANCE / (2 * count), max(0.37 * remaining + 1.0, 3.0)))


def _stated_Pa(trial_data: FitTrial) -> float:
    """Pressure of the row, or the median of the recorded pressure."""
    return trial_data.trial.pressure_Pa if trial_data.trace is None else float(np.median(trial_data.trace[1]))


def _force_N(trial: Trial, pressure_Pa: float) -> float:
    """Twice the driving force on the tip: pressure above the yield pressure, and weight; as in `kinematics.force`."""
    return (pressure_Pa - float(np.nan_to_num(trial.yield_pressure_Pa))) * trial.area_m2 + _weight_N(trial)


def _weight_N(trial: Trial) -> float:
    middle_m = np.array([0.25 * np.nan_to_num(trial.length_m)])
    mass_kg = float(np.nan_to_num(trial.moving_mass_kg(middle_m))[0])
    return trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)


def _implied_pressure_Pa(trial: Trial, force_N: float) -> float:
    """Pressure at which this force would act."""
    return (force_N - _weight_N(trial)) / trial.area_m2 + float(np.nan_to_num(trial.yield_pressure_Pa))


def _fit_curves(log_force: Floats, log_speed: Floats, vine_index: Indices) -> Callable[[Floats, Indices | int], Floats]:
    """Fit ln F against ln v robustly (Cauchy loss): a level for each vine, a slope and a curvature common to all."""
    from scipy.optimize import least_squares

    usual_exponent = 0.37  # Starting value of the exponent (PHYSICS)
    n_vines, middle = int(vine_index.max()) + 1, float(np.median(log_speed))

    def curve(values: Floats, log_v: Floats, vine: Indices | int) -> Floats:
        return np.asarray(values[vine] + values[-2] * (log_v - middle) + values[-1] * (log_v - middle) ** 2)

    straight = log_force - usual_exponent * (log_speed - middle)
    levels = [float(np.median(straight[vine_index == vine])) for vine in range(n_vines)]
    # 0.05: residual of ln F at which the robust fit halves the weight of a trial (chosen)
    fit = least_squares(
        lambda values: log_force - curve(values, log_speed, vine_index),
        [*levels, usual_exponent, 0.0],
        loss="cauchy",
        f_scale=0.05,
    )
    return partial(curve, fit.x)


def with_odd_trials(result: Diagnosis, odd: Sequence[OddTrial], without: Callable[[list[str]], Diagnosis]) -> Diagnosis:
    """Add what outlying trials mean for a diagnosis. Where the model is adequate, or the other trials support the same
    effect, they are a note. Where no effect explains all trials but one explains the others, the explanation says so.
    """
    if not odd:
        return result
    noted = replace(result, notes=(*result.notes, remark("odd_trials", odd=odd, count=len(result.fits[0].trials))))
    if result.verdict == ADEQUATE:
        return noted
    try:
        others = without([trial.name for trial in odd])
    except (FitError, SimulationError):
        return noted
    unexplained = UNEXPLAINED in (result.verdict, result.final_verdict)
    if UNEXPLAINED in (others.verdict, others.final_verdict):
        return result if unexplained else noted
    if not unexplained and set(result.answer_set) & set(others.answer_set):
        return noted
    result = replace(result, odd_trials=tuple(trial.name for trial in odd))
    facts = {"odd": odd, "count": len(result.fits[0].trials), "others": others, "with_them": result.explanation}
    words = str(Remark("odd_trials_decide", {**facts, "withdrawn": not unexplained}))
    return replace(result, explanation=words) if unexplained else _withdrawn(result, words)


def _withdrawn(result: Diagnosis, words: str) -> Diagnosis:
    """The diagnosis as `unexplained`, with its effects withdrawn."""
    first = result.rounds[0]
    ranking = tuple(replace(candidate, in_answer_set=False) for candidate in first.ranking)
    withdrawn = replace(
        first, verdict=UNEXPLAINED, answer_set=(), ranking=ranking, explanation=words, fits={}, sets=(), partial=()
    )
    return Diagnosis(
        rounds=(replace(withdrawn, partial_fits=()),),
        effects=(),
        explanation=words,
        fits=result.fits[:1],
        notes=result.notes,
        power=result.power,
        odd_trials=result.odd_trials,
    )


# ------------------------------------------------------------------------------
# Recordings with dropped frames: their times are corrected, and dropped frames beyond doubt become the verdict.


@dataclass(frozen=True)
class LostFrames:
    """Trials that may have dropped frames, and those among them that have for certain."""

    trials: tuple[str, ...] = ()
    certain: tuple[str, ...] = ()

    def including(self, trial: str, track: Track) -> LostFrames:
        """Add a trial if its times were corrected for dropped frames."""
        if not with_flag(track.flag, "retimed").any():
            return self
        certain = (trial,) if frames_surely_missing(track) else ()
        return LostFrames((*self.trials, trial), (*self.certain, *certain))


def correct_dropped_frames(pairs: Pairs) -> tuple[list[tuple[Trial, Track]], LostFrames]:
    """Correct the times of tracks with dropped and repeated frames. Returns pairs, dropped."""
    corrected: list[tuple[Trial, Track]] = []
    dropped = LostFrames()
    for trial, track in pairs:
        if trial.video is None and not with_flag(track.flag, "retimed").any():
            track = correct_frames(track)
        dropped = dropped.including(trial.name, track)
        corrected.append((trial, track))
    return corrected, dropped


def dropped_frames_in(fit: Fit) -> LostFrames:
    """Find trials of a fit whose dropped frames were not corrected."""
    dropped = LostFrames()
    for trial_data in fit.predictor.data:
        track = correct_frames(plain_track(trial_data.time_s, trial_data.lead_position_m))
        dropped = dropped.including(trial_data.trial.name, track)
    return dropped


def with_lost_frames(result: Diagnosis, dropped: LostFrames) -> Diagnosis:
    """Put certain dropped frames first in a diagnosis, and its verdict with corrected times into a note. A jump that a
    few outlying points may have caused becomes a note only.
    """
    if not dropped.trials:
        return result
    if not dropped.certain:
        return replace(result, notes=(*result.notes, remark("frames_perhaps_missing", trials=dropped.trials)))
    first = result.rounds[0]
    words = str(remark("frames_missing", trials=dropped.trials))
    artefact = Round(
        model=first.model,
        verdict=ARTEFACT,
        answer_set=(DROPPED_FRAMES,),
        ranking=first.ranking,
        explanation=words,
        cosine_names=first.cosine_names,
        cosines=first.cosines,
        fit=first.fit,
    )
    note = remark("with_corrected_times", verdict=result.verdict, explanation=result.explanation)
    return Diagnosis(
        rounds=(artefact,), effects=(), explanation=words, fits=result.fits[:1], notes=(note,), power=result.power
    )
