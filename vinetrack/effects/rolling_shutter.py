"""Rolling shutter: the rows of a picture are read one after the other, so that the edge is seen later along the rows.

Matters for cameras without a global shutter whose rows lie across the growth: a readout of 1 ms over 0.3 m is
s = 3.3 ms/m, and an edge at 5 m/s is then seen 1.7 % too far (s ẏ).

    t → t + s y, when what is stamped t was seen; to first order y → y / (1 − s ẏ)

Growth against the direction of the readout has s < 0. The acceleration within the delay is left out: at 100 m/s² and a
delay of 0.4 ms that is 8 µm.

Easily taken for `time_base` or `length_scale`: speeds err by a part that grows with the speed. A second camera, or the
same one turned by 180°, tells them apart.

Reduce it with a global shutter, or by turning the camera until the rows lie along the growth.

Source: the geometry of a readout at constant speed; Meingast, Geyer & Sastry (2005), Geometric models of
rolling-shutter cameras, arXiv cs/0503076.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 4  # convention: see `Effect`, its place among those of one hook
EASILY_TAKEN_FOR = ("time_base", "length_scale")
PARAMETERS = (
    Parameter("delay", "s", "s/m", 2e-3, bounds=(-0.1, 0.1), plausible=(-0.01, 0.01), meaning="delay along the growth"),
)


def observed_position(s, rig, delay):  # noqa: ARG001, D103
    return s.observed / np.maximum(1.0 - delay * s.lead_velocity, 0.1)


WORKED = (
    Worked(
        "observed_position",
        0.20202,
        "0.2/(1 − 2e-3 × 5) = 0.2/0.99",
        state={"observed": 0.2, "lead_velocity": 5.0},
        parameters={"delay": 2e-3},
    ),
    Worked(
        "observed_position",
        0.2,
        "of no size",
        state={"observed": 0.2, "lead_velocity": 5.0},
        parameters={"delay": 0.0},
    ),
)
