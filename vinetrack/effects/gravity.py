"""Gravity: the weight of tail and payload, along the direction of growth.

    tail force +m(x) g cosθ

θ is the growth angle from straight down (0 down, 90° horizontal, 180° up) and m(x) what still moves: tail and payload.
It acts on the tail itself and so counts whole. On a bare vine it is a few per cent of the drive, and leaves with the
mass: a steady speed sags by 1–4 % for that alone.

Source: Alvarez et al. (2025), Eq. (1).
"""

from vinetrack.effects import Worked

KIND = "base"
STANDARD_GRAVITY = 9.81  # m/s²


def tail_force(s, rig):  # noqa: D103
    return s.moving_mass * STANDARD_GRAVITY * rig.cos_angle


WORKED = (
    Worked(
        "tail_force", 0.34924, "35.6 g × 9.81, straight down", state={"moving_mass": 35.6e-3}, rig={"cos_angle": 1.0}
    ),
    Worked("tail_force", -0.34924, "the same, upwards", state={"moving_mass": 35.6e-3}, rig={"cos_angle": -1.0}),
)
