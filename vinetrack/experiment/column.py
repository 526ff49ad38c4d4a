"""A column of the trial sheet: what is declared of it, its unit and bounds, and its numbers in SI.

Nothing heavy is loaded here: the command line reads it at every start.
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
    """A column of the sheet.

    `field` is the field of a `Trial` that holds it, in SI where it is a number; `meaning` what it is, `measured` how to
    come by it, `default` what a blank cell stands for. `low` and `high` bound the value (`low` itself is refused where
    `above_low`). `slips` are units people write by mistake. A legal value outside `usual` gets a warning. `unit_key` is
    given where the name does not end in the unit. `shared` columns may stand in `experiment.yaml` for all trials;
    `limit` says how those that the next experiment may choose stand in its `limits`: as a `range`, or as a `choice`.
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

    @property
    def scale(self) -> Unit | None:
        """The unit of a number; None for text and for plain numbers."""
        return UNITS.get(self.unit_key or split_unit(self.name)[1])

    @property
    def unit(self) -> str:
        """The unit as it is printed; blank where there is none."""
        return self.scale.text if self.scale else ""

    @property
    def allowed(self) -> str:
        """The bounds in words."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.high):
            return ("above " if self.above_low else "at least ") + f"{self.low:g}{unit}"
        return f"{'above ' if self.above_low else ''}{self.low:g} to {self.high:g}{unit}"

    def in_words(self, value: float) -> str:
        """Name a number of this column in a sentence: `a chamber of 3.7 litres`.

        Parameters
        ----------
        value : in the unit of the column.

        Returns
        -------
        article, quantity, number and unit.
        """
        quantity = split_unit(self.name)[0].replace("_", " ")
        article = "an" if quantity[0] in "aeiou" else "a"
        return f"{article} {quantity} of {value:.3g} {self.unit}".rstrip()

    def to_si(self, value: float) -> float:
        """Return a number of this column in SI.

        Parameters
        ----------
        value : in the unit of the column.

        Returns
        -------
        the value in SI.
        """
        return self.scale.to_si(value) if self.scale else value

    def of_trial(self, trial: Trial) -> float:
        """Return the number that a trial has in this column.

        Parameters
        ----------
        trial : of a sheet, in SI.

        Returns
        -------
        in the unit of the column; NaN where it has none.
        """
        value = float(getattr(trial, self.field))
        return self.scale.from_si(value) if self.scale else value
