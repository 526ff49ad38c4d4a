"""Physical constants, SI (PHYSICS: the values the analysis and its published numbers share)."""

GRAVITY_M_S2 = 9.81
AMBIENT_PRESSURE_PA = 101_325.0
TEMPERATURE_K = 293.0
AIR_DENSITY_KG_M3 = 1.20
FILM_DENSITY_KG_M3 = 1200.0
GAS_CONSTANT_AIR_J_KG_K = 287.0
