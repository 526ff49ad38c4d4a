"""The section of the report that compares the model in use with the measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number, with_error
from vinetrack.core.units import display_unit
from vinetrack.figures.style import rows
from vinetrack.narrative.verdict_summary import interval_text, listed_names

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Diagnosis
    from vinetrack.inference.fit_result import BetweenTrialSpread, Number
    from vinetrack.inference.fit_summary import FitSummary

_EXPLAINED = (
    "The model in use is fitted to the positions of all trials at once. Each trial is then predicted with its own "
    "release and origin, at the nominal pressure and the vine's B: the difference is the error of position. The error "
    "of a complete model equals the replicate scatter: a ratio near 1 leaves nothing to explain, and with few "
    "replicates it may fall below 1 by chance. Final speeds of the leading edge are compared at the same growth."
)


@dataclass(frozen=True)
class ModelResult:
    """The fit, the comparison and the check of the damping law of a results folder."""

    fit: FitSummary
    comparison: pd.DataFrame
    check: pd.DataFrame
    diagnosis: Diagnosis | None = None


def model_section(result: ModelResult | None) -> dict[str, Any] | None:
    """Return the section on the model in use as text for the template; None if no model was fitted or refused."""
    if result is None:
        return None
    fit = result.fit
    return {
        "names": " + ".join(fit.names),
        "final": _final(result.diagnosis),
        "is_refuted": result.diagnosis is not None and result.diagnosis.refutes,
        "refused": fit.refused,
        "explained": _EXPLAINED,
        "verdict": verdict(result.comparison),
        "numbers": [_number(entry) for entry in fit.numbers],
        "spreads": [_spread(name, spread) for name, spread in fit.spreads.items()],
        "messages": list(fit.messages),
        "left_out": [f"{name}: {reason}" for name, reason in fit.left_out.items()],
        "warnings": list(fit.warnings),
        "conditions": [_condition(row) for row in rows(result.comparison)],
        "check": [_check(row) for row in rows(result.check)],
    }


def _final(diagnosis: Diagnosis | None) -> dict[str, Any] | None:
    """The final model of the diagnosis; None if nothing was added."""
    if diagnosis is None or not diagnosis.effects:
        return None
    from vinetrack.narrative.verdict_summary import settled_rows

    text = ""
    if diagnosis.ladder is not None and len(diagnosis.ladder):
        last = settled_rows(diagnosis.ladder).iloc[-1]
        inside, outside, floor = (
            number(1e3 * float(last[key])) for key in ("rms_in_sample_m", "rms_left_out_m", "floor_m")
        )
        text = (
            f"With {listed_names(diagnosis.effects)} the error of the model is {inside} mm, and {outside} mm on "
            f"conditions left out of the fit; replicate scatter is {floor} mm (root mean square)."
        )
    return {
        "names": " + ".join(diagnosis.final_model),
        "verdict": text,
        "numbers": [_number(entry) for entry in diagnosis.parameters],
    }


def verdict(comparison: pd.DataFrame) -> str:
    """Return the position error of the model in two sentences; blank without a condition."""
    if not len(comparison):
        return ""
    worst = comparison.sort_values("rms_position_m").iloc[-1]
    sentence = (
        f"Over {_conditions(len(comparison))} the model is off by {number(1e3 * _rms(comparison['rms_position_m']))} mm"
    )
    known = comparison[comparison["replicate_floor_m"] > 0]
    if len(known):
        sentence += f", and replicates scatter by {number(1e3 * _rms(known['replicate_floor_m']))} mm"
    return (
        f"{sentence} (root mean square). Worst is {worst['condition']}, by {number(1e3 * worst['rms_position_m'])} mm, "
        f"with the maximum after {number(1e3 * worst['worst_at_m'])} mm of growth."
    )


def _conditions(count: int) -> str:
    return "one condition" if count == 1 else f"{count} conditions"


def _rms(values: pd.Series) -> float:
    return math.sqrt(float((values**2).mean()))


def _number(entry: Number) -> dict[str, str]:
    unit, factor = display_unit(entry.unit)
    return {
        "symbol": entry.symbol,
        "vine": entry.vine,
        "parameter": entry.key,
        "value": with_error(factor * entry.value, factor * entry.sigma),
        "interval": interval_text(entry).removeprefix("95 %: ").removesuffix(f" {unit}"),
        "unit": unit,
    }


def _spread(name: str, spread: BetweenTrialSpread) -> str:
    how = "" if spread.estimated else " (fixed)"
    return f"{name} {number(100 * spread.value, 2)} %{how}"


def _condition(row: Any) -> dict[str, str]:
    return {
        "condition": row.condition,
        "rms": number(1e3 * row.rms_position_m),
        "floor": number(1e3 * row.replicate_floor_m),
        "ratio": number(row.ratio, 2),
        "speed": number(row.rms_final_velocity_m_s),
        "worst_ms": number(1e3 * row.worst_at_s),
        "worst_mm": number(1e3 * row.worst_at_m),
    }


def _check(row: Any) -> dict[str, str]:
    return {
        "vine": row.vine,
        "n_steady": number(row.n_steady),
        "n_trajectory": number(row.n_trajectory),
        "B_steady": number(row.B_steady),
        "B_trajectory": number(row.B_trajectory),
        "z": number(row.z, 2),
    }
