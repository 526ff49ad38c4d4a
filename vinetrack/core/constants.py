"""Physical constants in SI, and the names of the effects of the base model."""

# The four effects of the paper's equation of motion, Eq. (2): the default model, whatever columns the sheet has
BASE_EFFECTS = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")

GRAVITY_M_S2 = 9.81  # Chosen: the rounded value of the paper; standard gravity, 9.80665, is smaller by 0.034 %

AMBIENT_PRESSURE_PA = 101_325.0  # Standard atmosphere (ISO 2533)

TEMPERATURE_K = 293.0  # Chosen: a laboratory at 20 °C

AIR_DENSITY_KG_M3 = 1.20  # Derived: p/(R·T) = 101 325/(287 · 293) = 1.205, rounded

FILM_DENSITY_KG_M3 = 1200.0  # Chosen: thermoplastic polyurethane film, 1100 to 1250

GAS_CONSTANT_AIR_J_KG_K = 287.0  # Derived: 8.314 J/(mol·K) over 0.02896 kg/mol of dry air
