"""Moving average: positions that are means over an interval of time, not values at one instant.

Matters where positions were smoothed beforehand: five frames at 1069 frames/s are 4.7 ms, which rounds the release off
by up to a millimetre and shows a vine that moves before its release.

    y → mean of y from t − T/2 to t + T/2; where the acceleration lasts, y → y + ÿ T²/24

The parameter is T², to which the change of positions is proportional: for an average over N frames Δt apart it is
(N² − 1) Δt².

Easily taken for `supply_rise` and `latch_release`: the release is rounded off. Positions as they were measured tell
them apart.

Reduce it by giving positions as they were measured; a fit needs no smoothing.

Source: the second moment of a moving average; its frequency response is in Hamming (1989), Digital Filters, 3rd ed.,
chapter 3.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
ORDER = 5
PARAMETERS = (
    Parameter(
        "T2", "T²", "s²", 1e-5, bounds=(0.0, 1e-2), plausible=(0.0, 2.5e-3), meaning="square of the time averaged over"
    ),
)


def averaged_over(s, rig, T2):
    return T2


WORKED = (Worked("averaged_over", 2.1e-5, "(5² − 1) · (1/1069 s)²", parameters={"T2": 2.1e-5}),)
