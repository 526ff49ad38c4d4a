"""The result of a fit: numbers with errors and intervals, trial effects, and messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.notebook import html_table, plot
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.core.units import decimals, display_unit, or_nan
from vinetrack.dynamics.model import Model
from vinetrack.inference.fit_data import FitError, ImpreciseRest
from vinetrack.inference.parameters import DAMPING, EXPONENT

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.inference.mixed_effects import FitState
    from vinetrack.inference.optimiser import Solution
    from vinetrack.inference.sensitivity import Predictor


@dataclass(frozen=True)
class Number:
    """One fitted number, SI, with its standard error, degrees of freedom and 95 % interval. `vine` is blank if the
    number applies to all. `method` tells how the interval was found: `linear`, `profile` near a bound, `none` if the
    data do not determine it.
    """

    key: str
    vine: str
    symbol: str
    unit: str
    value: float
    sigma: float
    low: float
    high: float
    dof: float
    method: str
    bound: float = math.nan
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets if it belongs to one."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    @property
    def title(self) -> str:
        """Symbol, with the vine in brackets if it belongs to one."""
        return f"{self.symbol} ({self.vine})" if self.vine else self.symbol

    def to_json(self) -> dict[str, Any]:
        """As `fit.json` and `diagnosis.json` hold it, SI."""
        return {
            "parameter": self.key,
            "vine": self.vine,
            "symbol": self.symbol,
            "unit": self.unit,
            "value": self.value,
            "sigma": self.sigma,
            "low_95": self.low,
            "high_95": self.high,
            "interval": self.method,
            "bound": self.bound,
            "lower_bound": self.lower,
            "upper_bound": self.upper,
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Number:
        """Read what `to_json` wrote; unknown numbers are NaN, degrees of freedom too."""
        value, sigma, low, high, bound = (
            or_nan(entry.get(key)) for key in ("value", "sigma", "low_95", "high_95", "bound")
        )
        return cls(
            key=str(entry["parameter"]),
            vine=str(entry.get("vine") or ""),
            symbol=str(entry["symbol"]),
            unit=str(entry["unit"]),
            value=value,
            sigma=sigma,
            low=low,
            high=high,
            dof=math.nan,
            method=str(entry.get("interval") or ("linear" if math.isfinite(low) else "none")),
            bound=bound,
            lower=-math.inf if entry.get("lower_bound") is None else float(entry["lower_bound"]),
            upper=math.inf if entry.get("upper_bound") is None else float(entry["upper_bound"]),
        )

    @property
    def ends_at(self) -> str:
        """Ends of the 95 % interval that are bounds, not estimates: `lower`, `upper`, `lower and upper`, or blank."""
        slack = 1e-6 * max(abs(self.high - self.low), 1e-12 * max(abs(self.low), abs(self.high)))
        ends = [("lower", self.low - self.lower <= slack), ("upper", self.upper - self.high <= slack)]
        return " and ".join(name for name, is_bound in ends if is_bound)


@dataclass(frozen=True)
class BetweenTrialSpread:
    """Between-trial standard deviation, relative; `estimated` tells whether it is from these data."""

    value: float
    estimated: bool


@dataclass(frozen=True)
class TrialFit:
    """One trial under the model; arrays have shape (n_points,), at the points that were used. `whitened` are whitened
    residuals, without smooth errors of position, in standard deviations. Deviations are relative to the set pressure
    and to the vine's B.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    predicted_position_m: Floats
    predicted_velocity_m_s: Floats
    residual_m: Floats
    whitened: Floats
    release_s: float
    release_sigma_s: float
    origin_m: float
    origin_sigma_m: float
    pressure_deviation: float
    pressure_deviation_sigma: float
    damping_deviation: float
    damping_deviation_sigma: float
    noise_m: float
    band_m: Floats | None = None
    imprecise_rest: ImpreciseRest | None = None

    @property
    def within_band(self) -> float:
        """Fraction of the positions within the band; NaN without a band."""
        if self.band_m is None:
            return math.nan
        return float(np.mean(np.abs(self.residual_m) <= self.band_m))

    @property
    def name(self) -> str:
        """The trial's name."""
        return self.trial.name

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals, m."""
        return float(np.sqrt(np.mean(self.residual_m**2)))


class NumberTable:
    """Access to the numbers of a fit and their covariance, common to a fit in memory and one read from a file."""

    numbers: tuple[Number, ...]
    covariance: Floats

    def __getitem__(self, name: str) -> Number:
        """The number of this name: `effect.parameter`, `effect.parameter[vine]`, or the parameter's name if unique."""
        fits = [n for n in self.numbers if name in (n.name, n.key, n.key.split(".")[1], n.title)]
        if len(fits) != 1:
            known = ", ".join(number.name for number in (fits or self.numbers)) or "none"
            raise FitError(f"{name!r} is {'no number' if not fits else 'more than one number'} of the fit: {known}.")
        return fits[0]

    def correlation(self, first: str, second: str) -> float:
        """Correlation of the errors of two numbers."""
        i, j = self.numbers.index(self[first]), self.numbers.index(self[second])
        return float(self.covariance[i, j] / math.sqrt(self.covariance[i, i] * self.covariance[j, j]))

    def table(self) -> pd.DataFrame:
        """One row per number: `parameter, vine, value, sigma, low_95, high_95, unit, interval`; SI."""
        import pandas as pd

        return pd.DataFrame(
            [(n.key, n.vine, n.value, n.sigma, n.low, n.high, n.unit, n.method) for n in self.numbers],
            columns=["parameter", "vine", "value", "sigma", "low_95", "high_95", "unit", "interval"],
        )


