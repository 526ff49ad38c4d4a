"""Static yield: a vine at rest needs more pressure to start than to go on.

Matters where motion stops, or pressure rises slowly through the threshold: growth is intermittent, by stick and slip.
On a vine released at full pressure it has no effect, and such data cannot test it.

    at rest, eversion starts only above P_s > P_y: tip force −(P_s − P_y)A until it moves

Easily taken for nothing else, unless motion never stops while filmed: then it is not testable here. A single stop looks
like a lower P_y or a faster loss of pressure.

Reduce it by growing well above the threshold. Test it by raising the pressure slowly while filming.

Source: static and kinetic friction, applied to the yield pressure of Blumenschein, Okamura, Hawkes (2017), Biomimetic
and Biohybrid Systems, 522–531.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

NEEDS = ("yield_pressure_kPa",)
PARAMETERS = (
    Parameter(
        "P_s", "P_s", "Pa", 6e3, bounds=(0.0, 1e6), plausible=(1e3, 30e3), meaning="gauge pressure that starts growth"
    ),
)


def rest_force(s, rig, P_s):
    return -np.maximum(P_s - s.yield_pressure, 0.0) * s.area


WORKED = (
    Worked(
        "rest_force",
        -0.90478,
        "(5 − 3) kPa × 4.5239e-4 m²",
        state={"area": 4.5239e-4, "yield_pressure": 3e3},
        parameters={"P_s": 5e3},
    ),
    Worked(
        "rest_force",
        0.0,
        "below P_y it adds nothing",
        state={"area": 4.5239e-4, "yield_pressure": 3e3},
        parameters={"P_s": 2e3},
    ),
)
