"""A results folder as read by the explorer, the models that a user may choose in it, and their predictions and fits."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pandas as pd

import vinetrack.results as layout
from vinetrack.core.problems import UserError, reasons_told
from vinetrack.core.process import THREAD_PREFIX, in_one_blas_thread
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.diagnosis.ladder import rms_of
from vinetrack.dynamics.model import Model, Value, check_needs, host_for, values_by_key
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, Parameter, catalogue
from vinetrack.experiment.folder import Experiment
from vinetrack.figures.registry import condition_labels
from vinetrack.inference.fit import fit, predict_by_model, refit, rest_is_seen
from vinetrack.inference.fit_data import FitTrial, prepare
from vinetrack.inference.fit_result import DAMPING, YIELD_PRESSURE, Fit, FitSummary, Number, TrialFit, group_names
from vinetrack.inference.optimiser import Step, Watch
from vinetrack.inference.sensitivity import initial_trial_effects
from vinetrack.narrative.verdict_text import spaced_name


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
    def rows(self) -> slice:
        """The frames to draw, from a little before the end of the rest; points closer than a pixel are left out."""
        count = self.time_s.size
        first = min(int(np.searchsorted(self.data.time_s, self.release_s)), max(self.data.n_rest - 1, 0), count - 1)
        begin = max(first - max((count - first) // 20, 2), 0)
        # 250: points of a line; chosen: one per three or four pixels
        return slice(begin, None, max(math.ceil((count - begin) / 250), 1))


@dataclass(frozen=True)
class Campaign:
    """A results folder with its experiment. `stored` is its fit, `in_use` the effects of the model it is of."""

    folder: Path
    experiment: Experiment
    pairs: tuple[tuple[Trial, Track], ...]
    trials: tuple[ExplorerTrial, ...]
    left_out: Mapping[str, str]
    highest_m: Mapping[str, float]
    stored: FitSummary
    effects: Mapping[str, Effect]
    unusable: Mapping[str, str]
    in_use: tuple[str, ...]

    @cached_property
    def examples(self) -> Mapping[str, Trial]:
        """The first trial of each condition, ordered by vine (as in the sheet), payload and pressure."""
        first = {aligned.condition: aligned.data.trial for aligned in reversed(self.trials)}
        rank = {name: (self.vines.index(t.vine), t.payload_kg, t.pressure_Pa) for name, t in first.items()}
        return {name: first[name] for name in sorted(first, key=lambda name: rank[name])}

    @cached_property
    def conditions(self) -> tuple[str, ...]:
        """Conditions in the same order."""
        return tuple(self.examples)

    @cached_property
    def vines(self) -> tuple[str, ...]:
        """Vines in the order of the sheet."""
        return self.groups("vine")

    def groups(self, shared: str) -> tuple[str, ...]:
        """Return the groups of trials with a parameter value of their own, in the order of the sheet."""
        return tuple(group_names([aligned.data.trial for aligned in self.trials], shared))

    @cached_property
    def labels(self) -> Mapping[str, str]:
        """The label of every condition in the figures."""
        return condition_labels(self.examples)

    @cached_property
    def host(self) -> Model:
        """One model with all effects, as in a diagnosis: its compiled form serves every model that can be chosen."""
        return host_for(Model(()), self.effects.values())

    def indices_of_condition(self, condition: str) -> list[int]:
        """Return the indices of the trials of a condition in `trials`."""
        return [i for i, aligned in enumerate(self.trials) if aligned.condition == condition]

    def trial(self, name: str) -> ExplorerTrial:
        """Return the trial of that name; KeyError if there is none."""
        return {aligned.name: aligned for aligned in self.trials}[name]


def open_campaign(folder: Path, moved_to: Path | None = None) -> Campaign:
    """Open a results folder and its experiment, which may have moved."""
    results, experiment = layout.Results(folder), layout.read_source_experiment(folder, moved_to)
    pairs = layout.measured_trials(experiment, results)
    data, left_out = prepare(pairs, weighted=False)
    if not data:
        raise layout.ResultsError(f"{folder} has no trial to explore: {reasons_told(left_out) or 'every trial failed'}")
    stored = layout.read_fit(results)
    highest_m: dict[str, float] = {}
    if not stored.refused:
        table = layout.read_result(results.comparison).astype({"condition": str, "expected_high_m": float})
        highest_m = dict(zip(table["condition"], table["expected_high_m"], strict=True))
    compared = {name: layout.read_result(results.trajectories(name)) for name in highest_m}
    effects, unusable = {**catalogue(), **experiment.user_effects}, {}
    for effect in effects.values():
        try:
            check_needs(Model((effect,)), *(trial_data.trial for trial_data in data))
        except EffectError:
            unusable[effect.name] = f"needs {' and '.join(effect.needs)} in the sheet"
    return Campaign(
        folder=folder,
        experiment=experiment,
        pairs=tuple(pairs),
        trials=tuple(_align_trials(data, compared)),
        left_out={**experiment.failed, **experiment.left_out, **left_out},
        highest_m=highest_m,
        stored=stored,
        effects=effects,
        in_use=stored.names if stored.names and set(stored.names) <= set(effects) else tuple(experiment.settings.model),
        unusable=unusable,
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


# ------------------------------------------------------------------------------
# What a model with given sizes predicts, with the errors that `vinetrack compare` would give it: as there, each trial
# has its own release and origin, found anew for every model.


@dataclass(frozen=True)
class Prediction:
    """A model's prediction of every trial of a campaign, and the rms error of position by condition and in all, m."""

    trials: tuple[TrialFit, ...]
    errors_m: Mapping[str, float]
    rms_m: float


