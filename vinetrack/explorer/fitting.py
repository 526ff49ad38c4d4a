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
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from vinetrack.core.local_page import THREAD_PREFIX
from vinetrack.core.problems import UserError
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.diagnosis.ladder import compare
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import BASE_EFFECTS, EffectError
from vinetrack.explorer.campaign import (
    Campaign,
    ChoiceError,
    Curves,
    ModelChoice,
    added_and_dropped,
    choice_in_use,
    errors_m,
    simulate_curves,
    sized_model,
    sizes_of,
)
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import CONVERGED_DECREASE, Step, Watch

if TYPE_CHECKING:
    import pandas as pd


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
    """A fit, the choice with its estimates, its curves and errors; `floors_m` is the replicate scatter."""

    choice: ModelChoice
    fit: Fit
    curves: Curves
    errors_m: Mapping[str, float]
    floors_m: Mapping[str, float]
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
    """Compare a fit with the measurement, as `vinetrack compare` does."""
    fitted_choice = with_numbers(choice, {number.name: number.value for number in result.numbers})
    curves = simulate_curves(campaign, sized_model(campaign, fitted_choice))
    table = compare(result, campaign.pairs, kinematics=campaign.kinematics).table
    floors = dict(zip(table["condition"].astype(str), table["replicate_floor_m"].astype(float), strict=True))
    return Fitted(fitted_choice, result, curves, errors_m(campaign, curves), floors, seconds)


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
    """Computes in a thread `curves` and `errors_m` of the model in use, then its fit. `failure` is the reason if it
    failed, else blank. Listeners are called from that thread.
    """

    def __init__(self, campaign: Campaign, choice: ModelChoice | None = None) -> None:
        self.campaign = campaign
        self.initial = choice_in_use(campaign)
        self.opening_choice = self.initial if choice in (None, self.initial) else choice
        self.curves: Curves | None = None
        self.errors_m: dict[str, float] = {}
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
            self.curves = simulate_curves(self.campaign, sized_model(self.campaign, self.initial))
            self.errors_m = errors_m(self.campaign, self.curves)
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


# ------------------------------------------------------------------------------
# Exports of the page: the curves as CSV, the figure as SVG or PNG, the choice as a command.

PICTURES = ("svg", "png", "pdf")
FORMATS = ("csv", *PICTURES)
CURVE_COLUMNS = (
    "model",
    "condition",
    "trial",
    "time_s",
    "lead_position_m",
    "model_position_m",
    "residual_m",
    "replicates_mean_m",
    "replicates_sigma_m",
)


