"""How far a fit is, in a share and in words: it has no known number of steps, only a promise that shrinks."""

from __future__ import annotations

import math

from vinetrack.inference.optimiser import SETTLED_DECREASE, Step

LEAST_SHARE = 0.04


class Waiting:
    """The state of what a person waits for; `words` is what there is to say where nobody waits."""

    def __init__(self) -> None:
        self.words = ""
        self._begun = 0.0
        self._largest = 0.0
        self._share = LEAST_SHARE
        self._step: Step | None = None

    def begin(self, now: float) -> None:
        """A fit is wanted."""
        self._begun, self._largest, self._share, self._step, self.words = now, 0.0, LEAST_SHARE, None, ""

    def reach(self, step: Step) -> None:
        """It has come so far."""
        self._step = step
        if math.isfinite(step.promised) and step.promised > 0:
            self._largest = max(self._largest, step.promised)
            whole = math.log10(max(self._largest, 10 * SETTLED_DECREASE) / SETTLED_DECREASE)
            done = math.log10(max(self._largest, step.promised) / max(step.promised, SETTLED_DECREASE))
            self._share = max(self._share, min(done / whole, 0.97))

    def state(self, now: float, about: str, other: Step | None = None) -> tuple[float, str]:
        """Share done and words; `other` is the step of what has to be done first."""
        step = other or self._step
        where = f" · step {step.iteration}" if step is not None else ""
        promise = ""
        if step is not None and math.isfinite(step.promised):
            promise = (
                f" · the next lowers −2 ln L by {step.promised:,.2g}" if step.promised < 1e4 else " · still far off"
            )
        return self._share, f"{about}{where}{promise} · {now - self._begun:.1f} s"

    def end(self, words: str) -> None:
        """Nobody waits any more."""
        self.words = words

    def say(self, words: str) -> None:
        """Something to say that is no end."""
        self.words = words
