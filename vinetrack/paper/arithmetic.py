"""Rows of the table that follow from the paper's own numbers by arithmetic.

They cover pressures and volumes by the gas law in absolute pressure, p-values from R² and N, B against R, the speeds
that the printed B imply, the work of the weight, the injector, the hoop stress of the fast vine, and rounding.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np
from scipy.stats import t as student

from vinetrack.core import published
from vinetrack.core.constants import AMBIENT_PRESSURE_PA, GRAVITY_M_S2
from vinetrack.core.units import convert
from vinetrack.kinematics.scaling import regress
from vinetrack.paper.rows import COMPUTED, PaperRow
from vinetrack.planning.scaling_priors import BURST_STRESS_PA, damping_prior, hoop_stress_Pa

GAMMAS = {"slow": 1.0, "fast": 1.4}  # Isothermal and adiabatic: the chamber's gas lies between them


def area_m2(diameter_mm: float) -> float:
    """Cross-section πD²/4."""
    return math.pi * (diameter_mm / 1e3) ** 2 / 4


def volume_change(chamber_m3: float, diameter_mm: float, length_mm: float) -> float:
    """Return the volume of a whole vine over that of its chamber."""
    return area_m2(diameter_mm) * length_mm / 1e3 / chamber_m3


def gauge_left(gauge_Pa: float, change: float, gamma: float = 1.0) -> float:
    """Return the fraction of the gauge pressure left after the volume has grown by the fraction `change`. P_abs V^γ is
    constant, with absolute pressure.
    """
    absolute_Pa = gauge_Pa + AMBIENT_PRESSURE_PA
    return (absolute_Pa * (1 + change) ** -gamma - AMBIENT_PRESSURE_PA) / gauge_Pa


def p_value(R2: float, n: int) -> float:
    """Return the two-sided p-value of the slope of a straight line from its R² and the number of points."""
    dof = n - 2
    return 2 * float(student.sf(math.sqrt(R2 * dof / (1 - R2)), dof))


def printed_steady_speed_m_s(scale: int, gauge_Pa: float, yield_Pa: float) -> float:
    """Return the steady tail speed by Eq. (3) with the printed B and n."""
    force_N = (gauge_Pa - yield_Pa) * area_m2(published.DIAMETER_MM[scale])
    return (force_N / published.DAMPING_B[scale]) ** (1 / published.EXPONENT)


def weight_over_gas(diameter_mm: float) -> float:
    """Return the work of the payload's weight m g x over that of the gas P₀Ay, as in the paper's Fig. 9, x = 2y."""
    gas_Pa_m2 = 1e3 * published.EFFICIENCY_KPA * area_m2(diameter_mm)
    return published.PAYLOAD_G / 1e3 * GRAVITY_M_S2 * 2 / gas_Pa_m2


def computed_rows() -> Iterator[PaperRow]:
    """Yield every row of the table that needs no experiment and no simulation."""
    yield from _scale_rows()
    yield from _reservoir_rows()
    yield from _statistics_rows()
    yield from _coefficient_rows()
    yield from _steady_speed_rows()
    yield from _weight_rows()
    yield from _injector_rows()
    yield from _guess_rows()
    yield _rounding_row()


def _scale_rows() -> Iterator[PaperRow]:
    for scale, thickness_um in published.THICKNESS_UM.items():
        yield PaperRow(
            row=f"isometry_R{scale}",
            where="Table I",
            quantity="wall over diameter, against that of R = 1",
            setting=f"R = {scale}",
            published=1.0,
            as_printed="isometric",
            ours=thickness_um / published.DIAMETER_MM[scale] / (published.THICKNESS_UM[1] / published.DIAMETER_MM[1]),
            mark=COMPUTED,
            how="t/D of Table I",
        )


def _reservoir_rows() -> Iterator[PaperRow]:
    largest = max(published.DIAMETER_MM.values())
    change = volume_change(published.CHAMBER_L / 1e3, largest, published.LONGEST_VINE_MM)
    size = f"{published.CHAMBER_L:g} L, {largest:g} mm × {published.LONGEST_VINE_MM:g} mm vine"
    yield PaperRow(
        row="chamber_volume_change",
        where="Section III-B",
        quantity="volume change of the chamber",
        setting=size,
        unit="%",
        published=100 * published.CHAMBER_CHANGE,
        ours=100 * change,
        mark=COMPUTED,
        how="πD²L/4 over the chamber",
    )
    for pressure_kPa in sorted(published.POSITION_RMS_CM, reverse=True):
        for name, gamma in GAMMAS.items():
            yield PaperRow(
                row=f"gauge_drop_{pressure_kPa:g}kPa_{name}",
                where="Section III-B",
                quantity=f"fall of gauge pressure, {'isothermal' if gamma == 1 else 'adiabatic'}",
                setting=f"{pressure_kPa:g} kPa, {size}, nothing refilling it",
                unit="%",
                published=100 * published.CHAMBER_CHANGE,
                as_printed=f"{100 * published.CHAMBER_CHANGE:g}, within {100 * published.CHAMBER_ALLOWED:g}",
                ours=100 * (1 - gauge_left(1e3 * pressure_kPa, change, gamma)),
                mark=COMPUTED,
                how="the gas law holds for absolute pressure: the ambient 101.3 kPa expand too",
                beside="how fast the regulator refills the chamber is not printed; with it the fall is smaller",
            )


def _statistics_rows() -> Iterator[PaperRow]:
    n = len(published.DAMPING_B)
    yield PaperRow(
        row="steady_speed_p_value",
        where="Fig. 8",
        quantity="p-value of the linear fit of steady speed against scale",
        setting=f"R² {published.STEADY_SPEED_R2:g}, N = {n}",
        published=published.STEADY_SPEED_P_VALUE,
        ours=p_value(published.STEADY_SPEED_R2, n),
        mark=COMPUTED,
        how="t = √(R²·2/(1 − R²)) with two degrees of freedom: the printed R² and p do not belong together",
    )


def _coefficient_rows() -> Iterator[PaperRow]:
    scales, B = (np.array(list(values), dtype=float) for values in (published.DAMPING_B, published.DAMPING_B.values()))
    power, line = regress(np.log(scales), np.log(B)), regress(scales, B)
    row_of = partial(
        PaperRow, where="Fig. 7A", setting="the four printed B against R", mark=COMPUTED, as_printed="near-linear"
    )
    low, high = power["slope_95"]
    how = "least squares, N = 4 vines"
    yield row_of(
        row="B_power_of_scale", quantity="exponent on log axes", ours=power["slope"], low=low, high=high, how=how
    )
    yield row_of(row="B_line_R2", quantity="R² of a straight line", ours=line["R2"], how=how)
    low, high = line["intercept_95"]
    yield row_of(
        row="B_line_intercept",
        quantity="intercept of a straight line",
        unit="N·(s/m)ⁿ",
        ours=line["intercept"],
        low=low,
        high=high,
        how=f"{how}; through the origin it would be 0, and below 0 there is no B",
    )


def _steady_speed_rows() -> Iterator[PaperRow]:
    pressure_Pa, yield_Pa = 1e3 * published.STEADY_SPEED_KPA, 1e3 * published.YIELD_PRESSURE_KPA
    for scale in published.DAMPING_B:
        ours = printed_steady_speed_m_s(scale, pressure_Pa, 0.0)
        with_yield = printed_steady_speed_m_s(scale, pressure_Pa, yield_Pa)
        yield PaperRow(
            row=f"steady_speed_of_printed_B_R{scale}",
            where="Fig. 8 against Fig. 6",
            quantity="steady tail speed that the printed B gives",
            setting=f"R = {scale}, {published.STEADY_SPEED_KPA:g} kPa, no yield pressure",
            unit="m/s",
            as_printed="drawn only; rises with R",
            ours=ours,
            mark=COMPUTED,
            how="Eq. (3): not monotonic in R, whatever P_y is common to all; 5 % of B are 14 % of speed",
            beside=f"{with_yield:.2f} m/s with P_y = {published.YIELD_PRESSURE_KPA:g} kPa, printed for R = 4 alone",
        )


def _weight_rows() -> Iterator[PaperRow]:
    for diameter_mm in published.EFFICIENCY_DIAMETERS_MM:
        yield PaperRow(
            row=f"weight_share_{diameter_mm:g}mm",
            where="Fig. 9",
            quantity="work of the payload's weight over that of the gas, m g x / (P₀ A y)",
            setting=f"{diameter_mm:g} mm, {published.EFFICIENCY_KPA:g} kPa, {published.PAYLOAD_G:g} g, downwards",
            unit="%",
            as_printed="left out",
            ours=100 * weight_over_gas(diameter_mm),
            mark=COMPUTED,
            how="x = 2y",
        )


def _injector_rows() -> Iterator[PaperRow]:
    length_mm, diameter_mm = published.INJECTOR_CHAMBER_MM
    chamber_m3 = area_m2(diameter_mm) * length_mm / 1e3
    vine = published.INJECTOR
    change = volume_change(chamber_m3, vine["diameter_mm"], vine["length_mm"])
    size = (
        f"chamber {length_mm:g} mm × ⌀{diameter_mm:g} mm, vine ⌀{vine['diameter_mm']:g} mm × {vine['length_mm']:g} mm"
    )
    setting = f"{size}, {vine['pressure_kPa']:g} kPa"
    printed = 100 * published.INJECTOR_CHANGE
    row_of = partial(PaperRow, where="Section V-B", setting=setting, unit="%", mark=COMPUTED, published=printed)
    yield row_of(
        row="injector_volume_change",
        quantity="volume change of the injector's chamber",
        ours=100 * change,
        how="πD²L/4 of the vine over that of the chamber",
    )
    drop = {name: 100 * (1 - gauge_left(1e3 * vine["pressure_kPa"], change, gamma)) for name, gamma in GAMMAS.items()}
    yield row_of(
        row="injector_gauge_drop",
        quantity="fall of gauge pressure in the injector, isothermal",
        as_printed=f"{printed:g} (as a decrease in pressure)",
        ours=drop["slow"],
        how="the gas law in absolute pressure",
        beside=f"{drop['fast']:.1f} % if it is fast (adiabatic)",
    )


def _guess_rows() -> Iterator[PaperRow]:
    for scale, B in published.DAMPING_B.items():
        yield PaperRow(
            row=f"guessed_B_R{scale}",
            where="Fig. 6; the guess is ours",
            quantity="B ≈ 6.44 (t/200 µm)(D/24 mm)^0.75, a guess for vines that were not measured",
            setting=f"R = {scale}",
            unit="N·(s/m)ⁿ",
            published=B,
            ours=damping_prior(published.DIAMETER_MM[scale] / 1e3, published.THICKNESS_UM[scale] / 1e6),
            mark=COMPUTED,
            how="joins the printed values to within 15 %; off their common t/D it is a guess and nothing more",
        )
    fast = published.FAST_VINE
    stress_Pa = hoop_stress_Pa(1e3 * fast["pressure_kPa"], fast["diameter_mm"] / 1e3, fast["thickness_um"] / 1e6)
    yield PaperRow(
        row="fast_vine_hoop_stress",
        where="Section IV-E; the guess is ours",
        quantity="hoop stress PD/2t of the fast vine, just under burst",
        setting=f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm, {fast['pressure_kPa']:g} kPa",
        unit="MPa",
        as_printed="burst pressure just above 62 kPa",
        ours=stress_Pa / 1e6,
        mark=COMPUTED,
        how=f"from this vine alone comes the guess that film bursts at {BURST_STRESS_PA / 1e6:g} MPa",
    )


def _rounding_row() -> PaperRow:
    # The printed pressures look like rounded pounds per square inch: 14 kPa is 2 psi, 13.79 kPa.
    pressures_kPa, psi_kPa = (7, 14, 28, 34, 41, 48, 62), convert(1.0, "psi", "kPa")
    exact = [round(kPa / psi_kPa) * psi_kPa for kPa in pressures_kPa]
    errors = [abs(kPa / true - 1) for kPa, true in zip(pressures_kPa, exact, strict=True)]
    worst = int(np.argmax(errors))
    return PaperRow(
        row="pressure_rounding",
        where="throughout",
        quantity="largest error if pressures are rounded pounds per square inch",
        setting=f"{pressures_kPa[worst]} kPa for {exact[worst]:.2f}",
        unit="%",
        as_printed="whole kPa",
        ours=100 * errors[worst],
        mark=COMPUTED,
        how="7, 14, 28, 34, 41, 48 and 62 kPa are 1, 2, 4, 5, 6, 7 and 9 psi to the kPa",
    )
