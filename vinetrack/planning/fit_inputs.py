"""What a fit knows, in the form in which predictions draw from it: numbers, their covariance, spreads.

Taken from a `Fit`, or from what `fit.json` keeps of one. B is held as its logarithm, as in the fit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit

FEWEST_TO_SPARE = 3
"""Degrees of freedom that a spread has at least: a fit does not estimate it with fewer trials to spare. Derived: below
three the t distribution has no variance."""

NORMAL_95 = 1.959963984540054
"""Standard normal quantile of 0.975."""

_VINE = re.compile(r"([\d.]+)mm-([\d.]+)um(?:-([\d.]+)mm)?")


@dataclass(frozen=True)
class FitNumbers:
    """The numbers of a fit; `keys` and `vines` name them, `log` marks those held as logarithms.

    `mean`, `covariance` are those of the numbers of the next trial as held, what trials differ by included; numbers
    that the fit left open have a variance of 0 and stand in `open`. The covariance is stretched so that its normal 95 %
    are the fit's own, which take Student's t. `spreads` are those of pressure and B from trial to trial, relative, and
    `spread_dof` their degrees of freedom, infinite where they were told to the fit.
    """

    source: str
    model: tuple[str, ...]
    keys: tuple[str, ...]
    vines: tuple[str, ...]
    log: np.ndarray
    mean: Floats
    covariance: Floats
    open: tuple[str, ...]
    spreads: Mapping[str, float]
    spread_dof: Mapping[str, float]
    n_trials: int

    def place(self, key: str, vine: str = "") -> int | None:
        """Where a number stands, for all vines or for this one; None where it does not.

        Parameters
        ----------
        key : str
            Name of a parameter, `effect.parameter`.
        vine : str
            Name of a vine.

        Returns
        -------
        int or None
        """
        for k, (own_key, own_vine) in enumerate(zip(self.keys, self.vines, strict=True)):
            if own_key == key and own_vine in ("", vine):
                return k
        return None

    def sizes(self) -> dict[str, tuple[float, float]]:
        """Diameter and thickness, m, of every vine that has a B of its own."""
        sizes = {}
        for key, vine in zip(self.keys, self.vines, strict=True):
            if key == DAMPING and (size := size_of(vine)):
                sizes[vine] = size
        return sizes


def size_of(vine: str) -> tuple[float, float] | None:
    """Diameter and thickness in metres out of the name of a vine; None where it does not say.

    Parameters
    ----------
    vine : str
        Name as `vinetrack.experiment.naming` gives it.

    Returns
    -------
    (float, float) or None

    Examples
    --------
    >>> size_of("24mm-200um-280mm")
    (0.024, 0.0002)
    """
    match = _VINE.match(vine)
    return (float(match[1]) / 1e3, float(match[2]) / 1e6) if match else None


def fit_numbers(content: Mapping[str, Any], source: str) -> FitNumbers:
    """Numbers of a fit from what `fit.json` holds.

    Parameters
    ----------
    content : mapping
        What `fit.json` holds.
    source : str
        Named in messages and origins.

    Returns
    -------
    FitNumbers

    Raises
    ------
    FitError
        If there is no fit in it.
    """
    if content.get("refused"):
        raise FitError(f"{source} holds no fit to predict from: {content['refused']}")
    numbers = content["numbers"]
    if not numbers:
        raise FitError(f"{source} holds a fit without numbers: there is nothing to predict from.")
    covariance = np.array([[_number(cell) for cell in row] for row in content["covariance"]], dtype=float)
    values = np.array([number["value"] for number in numbers], dtype=float)
    log = np.array([number["parameter"] == DAMPING and number["value"] > 0 for number in numbers], dtype=bool)
    slopes = np.where(log, 1 / np.where(log, values, 1.0), 1.0)
    stretch = np.array(
        [_stretch(number, bool(is_log)) for number, is_log in zip(numbers, log, strict=True)], dtype=float
    )
    between = np.array([[_number(cell) for cell in row] for row in content.get("between_trials") or ()], dtype=float)
    known = np.isfinite(np.diag(covariance))
    if between.shape == covariance.shape:
        # What is predicted is a trial, whose numbers differ from the shared ones.
        covariance = covariance + np.nan_to_num(between)
    spare = float(max(len(content["trials"]) - len(numbers), FEWEST_TO_SPARE))
    held = np.where(known, slopes * stretch, 0.0)
    return FitNumbers(
        source=source,
        model=tuple(content["model"]),
        keys=tuple(number["parameter"] for number in numbers),
        vines=tuple(number["vine"] for number in numbers),
        log=log,
        mean=np.where(log, np.log(np.where(log, values, 1.0)), values),
        covariance=np.nan_to_num(covariance, nan=0.0, posinf=0.0, neginf=0.0) * held[:, None] * held,
        open=tuple(number["symbol"] for number, is_known in zip(numbers, known, strict=True) if not is_known),
        spreads={name: float(spread["value"]) for name, spread in content["spreads"].items()},
        spread_dof={name: spare if spread["estimated"] else math.inf for name, spread in content["spreads"].items()},
        n_trials=len(content["trials"]),
    )


def _number(cell: Any) -> float:
    return math.nan if cell is None else float(cell)


def _stretch(number: Mapping[str, Any], log: bool) -> float:
    """By how much the fit's 95 % are wider than those of a normal distribution; 1 where they come from a bound."""
    low, high, sigma = (_number(number[key]) for key in ("low_95", "high_95", "sigma"))
    if number["interval"] != "linear" or not sigma > 0 or not low < high or (log and not low > 0):
        return 1.0
    half = (math.log(high / low) if log else high - low) / 2
    return max(half / (NORMAL_95 * (sigma / number["value"] if log else sigma)), 1.0)


