"""Supply refill: a regulator lets gas into the chamber while the growing vine draws it out.

Matters wherever depletion would and a supply is open: with a slow regulator (τ_s of seconds) the pressure falls as in
a closed chamber, with a fast one (τ_s far below the time of growth) it hardly falls at all. In between it falls early
and then recovers, which a closed chamber cannot do. It contains `reservoir_depletion`, which is inactive beside it.

    Ṗ = −γ (P + P_atm) A ẏ / (V₀ + A y) + (P_set − P) / τ_s

The first term is the gas law of `reservoir_depletion` (γ = 1 slow and isothermal, 1.4 fast and adiabatic), the second
the supply that closes the gap in a time τ_s. τ_s → 0 keeps the set pressure, so that nothing changes; τ_s → ∞ is the
closed chamber.

Easily taken for a smaller γ or a larger V₀ of a closed chamber; growth that takes longer than τ_s, or a pressure
measured on the chamber, tells them apart.

Reduce it with a chamber large enough to need no supply, or shut the valve at release and model the depletion alone; or
record the pressure during growth.

Source: the gas laws for an open chamber, with a regulator of first order, such as the models of pneumatic actuators in
Beater (2007), Pneumatic Drives, Springer.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("chamber_l",)
IN_TRACE = True
ORDER = 1
REPLACES = ("reservoir_depletion",)
PARAMETERS = (
    Parameter(
        "tau", "τ_s", "s", 0.1, bounds=(0.0, 1e4), plausible=(0.01, 10.0), meaning="time in which the supply refills"
    ),
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


def chamber_rate(s, rig, tau, gamma):
    if tau <= 0.0:
        return 0.0 * s.pressure
    drawn = gamma * (s.pressure + rig.ambient_pressure) * s.area * s.lead_velocity
    return (s.set_pressure - s.pressure) / tau - drawn / (rig.chamber_volume + s.area * s.lead_position)


WORKED = (
    Worked(
        "chamber_rate",
        -23.74e3,
        "2000/0.1 − 1.4 × 129325 × 4.5239e-4 × 2/(3.7e-3 + 4.5239e-5) = 20000 − 163.815/3.745239e-3 = 20000 − 43740",
        state={"pressure": 28e3, "set_pressure": 30e3, "area": 4.5239e-4, "lead_position": 0.1, "lead_velocity": 2.0},
        rig={"chamber_volume": 3.7e-3, "ambient_pressure": 101_325.0},
    ),
)
