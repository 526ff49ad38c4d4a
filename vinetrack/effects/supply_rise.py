"""Supply rise: a valve opens, and the pressure rises with a time constant instead of at once.

Matters where growth begins when a valve opens rather than when a latch lets go of a vine under pressure: 6 ms are a
fifth of the growth of a small vine at 30 kPa.

    P → P (1 − e^(−(t/τ_v)^k)), t from the opening of the valve

τ_v = 0 is an immediate rise. k = 1 is a volume that fills through a fixed opening; a valve whose opening
itself takes time gives an S, k from 2 to 4.

Easily taken for `latch_release`, or a later release: a slow start and a late one look alike on few frames. A pressure
measured beside the inlet tells them apart, and then takes the place of this effect.

Reduce it with a valve of larger bore close to the vine, or hold the vine under full pressure and release a latch.

Source: for k = 1 the filling of a volume through a resistance, to first order; Beater (2007), Pneumatic Drives,
Springer. The exponent is the shape of Weibull's distribution (J. Appl. Mech. 18, 293, 1951), taken as the simplest
family that goes from an exponential to an S.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

IN_TRACE = True
ORDER = 2
FINITE = True
PARAMETERS = (
    Parameter("tau", "τ_v", "s", 5e-3, bounds=(0.0, 2.0), plausible=(0.0, 0.05), meaning="time in which a valve opens"),
    Parameter(
        "shape",
        "k",
        "1",
        1.0,
        bounds=(0.5, 8.0),
        zero=1.0,
        plausible=(1.0, 4.0),
        meaning="1: an exponential rise; 2 to 4: an S, from a valve that itself opens slowly",
    ),
)


def pressure(s, rig, tau, shape):
    if tau <= 0.0:
        return s.pressure
    return s.pressure * (1.0 - np.exp(-((np.maximum(s.time, 0.0) / tau) ** shape)))


WORKED = (
    Worked("pressure", 24.211e3, "28000 × (1 − e^(−10/5)) = 28000 × 0.864665", state={"pressure": 28e3, "time": 10e-3}),
    Worked(
        "pressure",
        6193.6,
        "28000 × (1 − e^(−0.5²)) = 28000 × 0.221199, twice as late 28000 × (1 − e^(−1)) = 17699",
        state={"pressure": 28e3, "time": 2.5e-3},
        parameters={"shape": 2.0},
    ),
)
