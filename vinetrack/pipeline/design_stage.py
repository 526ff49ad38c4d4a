"""The commands `vinetrack design vine` and `vinetrack design reservoir`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Trial
from vinetrack.core.terminal import table, waiting
from vinetrack.dynamics.model import host_for
from vinetrack.experiment.schema import COLUMNS, CellError, option, read_cell
from vinetrack.figures.prediction_figures import draw_choice, draw_reservoir
from vinetrack.pipeline.predict_stage import (
    PredictionRequest,
    check_figure,
    describe_trial,
    display_value,
    format_volume,
    planning_errors,
    read_basis,
    speed_band,
    write_figure,
)
from vinetrack.planning.prediction import (
    GAMMAS,
    Choice,
    Room,
    chambers,
    design_checks,
    fastest,
    final_m_s,
    final_with,
    gauge_loss,
    supplied_chamber,
    swept_m3,
)
from vinetrack.planning.predictive_inputs import PredictiveInputs, hoop_stress_Pa

FILMS = "--films-um"


def read_range(column: str, text: str) -> tuple[float, float]:
    """Read a range from `low:high` or one number, each checked like a cell of the column. Returns low, high : float,
    SI.
    """
    values = [_cell(column, part) for part in text.split(":")]
    if len(values) > 2:
        raise _refusal(column, text, "is not a range", "write low:high, such as 5:25")
    if values[0] > values[-1]:
        raise _refusal(column, text, "ends before it begins", "write the lower value first")
    return values[0], values[-1]


def read_list(column: str, text: str, name: str = "") -> tuple[float, ...]:
    """Read a list of numbers joined by commas, each checked like a cell of the column. Returns without repetitions."""
    return tuple(dict.fromkeys(_cell(column, part, name) for part in text.split(",") if part.strip()))


def _cell(column: str, text: str, name: str = "") -> float:
    """Read one number of a column; return it in SI."""
    try:
        value = read_cell(COLUMNS[column], text.strip())
    except CellError as error:
        raise _refusal(column, text, error.message, error.remedy, error.allowed, name) from None
    assert isinstance(value, float)
    return COLUMNS[column].to_si(value)


def _refusal(column: str, text: str, message: str, remedy: str, allowed: str = "", name: str = "") -> ExperimentError:
    problem = Problem(message=message, column=name or option(column), value=text, allowed=allowed, remedy=remedy)
    return ExperimentError([problem])


def design_vine(
    request: PredictionRequest,
    *,
    films: str,
    diameter: str,
    length: str,
    burst_share: float,
    burst_stress_MPa: float,
    samples: int,
    seed: int,
    at_fraction: float,
    figure: Path | None = None,
) -> tuple[list[str], dict[str, Any]]:
    """Find the fastest vine of every film; draw the choice if requested. Returns lines, and JSON content."""
    check_figure(figure)
    basis = read_basis(request, needed=("pressure_kPa",))
    room = Room(
        films_m=read_list("thickness_um", films, FILMS),
        diameter_m=read_range("diameter_mm", diameter),
        length_m=read_range("length_mm", length),
        pressure_Pa=basis.planned.trials[0].pressure_Pa,
        rig=basis.planned.trials[0],
        burst_share=burst_share,
        burst_stress_Pa=1e6 * burst_stress_MPa,
    )
    max_films = 12  # Largest number of films (chosen)
    if not 0 < len(room.films_m) <= max_films:
        raise _refusal("thickness_um", films, f"names {len(room.films_m)} films", f"name 1 to {max_films}", name=FILMS)
    thickest_m = max(room.films_m)
    if thickest_m > room.diameter_m[0] / 4:
        message = f"begins below four times the thickest film, {1e6 * thickest_m:g} µm"
        raise _refusal("diameter_mm", diameter, message, f"begin at {4e3 * thickest_m:g} mm or more")
    with planning_errors(), waiting("looking for the fastest vine"):
        choices = fastest(room, basis.stated, basis.fit, samples=samples, seed=seed, at_fraction=at_fraction)
    _refuse_standstill(room, choices)
    lines = [*basis.heading, *_vine_lines(room, choices)]
    if figure is not None:
        write_figure(draw_choice(choices), figure)
        lines.append(f"Figure: {figure}")
    return lines, {"warnings": basis.heading, "films": [_choice_entry(choice) for choice in choices]}


def _choice_entry(choice: Choice) -> dict[str, Any]:
    """Return the fastest vine of one film as JSON content, units in the keys."""
    trial, final = choice.prediction.inputs.trial, choice.prediction.final
    speed = {"y_over_L": final.y_over_L, "median": final.median, "low_90": final.low, "high_90": final.high}
    return {
        "thickness_um": 1e6 * trial.thickness_m,
        "diameter_mm": 1e3 * trial.diameter_m,
        "length_mm": 1e3 * trial.length_m,
        "pressure_kPa": trial.pressure_Pa / 1e3,
        "final_speed_m_s": speed,
        "fastest_in_share_of_draws": choice.odds,
        "limited_by": list(choice.limits),
    }


def _refuse_standstill(room: Room, choices: Sequence[Choice]) -> None:
    """Refuse a design in which no vine reaches its end at the medians of the predictive inputs."""
    if choices[0].prediction.final.median > 0:
        return
    highest_Pa = max(choice.prediction.inputs.trial.pressure_Pa for choice in choices)
    yield_kPa = choices[0].prediction.inputs.trial.yield_pressure_Pa / 1e3
    message = f"moves none of these vines to its end, against a yield pressure of {yield_kPa:.3g} kPa"
    remedy = "raise it, or give a lower yield pressure as --yield-pressure-kPa"
    if highest_Pa < 0.995 * room.pressure_Pa:
        message += f": their walls may carry at most {highest_Pa / 1e3:.3g} kPa"
        remedy = "raise --burst-fraction, or allow thicker films or smaller diameters"
    raise _refusal("pressure_kPa", f"{room.pressure_Pa / 1e3:g}", message, remedy)


def _vine_lines(room: Room, choices: Sequence[Choice]) -> Iterator[str]:
    best = choices[0].prediction
    yield (
        f"fastest by {best.final.name}"
        + ("" if best.final.y_over_L == 1 else f" at y/L = {best.final.y_over_L:g}")
        + f"; hoop stress up to {room.burst_share:.0%} of {room.burst_stress_Pa / 1e6:g} MPa, supply up to "
        f"{room.pressure_Pa / 1e3:g} kPa"
    )
    yield ""
    rows = []
    for choice in choices:
        trial, final = choice.prediction.inputs.trial, choice.prediction.final
        rows.append(
            (
                f"{1e6 * trial.thickness_m:g}",
                f"{1e3 * trial.diameter_m:.3g}",
                f"{1e3 * trial.length_m:.3g}",
                f"{trial.pressure_Pa / 1e3:.3g}",
                f"{hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m) / 1e6:.2f}",
                display_value(final.median, "m/s"),
                f"{display_value(final.low, 'm/s')} to {display_value(final.high, 'm/s')}",
                f"{choice.odds:.0%}",
                ", ".join(choice.limits),
            )
        )
    head = ("film", "diameter", "length", "pressure", "PD/2t", "speed", "90 % band", "fastest", "limited by")
    yield from table(rows, head, ("µm", "mm", "mm", "kPa", "MPa", "m/s", "m/s", "of draws", ""), align=">>>>>><><")
    yield ""
    if choices[0].odds < 0.8 and len(choices) > 1:
        yield (
            f"the choice of film is uncertain: {1e6 * choices[0].thickness_m:g} µm is the fastest in only "
            f"{choices[0].odds:.0%} of the draws; measuring B and P_y of the first two films would decide it"
        )
    yield f"uncertainty budget of the fastest, {describe_trial(best.inputs.trial)}: final speed by each input alone"
    yield from table([(f"  {share.name}", speed_band(share), share.words) for share in best.shares])
    yield "  not included: the burst stress, a guess from one vine, and effects not in the model (`vinetrack predict`)"
    yield from (f"! {warning}" for warning in design_checks(best))


def design_reservoir(
    request: PredictionRequest,
    *,
    within_percent: float,
    supply_s: float,
    at_fraction: float,
    figure: Path | None = None,
) -> tuple[list[str], dict[str, Any]]:
    """Find the chamber that limits the loss of gauge pressure; draw the loss against volume if requested. Speeds are
    predicted if the wall thickness is given. Returns lines, and JSON content.
    """
    check_figure(figure)
    basis = read_basis(request, needed=("diameter_mm", "length_mm", "pressure_kPa"))
    trial = basis.planned.trials[0]
    loss = within_percent / 100
    with planning_errors(), waiting("simulating"):
        inputs = basis.inputs[0] if math.isfinite(trial.thickness_m) else None
        lines = [*basis.heading, *_reservoir_lines(trial, inputs, loss, at_fraction)]
        if math.isfinite(supply_s) and inputs is not None:
            volumes = {law: supplied_chamber(inputs, loss, supply_s, gamma) for law, gamma in GAMMAS.items()}
            needed = ", ".join(
                f"{format_volume(volume) if volume > 0 else 'none'} ({law.split(',')[0]})"
                for law, volume in volumes.items()
            )
            lines.append(f"with a supply that refills the chamber in {1e3 * supply_s:g} ms, at the medians: {needed}")
    if math.isfinite(supply_s) and inputs is None:
        lines.append("! --supply-s needs --thickness-um: how fast the vine takes up gas depends on its wall")
    if figure is not None:
        swept = swept_m3(trial)
        drawn_m3 = swept * np.geomspace(3.0, 300.0, 200)
        losses = {
            law: np.array([gauge_loss(trial, volume_m3, gamma) for volume_m3 in drawn_m3.tolist()])
            for law, gamma in GAMMAS.items()
        }
        write_figure(draw_reservoir(drawn_m3, losses, loss, swept, trial.chamber_m3), figure)
        lines.append(f"Figure: {figure}")
    entries = [
        {
            "chamber": name,
            "volume_l": 1e3 * volume_m3,
            "loss_of_gauge_pressure": {law: gauge_loss(trial, volume_m3, gamma) for law, gamma in GAMMAS.items()},
        }
        for name, volume_m3 in chambers(trial, loss).items()
    ]
    return lines, {"warnings": basis.heading, "chambers": entries}


def _reservoir_lines(trial: Trial, inputs: PredictiveInputs | None, loss: float, at_fraction: float) -> Iterator[str]:
    size = f"{1e3 * trial.diameter_m:.4g} mm × {1e3 * trial.length_m:.4g} mm at {trial.pressure_Pa / 1e3:.4g} kPa"
    description = size if inputs is None else describe_trial(trial)
    yield f"{description}: it sweeps {format_volume(swept_m3(trial))}"
    yield f"closed chamber that keeps the gauge pressure within {100 * loss:g} %, by the gas law in absolute pressure"
    yield ""
    laws = [law.split(",")[0] for law in GAMMAS]
    rows, speeds = [], [] if inputs is None else [f"speed, {law}" for law in laws]
    for name, volume_m3 in chambers(trial, loss).items():
        cells = [name, format_volume(volume_m3)]
        cells += [f"{100 * gauge_loss(trial, volume_m3, gamma):.1f}" for gamma in GAMMAS.values()]
        if inputs is not None:
            finals = [final_with(inputs, volume_m3, gamma, at_fraction) for gamma in GAMMAS.values()]
            cells += [display_value(final, "m/s") for final in finals]
        rows.append(cells)
    head = ("chamber", "volume", *(f"loses, {law}" for law in laws), *speeds)
    yield from table(rows, head, ("", "", "% of gauge", "% of gauge", *["m/s"] * len(speeds)), align="<>" + ">" * 4)
    if inputs is not None:
        steady = final_m_s(inputs, inputs.model, host_for(inputs.model), at_fraction)
        place = "" if trial.payload_kg > 0 else f" at y/L = {at_fraction:g}"
        yield f"speed: final speed at the medians{place}; {display_value(steady, 'm/s')} m/s at constant pressure"
    yield "slow: γ = 1, isothermal; fast: γ = 1.4, adiabatic, as within milliseconds"
