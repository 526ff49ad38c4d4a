"""Fits of the explorer, in threads: the model in use, fitted once for all open pages, and the chosen models."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

from vinetrack.core.local_page import THREAD_PREFIX
from vinetrack.core.problems import UserError
from vinetrack.diagnosis.compare import compare
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import ModelChoice, first_choice, sized
from vinetrack.explorer.curves import Curves, errors_m, follow
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import CONVERGED_DECREASE, Step, Watch

log = logging.getLogger(__name__)

FAULT = "A fault of the program, not of your data: run vinetrack explore with --log FILE to have the traceback."
STRONG_CORRELATION = 0.9
"""Chosen: two numbers of this correlation have errors 1/√(1 − 0.9²) = 2.3 times those with the other one known."""

CLEARLY_WORSE = 0.5
"""Chosen: a fall of ln L by 0.5 is the limit of one standard error; two fits within it agree."""


class GivenUp(Exception):  # noqa: N818 - nothing went wrong
    """The fit is no longer wanted."""


@dataclass(frozen=True)
class Fitted:
    """A fit, the choice at its numbers, and what follows from them. `floors_m` are those of its own comparison."""

    choice: ModelChoice
    fit: Fit
    curves: Curves
    errors_m: Mapping[str, float]
    floors_m: Mapping[str, float]
    seconds: float

    def number(self, name: str) -> Number | None:
        """The fitted number of that name, None where it was not fitted.

        Parameters
        ----------
        name : `effect.parameter`, with `[vine]` where each vine has its own.

        Returns
        -------
        Number or None
        """
        return next((number for number in self.fit.numbers if number.name == name), None)


def first_fit(campaign: Campaign, choice: ModelChoice, watch: Watch | None = None) -> Fitted:
    """Fit the model in use, as the stage of the workflow does.

    Its likelihood is known from `fit.json`; where the first start reaches it, no others are tried.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : the model in use.
    watch : called after every step.

    Returns
    -------
    Fitted

    Raises
    ------
    FitError, EffectError, SimulationError
        If it cannot be fitted.
    """
    begun = time.perf_counter()
    model = sized(campaign, choice).model
    # A falling body has no other parameter.
    free = ("gravity.g",) if model.names == ("gravity",) else ()
    bare = replace(model, values={})
    begin = partial(fit, bare, campaign.pairs, free=free, host=campaign.host, watch=watch, profile=False)
    result = begin(thorough=False)
    if not result.log_likelihood > campaign.log_likelihood - CLEARLY_WORSE:
        result = begin()
    return _weighed(campaign, choice, result, time.perf_counter() - begun)


def fit_choice(campaign: Campaign, before: Fit, choice: ModelChoice, watch: Watch | None = None) -> Fitted:
    """Fit what was chosen, from where a fit ended and the sizes that were chosen for what is new.

    Where that ends worse than without the new effects, or does not settle, it is tried once more from their defaults.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    before : the fit to start from.
    choice : effects and sizes.
    watch : called after every step.

    Returns
    -------
    Fitted

    Raises
    ------
    FitError, EffectError, SimulationError
        If it cannot be fitted.
    """
    begun = time.perf_counter()
    model = replace(sized(campaign, choice).model, values={})
    new = [effect for effect in model if effect.name not in before.model]
    values = sized(campaign, choice).model.values
    begin = {key: value for effect in new for key, value in values.items() if key.startswith(f"{effect.name}.")}
    result = refit(before, model, start=begin, watch=watch)
    grew = set(before.model.names) <= set(model.names)
    worse = grew and result.log_likelihood < before.log_likelihood - CLEARLY_WORSE
    if new and (worse or not result.converged):
        again: dict[str, Value] = {f"{e.name}.{p.name}": p.default for e in new for p in e.parameters}
        other = refit(before, model, start=again, watch=watch)
        result = max((result, other), key=lambda result: result.log_likelihood)
    return _weighed(campaign, choice, result, time.perf_counter() - begun)


def _weighed(campaign: Campaign, choice: ModelChoice, result: Fit, seconds: float) -> Fitted:
    """The fit compared with the measurement, as `vinetrack compare` does."""
    settled = at_numbers(choice, {number.name: number.value for number in result.numbers})
    curves = follow(campaign, sized(campaign, settled))
    table = compare(result, campaign.pairs, kinematics=campaign.kinematics).table
    floors = dict(zip(table["condition"].astype(str), table["replicate_floor_m"].astype(float), strict=True))
    return Fitted(settled, result, curves, errors_m(campaign, curves), floors, seconds)


def at_numbers(choice: ModelChoice, numbers: Mapping[str, float]) -> ModelChoice:
    """The same effects at these sizes.

    Parameters
    ----------
    choice : effects and sizes.
    numbers : SI, by name.

    Returns
    -------
    Choice
    """
    return replace(choice, numbers={**choice.numbers, **numbers})


def gained_words(before: Fit, after: Fit) -> str:
    """Return how −2 ln L changed with a larger or smaller model, as a sentence.

    Parameters
    ----------
    before, after : fits of two models to the same trials.

    Returns
    -------
    str
    """
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    more = len(after.numbers) - len(before.numbers)
    numbers = f"{abs(more)} number{'' if abs(more) == 1 else 's'} {'more' if more > 0 else 'fewer'}"
    if more == 0:
        return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} with as many numbers."
    return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} for {numbers}."


def tied_words(result: Fit) -> list[str]:
    """Return the pairs of fitted numbers with strongly correlated errors, largest correlation first, as text.

    Parameters
    ----------
    result : a fit with its covariance.

    Returns
    -------
    list of str
    """
    pairs = []
    for i, number in enumerate(result.numbers):
        for k in range(i):
            scale = math.sqrt(float(result.covariance[i, i] * result.covariance[k, k]))
            r = float(result.covariance[i, k]) / scale if scale > 0 and math.isfinite(scale) else 0.0
            if abs(r) > STRONG_CORRELATION:
                pairs.append((abs(r), f"{result.numbers[k].title} and {number.title}: correlation {r:+.2f}"))
    return [words for _, words in sorted(pairs, reverse=True)]


Told = TypeVar("Told")
Outcome = TypeVar("Outcome")


class FitJob(Generic[Told, Outcome]):
    """One fit, or a search made of fits, in a thread; `told`, `done` and `failed` are called from that thread."""

    def __init__(
        self,
        work: Callable[[Callable[[Told], None]], Outcome],
        *,
        told: Callable[[Told], None],
        done: Callable[[Outcome], None],
        failed: Callable[[str], None],
    ) -> None:
        self._work, self._told, self._done, self._failed = work, told, done, failed
        self._unwanted = threading.Event()
        self.begun = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"{THREAD_PREFIX}fit")
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it goes on, wanted."""
        return self._thread.is_alive() and not self._unwanted.is_set()

    def give_up(self) -> None:
        """Let it end at its next step; nothing more is heard of it."""
        self._unwanted.set()

    def wait(self, timeout_s: float | None = None) -> None:
        """Until it has ended.

        Parameters
        ----------
        timeout_s : None for no limit.
        """
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            result = self._work(self._watch)
        except GivenUp:
            return
        except UserError as error:
            self._say(self._failed, str(error))
        except Exception:
            log.exception("a fit of the explorer")
            self._say(self._failed, FAULT)
        else:
            if not self._unwanted.is_set():
                self._done(result)

    def _say(self, whom: Callable[[str], None], words: str) -> None:
        if not self._unwanted.is_set():
            whom(words)

    def _watch(self, step: Told) -> None:
        if self._unwanted.is_set():
            raise GivenUp
        self._told(step)


