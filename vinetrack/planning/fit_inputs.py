"""Fitted parameters in the form from which predictions draw: means, covariance, between-trial standard deviations.

They come from a `Fit` or from `fit.json`. B is held as its logarithm, as in the fit.
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

LEAST_DOF = 3  # Least degrees of freedom of a between-trial standard deviation (derived)

NORMAL_95 = 1.959963984540054  # Standard normal quantile of 0.975

_VINE = re.compile(r"([\d.]+)mm-([\d.]+)um(?:-([\d.]+)mm)?")


@dataclass(frozen=True)
class FitNumbers:
    """The parameters of a fit, named by `keys` and `vines`; `log` marks those held as logarithms. `mean` and
    `covariance` are those of the parameters of a new trial, between-trial differences included. Parameters that the fit
    does not determine have a variance of 0 and are listed in `open`.
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
        """Return the index of a parameter, shared or of this vine; None where there is none."""
        for k, (name, of_vine) in enumerate(zip(self.keys, self.vines, strict=True)):
            if name == key and of_vine in ("", vine):
                return k
        return None

    def sizes(self) -> dict[str, tuple[float, float]]:
        """Diameter and thickness, m, of every vine with a fitted B."""
        sizes = {}
        for key, vine in zip(self.keys, self.vines, strict=True):
            if key == DAMPING and (size := size_of(vine)):
                sizes[vine] = size
        return sizes


def size_of(vine: str) -> tuple[float, float] | None:
    """Parse diameter and thickness, m, from the name of a vine; None where the name does not contain them. Returns
    (float, float) or None.
    """
    match = _VINE.match(vine)
    return (float(match[1]) / 1e3, float(match[2]) / 1e6) if match else None


def fit_numbers(content: Mapping[str, Any], source: str) -> FitNumbers:
    """Read the parameters of a fit from the content of `fit.json`."""
    if content.get("refused"):
        raise FitError(f"{source} holds no fit to predict from: {content['refused']}")
    numbers = content["numbers"]
    if not numbers:
        raise FitError(f"{source} holds a fit without numbers: there is nothing to predict from.")
    covariance = np.array([[_number(cell) for cell in row] for row in content["covariance"]], dtype=float)
    values = np.array([number["value"] for number in numbers], dtype=float)
    log = np.array([number["parameter"] == DAMPING and number["value"] > 0 for number in numbers], dtype=bool)
    slopes = np.where(log, 1 / np.where(log, values, 1.0), 1.0)
    widening = np.array(
        [_widening(number, bool(is_log)) for number, is_log in zip(numbers, log, strict=True)], dtype=float
    )
    between = np.array([[_number(cell) for cell in row] for row in content.get("between_trials") or ()], dtype=float)
    is_known = np.isfinite(np.diag(covariance))
    if between.shape == covariance.shape:
        # A prediction is of one trial, whose parameters differ from the shared ones.
        covariance = covariance + np.nan_to_num(between)
    dof = float(max(len(content["trials"]) - len(numbers), LEAST_DOF))
    scale = np.where(is_known, slopes * widening, 0.0)
    return FitNumbers(
        source=source,
        model=tuple(content["model"]),
        keys=tuple(number["parameter"] for number in numbers),
        vines=tuple(number["vine"] for number in numbers),
        log=log,
        mean=np.where(log, np.log(np.where(log, values, 1.0)), values),
        covariance=np.nan_to_num(covariance, nan=0.0, posinf=0.0, neginf=0.0) * scale[:, None] * scale,
        open=tuple(number["symbol"] for number, known in zip(numbers, is_known, strict=True) if not known),
        spreads={name: float(spread["value"]) for name, spread in content["spreads"].items()},
        spread_dof={name: dof if spread["estimated"] else math.inf for name, spread in content["spreads"].items()},
        n_trials=len(content["trials"]),
    )


def _number(cell: Any) -> float:
    return math.nan if cell is None else float(cell)


def _widening(number: Mapping[str, Any], log: bool) -> float:
    """Ratio of the fit's 95 % interval to that of a normal distribution, at least 1; 1 where a bound determines it."""
    low, high, sigma = (_number(number[key]) for key in ("low_95", "high_95", "sigma"))
    if number["interval"] != "linear" or not sigma > 0 or not low < high or (log and not low > 0):
        return 1.0
    half = (math.log(high / low) if log else high - low) / 2
    return max(half / (NORMAL_95 * (sigma / number["value"] if log else sigma)), 1.0)


def numbers_of(fit: Fit) -> FitNumbers:
    """Return the parameters of a fit as `vinetrack.fit` returns it."""
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
    """Return the fitted vine of this diameter and wall and any length, since B belongs to the tip; None without one."""
    sizes = [
        (vine, size) for vine, size in numbers.sizes().items() if alike(size, (trial.diameter_m, trial.thickness_m))
    ]
    exact = [vine for vine, _ in sizes if vine == trial.vine]
    return exact[0] if exact else sizes[0][0] if sizes else None


def alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Return whether two sizes are equal to five digits."""
    return all(abs(a / b - 1) < 1e-5 for a, b in zip(first, second, strict=True))


def nearest_vine(numbers: FitNumbers, trial: Trial) -> str | None:
    """Return the fitted vine nearest in ln diameter and ln thickness; None where no name contains a size."""
    target = np.log([trial.diameter_m, trial.thickness_m])
    sizes = numbers.sizes()
    return min(sizes, key=lambda vine: float(np.sum((np.log(sizes[vine]) - target) ** 2)), default=None)


def yield_place(numbers: FitNumbers, vine: str, stated_Pa: float) -> int | None:
    """Return the index of the yield pressure of a fitted vine; of several, the one nearest to the stated value."""
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
