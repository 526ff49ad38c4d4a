"""Reel inertia: a reel, spool or pulley that the tail turns has to be accelerated with it.

Matters where everything accelerates, and most on light vines: a reel of 20 g on its rim moves like five times the film
of a small vine.

    M = J/r² moves with the tail, J the reel's moment of inertia, r the radius at which the tail leaves it

It has no weight along the growth. The film still on the reel counts as part of J; its decrease is neglected.

Easily taken for `gas_inertia` or `latch_release`: all slow the start. `payload_g` that is too small looks the same on a
horizontal vine; on a vertical one a payload's weight tells them apart.

Reduce it with a light reel of small radius, or by letting the tail lie loose. Measure it by letting a known weight
unwind the reel: M is the apparent additional mass of that weight.

Source: rotation about a fixed axis; Hawkes, Blumenschein, Greer, Okamura (2017), Science Robotics 2, eaan3028, store
the tail on a reel in the base.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter(
        "M", "M", "kg", 0.01, bounds=(0.0, 100.0), plausible=(0.0, 1.0), meaning="J/r² of the reel that the tail turns"
    ),
)


def added_mass(s, rig, M):
    return M + 0.0 * s.lead_position


WORKED = (
    Worked(
        "added_mass",
        0.02,
        "J = 3.2e-5 kg m² at r = 40 mm: 3.2e-5 / 0.04² kg",
        state={"lead_position": 0.1},
        parameters={"M": 3.2e-5 / 0.04**2},
    ),
)
