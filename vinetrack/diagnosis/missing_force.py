"""The force that a model lacks: drawn against growth, speed, time and pressure, and held against simple laws.

Nothing is differentiated. What a force would do to the positions is known (`vinetrack.diagnosis.force_sensitivities`);
the positions then say which force, by least squares with the noise of the tracks, release and origin of every trial
free, its pressure and B free within what replicates scatter by, and B, n and all other numbers of the model free
beside it.

Part of any force can be taken over by B and n: between them and a force that is drawn freely the data do not decide.
Where a simple law explains most of what is missing, B and n are put as this law has them; else where the fit left them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceFit, Gain
from vinetrack.diagnosis.force_laws import Law, coarse_laws, finer_laws
from vinetrack.diagnosis.force_refinement import refine
from vinetrack.diagnosis.force_sensitivities import FittedMotion, force_sensitivities
from vinetrack.diagnosis.force_surface import curves, standard_error
from vinetrack.diagnosis.learned_force import LearnedForce, learned_force
from vinetrack.diagnosis.linear_misfit import LinearMisfit, linear_misfit, pieces_along
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

FORCE_COLUMNS = ("against", "value", "force_N", "sigma_N", "condition")
LAW_COLUMNS = ("law", "words", "explained", "amplitude_N", "sigma_N", "delta_chi2", "bic")

FAMILIES = {"growth": 24, "speed": 10, "time": 10}
"""Smooth pieces of a force that hangs on one thing alone, the same in all trials."""

PARTS = 10
"""Means over all conditions are taken in so many parts of each axis. Chosen for the picture."""

LIKE = 0.7
"""Part of what is missing that a law must explain to be named. Chosen: below, a sentence that names a law would
mislead; at 0.85 a law with a wrong exponent is not named either."""

SEEN = 5.0
"""Errors that a force must be away from nothing: some hundred laws are tried. Chosen: five standard errors keep the
best of a hundred laws at a chance of 6e-5."""

DRAWN = 24
"""Points of a curve. Chosen for the picture."""

UNTOLD = 2.0
"""Times the usual error, beyond which a force is not drawn: near the end it has no time left to move anything. Chosen
for the picture."""

IN_FULL, ROUGH = 3, 1.5
"""Laws that are fitted in full where the best linear fit leaves more than this times the noise; else the best alone.
Chosen for time."""

WORTH, AS_PROMISED = 0.5, 1.5
"""Part of χ² that a law must take away to be fitted in full, and by how much more it may then leave than promised.
Chosen for time; a law refused here keeps its linear fit."""

MENDS = 0.5
"""Part of the misfit that a smooth force in every condition must take away, to be a force at all. Chosen: half of the
misfit, below which the sentence says that it is no force."""

EQUALLY = 0.05
"""Laws that explain as much but for this part are named beside it. Chosen: a twentieth is what single trials scatter
by."""


BEYOND_DRIVE = 10.0
"""Times the largest drive, weight and inertia of the trials, above which a force is not named: such a law acts at the
edge of what was visited, where next to nothing is felt of it. Chosen: one missing force of the drive's own size is a
gross failure already; at half of it a stop that a vine runs into may go unnamed, at twice nonsense is as rare."""


Answers = Callable[[Sequence[Law]], list[Floats]]


@dataclass(frozen=True)
class SeenLaw:
    """A law with its size: amplitudes, N, the part of what any smooth force could explain, and the words for it."""

    law: Law
    amplitude_N: tuple[float, ...]
    explained: float
    words: str


@dataclass(frozen=True)
class MissingForce:
    """What is missing, as a force on the tail, N.

    `table`, columns `FORCE_COLUMNS`: the force of every condition (blank: mean over all) against `lead_position_m`,
    `tail_velocity_m_s`, `time_s` and `pressure_Pa`. `laws`, columns `LAW_COLUMNS`, the best of each kind, best first;
    `explained` is the part of what any smooth force could explain. `depends_on` gives the same for a force that hangs
    on one thing alone. `seen` are the laws whose force is more than errors could make, best first.
    `learned` is the force as a smooth function of one or two variables; None where none is heard.
    """

    table: pd.DataFrame
    laws: pd.DataFrame
    depends_on: Mapping[str, float]
    sentence: str
    seen: tuple[SeenLaw, ...] = ()
    learned: LearnedForce | None = None

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "sentence": self.sentence,
            "laws": self.laws.head(6).to_dict("records"),
            "depends_on": dict(self.depends_on),
            "learned": None if self.learned is None else self.learned.to_json(),
        }


def missing_force(model_fit: Fit, *, learn: bool = True) -> MissingForce:
    """Find the force that a fit lacks.

    Parameters
    ----------
    model_fit : the fit that is questioned.
    learn : bool
        Whether to learn it as a smooth function as well, which takes most of the time.

    Returns
    -------
    MissingForce

    Raises
    ------
    FitError
        If the model cannot be followed.
    """
    linear = linear_misfit(model_fit)
    fit, motions, everything = linear.fit, linear.motions, linear.everything

    def answers(laws: Sequence[Law]) -> list[Floats]:
        return force_sensitivities(
            model_fit, fit.trial_effects, motions, lambda m: np.column_stack([law.along(m) for law in laws])
        )

    ranked = _in_full(model_fit, fit, motions, _ranked(fit, answers, motions, everything))
    families = _families(model_fit, fit, motions)
    whole = max([1e-300, everything.beyond, *families.values(), *(hypothesis.gain.beyond for hypothesis in ranked)])
    laws = [replace(hypothesis, explained=hypothesis.gain.beyond / whole) for hypothesis in ranked]
    depends = {name: beyond / whole for name, beyond in families.items()}
    best = laws[0]
    gauge = best.gain.numbers if best.explained >= LIKE and best.seen else np.zeros_like(best.gain.numbers)
    drawn = fit.smooth(linear.pieces, gauge)
    return MissingForce(
        table=_table(motions, linear.longest, drawn),
        laws=_law_table(laws),
        depends_on=depends,
        sentence=_sentence(laws, depends, _mended(fit, whole)),
        seen=tuple(_seen(law) for law in laws if law.seen),
        learned=_learned(model_fit, linear) if learn else None,
    )


def learned_alone(model_fit: Fit) -> LearnedForce | None:
    """The force that a fit lacks as a smooth function, without the laws that it may look like.

    Parameters
    ----------
    model_fit : the fit that is questioned.

    Returns
    -------
    LearnedForce or None

    Raises
    ------
    FitError
        If the model cannot be followed.
    """
    return _learned(model_fit, linear_misfit(model_fit))


def _learned(model_fit: Fit, linear: LinearMisfit) -> LearnedForce | None:
    """The force as a smooth function; None also where it leads to motions that cannot be followed.

    In one thread: matrices of 160 rows are too small for more, and on cores that are busy threads wait for each other,
    a hundred times as long as the work takes.
    """
    try:
        with threadpool_limits(1), np.errstate(all="raise", under="ignore"):
            return learned_force(model_fit, linear.fit, linear.motions, linear.fit.scatter.dof)
    except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
        return None


def _seen(judged: _Judged) -> SeenLaw:
    amplitude = judged.gain.amplitude
    words = judged.law.words(amplitude.tolist(), judged.gain.sigma)
    return SeenLaw(judged.law, tuple(amplitude.tolist()), judged.explained, words)


@dataclass(frozen=True)
class _Judged:
    """A law with what it explains."""

    law: Law
    gain: Gain
    bic: float
    explained: float = 0.0
    largest_N: float = math.inf

    @property
    def seen(self) -> bool:
        """Whether its force is more than the errors of single trials could make, and one that these motions allow."""
        size_N = math.hypot(*self.gain.amplitude)
        return SEEN * self.gain.sigma < size_N < self.largest_N and not self.law.is_a_point


def _ranked(fit: ForceFit, answers: Answers, motions: Sequence[FittedMotion], everything: Gain) -> list[_Judged]:
    """The best law of each kind, best first."""

    def gains(laws: Sequence[Law]) -> list[tuple[Law, Gain]]:
        judged_laws = zip(laws, fit.gains(answers(laws), [law.columns for law in laws]), strict=True)
        return [(law, gain) for law, gain in judged_laws if gain.terms or law.kind == "constant"]

    judged_laws, largest = gains(coarse_laws(motions)), _largest_N(motions)
    most = max(everything.chi2, *(gain.chi2 for _, gain in judged_laws))
    finer = [
        law
        for judged in _best_of_kinds(_judged(fit, judged_laws, most, largest))
        for law in finer_laws(judged.law, motions)
    ]
    judged_laws += gains(finer)
    most = max(most, *(gain.chi2 for _, gain in judged_laws))
    return sorted(
        _best_of_kinds(_judged(fit, judged_laws, most, largest)), key=lambda judged: (not judged.seen, judged.bic)
    )


def _in_full(model_fit: Fit, fit: ForceFit, motions: Sequence[FittedMotion], laws: list[_Judged]) -> list[_Judged]:
    """The laws, the best fitted in full where that leaves hardly more than their linear fit promised.

    Where the linear fit of the best leaves but noise, its rivals' will do.
    """
    rough = fit.chi2 - laws[0].gain.chi2 > ROUGH * fit.points
    gains = [law.gain for law in laws]
    for k, judged_law in enumerate(laws[: IN_FULL if rough else 1]):
        if not judged_law.seen or judged_law.gain.chi2 < WORTH * fit.chi2:
            continue
        full = refine(model_fit, fit, motions, judged_law.law, judged_law.gain, thorough=k == 0)
        if full is not None and full.chi2 < max(AS_PROMISED * (fit.chi2 - judged_law.gain.chi2), fit.points):
            gains[k] = Gain(fit.chi2 - full.chi2, full.amplitude, full.sigma, full.numbers, judged_law.gain.terms)
            laws = [*laws[:k], replace(judged_law, law=full.law), *laws[k + 1 :]]
    most = max(gain.chi2 for gain in gains)
    judged = _judged(fit, list(zip((law.law for law in laws), gains, strict=True)), most, _largest_N(motions))
    return sorted(judged, key=lambda ranked: (not ranked.seen, ranked.bic))


def _judged(fit: ForceFit, laws_and_gains: Sequence[tuple[Law, Gain]], most: float, largest_N: float) -> list[_Judged]:
    return [
        _Judged(law, gain, fit.bic(gain.chi2, law.numbers, most), largest_N=largest_N) for law, gain in laws_and_gains
    ]


def _largest_N(motions: Sequence[FittedMotion]) -> float:
    """The largest force that is named: BEYOND_DRIVE times drive, weight and inertia at their largest."""
    sizes = []
    for motion in motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.actual))
        sizes.append(float(np.max(drive_N + body_N)))
    return BEYOND_DRIVE * max(sizes)


def _best_of_kinds(judged: Sequence[_Judged]) -> list[_Judged]:
    best: dict[str, _Judged] = {}
    for law in judged:
        before = best.get(law.law.name)
        if before is None or (not law.seen, law.bic) < (not before.seen, before.bic):
            best[law.law.name] = law
    return list(best.values())


def _families(model_fit: Fit, fit: ForceFit, motions: Sequence[FittedMotion]) -> dict[str, float]:
    """By how much χ² falls with a smooth force that hangs on one thing alone; or one constant a condition."""
    along = {
        "growth": lambda m: m.lead_position_m,
        "speed": lambda m: m.tail_velocity_m_s,
        "time": lambda m: m.time_s,
    }
    explained = {}
    for name, count in FAMILIES.items():
        top = max(float(along[name](motion).max()) for motion in motions)
        answers = force_sensitivities(
            model_fit,
            fit.trial_effects,
            motions,
            lambda m, a=along[name], t=top, n=count: curves(a(m) / t, n),  # type: ignore[misc]
        )
        explained[name] = fit.together(answers).beyond
    constant = force_sensitivities(model_fit, fit.trial_effects, motions, lambda m: np.ones((m.time_s.size, 1)))
    explained["condition"] = fit.by_condition(constant).beyond
    return explained


def _table(
    motions: Sequence[FittedMotion], longest: Mapping[str, float], drawn: Mapping[str, tuple[Floats, Floats]]
) -> pd.DataFrame:
    """Force of every condition along its first trial's motion, and the mean over all."""
    import pandas as pd

    rows = []
    for condition, (coefficients, covariance) in drawn.items():
        motion = next(m for m in motions if m.trial.condition == condition)
        at = np.linspace(0.04, 0.96, DRAWN) * motion.lead_position_m.max()
        shape = pieces_along(at / longest[condition])
        sigma = standard_error(shape, covariance)
        told = sigma < UNTOLD * np.median(sigma)
        at, force, sigma = at[told], (shape @ coefficients)[told], sigma[told]
        when = np.interp(at, motion.lead_position_m, motion.time_s)
        axes = {
            "lead_position_m": at,
            "tail_velocity_m_s": np.interp(when, motion.time_s, motion.tail_velocity_m_s),
            "time_s": when,
            "pressure_Pa": np.interp(when, motion.time_s, motion.pressure_Pa),
        }
        for against, values in axes.items():
            rows += [(against, *row, condition) for row in zip(values, force, sigma, strict=True)]
    table = pd.DataFrame(rows, columns=list(FORCE_COLUMNS))
    means = [_mean(part) for _, part in table.groupby("against", sort=False)]
    return pd.concat([table, *means], ignore_index=True)


