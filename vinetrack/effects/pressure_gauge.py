"""Pressure gauge: the gauge for P has a constant error, and P_y was not read on it.

Matters most near the yield pressure: 0.5 kPa is a tenth of P − P_y at 8 kPa over 3 kPa.

    P → P + δ, P_y unchanged, true from read

Read on one gauge, δ cancels in P − P_y and nothing changes.

Easily taken for an error of P_y, which each vine has of its own: in the base model P_y − δ is exactly the same, and no
trial tells them apart. A constant friction F of the tail is the same as δ = −2F/A.

Reduce it by zeroing the gauge before each trial, and reading P_y on it too: an error of P_y looks exactly the same, so
measure that again as well.

Source: the zero error of a gauge; Eq. (2) of Alvarez et al. (2025) depends on P − P_y only.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 5
PARAMETERS = (
    Parameter(
        "delta", "δ", "Pa", 500.0, bounds=(-2e4, 2e4), shared="vine", plausible=(-2e3, 2e3), meaning="true minus read"
    ),
)


def gauge(s, rig, delta):
    return s.pressure + delta


WORKED = (Worked("gauge", 28.5e3, "28 kPa + 0.5 kPa", state={"pressure": 28e3}),)
