"""The summary of a fit that `fit.json` stores: all quoted results, without the data and state behind them.

`vinetrack.inference.summary_of_fit` makes it from a fit in memory and `FitSummary.from_json` from a file, so that the
keys of the file are defined here alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.notebook import html_table
from vinetrack.core.numbers import or_nan
from vinetrack.core.records import Floats
from vinetrack.dynamics.model import Value, values_by_key
from vinetrack.inference.fit_result import BetweenTrialSpread, Number, NumberTable, number_row, numbers_text

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class TrialEstimates:
    """What a fit estimated for one trial; deviations are relative, of the set pressure and of the vine's B."""

    release_s: float
    release_sigma_s: float
    origin_m: float
    origin_sigma_m: float
    pressure_deviation: float
    pressure_deviation_sigma: float
    damping_deviation: float
    damping_deviation_sigma: float


@dataclass(frozen=True, repr=False)
class FitSummary(NumberTable):
    """The quoted results of a fit: see `vinetrack.inference.fit_result.Fit` for the meaning of each field. `names` are
    those of the effects; `covariance` is that of `numbers`, SI, in their order; `warnings` are those of the audit.
    `refused` is the reason why the model was not fitted, blank if it was: everything else is empty then.
    """

    names: tuple[str, ...]
    numbers: tuple[Number, ...] = ()
    covariance: Floats = field(default_factory=lambda: np.empty((0, 0)))
    spreads: Mapping[str, BetweenTrialSpread] = field(default_factory=dict)
    noise_m: float = math.nan
    noise_correlation: float = math.nan
    chi2_per_dof: float = math.nan
    log_likelihood: float = math.nan
    converged: bool = False
    messages: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    trials: Mapping[str, TrialEstimates] = field(default_factory=dict)
    refused: str = ""
    between: Floats = field(default_factory=lambda: np.empty((0, 0)))
    moved_by_film: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def fitted_values(self) -> dict[str, Value]:
        """Fitted values by `effect.parameter`, SI, as `Model.with_values` takes them."""
        return values_by_key((number.key, number.vine, number.value) for number in self.numbers)

    def trial_table(self) -> pd.DataFrame:
        """One row per trial: `trial, release_s, release_sigma_s, origin_m, …`; deviations are relative."""
        import pandas as pd

        columns = ["trial", *(entry.name for entry in fields(TrialEstimates))]
        return pd.DataFrame(
            [{"trial": name, **asdict(estimates)} for name, estimates in self.trials.items()], columns=columns
        )

    def to_json(self) -> dict[str, Any]:
        """As `fit.json` holds it, SI; a refused fit has its model and the reason alone."""
        content: dict[str, Any] = {"model": list(self.names), "refused": self.refused or None}
        if self.refused:
            return content
        return content | {
            "numbers": [number.to_json() for number in self.numbers],
            "covariance": self.covariance,
            "between_trials": self.between,
            "moved_by_film": self.moved_by_film,
            "spreads": {name: asdict(spread) for name, spread in self.spreads.items()},
            "noise_m": self.noise_m,
            "noise_correlation": self.noise_correlation,
            "chi2_per_dof": self.chi2_per_dof,
            "log_likelihood": self.log_likelihood,
            "converged": self.converged,
            "messages": list(self.messages),
            "warnings": list(self.warnings),
            "left_out": dict(self.left_out),
            "trials": {name: asdict(estimates) for name, estimates in self.trials.items()},
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> FitSummary:
        """Read what `to_json` wrote; unknown numbers are NaN."""
        numbers = tuple(Number.from_json(entry) for entry in content.get("numbers") or ())
        matrix, between = (
            [[or_nan(cell) for cell in row] for row in content.get(key) or ()]
            for key in ("covariance", "between_trials")
        )
        keys = [entry.name for entry in fields(TrialEstimates)]
        return cls(
            names=tuple(content.get("model") or ()),
            numbers=numbers,
            covariance=np.array(matrix, dtype=float) if matrix else np.full((len(numbers), len(numbers)), math.nan),
            spreads={
                str(name): BetweenTrialSpread(or_nan(spread["value"]), bool(spread["estimated"]))
                for name, spread in (content.get("spreads") or {}).items()
            },
            noise_m=or_nan(content.get("noise_m")),
            noise_correlation=or_nan(content.get("noise_correlation")),
            chi2_per_dof=or_nan(content.get("chi2_per_dof")),
            log_likelihood=or_nan(content.get("log_likelihood")),
            converged=bool(content.get("converged")),
            messages=tuple(content.get("messages") or ()),
            warnings=tuple(content.get("warnings") or ()),
            left_out=dict(content.get("left_out") or {}),
            trials={
                str(name): TrialEstimates(*(or_nan(estimates.get(key)) for key in keys))
                for name, estimates in (content.get("trials") or {}).items()
            },
            refused=str(content.get("refused") or ""),
            between=np.array(between, dtype=float) if between else np.empty((0, 0)),
            moved_by_film=np.array([or_nan(cell) for cell in content.get("moved_by_film") or ()]),
        )

    def __repr__(self) -> str:
        state = "refused" if self.refused else f"{len(self.trials)} trials"
        return f"FitSummary({' + '.join(self.names)}; {state})"

    def _repr_html_(self) -> str:
        if self.refused:
            return html_table((), (), f"{' + '.join(self.names)} was not fitted: {self.refused}")
        head = ("", "value", "standard error", "95 % interval", "unit")
        title = f"{' + '.join(self.names)}, fitted to {len(self.trials)} trials"
        return html_table(head, [number_row(number) for number in self.numbers], title, self.messages)

    def __str__(self) -> str:
        if self.refused:
            return f"{' + '.join(self.names)} was not fitted: {self.refused}"
        head = f"{' + '.join(self.names)}, fitted to {len(self.trials)} trials"
        return "\n".join([head, *numbers_text(self)])
