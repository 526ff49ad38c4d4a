"""Chirp: the film resists now more, now less, in waves that become shorter along its length.

    tail force −F sin(2π (y/Λ)^1.5 + φ)

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import math

import numpy as np

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("F", "F", "N", 0.1, bounds=(-100.0, 100.0)),
    Parameter("length", "Λ", "m", 0.1, bounds=(1e-3, 10.0), zero=0.1),
    Parameter("phase", "φ", "1", 0.0, bounds=(-10.0, 10.0)),
)


def tail_force(s, rig, F, length, phase):  # noqa: ARG001
    return -F * np.sin(2.0 * math.pi * (max(s.lead_position, 0.0) / length) ** 1.5 + phase)