@dataclass(frozen=True, repr=False)
class Fit(NumberTable):
    """A model fitted to trajectories. Printed, it is a table. `model` has the fitted values. `covariance` is that of
    `numbers`, SI, in their order.
    """

    model: Model
    numbers: tuple[Number, ...]
    covariance: Floats
    spreads: Mapping[str, BetweenTrialSpread]
    noise_m: float
    noise_correlation: float
    chi2_per_dof: float
    log_likelihood: float
    trials: tuple[TrialFit, ...]
    messages: tuple[str, ...]
    left_out: Mapping[str, str]
    converged: bool
    iterations: int
    predictor: Predictor
    solution: Solution
    options: Mapping[str, Any]
    pairs: tuple[tuple[Trial, Track], ...] = ()
    between: Floats | None = None
    smooth: FitState | None = None

    @property
    def state(self) -> FitState:
        """State of the solution, with the variance components of the fit that includes smooth errors of position. The
        iterations are without smooth errors, so that the displacement by a lens is taken for deviations of single
        trials and enlarges noise and standard deviations.
        """
        state, smooth = self.solution.state, self.smooth
        if smooth is None:
            return state
        return replace(state, spread=smooth.spread, rho=smooth.rho, variance=smooth.variance)

    def trial(self, name: str) -> TrialFit:
        """The trial of that name; KeyError where there is none."""
        return {trial.name: trial for trial in self.trials}[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects of the model, in order."""
        return self.model.names

    def positions(self) -> pd.DataFrame:
        """Measured and predicted positions of all trials, one row per point."""
        import pandas as pd

        parts = [
            pd.DataFrame(
                {
                    "trial": trial.name,
                    "time_s": trial.time_s,
                    "lead_position_m": trial.lead_position_m,
                    "predicted_position_m": trial.predicted_position_m,
                    "residual_m": trial.residual_m,
                }
            )
            for trial in self.trials
        ]
        return pd.concat(parts, ignore_index=True)

    def plot(self, name: str = "model_comparison", **options: Any) -> Figure:
        """A figure of the report for this model: `model_comparison` or `model_residuals`."""
        return plot(self, name, **options)

    def __repr__(self) -> str:
        return f"Fit({' + '.join(self.model.names)}; {len(self.trials)} trials)"

    def _repr_html_(self) -> str:
        title = f"{' + '.join(self.model.names)}, fitted to {len(self.trials)} trials"
        head = ("", "value", "standard error", "95 % interval", "unit")
        return html_table(head, [number_row(number) for number in self.numbers], title, self.messages)

    def __str__(self) -> str:
        points = sum(trial.time_s.size for trial in self.trials)
        head = f"{' + '.join(self.model.names)}, fitted to {len(self.trials)} trials ({points} positions)"
        return "\n".join([head, *numbers_text(self)])


def numbers_text(fit: Any) -> list[str]:
    """The numbers of a fit, its noise and its messages as lines of text."""
    lines = aligned([("", "value", "error", "95 % interval", "unit"), *map(number_row, fit.numbers)])
    lines += [_spread_line(name, spread) for name, spread in fit.spreads.items()]
    lines.append(
        f"noise {fit.noise_m * 1e3:.3g} mm, correlation {fit.noise_correlation:.2f};"
        f" χ² per degree of freedom {fit.chi2_per_dof:.3g}; ln L {fit.log_likelihood:.1f}"
    )
    lines += [f"! {message}" for message in fit.messages]
    if fit.left_out:
        lines.append(f"left out: {'; '.join(f'{name} ({why})' for name, why in fit.left_out.items())}")
    return lines


def number_row(number: Number) -> tuple[str, ...]:
    """A number as texts in its display unit: name, value, `± standard error`, 95 % interval, unit."""
    unit, factor = display_unit(number.unit)
    if math.isfinite(number.bound):
        return number.title, f"{number.bound * factor:.4g}", "at its bound", "", unit
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return number.title, f"{number.value * factor:.4g}", "open", "", unit
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    return number.title, value, f"± {number.sigma * factor:.{digits}f}", f"{low} to {high}", unit


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Rows of (name, value, error, interval, unit) as aligned lines of text; values to the right, others to
    the left.
    """
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if k == 1 else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append(f"  {'  '.join(cells)}".rstrip())
    return lines


def _spread_line(name: str, spread: BetweenTrialSpread) -> str:
    how = "" if spread.estimated else " (fixed: given, or too few trials to estimate it)"
    return f"between-trial standard deviation of {name} {100 * spread.value:.2g} %{how}"


# ------------------------------------------------------------------------------
# Check of the damping fits by the dynamic model: B and n from steady windows against B and n from whole trajectories.
#
# Both use the same recordings, but not the same part of them: steady windows show the final speed of a vine,
# trajectories also the approach to it. If they differ by more than their errors, the model lacks an effect.

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
