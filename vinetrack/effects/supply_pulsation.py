"""Supply pulsation: the pressure oscillates, as behind a pump or a hunting regulator.

Matters where the oscillation is slow enough for the vine to follow: at 20 Hz an amplitude of a twentieth of the
pressure moves the edge by millimetres, at 100 Hz by tenths of a millimetre.

    P → P (1 + a sin(2π f t + φ)), t from release

φ is shared by all trials: release is locked to the oscillation, or the oscillation begins with the opening. With a
random phase in each trial it is a deviation of single trials instead.

Easily taken for noise that is correlated, or where less than one period is filmed for `leak` and `reservoir_depletion`.
A pressure measured beside the inlet shows it, and then takes the place of this effect.

Reduce it with a chamber between pump and vine, ten times the volume that the vine takes. Measure it with a fast gauge.

Source: the first term of a Fourier series; reciprocating pumps and relay-controlled regulators are its usual causes.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

IN_TRACE = True
ORDER = 2
PARAMETERS = (
    Parameter("a", "a", "1", 0.05, bounds=(0.0, 0.9), plausible=(0.0, 0.2), meaning="relative amplitude"),
    Parameter(
        "f",
        "f",
        "Hz",
        20.0,
        bounds=(1.0, 500.0),
        zero=20.0,
        plausible=(5.0, 100.0),
        tried=tuple(float(f) for f in np.linspace(5.0, 95.0, 21)),
        meaning="frequency",
    ),
    Parameter(
        "phi",
        "φ",
        "rad",
        0.0,
        bounds=(-7.0, 7.0),
        plausible=(-np.pi, np.pi),
        period=2 * np.pi,
        tried=(-np.pi / 2, 0.0, np.pi / 2, np.pi),
        meaning="phase at release",
    ),
)


def pressure(s, rig, a, f, phi):
    return s.pressure * (1.0 + a * np.sin(2.0 * np.pi * f * np.maximum(s.time, 0.0) + phi))


WORKED = (
    Worked(
        "pressure",
        29.4e3,
        "28000 × (1 + 0.05 sin(2π × 25 × 0.010)) = 28000 × (1 + 0.05 sin(π/2))",
        state={"pressure": 28e3, "time": 10e-3},
        parameters={"f": 25.0},
    ),
    Worked(
        "pressure",
        28.7e3,
        "at release 28000 × (1 + 0.05 sin(π/6)) = 28000 × 1.025",
        state={"pressure": 28e3, "time": 0.0},
        parameters={"f": 25.0, "phi": np.pi / 6},
    ),
)
