"""Named models fitted to the recordings, and what each gains."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import vinetrack as vt
from tube.recordings import AREA_M2, Recording
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis.ladder import align_trials, left_out_error
from vinetrack.diagnosis.ladder import rms_of as rms_m
from vinetrack.dynamics.model import Model, Value
from vinetrack.experiment.folder import Experiment
from vinetrack.inference.fit_data import pairs_of
from vinetrack.inference.fit_result import Fit, TrialFit

PER_TUBE = {"static_yield.P_s": "vine"}
"""A pressure to start belongs to a tube as its yield pressure does."""

FRICTIONS_N_M, INERTIAS_KG = (2.0, 2.5, 3.0), (0.1, 0.2)
FALLING_N, FADES_AT_M_S = (0.5, 1.0), (0.1,)
QUADRATIC_N_M2 = (2.0, 5.0)
"""To begin from, every value of one with every value of the others; also begun from what the catalogue says. Chosen
around what the recordings show: from any single one of them a change of the last digit ends elsewhere, at 17 to 190 mm
on tube 2. Falling friction: ½A times the 2 to 4 kPa between start and stop, gone by 0.1 m/s."""

SETS = (
    ("static_yield",),
    ("tail_friction",),
    ("capstan_friction",),
    ("falling_friction",),
    ("static_yield", "tail_friction"),
    ("reel_inertia",),
    ("tail_friction", "reel_inertia"),
    ("falling_friction", "reel_inertia"),
    ("static_yield", "tail_friction", "reel_inertia"),
    ("tail_friction", "falling_friction", "reel_inertia"),
    ("quadratic_length_friction", "falling_friction", "reel_inertia"),
)
"""Sets of effects that are added to the base model."""


@dataclass(frozen=True)
class Outcome:
    """One model fitted to every tube by itself: fits by tube, predictions of all trials, errors on left-out ones, m."""

    name: str
    fits: Mapping[str, Fit]
    trials: tuple[TrialFit, ...]
    left_out_m: float
    left_out_by_tube: Mapping[str, float]

    @property
    def rms_m(self) -> float:
        """Root mean square of the position error, every trial alike, m."""
        return rms_m(self.trials)

    def rms_of(self, name: str) -> float:
        """Root mean square of the position error of one trial from where something moves, m."""
        return rms_m([trial for trial in self.trials if trial.name == name])


def models() -> dict[str, Model]:
    """The models by name, each the base model and more."""
    base = vt.base_model()
    named = {"Eq. (2)": base}
    for members in SETS:
        model = base
        for member in members:
            model = model + getattr(vt.effects, member)
        named[" ".join(f"+ {member}" for member in members)] = model
    return named


def starts(model: Model, recordings: Sequence[Recording], vines: Mapping[str, str]) -> list[dict[str, Value]]:
    """Values to begin from: those of the catalogue, and those the recordings show at a glance.

    A vine that stops and starts has a minimum in every way of matching starts to starts; the pressures at which it was
    seen to start are near the one that is meant.
    """
    seen = {
        vines[one.name]: next(event.pressure_Pa for event in one.events if event.kind == "start") for one in recordings
    }
    values: dict[str, Sequence[Value]] = {
        "static_yield.P_s": [seen],
        "tail_friction.mu_w": FRICTIONS_N_M,
        "quadratic_length_friction.q": QUADRATIC_N_M2,
        "falling_friction.F_s": FALLING_N,
        "falling_friction.v_s": FADES_AT_M_S,
        "reel_inertia.M": INERTIAS_KG,
    }
    values = {key: options for key, options in values.items() if key in model.parameter_names}
    glances = [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())]
    return [{}, *glances] if values else [{}]


def fit_tubes(name: str, model: Model, experiment: Experiment, recordings: Sequence[Recording]) -> Outcome:
    """A model fitted to every tube by itself.

    The tubes differ in brake, supply and making; nothing says that they share a friction or an n.
    """
    pairs, _ = pairs_of(experiment)
    tube_of = {one.name: one.tube for one in recordings}
    fits: dict[str, Fit] = {}
    trials: list[TrialFit] = []
    left_m: dict[str, float] = {}
    for tube in dict.fromkeys(one.tube for one in recordings):
        members = [pair for pair in pairs if tube_of[pair[0].name] == tube]
        fit, predicted = _best(name, model, members, recordings)
        fits[tube] = fit
        trials += predicted
        if len(members) > 1:
            left_m[tube] = left_out_error(fit)
    every = math.sqrt(float(np.mean(np.square(list(left_m.values()))))) if left_m else math.nan
    return Outcome(name, fits, tuple(trials), every, left_m)


def _best(
    name: str, model: Model, pairs: Sequence[tuple[Trial, Track]], recordings: Sequence[Recording]
) -> tuple[Fit, tuple[TrialFit, ...]]:
    """Of the fits begun from all starts the one with the least position error, and what it says of the trials.

    Not the likeliest: a model that is far from what happened takes its misfit for slow noise, and of two such fits
    the likelier may be several times further off.
    """
    vines = {trial.name: trial.vine for trial, _ in pairs}
    shared = {key: how for key, how in PER_TUBE.items() if key in model.parameter_names}
    followed: list[tuple[Fit, tuple[TrialFit, ...]]] = []
    for start in starts(model, [one for one in recordings if one.name in vines], vines):
        try:
            fit = vt.fit(model, pairs, shared=shared, start=start)
            followed.append((fit, tuple(align_trials(fit).trials)))
        except vt.FitError as error:
            print(f"{name}, {', '.join(vines)}: a start was given up. {error}")
    if not followed:
        raise vt.FitError(f"{name}: no start could be followed.")
    return min(followed, key=lambda pair: rms_m(pair[1]))


def number(fit: Fit, key: str) -> float:
    """A number of a fit to one tube, SI; NaN where it has none."""
    return next((one.value for one in fit.numbers if one.key == key), math.nan)


def threshold_kPa(fit: Fit, kind: str, length_m: float) -> float:
    """Gauge pressure at which the model starts, or stops once nothing carries it on, this far grown, kPa.

    Friction of the tail counts whole at the tail, the pressure a half: ½ (P − P_s) A = μ_s w y.
    """
    yields = number(fit, "yield_pressure.P_y")
    value = yields if kind == "stop" else float(np.fmax(yields, number(fit, "static_yield.P_s")))
    friction = float(np.nan_to_num(number(fit, "tail_friction.mu_w")))
    return (value + 2 * friction * length_m / AREA_M2) / 1e3