log = logging.getLogger(__name__)


class BackgroundFit:
    """Grows in the background, in this order: `curves` and `errors_m` of the model in use, then its fit.

    `trouble` says why it got no further, blank where it did. Listeners are called from the background's thread.
    """

    def __init__(self, campaign: Campaign, choice: ModelChoice | None = None) -> None:
        self.campaign = campaign
        self.start = first_choice(campaign)
        self.opening = self.start if choice in (None, self.start) else choice
        self.curves: Curves | None = None
        self.errors_m: dict[str, float] = {}
        self.fitted: Fitted | None = None
        self.step: Step | None = None
        self.trouble = ""
        self._listeners: list[Callable[[], None]] = []
        self._thread = threading.Thread(target=self._grow, daemon=True, name=f"{THREAD_PREFIX}ground")

    def begin(self) -> BackgroundFit:
        """Start growing."""
        self._thread.start()
        return self

    def wait(self, timeout_s: float | None = None) -> None:
        """Until all is there, or something went wrong.

        Parameters
        ----------
        timeout_s : None for no limit.
        """
        self._thread.join(timeout_s)

    def listen(self, heard: Callable[[], None]) -> None:
        """Have `heard` called whenever something new is there.

        Parameters
        ----------
        heard : takes no argument.
        """
        self._listeners.append(heard)

    def forget(self, heard: Callable[[], None]) -> None:
        """Call it no more.

        Parameters
        ----------
        heard : as given to `listen`.
        """
        if heard in self._listeners:
            self._listeners.remove(heard)

    @property
    def growing(self) -> bool:
        """Whether more is to come."""
        return self._thread.is_alive()

    def _grow(self) -> None:
        try:
            self.curves = follow(self.campaign, sized(self.campaign, self.start))
            self.errors_m = errors_m(self.campaign, self.curves)
            self._tell()
            self.fitted = first_fit(self.campaign, self.start, self._stepped)
        except (FitError, EffectError, SimulationError) as error:
            self.trouble = str(error)
        except Exception:
            log.exception("the model in use")
            self.trouble = FAULT
        self._tell()

    def _stepped(self, step: Step) -> None:
        self.step = step
        self._tell()

    def _tell(self) -> None:
        for heard in list(self._listeners):
            heard()


