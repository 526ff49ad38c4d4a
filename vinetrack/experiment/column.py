"""Declaration of one column of the trial sheet, and conversion of its numbers to and from SI.

Imports stay light: the command line loads this module at every start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vinetrack.core.units import UNITS, Unit, split_unit

if TYPE_CHECKING:
    from vinetrack.core.records import Trial


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of the trial sheet. `field` is the field of `Trial` that holds the value, in SI where it is a number;
    `meaning` describes it, `measured` says how to measure it, `default` what a blank cell stands for.
    """

    name: str
    field: str
    meaning: str
    measured: str = ""
    default: str = ""
    kind: str = "number"
    low: float = -math.inf
    high: float = math.inf
    above_low: bool = False
    unit_key: str = ""
    slips: tuple[str, ...] = ()
    usual: tuple[float, float] = (-math.inf, math.inf)
    unusual_hint: str = ""
    shared: bool = True
    limit: str = ""
    condition_part: str = ""

    @property
    def scale(self) -> Unit | None:
        """The unit; None for text and for numbers without one."""
        return UNITS.get(self.unit_key or split_unit(self.name)[1])

    @property
    def unit(self) -> str:
        """The unit as it is printed; blank if there is none."""
        return self.scale.text if self.scale else ""

    @property
    def allowed(self) -> str:
        """The bounds, in words."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.high):
            return ("above " if self.above_low else "at least ") + f"{self.low:g}{unit}"
        return f"{'above ' if self.above_low else ''}{self.low:g} to {self.high:g}{unit}"

    def in_words(self, value: float) -> str:
        """Return a value as a phrase for a sentence: `a chamber of 3.7 litres`."""
        quantity = split_unit(self.name)[0].replace("_", " ")
        article = "an" if quantity[0] in "aeiou" else "a"
        return f"{article} {quantity} of {value:.3g} {self.unit}".rstrip()

    def to_si(self, value: float) -> float:
        """Convert a value of this column to SI."""
        return self.scale.to_si(value) if self.scale else value

    def of_trial(self, trial: Trial) -> float:
        """Return a trial's value of this column."""
        value = float(getattr(trial, self.field))
        return self.scale.from_si(value) if self.scale else value
