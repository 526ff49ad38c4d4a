"""Fits that a page asks for: in a thread, told of step by step, given up when something else is wanted."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from vinetrack.diagnosis.compare import compare
from vinetrack.dynamics.model import Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import Choice, sized
from vinetrack.explorer.curves import Curves, errors_m, follow
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import Step, Watch

log = logging.getLogger(__name__)

FAULT = "A fault of the program, not of your data: run vinetrack explore with --log FILE to have the traceback."
STRONGLY_TIED = 0.9
CLEARLY_WORSE = 0.5


class GivenUp(Exception):  # noqa: N818 - nothing went wrong
    """The fit is no longer wanted."""


@dataclass(frozen=True)
class Fitted:
    """A fit, the choice at its numbers, and what follows from them. `floors_m` are those of its own comparison."""

    choice: Choice
    fit: Fit
    curves: Curves
    errors_m: Mapping[str, float]
    floors_m: Mapping[str, float]
    seconds: float

    def number(self, name: str) -> Number | None:
        """The fitted number of that name, None where it was not fitted."""
        return next((number for number in self.fit.numbers if number.name == name), None)


def first_fit(campaign: Campaign, choice: Choice, watch: Watch | None = None) -> Fitted:
    """Fit the model in use, as the stage of the workflow does.

    What that found is known, and where the first start leads there, others need not be tried.

    Raises
    ------
    FitError, EffectError, SimulationError
        If it cannot be fitted.
    """
    begun = time.perf_counter()
    model = sized(campaign, choice).model
    # A falling body has nothing else to find.
    free = ("gravity.g",) if model.names == ("gravity",) else ()
    bare = replace(model, values={})
    begin = partial(fit, bare, campaign.pairs, free=free, host=campaign.host, watch=watch, profile=False)
    found = begin(thorough=False)
    if not found.log_likelihood > campaign.log_likelihood - CLEARLY_WORSE:
        found = begin()
    return _weighed(campaign, choice, found, time.perf_counter() - begun)


def fit_choice(campaign: Campaign, before: Fit, choice: Choice, watch: Watch | None = None) -> Fitted:
    """Fit what was chosen, from where a fit ended and the sizes that were chosen for what is new.

    Where that ends worse than without the new effects, or does not settle, it is tried once more from their defaults.

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
    found = refit(before, model, start=begin, watch=watch)
    grew = set(before.model.names) <= set(model.names)
    worse = grew and found.log_likelihood < before.log_likelihood - CLEARLY_WORSE
    if new and (worse or not found.converged):
        again: dict[str, Value] = {f"{e.name}.{p.name}": p.default for e in new for p in e.parameters}
        other = refit(before, model, start=again, watch=watch)
        found = max((found, other), key=lambda one: one.log_likelihood)
    return _weighed(campaign, choice, found, time.perf_counter() - begun)


def _weighed(campaign: Campaign, choice: Choice, found: Fit, seconds: float) -> Fitted:
    """The fit held against the measurement, as `vinetrack compare` does."""
    settled = at_numbers(choice, {number.name: number.value for number in found.numbers})
    curves = follow(campaign, sized(campaign, settled))
    table = compare(found, campaign.pairs, kinematics=campaign.kinematics).table
    floors = dict(zip(table["condition"].astype(str), table["replicate_floor_m"].astype(float), strict=True))
    return Fitted(settled, found, curves, errors_m(campaign, curves), floors, seconds)


def at_numbers(choice: Choice, numbers: Mapping[str, float]) -> Choice:
    """The same effects at these sizes."""
    return replace(choice, numbers={**choice.numbers, **numbers})


def gained_words(before: Fit, after: Fit) -> str:
    """What a larger or smaller model did to −2 ln L, in words."""
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    more = len(after.numbers) - len(before.numbers)
    numbers = f"{abs(more)} number{'' if abs(more) == 1 else 's'} {'more' if more > 0 else 'fewer'}"
    if more == 0:
        return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} with as many numbers."
    return f"−2 ln L {'fell' if gain >= 0 else 'rose'} by {abs(gain):,.1f} for {numbers}."


def tied_words(found: Fit) -> list[str]:
    """Pairs of fitted numbers whose errors hang together, the most tied first, in words."""
    pairs = []
    for i, one in enumerate(found.numbers):
        for k in range(i):
            scale = math.sqrt(float(found.covariance[i, i] * found.covariance[k, k]))
            r = float(found.covariance[i, k]) / scale if scale > 0 and math.isfinite(scale) else 0.0
            if abs(r) > STRONGLY_TIED:
                pairs.append((abs(r), f"{found.numbers[k].title} and {one.title}: correlation {r:+.2f}"))
    return [words for _, words in sorted(pairs, reverse=True)]


class Job:
    """One fit in a thread; `told`, `done` and `failed` are called from that thread."""

    def __init__(
        self,
        work: Callable[[Watch], Fitted],
        *,
        told: Callable[[Step], None],
        done: Callable[[Fitted], None],
        failed: Callable[[str], None],
    ) -> None:
        self._work, self._told, self._done, self._failed = work, told, done, failed
        self._unwanted = threading.Event()
        self.begun = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True, name="vinetrack-fit")
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it goes on, wanted."""
        return self._thread.is_alive() and not self._unwanted.is_set()

    def give_up(self) -> None:
        """Let it end at its next step; nothing more is heard of it."""
        self._unwanted.set()

    def wait(self, timeout_s: float | None = None) -> None:
        """Until it has ended."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            found = self._work(self._watch)
        except GivenUp:
            return
        except (FitError, EffectError, SimulationError) as error:
            self._say(self._failed, str(error))
        except Exception:
            log.exception("a fit of the explorer")
            self._say(self._failed, FAULT)
        else:
            if not self._unwanted.is_set():
                self._done(found)

    def _say(self, whom: Callable[[str], None], words: str) -> None:
        if not self._unwanted.is_set():
            whom(words)

    def _watch(self, step: Step) -> None:
        if self._unwanted.is_set():
            raise GivenUp
        self._told(step)
