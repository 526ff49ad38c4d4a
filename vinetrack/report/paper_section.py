"""Section of the report that compares the paper's numbers with ours: Tables I and II, `paper.csv`, figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vinetrack.core import published
from vinetrack.core.units import interval, number
from vinetrack.figures.style import rows
from vinetrack.report.section import ReportFigure, ReportSection, ReportTable

if TYPE_CHECKING:
    import pandas as pd


def paper_section(table: pd.DataFrame, departures: pd.DataFrame, figures: Sequence[ReportFigure]) -> ReportSection:
    """Return the section."""
    from vinetrack.paper.rows import MARKS

    present = [f"“{mark}”: {words}" for mark, words in MARKS.items() if (table["mark"] == mark).any()]
    return ReportSection(
        key="paper",
        title="Comparison with the paper",
        paragraphs=[
            f"The numbers of {published.SOURCE} next to ours. {tally(table)} Each row is marked with its kind.",
            f"{'; '.join(present)}.",
            "The errors of Eq. (2) at low pressure (1.90 cm at 7 kPa) are compared with those that a chamber without "
            "refill, and a tail that cannot push, would cause in the same vine. Neither is claimed to be the reason: "
            "how fast the regulator refills, and how long the vines were, is not published, and B and n of Fig. 6 may "
            "have absorbed a part of it.",
        ],
        tables=[table_one(table), *table_two(table, departures), *every_row(table)],
        figures=list(figures),
    )


def tally(table: pd.DataFrame) -> str:
    """Return the number of rows of each kind, as a sentence."""
    from vinetrack.paper.rows import MARKS

    counts = table["mark"].value_counts()
    parts = [f"{counts[mark]} {mark}" for mark in MARKS if counts.get(mark, 0)]
    return f"{len(table)} rows: {', '.join(parts)}."


def table_one(table: pd.DataFrame) -> ReportTable:
    """Return Table I of the paper, with the results of Fig. 6 and ours."""
    by_row = _by_row(table)
    body = [
        (
            str(scale),
            *(
                _shown(_value(by_row.get(f"{name}_R{scale}"), "published"))
                for name in ("thickness", "diameter", "press", "laser")
            ),
            f"{published.DAMPING_B[scale]:g}",
            _ours(by_row.get(f"B_R{scale}")),
            f"{published.DAMPING_R2[scale]:g}",
            number(_value(by_row.get(f"R2_R{scale}"))),
        )
        for scale in published.DAMPING_B
    ]
    head = (
        "R",
        "wall, µm",
        "diameter, mm",
        "heat press, °C",
        "laser, %",
        "B printed, N·(s/m)ⁿ",
        "B here (95 %)",
        "R² printed",
        "R² here",
    )
    return ReportTable("Table I, with the results of Fig. 6", head, body, frozenset(range(1, len(head))))


def table_two(table: pd.DataFrame, departures: pd.DataFrame) -> list[ReportTable]:
    """Return Table II of the paper, positions and speeds, with ours and the effects of departures from Eq. (2)."""
    by_row = _by_row(table)
    head = ("pressure, kPa", "printed", "here", "chamber not refilled", "tail that cannot push", "both")
    made = []
    for title, figure, row, column, factor, printed, note in _ERRORS:
        body = []
        for pressure_kPa in printed:
            result = by_row.get(f"{row}_{pressure_kPa:g}kPa")
            causes = departures[
                (departures["figure"] == figure) & (abs(departures["pressure_kPa"] - pressure_kPa) < 1e-6)
            ]
            size = {str(cause.departure): factor * float(getattr(cause, column)) for cause in rows(causes)}
            body.append(
                (
                    f"{pressure_kPa:g}",
                    f"{printed[pressure_kPa]:g}",
                    number(_value(result)),
                    _range(size, "depletion_slow", "depletion_fast"),
                    number(size.get("slack")),
                    _range(size, "depletion_slow_slack", "depletion_fast_slack"),
                )
            )
        made.append(ReportTable(title, head, body, frozenset(range(len(head))), note))
    return made


_ERRORS = (
    (
        "Table II, rms of position, cm",
        "Fig. 4",
        "position_rms",
        "rms_position_m",
        100.0,
        published.POSITION_RMS_CM,
        "Here: mean of the trials minus Eq. (2) with the printed numbers. The last three columns: the error that a "
        "departure from Eq. (2) would cause, simulated for a vine of 280 mm.",
    ),
    (
        "Table II, rms of final speed, m/s",
        "Fig. 5",
        "final_speed_rms",
        "rms_final_lead_velocity_m_s",
        1.0,
        published.FINAL_SPEED_RMS_M_S,
        "At 12 cm, over payloads; B of this vine is not printed and is scaled in proportion to the wall.",
    ),
)


def every_row(table: pd.DataFrame) -> list[ReportTable]:
    """Return all rows of `paper.csv`, in one table for each part of the paper."""
    head = ("what", "printed", "here (95 %)", "kind", "how obtained, and remarks")
    made = []
    parts = table["where"].map(_part)
    for title in (*_PARTS, _ELSEWHERE):
        members = table[parts == title]
        if len(members):
            body = [
                (
                    f"{row.quantity}{', ' if row.setting else ''}{row.setting}"
                    + ("" if row.unit == "1" else f" ({row.unit})"),
                    row.as_printed,
                    _ours(row),
                    row.mark,
                    f"{row.how}{'; ' if row.beside else ''}{row.beside}",
                )
                for row in rows(members)
            ]
            made.append(ReportTable(f"{title}, every number", head, body, frozenset({1, 2})))
    return made


# Parts of the paper, with their sections and figures
_PARTS = {
    "Table I": ("Table I",),
    "Protocol": ("Section III-D", "Section III-E"),
    "Figs. 4 and 5, Table II": ("Fig. 4", "Fig. 5", "Section IV-A"),
    "Fig. 6": ("Fig. 6",),
    "Fig. 7": ("Fig. 7A", "Fig. 7B"),
    "Fig. 8": ("Fig. 8",),
    "Fig. 9": ("Fig. 9",),
    "Chamber and injector": ("Section III-B", "Section V-B"),
}

_ELSEWHERE = "The fast vine, air drag, pressures"


def _part(where: str) -> str:
    """The part of the paper of an entry of `where`, from its first reference."""
    first = where.split(";")[0].split(",")[0].split(" against")[0]
    return next((title for title, places in _PARTS.items() if first in places), _ELSEWHERE)


def _by_row(table: pd.DataFrame) -> Mapping[str, Any]:
    return {row.row: row for row in rows(table)}


def _value(row: Any, column: str = "ours") -> float | None:
    """The value of a row; None if there is no such row."""
    return None if row is None else float(getattr(row, column))


def _ours(row: Any) -> str:
    if row is None or not math.isfinite(row.ours):
        return "–"
    bounds = interval((row.ours_low_95, row.ours_high_95))
    return f"{_shown(row.ours)} ({bounds})" if bounds != "–" else _shown(row.ours)


def _shown(value: float | None) -> str:
    """A number to three digits; integers are unchanged."""
    whole = value is not None and math.isfinite(value) and math.isclose(value, round(value), rel_tol=1e-9)
    return f"{value:.0f}" if whole else number(value)


def _range(size: Mapping[str, float], low: str, high: str) -> str:
    """Two sizes as a range, the smaller first."""
    if low not in size or high not in size:
        return "–"
    first, last = (number(value) for value in sorted((size[low], size[high])))
    return first if first == last else f"{first} to {last}"
