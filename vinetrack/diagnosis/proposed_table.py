"""The learned force fitted as an effect, where no formula reproduces it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vinetrack.diagnosis.add import both_fits
from vinetrack.diagnosis.initial_fit import with_host
from vinetrack.diagnosis.ladder import left_out
from vinetrack.diagnosis.learned_effect import table_name, table_text
from vinetrack.diagnosis.learned_force import LEAST_CHI2_PER_POINT, LearnedForce
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.missing_force import LEAST_MISFIT_REDUCTION, learn_missing_force
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, load_effect, remember
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

LEAST_SIGMAS = 6.0  # Standard deviations by which a law must improve the fit to be proposed

# Part of the misfit that a law must take away for the learned force not to be tried as a table (chosen)
LAW_REPRODUCES = 0.9


@dataclass(frozen=True)
class ProposedTable:
    """A learned force that was fitted as an effect; `rms_left_out_m` is with the table learned from all trials."""

    learned: LearnedForce
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float

    def sentences(self, before: Fit) -> list[str]:
        """How much of the misfit the table explains."""
        after = self.ratio.fit
        return [
            f"No formula in the list reproduces the learned force. As a table ({self.effect.name}) it reduces χ² per"
            f" point from {before.chi2_per_dof:.1f} to {after.chi2_per_dof:.1f}; the error on left-out conditions, with"
            f" the table itself learned from all trials, is {1e3 * self.rms_left_out_m:.2f} mm."
        ]


def proposed_table(
    model: Model, before: Fit, laws: Sequence[Fit], report: Callable[[str], None]
) -> ProposedTable | None:
    """Estimate the missing force as a smooth function and fit it as a table."""
    misfit = before.chi2_per_dof - 1
    remaining = min((fit.chi2_per_dof for fit in laws), default=before.chi2_per_dof) - 1
    if misfit < LEAST_CHI2_PER_POINT - 1 or remaining < (1 - LAW_REPRODUCES) * misfit:
        return None
    report("estimating the missing force as a table")
    learned = learn_missing_force(before)
    if learned is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{table_name(learned)}.py"
        path.write_text(table_text(learned), encoding="utf-8")
        remember(path)
        effect = load_effect(path)
        try:
            start, after = both_fits(with_host(before, Model((*model, effect))), effect, report)
        except FitError:
            return None
        ratio = likelihood_ratio(start, (effect,), after)
        better = all(2 * (after.log_likelihood - fit.log_likelihood) > ANSWER_SET_DELTA_CHI2 for fit in laws)
        explains = start.chi2_per_dof - after.chi2_per_dof > LEAST_MISFIT_REDUCTION * misfit
        if not (better and explains and ratio.sigma > LEAST_SIGMAS):
            return None
        report("errors with the table")
        return ProposedTable(learned, effect, ratio, left_out(after).rms_m)