def _mean(part: pd.DataFrame) -> pd.DataFrame:
    """Weighted means over all conditions in parts of an axis; errors no smaller than conditions differ."""
    import pandas as pd

    values = part["value"].to_numpy(float)
    edges = np.linspace(values.min(), values.max(), PARTS + 1)
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, PARTS - 1)
    rows = []
    for k in np.unique(place):
        chosen = part[place == k]
        weight = 1 / chosen["sigma_N"].to_numpy(float) ** 2
        force = chosen["force_N"].to_numpy(float)
        mean = float(np.average(force, weights=weight))
        conditions = len(set(chosen["condition"]))
        scatter = math.sqrt(float(np.average((force - mean) ** 2, weights=weight)) / max(conditions - 1, 1))
        formal = float(np.sqrt(1 / np.sum(weight)))
        at = float(np.average(chosen["value"].to_numpy(float), weights=weight))
        rows.append((part["against"].iloc[0], at, mean, max(formal, scatter if conditions > 1 else 0.0), ""))
    return pd.DataFrame(rows, columns=list(FORCE_COLUMNS))


def _law_table(laws: Sequence[_Judged]) -> pd.DataFrame:
    import pandas as pd

    rows = [
        (
            law.law.name,
            law.law.words(law.gain.amplitude.tolist(), law.gain.sigma),
            law.explained,
            float(law.gain.amplitude[0]) if law.law.columns == 1 else float(np.hypot(*law.gain.amplitude)),
            law.gain.sigma,
            law.gain.chi2,
            law.bic,
        )
        for law in laws
    ]
    return pd.DataFrame(rows, columns=list(LAW_COLUMNS))


