"""Tail friction: the tail drags along the inside of the body it runs through.

Matters for long vines, above some 30 cm: the length in contact grows with y. With the tail stored behind the base it
decreases again in the second half, when the tail runs out; a tail that comes off a reel always fills the body.

    tail force −(μ_s w) min(y, L − y); with `tail_store: reel` −(μ_s w) y

μ_s is the film's friction on itself and w the contact force per metre; from the film's weight alone μ_s w is below
0.2 N/m, clinging film reaches more.

Easily taken for `reservoir_depletion` in the first half of growth, or all along with a reel. Another chamber or another
diameter tells them apart; so does the second half.

Reduce it with powder or oil between tail and wall, or a shorter vine. Measure it with a spring balance: pull the tail
through a vine that is grown half-way and held.

Source: Alvarez et al. (2025), μ_s w L of Eq. (1); Blumenschein, Okamura, Hawkes (2017) give the friction along a
straight body.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter(
        "mu_w",
        "μ_s w",
        "N/m",
        0.5,
        bounds=(0.0, 1e3),
        plausible=(0.0, 10.0),
        meaning="friction per metre of tail inside the body",
    ),
)


def tail_force(s, rig, mu_w):
    if rig.tail_on_reel > 0.0:
        return -mu_w * s.lead_position
    return -mu_w * np.minimum(s.lead_position, rig.length - s.lead_position)


def breakpoints(rig, mu_w):
    return () if rig.tail_on_reel > 0.0 else (rig.length / 2,)


WORKED = (
    Worked(
        "tail_force",
        -0.05,
        "0.5 N/m × 0.10 m of 0.28 m",
        state={"lead_position": 0.1},
        rig={"length": 0.28, "tail_on_reel": 0.0},
    ),
    Worked(
        "tail_force",
        -0.04,
        "0.5 N/m × (0.28 − 0.20) m",
        state={"lead_position": 0.2},
        rig={"length": 0.28, "tail_on_reel": 0.0},
    ),
)