def curve_table(campaign: Campaign, choice: ModelChoice, curves: Curves, shown: Sequence[int]) -> pd.DataFrame:
    """Return measurement and model at every frame used, since release and from the origin."""
    import pandas as pd

    parts = []
    for i in shown:
        aligned, motion = campaign.trials[i], curves[i]
        band = campaign.bands.get(aligned.condition)
        unknown = np.full(aligned.time_s.size, math.nan)
        mean_m = unknown if band is None else np.interp(aligned.time_s, band.time_s, band.mean_m)
        sigma_m = unknown if band is None else np.interp(aligned.time_s, band.time_s, band.sigma_m)
        columns = ("+".join(choice.effects), aligned.condition, aligned.name, aligned.time_s, aligned.growth_m)
        model_columns = (motion.growth_m, motion.residual_m, mean_m, sigma_m)
        parts.append(pd.DataFrame(dict(zip(CURVE_COLUMNS, (*columns, *model_columns), strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def export_bytes(campaign: Campaign, choice: ModelChoice, curves: Curves, shown: Sequence[int], form: str) -> bytes:
    """Return the curves as `csv`, or the figure of the report as `svg`, `png` or `pdf`."""
    if form not in FORMATS:
        raise ChoiceError(f"{form!r} is no export format: use one of {', '.join(FORMATS)}.")
    table = curve_table(campaign, choice, curves, shown)
    if form == "csv":
        return table.to_csv(index=False, lineterminator="\n").encode("utf-8")
    from vinetrack.figures.motion_figures import draw_model_comparison
    from vinetrack.figures.style import render

    conditions = [name for name in campaign.conditions if name in set(table["condition"])]
    compared = _compared(campaign, choice, errors_m(campaign, curves), conditions)
    trajectories = {str(name): part.reset_index(drop=True) for name, part in table.groupby("condition", sort=False)}
    return render(draw_model_comparison(compared, trajectories), [form])[form]


def _compared(
    campaign: Campaign, choice: ModelChoice, errors: Mapping[str, float], conditions: Sequence[str]
) -> pd.DataFrame:
    import pandas as pd

    floors = [campaign.floors_m.get(name, math.nan) for name in conditions]
    rms = [errors[name] for name in conditions]
    return pd.DataFrame(
        {
            "model": "+".join(choice.effects),
            "condition": conditions,
            "condition_label": [campaign.labels[name] for name in conditions],
            "vine": [campaign.trials[campaign.indices_of_condition(name)[0]].data.trial.vine for name in conditions],
            "rms_position_m": rms,
            "ratio": [r / f if f > 0 else math.nan for r, f in zip(rms, floors, strict=True)],
        }
    )


def write_export(campaign: Campaign, choice: ModelChoice, curves: Curves, path: Path) -> None:
    """Write all trials to a file, atomically; its suffix gives the format."""
    from vinetrack.core.tables import write_bytes

    form = path.suffix.lower().removeprefix(".")
    write_bytes(path, export_bytes(campaign, choice, curves, range(len(campaign.trials)), form))


def commands(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, *, fitted: bool, save: bool = False
) -> list[str]:
    """Return the commands that reproduce the choice without the page."""
    folder = shlex.quote(campaign.folder.as_posix())
    added, dropped = added_and_dropped(campaign, choice)
    if not added and not dropped and (fitted or not _changed_sizes(campaign, start, choice)):
        return [f"vinetrack compare {folder}"]
    if fitted and not dropped:
        end = " --save" if save else ""
        return [f"vinetrack add {_command_line_name(campaign, name)} {folder}{end}" for name in added]
    options = [f"--add {name}" for name in added] + [f"--drop {name}" for name in dropped]
    if fitted or save:
        options += ["--refit"] if fitted else []
        return [" ".join(["vinetrack explore", folder, *options, *(["--save"] if save else [])])]
    options += [
        f"--set {shlex.quote(f'{name}={value:.6g}')}" for name, value in _changed_sizes(campaign, start, choice).items()
    ]
    return [" ".join(["vinetrack explore", folder, *options])]


def _command_line_name(campaign: Campaign, effect: str) -> str:
    """Name of an effect on the command line: its file, if the settings do not list that yet."""
    path = campaign.effects[effect].path
    is_unlisted = campaign.own_files([effect]) and path.name not in campaign.experiment.settings.effects
    return shlex.quote(path.as_posix()) if is_unlisted else effect


def _changed_sizes(campaign: Campaign, start: ModelChoice, choice: ModelChoice) -> dict[str, float]:
    """Sizes of effects in the model that differ from those with which the page opened, by name."""
    names = [
        size.name for effect in choice.effects for size in sizes_of(campaign, campaign.effects[effect], choice.numbers)
    ]
    return {name: choice.numbers[name] for name in names if choice.numbers[name] != start.numbers.get(name)}


def model_text(names: Sequence[str]) -> str:
    """Return a model as text, with one name for the base effects together."""
    others = [name.replace("_", " ") for name in names if name not in BASE_EFFECTS]
    missing_base = [name for name in BASE_EFFECTS if name not in names]
    base = "base model" if not missing_base else " + ".join(name for name in names if name in BASE_EFFECTS)
    return " + ".join([base, *others])