def _mended(fit: ForceFit, whole: float) -> float:
    """Part of the misfit that a force can mend; NaN where there is none to speak of beyond the noise."""
    misfit = fit.chi2 - fit.points
    return min(whole / misfit, 1.0) if misfit > fit.points else math.nan


def _sentence(laws: Sequence[_Judged], depends: Mapping[str, float], mended: float) -> str:
    """What it looks like, in a sentence or two."""
    best = laws[0]
    if mended < MENDS:
        return (
            f"No smooth force on the tail mends it: one of its own in every condition takes away {max(mended, 0.0):.0%}"
            " of the misfit. Either it is no force, or the model is too far off to say."
        )
    words = best.law.words(best.gain.amplitude.tolist(), best.gain.sigma)
    if not best.seen and math.isfinite(mended):
        return "What is missing is no simple law of force that single trials agree on."
    if not best.seen:
        return "No further force on the tail can be told from how single trials differ."
    if best.explained < LIKE:
        name, part = max(depends.items(), key=lambda part: part[1])
        whole = {
            "growth": "where the tip is",
            "speed": "the speed",
            "time": "the time",
            "condition": "the condition, and not on what happens in a trial",
        }
        sentence = (
            f"What is missing looks like none of the simple laws: the best, {words},"
            f" explains {best.explained:.0%} of it."
        )
        if part >= LIKE:
            sentence += f" It hangs on {whole[name]}: a force of that alone explains {part:.0%}."
        return sentence
    # What not even a free force mends is the error of small forces where the force is none: laws are told apart less.
    nearly = EQUALLY + float(np.nan_to_num(1 - mended))
    others = [
        law
        for law in laws[1:]
        if law.seen and law.explained > best.explained - nearly and law.law.shapes <= best.law.shapes
    ]
    sentence = f"What is missing looks like {words}; that explains {best.explained:.0%} of what any force could."
    if others:
        listed = "; ".join(other.law.words(other.gain.amplitude.tolist(), other.gain.sigma) for other in others[:2])
        sentence += f" These data would nearly as well have: {listed}."
    return sentence
