"""Slip: a friction that grows with the travel and levels off with the speed.

    tail force −F (x/X)^1.5 ẋ/(ẋ + v₀)

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("F", "F", "N", 0.1, bounds=(-100.0, 100.0)),
    Parameter("travel", "X", "m", 0.5, bounds=(1e-3, 10.0), zero=0.5),
    Parameter("speed", "v₀", "m/s", 1.0, bounds=(1e-3, 100.0), zero=1.0),
)


def tail_force(s, rig, F, travel, speed):  # noqa: ARG001
    return -F * (max(s.tail_position, 0.0) / travel) ** 1.5 * s.tail_velocity / (s.tail_velocity + speed)
