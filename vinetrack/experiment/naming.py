"""Names of vines and conditions, unique for each set of nominal settings.

Names list the settings and are valid file names: `24mm-200um-280mm` is a vine, `24mm-200um-280mm_28kPa_35.6g` a
condition.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from vinetrack.core.records import Trial
from vinetrack.experiment.column import Column
from vinetrack.experiment.schema import COLUMNS


def with_names(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return the trials with `vine` and `condition` filled in. The name of a condition always contains pressure and
    payload, and other physical settings only if they differ within the experiment (the yield pressure only if it
    differs within one vine). Returns the trials, in the same order.
    """
    shown = [column for column in _OPTIONAL_PARTS if len({_part(column, trial) for trial in trials}) > 1]
    yields: dict[str, set[str]] = {}
    for trial in trials:
        yields.setdefault(_vine(trial), set()).add(_yield_pressure(trial))
    named = []
    for trial in trials:
        vine = _vine(trial)
        parts = [vine, f"{_digits(trial.pressure_Pa / 1000)}kPa", f"{_digits(trial.payload_kg * 1000)}g"]
        if len(yields[vine]) > 1:
            parts.append(_yield_pressure(trial))
        parts += filter(None, (_part(column, trial) for column in shown))
        named.append(replace(trial, vine=vine, condition="_".join(parts)))
    return tuple(named)


def _digits(value: float) -> str:
    """Return a value to six digits, without exponent or trailing zeros.

    >>> _digits(28.000000004), _digits(0.5), _digits(100000.0)
    ('28', '0.5', '100000')
    """
    text = f"{float(f'{value:.6g}'):.12f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _vine(trial: Trial) -> str:
    """Name of a trial's vine: diameter, thickness and length, unknown ones left out."""
    sizes = ((trial.diameter_m * 1e3, "mm"), (trial.thickness_m * 1e6, "um"), (trial.length_m * 1e3, "mm"))
    return "-".join(f"{_digits(size)}{unit}" for size, unit in sizes if math.isfinite(size))


def _yield_pressure(trial: Trial) -> str:
    return f"yield{_digits(trial.yield_pressure_Pa / 1000)}kPa"


def _part(column: Column, trial: Trial) -> str:
    """Return the part of a condition's name that shows a column; blank where the trial has no value."""
    if column.kind == "bends":
        value = "-".join("x".join(_digits(1000 * m) for m in (b.start_m, b.arc_m, b.radius_m)) for b in trial.bends)
    else:
        number = column.of_trial(trial)
        value = _digits(number) if math.isfinite(number) else ""
    return column.condition_part.format(value) if value else ""


# Columns that a condition's name shows only if they differ within the experiment; bends, the longest part, last
_OPTIONAL_PARTS = sorted(
    (column for column in COLUMNS.values() if column.condition_part), key=lambda column: column.kind == "bends"
)
