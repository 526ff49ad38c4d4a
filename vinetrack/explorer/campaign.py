"""A results folder as read by the explorer: aligned trials, the model in use, and the effects to choose from.

It is read once and never changed; the choice of the user is in `choice`, its curves are in `curves`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats, Kinematics, Track, Trial
from vinetrack.dynamics.host import host_for
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.trial_inputs import check_needs
from vinetrack.effects import Effect, EffectError, catalogue
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.left_out import rest_is_seen
from vinetrack.inference.parameters import group_names
from vinetrack.inference.prepared_trials import prepare
from vinetrack.inference.starts import initial_trial_effects
from vinetrack.pipeline.model_stage import measured_trials
from vinetrack.results.folder_layout import Results, ResultsError, read_result
from vinetrack.results.stored_fit import read_fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment


@dataclass(frozen=True)
class ExplorerTrial:
    """One trial with its release and origin, which align it with the common clock and ruler of all trials.
    `origin_known` tells whether the vine was filmed at rest; if not, the origin is fitted with a model.
    """

    data: FitTrial
    release_s: float
    origin_m: float
    origin_known: bool

    @property
    def name(self) -> str:
        """The trial's name."""
        return self.data.trial.name

    @property
    def condition(self) -> str:
        """The condition it is a replicate of."""
        return self.data.trial.condition

    @cached_property
    def time_s(self) -> Floats:
        """Time since release, s, shape (n_points,)."""
        return self.data.time_s - self.release_s

    @cached_property
    def growth_m(self) -> Floats:
        """Position from the origin, m, shape (n_points,)."""
        return self.data.lead_position_m - self.origin_m

    def first_counted_frame(self, release_s: float) -> int:
        """Return the first frame that counts for errors: where model or measurement moves, since rest
        dilutes an error.
        """
        released = int(np.searchsorted(self.data.time_s, release_s))
        return min(released, max(self.data.n_rest - 1, 0), self.data.time_s.size - 1)


@dataclass(frozen=True)
class ReplicateBand:
    """Mean and standard deviation of the replicates of one condition, shape (n_times,)."""

    time_s: Floats
    mean_m: Floats
    sigma_m: Floats


@dataclass(frozen=True)
class Campaign:
    """A results folder with its experiment, read by `read_campaign`. `numbers` are the estimates of the fit in
    `fit.json`, by name, SI; empty if the fit was refused, with the reason in `refused`. `log_likelihood` is that of the
    same fit, NaN if it was refused.
    """

    name: str
    folder: Path
    experiment: Experiment
    pairs: tuple[tuple[Trial, Track], ...]
    kinematics: Mapping[str, Kinematics]
    trials: tuple[ExplorerTrial, ...]
    left_out: Mapping[str, str]
    bands: Mapping[str, ReplicateBand]
    floors_m: Mapping[str, float]
    numbers: Mapping[str, float]
    log_likelihood: float
    refused: str
    effects: Mapping[str, Effect]
    unusable: Mapping[str, str]

    @property
    def in_use(self) -> tuple[str, ...]:
        """Names of the effects in use: `model:` of the experiment."""
        return tuple(self.experiment.settings.model)

    @cached_property
    def conditions(self) -> tuple[str, ...]:
        """Conditions ordered by vine (as in the sheet), payload and pressure."""
        first = {aligned.condition: aligned.data.trial for aligned in reversed(self.trials)}
        vines = list(dict.fromkeys(aligned.data.trial.vine for aligned in self.trials))
        rank = {name: (vines.index(t.vine), t.payload_kg, t.pressure_Pa) for name, t in first.items()}
        return tuple(sorted(rank, key=lambda name: rank[name]))

    @cached_property
    def vines(self) -> tuple[str, ...]:
        """Vines in the order of the sheet."""
        return self.groups("vine")

    def groups(self, shared: str) -> tuple[str, ...]:
        """Return the groups of trials with a parameter value of their own, in the order of the sheet."""
        return tuple(group_names([aligned.data.trial for aligned in self.trials], shared))

    @cached_property
    def labels(self) -> Mapping[str, str]:
        """A short name of every condition: those of its settings that vary."""
        return condition_labels(
            {name: self.trials[self.indices_of_condition(name)[0]].data.trial for name in self.conditions}
        )

    @cached_property
    def host(self) -> Model:
        """One model with all effects, as in a diagnosis: its compiled form serves every model that can be chosen."""
        return host_for(Model(()), self.effects.values())

    def own_files(self, names: Sequence[str]) -> list[str]:
        """Return the files of user effects in the experiment's folder, of those named."""
        folder = self.experiment.folder.resolve()
        paths = [self.effects[name].path for name in names]
        return [path.name for path in paths if path.resolve().parent == folder]

    def indices_of_condition(self, condition: str) -> list[int]:
        """Return the indices of the trials of a condition in `trials`."""
        return [i for i, aligned in enumerate(self.trials) if aligned.condition == condition]

    def trial(self, name: str) -> ExplorerTrial:
        """Return the trial of that name; KeyError if there is none."""
        return {aligned.name: aligned for aligned in self.trials}[name]


