"""End stop: beyond some growth the vine runs into something soft: a wall of foam, a cord that tightens, a seam.

Matters beyond y₀ and not at all before; a stiff one ends the growth before all film is everted.

    tail force −k max(0, y − y₀)

k is the stiffness at the tail and y₀ the growth at which it begins, the same for all trials. A vine that has come to
rest against it stays there: it does not rebound.

Easily taken for `tail_friction`, or for the end of growth where the sheet's length is too large. A trial of another
length tells them apart: the end of growth moves with the length, a stop in the room does not.

Reduce it by clearing the way. Measure it by pushing a grown vine against it with a spring balance.

Source: a linear spring with a gap, the simplest contact that has a place and a stiffness.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

PARAMETERS = (
    Parameter("k", "k", "N/m", 20.0, bounds=(0.0, 1e6), plausible=(0.0, 1e4), meaning="stiffness at the tail"),
    Parameter(
        "y_0",
        "y₀",
        "m",
        0.1,
        bounds=(1e-3, 1e2),
        zero=0.1,
        plausible=(0.03, 10.0),
        tried=tuple(float(y) for y in np.geomspace(0.02, 2.0, 20)),
        meaning="growth at which it begins",
    ),
)


def tail_force(s, rig, k, y_0):
    return -k * np.maximum(s.lead_position - y_0, 0.0)


def breakpoints(rig, k, y_0):
    return (y_0,)


WORKED = (
    Worked("tail_force", -0.4, "20 N/m × (0.12 − 0.10) m", state={"lead_position": 0.12}),
    Worked("tail_force", 0.0, "not reached", state={"lead_position": 0.09}),
)
