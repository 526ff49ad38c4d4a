"""Lines of the table about size: B, steady speed and efficiency against scale, wall and diameter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from vinetrack.core import published
from vinetrack.paper.rows import NOT_CHECKABLE, PREFERRED, SIMULATED, PaperRow, bounds, number

nan = math.nan


def size_rows(mark: str, damping: Mapping[str, Any], scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    """Lines from `damping.json` and `scaling.json`; where they have nothing to say, ours is blank."""
    yield from _scale_rows(mark, scaling)
    yield from _steady_speed_rows(mark, scaling)
    yield from _wall_rows(mark, damping, scaling)
    yield from _efficiency_rows(mark, scaling)


def _scale_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    family = next((one for one in scaling.get("isometric") or () if len(one["vines"]) >= 4), None)
    line, power = ((family or {}).get(key) or {} for key in ("line", "power"))
    one = partial(PaperRow, where="Fig. 7A", setting="our four B against R", as_printed="near-linear", mark=mark)
    low, high = bounds(power.get("slope_95"))
    how = "least squares on the means of vines"
    yield one(
        row="our_B_power_of_scale",
        quantity="exponent on log axes",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        how=how,
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    yield one(row="our_B_line_R2", quantity="R² of a straight line", ours=number(line.get("R2")), how=how)


def _steady_speed_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    family = _at_pressure(scaling.get("steady_speed") or (), published.STEADY_SPEED_KPA)
    sizes = len(family.get("sizes", ()))
    counts = [int(count) for count in family.get("n_steady", ())]
    setting = f"{published.STEADY_SPEED_KPA:g} kPa, N = {sizes} vines"
    one = partial(PaperRow, where="Fig. 8", setting=setting, mark=mark)
    yield one(
        row="steady_speed_trials",
        quantity="steady trials a vine",
        published=float(published.REPLICATES),
        ours=float(np.median(counts)) if counts else nan,
        how="those whose speed the gated rule finds steady",
    )
    line, power = (family.get(key) or {} for key in ("line", "power"))
    why = "grown from the printed B, which do not rise evenly with R" if mark == SIMULATED else "as filmed"
    yield one(
        row="steady_speed_R2",
        quantity="R² of a straight line through the speeds",
        published=published.STEADY_SPEED_R2,
        ours=number(line.get("R2")),
        how=f"{why}: Fig. 6 and Fig. 8 cannot be tested on each other",
        beside=f"p = {line['p']:.2g}, monotonic: {'yes' if family.get('monotonic') else 'no'}" if line else "",
    )
    low, high = bounds(power.get("slope_95"))
    yield one(
        row="steady_speed_power",
        quantity="exponent of steady speed against scale, on log axes",
        as_printed="rises monotonically",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        how=f"least squares on the means of vines; {why}",
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    relative = (family.get("over_diameter") or {}).get("power") or {}
    low, high = bounds(relative.get("slope_95"))
    yield one(
        row="steady_speed_over_diameter_power",
        quantity="exponent of steady speed over diameter against scale",
        as_printed="no trend",
        ours=number(relative.get("slope")),
        low=low,
        high=high,
        how="least squares on the means of vines; four vines exclude little",
        beside=f"p = {relative['p']:.2g}" if relative else "",
    )


def _wall_rows(mark: str, damping: Mapping[str, Any], scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    diameter_mm = published.THICKNESS_SERIES_DIAMETER_MM
    families = scaling.get("thickness") or ()
    damping = (damping.get(PREFERRED) or {}).get("vines") or {}
    family: Mapping[str, Any] = {}
    for one in families:
        if any(abs(damping.get(vine, {}).get("diameter_mm", nan) / diameter_mm - 1) < 0.01 for vine in one["vines"]):
            family = one
    power, line = (family.get(key) or {} for key in ("power", "line"))
    own = partial(
        PaperRow,
        where="Fig. 7B",
        setting=f"{diameter_mm:g} mm, walls of {', '.join(f'{size:g}' for size in family.get('sizes', ()))} µm",
        as_printed="rises linearly",
        mark=NOT_CHECKABLE if mark == SIMULATED else mark,
        how="of the four B one is printed; the virtual trials were grown with B in proportion to the wall"
        if mark == SIMULATED
        else "least squares on the means of vines",
    )
    low, high = bounds(power.get("slope_95"))
    yield own(
        row="B_power_of_wall",
        quantity="exponent of B against wall thickness",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    yield own(row="B_wall_line_R2", quantity="R² of a straight line", ours=number(line.get("R2")))


def _efficiency_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    families = [
        family
        for family in scaling.get("efficiency") or ()
        if math.isclose(family["pressure_kPa"], published.EFFICIENCY_KPA, rel_tol=0.02)
        and math.isclose(family["payload_g"], published.PAYLOAD_G, rel_tol=0.02)
    ]
    trends: Mapping[str, Any] = families[0]["trend"] if families else {}
    names = {
        "efficiency": "½ m(x) ẋ² / (P₀ A y)",
        "efficiency_payload": "payload alone",
        "efficiency_with_weight": "with the work of the weight in the denominator",
    }
    printed = {"thickness_um": ("wall", "higher for thinner walls"), "diameter_mm": ("diameter", "no clear trend")}
    for key, words in names.items():
        trend = trends.get(key) or {}
        for size, (name, statement) in printed.items():
            power = trend.get(size) or {}
            low, high = bounds(power.get("power_95"))
            yield PaperRow(
                row=f"{key}_power_of_{name}",
                where="Fig. 9",
                quantity=f"exponent of efficiency against {name}, {words}",
                setting=f"{published.EFFICIENCY_KPA:g} kPa, {published.PAYLOAD_G:g} g, after "
                f"{published.EFFICIENCY_AT_MM:g} mm, N = {trend.get('n', 0)} vines",
                as_printed=statement,
                ours=number(power.get("power")),
                low=low,
                high=high,
                mark=NOT_CHECKABLE if mark == SIMULATED else mark,
                how="values are drawn only, and B of six of the eight vines is not printed"
                if mark == SIMULATED
                else "powers of wall and diameter fitted together on logarithms",
                beside=f"p = {power['p']:.2g}" if power else "",
            )


def _at_pressure(families: Sequence[Mapping[str, Any]], pressure_kPa: float) -> Mapping[str, Any]:
    return next((one for one in families if math.isclose(one["pressure_kPa"], pressure_kPa, rel_tol=0.02)), {})
