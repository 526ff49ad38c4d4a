"""Payload friction: the payload rubs along the wall of the vine it rides in.

Matters with a payload, most on a horizontal vine, where the payload's whole weight lies on the wall.

    tail force −μ_p m_pay g

On a vertical rig only clinging film and a crooked path press the payload on the wall: there μ_p is an effective
coefficient, not that of the materials.

Easily taken for an error of the growth angle (`growth_angle`) or of the payload's mass: both are forces proportional
to m_pay. Growth upwards and downwards tells it from an angle, which changes sign.

Reduce it with a smooth, round payload of smaller diameter, and powder. Measure it with a spring balance: pull the
payload through a vine that is held; and weigh it, and hold a plumb-line beside the vine.

Source: Coulomb's law of friction.
"""

from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.effects import Parameter, Worked

NEEDS = ("payload_g",)
PARAMETERS = (
    Parameter(
        "mu_p", "μ_p", "1", 0.3, bounds=(0.0, 10.0), plausible=(0.0, 1.5), meaning="friction of payload on the wall"
    ),
)


def tail_force(s, rig, mu_p):
    return -mu_p * rig.payload_mass * GRAVITY_M_S2 + 0.0 * s.lead_position


WORKED = (
    Worked("tail_force", -0.10477, "0.3 × 35.6 g × 9.81", state={"lead_position": 0.1}, rig={"payload_mass": 35.6e-3}),
)
