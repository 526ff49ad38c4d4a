"""Stribeck friction: a resistance that falls with speed.

    tail force −F exp(−ẋ/v_s)

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import numpy as np

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("F", "F", "N", 0.1, bounds=(0.0, 100.0)),
    Parameter("speed", "v_s", "m/s", 1.0, bounds=(1e-3, 100.0), zero=1.0),
)


def tail_force(s, rig, F, speed):  # noqa: ARG001
    return -F * np.exp(-s.tail_velocity / speed)
