"""Latch release: what holds the vine before release does not let go at once.

Matters in the first centimetre: a clamp that opens, a plug that slides out, a film that sticks to itself.

    tail force −F_l exp(−y/ℓ), F_l < ½(P − P_y)A

With F_l as large as the drive the vine never starts; ℓ is the growth over which the grip is lost.

Easily taken for a later release: a slow start and a late one look alike on few frames. A higher frame rate, or a
contact that shows when the latch opened, tells them apart.

Reduce it with a latch that opens in less than a frame: a burnt thread, a magnet.

Source: none; an exponential decay over a length is the simplest force that holds first and then lets go.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter("F", "F_l", "N", 0.2, bounds=(0.0, 1e3), plausible=(0.0, 5.0), meaning="grip at release"),
    Parameter(
        "reach", "ℓ", "m", 5e-3, bounds=(1e-4, 0.3), zero=5e-3, plausible=(1e-3, 30e-3), meaning="growth to let go"
    ),
)


def tail_force(s, rig, F, reach):
    return -F * np.exp(-s.lead_position / reach)


WORKED = (
    Worked("tail_force", -0.2, "at rest, whole", state={"lead_position": 0.0}),
    Worked("tail_force", -0.027067, "0.2 × e^(−10/5) = 0.2 × 0.135335", state={"lead_position": 10e-3}),
)
