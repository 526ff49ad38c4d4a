"""Pressure damping: the damping coefficient grows with pressure.

Matters in campaigns over a wide range of pressure: pressure stretches the wall and presses the folds together, so that
a vine does not have one B.

    B → B (1 + βP)

Easily taken for `wall_stretch`: both make the resistance, or the drive, grow with pressure. Trials at several pressures
show a B that drifts with P; a payload changes the speed at one pressure and tells the two apart.

It cannot be reduced; keep to a narrow range of pressure, or fit B at each.

Source: first order of the dependence of B on pressure that a power law leaves out; Blumenschein, Okamura, Hawkes (2017)
take the damping as independent of pressure.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

PARAMETERS = (
    Parameter(
        "beta",
        "β",
        "1/Pa",
        3e-6,
        bounds=(-1e-4, 1e-4),
        plausible=(-1e-5, 1e-5),
        meaning="relative change of B with pressure",
    ),
)


def damping_gain(s, rig, beta):
    return s.damping_gain * np.maximum(1.0 + beta * s.pressure, 0.0)


WORKED = (Worked("damping_gain", 1.084, "1 + 3e-6 × 28000", state={"pressure": 28e3, "damping_gain": 1.0}),)
