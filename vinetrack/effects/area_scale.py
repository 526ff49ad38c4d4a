"""Area scale: the diameter is wrong, for example because the flattened tube was measured.

Matters as twice its size on the drive: 1 % of 12 mm is 0.12 mm, 2 % of PA.

    D → (1 + ε) D: A → (1 + ε)² A, λ → (1 + ε) λ, true from measured

λ follows because it is computed from D.

Easily taken for `pressure_gain`: with a heavy payload, or where λ is weighed, nothing tells them apart, except
depletion, which depends on the swept volume.

Reduce it by measuring the width of the flattened tube: the diameter is 2/π of it; or the inflated vine with callipers.

Source: the geometry of a tube; Eq. (2) of Alvarez et al. (2025).
"""

import math

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 2
PARAMETERS = (
    Parameter(
        "eps",
        "ε",
        "1",
        0.02,
        bounds=(-0.6, 1.5),
        shared="vine",
        plausible=(-0.05, 0.05),
        meaning="relative error of D",
        slips=(
            (2 / math.pi - 1, "the width of the flattened tube was taken for its diameter"),
            (1.0, "the radius was taken for the diameter"),
            (-0.5, "the diameter was taken for the radius, and doubled"),
        ),
    ),
)


def area(s, rig, eps):
    return s.area * (1.0 + eps) ** 2


def film_gain(s, rig, eps):
    return 1.0 + eps


WORKED = (
    Worked("area", 4.7067e-4, "4.5239e-4 × 1.02²", state={"area": 4.5239e-4}),
    Worked("film_gain", 1.02, "1 + 0.02"),
)
