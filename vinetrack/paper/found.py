"""Lines of the table that come from an experiment's results: the law, model against measurement, the fast vine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.inference.fit_summary import FitSummary
from vinetrack.paper.foretold import departures_in_words
from vinetrack.paper.found_sizes import size_rows
from vinetrack.paper.rows import NOT_CHECKABLE, PREFERRED, SIMULATED, PaperRow, bounds, number

nan = math.nan


@dataclass(frozen=True, kw_only=True)
class Found:
    """What an experiment found: tables and files of its results folder, by the names they have there.

    `mark` is `SIMULATED` or `MEASURED`. `positions` has a row a pressure of the paper's Fig. 4 (`pressure_kPa,
    n_trials, rms_mean_m, rms_single_m`), `speeds` one a condition of Fig. 5 (`pressure_kPa, payload_g,
    final_lead_velocity_m_s, eq2_lead_velocity_m_s`); `departures` is `departures.departure_table`.
    """

    mark: str
    damping: Mapping[str, Any]
    scaling: Mapping[str, Any]
    conditions: pd.DataFrame
    fit: FitSummary
    positions: pd.DataFrame
    speeds: pd.DataFrame
    departures: pd.DataFrame


def found_rows(found: Found) -> Iterator[PaperRow]:
    """Every line that an experiment answers; where it has nothing to say, ours is blank."""
    yield from _law_rows(found)
    yield from _position_rows(found)
    yield from _final_speed_rows(found)
    yield from size_rows(found.mark, found.damping, found.scaling)
    yield _fast_row(found)


def _law_rows(found: Found) -> Iterator[PaperRow]:
    names = {
        "log_log": ("n_log_log", "least squares on logarithms, with the weight in the force"),
        PREFERRED: ("n_both_axes", "errors on both axes, with the weight in the force"),
        "paper": ("n_literal", "the published rule to the letter: set pressure, no weight, 3 % windows"),
    }
    for method, (row, how) in names.items():
        law = found.damping.get(method) or {}
        low, high = bounds(law.get("n_95_total"))
        yield PaperRow(
            row=row,
            where="Fig. 6",
            quantity="damping exponent n, shared by the scales",
            published=published.EXPONENT,
            ours=number(law.get("n")),
            low=low,
            high=high,
            mark=found.mark,
            how=how,
        )
    for scale, printed in published.DAMPING_B.items():
        yield from _coefficient_rows(found, scale, printed)


def _coefficient_rows(found: Found, scale: int, printed: float) -> Iterator[PaperRow]:
    ours = {method: _law_of(found.damping.get(method) or {}, scale) for method in (PREFERRED, "log_log", "paper")}
    low, high = bounds(ours[PREFERRED].get("B_95_total"))
    literal = number(ours["paper"].get("B"))
    yield PaperRow(
        row=f"B_R{scale}",
        where="Fig. 6",
        quantity="damping coefficient B",
        setting=f"R = {scale}, N = {ours[PREFERRED].get('n_trials', 0)} steady trials",
        unit="N·(s/m)ⁿ",
        published=printed,
        ours=number(ours[PREFERRED].get("B")),
        low=low,
        high=high,
        mark=found.mark,
        how="errors on both axes",
        beside=f"{literal:.3g} by the published rule to the letter" if math.isfinite(literal) else "",
    )
    yield PaperRow(
        row=f"R2_R{scale}",
        where="Fig. 6",
        quantity="R² of the power law",
        setting=f"R = {scale}",
        published=published.DAMPING_R2[scale],
        ours=number(ours["log_log"].get("R2")),
        mark=NOT_CHECKABLE if found.mark == SIMULATED else found.mark,
        how="least squares on logarithms; in virtual trials R² says what scatter was assumed",
    )


def _law_of(law: Mapping[str, Any], scale: int) -> Mapping[str, Any]:
    for vine in (law.get("vines") or {}).values():
        if published.scale_of(vine["diameter_mm"], vine["thickness_um"]) == scale:
            return dict(vine)
    return {}


def _position_rows(found: Found) -> Iterator[PaperRow]:
    names = ("n_trials", "rms_mean_m", "rms_single_m")
    for pressure_kPa, printed_cm in published.POSITION_RMS_CM.items():
        own = found.positions[np.isclose(found.positions["pressure_kPa"].to_numpy(float), pressure_kPa)]
        n_trials, mean_m, single_m = (float(own[name].iloc[0]) for name in names) if len(own) else (0.0, nan, nan)
        alone = f"; {100 * single_m:.2f} cm over single trials" if len(own) else ""
        yield PaperRow(
            row=f"position_rms_{pressure_kPa:g}kPa",
            where="Fig. 4, Table II",
            quantity="rms of the leading edge's position, mean of the trials against Eq. (2) with the printed numbers",
            setting=f"24 mm × 200 µm, {published.PAYLOAD_G:g} g, {pressure_kPa:g} kPa, N = {n_trials:g}",
            unit="cm",
            published=printed_cm,
            ours=100 * mean_m,
            mark=found.mark,
            how=("nothing but B and P that scatter by 3 and 1 %" if found.mark == SIMULATED else "as filmed") + alone,
            beside=departures_in_words(found.departures, "Fig. 4", pressure_kPa),
        )
    yield _yield_row(found)


def _yield_row(found: Found) -> PaperRow:
    ours, low, high = nan, nan, nan
    for one in found.fit.numbers:
        if one.key == "yield_pressure.P_y" and one.vine.startswith("24mm-200um"):
            ours, low, high = (value / 1e3 for value in (one.value, one.low, one.high))
    return PaperRow(
        row="yield_pressure",
        where="Section IV-A",
        quantity="yield pressure",
        setting="24 mm × 200 µm",
        unit="kPa",
        published=published.YIELD_PRESSURE_KPA,
        ours=ours,
        low=low,
        high=high,
        mark=found.mark,
        how="fitted to whole trajectories with what the sheet says and its error",
    )


def _final_speed_rows(found: Found) -> Iterator[PaperRow]:
    for pressure_kPa, printed in published.FINAL_SPEED_RMS_M_S.items():
        own = found.speeds[np.isclose(found.speeds["pressure_kPa"].to_numpy(float), pressure_kPa)]
        off = (own["final_lead_velocity_m_s"] - own["eq2_lead_velocity_m_s"]).to_numpy(float)
        payloads = ", ".join(f"{payload:g}" for payload in own["payload_g"])
        yield PaperRow(
            row=f"final_speed_rms_{pressure_kPa:g}kPa",
            where="Fig. 5, Table II",
            quantity="rms over payloads of the leading edge's speed at 12 cm, means against Eq. (2)",
            setting=f"24 mm × 150 µm, {pressure_kPa:g} kPa, payloads {payloads or 'none'} g",
            unit="m/s",
            published=printed,
            ours=math.sqrt(float(np.mean(off**2))) if off.size else nan,
            mark=NOT_CHECKABLE,
            how="B of this vine and the payloads are not printed: B in proportion to the wall, payloads ours",
            beside=departures_in_words(found.departures, "Fig. 5", pressure_kPa),
        )


def _fast_row(found: Found) -> PaperRow:
    fast = published.FAST_VINE
    table = found.conditions
    same = np.ones(len(table), dtype=bool)
    for column in ("diameter_mm", "thickness_um", "pressure_kPa"):
        same &= np.isclose(table[column].to_numpy(float), fast[column], rtol=0.02)
    own = table[same & (table["payload_g"] == 0).to_numpy()]
    row = own.iloc[0] if len(own) else None
    return PaperRow(
        row="fast_vine_measured",
        where="Section IV-E",
        quantity="speed of the leading edge, measured",
        setting=f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm, {fast['pressure_kPa']:g} kPa"
        + (f", at {row['final_at_mm']:.0f} mm, N = {int(row['n_final'])}" if row is not None else ""),
        unit="m/s",
        published=published.FAST_VINE_MEASURED_M_S,
        ours=float(row["final_lead_velocity_m_s"]) if row is not None else nan,
        mark=NOT_CHECKABLE if found.mark == SIMULATED else found.mark,
        how="its B is not printed; the virtual one has a guessed B, and where the 60 m/s were measured is not printed"
        if found.mark == SIMULATED
        else "as filmed",
    )
