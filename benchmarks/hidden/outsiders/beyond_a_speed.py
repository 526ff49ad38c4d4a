"""Beyond a speed: a resistance that is nothing up to a speed and grows with the square of what is beyond it.

    tail force −c max(0, ẋ − v₁)²

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

import numpy as np

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("c", "c", "N·s²/m²", 1e-2, bounds=(-10.0, 10.0)),
    Parameter("speed", "v₁", "m/s", 3.0, bounds=(0.0, 100.0), zero=3.0),
)


def tail_force(s, rig, c, speed):  # noqa: ARG001
    return -c * np.maximum(s.tail_velocity - speed, 0.0) ** 2
