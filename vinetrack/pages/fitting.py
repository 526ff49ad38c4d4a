"""Fits of the explorer in background threads: the model in use, once for all open pages, and the chosen models."""

from __future__ import annotations

import logging
import math
import shlex
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

from vinetrack.core.local_page import THREAD_PREFIX
from vinetrack.core.problems import UserError
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import BASE_EFFECTS, EffectError
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import CONVERGED_DECREASE, Step, Watch
from vinetrack.pages.campaign import (
    Campaign,
    ModelChoice,
    Prediction,
    choice_in_use,
    predict_choice,
    predict_fit,
    sized_model,
)

log = logging.getLogger(__name__)

FAULT = "A fault of the program, not of your data: run vinetrack explore with --log FILE for the traceback."
# Chosen: with this correlation each standard error is 1/√(1 − 0.9²) = 2.3 times its value with the other parameter
# known
STRONG_CORRELATION = 0.9

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
    model = sized_model(campaign, choice).model
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
    model = replace(sized_model(campaign, choice).model, values={})
    new = [effect for effect in model if effect.name not in before.model]
    values = sized_model(campaign, choice).model.values
    chosen = {key: value for effect in new for key, value in values.items() if key.startswith(f"{effect.name}.")}
    result = refit(before, model, start=chosen, watch=watch)
    is_larger = set(before.model.names) <= set(model.names)
    is_worse = is_larger and result.log_likelihood < before.log_likelihood - CLEARLY_WORSE
    if new and (is_worse or not result.converged):
        defaults: dict[str, Value] = {f"{e.name}.{p.name}": p.default for e in new for p in e.parameters}
        other = refit(before, model, start=defaults, watch=watch)
        result = max((result, other), key=lambda result: result.log_likelihood)
    return _evaluated(campaign, choice, result, time.perf_counter() - started)


def _evaluated(campaign: Campaign, choice: ModelChoice, result: Fit, seconds: float) -> Fitted:
    fitted_choice = with_numbers(choice, {number.name: number.value for number in result.numbers})
    return Fitted(fitted_choice, result, predict_fit(campaign, result), seconds)


def with_numbers(choice: ModelChoice, numbers: Mapping[str, float]) -> ModelChoice:
    """Return the same effects with these sizes."""
    return replace(choice, numbers={**choice.numbers, **numbers})


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
    pairs = []
    for i, number in enumerate(result.numbers):
        for k in range(i):
            scale = math.sqrt(float(result.covariance[i, i] * result.covariance[k, k]))
            r = float(result.covariance[i, k]) / scale if scale > 0 and math.isfinite(scale) else 0.0
            if abs(r) > STRONG_CORRELATION:
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
        self.started = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"{THREAD_PREFIX}fit")
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it is running and was not cancelled."""
        return self._thread.is_alive() and not self._cancelled.is_set()

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
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"{THREAD_PREFIX}background")

    def begin(self) -> BackgroundFit:
        """Start the thread."""
        self._thread.start()
        return self

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until it has finished or failed."""
        self._thread.join(timeout_s)

    def add_listener(self, listener: Callable[[], None]) -> None:
        """Call `listener` whenever there is a new result or step."""
        self._listeners.append(listener)

    def remove_listener(self, listener: Callable[[], None]) -> None:
        """Remove a listener."""
        if listener in self._listeners:
            self._listeners.remove(listener)

    @property
    def running(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def _run(self) -> None:
        try:
            self.prediction = predict_choice(self.campaign, self.initial)
            self._notify()
            self.fitted = first_fit(self.campaign, self.initial, self._on_step)
        except (FitError, EffectError, SimulationError) as error:
            self.failure = str(error)
        except Exception:
            log.exception("the model in use")
            self.failure = FAULT
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
    largest value down to `CONVERGED_DECREASE`, where a fit stops.
    """

    def __init__(self) -> None:
        self.message = ""
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
        step = other or self._step
        where = f" · step {step.iteration}" if step is not None else ""
        promise = ""
        if step is not None and math.isfinite(step.predicted_decrease):
            promise = (
                f" · the next step lowers −2 ln L by {step.predicted_decrease:,.2g}"
                if step.predicted_decrease < 1e4
                else " · still far off"
            )
        return self._fraction, f"{task}{where}{promise} · {now - self._started:.1f} s"

    def end(self, message: str) -> None:
        """Show why a fit ended."""
        self.message = message

    def set_message(self, message: str) -> None:
        """Show a message without ending the fit."""
        self.message = message


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
