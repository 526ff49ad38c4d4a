"""Eversion damping: everting the film takes more force at higher speed.

Matters always: it sets the steady speed of a fast vine.

    tip force −B ẋⁿ, on the tail −½B ẋⁿ, by ½ = 1/r

A power law of the tail speed, with n near 0.37 for thermoplastic polyurethane and B growing with scale and thickness:
buckling, wrinkling and the film's nonlinear viscoelasticity together. B belongs to one vine, n to the material.

Easily taken for `linear_damping` (n near 1) or `pressure_damping` (a B that drifts with pressure).

Reduce it with thinner or softer film, and powder or oil on the fold.

Source: Alvarez et al. (2025), third term of Eq. (1) (printed there as Bxⁿ; it is a power of the speed).
"""

from vinetrack.effects import Parameter, Worked

KIND = "base"
PARAMETERS = (
    Parameter(
        "B",
        "B",
        "N·(s/m)ⁿ",
        3.0,
        bounds=(0.0, 1e3),
        shared="vine",
        plausible=(0.1, 20.0),
        meaning="damping coefficient",
    ),
    Parameter("n", "n", "1", 0.37, bounds=(0.0, 2.0), zero=0.37, plausible=(0.2, 0.6), meaning="damping exponent"),
)


def tip_force(s, rig, B, n):
    return -B * s.damping_gain * s.tail_velocity**n


WORKED = (
    Worked(
        "tip_force",
        -10.853,
        "6.44 × 4.1^0.37 = 6.44 × 1.6855",
        state={"tail_velocity": 4.1, "damping_gain": 1.0},
        parameters={"B": 6.44},
    ),
)
