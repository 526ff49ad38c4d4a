"""The paper's numbers beside ours, as a section of the report: Tables I and II, every row of `paper.csv`, figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vinetrack import published
from vinetrack.figures.numbers import interval, number
from vinetrack.figures.style import rows
from vinetrack.report.section import ReportFigure, ReportSection, ReportTable

if TYPE_CHECKING:
    import pandas as pd

FIGURES = {
    "paper_fig4": ("Fig. 4: the leading edge with the payload", "paper_motions.csv"),
    "paper_table2": ("Table II, drawn", "paper.csv"),
    "paper_fig5": ("Fig. 5: final speed and payload", "paper_speeds.csv"),
    "paper_fig6": ("Fig. 6: growth force and steady speed", "damping_points.csv"),
    "paper_fig7": ("Fig. 7: B against scale and wall", "scaling.json"),
    "paper_fig8": ("Fig. 8: steady speed and scale", "conditions.csv"),
    "paper_fig9": ("Fig. 9: energy efficiency", "conditions.csv"),
    "paper_reservoir": ("What a chamber loses", "paper_pressures.csv"),
}
"""Title of each figure, and the file that its numbers stand in."""


def paper_section(table: pd.DataFrame, departures: pd.DataFrame, figures: Sequence[ReportFigure]) -> ReportSection:
    """Put the section together.

    Parameters
    ----------
    table : as in `paper.csv`.
    departures : as in `paper_departures.csv`.
    figures : the pictures, in order.
    """
    from vinetrack.paper.rows import MARKS

    present = [f"{mark}: {words}" for mark, words in MARKS.items() if (table["mark"] == mark).any()]
    return ReportSection(
        key="paper",
        title="Beside the paper",
        paragraphs=[
            f"The numbers of {published.SOURCE} beside ours. {tally(table)} Each row says which kind it is.",
            f"{'; '.join(present)}.".capitalize(),
            "The errors of Eq. (2) at low pressure (1.90 cm at 7 kPa) are set beside what a chamber that nothing "
            "refills, and a tail that cannot push, would cause in the same vine. Neither is claimed to be the reason: "
            "how fast the regulator refills, and how long the vines were, is not printed, and B and n of Fig. 6 may "
            "have taken up a part of it.",
        ],
        tables=[table_one(table), table_two(table, departures), every_row(table)],
        figures=list(figures),
    )


def tally(table: pd.DataFrame) -> str:
    """How many rows there are of each kind, as a sentence."""
    from vinetrack.paper.rows import MARKS

    counts = table["mark"].value_counts()
    parts = [f"{counts[mark]} {mark}" for mark in MARKS if counts.get(mark, 0)]
    return f"{len(table)} rows: {', '.join(parts)}."


def table_one(table: pd.DataFrame) -> ReportTable:
    """Table I of the paper, with what Fig. 6 found and what we did."""
    by_row = _by_row(table)
    body = [
        (
            str(scale),
            *(_shown(published_of(by_row, f"{name}_R{scale}")) for name in ("thickness", "diameter", "press", "laser")),
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
    return ReportTable("Table I, with what Fig. 6 found", head, body, frozenset(range(1, len(head))))


def table_two(table: pd.DataFrame, departures: pd.DataFrame) -> ReportTable:
    """Table II of the paper, with ours and with what departures from Eq. (2) would cause."""
    by_row = _by_row(table)
    body = []
    for pressure_kPa in sorted({*published.POSITION_RMS_CM, *published.FINAL_SPEED_RMS_M_S}):
        cells = [f"{pressure_kPa:g}"]
        for figure, row, column, factor in (
            ("Fig. 4", "position_rms", "rms_position_m", 100.0),
            ("Fig. 5", "final_speed_rms", "rms_final_lead_velocity_m_s", 1.0),
        ):
            one = by_row.get(f"{row}_{pressure_kPa:g}kPa")
            own = departures[(departures["figure"] == figure) & (abs(departures["pressure_kPa"] - pressure_kPa) < 1e-6)]
            size = {str(cause.departure): factor * float(getattr(cause, column)) for cause in rows(own)}
            cells += ["–" if one is None else f"{one.published:g}", number(_value(one))]
            cells += [_range(size, "depletion_slow", "depletion_fast"), number(size.get("slack"))]
            cells += [_range(size, "depletion_slow_slack", "depletion_fast_slack")]
        body.append(tuple(cells))
    causes = ("chamber not refilled", "tail that cannot push", "both")
    head = [
        "pressure, kPa",
        *(f"position, cm: {words}" for words in ("printed", "here", *causes)),
        *(f"speed, m/s: {words}" for words in ("printed", "here", *causes)),
    ]
    note = (
        "Root mean squares. Here: the mean of the trials against Eq. (2) with the printed numbers; speeds at 12 cm, "
        "over payloads. The last three of each are what a departure from Eq. (2) would cause, simulated for 280 mm."
    )
    return ReportTable("Table II", head, body, frozenset(range(len(head))), note)


def every_row(table: pd.DataFrame) -> ReportTable:
    """All of `paper.csv`."""
    head = ("where", "what", "setting", "unit", "printed", "here (95 %)", "mark", "how", "beside it")
    body = [
        (
            row.where,
            row.quantity,
            row.setting,
            "" if row.unit == "1" else row.unit,
            row.as_printed,
            _ours(row),
            row.mark,
            row.how,
            row.beside,
        )
        for row in rows(table)
    ]
    return ReportTable("Every published number", head, body, frozenset({4, 5}))


def _by_row(table: pd.DataFrame) -> Mapping[str, Any]:
    return {row.row: row for row in rows(table)}


def published_of(by_row: Mapping[str, Any], row: str) -> float | None:
    """The published value of a row; None where there is no such row."""
    return float(by_row[row].published) if row in by_row else None


def _value(row: Any) -> float | None:
    return None if row is None else float(row.ours)


def _ours(row: Any) -> str:
    if row is None or not math.isfinite(row.ours):
        return "–"
    bounds = interval((row.ours_low_95, row.ours_high_95))
    return f"{_shown(row.ours)} ({bounds})" if bounds != "–" else _shown(row.ours)


def _shown(value: float | None) -> str:
    """A number to three digits, a whole one as it is."""
    whole = value is not None and math.isfinite(value) and math.isclose(value, round(value), rel_tol=1e-9)
    return f"{value:.0f}" if whole else number(value)


def _range(size: Mapping[str, float], low: str, high: str) -> str:
    """Two sizes as a range, the smaller first."""
    pair = [size.get(name) for name in (low, high)]
    first, last = (
        (number(one) for one in sorted(one for one in pair if one is not None)) if None not in pair else ("", "")
    )
    return f"{first} to {last}" if first != last else first or "–"