def read_campaign(folder: Path, experiment: Experiment, user_effects: Mapping[str, Effect]) -> Campaign:
    """Read the results folder of an experiment."""
    results = Results(folder)
    pairs, kinematics = measured_trials(experiment, results)
    data, left_out = prepare(pairs)
    if not data:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items()) or "every trial failed"
        raise ResultsError(f"{folder} has no trial to explore: {why}")
    fitted = read_fit(results)
    refused = fitted.refused
    compared = {} if refused else _compared(results)
    aligned = _align_trials(data, compared)
    effects = {**catalogue(), **user_effects}
    floors = {} if refused else _floors(results)
    return Campaign(
        name=folder.name,
        folder=folder,
        experiment=experiment,
        pairs=tuple(pairs),
        kinematics=kinematics,
        trials=tuple(aligned),
        left_out={**experiment.failed, **experiment.left_out, **left_out},
        bands=_bands(compared),
        floors_m=floors,
        numbers={entry.name: entry.value for entry in fitted.numbers},
        log_likelihood=fitted.log_likelihood,
        refused=refused,
        effects=effects,
        unusable=_unusable(effects.values(), [trial_data.trial for trial_data in data]),
    )


def _compared(results: Results) -> dict[str, pd.DataFrame]:
    """`comparison/<condition>.csv` by condition."""
    conditions = read_result(results.comparison)["condition"]
    return {str(name): read_result(results.trajectories(str(name))) for name in conditions}


def _floors(results: Results) -> dict[str, float]:
    table = read_result(results.comparison)
    return dict(zip(table["condition"].astype(str), table["replicate_floor_m"].astype(float), strict=True))


def _align_trials(data: list[FitTrial], compared: Mapping[str, pd.DataFrame]) -> list[ExplorerTrial]:
    """Align trials by the release and origin of the comparison, or else by those estimated from the track alone."""
    starts, at_rest = initial_trial_effects(data), rest_is_seen(data)
    trials = []
    for i, trial_data in enumerate(data):
        release_s, origin_m = float(starts[i, 0]), float(starts[i, 1])
        table = compared.get(trial_data.trial.condition)
        rows = None if table is None else table[table["trial"] == trial_data.trial.name]
        if rows is not None and len(rows) == trial_data.time_s.size:
            release_s = float(trial_data.time_s[0] - rows["time_s"].iloc[0])
            origin_m = float(trial_data.lead_position_m[0] - rows["lead_position_m"].iloc[0])
        if at_rest[i]:
            origin_m = trial_data.rest_origin_m
        trials.append(ExplorerTrial(trial_data, release_s, origin_m, bool(at_rest[i])))
    return trials


def _bands(compared: Mapping[str, pd.DataFrame]) -> dict[str, ReplicateBand]:
    """Mean and standard deviation of the replicates at the times of the longest trial of each condition."""
    bands = {}
    for condition, table in compared.items():
        if table["trial"].nunique() < 2:
            continue
        longest = table.groupby("trial")["time_s"].max().idxmax()
        rows = table[table["trial"] == longest]
        names = ("time_s", "replicates_mean_m", "replicates_sigma_m")
        time_s, mean_m, sigma_m = (rows[name].to_numpy(dtype=float) for name in names)
        known = np.isfinite(sigma_m) & np.isfinite(mean_m)
        bands[condition] = ReplicateBand(time_s[known], mean_m[known], sigma_m[known])
    return bands


def _unusable(effects: Any, trials: list[Trial]) -> dict[str, str]:
    reasons = {}
    for effect in effects:
        try:
            check_needs(Model((effect,)), *trials)
        except EffectError:
            reasons[effect.name] = f"needs {' and '.join(effect.needs)} in the sheet"
    return reasons


def condition_labels(conditions: Mapping[str, Trial]) -> dict[str, str]:
    """Return a label for each condition, from the settings in which the trials of the experiment differ."""
    written = {name: _settings(trial) for name, trial in conditions.items()}
    keys = list(dict.fromkeys(key for settings in written.values() for key in settings))
    varying = [key for key in keys if len({settings.get(key, "") for settings in written.values()}) > 1]
    kept = _without_redundant(varying, written) or ["pressure"]
    labels = {
        name: ", ".join(settings[key] for key in kept if settings.get(key)) or name
        for name, settings in written.items()
    }
    named = list(labels.values())
    # Conditions that differ in another setting get their name appended.
    return {name: label if named.count(label) == 1 else f"{label} ({name})" for name, label in labels.items()}


def _without_redundant(keys: list[str], written: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Drop thickness and length if the other sizes determine them."""
    kept = list(keys)
    for key in ("length", "thickness"):
        others = [other for other in kept if other in ("diameter", "thickness", "length") and other != key]
        with_it = {tuple(s.get(k, "") for k in (*others, key)) for s in written.values()}
        if key in kept and others and len(with_it) == len({pair[:-1] for pair in with_it}):
            kept.remove(key)
    return kept


def _settings(trial: Trial) -> dict[str, str]:
    """Settings that may distinguish conditions, in the units of the sheet."""
    numbers = {
        "diameter": (1e3 * trial.diameter_m, "mm"),
        "thickness": (1e6 * trial.thickness_m, "µm"),
        "length": (1e3 * trial.length_m, "mm long"),
        "pressure": (trial.pressure_Pa / 1e3, "kPa"),
        "payload": (1e3 * trial.payload_kg if trial.payload_kg else math.nan, "g"),
        "angle": (math.degrees(trial.growth_angle_rad), "°"),
        "chamber": (1e3 * trial.chamber_m3, "L"),
        "inlet": (1e3 * trial.inlet_m, "mm inlet"),
        "bends": (len(trial.bends) if trial.bends else math.nan, "bends"),
    }
    return {key: f"{value:.3g} {unit}" for key, (value, unit) in numbers.items() if math.isfinite(value)}
