"""How much likelier a hypothesis would be if the film weighed a little other than the sheet says.

Which of two effects is likelier may hang on the mass of the film: a drag on film that is 1.5 % lighter than stated was
less likely than a wrong scale, by Δχ² 27. So what is as likely as the best with the film of every vine free, within
what nobody knows it better than, is not excluded. Whether anything is missing at all is asked without: there the film
is a hypothesis of its own, `film_mass`.
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
    """Fall of −2 ln L with the film of each vine off by ε ~ N(0, `FILM_ERROR`), by linear algebra.

    Parameters
    ----------
    fit : of a hypothesis.

    Returns
    -------
    float
        At least 0; 0 for a fit that is far off, has film of free mass already, or feels none.
    """
    if FILM in fit.model or is_poor_fit(fit.predictor, fit.solution):
        return 0.0
    errors = film_errors(fit.predictor, fit.solution, fit.trials)
    if not errors.n_columns:
        return 0.0
    base = with_smooth_errors(fit)
    return max(_deviance(base, base) - _deviance(with_errors(fit, base, errors), base), 0.0)


def _deviance(solution: Solution, base: Solution) -> float:
    """−2 ln L of a solution, its numbers and the spreads between trials that `base` estimates at their best."""
    part, problem, state = (
        marginal(solution.cross_products, solution.problem, solution.state),
        solution.problem,
        solution.state,
    )
    spread = estimate_between_trial_sd(part, problem, state, base.estimable, restricted=False)
    return deviance(part, problem, state, spread, restricted=False)
