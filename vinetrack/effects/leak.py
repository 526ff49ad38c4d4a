"""Leak: gas escapes through the seam or the inlet while the vine grows.

Matters where growth takes longer than a hundredth of the time the pressure would need to bleed away: slow growth near
the yield pressure, old vines, no supply.

    P → P e^(−t/τ), t from release

The parameter is the rate 1/τ: it is 0 without a leak, and the loss of pressure is proportional to it.

Easily taken for `reservoir_depletion`, which falls with the volume swept and so, at constant speed, with time as well.
Growth at two speeds on one chamber tells them apart.

Reduce it by sealing; measure it on the blocked vine: shut the valve and watch the gauge.

Source: the isothermal emptying of a volume through a laminar leak, linearised; any textbook on gas flow.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

IN_TRACE = True
ORDER = 2
PARAMETERS = (
    Parameter(
        "rate", "1/τ", "1/s", 0.5, bounds=(0.0, 50.0), plausible=(0.0, 5.0), meaning="fraction of P lost per second"
    ),
)


def pressure(s, rig, rate):
    return s.pressure * np.exp(-rate * s.time)


WORKED = (
    Worked("pressure", 25.335e3, "28000 × e^(−0.5 × 0.2) = 28000 × 0.904837", state={"pressure": 28e3, "time": 0.2}),
)
