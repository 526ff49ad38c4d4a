"""Growing friction: a resistance that rises with time.

    tail force −k t

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

from vinetrack.effects import Parameter

PARAMETERS = (Parameter("rate", "k", "N/s", 0.1, bounds=(-1e4, 1e4)),)


def tail_force(s, rig, rate):  # noqa: ARG001
    return -rate * s.time
