"""Units of columns and options, units that users write by mistake, and display units.

The program calculates in SI. A name that carries a unit ends with it: `pressure_kPa`, `film_density_kg_m3`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

# The four effects of the paper's equation of motion, Eq. (2): the default model, whatever columns the sheet has
BASE_EFFECTS = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")
GRAVITY_M_S2 = 9.81  # Chosen: the rounded value of the paper; standard gravity, 9.80665, is smaller by 0.034 %
AMBIENT_PRESSURE_PA = 101_325.0  # Standard atmosphere (ISO 2533)
TEMPERATURE_K = 293.0  # Chosen: a laboratory at 20 °C
AIR_DENSITY_KG_M3 = 1.20  # Derived: p/(R·T) = 101 325/(287 · 293) = 1.205, rounded
GAS_CONSTANT_AIR_J_KG_K = 287.0  # Derived: 8.314 J/(mol·K) over 0.02896 kg/mol of dry air


# ------------------------------------------------------------------------------
# Formatting of numbers, everywhere: values with as many digits as their error justifies.


def decimals(sigma: float) -> int:
    """Return the number of decimals that shows two digits of an error, at most 12; 0 for an error of 0 or NaN."""
    # Rounded first: 0.00999 is 0.010. 12: derived: an error below 1e-11 is the rounding of a double of order 1e5
    return min(max(1 - math.floor(math.log10(float(f"{sigma:.1e}"))), 0), 12) if 0 < sigma < math.inf else 0


def or_nan(value: Any) -> float:
    """Return a number of a JSON file as a float; NaN for None, which means unknown."""
    return math.nan if value is None else float(value)


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` to `digits` significant digits, without exponent from 0.0001 to 999999; "–" for None and NaN."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_error(value: float | None, sigma: float | None) -> str:
    """Return `value ± sigma`, the error to two significant digits and the value to the same decimal."""
    value, sigma = or_nan(value), or_nan(sigma)
    if not (math.isfinite(value) and 0 < sigma < math.inf):
        return number(value)
    places = decimals(sigma)
    # 6: decimals beyond which value and error are written with a common power of ten (chosen)
    if places > 6:
        power = 3 * ((places - 1) // 3)
        shown = max(places - power, 0)
        scaled = value * 10.0**power
        scaled = 0.0 if abs(scaled) < 0.5 * 10.0**-shown else scaled  # no "-0.0"
        raised = str(power).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"({scaled:.{shown}f} ± {sigma * 10.0**power:.{shown}f})·10⁻{raised}"
    return f"{value:.{places}f} ± {sigma:.{places}f}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """Return `(low, high)` as "low to high", with decimals that suit its width; "–" if unknown."""
    low, high = map(or_nan, bounds or (None, None))
    if not math.isfinite(low + high):
        return "–"
    places = min(decimals(high - low), 6) if high > low else 2
    return f"{low:.{places}f} to {high:.{places}f}"


def with_interval(value: float | None, bounds: Sequence[float | None] | None) -> str:
    """Return `value (95 %: low to high)`, with decimals that suit the width; without bounds the value."""
    low, high = map(or_nan, bounds or (None, None))
    if value is None or not math.isfinite(low + high):
        return number(value)
    places = min(decimals((high - low) / 2), 6) if high > low else 3
    return f"{value:.{places}f} (95 %: {low:.{places}f} to {high:.{places}f})"


@dataclass(frozen=True)
class Unit:
    """A unit and its conversion: value in SI = value · `multiply` / `divide`. Factor and divisor are separate so that
    both are exact: 28.7 / 1000 is the double closest to 0.0287, whereas 28.7 · 0.001 may differ in the last place.
    """

    si: str
    text: str
    multiply: float = 1.0
    divide: float = 1.0

    def to_si(self, value: float) -> float:
        """Return a value in SI."""
        return value * self.multiply / self.divide

    def from_si(self, value: float) -> float:
        """Return a value in this unit."""
        return value * self.divide / self.multiply


# Units by the suffix of a name: by SI unit, name=multiply/divide, then what is printed in place of the name
UNITS = {
    name: Unit(si, text[0].replace("_", " ") if text else name, *map(float, scale.split("/")))
    for si, units in {
        "Pa": "Pa=1 mbar=100 kPa=1000 psi=6894.757293168361 bar=1e5 MPa=1e6",
        "m": "nm=1/1e9 um=1/1e6=µm mil=25.4/1e6 mm=1/1000 cm=1/100 in=25.4/1000 ft=304.8/1000 m=1=metres",
        "kg": "mg=1/1e6 g=1/1000 oz=28.349523125/1000 lb=453.59237/1000 kg=1",
        "s": "ns=1/1e9 us=1/1e6=µs ms=1/1000 s=1",
        "m3": "ml=1/1e6 cm3=1/1e6=cm³ l=1/1000=litres m3=1=m³",
        "rad": f"deg={math.pi / 180!r}=degrees rad=1=radians",
        "kg_m3": "g_cm3=1000=g/cm³ kg_m3=1=kg/m³",
        "fps": "fps=1=frames_per_second",
    }.items()
    for name, scale, *text in (unit.split("=") for unit in units.split())
}

# Display unit by SI unit, and the factor from SI: masses are shown in grams; "1" is dimensionless
DISPLAY_UNITS = {"kg": ("g", 1e3), "1": ("", 1.0)}
PREDICTION_UNITS = {**DISPLAY_UNITS, "s": ("ms", 1e3)}  # Display units of predictions


def display_unit(
    unit: str, pressure_unit: str = "kPa", table: Mapping[str, tuple[str, float]] = DISPLAY_UNITS
) -> tuple[str, float]:
    """Return the display unit of an SI unit and the factor from SI: itself and 1.0 if it has no other. Pressures, and
    what is counted per pressure, have the unit of the user's sheet.
    """
    if unit not in ("Pa", "1/Pa"):
        return table.get(unit, (unit, 1.0))
    text, factor = UNITS[pressure_unit].text, convert(1.0, "Pa", pressure_unit)
    return (text, factor) if unit == "Pa" else (f"1/{text}", 1 / factor)


def split_unit(name: str) -> tuple[str, str]:
    """Split a name into its quantity and the key of its unit, which is blank if the name does not end in a unit.

    >>> split_unit("film_density_kg_m3"), split_unit("bends")
    (('film_density', 'kg_m3'), ('bends', ''))
    """
    match = re.fullmatch(rf"(.*?)_({'|'.join(UNITS)})", name)
    return (match[1], match[2]) if match else (name, "")


def other_units(name: str) -> dict[str, str]:
    """Return the names of the same quantity in other units, each with its unit; none for a name without a unit.

    >>> other_units("chamber_l")
    {'chamber_ml': 'ml', 'chamber_cm3': 'cm3', 'chamber_m3': 'm3'}
    """
    quantity, own = split_unit(name)
    others = [key for key in UNITS if own and key != own and UNITS[key].si == UNITS[own].si]
    return {f"{quantity}_{key}": key for key in others}


def convert(value: float, unit: str, to: str) -> float:
    """Convert a value to another unit of the same quantity."""
    # One product of both factors avoids the rounding of an intermediate SI value: 1 in is exactly 25.4 mm.
    given, wanted = UNITS[unit], UNITS[to]
    return value * (given.multiply * wanted.divide) / (given.divide * wanted.multiply)


def pressure_text(pressure_Pa: float, unit: str = "kPa", digits: int = 3) -> str:
    """Return a pressure in the unit that the user's sheet has, with kPa beside any other.

    >>> pressure_text(34474.0), pressure_text(34474.0, "psi")
    ('34.5 kPa', '5 psi (34.5 kPa)')
    """
    shown = f"{pressure_Pa / 1e3:.{digits}g} kPa"
    return shown if unit == "kPa" else f"{UNITS[unit].from_si(pressure_Pa):.{digits}g} {UNITS[unit].text} ({shown})"
