"""Squeeze: beyond a place the body is pressed against its surroundings, with the square of the pressure.

    tail force −½F (P/P₀)² (1 + tanh((y − y₀)/w))

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import numpy as np

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("F", "F", "N", 0.1, bounds=(-100.0, 100.0)),
    Parameter("pressure", "P₀", "Pa", 2e4, bounds=(1.0, 1e6), zero=2e4),
    Parameter("place", "y₀", "m", 0.1, bounds=(0.0, 10.0), zero=0.1),
    Parameter("width", "w", "m", 0.03, bounds=(1e-4, 10.0), zero=0.03),
)


def tail_force(s, rig, F, pressure, place, width):  # noqa: ARG001
    ratio = s.pressure / pressure
    return -0.5 * F * ratio * ratio * (1.0 + np.tanh((s.lead_position - place) / width))
