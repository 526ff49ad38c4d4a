"""Trace clock: the clock of the recorded pressure is ahead of the camera's, or behind it.

Matters where pressure and pictures are recorded by two devices without a common trigger: at 2 m/s an offset of 3 ms
is 6 mm of growth.

    t → t + δ_t, time of a trace sample stamped t, on the clock of the camera

Only trials with a pressure recorded during growth depend on it.

Easily taken for `latch_release` where the pressure rises while the vine is filmed: the vine seems to wait. A lamp that
both devices record tells them apart.

Reduce it by triggering both from one signal.

Source: none; the difference of two clocks that run at the same rate.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
PARAMETERS = (
    Parameter("delta", "δ_t", "s", 2e-3, bounds=(-0.5, 0.5), plausible=(-0.05, 0.05), meaning="offset of the clocks"),
)


def trace_time(s, rig, delta):
    return s.time + delta


WORKED = (Worked("trace_time", 0.102, "0.1 s + 2 ms", state={"time": 0.1}),)
