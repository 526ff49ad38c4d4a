"""Pressure gain: the scale of the gauge is wrong, for P and P_y alike.

Matters at every pressure in proportion; pressures rounded to whole psi err by up to 1.5 %.

    P → (1 + ε) P and P_y → (1 + ε) P_y, true from read

Easily taken for B together with the time base or the length scale, and for `area_scale`, from which nothing tells it
apart where the film is weighed.

Reduce it by calibrating the gauge against a column of water or a second gauge.

Source: the linear error of a gauge; Eq. (2) of Alvarez et al. (2025) depends on pressure only through PA.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 4
PARAMETERS = (
    Parameter("eps", "ε", "1", 0.02, bounds=(-0.5, 0.5), plausible=(-0.05, 0.05), meaning="relative error of P"),
)


def gauge(s, rig, eps):
    return s.pressure * (1.0 + eps)


def yield_gauge(s, rig, eps):
    return s.yield_pressure * (1.0 + eps)


WORKED = (
    Worked("gauge", 28.56e3, "28 kPa × 1.02", state={"pressure": 28e3}),
    Worked("yield_gauge", 3.06e3, "3 kPa × 1.02", state={"yield_pressure": 3e3}),
)
