"""Time base: the frame rate was not the stated one.

Matters where the rate was set by hand, read from a container that plays back slowly, or drifts with the camera's
temperature. The relative error of speeds is that of the rate.

    t → (1 + ε) t, reported from true

Easily taken for `length_scale` (speed alone cannot tell them apart) or `pressure_gain`; on horizontal vines a gain of
pressure and B together imitate it. Gravity does not: a falling body measures the rate.

Reduce it by filming a strobe, a clock or a falling ball.

Source: dimensional analysis of Eq. (2) of Alvarez et al. (2025).
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
PARAMETERS = (
    Parameter(
        "eps",
        "ε",
        "1",
        0.02,
        bounds=(-0.95, 19.0),
        shared="day",
        plausible=(-0.1, 0.1),
        tried=(3.0, -0.75),
        meaning="relative error of time",
        slips=(
            (1.0, "half the frame rate was stated"),
            (-0.5, "twice the frame rate was stated"),
            (9.0, "a tenth of the frame rate was stated"),
            (-0.9, "ten times the frame rate was stated"),
        ),
    ),
)


def true_time(s, rig, eps):
    return s.time / (1.0 + eps)


WORKED = (Worked("true_time", 0.1, "0.102 s/1.02", state={"time": 0.102}),)
