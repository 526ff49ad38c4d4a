"""Names of vines and conditions, unique for each set of nominal settings.

Names list the settings and are valid file names: `24mm-200um-280mm` is a vine, `24mm-200um-280mm_28kPa_35.6g` a
condition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from vinetrack.core.records import Trial


def with_names(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return the trials with `vine` and `condition` filled in.

    The name of a condition always contains pressure and payload, and other physical settings only if they differ within
    the experiment (the yield pressure only if it differs within one vine). Settings that agree to six digits count as
    equal.

    Parameters
    ----------
    trials : all trials of an experiment.

    Returns
    -------
    the trials, in the same order.
    """
    shown = [further for further in _OPTIONAL_PARTS if len({further(trial) for trial in trials}) > 1]
    yields: dict[str, set[str]] = {}
    for trial in trials:
        yields.setdefault(_vine(trial), set()).add(_yield_pressure(trial))
    named = []
    for trial in trials:
        vine = _vine(trial)
        parts = [vine, f"{_digits(trial.pressure_Pa / 1000)}kPa", f"{_digits(trial.payload_kg * 1000)}g"]
        if len(yields[vine]) > 1:
            parts.append(_yield_pressure(trial))
        parts += filter(None, (further(trial) for further in shown))
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


def _bends(trial: Trial) -> str:
    bends = ("x".join(_digits(1000 * m) for m in (bend.start_m, bend.arc_m, bend.radius_m)) for bend in trial.bends)
    return f"bends{'-'.join(bends)}" if trial.bends else ""


_OPTIONAL_PARTS: tuple[Callable[[Trial], str], ...] = (
    lambda trial: f"{_digits(math.degrees(trial.growth_angle_rad))}deg",
    lambda trial: f"chamber{_digits(trial.chamber_m3 * 1000)}l" if math.isfinite(trial.chamber_m3) else "",
    lambda trial: f"inlet{_digits(trial.inlet_m * 1000)}mm" if math.isfinite(trial.inlet_m) else "",
    lambda trial: f"film{_digits(trial.film_density_kg_m3)}",
    lambda trial: f"ratio{_digits(trial.travel_ratio)}",
    _bends,
)
"""Parts of a condition's name that appear only if they differ within the experiment."""
