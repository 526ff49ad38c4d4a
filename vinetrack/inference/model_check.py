"""Check of the damping fits by the dynamic model: B and n from steady windows against B and n from whole
trajectories.

Both use the same recordings, but not the same part of them: steady windows show the final speed of a vine, trajectories
also the approach to it. If they differ by more than their errors, the model lacks an effect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.parameters import DAMPING, EXPONENT

if TYPE_CHECKING:
    import pandas as pd

CHECK_COLUMNS = ("vine", "n_steady", "n_trajectory", "B_steady", "B_trajectory", "z")


def check_damping(fit: Fit, damping: Mapping[str, Any]) -> pd.DataFrame:
    """One row per vine, as `model_check.csv` holds it."""
    import pandas as pd

    if EXPONENT not in [number.key for number in fit.numbers]:
        raise FitError("The exponent n was fixed in this fit: there is nothing to check the steady windows against.")
    n = fit[EXPONENT]
    rows = []
    for vine in dict.fromkeys(trial.trial.vine for trial in fit.trials):
        steady = (damping.get("vines") or {}).get(vine)
        B = next((b for b in fit.numbers if b.key == DAMPING and b.vine in (vine, "")), None)
        n_steady = damping.get("n")
        row: dict[str, object] = {
            "vine": vine,
            "n_steady": math.nan if n_steady is None else n_steady,
            "n_trajectory": n.value,
            "B_steady": steady["B"] if steady else math.nan,
            "B_trajectory": B.value if B else math.nan,
            "z": math.nan,
        }
        if steady and B and n_steady is not None:
            difference = np.array([n_steady - n.value, math.log(steady["B"] / B.value)])
            row["z"] = _deviate(difference, _steady_covariance(damping, vine) + _trajectory_covariance(fit, B.name))
        rows.append(row)
    return pd.DataFrame(rows, columns=list(CHECK_COLUMNS))


def _steady_covariance(damping: Mapping[str, Any], vine: str) -> Floats:
    """Covariance of n and ln B of one vine from steady windows."""
    names = damping["covariance"]["parameters"]
    k = [names.index("n"), names.index(f"ln B {vine}")]
    return np.array(damping["covariance"]["matrix"], dtype=float)[np.ix_(k, k)]


def _trajectory_covariance(fit: Fit, name: str) -> Floats:
    """Covariance of n and ln B from the trajectories."""
    k = [fit.numbers.index(fit[EXPONENT]), fit.numbers.index(fit[name])]
    slopes = np.array([1.0, 1 / fit[name].value])
    return np.asarray(fit.covariance[np.ix_(k, k)] * slopes[:, None] * slopes)


def _deviate(difference: Floats, covariance: Floats) -> float:
    """Normal deviate as unlikely as this difference of two parameters, from χ² with two degrees of freedom."""
    from scipy.stats import norm

    if not np.isfinite(covariance).all() or np.linalg.matrix_rank(covariance) < 2:
        return math.nan
    square = float(difference @ np.linalg.solve(covariance, difference))
    # ln P(χ²₂ > s) = −s/2; half of it on each side of the normal, in logarithms so that 40 σ is 40 σ.
    log_tail = -square / 2 - math.log(2)
    if log_tail > -700:
        return float(norm.isf(math.exp(log_tail)))
    return math.sqrt(square - math.log(square))
