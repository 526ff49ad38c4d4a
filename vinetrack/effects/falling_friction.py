"""Falling friction: a friction on the tail that is largest at rest and falls with speed, as in stick and slip.

Matters on slow vines, at the start and wherever motion nearly stops: dry film on film holds more than film that slides.

    tail force −F_s exp(−(ẋ/v_s)^k), against the motion

F_s is the friction at rest beyond that of sliding, v_s the tail speed at which it has fallen to 1/e; k = 1 falls from
rest on, k = 2 is flat at first. With F_s above the drive the vine never starts.

Easily taken for `static_yield` or a smaller n of `eversion_damping`; with v_s far below all speeds it is a
`latch_release`. Trials at low and at high pressure tell them apart: what falls with speed hardly counts in fast
ones.

Reduce it with powder or oil on the film, or by growing faster. Measure it with a spring balance: pull the tail through
a held vine at several speeds.

Source: Stribeck's curve in the form of Bo & Pavelescu (1982), Wear 82, 277–289, where k lies between 1/2 and 1 for dry
contacts, and 2 is the Gaussian form of Tustin's rule; Armstrong-Hélouvry, Dupont, Canudas de Wit (1994), Automatica 30,
1083–1138.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
FINITE = True
PARAMETERS = (
    Parameter(
        "F_s", "F_s", "N", 0.2, bounds=(0.0, 1e3), plausible=(0.0, 5.0), meaning="friction at rest beyond sliding"
    ),
    Parameter(
        "v_s",
        "v_s",
        "m/s",
        0.5,
        bounds=(1e-2, 30.0),
        zero=0.5,
        plausible=(0.05, 3.0),
        meaning="speed at which it has fallen to 1/e",
    ),
    Parameter(
        "k",
        "k",
        "1",
        1.0,
        bounds=(1.0, 2.0),
        zero=1.0,
        plausible=(1.0, 2.0),
        tried=(1.0, 2.0),
        meaning="1: falls from rest on; 2: flat at first",
    ),
)


def tail_force(s, rig, F_s, v_s, k):
    return -F_s * np.exp(-((np.maximum(s.tail_velocity, 0.0) / v_s) ** k))


WORKED = (
    Worked("tail_force", -0.2, "at rest, whole", state={"tail_velocity": 0.0}),
    Worked("tail_force", -0.027067, "0.2 × e^(−1.0/0.5) = 0.2 × 0.135335", state={"tail_velocity": 1.0}),
    Worked(
        "tail_force",
        -0.155760,
        "0.2 × e^(−(0.25/0.5)²) = 0.2 × 0.778801",
        state={"tail_velocity": 0.25},
        parameters={"k": 2.0},
    ),
)
