"""Gain of a hypothesis if the film mass of each vine is a nuisance parameter.

Which of two effects has the higher likelihood may depend on the mass of the film: where the truth was a drag on film
that is 1.5 % lighter than stated, a wrong scale was ahead of it by Δχ² 27. A hypothesis is therefore not excluded if it
fits as well as the best once the film mass of every vine is free within its usual error. The tests of whether anything
is missing use the stated mass: there a wrong film mass is a hypothesis of its own, `film_mass`.
"""

from __future__ import annotations

from vinetrack.diagnosis.between_gain import with_errors
from vinetrack.inference.film_influence import FILM
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.goodness_of_fit import is_poor_fit
from vinetrack.inference.marginal_likelihood import deviance, estimate_between_trial_sd, marginal
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import with_smooth_errors
from vinetrack.inference.systematics import film_errors


def film_gain(fit: Fit) -> float:
    """Fall of −2 ln L with a relative error ε ~ N(0, `FILM_ERROR`²) of each vine's film mass, by linear algebra. ε
    takes its best value, with its prior as a penalty; it is not integrated out. Returns at least 0; 0 for a fit that is
    far off, has a free film mass already, or does not depend on it.
    """
    if FILM in fit.model or is_poor_fit(fit.predictor, fit.solution):
        return 0.0
    errors = film_errors(fit.predictor, fit.solution, fit.trials)
    if not errors.n_columns:
        return 0.0
    base = with_smooth_errors(fit)
    return max(_deviance(base, base) - _deviance(with_errors(fit, base, errors), base), 0.0)


def _deviance(solution: Solution, base: Solution) -> float:
    """−2 ln L, minimised over the parameters and over the between-trial standard deviations that `base` estimates."""
    part, problem, state = (
        marginal(solution.cross_products, solution.problem, solution.state),
        solution.problem,
        solution.state,
    )
    spread = estimate_between_trial_sd(part, problem, state, base.estimable, restricted=False)
    return deviance(part, problem, state, spread, restricted=False)
