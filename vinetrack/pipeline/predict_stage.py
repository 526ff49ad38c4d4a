"""The command `vinetrack predict`: what vines not yet built will do, as lines, a figure, a CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number
from vinetrack.core.tables import write_csv, write_json
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
WORTH_SHOWING = 0.005
"""Relative change of the final speed below which an effect that is left out is not listed."""


@dataclass(frozen=True)
class Foretold:
    """One condition: what is foretold, what speaks against it, and what effects left out would change."""

    sight: VinePrediction
    hazards: tuple[str, ...]
    neglected: tuple[Neglected, ...]


def foretell(
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

    Raises
    ------
    ExperimentError, ResultsError, EffectError
        If something asked for will not do; see `read_ground`.
    """
    import pandas as pd

    check_figure(figure)
    ground = read_ground(asked)
    found = foresee_all(ground, samples, seed, at_fraction)
    lines = [*_one(found[0])] if len(found) == 1 else [*_several(found)]
    lines += [f"! {words}" for words in warnings_of(ground)]
    if figure is not None:
        from vinetrack.figures.prediction_figures import draw_foresight

        write_figure(draw_foresight([_picture(one.sight) for one in found], at_fraction), figure)
        lines.append(f"Figure: {figure}")
    if csv is not None:
        write_csv(csv, pd.concat([one.sight.curve for one in found], ignore_index=True))
        lines.append(f"Curves: {csv}")
    if json is not None:
        write_json(json, [_entry(one) for one in found])
        lines.append(f"Everything: {json}")
    return lines


def foresee_all(ground: Ground, samples: int, seed: int, at_fraction: float) -> list[Foretold]:
    """Foretell every condition.

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

    found = []
    try:
        for inputs in progress(inputs_of(ground), "predicting", unit="condition"):
            sight = predict_vine(inputs, samples=samples, seed=seed, at_fraction=at_fraction)
            found.append(Foretold(sight, design_checks(sight), neglected(inputs, at_fraction)))
    except SimulationError as error:
        raise ResultsError(f"{error} Leave an effect out, or give it another size.") from None
    except EffectError as error:
        raise as_option(error) from None
    return found


def _one(found: Foretold) -> Iterator[str]:
    """Everything about one condition."""
    from vinetrack.core.terminal import table

    sight = found.sight
    inputs = sight.inputs
    yield f"{trial_words(inputs.trial)}; {' + '.join(inputs.model.names)}"
    yield ""
    yield from table(input_rows(inputs.bands()), ("what goes in", "median", "90 % band", "unit", "from"), align="<><<<")
    yield ""
    rows = [_quantity_row(one) for one in sight.quantities]
    yield from table(rows, ("what comes out", "at y/L", "median", "90 % band", "unit"), align="<<><<")
    yield ""
    head = (f"uncertainties included ({sight.samples} draws)", "final speed by it alone", "why")
    yield from table([_share_row(share.name, share.low, share.high, share.words) for share in sight.shares], head)
    yield from _left_out(found)
    yield ""
    yield from (f"! {words}" for words in found.hazards)


def _quantity_row(one: Quantity) -> tuple[str, str, str, str, str]:
    """Name, place, median, band and unit; stresses in MPa, and forces in mN where all of them are that small."""
    place = "" if math.isnan(one.y_over_L) else f"{one.y_over_L:g}"
    values, unit = (one.low, one.median, one.high), one.unit
    if unit == "Pa":
        texts, unit = [number(value / 1e6) for value in values], "MPa"
    elif unit == "N" and max(abs(value) for value in values) < LEAST_N:
        texts, unit = [number(1e3 * value) for value in values], "mN"
    else:
        texts, unit = [shown(value, unit) for value in values], unit_of(unit)
    no_band = one.low == one.high or math.isnan(one.median)
    return one.name, place, texts[1], "–" if no_band else f"{texts[0]} to {texts[2]}", unit


def _share_row(name: str, low: float, high: float, words: str) -> tuple[str, str, str]:
    return name, f"{shown(low, 'm/s')} to {shown(high, 'm/s')} m/s", words


def _left_out(found: Foretold) -> Iterator[str]:
    """Effects that no vine is free of and the model leaves out, with what they would make of the final speed."""
    from vinetrack.core.terminal import table

    rows = [
        (
            one.effect,
            one.size,
            f"{shown(one.without_m_s, 'm/s')} → {shown(one.final_m_s, 'm/s')} m/s",
            f"{one.change:+.1%}",
        )
        for one in found.neglected
        if abs(one.change) >= WORTH_SHOWING
    ]
    if rows:
        yield ""
        yield from table(rows, ("left out of the model", "if it were", "the final speed went", ""))


def _several(found: Sequence[Foretold]) -> Iterator[str]:
    """A row a condition."""
    from vinetrack.core.terminal import table
    from vinetrack.planning.prediction import TIME

    yield f"{' + '.join(found[0].sight.inputs.model.names)}; medians and 90 % bands of {found[0].sight.samples} draws"
    rows = [
        (
            one.sight.inputs.trial.condition,
            *_quantity_row(one.sight.final)[1:4],
            *_quantity_row(one.sight[TIME])[2:4],
            f"{one.sight.slack:.0%}",
        )
        for one in found
    ]
    head = ("condition", "at y/L", "final speed", "90 % band", "time", "90 % band", "slack tail")
    yield from table(rows, head, ("", "", "m/s", "m/s", "ms", "ms", "of draws"), align="<<><><>")
    if any(one.sight.inputs.trial.payload_kg > 0 for one in found):
        yield "final speed: of the leading edge; at y/L = 1, of a payload as it leaves the vine"
    yield ""
    yield "uncertainties included:"
    words = dict.fromkeys((share.name, share.words) for one in found for share in one.sight.shares)
    yield from (f"  {name}: {text}" for name, text in words)
    yield ""
    said = dict.fromkeys(text for one in found for text in one.hazards)
    for text in said:
        conditions = [one.sight.inputs.trial.condition for one in found if text in one.hazards]
        yield f"! {'all conditions' if len(conditions) == len(found) else ', '.join(conditions)}: {text}"


def _picture(sight: VinePrediction) -> PredictionPicture:
    from vinetrack.figures.prediction_figures import PredictionPicture

    return PredictionPicture(
        title=trial_words(sight.inputs.trial),
        curve=sight.curve,
        final_name=sight.final.name,
        shares=[(share.name, share.low, share.high) for share in sight.shares],
        final=(sight.final.low, sight.final.median, sight.final.high),
    )


def _entry(found: Foretold) -> dict[str, Any]:
    """One condition as JSON holds it, SI."""
    sight = found.sight
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
            for n in found.neglected
        ],
        "arrives": sight.arrives,
        "slack": sight.slack,
        "warnings": list(found.hazards),
    }
