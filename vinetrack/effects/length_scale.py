"""Length scale: millimetres per pixel are wrong by a constant factor.

Matters always: the target stood before or behind the plane of growth, or its size was misread. One per cent of distance
to the camera is one per cent of length.

    y → (1 + ε) y, reported from true

Easily taken for an error of B or for drag; together with errors of frame rate, pressure and B it is undetectable in one
loaded trial, to a fraction of a micrometre. The end of growth at a known length shows it, and a stated length that is
off by as much looks the same, as one does that counts what was everted at the start.

Reduce it with a calibration target in the plane of growth, or a ruler beside the vine; measure what grows.

Source: the geometry of projection; Hartley & Zisserman (2004), Multiple View Geometry in Computer Vision.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 5
PARAMETERS = (
    Parameter(
        "eps",
        "ε",
        "1",
        0.02,
        bounds=(-0.65, 2.0),
        shared="day",
        plausible=(-0.1, 0.1),
        meaning="relative error of length",
        slips=(
            (1.0, "the travel of the tail was taken for that of the edge, or twice a length of the target was stated"),
            (-0.5, "half a length of the target was stated"),
            (1.54, "centimetres were taken for inches"),
            (1 / 2.54 - 1, "inches were taken for centimetres"),
        ),
    ),
)


def observed_position(s, rig, eps):
    return s.observed * (1.0 + eps)


WORKED = (Worked("observed_position", 0.102, "0.1 m × 1.02", state={"observed": 0.1}),)
