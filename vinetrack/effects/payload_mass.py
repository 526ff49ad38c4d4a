"""Payload mass: the payload of a vine weighs more or less than stated, by the same amount in each loaded trial.

Matters with a payload, most for a light one: its mount, tape, bolts or cable were not weighed, or the balance was not
zeroed. In a vine that runs at a few metres a second most of the mass that moves is payload.

    m_pay → m_pay + δ in trials with a payload: inertia and weight

Friction of the payload is that of the stated mass.

Easily taken for `payload_friction`, `growth_angle` or `area_scale`, which change another force; where every
trial has a payload, for `film_mass`, and for horizontal growth exactly for `reel_inertia`.

Reduce it by weighing the payload as it is put in, mount and tape included.

Source: Eq. (2) of Alvarez et al. (2025).
"""

from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.effects import Parameter, Worked

KIND = "measurement"
NEEDS = ("payload_g",)
PARAMETERS = (
    Parameter(
        "delta",
        "δ",
        "kg",
        5e-3,
        bounds=(-1.0, 1.0),
        shared="vine",
        plausible=(-0.02, 0.05),
        meaning="mass of the payload beyond the stated one",
    ),
)


def added_mass(s, rig, delta):
    if rig.payload_mass <= 0.0:
        return 0.0 * s.lead_position
    return max(delta, -rig.payload_mass) + 0.0 * s.lead_position


def tail_force(s, rig, delta):
    if rig.payload_mass <= 0.0:
        return 0.0 * s.lead_position
    return max(delta, -rig.payload_mass) * GRAVITY_M_S2 * rig.cos_angle + 0.0 * s.lead_position


WORKED = (
    Worked(
        "added_mass",
        0.006,
        "a mount of 6 g",
        state={"lead_position": 0.1},
        rig={"payload_mass": 0.02},
        parameters={"delta": 0.006},
    ),
    Worked(
        "added_mass",
        -0.02,
        "no less than none",
        state={"lead_position": 0.1},
        rig={"payload_mass": 0.02},
        parameters={"delta": -0.1},
    ),
    Worked(
        "tail_force",
        0.05886,
        "6 g × 9.81, straight down",
        state={"lead_position": 0.1},
        rig={"payload_mass": 0.02, "cos_angle": 1.0},
        parameters={"delta": 0.006},
    ),
)
