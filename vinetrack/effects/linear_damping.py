"""Linear damping: a resistance proportional to speed, in addition to the power law of eversion.

Matters where something viscous moves along: a wet or lubricated tail, a grease seal, a roller in its bearing.

    tip force −b ẋ, on the tail −½b ẋ, by ½ = 1/r

Easily taken for a larger n of `eversion_damping`; if n is 1 it is the same force. A wide range of speeds on one vine
tells them apart.

Reduce it by drying the film and taking bearings and seals out of the tail's way.

Source: viscous friction. Blumenschein, Okamura, Hawkes (2017), Biomimetic and Biohybrid Systems, 522–531, put all that
depends on speed in one power law.
"""

from vinetrack.effects import Parameter, Worked

PARAMETERS = (
    Parameter("b", "b", "N·s/m", 0.05, bounds=(0.0, 100.0), plausible=(0.0, 1.0), meaning="linear damping coefficient"),
)


def tip_force(s, rig, b):
    return -b * s.tail_velocity


WORKED = (Worked("tip_force", -0.41, "0.1 N·s/m × 4.1 m/s", state={"tail_velocity": 4.1}, parameters={"b": 0.1}),)
