"""Record of an undetected effect that a fitted size may include, as stored in a diagnosis and its file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vinetrack.core.numbers import or_nan
from vinetrack.inference.fit_result import Number


@dataclass(frozen=True)
class Confounder:
    """Another effect that a fitted size may include."""

    number: Number
    effect: str
    symbol: str
    unit: str
    limit: float
    value: float
    low_95: float
    high_95: float

    def to_json(self) -> dict[str, object]:
        """Return it as an entry of `confounded_by`."""
        return {
            "parameter": self.number.key,
            "vine": self.number.vine,
            "effect": self.effect,
            "symbol": self.symbol,
            "unit": self.unit,
            "limit_95": self.limit,
            "value_at_limit": self.value,
            "low_95": self.low_95,
            "high_95": self.high_95,
        }


def left_open(alike: Sequence[Confounder]) -> tuple[float, float]:
    """The 95 % interval of a size with each of these effects left free (hull). Returns low, high : SI."""
    return min(rival.low_95 for rival in alike), max(rival.high_95 for rival in alike)


def read_confounders(entries: Iterable[Mapping[str, Any]], numbers: Sequence[Number]) -> tuple[Confounder, ...]:
    """Read confounders from a file, each with the size that it concerns. Returns without those whose size is missing
    from `numbers`.
    """
    of = {(number.key, number.vine): number for number in numbers}
    return tuple(
        Confounder(
            number=of[entry["parameter"], entry["vine"]],
            effect=str(entry["effect"]),
            symbol=str(entry["symbol"]),
            unit=str(entry["unit"]),
            limit=or_nan(entry.get("limit_95")),
            value=or_nan(entry.get("value_at_limit")),
            low_95=or_nan(entry.get("low_95")),
            high_95=or_nan(entry.get("high_95")),
        )
        for entry in entries
        if (entry["parameter"], entry["vine"]) in of
    )
