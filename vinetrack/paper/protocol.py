"""Rows of the table about the protocol: the vines of Table I, their fabrication, and how trials were run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.paper.rows import NOT_CHECKABLE, SIMULATED, PaperRow


def protocol_rows(trials: Sequence[Trial], steady: pd.DataFrame, mark: str) -> Iterator[PaperRow]:
    """Compare the protocol of an experiment with that of the paper."""
    source = "an input: the virtual trials were grown with it" if mark == SIMULATED else "as the trial sheet says"
    bare = [trial for trial in trials if trial.payload_kg == 0 and trial.travel_ratio == 2]
    by_scale = {
        scale: [t for t in bare if published.scale_of(1e3 * t.diameter_m, 1e6 * t.thickness_m) == scale]
        for scale in published.DAMPING_B
    }
    for scale, of_scale in by_scale.items():
        yield from _size_rows(scale, of_scale, mark, source)
    for scale, of_scale in by_scale.items():
        yield from _campaign_rows(scale, of_scale, mark, source)
    yield _capture_row(trials, mark, source)
    yield from _window_rows({trial.name for of_scale in by_scale.values() for trial in of_scale}, steady, mark)


def _size_rows(scale: int, of_scale: Sequence[Trial], mark: str, source: str) -> Iterator[PaperRow]:
    sizes = (
        ("thickness", "wall thickness", "µm", published.THICKNESS_UM, [1e6 * trial.thickness_m for trial in of_scale]),
        ("diameter", "diameter", "mm", published.DIAMETER_MM, [1e3 * trial.diameter_m for trial in of_scale]),
    )
    for name, quantity, unit, printed, ours in sizes:
        yield PaperRow(
            row=f"{name}_R{scale}",
            where="Table I",
            quantity=quantity,
            setting=f"R = {scale}",
            unit=unit,
            published=printed[scale],
            ours=float(np.mean(ours)) if ours else math.nan,
            mark=mark,
            how=source,
        )
    settings = (
        ("press", "temperature of the heat press", "°C", published.PRESS_TEMPERATURE_DEGC),
        ("laser", "power of the laser cutter", "%", published.LASER_POWER_PERCENT),
    )
    for name, quantity, unit, printed in settings:
        yield PaperRow(
            row=f"{name}_R{scale}",
            where="Table I",
            quantity=quantity,
            setting=f"R = {scale}",
            unit=unit,
            published=printed[scale],
            mark=NOT_CHECKABLE,
            how="a setting of the authors' machines; nothing follows from it",
        )


def _campaign_rows(scale: int, of_scale: Sequence[Trial], mark: str, source: str) -> Iterator[PaperRow]:
    pressures: dict[float, int] = {}
    for trial in of_scale:
        pressures[round(trial.pressure_Pa, 3)] = pressures.get(round(trial.pressure_Pa, 3), 0) + 1
    low, high = published.CONDITIONS
    yield PaperRow(
        row=f"pressures_R{scale}",
        where="Section III-D",
        quantity="pressures without payload",
        setting=f"R = {scale}",
        as_printed=f"{low} to {high}",
        ours=float(len(pressures)) if of_scale else math.nan,
        mark=mark,
        how=f"{source}; which pressures is not printed",
    )
    low, high = published.TRIALS
    yield PaperRow(
        row=f"trials_R{scale}",
        where="Section III-D",
        quantity="trials of each pressure",
        setting=f"R = {scale}",
        as_printed=f"{low} to {high}",
        ours=float(np.median(list(pressures.values()))) if of_scale else math.nan,
        mark=mark,
        how=source,
    )


def _capture_row(trials: Sequence[Trial], mark: str, source: str) -> PaperRow:
    rates = [trial.capture_fps for trial in trials if math.isfinite(trial.capture_fps)]
    return PaperRow(
        row="capture_fps",
        where="Section III-D",
        quantity="frames a second",
        unit="1/s",
        published=published.CAPTURE_FPS,
        ours=float(np.median(rates)) if rates else math.nan,
        mark=mark,
        how=source,
    )


def _window_rows(names: set[str], steady: pd.DataFrame, mark: str) -> Iterator[PaperRow]:
    """What the published rule for a steady window accepts in trials without payload, and the gated rule."""
    windows = steady[steady["trial"].isin(names)]
    literal, gated = windows[windows["rule"] == "paper"], windows[windows["rule"] == "gated"]
    accepted = literal[literal["accepted"]]
    drift = accepted["drift"].abs()
    row_of = partial(PaperRow, where="Section III-E", setting="trials of R = 1…4 without payload", mark=mark)
    yield row_of(
        row="window_fewest_points",
        quantity="fewest points in a steady window",
        as_printed=f"at least {published.STEADY_FEWEST_POINTS}",
        ours=float(accepted["points"].min()) if len(accepted) else math.nan,
        how=f"the published rule to the letter, N = {len(accepted)} windows",
        beside="noise alone makes three velocities in a row agree to 3 % somewhere",
    )
    yield row_of(
        row="window_largest_cv",
        quantity="largest coefficient of variation of velocity in a steady window",
        unit="%",
        published=100 * published.STEADY_CV,
        as_printed=f"below {100 * published.STEADY_CV:g}",
        ours=100 * float(accepted["cv"].max()) if len(accepted) else math.nan,
        how="the published rule to the letter",
        beside=f"a speed may drift within it: by up to {100 * drift.max():.1f} % across the window"
        if len(drift)
        else "",
    )
    yield row_of(
        row="window_share_accepted",
        quantity="trials in which the published rule finds a steady window",
        unit="%",
        as_printed="not printed",
        ours=100 * float(literal["accepted"].mean()) if len(literal) else math.nan,
        how="chosen by hand there, the longest run here",
        beside=f"the gated rule finds one in {100 * gated['accepted'].mean():.0f} %" if len(gated) else "",
    )
