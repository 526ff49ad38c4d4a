"""Perspective: the plane of growth is tilted to the sensor, so that the scale changes along the growth.

Matters for a camera that is not square to the growth: a tilt of 1° seen from 1 m is k = 0.017 1/m, half a millimetre
at 0.17 m of growth.

    y → y + k y², reported from true

k is the sine of the tilt over the distance of the camera; the origin and the scale at release are right.

Easily taken for `tail_friction` or `reservoir_depletion`: a slow change along y. A ruler in the picture tells.

Reduce it with a long lens far away, square to the plane, or a target that fills the plane.

Source: the projection of a tilted plane to second order;
Hartley & Zisserman (2004), Multiple View Geometry in Computer Vision.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 4
PARAMETERS = (
    Parameter(
        "k",
        "k",
        "1/m",
        0.05,
        bounds=(-3.0, 3.0),
        shared="day",
        plausible=(-0.3, 0.3),
        meaning="change of scale along y",
    ),
)


def observed_position(s, rig, k):
    return s.observed * (1.0 + k * s.observed)


WORKED = (Worked("observed_position", 0.202, "0.2 + 0.05 × 0.2²", state={"observed": 0.2}),)