def numbers_of(fit: Fit) -> FitNumbers:
    """Numbers of a fit as `vinetrack.fit` returns it.

    Parameters
    ----------
    fit : a fit.

    Returns
    -------
    FitNumbers
    """
    content = {
        "model": fit.model.names,
        "numbers": [number.to_json() for number in fit.numbers],
        "covariance": fit.covariance,
        "between_trials": None if fit.between is None else fit.between.tolist(),
        "spreads": {
            name: {"value": spread.value, "estimated": spread.estimated} for name, spread in fit.spreads.items()
        },
        "trials": {trial.name: None for trial in fit.trials},
    }
    return fit_numbers(content, "the fit")


def same_vine(numbers: FitNumbers, trial: Trial) -> str | None:
    """The fitted vine of this diameter and wall, of any length, for B is a matter of the tip; None if there is none.

    Parameters
    ----------
    numbers : of a fit.
    trial : diameter, thickness and vine.

    Returns
    -------
    str or None
        Name of the vine; that of the same length before others.
    """
    sizes = [
        (vine, size) for vine, size in numbers.sizes().items() if alike(size, (trial.diameter_m, trial.thickness_m))
    ]
    exact = [vine for vine, _ in sizes if vine == trial.vine]
    return exact[0] if exact else sizes[0][0] if sizes else None


def alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Whether two sizes are the same to five digits.

    Parameters
    ----------
    first, second : (float, float)
        Diameter and thickness, m.

    Returns
    -------
    bool
    """
    return all(abs(a / b - 1) < 1e-5 for a, b in zip(first, second, strict=True))


def nearest_vine(numbers: FitNumbers, trial: Trial) -> str | None:
    """The fitted vine whose size is nearest, in logarithms; None where no vine says its size.

    Parameters
    ----------
    numbers : of a fit.
    trial : diameter and thickness.

    Returns
    -------
    str or None
        Name of the vine.
    """
    target = np.log([trial.diameter_m, trial.thickness_m])
    sizes = numbers.sizes()
    return min(sizes, key=lambda vine: float(np.sum((np.log(sizes[vine]) - target) ** 2)), default=None)


def yield_place(numbers: FitNumbers, vine: str, stated_Pa: float) -> int | None:
    """Where the yield pressure of a fitted vine stands; of several the one nearest to what the sheet says.

    Parameters
    ----------
    numbers : of a fit.
    vine : str
        Name of a vine.
    stated_Pa : float
        Yield pressure of the sheet, NaN where it has none.

    Returns
    -------
    int or None
    """
    places = [
        k
        for k, (key, name) in enumerate(zip(numbers.keys, numbers.vines, strict=True))
        if key == YIELD_PRESSURE and (name == vine or name.startswith(f"{vine}, "))
    ]
    if not places:
        return None
    if not math.isfinite(stated_Pa):
        return places[0]
    return min(places, key=lambda k: abs(float(numbers.mean[k]) - stated_Pa))