def predict_choice(campaign: Campaign, choice: ModelChoice) -> Prediction:
    """Predict every trial by a choice."""
    data = []
    for aligned in campaign.trials:
        trial = aligned.data.trial
        yield_Pa = trial.yield_pressure_Pa
        # Fitted by vine, and by stated value if a vine has several
        for group in (trial.vine, trial.yield_group):
            yield_Pa = choice.numbers.get(f"{YIELD_PRESSURE}[{group}]", yield_Pa)
        data.append(replace(aligned.data, trial=replace(trial, yield_pressure_Pa=yield_Pa)))
    *_, predicted = predict_by_model(sized_model(campaign, choice), data, campaign.host, 0.0, 1.0, from_rest=True)
    members = {name: [predicted[i] for i in campaign.indices_of_condition(name)] for name in campaign.conditions}
    errors_m = {name: rms_of(trials) for name, trials in members.items()}
    return Prediction(tuple(predicted), errors_m, rms_of(predicted))


# ------------------------------------------------------------------------------
# The user's choice: the effects in the model and their sizes. Immutable; a change returns a new choice.


@dataclass(frozen=True)
class SizeControl:
    """One parameter of an effect with a slider; `vine` is blank if one value applies to all trials."""

    effect: str
    parameter: Parameter
    vine: str
    pressure_unit: str = "kPa"

    @property
    def key(self) -> str:
        """`effect.parameter`."""
        return f"{self.effect}.{self.parameter.name}"

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets if each has its own value."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key


@dataclass(frozen=True)
class ModelChoice:
    """Effects in the model, in the order they were added, and the value of every parameter, in the model or not.
    `numbers` also holds the fitted yield pressures by vine, which have no slider.
    """

    effects: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=dict)

    def with_effect(self, effect: str, wanted: bool = True) -> ModelChoice:
        """Return the choice with an effect added (at the end) or removed; its sizes are kept for when it returns."""
        if wanted == (effect in self.effects):
            return self
        kept = tuple(name for name in self.effects if name != effect)
        return replace(self, effects=(*kept, effect) if wanted else kept)

    def with_sizes(self, numbers: Mapping[str, float]) -> ModelChoice:
        """Return the same effects with these values of parameters."""
        return replace(self, numbers={**self.numbers, **numbers})


def choice_in_use(campaign: Campaign) -> ModelChoice:
    """Return the model in use with its fitted values, and all other parameters at their defaults."""
    sizes = [size for effect in campaign.effects.values() for size in sizes_of(campaign, effect)]
    numbers = {number.name: number.value for number in campaign.stored.numbers}
    return ModelChoice(campaign.in_use, {size.name: size.parameter.default for size in sizes} | numbers)


def sizes_of(campaign: Campaign, effect: Effect) -> list[SizeControl]:
    """Return the sliders of an effect: one per parameter, or one per vine or day if each has its own value."""
    pressure_unit = campaign.trials[0].data.trial.pressure_unit
    return [
        SizeControl(effect.name, parameter, vine, pressure_unit)
        for parameter in effect.parameters
        for vine in campaign.groups(parameter.shared)
    ]


