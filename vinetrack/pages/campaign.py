"""A results folder as read by the explorer: aligned trials, the model in use, and the effects to choose from.

It is read once and never changed; the choice of the user is in `choice`, its curves are in `curves`.
"""

from __future__ import annotations

import logging
import math
import shlex
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Kinematics, Track, Trial
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import SLIDER_UNITS, display_unit
from vinetrack.diagnosis.ladder import compare
from vinetrack.diagnosis.replicates import first_that_counts
from vinetrack.dynamics.model import Model, Value, check_needs, host_for
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, Parameter, catalogue
from vinetrack.inference.fit import fit, predict_from_rest, refit, rest_is_seen
from vinetrack.inference.fit_data import FitTrial, prepare
from vinetrack.inference.fit_result import DAMPING, YIELD_PRESSURE, Fit, Number, TrialFit, group_names
from vinetrack.inference.optimiser import CONVERGED_DECREASE, Step, Watch
from vinetrack.inference.sensitivity import initial_trial_effects
from vinetrack.pages.local_page import THREAD_PREFIX
from vinetrack.results.folder_layout import Results, ResultsError, measured_trials, read_fit, read_result

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment


@dataclass(frozen=True)
class ExplorerTrial:
    """One trial with its release and origin, which align it with the common clock and ruler of all trials."""

    data: FitTrial
    release_s: float
    origin_m: float

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

    @cached_property
    def first_drawn(self) -> int:
        """The first frame to draw: a little before the release, since rest would take most of a figure."""
        released = int(np.searchsorted(self.data.time_s, self.release_s))
        first = min(released, max(self.data.n_rest - 1, 0), self.data.time_s.size - 1)
        return max(first - max((self.data.time_s.size - first) // 20, 2), 0)


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
    same fit, NaN if it was refused. `in_use` are the effects of the model that the results are of.
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
    in_use: tuple[str, ...]

    @property
    def saved(self) -> tuple[str, ...]:
        """The effects of `model:` in the settings, which differ from those in use until the next run."""
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
    data, left_out = prepare(pairs, weighted=False)
    if not data:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items()) or "every trial failed"
        raise ResultsError(f"{folder} has no trial to explore: {why}")
    fitted = read_fit(results)
    refused = fitted.refused
    comparison = None if refused else read_result(results.comparison)
    conditions = [] if comparison is None else list(comparison["condition"].astype(str))
    floors = [] if comparison is None else map(float, comparison["replicate_floor_m"])
    compared = {name: read_result(results.trajectories(name)) for name in conditions}
    aligned = _align_trials(data, compared)
    effects = {**catalogue(), **user_effects}
    return Campaign(
        name=folder.name,
        folder=folder,
        experiment=experiment,
        pairs=tuple(pairs),
        kinematics=kinematics,
        trials=tuple(aligned),
        left_out={**experiment.failed, **experiment.left_out, **left_out},
        bands=_bands(compared),
        floors_m=dict(zip(conditions, floors, strict=True)),
        numbers={entry.name: entry.value for entry in fitted.numbers},
        log_likelihood=fitted.log_likelihood,
        refused=refused,
        effects=effects,
        in_use=fitted.names if fitted.names and set(fitted.names) <= set(effects) else tuple(experiment.settings.model),
        unusable=_unusable(effects.values(), [trial_data.trial for trial_data in data]),
    )


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
        trials.append(ExplorerTrial(trial_data, release_s, origin_m))
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


# ------------------------------------------------------------------------------
# What a model with given sizes predicts, with the errors that `vinetrack compare` would give it: as there, each trial
# has its own release and origin, found anew for every model.


@dataclass(frozen=True)
class Prediction:
    """A model's prediction of every trial of a campaign, in its order, and by condition the root mean square error of
    position and the scatter of replicates, m.
    """

    trials: tuple[TrialFit, ...]
    errors_m: Mapping[str, float]
    floors_m: Mapping[str, float]


def predict_choice(campaign: Campaign, choice: ModelChoice, floors_m: Mapping[str, float] | None = None) -> Prediction:
    """Predict every trial by a choice; the scatter of replicates hardly depends on it, and is taken as given."""
    yields_Pa = fitted_yield_pressures(campaign, choice.numbers)
    data = [trial.data for trial in campaign.trials]
    for i, aligned in enumerate(campaign.trials):
        if aligned.name in yields_Pa:
            data[i] = replace(data[i], trial=replace(data[i].trial, yield_pressure_Pa=yields_Pa[aligned.name]))
    predicted = predict_from_rest(sized_model(campaign, choice), data, campaign.host)
    squares = [float(np.mean(trial.residual_m[first_that_counts(trial) :] ** 2)) for trial in predicted]
    errors_m = {
        condition: math.sqrt(float(np.mean([squares[i] for i in campaign.indices_of_condition(condition)])))
        for condition in campaign.conditions
    }
    return Prediction(tuple(predicted), errors_m, campaign.floors_m if floors_m is None else floors_m)


def predict_fit(campaign: Campaign, fitted: Fit) -> Prediction:
    """Predict every trial by a fit, exactly as `vinetrack compare` does."""
    comparison = compare(fitted, campaign.pairs, kinematics=campaign.kinematics)
    by_name = {trial.name: trial for trial in comparison.trials}
    table = comparison.table.set_index("condition")
    errors_m, floors_m = (
        dict(zip(campaign.conditions, map(float, table.loc[list(campaign.conditions), column]), strict=True))
        for column in ("rms_position_m", "replicate_floor_m")
    )
    return Prediction(tuple(by_name[trial.name] for trial in campaign.trials), errors_m, floors_m)


def overall_m(errors: Mapping[str, float], conditions: Sequence[str]) -> float:
    """Return the root mean square over conditions with a known error, m; NaN if there are none."""
    known = [errors[name] for name in conditions if math.isfinite(errors.get(name, math.nan))]
    return math.sqrt(float(np.mean(np.square(known)))) if known else math.nan


def fitted_yield_pressures(campaign: Campaign, numbers: Mapping[str, float]) -> dict[str, float]:
    """Return fitted yield pressures by trial, from those by vine (and stated value, if a vine has several)."""
    yields_Pa = {}
    for aligned in campaign.trials:
        trial = aligned.data.trial
        for vine in (trial.vine, f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"):
            value = numbers.get(f"{YIELD_PRESSURE}[{vine}]")
            if value is not None:
                yields_Pa[trial.name] = value
    return yields_Pa


# ------------------------------------------------------------------------------
# The user's choice: the effects in the model and their sizes. Immutable; a change returns a new choice.


@dataclass(frozen=True)
class SizeControl:
    """One parameter of an effect with a slider, SI; `vine` is blank if one value applies to all trials."""

    effect: str
    parameter: Parameter
    vine: str
    low: float
    high: float

    @property
    def key(self) -> str:
        """`effect.parameter`."""
        return f"{self.effect}.{self.parameter.name}"

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets if each has its own value."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    @property
    def shown(self) -> tuple[str, float]:
        """The displayed unit, and the factor from SI."""
        return display_unit(self.parameter.unit, SLIDER_UNITS)


@dataclass(frozen=True)
class ModelChoice:
    """Effects in the model, in the order they were added, and the value of every parameter, in the model or not.
    `numbers` also holds the fitted yield pressures by vine, which have no slider.
    """

    effects: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __contains__(self, effect: object) -> bool:
        return effect in self.effects

    def with_effect(self, effect: str, wanted: bool = True) -> ModelChoice:
        """Return the choice with an effect added (at the end) or removed; its sizes are kept for when it returns."""
        if wanted == (effect in self.effects):
            return self
        kept = tuple(name for name in self.effects if name != effect)
        return replace(self, effects=(*kept, effect) if wanted else kept)

    def with_size(self, name: str, value: float) -> ModelChoice:
        """Return the choice with another value of one parameter."""
        return self.with_sizes({name: value})

    def with_sizes(self, numbers: Mapping[str, float]) -> ModelChoice:
        """Return the same effects with these values of parameters."""
        return replace(self, numbers={**self.numbers, **numbers})


def choice_in_use(campaign: Campaign) -> ModelChoice:
    """Return the model in use with its fitted values, and all other parameters at their defaults."""
    numbers = {
        size.name: size.parameter.default
        for effect in campaign.effects.values()
        for size in sizes_of(campaign, effect, {})
    }
    return ModelChoice(campaign.in_use, {**numbers, **campaign.numbers})


def sizes_of(campaign: Campaign, effect: Effect, numbers: Mapping[str, float]) -> list[SizeControl]:
    """Return the sliders of an effect: one per parameter, or one per vine or day if each has its own value. Their
    ranges include the present value.
    """
    sizes = []
    for parameter in effect.parameters:
        for vine in campaign.groups(parameter.shared):
            bare = SizeControl(effect.name, parameter, vine, 0.0, 1.0)
            low, high = slider_range(bare.key, parameter, numbers.get(bare.name, parameter.default))
            sizes.append(replace(bare, low=low, high=high))
    return sizes


def slider_range(key: str, parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the range of a slider: the plausible range, extended to the size without effect and the present value.
    Returns low, high, >>> slider_range("x.k", Parameter("k", "k", "1", 1.0, bounds=(0.0, 9.0), plausible=(0.0, 3.0)),
    5.0), (0.0, 6.25).
    """
    low, high = parameter.plausible or parameter.bounds
    if key == DAMPING or not (math.isfinite(low) and math.isfinite(high)):
        reach = 2.0 * max(abs(value), abs(parameter.default), 1e-12)
        low, high = (0.0 if parameter.bounds[0] >= 0 else -reach), reach
    low, high = min(low, parameter.zero, value), max(high, parameter.zero)
    if value >= high:
        high = value + 0.25 * (value - low)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1]) if value < parameter.bounds[1] else value


def sized_model(campaign: Campaign, choice: ModelChoice) -> Model:
    """Return the chosen model with its sizes, ready to be simulated."""
    effects = tuple(campaign.effects[name] for name in choice.effects)
    values: dict[str, Value] = {}
    for effect in effects:
        for size in sizes_of(campaign, effect, choice.numbers):
            value = choice.numbers.get(size.name, size.parameter.default)
            if size.vine:
                by_vine = values.get(size.key, {})
                assert isinstance(by_vine, Mapping)
                values[size.key] = {**by_vine, size.vine: value}
            else:
                values[size.key] = value
    return Model(effects, values)


# ------------------------------------------------------------------------------
# Fits of the explorer in background threads: the model in use, once for all open pages, and the chosen models.

log = logging.getLogger(__name__)

FAULT = "A fault of the program, not of your data: run vinetrack explore with --log FILE for the traceback."

CLEARLY_WORSE = 0.5  # Decrease in ln L (chosen)


class FitCancelled(Exception):  # noqa: N818 - nothing went wrong
    """The fit was cancelled."""


@dataclass(frozen=True)
class Fitted:
    """A fit, the choice with its estimates, and what it predicts."""

    choice: ModelChoice
    fit: Fit
    prediction: Prediction
    seconds: float

    def number(self, name: str) -> Number | None:
        """Return the estimate of a parameter, None if it was not fitted."""
        return next((number for number in self.fit.numbers if number.name == name), None)


def first_fit(campaign: Campaign, choice: ModelChoice, watch: Watch | None = None) -> Fitted:
    """Fit the model in use, as the model stage of the workflow does. The likelihood to be reached is in `fit.json`: if
    the first start reaches it, no others are tried.
    """
    started = time.perf_counter()
    model = sized_model(campaign, choice)
    # A falling body has no other parameter.
    free = ("gravity.g",) if model.names == ("gravity",) else ()
    bare = replace(model, values={})
    run_fit = partial(fit, bare, campaign.pairs, free=free, host=campaign.host, watch=watch, profile=False)
    result = run_fit(thorough=False)
    if not result.log_likelihood > campaign.log_likelihood - CLEARLY_WORSE:
        result = run_fit()
    return _evaluated(campaign, choice, result, time.perf_counter() - started)


@in_one_blas_thread
def fit_choice(campaign: Campaign, before: Fit, choice: ModelChoice, watch: Watch | None = None) -> Fitted:
    """Fit the chosen model, starting from an earlier fit, with the chosen sizes of new effects. If the result is worse
    than without the new effects, or has not converged, it is refitted from their defaults.
    """
    started = time.perf_counter()
    sized = sized_model(campaign, choice)
    model = replace(sized, values={})
    new = [effect for effect in model if effect.name not in before.model]
    chosen = {key: value for effect in new for key, value in sized.values.items() if key.startswith(f"{effect.name}.")}
    result = refit(before, model, start=chosen, watch=watch)
    is_larger = set(before.model.names) <= set(model.names)
    is_worse = is_larger and result.log_likelihood < before.log_likelihood - CLEARLY_WORSE
    if new and (is_worse or not result.converged):
        defaults: dict[str, Value] = {f"{e.name}.{p.name}": p.default for e in new for p in e.parameters}
        other = refit(before, model, start=defaults, watch=watch)
        result = max((result, other), key=lambda result: result.log_likelihood)
    return _evaluated(campaign, choice, result, time.perf_counter() - started)


def _evaluated(campaign: Campaign, choice: ModelChoice, result: Fit, seconds: float) -> Fitted:
    fitted_choice = choice.with_sizes({number.name: number.value for number in result.numbers})
    return Fitted(fitted_choice, result, predict_fit(campaign, result), seconds)


def likelihood_change_text(before: Fit, after: Fit) -> str:
    """Return how −2 ln L changed with a larger or smaller model, as a sentence."""
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    more = len(after.numbers) - len(before.numbers)
    numbers = f"{abs(more)} parameter{'' if abs(more) == 1 else 's'} {'more' if more > 0 else 'fewer'}"
    if more == 0:
        return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} with the same number of parameters."
    return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} for {numbers}."


def correlated_pairs_text(result: Fit) -> list[str]:
    """Return the pairs of strongly correlated estimates, largest correlation first, as text."""
    # Chosen: with this correlation each standard error is 1/√(1 − 0.9²) = 2.3 times its value with the other
    # parameter known
    strong_correlation = 0.9
    pairs = []
    for i, number in enumerate(result.numbers):
        for k in range(i):
            scale = math.sqrt(float(result.covariance[i, i] * result.covariance[k, k]))
            r = float(result.covariance[i, k]) / scale if scale > 0 and math.isfinite(scale) else 0.0
            if abs(r) > strong_correlation:
                pairs.append((abs(r), f"{result.numbers[k].title} and {number.title}: correlation {r:+.2f}"))
    return [words for _, words in sorted(pairs, reverse=True)]


Progress = TypeVar("Progress")
Outcome = TypeVar("Outcome")


class FitJob(Generic[Progress, Outcome]):
    """One fit, or a search made of fits, in a thread; the callbacks are called from that thread."""

    def __init__(
        self,
        work: Callable[[Callable[[Progress], None]], Outcome],
        *,
        on_progress: Callable[[Progress], None],
        on_success: Callable[[Outcome], None],
        on_failure: Callable[[str], None],
    ) -> None:
        self._work, self._on_progress, self._on_success, self._on_failure = work, on_progress, on_success, on_failure
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"{THREAD_PREFIX}fit")
        self._thread.start()

    def cancel(self) -> None:
        """End it at its next step; no callback is called any more."""
        self._cancelled.set()

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until it has ended."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            result = self._work(self._watch)
        except FitCancelled:
            return
        except UserError as error:
            self._report(self._on_failure, str(error))
        except Exception:
            log.exception("a fit of the explorer")
            self._report(self._on_failure, FAULT)
        else:
            if not self._cancelled.is_set():
                self._on_success(result)

    def _report(self, callback: Callable[[str], None], message: str) -> None:
        if not self._cancelled.is_set():
            callback(message)

    def _watch(self, step: Progress) -> None:
        if self._cancelled.is_set():
            raise FitCancelled
        self._on_progress(step)


class BackgroundFit:
    """Computes in a thread the `prediction` of the model in use, then its fit. `failure` is the reason if it
    failed, else blank. Listeners are called from that thread.
    """

    def __init__(self, campaign: Campaign, choice: ModelChoice | None = None) -> None:
        self.campaign = campaign
        self.initial = choice_in_use(campaign)
        self.opening_choice = self.initial if choice in (None, self.initial) else choice
        self.prediction: Prediction | None = None
        self.fitted: Fitted | None = None
        self.step: Step | None = None
        self.failure = ""
        self._listeners: list[Callable[[], None]] = []
        self._job: FitJob[Step, Fitted] | None = None

    def begin(self) -> BackgroundFit:
        """Start the thread."""
        self._job = FitJob(
            self._work, on_progress=self._on_step, on_success=self._on_success, on_failure=self._on_failure
        )
        return self

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until it has finished or failed."""
        if self._job is not None:
            self._job.wait(timeout_s)

    def add_listener(self, listener: Callable[[], None]) -> None:
        """Call `listener` whenever there is a new result or step."""
        self._listeners.append(listener)

    def remove_listener(self, listener: Callable[[], None]) -> None:
        """Remove a listener."""
        if listener in self._listeners:
            self._listeners.remove(listener)

    @property
    def running(self) -> bool:
        """Whether the fit is awaited."""
        return self._job is not None and self.fitted is None and not self.failure

    def _work(self, watch: Watch) -> Fitted:
        self.prediction = predict_choice(self.campaign, self.initial)
        self._notify()
        return first_fit(self.campaign, self.initial, watch)

    def _on_success(self, fitted: Fitted) -> None:
        self.fitted = fitted
        self._notify()

    def _on_failure(self, reason: str) -> None:
        self.failure = reason
        self._notify()

    def _on_step(self, step: Step) -> None:
        self.step = step
        self._notify()

    def _notify(self) -> None:
        for listener in list(self._listeners):
            listener()


_INITIAL_FRACTION = 0.04  # Fraction of the progress bar filled at the start; chosen: visible at a width of 200 pixels


class FitProgress:
    """Progress of a fit, as a fraction and as text; `message` is shown when no fit runs. The number of steps is
    unknown. Progress is measured on the logarithm of the predicted decrease of −2 ln L by the next step, from its
    largest value down to `CONVERGED_DECREASE`, where a fit stops; and by the clock where `typical_s` is given.
    """

    def __init__(self, typical_s: float = 0.0) -> None:
        self.message = ""
        self._typical_s = typical_s
        self._started = 0.0
        self._largest = 0.0
        self._fraction = _INITIAL_FRACTION
        self._step: Step | None = None

    def begin(self, now: float) -> None:
        """Start the clock of a new fit."""
        self._started, self._largest, self._fraction, self._step, self.message = now, 0.0, _INITIAL_FRACTION, None, ""

    def update(self, step: Step) -> None:
        """Take the latest step of the fit into account."""
        self._step = step
        if math.isfinite(step.predicted_decrease) and step.predicted_decrease > 0:
            self._largest = max(self._largest, step.predicted_decrease)
            whole = math.log10(max(self._largest, 10 * CONVERGED_DECREASE) / CONVERGED_DECREASE)
            done = math.log10(
                max(self._largest, step.predicted_decrease) / max(step.predicted_decrease, CONVERGED_DECREASE)
            )
            self._fraction = max(self._fraction, min(done / whole, 0.97))

    def state(self, now: float, task: str, other: Step | None = None) -> tuple[float, str]:
        """Return the fraction done and the text of the status line. Returns fraction, text."""
        passed_s = now - self._started
        if self._typical_s:
            return max(self._fraction, passed_s / (passed_s + self._typical_s / 2)), f"{task} · {passed_s:.0f} s"
        step = other or self._step
        where = f" · step {step.iteration}" if step is not None else ""
        promise = ""
        if step is not None and math.isfinite(step.predicted_decrease):
            promise = (
                f" · the next step lowers −2 ln L by {step.predicted_decrease:,.2g}"
                if step.predicted_decrease < 1e4
                else " · still far off"
            )
        return self._fraction, f"{task}{where}{promise} · {passed_s:.1f} s"


def commands(campaign: Campaign, choice: ModelChoice, *, fitted: bool, save: bool = False) -> list[str]:
    """Return the commands that give the choice without the page; none for sizes that were dragged and not fitted, and
    for a model without an effect of that in use.
    """
    folder = shlex.quote(campaign.folder.as_posix())
    added = [name for name in choice.effects if name not in campaign.in_use]
    if not fitted or not set(campaign.in_use) <= set(choice.effects):
        return []
    if not added:
        return [f"vinetrack compare {folder}"]
    end = " --save" if save else ""
    return [f"vinetrack add {_command_line_name(campaign, name)} {folder}{end}" for name in added]


def _command_line_name(campaign: Campaign, effect: str) -> str:
    """Name of an effect on the command line: its file, if the settings do not list that yet."""
    path = campaign.effects[effect].path
    is_unlisted = campaign.own_files([effect]) and path.name not in campaign.experiment.settings.effects
    return shlex.quote(path.as_posix()) if is_unlisted else effect


def model_text(names: Sequence[str]) -> str:
    """Return a model as text, with one name for the base effects together."""
    others = [name.replace("_", " ") for name in names if name not in BASE_EFFECTS]
    missing_base = [name for name in BASE_EFFECTS if name not in names]
    base = "base model" if not missing_base else " + ".join(name for name in names if name in BASE_EFFECTS)
    return " + ".join([base, *others])
