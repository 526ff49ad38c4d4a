"""One row of the table that compares published numbers with ours, and the meaning of its marks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import pandas as pd

from vinetrack.core.published import SOURCE

COMPUTED = "computed"
SIMULATED = "simulated from printed parameters"
MEASURED = "measured"
NOT_CHECKABLE = "not checkable"

UNANSWERED = "the trials of this experiment do not tell"

MARKS = {
    COMPUTED: f"follows by arithmetic, or by Eq. (2), from other numbers of {SOURCE}; ours is the corrected value "
    "where the two differ",
    SIMULATED: "found in virtual trials that were grown from the printed B and n: agreement checks the analysis, not "
    "the paper",
    MEASURED: "found in trials that were filmed",
    NOT_CHECKABLE: "rests on something that is not printed: a setting, a scatter, or a B that had to be guessed",
}

PAPER_COLUMNS = (
    "row",
    "where",
    "quantity",
    "setting",
    "unit",
    "published",
    "as_printed",
    "ours",
    "ours_low_95",
    "ours_high_95",
    "mark",
    "how",
    "beside",
)

PREFERRED = "both_axes"  # The fit of the damping law that supplies our numbers

nan = math.nan


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """A published number or statement and ours, in `unit`. `row` identifies it in programs; `where` and `as_printed`
    say where and how it is printed; `published` is NaN where that is not a number. `low` and `high` are the 95 %
    interval of ours.
    """

    row: str
    where: str
    quantity: str
    mark: str
    how: str
    setting: str = ""
    unit: str = "1"
    published: float = nan
    as_printed: str = ""
    ours: float = nan
    low: float = nan
    high: float = nan
    beside: str = ""


def as_table(rows: Iterable[PaperRow]) -> pd.DataFrame:
    """Return the rows as a table with the columns `PAPER_COLUMNS` of `paper.csv`."""
    entries = []
    for row in map(_as_answered, rows):
        entry = asdict(row)
        entry["ours_low_95"], entry["ours_high_95"] = entry.pop("low"), entry.pop("high")
        entry["as_printed"] = row.as_printed or (f"{row.published:g}" if math.isfinite(row.published) else "")
        entries.append(entry)
        if row.mark not in MARKS:
            raise ValueError(f"row {row.row} has the mark {row.mark!r}")
    table = pd.DataFrame(entries, columns=list(PAPER_COLUMNS))
    twice = table.loc[table["row"].duplicated(), "row"].tolist()
    if twice:
        raise ValueError(f"rows stand twice: {', '.join(twice)}")
    return table


def _as_answered(row: PaperRow) -> PaperRow:
    """The row; where trials should have given a number and did not, `how` says so."""
    if row.mark not in (SIMULATED, MEASURED) or math.isfinite(row.ours):
        return row
    return replace(row, how=UNANSWERED)


def number(value: Any) -> float:
    """Return a number read from JSON, NaN for null."""
    return nan if value is None else float(value)


def bounds(pair: Sequence[float | None] | None) -> tuple[float, float]:
    """Return an interval read from JSON, NaN for null. Returns low, high."""
    low, high = pair or (None, None)
    return number(low), number(high)
