"""Simpler forms of an effect that contains another as a special case, refitted from where the larger one ended."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence

import numpy as np

from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

# Standard errors by which an additional parameter must differ from zero for the simpler form to be ruled out without a
# fit
CERTAIN_SIGMAS = 6.0

# A hypothesis and its ln L, one of its effects, and the simpler form of that effect
NestedForm = tuple[str, float, str, str]


def simpler_forms(
    before: Fit, hypothesis: LikelihoodRatio, effects: Sequence[Effect], tried: set[NestedForm]
) -> Iterator[tuple[tuple[Effect, ...], Fit]]:
    """Refit a hypothesis with one of its effects replaced by a simpler effect that it contains."""
    for larger in hypothesis.effects:
        for simpler in effects:
            contained = simpler.name in larger.replaces and simpler.name not in hypothesis.names
            if not contained or _needs_larger_form(hypothesis.fit, larger, simpler):
                continue
            form = "+".join(sorted(hypothesis.names)), hypothesis.fit.log_likelihood, larger.name, simpler.name
            if form in tried:
                continue
            tried.add(form)
            replaced = tuple(simpler if effect is larger else effect for effect in hypothesis.effects)
            model = before.model.with_effects(replaced)
            values = hypothesis.fit.model.values
            sizes = {f"{simpler.name}.{p.name}": values.get(f"{larger.name}.{p.name}") for p in simpler.parameters}
            start = {key: size for key, size in sizes.items() if size is not None}
            with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
                yield replaced, refit(hypothesis.fit, model, start=start, thorough=False)


def _needs_larger_form(fit: Fit, larger: Effect, simpler: Effect) -> bool:
    """Whether a parameter that only the larger form has differs from zero beyond doubt."""
    additional = {p.name for p in larger.parameters} - {p.name for p in simpler.parameters}
    numbers = [n for n in fit.numbers if n.key.split(".")[0] == larger.name and n.key.split(".")[1] in additional]
    return any(
        math.isfinite(n.sigma) and not math.isfinite(n.bound) and abs(n.value) > CERTAIN_SIGMAS * n.sigma
        for n in numbers
    )
