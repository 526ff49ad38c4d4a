"""The command `vinetrack predict`: what vines not yet built will do, as lines, a figure, a CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number
from vinetrack.core.tables import STANDARD_OUTPUT, write_csv, write_json
from vinetrack.pipeline.prediction_inputs import (
    Asked,
    Ground,
    as_option,
    check_figure,
    input_rows,
    inputs_of,
    read_ground,
    shown,
    trial_words,
    unit_of,
    warnings_of,
    write_figure,
)
from vinetrack.results.folder_layout import ResultsError

if TYPE_CHECKING:
    from vinetrack.figures.prediction_figures import PredictionPicture
    from vinetrack.planning.design_checks import Neglected
    from vinetrack.planning.prediction import Quantity, VinePrediction

LEAST_N = 0.01
"""Largest force below which forces are shown in mN, N. Chosen: three digits then need no leading zeros."""

WORTH_SHOWING = 0.005
"""Relative change of the final speed below which an effect that is left out is not listed. Chosen: half a per cent is a
tenth of what a good measurement of speed resolves. At half the list grows by effects without weight, at twice some of
one per cent are missing."""


@dataclass(frozen=True)
class ConditionPrediction:
    """One condition: its prediction, what speaks against it, and what effects left out would change."""

    sight: VinePrediction
    hazards: tuple[str, ...]
    neglected: tuple[Neglected, ...]


def predict_conditions(
    asked: Asked,
    *,
    samples: int,
    seed: int,
    at_fraction: float,
    figure: Path | None = None,
    csv: Path | None = None,
    json: Path | None = None,
) -> list[str]:
    """Lines for the terminal; figure, curves and everything said are written where asked for.

    Parameters
    ----------
    asked
        Numbers, sheet, fit and effects of the command line.
    samples, seed : int
        Draws, and the seed of the random numbers.
    at_fraction : float
        y/L at which a bare vine's final speed is taken.
    figure, csv, json : Path, optional
        Where the figure, the curves and all numbers are written.

    Returns
    -------
    list of str

    Raises
    ------
    ExperimentError, ResultsError, EffectError
        If something asked for will not do; see `read_ground`.
    """
    import pandas as pd

    check_figure(figure)
    ground = read_ground(asked)
    predictions = _predict_all(ground, samples, seed, at_fraction)
    lines = [*_one(predictions[0])] if len(predictions) == 1 else [*_several(predictions)]
    lines += [f"! {words}" for words in warnings_of(ground)]
    if figure is not None:
        from vinetrack.figures.prediction_figures import draw_predictions

        write_figure(draw_predictions([_picture(prediction.sight) for prediction in predictions], at_fraction), figure)
        lines.append(f"Figure: {figure}")
    if csv is not None:
        write_csv(csv, pd.concat([prediction.sight.curve for prediction in predictions], ignore_index=True))
        lines.append(f"Curves: {csv}")
    if json is not None:
        write_json(json, [_entry(prediction) for prediction in predictions])
        lines.append(f"Everything: {json}")
    return [] if json == STANDARD_OUTPUT else lines


def _predict_all(ground: Ground, samples: int, seed: int, at_fraction: float) -> list[ConditionPrediction]:
    """Predict every condition.

    Raises
    ------
    ResultsError
        If a condition cannot be simulated, or the fit is not one of everting vines.
    """
    from vinetrack.core.terminal import progress
    from vinetrack.dynamics.simulate import SimulationError
    from vinetrack.effects import EffectError
    from vinetrack.planning.design_checks import design_checks, neglected
    from vinetrack.planning.prediction import predict_vine

    predictions = []
    try:
        for inputs in progress(inputs_of(ground), "predicting", unit="condition"):
            sight = predict_vine(inputs, samples=samples, seed=seed, at_fraction=at_fraction)
            predictions.append(ConditionPrediction(sight, design_checks(sight), neglected(inputs, at_fraction)))
    except SimulationError as error:
        raise ResultsError(f"{error} Leave an effect out, or give it another size.") from None
    except EffectError as error:
        raise as_option(error) from None
    return predictions


def _one(prediction: ConditionPrediction) -> Iterator[str]:
    """Everything about one condition."""
    from vinetrack.core.terminal import table

    sight = prediction.sight
    inputs = sight.inputs
    yield f"{trial_words(inputs.trial)}; {' + '.join(inputs.model.names)}"
    yield ""
    yield from table(input_rows(inputs.bands()), ("what goes in", "median", "90 % band", "unit", "from"), align="<><<<")
    yield ""
    rows = [_quantity_row(quantity) for quantity in sight.quantities]
    yield from table(rows, ("what comes out", "at y/L", "median", "90 % band", "unit"), align="<<><<")
    yield ""
    head = (f"uncertainties included ({sight.samples} draws)", "final speed by it alone", "why")
    yield from table([_share_row(share.name, share.low, share.high, share.words) for share in sight.shares], head)
    yield from _left_out(prediction)
    yield ""
    yield from (f"! {words}" for words in prediction.hazards)


def _quantity_row(quantity: Quantity) -> tuple[str, str, str, str, str]:
    """Name, place, median, band and unit; stresses in MPa, and forces in mN where all of them are that small."""
    place = "" if math.isnan(quantity.y_over_L) else f"{quantity.y_over_L:g}"
    values, unit = (quantity.low, quantity.median, quantity.high), quantity.unit
    if unit == "Pa":
        texts, unit = [number(value / 1e6) for value in values], "MPa"
    elif unit == "N" and max(abs(value) for value in values) < LEAST_N:
        texts, unit = [number(1e3 * value) for value in values], "mN"
    else:
        texts, unit = [shown(value, unit) for value in values], unit_of(unit)
    no_band = quantity.low == quantity.high or math.isnan(quantity.median)
    return quantity.name, place, texts[1], "–" if no_band else f"{texts[0]} to {texts[2]}", unit


def _share_row(name: str, low: float, high: float, words: str) -> tuple[str, str, str]:
    return name, f"{shown(low, 'm/s')} to {shown(high, 'm/s')} m/s", words


def _left_out(prediction: ConditionPrediction) -> Iterator[str]:
    """Effects that no vine is free of and the model leaves out, with what they would make of the final speed."""
    from vinetrack.core.terminal import table

    rows = [
        (
            effect_left_out.effect,
            effect_left_out.size,
            f"{shown(effect_left_out.without_m_s, 'm/s')} → {shown(effect_left_out.final_m_s, 'm/s')} m/s",
            f"{effect_left_out.change:+.1%}",
        )
        for effect_left_out in prediction.neglected
        if abs(effect_left_out.change) >= WORTH_SHOWING
    ]
    if rows:
        yield ""
        yield from table(rows, ("left out of the model", "if it were", "the final speed went", ""))


def _several(predictions: Sequence[ConditionPrediction]) -> Iterator[str]:
    """A row a condition."""
    from vinetrack.core.terminal import table
    from vinetrack.planning.prediction import TIME

    first = predictions[0].sight
    yield f"{' + '.join(first.inputs.model.names)}; medians and 90 % bands of {first.samples} draws"
    rows = [
        (
            prediction.sight.inputs.trial.condition,
            *_quantity_row(prediction.sight.final)[1:4],
            *_quantity_row(prediction.sight[TIME])[2:4],
            f"{prediction.sight.slack:.0%}",
        )
        for prediction in predictions
    ]
    head = ("condition", "at y/L", "final speed", "90 % band", "time", "90 % band", "slack tail")
    yield from table(rows, head, ("", "", "m/s", "m/s", "ms", "ms", "of draws"), align="<<><><>")
    if any(prediction.sight.inputs.trial.payload_kg > 0 for prediction in predictions):
        yield "final speed: of the leading edge; at y/L = 1, of a payload as it leaves the vine"
    yield ""
    yield "uncertainties included:"
    words = dict.fromkeys((share.name, share.words) for prediction in predictions for share in prediction.sight.shares)
    yield from (f"  {name}: {text}" for name, text in words)
    yield ""
    hazards = dict.fromkeys(text for prediction in predictions for text in prediction.hazards)
    for text in hazards:
        conditions = [
            prediction.sight.inputs.trial.condition for prediction in predictions if text in prediction.hazards
        ]
        yield f"! {'all conditions' if len(conditions) == len(predictions) else ', '.join(conditions)}: {text}"


def _picture(sight: VinePrediction) -> PredictionPicture:
    from vinetrack.figures.prediction_figures import PredictionPicture

    return PredictionPicture(
        title=trial_words(sight.inputs.trial),
        curve=sight.curve,
        final_name=sight.final.name,
        shares=[(share.name, share.low, share.high) for share in sight.shares],
        final=(sight.final.low, sight.final.median, sight.final.high),
    )


def _entry(prediction: ConditionPrediction) -> dict[str, Any]:
    """One condition as JSON holds it, SI."""
    sight = prediction.sight
    return {
        "condition": sight.inputs.trial.condition,
        "model": list(sight.inputs.model.names),
        "samples": sight.samples,
        "inputs": [
            {"name": i.name, "unit": i.unit, "median": i.median, "low_90": i.low, "high_90": i.high, "from": i.origin}
            for i in sight.inputs.bands()
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
            for q in sight.quantities
        ],
        "uncertainties": [
            {"name": s.name, "words": s.words, "alone_low_90_m_s": s.low, "alone_high_90_m_s": s.high}
            for s in sight.shares
        ],
        "left_out": [
            {"effect": n.effect, "size": n.size, "final_m_s": n.final_m_s, "without_m_s": n.without_m_s}
            for n in prediction.neglected
        ],
        "arrives": sight.arrives,
        "slack": sight.slack,
        "warnings": list(prediction.hazards),
    }
