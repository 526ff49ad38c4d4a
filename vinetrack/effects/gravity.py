"""Gravity: the weight of tail and payload, along the direction of growth.

Matters with a payload. Without one it is a few per cent of the drive and vanishes with the moving mass: the speed falls
by 1–4 % from that alone.

    tail force +m(x) g cosθ

θ is the growth angle from straight down (0 down, 90° horizontal, 180° up) and m(x) the moving mass of tail and payload.
It acts on the tail itself and so counts in full.

Easily taken for `payload_friction` where cosθ or the payload's mass is wrong.

Reduce it by growing horizontally.

g is known and fixed, for a falling body too, where it would absorb air drag. To measure g from a fall, free it by name.

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


def tail_force(s, rig, g):
    return s.moving_mass * g * rig.cos_angle


WORKED = (
    Worked(
        "tail_force", 0.34924, "35.6 g × 9.81, straight down", state={"moving_mass": 35.6e-3}, rig={"cos_angle": 1.0}
    ),
    Worked("tail_force", -0.34924, "the same, upwards", state={"moving_mass": 35.6e-3}, rig={"cos_angle": -1.0}),
)
