"""Growth angle: stated from the horizontal instead of from straight down, so that the weight has the wrong direction.

Matters with a payload: a hanging vine stated as horizontal (90 for 0), or a horizontal one whose blank angle counts
as straight down, has the whole weight wrong: 0.35 N with 35.6 g, as much as 1.5 kPa on 24 mm.

    tail force +m(x) g f (sinθ − cosθ)

θ is the growth angle as stated and f the size of the error: 1 is horizontal for straight down or straight down for
horizontal, 2 up for down. A tilt lies in between: 20° from straight down are 0.06, 20° from the horizontal 0.34.

Easily taken for `payload_friction`, or P_y and B where all trials carry one payload. The film, whose weight
vanishes as the vine grows, tells it from them, except on vines of light film, 0.1 mm on 12 mm.

Measure it with a plumb-line beside the vine, and look at a picture of the rig: straight down is 0, horizontal 90, up
180.

Source: Alvarez et al. (2025), Eq. (1).
"""

import numpy as np

from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.effects import Parameter, Worked

KIND = "measurement"
NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter(
        "f",
        "f",
        "1",
        1.0,
        bounds=(0.0, 2.0),
        plausible=(0.8, 1.2),
        meaning="1 where the angle was stated from the horizontal and not from straight down",
    ),
)


def tail_force(s, rig, f):
    sine = np.sqrt(np.maximum(1.0 - rig.cos_angle**2, 0.0))
    return s.moving_mass * GRAVITY_M_S2 * f * (sine - rig.cos_angle)


WORKED = (
    Worked(
        "tail_force",
        0.069847,
        "35.6 g × 9.81 × (0.8 − 0.6): stated 53° from straight down, 37° in truth",
        state={"moving_mass": 35.6e-3},
        rig={"cos_angle": 0.6},
    ),
)
