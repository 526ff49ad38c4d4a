"""Gravity: the weight of tail and payload, along the direction of growth.

Matters with a payload, and on a bare vine as a few per cent of the drive that leave with the mass: a steady speed sags
by 1–4 % for that alone.

    tail force +m(x) g cosθ

θ is the growth angle from straight down (0 down, 90° horizontal, 180° up) and m(x) what still moves: tail and payload.
It acts on the tail itself and so counts whole.

Easily taken for `payload_friction` where cosθ or the payload's mass is wrong.

Reduce it by growing horizontally.

g is known and held, for a falling body too: there it would take up the drag of the air. Where a fall is filmed to
measure g, free it by name.

Source: Alvarez et al. (2025), Eq. (1).
"""

from vinetrack.effects import Parameter, Worked

KIND = "base"
PARAMETERS = (
    Parameter(
        "g",
        "g",
        "m/s²",
        9.81,
        bounds=(0.0, 30.0),
        plausible=(9.76, 9.84),
        held=True,
        meaning="acceleration of free fall",
    ),
)


def tail_force(s, rig, g):  # noqa: D103
    return s.moving_mass * g * rig.cos_angle


WORKED = (
    Worked(
        "tail_force",
        0.34924,
        "35.6 g × 9.81, straight down",
        state={"moving_mass": 35.6e-3},
        rig={"cos_angle": 1.0},
        parameters={"g": 9.81},
    ),
    Worked(
        "tail_force",
        -0.34924,
        "the same, upwards",
        state={"moving_mass": 35.6e-3},
        rig={"cos_angle": -1.0},
        parameters={"g": 9.81},
    ),
)
