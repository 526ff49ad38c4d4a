"""Pressure drive: the gas pushes the tip forward.

Matters always: it drives the growth, and all other terms are small or large relative to it.

    tip force +PA, on the tail +½PA, by ½ = 1/r

P is the gauge pressure that the other effects leave at the tip, A = πD²/4.

Easily taken for nothing, but an error of P or of D is an error of this: `pressure_gain`, `area_scale`.

Reduce it by the regulator.

Source: Blumenschein, Okamura, Hawkes (2017), Biomimetic and Biohybrid Systems, 522–531; Alvarez et al. (2025), Eq. (1).
"""

from vinetrack.effects import Worked

KIND = "base"


def tip_force(s, rig):
    return s.pressure * s.area


WORKED = (
    Worked(
        "tip_force", 12.667, "28 kPa × π(24 mm)²/4 = 28000 × 4.5239e-4", state={"pressure": 28e3, "area": 4.5239e-4}
    ),
)
