"""Rough patch: a place on the film where eversion costs more.

    tail force −F exp(−½ ((y − y₀)/w)²)

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import numpy as np

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("F", "F", "N", 0.1, bounds=(0.0, 100.0)),
    Parameter("place", "y₀", "m", 0.1, bounds=(0.0, 1.0), zero=0.1),
    Parameter("width", "w", "m", 0.01, bounds=(1e-4, 0.5), zero=0.01),
)


def tail_force(s, rig, F, place, width):  # noqa: ARG001
    away = (s.lead_position - place) / width
    return -F * np.exp(-0.5 * away * away)
