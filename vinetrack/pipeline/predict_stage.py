"""The command `vinetrack predict`: predictions of new vines as lines, figure, CSV and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number
from vinetrack.core.tables import STANDARD_OUTPUT, write_csv, write_json
from vinetrack.pipeline.prediction_inputs import (
    PredictionBasis,
    PredictionRequest,
    check_figure,
    describe_trial,
    display_unit_name,
    display_value,
    input_rows,
    inputs_of,
    name_missing_option,
    read_basis,
    warnings_of,
    write_figure,
)
from vinetrack.results.folder_layout import ResultsError

if TYPE_CHECKING:
    from vinetrack.figures.prediction_figures import PredictionPicture
    from vinetrack.planning.design_checks import Neglected
    from vinetrack.planning.prediction import Quantity, VinePrediction

SMALL_FORCE_N = 0.01  # Forces are shown in mN if all are below this, N (chosen)

# Smallest relative change of the final speed for which a neglected effect is listed (chosen)
SMALLEST_LISTED_CHANGE = 0.005


@dataclass(frozen=True)
class ConditionPrediction:
    """Prediction of one condition, its design checks (`hazards`), and the influence of neglected effects."""

    prediction: VinePrediction
    hazards: tuple[str, ...]
    neglected: tuple[Neglected, ...]


def predict_conditions(
    request: PredictionRequest,
    *,
    samples: int,
    seed: int,
    at_fraction: float,
    figure: Path | None = None,
    csv: Path | None = None,
    json: Path | None = None,
) -> list[str]:
    """Predict all conditions; write figure, curves and JSON if requested."""
    import pandas as pd

    check_figure(figure)
    basis = read_basis(request)
    entries = _predict_all(basis, samples, seed, at_fraction)
    lines = [*_condition_lines(entries[0])] if len(entries) == 1 else [*_table_lines(entries)]
    lines += [f"! {warning}" for warning in warnings_of(basis)]
    if figure is not None:
        from vinetrack.figures.prediction_figures import draw_predictions

        write_figure(draw_predictions([_picture(entry.prediction) for entry in entries], at_fraction), figure)
        lines.append(f"Figure: {figure}")
    if csv is not None:
        write_csv(csv, pd.concat([entry.prediction.curve for entry in entries], ignore_index=True))
        lines.append(f"Curves: {csv}")
    if json is not None:
        write_json(json, [_json_entry(entry) for entry in entries])
        lines.append(f"All numbers: {json}")
    return [] if json == STANDARD_OUTPUT else lines


def _predict_all(basis: PredictionBasis, samples: int, seed: int, at_fraction: float) -> list[ConditionPrediction]:
    """Predict every condition."""
    from vinetrack.core.terminal import progress
    from vinetrack.dynamics.simulate import SimulationError
    from vinetrack.effects import EffectError
    from vinetrack.planning.design_checks import design_checks, neglected
    from vinetrack.planning.prediction import predict_vine

    entries = []
    try:
        for inputs in progress(inputs_of(basis), "predicting", unit="condition"):
            prediction = predict_vine(inputs, samples=samples, seed=seed, at_fraction=at_fraction)
            entries.append(ConditionPrediction(prediction, design_checks(prediction), neglected(inputs, at_fraction)))
    except SimulationError as error:
        raise ResultsError(f"{error} Leave an effect out, or give it another size.") from None
    except EffectError as error:
        raise name_missing_option(error) from None
    return entries


def _condition_lines(entry: ConditionPrediction) -> Iterator[str]:
    """Yield all lines about a single condition."""
    from vinetrack.core.terminal import table

    prediction = entry.prediction
    inputs = prediction.inputs
    yield f"{describe_trial(inputs.trial)}; {' + '.join(inputs.model.names)}"
    yield ""
    yield from table(input_rows(inputs.bands()), ("input", "median", "90 % band", "unit", "from"), align="<><<<")
    yield ""
    rows = [_quantity_row(quantity) for quantity in prediction.quantities]
    yield from table(rows, ("prediction", "at y/L", "median", "90 % band", "unit"), align="<<><<")
    yield ""
    head = (f"uncertainties included ({prediction.samples} draws)", "final speed by it alone", "why")
    yield from table([_share_row(share.name, share.low, share.high, share.words) for share in prediction.shares], head)
    yield from _left_out(entry)
    yield ""
    yield from (f"! {warning}" for warning in entry.hazards)


def _quantity_row(quantity: Quantity) -> tuple[str, str, str, str, str]:
    """Return name, place, median, band and unit; stresses are in MPa, and forces in mN if all are small."""
    place = "" if math.isnan(quantity.y_over_L) else f"{quantity.y_over_L:g}"
    values, unit = (quantity.low, quantity.median, quantity.high), quantity.unit
    if unit == "Pa":
        texts, unit = [number(value / 1e6) for value in values], "MPa"
    elif unit == "N" and max(abs(value) for value in values) < SMALL_FORCE_N:
        texts, unit = [number(1e3 * value) for value in values], "mN"
    else:
        texts, unit = [display_value(value, unit) for value in values], display_unit_name(unit)
    no_band = quantity.low == quantity.high or math.isnan(quantity.median)
    return quantity.name, place, texts[1], "–" if no_band else f"{texts[0]} to {texts[2]}", unit


def _share_row(name: str, low: float, high: float, words: str) -> tuple[str, str, str]:
    return name, f"{display_value(low, 'm/s')} to {display_value(high, 'm/s')} m/s", words


def _left_out(entry: ConditionPrediction) -> Iterator[str]:
    """Yield a table of neglected effects that every vine has, with their influence on the final speed."""
    from vinetrack.core.terminal import table

    rows = [
        (
            omitted.effect,
            omitted.size,
            f"{display_value(omitted.without_m_s, 'm/s')} → {display_value(omitted.final_m_s, 'm/s')} m/s",
            f"{omitted.change:+.1%}",
        )
        for omitted in entry.neglected
        if abs(omitted.change) >= SMALLEST_LISTED_CHANGE
    ]
    if rows:
        yield ""
        yield from table(rows, ("not in the model", "at the size", "final speed", "change"))


def _table_lines(entries: Sequence[ConditionPrediction]) -> Iterator[str]:
    """Yield a table with one row per condition."""
    from vinetrack.core.terminal import table
    from vinetrack.planning.prediction import TIME

    first = entries[0].prediction
    yield f"{' + '.join(first.inputs.model.names)}; medians and 90 % bands of {first.samples} draws"
    rows = [
        (
            entry.prediction.inputs.trial.condition,
            *_quantity_row(entry.prediction.final)[1:4],
            *_quantity_row(entry.prediction[TIME])[2:4],
            f"{entry.prediction.slack:.0%}",
        )
        for entry in entries
    ]
    head = ("condition", "at y/L", "final speed", "90 % band", "time", "90 % band", "slack tail")
    yield from table(rows, head, ("", "", "m/s", "m/s", "ms", "ms", "of draws"), align="<<><><>")
    if any(entry.prediction.inputs.trial.payload_kg > 0 for entry in entries):
        yield "final speed: of the leading edge; at y/L = 1, of a payload as it leaves the vine"
    yield ""
    yield "uncertainties included:"
    sources = dict.fromkeys((share.name, share.words) for entry in entries for share in entry.prediction.shares)
    yield from (f"  {name}: {text}" for name, text in sources)
    yield ""
    hazards = dict.fromkeys(text for entry in entries for text in entry.hazards)
    for text in hazards:
        conditions = [entry.prediction.inputs.trial.condition for entry in entries if text in entry.hazards]
        yield f"! {'all conditions' if len(conditions) == len(entries) else ', '.join(conditions)}: {text}"


def _picture(prediction: VinePrediction) -> PredictionPicture:
    from vinetrack.figures.prediction_figures import PredictionPicture

    return PredictionPicture(
        title=describe_trial(prediction.inputs.trial),
        curve=prediction.curve,
        final_name=prediction.final.name,
        shares=[(share.name, share.low, share.high) for share in prediction.shares],
        final=(prediction.final.low, prediction.final.median, prediction.final.high),
    )


def _json_entry(entry: ConditionPrediction) -> dict[str, Any]:
    """Return one condition as JSON content, SI."""
    prediction = entry.prediction
    return {
        "condition": prediction.inputs.trial.condition,
        "model": list(prediction.inputs.model.names),
        "samples": prediction.samples,
        "inputs": [
            {"name": i.name, "unit": i.unit, "median": i.median, "low_90": i.low, "high_90": i.high, "from": i.origin}
            for i in prediction.inputs.bands()
        ],
        "quantities": [
            {
                "name": q.name,
                "y_over_L": q.y_over_L,
                "unit": q.unit,
                "median": q.median,
                "low_90": q.low,
                "high_90": q.high,
            }
            for q in prediction.quantities
        ],
        "uncertainties": [
            {"name": s.name, "words": s.words, "alone_low_90_m_s": s.low, "alone_high_90_m_s": s.high}
            for s in prediction.shares
        ],
        "left_out": [
            {"effect": n.effect, "size": n.size, "final_m_s": n.final_m_s, "without_m_s": n.without_m_s}
            for n in entry.neglected
        ],
        "arrives": prediction.arrives,
        "slack": prediction.slack,
        "warnings": list(entry.hazards),
    }
