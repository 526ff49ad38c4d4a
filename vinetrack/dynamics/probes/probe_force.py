"""Probe force: a small local force with which the diagnosis tests for misfit that no candidate effect explains.

It is not a physical effect and not in the catalogue. Its size is always zero; only the sensitivities of the
trajectories to it are used.

    tail force a·exp(−½((q − q₀)/w)²), q one of y/L, ẋ, t, each with or without the factor P

`kind` states which: 0 y/L, 1 ẋ, 2 t; and 3, 4, 5 the same times P over 10⁵ Pa.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

PARAMETERS = (
    Parameter("size", "a", "N", 0.1, bounds=(-1e3, 1e3), meaning="force at the centre"),
    Parameter("kind", "kind", "1", 0.0, bounds=(0.0, 5.0), meaning="variable it depends on"),
    Parameter("centre", "q₀", "1", 0.5, zero=0.5, meaning="centre"),
    Parameter("width", "w", "1", 0.1, zero=0.1, meaning="width"),
)


def tail_force(s, rig, size, kind, centre, width):
    position = s.lead_position / rig.length if rig.length > 0.0 else s.lead_position
    coordinate = position
    if kind == 1.0 or kind == 4.0:
        coordinate = s.tail_velocity
    if kind == 2.0 or kind == 5.0:
        coordinate = s.time
    factor = size * s.pressure / 1e5 if kind > 2.5 else size
    return factor * np.exp(-0.5 * ((coordinate - centre) / width) ** 2)


WORKED = (
    Worked(
        "tail_force",
        0.060653,
        "one width from the centre: 0.1 × e^(−1/2)",
        state={"lead_position": 0.12},
        rig={"length": 0.2},
        parameters={"size": 0.1, "kind": 0.0, "centre": 0.5, "width": 0.1},
    ),
    Worked(
        "tail_force",
        0.02,
        "at the centre, as a function of speed, at 20 kPa",
        state={"tail_velocity": 4.0, "pressure": 2e4},
        parameters={"size": 0.1, "kind": 4.0, "centre": 4.0, "width": 1.0},
    ),
)
