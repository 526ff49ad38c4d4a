"""Cubic damping: a resistance that grows with the third power of the speed.

    tail force −c ẋ³

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

from vinetrack.effects import Parameter

PARAMETERS = (Parameter("c", "c", "N·s³/m³", 1e-3, bounds=(-10.0, 10.0)),)


def tail_force(s, rig, c):  # noqa: ARG001
    return -c * s.tail_velocity * s.tail_velocity * s.tail_velocity
