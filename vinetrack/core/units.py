"""Units of columns and options, units that users write by mistake, and display units.

The program calculates in SI. A name that carries a unit ends with it: `pressure_kPa`, `film_density_kg_m3`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Unit:
    """A unit and its conversion: value in SI = value · `multiply` / `divide`. Factor and divisor are separate so that
    both are exact: 28.7 / 1000 is the double closest to 0.0287, whereas 28.7 · 0.001 may differ in the last place.
    """

    si: str
    text: str
    multiply: float = 1.0
    divide: float = 1.0
    metavar: str = "NUMBER"

    def to_si(self, value: float) -> float:
        """Return a value in SI."""
        return value * self.multiply / self.divide

    def from_si(self, value: float) -> float:
        """Return a value in this unit."""
        return value * self.divide / self.multiply


# Units by the suffix of a name
UNITS: dict[str, Unit] = {
    "Pa": Unit("Pa", "Pa"),
    "mbar": Unit("Pa", "mbar", multiply=100.0),
    "kPa": Unit("Pa", "kPa", multiply=1000.0, metavar="KPA"),
    "psi": Unit("Pa", "psi", multiply=6894.757293168361),
    "bar": Unit("Pa", "bar", multiply=1e5),
    "MPa": Unit("Pa", "MPa", multiply=1e6, metavar="MPA"),
    "nm": Unit("m", "nm", divide=1e9),
    "um": Unit("m", "µm", divide=1e6, metavar="UM"),
    "mm": Unit("m", "mm", divide=1000.0, metavar="MM"),
    "cm": Unit("m", "cm", divide=100.0),
    "in": Unit("m", "in", multiply=25.4, divide=1000.0),
    "ft": Unit("m", "ft", multiply=304.8, divide=1000.0),
    "m": Unit("m", "metres"),
    "mg": Unit("kg", "mg", divide=1e6),
    "g": Unit("kg", "g", divide=1000.0, metavar="GRAMS"),
    "oz": Unit("kg", "oz", multiply=28.349523125, divide=1000.0),
    "lb": Unit("kg", "lb", multiply=453.59237, divide=1000.0),
    "kg": Unit("kg", "kg"),
    "ns": Unit("s", "ns", divide=1e9),
    "us": Unit("s", "µs", divide=1e6),
    "ms": Unit("s", "ms", divide=1000.0),
    "s": Unit("s", "s"),
    "ml": Unit("m3", "ml", divide=1e6),
    "cm3": Unit("m3", "cm³", divide=1e6),
    "l": Unit("m3", "litres", divide=1000.0, metavar="LITRES"),
    "m3": Unit("m3", "m³"),
    "deg": Unit("rad", "degrees", multiply=math.pi / 180, metavar="DEGREES"),
    "rad": Unit("rad", "radians"),
    "g_cm3": Unit("kg_m3", "g/cm³", multiply=1000.0),
    "kg_m3": Unit("kg_m3", "kg/m³"),
    "fps": Unit("fps", "frames per second"),
}

# Display unit by SI unit, and the factor from SI: pressures are shown in kPa, masses in grams; "1" is dimensionless
DISPLAY_UNITS: dict[str, tuple[str, float]] = {
    "Pa": ("kPa", 1e-3),
    "1/Pa": ("1/kPa", 1e3),
    "kg": ("g", 1e3),
    "1": ("", 1.0),
}

SLIDER_UNITS = {**DISPLAY_UNITS, "m": ("mm", 1e3), "m²": ("cm²", 1e4)}  # Display units of sliders

PREDICTION_UNITS = {**DISPLAY_UNITS, "s": ("ms", 1e3)}  # Display units of predictions


def display_unit(unit: str, table: Mapping[str, tuple[str, float]] = DISPLAY_UNITS) -> tuple[str, float]:
    """Return the display unit of an SI unit, and the factor from SI. Returns name, factor (the unit itself and 1.0 if
    it has no other display unit), >>> display_unit("Pa"), display_unit("m"), (('kPa', 0.001), ('m', 1.0)).
    """
    return table.get(unit, (unit, 1.0))


def split_unit(name: str) -> tuple[str, str]:
    """Split a name into its quantity and the key of its unit, which is blank if the name does not end in a unit.
    Returns quantity, unit, >>> split_unit("yield_pressure_kPa"), split_unit("film_density_kg_m3"), split_unit("bends"),
    (('yield_pressure', 'kPa'), ('film_density', 'kg_m3'), ('bends', '')).
    """
    parts = name.split("_")
    for start in range(1, len(parts)):
        if (ending := "_".join(parts[start:])) in UNITS:
            return "_".join(parts[:start]), ending
    return name, ""


def convert(value: float, unit: str, to: str) -> float:
    """Convert a value to another unit of the same quantity."""
    given, wanted = UNITS[unit], UNITS[to]
    if given.si != wanted.si:
        raise ValueError(f"{given.text} cannot be turned into {wanted.text}")
    # One product of both factors avoids the rounding of an intermediate SI value: 1 in is exactly 25.4 mm.
    return value * (given.multiply * wanted.divide) / (given.divide * wanted.multiply)
