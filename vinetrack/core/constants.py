"""What the whole program shares: physical constants, SI, and the names of the effects of the base model."""

BASE_EFFECTS = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")
"""The four effects that make the equation of motion of the paper, Eq. (2): the model in use unless settings say
otherwise, whatever columns the sheet has."""

GRAVITY_M_S2 = 9.81
"""Chosen: the rounded value of the paper; standard gravity is 9.80665, a third of a per mille less."""

AMBIENT_PRESSURE_PA = 101_325.0
"""Standard atmosphere (ISO 2533); weather moves it by 3 %, and altitude by 12 % a kilometre."""

TEMPERATURE_K = 293.0
"""Chosen: a laboratory at 20 °C."""

AIR_DENSITY_KG_M3 = 1.20
"""Derived: p/(R·T) = 101 325/(287 · 293) = 1.205, rounded."""

FILM_DENSITY_KG_M3 = 1200.0
"""Chosen: thermoplastic polyurethane film, 1100 to 1250; mass of the wall and its weight scale with it."""

GAS_CONSTANT_AIR_J_KG_K = 287.0
"""Derived: 8.314 J/(mol·K) over 0.02896 kg/mol of dry air."""
