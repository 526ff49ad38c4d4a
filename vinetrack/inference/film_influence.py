"""By how much the numbers of a fit would move if the film weighed a little other than the sheet says.

The mass of the film is computed from its thickness and density, which no sheet knows better than to a few per cent.
It is no part of the stated errors: it can be weighed, and then it is nothing. In a campaign of two dozen quiet trials
it may be more than everything that is part of them, and then the fit says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.core.units import display_unit
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.position_errors import with_smooth_errors
from vinetrack.inference.robust_covariance import parameter_shifts
from vinetrack.inference.systematics import FILM_ERROR, film_errors

FILM = "film_mass"
"""The effect that makes the mass of the film a number of the fit."""

MATTERS = 1.0
"""Movement of a number, in its stated errors, from which the film is mentioned. Derived: with the film in it the error
of the number would then be √2 times as large; at half 1.12 times, at twice 2.2 times. Wording alone depends on it."""

MOST_NAMED = 4
"""Numbers named with their movements at most, those moved furthest first. Chosen: two lines; at half n may stand alone,
at twice it fills four. Wording alone."""


def film_influence(fit: Fit) -> Floats:
    """Standard deviation that film of an unknown mass, each vine's by 2 %, adds to each number of a fit.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    array, shape (n_numbers,)
        In the units of `fit.numbers`, SI. Zeros where the mass of the film is a number of the fit, or moves nothing.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False)
    >>> vt.film_influence(fit).shape
    (3,)
    """
    if FILM in fit.model:
        return np.zeros(len(fit.numbers))
    errors = film_errors(fit.predictor, fit.solution, fit.trials)
    moved = parameter_shifts(fit.predictor, with_smooth_errors(fit), errors)[: len(fit.numbers)]
    free = fit.predictor.layout.free
    slopes = np.array([each.derivative(number.value) for each, number in zip(free, fit.numbers, strict=True)])
    return np.asarray(np.sqrt(np.sum(moved**2, axis=1)) * slopes)


def film_messages(numbers: Sequence[Number], moved: Floats) -> tuple[str, ...]:
    """What is to be said of the film beside the errors of a fit: one sentence, or none where it matters less than they.

    Parameters
    ----------
    numbers : sequence of Number
        Of the fit.
    moved : array, shape (n_numbers,)
        As of `film_influence`.

    Returns
    -------
    tuple of str
    """
    sigma = np.array([number.sigma for number in numbers])
    times = np.divide(moved, sigma, out=np.zeros_like(moved), where=np.isfinite(sigma) & (sigma > 0))
    named = [k for k in np.argsort(-times, kind="stable").tolist() if times[k] >= MATTERS]
    if not named:
        return ()
    parts = []
    for k in named[:MOST_NAMED]:
        unit, factor = display_unit(numbers[k].unit)
        parts.append(f"{numbers[k].title} by {factor * moved[k]:.2g} {unit}".rstrip())
    more = len(named) - len(parts)
    listed = ", ".join(parts) + (f", and {more} more" if more else "")
    return (
        f"these errors take the mass of the film as stated; were it off by {100 * FILM_ERROR:g} % in each vine, that"
        f" would move {listed}. Weigh a piece of each vine, and correct thickness_um or film_density_kg_m3 by it",
    )
