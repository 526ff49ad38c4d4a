"""The command `vinetrack design reservoir`: the chamber that keeps the gauge pressure within so many per cent."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.pipeline.prediction_inputs import (
    Asked,
    as_option,
    beliefs_of,
    check_figure,
    litres,
    read_ground,
    shown,
    trial_words,
    write_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.planning.predictive_inputs import PredictiveInputs
    from vinetrack.planning.reservoir_design import Chamber

SIZED = ("diameter_mm", "length_mm", "pressure_kPa")


def design_reservoir(
    asked: Asked, *, within_percent: float, supply_s: float | None, at_fraction: float, figure: Path | None = None
) -> list[str]:
    """Lines for the terminal about the chambers worth looking at; the figure is written where asked for.

    Speeds are told where the wall is given, so that there is a vine to simulate.

    Raises
    ------
    ExperimentError, ResultsError, EffectError
        If something asked for will not do.
    """
    from vinetrack.core.terminal import waiting
    from vinetrack.effects import EffectError

    check_figure(figure)
    ground = read_ground(asked, needed=SIZED)
    trial = ground.planned.trials[0]
    belief = beliefs_of(ground)[0] if math.isfinite(trial.thickness_m) else None
    loss = within_percent / 100
    try:
        with waiting("simulating"):
            lines = [*_lines(trial, belief, loss, at_fraction)]
            if supply_s is not None and belief is not None:
                lines += _supplied(belief, loss, supply_s)
    except EffectError as error:
        raise as_option(error) from None
    if supply_s is not None and belief is None:
        lines.append("! how fast the vine draws gas depends on its wall: give --thickness-um to use --supply-s")
    if figure is not None:
        write_figure(_picture(trial, loss), figure)
        lines.append(f"Figure: {figure}")
    return lines


def _lines(trial: Trial, belief: PredictiveInputs | None, loss: float, at_fraction: float) -> Iterator[str]:
    from vinetrack.core.terminal import table
    from vinetrack.planning.reservoir_design import GAMMAS, chambers, swept_m3

    words = (
        trial_words(trial)
        if belief is not None
        else (f"{1e3 * trial.diameter_m:.4g} mm × {1e3 * trial.length_m:.4g} mm at {trial.pressure_Pa / 1e3:.4g} kPa")
    )
    yield f"{words}: it sweeps {litres(swept_m3(trial))}"
    yield f"closed chamber that keeps the gauge pressure within {100 * loss:g} %, by the gas law in absolute pressure"
    yield ""
    found = chambers(trial, loss)
    rows = [_row(one, belief, at_fraction) for one in found]
    laws = [law.split(",")[0] for law in GAMMAS]
    speeds = [f"speed, {law}" for law in laws] if belief is not None else []
    head = ("chamber", "volume", *(f"loses, {law}" for law in laws), *speeds)
    yield from table(rows, head, ("", "", "% of gauge", "% of gauge", *["m/s"] * len(speeds)), align="<>" + ">" * 4)
    if belief is not None:
        steady = _final(belief, math.inf, 1.0, at_fraction)
        place = "" if trial.payload_kg > 0 else f" at y/L = {at_fraction:g}"
        yield f"speed: final speed at the medians{place}; {shown(steady, 'm/s')} m/s at constant pressure"
    yield ("slow: γ = 1, the gas stays at room temperature; fast: γ = 1.4, it takes up no heat, as within milliseconds")


def _row(one: Chamber, belief: PredictiveInputs | None, at_fraction: float) -> tuple[str, ...]:
    from vinetrack.planning.reservoir_design import GAMMAS

    losses = [f"{100 * share:.1f}" for share in one.losses.values()]
    speeds = (
        []
        if belief is None
        else [shown(_final(belief, one.volume_m3, gamma, at_fraction), "m/s") for gamma in GAMMAS.values()]
    )
    return one.name, litres(one.volume_m3), *losses, *speeds


def _final(belief: PredictiveInputs, volume_m3: float, gamma: float, at_fraction: float) -> float:
    from vinetrack.planning.design_checks import final_m_s, whole_model
    from vinetrack.planning.reservoir_design import final_with

    if math.isinf(volume_m3):
        return final_m_s(belief, belief.model, whole_model(belief.model), at_fraction)
    return final_with(belief, volume_m3, gamma, at_fraction)


def _supplied(belief: PredictiveInputs, loss: float, supply_s: float) -> list[str]:
    from vinetrack.planning.reservoir_design import GAMMAS, supplied_chamber

    volumes = {law.split(",")[0]: supplied_chamber(belief, loss, supply_s, gamma) for law, gamma in GAMMAS.items()}
    words = ", ".join(f"{litres(volume) if volume > 0 else 'none'} ({law})" for law, volume in volumes.items())
    return [f"with a supply that closes the gap in {1e3 * supply_s:g} ms, at the medians: {words}"]


def _picture(trial: Trial, loss: float) -> Figure:
    import numpy as np

    from vinetrack.figures.design_figures import GasLawLoss, draw_reservoir
    from vinetrack.planning.reservoir_design import GAMMAS, chambers, gauge_loss, swept_m3

    swept = swept_m3(trial)
    volumes = swept * np.geomspace(3.0, 300.0, 200)
    laws = [
        GasLawLoss(
            name,
            np.array([
                gauge_loss(trial.pressure_Pa, swept, float(volume), gamma, trial.ambient_pressure_Pa)
                for volume in volumes
            ]),
        )
        for name, gamma in GAMMAS.items()
    ]  # fmt: skip
    asked = [one for one in chambers(trial, loss) if one.name == "asked about"]
    return draw_reservoir(volumes, laws, loss, swept, asked[0].volume_m3 if asked else None)
