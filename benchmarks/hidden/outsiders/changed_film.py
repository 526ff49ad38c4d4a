"""Changed film: beyond a place on it the film takes another force to evert.

    B → B (1 + δ) for y > y₁

In no catalogue. Only scoring gives it to the package, to learn how well the truth would have fitted.
"""

from vinetrack.effects import Parameter

PARAMETERS = (
    Parameter("delta", "δ", "1", 0.1, bounds=(-0.9, 10.0)),
    Parameter("place", "y₁", "m", 0.1, bounds=(0.0, 1.0), zero=0.1),
)


def damping_gain(s, rig, delta, place):  # noqa: ARG001
    return s.damping_gain * (1.0 + delta * (s.lead_position > place))
