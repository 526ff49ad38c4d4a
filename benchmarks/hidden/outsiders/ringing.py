"""Ringing: the supply swings about the pressure that is set.

    P → P (1 + a sin 2πft)

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import math

import numpy as np

from vinetrack.effects import Parameter

ORDER = 2
PARAMETERS = (
    Parameter("swing", "a", "1", 0.05, bounds=(-1.0, 1.0)),
    Parameter("rate", "f", "Hz", 10.0, bounds=(0.01, 1e4), zero=10.0),
)


def pressure(s, rig, swing, rate):  # noqa: ARG001
    return s.pressure * (1.0 + swing * np.sin(2.0 * math.pi * rate * s.time))
