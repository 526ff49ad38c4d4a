"""Reservoir depletion: the chamber's gas expands into the growing vine, and its pressure falls.

Matters wherever A·L is more than a thousandth of V₀, most at low gauge pressure and late in growth. A regulator that
refills the chamber works against it (`supply_refill`).

    P → (P₀ + P_atm) (V₀ / (V₀ + A y))^γ − P_atm

V₀ is the chamber's volume and A·y the volume that the vine has filled. Boyle's law needs absolute pressure: a
volume change of a few per cent takes tens of per cent off a small gauge pressure. With 3.7 L and a vine of 24 mm × 280
mm, 28 kPa falls by 15 % (γ = 1, slow enough to stay at room temperature) to 21 % (γ = 1.4, too fast to exchange heat);
7 kPa by 51 to 71 %.

V₀ includes hoses and all else that is open to the vine. An error of V₀ shows in γ, which is then that of the gas times
the ratio of stated to true volume, as long as V₀ is much larger than the filled volume.

Easily taken for `tail_friction` in the first half of growth (all along with a reel), or for a `leak` at constant speed.
Another chamber or another diameter tells them apart.

Reduce it with a larger chamber beside the inlet, or measure the pressure during growth and give it as a trace. A γ
outside 1 to 1.4 is an error of the stated volume: the true one is 1/γ to 1.4/γ times as large, hoses included.

Source: the gas laws; Alvarez et al. (2025), section III-B, uses gauge pressure in P₂ = P₁V₁/V₂, which hides the effect.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("chamber_l",)
IN_TRACE = True
ORDER = 1
PARAMETERS = (
    Parameter(
        "gamma",
        "γ",
        "1",
        1.4,
        bounds=(0.6, 2.4),
        plausible=(1.0, 1.4),
        meaning="1 isothermal, 1.4 adiabatic; times the stated over the true volume of the chamber",
    ),
)


def pressure(s, rig, gamma):
    volume_ratio = rig.chamber_volume / (rig.chamber_volume + s.area * s.lead_position)
    return (s.pressure + rig.ambient_pressure) * volume_ratio**gamma - rig.ambient_pressure


WORKED = (
    Worked(
        "pressure",
        2.013e3,
        "108325 × (3.7/3.82667)^1.4 − 101325: 71 % below 7 kPa",
        state={"pressure": 7e3, "area": 4.5239e-4, "lead_position": 0.28},
        rig={"chamber_volume": 3.7e-3, "ambient_pressure": 101_325.0},
    ),
)
