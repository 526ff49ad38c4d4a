"""Sensitivity of fitted numbers to the mass of the film.

The mass of the film is computed from its thickness and density, which no sheet states to better than a few per cent. It
is not part of the stated errors, because it can be weighed and is then negligible. In a campaign of two dozen precise
trials it may exceed all stated errors, and the fit then says so.
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

FILM = "film_mass"  # The effect that makes the mass of the film a free parameter

MATTERS = 1.0  # Change of a number, in its stated errors, from which the film is mentioned (derived)

MOST_NAMED = 4  # Largest number of changes listed, the largest first (chosen)


def film_influence(fit: Fit) -> Floats:
    """Standard deviation of each fitted number due to an unknown film mass, independent by 2 % for each vine.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    array, shape (n_numbers,)
        In the units of `fit.numbers`, SI. Zeros if the fit estimates the mass of the film, or it has no influence.

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
    """A message on the film mass where it matters as much as the stated errors, else none. Shapes: moved
    (n_numbers,).
    """
    sigma = np.array([number.sigma for number in numbers])
    ratio = np.divide(moved, sigma, out=np.zeros_like(moved), where=np.isfinite(sigma) & (sigma > 0))
    affected = [k for k in np.argsort(-ratio, kind="stable").tolist() if ratio[k] >= MATTERS]
    if not affected:
        return ()
    parts = []
    for k in affected[:MOST_NAMED]:
        unit, factor = display_unit(numbers[k].unit)
        parts.append(f"{numbers[k].title} by {factor * moved[k]:.2g} {unit}".rstrip())
    more = len(affected) - len(parts)
    listed = ", ".join(parts) + (f", and {more} more" if more else "")
    return (
        f"these errors assume the stated mass of the film; an error of {100 * FILM_ERROR:g} % in each vine would change"
        f" {listed}. Weigh a piece of each vine, and correct thickness_um or film_density_kg_m3",
    )
