"""Single trials that do not go with the others: a row of the sheet that belongs to another recording, a typing error.

One such trial among thirty leaves more than any effect explains, and the verdict is `unexplained`. It is looked for
without the model that failed: over the middle of its growth the tail moves about so fast that damping holds the force,

    ln F_j = ln B_vine + n ln v_j + c (ln v_j)²,    F = (P − P_y) A + r m̄ g cos θ

with a bend c for what goes with another power of speed. What a trial leaves of a robust fit of these curves is held
against what the others leave. Effects that the model lacks bend all trials of a condition alike; a pressure with its
digits swapped does not. Whether row or recording is wrong only the user can tell: nothing is left out by itself, but
what the others say without it is said too, and a name that rests on such trials alone is taken back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.result import ADEQUATE, UNEXPLAINED, Diagnosis
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.starts import middle_speed
from vinetrack.narrative.verdict_summary import joined
from vinetrack.narrative.verdict_text import odd_in_words

Indices = NDArray[np.int_]

USUAL_EXPONENT = 0.37
"""Where the exponent begins. PHYSICS: published for vines of 6 to 24 mm."""

USUAL_SCATTER = 0.05
"""Scatter of ln F from which the robust fit gives trials less weight. Chosen: B of one vine scatters by 1 to 4 % and
the pressure by 1 to 2 %; at half and twice only the efficiency of the fit changes."""

LEAST_SCATTER = 0.02
"""Scatter of ln F that is allowed at least: what careful trials differ by. Chosen; at half and twice campaigns of a few
very careful trials alone change."""

CHANCE = 1e-4
"""Chance that normal scatter makes a trial of a campaign odd. Chosen: it is asked where the verdict is `unexplained`
alone, and changes none; at ten times the limit falls from 10 to 8 standard deviations for 24 trials."""

EFFICIENCY = 0.37
"""Of a standard deviation from the median of absolute values, against the mean square. Derived for the normal
distribution."""

FEWEST_TRIALS, LARGEST_SHARE = 8, 0.125
"""Trials from which some can be odd, and the part of them that may be; two at least, for rows are exchanged. Chosen:
with eight, most say what is usual; where more than an eighth stand apart, they are no slips but a kind of their own."""


@dataclass(frozen=True)
class OddTrial:
    """A trial that does not go with the others: its pressure as stated and the one that it moves as with, Pa.

    `like_Pa` is NaN where none is known.
    """

    name: str
    stated_Pa: float
    implied_pressure_Pa: float


def odd_trials(data: Sequence[FitTrial]) -> list[OddTrial]:
    """Trials whose speed the stated numbers contradict, though those of the others agree.

    Parameters
    ----------
    data : trials of evertible tubes, as they were fitted.

    Returns
    -------
    list of OddTrial
        In the order of the trials; none where they are many, or where there are too few to say what is usual.
    """
    trials = [trial_data.trial for trial_data in data]
    if len(data) < FEWEST_TRIALS or any(trial.travel_ratio != 2 for trial in trials):
        return []
    speed = np.array([middle_speed(trial_data) for trial_data in data])
    stated = [_stated_Pa(trial_data) for trial_data in data]
    force = np.array([_force_N(trial, pressure_Pa) for trial, pressure_Pa in zip(trials, stated, strict=True)])
    moved = force > 0
    if np.count_nonzero(moved) < FEWEST_TRIALS:
        return []
    names = [trial.vine for trial in trials]
    known, place = np.unique(
        [name for name, is_moved in zip(names, moved, strict=True) if is_moved], return_inverse=True
    )
    usual = _curves(np.log(force[moved]), np.log(speed[moved]), place)
    which = {vine: k for k, vine in enumerate(known)}
    left = np.full(len(data), -np.inf)
    left[moved] = np.log(force[moved]) - usual(np.log(speed[moved]), place)
    scatter = max(float(np.median(np.abs(left[moved]))) / 0.6745, LEAST_SCATTER)
    allowed = _limit(len(data)) * scatter
    alike = [[j for j, other in enumerate(trials) if other.condition == trial.condition and j != k]
             for k, trial in enumerate(trials)]  # fmt: skip
    # Where a replicate stands as far off it is the condition, and physics.
    odd = [
        k
        for k in np.flatnonzero(np.abs(left) > allowed).tolist()
        if all(abs(left[j]) < allowed < abs(left[k] - left[j]) for j in alike[k])
    ]
    if len(odd) > max(2, int(LARGEST_SHARE * len(data))):
        return []
    due = {k: float(usual(np.log(speed[k]), which[names[k]])) if names[k] in which else math.nan for k in odd}
    return [OddTrial(trials[k].name, stated[k], _like_Pa(trials[k], math.exp(due[k]))) for k in odd]


def _limit(count: int) -> float:
    from scipy.stats import t

    return float(t.isf(CHANCE / (2 * count), max(EFFICIENCY * count, 3.0)))


def _stated_Pa(trial_data: FitTrial) -> float:
    """Pressure of the row, or of the gauge where it was recorded."""
    return trial_data.trial.pressure_Pa if trial_data.trace is None else float(np.median(trial_data.trace[1]))


def _force_N(trial: Trial, pressure_Pa: float) -> float:
    """Twice the force on the head less what begins growth and the weight, as in `kinematics.force`."""
    return (pressure_Pa - float(np.nan_to_num(trial.yield_pressure_Pa))) * trial.area_m2 + _weight_N(trial)


def _weight_N(trial: Trial) -> float:
    middle_m = np.array([0.25 * np.nan_to_num(trial.length_m)])
    mass_kg = float(np.nan_to_num(trial.moving_mass_kg(middle_m))[0])
    return trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)


def _like_Pa(trial: Trial, force_N: float) -> float:
    return (force_N - _weight_N(trial)) / trial.area_m2 + float(np.nan_to_num(trial.yield_pressure_Pa))


def _curves(log_force: Floats, log_speed: Floats, place: Indices) -> Callable[[Floats, Indices | int], Floats]:
    """Logarithm of force by that of speed and the place of the vine: a level for each, a slope and a bend of all."""
    from scipy.optimize import least_squares

    vines, middle = int(place.max()) + 1, float(np.median(log_speed))

    def curve(values: Floats, log_v: Floats, vine: Indices | int) -> Floats:
        return np.asarray(values[vine] + values[-2] * (log_v - middle) + values[-1] * (log_v - middle) ** 2)

    straight = log_force - USUAL_EXPONENT * (log_speed - middle)
    begun = [float(np.median(straight[place == vine])) for vine in range(vines)]
    fit = least_squares(
        lambda values: log_force - curve(values, log_speed, place),
        [*begun, USUAL_EXPONENT, 0.0],
        loss="cauchy",
        f_scale=USUAL_SCATTER,
    )
    return partial(curve, fit.x)


def with_odd_trials(result: Diagnosis, odd: Sequence[OddTrial], without: Callable[[list[str]], Diagnosis]) -> Diagnosis:
    """What trials that do not go with the others mean for a diagnosis.

    Of an adequate model, and where the others bear a name out, they are a note. Where nothing explains all trials and
    the others are explained, that is said. Where the others are explained and do not bear the name out, it rests on
    these trials alone, and the verdict is `unexplained`.

    Parameters
    ----------
    result : of all trials.
    odd : of them.
    without : gives the diagnosis without the trials of these names.

    Returns
    -------
    Diagnosis
    """
    if not odd:
        return result
    words = odd_in_words(odd, len(result.fits[0].trials))
    noted = replace(result, notes=(*result.notes, words))
    if result.verdict == ADEQUATE:
        return noted
    try:
        others = without([trial.name for trial in odd])
    except (FitError, SimulationError):
        return noted
    nothing = UNEXPLAINED in (result.verdict, result.final_verdict)
    if UNEXPLAINED in (others.verdict, others.final_verdict):
        return result if nothing else noted
    if not nothing and set(result.answer_set) & set(others.answer_set):
        return noted
    result = replace(result, odd_trials=tuple(trial.name for trial in odd))
    names = joined(result.odd_trials)
    words = f"{words} Without {names} the verdict is `{others.verdict}`: {others.explanation} With {names}:"
    if nothing:
        return replace(result, explanation=f"{words} {result.explanation}")
    named = f"what the verdict would be rests on {'it' if len(odd) == 1 else 'them'} alone. {result.explanation}"
    return _taken_back(result, f"{words} {named}")


def _taken_back(result: Diagnosis, words: str) -> Diagnosis:
    """A diagnosis whose names do not stand."""
    first = result.rounds[0]
    ranking = tuple(replace(candidate, in_answer_set=False) for candidate in first.ranking)
    asked = replace(
        first, verdict=UNEXPLAINED, answer_set=(), ranking=ranking, explanation=words, fits={}, sets=(), partial=()
    )
    return Diagnosis(
        rounds=(replace(asked, partial_fits=()),),
        effects=(),
        explanation=words,
        fits=result.fits[:1],
        notes=result.notes,
        power=result.power,
        odd_trials=result.odd_trials,
    )
