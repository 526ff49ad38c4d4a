"""Rolling shutter: rows of a picture are read one after the other, so the edge is recorded later along the growth.

Matters for cameras without a global shutter whose rows lie across the growth: a readout of 1 ms over 0.3 m is
s = 3.3 ms/m, and an edge at 5 m/s is then recorded 1.7 % too far (s ẏ).

    t → t + s y, time at which a position stamped t was recorded; at constant speed y → y / (1 − s ẏ)

Growth against the direction of the readout has s < 0. Changes of speed within the delay count: on a vine of 50 m/s the
acceleration moves the edge by half a millimetre in that time.

Easily taken for `time_base` or `length_scale`: the relative error of speed grows with the speed. A second camera, or
the same one turned by 180°, tells them apart.

Reduce it with a global shutter, or by turning the camera until the rows lie along the growth.

Source: the geometry of a readout at constant speed; Meingast, Geyer & Sastry (2005), Geometric models of
rolling-shutter cameras, arXiv cs/0503076.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 4
PARAMETERS = (
    Parameter("delay", "s", "s/m", 2e-3, bounds=(-0.1, 0.1), plausible=(-0.01, 0.01), meaning="delay along the growth"),
)


def row_delay(s, rig, delay):
    return delay


WORKED = (Worked("row_delay", 2e-3, "the delay itself"),)
