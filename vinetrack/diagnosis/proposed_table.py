"""The learned force fitted as an effect, where no formula takes away what it does."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vinetrack.diagnosis.add import both_fits
from vinetrack.diagnosis.initial_fit import with_host
from vinetrack.diagnosis.ladder import left_out
from vinetrack.diagnosis.learned_effect import table_name, table_text
from vinetrack.diagnosis.learned_force import MISSES, LearnedForce
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.missing_force import MENDS, learned_alone
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, load_effect, remember
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

WORTH = 6.0
"""Standard deviations by which a law must mend the model to be proposed: some hundred laws are tried, and none is known
beforehand. Chosen as SEARCH_SIGMAS of the misfit tests; at half one is found in noise, at twice in gross misfits
alone."""

REPRODUCES = 0.9
"""Part of the misfit that a law must take away, for the learned force not to be asked for as a table. Chosen: with it
the noise is within a third of what is left where a model misses by four times its noise; at 0.8 a law that bends where
the force does not passes for the force, at 0.95 nearly every law is followed by a table."""


@dataclass(frozen=True)
class ProposedTable:
    """A learned force as an effect that was fitted; `rms_left_out_m` with the table learned from all trials."""

    learned: LearnedForce
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float

    def sentences(self, before: Fit) -> list[str]:
        """What the table does.

        Parameters
        ----------
        before : the fit without it.

        Returns
        -------
        list of str
        """
        after = self.ratio.fit
        return [
            f"No formula tried does what the learned force does. As a table ({self.effect.name}) it takes χ² per point"
            f" from {before.chi2_per_dof:.1f} to {after.chi2_per_dof:.1f}; error on left-out conditions, the table"
            f" itself learned from all: {1e3 * self.rms_left_out_m:.2f} mm."
        ]


def proposed_table(
    model: Model, before: Fit, laws: Sequence[Fit], report: Callable[[str], None]
) -> ProposedTable | None:
    """Learn the missing force and fit it as a table.

    Parameters
    ----------
    model : the model that lacks something.
    before : its fit.
    laws : sequence of Fit
        Those with the laws that are proposed.
    report : called with a sentence at each step.

    Returns
    -------
    ProposedTable, or None where a law does as well, or none is learned that mends the model
    """
    misfit = before.chi2_per_dof - 1
    left = min((fit.chi2_per_dof for fit in laws), default=before.chi2_per_dof) - 1
    if misfit < MISSES - 1 or left < (1 - REPRODUCES) * misfit:
        return None
    report("learning the missing force as a table")
    learned = learned_alone(before)
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
        mends = start.chi2_per_dof - after.chi2_per_dof > MENDS * misfit
        if not (better and mends and ratio.sigma > WORTH):
            return None
        report("errors with the table")
        return ProposedTable(learned, effect, ratio, left_out(after).rms_m)