def slider_range(key: str, parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the range of a slider: the plausible range, extended to the size without effect and the present value.

    >>> slider_range("x.k", Parameter("k", "k", "1", 1.0, bounds=(0.0, 9.0), plausible=(0.0, 3.0)), 5.0)
    (0.0, 6.25)
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
    sizes = [size for effect in effects for size in sizes_of(campaign, effect)]
    return Model(effects, values_by_key((size.key, size.vine, choice.numbers[size.name]) for size in sizes))


# ------------------------------------------------------------------------------
# Fits of the explorer in background threads: the model in use, once for all open pages, and the chosen models.

log = logging.getLogger(__name__)


class Cancelled(Exception):  # noqa: N818 - nothing went wrong
    """The work of a job was cancelled."""


@dataclass(frozen=True)
class Evaluated:
    """A fit, the choice with its sizes, and what that predicts."""

    choice: ModelChoice
    prediction: Prediction
    fit: Fit

    @property
    def numbers(self) -> dict[str, Number]:
        """The fitted numbers by name."""
        return {number.name: number for number in self.fit.numbers}


@in_one_blas_thread
def fit_choice(campaign: Campaign, before: Fit, choice: ModelChoice, watch: Watch | None = None) -> Evaluated:
    """Fit the chosen model, starting from an earlier fit, with the chosen sizes of new effects. If the result is worse
    than without the new effects, or has not converged, it is refitted from their defaults.
    """
    sized = sized_model(campaign, choice)
    model = replace(sized, values={})
    new = [effect for effect in model if effect.name not in before.model]
    chosen = {key: value for effect in new for key, value in sized.values.items() if key.startswith(f"{effect.name}.")}
    result = refit(before, model, start=chosen, watch=watch)
    is_larger = set(before.model.names) <= set(model.names)
    is_worse = is_larger and result.log_likelihood < before.log_likelihood - 0.5  # of ln L (chosen)
    if new and (is_worse or not result.converged):
        defaults: dict[str, Value] = {f"{e.name}.{p.name}": p.default for e in new for p in e.parameters}
        other = refit(before, model, start=defaults, watch=watch)
        result = max((result, other), key=lambda result: result.log_likelihood)
    return _evaluated(campaign, choice, result)


def _evaluated(campaign: Campaign, choice: ModelChoice, fitted: Fit) -> Evaluated:
    choice = choice.with_sizes({number.name: number.value for number in fitted.numbers})
    return Evaluated(choice, predict_choice(campaign, choice), fitted)


Progress = TypeVar("Progress")
Outcome = TypeVar("Outcome")


class Job(Generic[Progress, Outcome]):
    """Work in a thread: `on_progress` gets its steps, `on_end` its outcome, or None and the reason, through `soon`."""

    def __init__(
        self,
        work: Callable[[Callable[[Progress], None]], Outcome],
        on_progress: Callable[[Progress], None],
        on_end: Callable[[Outcome | None, str], None],
        soon: Callable[[Callable[[], None]], object] = lambda call: call(),
    ) -> None:
        self._cancelled = threading.Event()

        def watch(step: Progress) -> None:
            if self._cancelled.is_set():
                raise Cancelled
            on_progress(step)

        def run() -> None:
            outcome, reason = None, ""
            try:
                outcome = work(watch)
            except Cancelled:
                return
            except UserError as error:
                reason = str(error)
            except Exception:
                log.exception("a job of the explorer")
                reason = (
                    "A fault of the program, not of your data: --log FILE of vinetrack explore keeps the traceback."
                )
            # It may be cancelled while it waits to be called.
            soon(lambda: None if self._cancelled.is_set() else on_end(outcome, reason))

        self._thread = threading.Thread(target=run, daemon=True, name=f"{THREAD_PREFIX}job")
        self._thread.start()

    def cancel(self) -> None:
        """End it at its next step; no callback is called any more."""
        self._cancelled.set()

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until it has ended."""
        self._thread.join(timeout_s)


class BackgroundFit:
    """Computes in a thread the `prediction` of the model in use, then its fit, or `failure`; tells its listeners."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.initial = choice_in_use(campaign)
        self.prediction: Prediction | None = None
        self.fitted: Evaluated | None = None
        self.step: Step | None = None
        self.failure = ""
        self.listeners: list[Callable[[], None]] = []
        self._job: Job[Step, Evaluated] | None = None

    def begin(self) -> BackgroundFit:
        """Start the thread."""
        self._job = Job(self._work, self._on_step, self._on_end)
        return self

    def wait(self) -> Evaluated:
        """Wait for the fit and return it; a UserError with the reason if there is none."""
        if self._job is not None:
            self._job.wait()
        if self.fitted is None:
            raise UserError(self.failure)
        return self.fitted

    @property
    def running(self) -> bool:
        """Whether the fit is awaited."""
        return self._job is not None and self.fitted is None and not self.failure

    def _work(self, watch: Watch) -> Evaluated:
        """Predict, then fit the model in use as the model stage of the workflow does."""
        campaign, initial = self.campaign, self.initial
        self.prediction = predict_choice(campaign, initial)
        self._notify()
        model = replace(sized_model(campaign, initial), values={})
        # A falling body has no other parameter.
        free = ("gravity.g",) if model.names == ("gravity",) else ()
        return _evaluated(campaign, initial, fit(model, campaign.pairs, free=free, host=campaign.host, watch=watch))

    def _on_step(self, step: Step) -> None:
        self.step = step
        self._notify()

    def _on_end(self, fitted: Evaluated | None, reason: str) -> None:
        self.fitted, self.failure = fitted, reason
        self._notify()

    def _notify(self) -> None:
        for listener in list(self.listeners):
            listener()


def model_text(names: Sequence[str]) -> str:
    """Return a model as text, with one name for the base effects together."""
    others = [spaced_name(name) for name in names if name not in BASE_EFFECTS]
    missing_base = [name for name in BASE_EFFECTS if name not in names]
    base = "base model" if not missing_base else " + ".join(name for name in names if name in BASE_EFFECTS)
    return " + ".join([base, *others])