_LEAST_SHARE = 0.04
"""Of the bar at the begin; chosen: visible at a width of 200 pixels."""


class FitProgress:
    """How far a fit is, as a fraction and in words; `words` is the message where no fit runs.

    The number of steps is unknown: progress is measured by the logarithm of the decrease that the next step promises,
    from its largest value down to `CONVERGED_DECREASE`, where a fit stops.
    """

    def __init__(self) -> None:
        self.words = ""
        self._begun = 0.0
        self._largest = 0.0
        self._share = _LEAST_SHARE
        self._step: Step | None = None

    def begin(self, now: float) -> None:
        """A fit is wanted.

        Parameters
        ----------
        now : monotonic clock, s.
        """
        self._begun, self._largest, self._share, self._step, self.words = now, 0.0, _LEAST_SHARE, None, ""

    def reach(self, step: Step) -> None:
        """It has come so far.

        Parameters
        ----------
        step : the last one of the fit.
        """
        self._step = step
        if math.isfinite(step.predicted_decrease) and step.predicted_decrease > 0:
            self._largest = max(self._largest, step.predicted_decrease)
            whole = math.log10(max(self._largest, 10 * CONVERGED_DECREASE) / CONVERGED_DECREASE)
            done = math.log10(
                max(self._largest, step.predicted_decrease) / max(step.predicted_decrease, CONVERGED_DECREASE)
            )
            self._share = max(self._share, min(done / whole, 0.97))

    def state(self, now: float, about: str, other: Step | None = None) -> tuple[float, str]:
        """Share done and words; `other` is the step of what has to be done first.

        Parameters
        ----------
        now : monotonic clock, s.
        about : what is fitted.
        other : the step of what has to be done first; None where nothing has.

        Returns
        -------
        share : float, 0 to 1
        text : str
        """
        step = other or self._step
        where = f" · step {step.iteration}" if step is not None else ""
        promise = ""
        if step is not None and math.isfinite(step.predicted_decrease):
            promise = (
                f" · the next lowers −2 ln L by {step.predicted_decrease:,.2g}"
                if step.predicted_decrease < 1e4
                else " · still far off"
            )
        return self._share, f"{about}{where}{promise} · {now - self._begun:.1f} s"

    def end(self, words: str) -> None:
        """The fit has ended; `words` state why, blank where it succeeded.

        Parameters
        ----------
        words : blank where the fit succeeded.
        """
        self.words = words

    def say(self, words: str) -> None:
        """State something that is no end.

        Parameters
        ----------
        words : the message.
        """
        self.words = words
