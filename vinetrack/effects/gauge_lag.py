"""Gauge lag: the gauge shows a recorded pressure late, through a line, a filter or its own slowness.

Matters where the pressure changes while the vine is filmed: 10 ms behind a pressure that falls by 50 kPa/s is 0.5 kPa.

    P → P + τ dP/dt, true from read

It is a first-order lag; τ = 0 is none. Only trials with a pressure recorded during growth depend on it.

Easily taken for `trace_clock`: a pressure that changes evenly is late by τ. Only where it bends do they differ: a clock
moves the bend, a lag rounds it off. A step of pressure in the vine at rest tells them apart.

Reduce it with a gauge at the chamber itself, a short line to it, and no filter.

Source: the first-order response of a sensor; Doebelin (2003), Measurement Systems, 5th ed., McGraw-Hill, chapter 3.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
PARAMETERS = (
    Parameter("tau", "τ_g", "s", 5e-3, bounds=(0.0, 1.0), plausible=(0.0, 0.05), meaning="time constant of the gauge"),
)


def trace_pressure(s, rig, tau):
    return s.pressure + tau * s.pressure_slope


WORKED = (
    Worked("trace_pressure", 27.75e3, "28 kPa − 5 ms × 50 kPa/s", state={"pressure": 28e3, "pressure_slope": -50e3}),
)
