"""Capstan friction: the tail runs around the bends of the body, and friction multiplies its tension in each.

Matters for bends above some 30° in all, not on a straight path. Bends come from the sheet (`bends`), and only those
that the tip has passed count; without any in the sheet, a path of constant curvature is assumed.

    tail force −C (exp(μ_c φ(y)) − 1), φ the angle the tip has passed
    without bends in the sheet −C (exp(k y) − 1); as printed, a constant −Σ C exp(μ_c φ_i)

C is the tail's tension before the bend. `mass_loss: as_printed` takes this term of the paper literally as well: the
whole of every bend (taken as equal ones) from the start, or a constant C without bends. μ_c is used with bends, k
without.

Easily taken for `tail_friction`: a small k y grows like y. A path with known bends, and one without, tell them apart.

Reduce it with fewer, wider bends and powder on the film. Measure it with a spring balance: pull a tail through the
bends with a known weight at its other end.

Source: the capstan equation (Euler, Eytelwein); Blumenschein, Okamura, Hawkes (2017); last term of Eq. (1) of Alvarez
et al. (2025).
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter("C", "C", "N", 0.05, bounds=(0.0, 100.0), plausible=(0.0, 1.0), meaning="tension before the bend"),
    Parameter("mu_c", "μ_c", "1", 0.5, bounds=(0.0, 5.0), zero=0.5, plausible=(0.0, 2.0), meaning="friction in bends"),
    Parameter(
        "k", "k", "1/m", 5.0, bounds=(0.0, 50.0), zero=5.0, plausible=(0.0, 20.0), meaning="μ_c × curvature, no bends"
    ),
)


def tail_force(s, rig, C, mu_c, k):
    if rig.as_printed > 0.0:
        count = max(rig.bend_count, 1.0)
        return -C * count * np.exp(mu_c * rig.bend_total / count) + 0.0 * s.lead_position
    if rig.has_bends > 0.0:
        return -C * (np.exp(mu_c * s.bend_angle) - 1.0)
    return -C * (np.exp(k * s.lead_position) - 1.0)


WORKED = (
    Worked(
        "tail_force",
        -0.11933,
        "a right angle passed: 0.1 × (e^(0.5 × 1.5708) − 1) = 0.1 × (2.19328 − 1)",
        state={"bend_angle": 1.5708, "lead_position": 0.2},
        rig={"as_printed": 0.0, "has_bends": 1.0},
        parameters={"C": 0.1},
    ),
    Worked(
        "tail_force",
        -0.17183,
        "no bends in the sheet: 0.1 × (e^(5 × 0.2) − 1)",
        state={"bend_angle": 0.0, "lead_position": 0.2},
        rig={"as_printed": 0.0, "has_bends": 0.0},
        parameters={"C": 0.1},
    ),
    Worked(
        "tail_force",
        -0.43866,
        "as printed, two right angles: 2 × 0.1 × 2.19328",
        state={"bend_angle": 0.0, "lead_position": 0.0},
        rig={"as_printed": 1.0, "has_bends": 1.0, "bend_count": 2.0, "bend_total": 3.14159},
        parameters={"C": 0.1},
    ),
)
