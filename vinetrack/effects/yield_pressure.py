"""Yield pressure: the film resists eversion even when that is slow.

Matters near the threshold: at 7 kPa a P_y of 3 kPa takes 43 % of the drive.

    tip force −P_y A, on the tail −½P_y A, by ½ = 1/r

P_y is the gauge pressure at which eversion begins, measured for each vine on the same gauge as P (`yield_pressure_kPa`
of the trial sheet, with its error).

Easily taken for an offset of the gauge, `pressure_gauge`: exactly the same in the base model; and for B where n is 0.

Reduce it with thinner, more slippery film.

Source: Blumenschein, Okamura, Hawkes (2017); Alvarez et al. (2025), fourth term of Eq. (1).
"""

from vinetrack.effects import Worked

KIND = "base"
NEEDS = ("yield_pressure_kPa",)


def tip_force(s, rig):
    return -s.yield_pressure * s.area


WORKED = (Worked("tip_force", -1.3572, "3 kPa × 4.5239e-4 m²", state={"area": 4.5239e-4, "yield_pressure": 3e3}),)
