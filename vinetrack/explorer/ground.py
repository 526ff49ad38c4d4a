"""What all open pages stand on: the campaign, the curves of the model in use, and its fit, made once for all."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import Choice, first_choice, sized
from vinetrack.explorer.curves import Curves, errors_m, follow
from vinetrack.explorer.fitting import FAULT, Fitted, first_fit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.optimiser import Step

log = logging.getLogger(__name__)


class Ground:
    """Grows in the background, in this order: `curves` and `errors_m` of the model in use, then its fit.

    `trouble` says why it got no further, blank where it did. Listeners are called from the background's thread.
    """

    def __init__(self, campaign: Campaign, choice: Choice | None = None) -> None:
        self.campaign = campaign
        self.start = first_choice(campaign)
        self.opening = choice or self.start
        self.curves: Curves | None = None
        self.errors_m: dict[str, float] = {}
        self.fitted: Fitted | None = None
        self.step: Step | None = None
        self.trouble = ""
        self._listeners: list[Callable[[], None]] = []
        self._thread = threading.Thread(target=self._grow, daemon=True, name="vinetrack-ground")

    def begin(self) -> Ground:
        """Start growing."""
        self._thread.start()
        return self

    def wait(self, timeout_s: float | None = None) -> None:
        """Until all is there, or something went wrong."""
        self._thread.join(timeout_s)

    def listen(self, heard: Callable[[], None]) -> None:
        """Have `heard` called whenever something new is there."""
        self._listeners.append(heard)

    def forget(self, heard: Callable[[], None]) -> None:
        """Call it no more."""
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
