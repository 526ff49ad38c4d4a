"""Lens: radial distortion of a camera whose lens is not calibrated.

Matters for wide lenses and for any camera whose distortion was not measured: a barrel distortion of 1 % at the edge of
a picture 0.3 m wide displaces the leading edge there by 1.5 mm (1 % of 150 mm, k₃ = −0.44 1/m²).

    y → y + k₃ ((y − y_c)³ + y_c³), reported from true

y_c is the position at which the axis of growth passes the middle of the picture. The term y_c³ keeps the position at
release; the origin is free in every trial anyway.

Easily taken for `latch_release` (the first centimetres are stretched or compressed) or `perspective`: a change of scale
along y. A ruler or a checkerboard in the plane of growth tells them apart.

Reduce it by calibrating the camera with a target that fills the picture, or with a longer lens farther away.

Source: radial distortion to lowest order, Brown (1971), Close-range camera calibration, Photogramm. Eng. 37, 855.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 4
PARAMETERS = (
    Parameter(
        "k3", "k₃", "1/m²", 0.3, bounds=(-50.0, 50.0), shared="day", plausible=(-1.0, 1.0), meaning="radial distortion"
    ),
    Parameter(
        "y_c",
        "y_c",
        "m",
        0.12,
        bounds=(-1.0, 2.0),
        zero=0.12,
        plausible=(0.02, 0.3),
        meaning="growth at which the edge passes the middle of the picture",
    ),
)


def observed_position(s, rig, k3, y_c):
    off_centre = s.observed - y_c
    return s.observed + k3 * (off_centre * off_centre * off_centre + y_c * y_c * y_c)


WORKED = (
    Worked(
        "observed_position",
        0.200672,
        "0.2 + 0.3 × ((0.2 − 0.12)³ + 0.12³) = 0.2 + 0.3 × (5.12e-4 + 1.728e-3) = 0.2 + 6.72e-4",
        rel=1e-6,
        state={"observed": 0.2},
    ),
)
