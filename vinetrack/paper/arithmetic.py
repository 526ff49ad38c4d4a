"""Rows of the table that follow from the paper's own numbers by arithmetic.

They cover pressures and volumes by the gas law in absolute pressure, p-values from R² and N, B against R, the speeds
that the printed B imply, the work of the weight, the injector, the hoop stress of the fast vine, and rounding.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t as student

from vinetrack import effects
from vinetrack.core import published
from vinetrack.core.published import SOURCE
from vinetrack.core.records import Trial
from vinetrack.core.units import AMBIENT_PRESSURE_PA, GRAVITY_M_S2, convert
from vinetrack.dynamics.model import Model, base_model
from vinetrack.dynamics.simulate import Trajectory, simulate
from vinetrack.kinematics.damping import regress
from vinetrack.kinematics.summary import lead_velocity_at
from vinetrack.planning.predictive_inputs import BURST_STRESS_PA, damping_prior, hoop_stress_Pa

# ------------------------------------------------------------------------------
# One row of the table that compares published numbers with ours, and the meaning of its marks.

COMPUTED = "computed"
SIMULATED = "simulated from printed parameters"
MEASURED = "measured"
NOT_CHECKABLE = "not checkable"

UNANSWERED = "the trials of this experiment do not tell"

MARKS = {
    COMPUTED: f"follows by arithmetic, or by Eq. (2), from other numbers of {SOURCE}; ours is the corrected value "
    "where the two differ",
    SIMULATED: "found in virtual trials that were grown from the printed B and n: agreement checks the analysis, not "
    "the paper",
    MEASURED: "found in trials that were filmed",
    NOT_CHECKABLE: "rests on something that is not printed: a setting, a scatter, or a B that had to be guessed",
}

PAPER_COLUMNS = (
    "row",
    "where",
    "quantity",
    "setting",
    "unit",
    "published",
    "as_printed",
    "ours",
    "ours_low_95",
    "ours_high_95",
    "mark",
    "how",
    "beside",
)

PREFERRED = "both_axes"  # The fit of the damping law that supplies our numbers

nan = math.nan


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """A published number or statement and ours, in `unit`. `row` identifies it in programs; `where` and `as_printed`
    say where and how it is printed; `published` is NaN where that is not a number. `low` and `high` are the 95 %
    interval of ours.
    """

    row: str
    where: str
    quantity: str
    mark: str
    how: str
    setting: str = ""
    unit: str = "1"
    published: float = nan
    as_printed: str = ""
    ours: float = nan
    low: float = nan
    high: float = nan
    beside: str = ""


def as_table(rows: Iterable[PaperRow]) -> pd.DataFrame:
    """Return the rows as a table with the columns `PAPER_COLUMNS` of `paper.csv`."""
    entries = []
    for row in map(_as_answered, rows):
        entry = asdict(row)
        entry["ours_low_95"], entry["ours_high_95"] = entry.pop("low"), entry.pop("high")
        entry["as_printed"] = row.as_printed or (f"{row.published:g}" if math.isfinite(row.published) else "")
        entries.append(entry)
        if row.mark not in MARKS:
            raise ValueError(f"row {row.row} has the mark {row.mark!r}")
    table = pd.DataFrame(entries, columns=list(PAPER_COLUMNS))
    twice = table.loc[table["row"].duplicated(), "row"].tolist()
    if twice:
        raise ValueError(f"rows stand twice: {', '.join(twice)}")
    return table


def _as_answered(row: PaperRow) -> PaperRow:
    """The row; where trials should have given a number and did not, `how` says so."""
    if row.mark not in (SIMULATED, MEASURED) or math.isfinite(row.ours):
        return row
    return replace(row, how=UNANSWERED)


def number(value: Any) -> float:
    """Return a number read from JSON, NaN for null."""
    return nan if value is None else float(value)


def bounds(pair: Sequence[float | None] | None) -> tuple[float, float]:
    """Return an interval read from JSON, NaN for null. Returns low, high."""
    low, high = pair or (None, None)
    return number(low), number(high)


# ------------------------------------------------------------------------------
# Departures from the paper's assumptions, simulated for its own trials: differences of the motions from Eq. (2).
#
# The departures are a chamber that is not refilled, from slow (isothermal) to fast (adiabatic), a tail that cannot
# carry
# compression, and both. They bound the effect of such a departure, with the printed B, n and P_y, and do not explain
# what
# was measured: neither the rate at which the regulator refills nor the lengths of the vines are printed, and a payload
# that has fallen to the tip rests there without pushing it.

# Fraction of the length up to which positions are compared (chosen)
WITHIN = 0.95

LASTS_S = 60.0  # Duration of the simulated motions, s; the slowest, at 7 kPa, takes 7 s by Eq. (2) (chosen)


@dataclass(frozen=True)
class Departure:
    """A departure from Eq. (2): `gamma` of a chamber that is not refilled (None: refilled), and a slack tail."""

    name: str
    words: str
    gamma: float | None = None
    slack: bool = False

    def model(self, B: float) -> Model:
        """Return Eq. (2) with the printed n and this departure."""
        model = base_model()
        if self.gamma is not None:
            model = (model + effects.reservoir_depletion).with_values({"reservoir_depletion.gamma": self.gamma})
        return model.with_values({"eversion_damping.B": B, "eversion_damping.n": published.EXPONENT})

    def trial(self, trial: Trial) -> Trial:
        """Return the trial, whose tail may go slack if the departure says so."""
        return replace(trial, tail_slack="free" if self.slack else "taut")


NONE = Departure("eq2", "Eq. (2)")
DEPARTURES = (
    Departure("depletion_slow", "chamber not refilled, isothermal", gamma=1.0),
    Departure("depletion_fast", "chamber not refilled, adiabatic", gamma=1.4),
    Departure("slack", "tail that cannot push", slack=True),
    Departure("depletion_slow_slack", "both, isothermal", gamma=1.0, slack=True),
    Departure("depletion_fast_slack", "both, adiabatic", gamma=1.4, slack=True),
)

DEPARTURE_COLUMNS = (
    "figure",
    "pressure_kPa",
    "departure",
    "rms_position_m",
    "rms_final_lead_velocity_m_s",
    "slack_from_s",
)
MOTION_COLUMNS = ("pressure_kPa", "departure", "time_s", "lead_position_m")


def paper_trial(
    diameter_mm: float, thickness_um: float, length_mm: float, pressure_kPa: float, payload_g: float = 0.0
) -> Trial:
    """Return a trial of the paper's rig: downwards, 3.7 L, P_y 3 kPa."""
    return Trial(
        name=f"{diameter_mm:g} mm × {thickness_um:g} µm at {pressure_kPa:g} kPa",
        capture_fps=published.CAPTURE_FPS,
        diameter_m=diameter_mm / 1e3,
        thickness_m=thickness_um / 1e6,
        length_m=length_mm / 1e3,
        pressure_Pa=1e3 * pressure_kPa,
        yield_pressure_Pa=1e3 * published.YIELD_PRESSURE_KPA,
        payload_kg=payload_g / 1e3,
        chamber_m3=published.CHAMBER_L / 1e3,
    )


def position_trials() -> list[Trial]:
    """Return the trials of the paper's Fig. 4: the 24 mm × 200 µm vine, as long as the longest, with its payload."""
    size = (published.DIAMETER_MM[4], published.THICKNESS_UM[4], published.LONGEST_VINE_MM)
    return [paper_trial(*size, pressure_kPa, published.PAYLOAD_G) for pressure_kPa in published.POSITION_RMS_CM]


def departure_table(payloads_g: Sequence[float]) -> pd.DataFrame:
    """Compute the differences of each departure from Eq. (2), columns `DEPARTURE_COLUMNS`."""
    rows: list[tuple[object, ...]] = []
    for trial in position_trials():
        plain = follow(trial, NONE, published.DAMPING_B[4])
        for departure in DEPARTURES:
            moved = follow(trial, departure, published.DAMPING_B[4])
            rms_m = position_rms_m(plain, moved, trial)
            rows.append(("Fig. 4", trial.pressure_Pa / 1e3, departure.name, rms_m, math.nan, moved.slack_from_s))
    for pressure_kPa in published.FINAL_SPEED_RMS_M_S:
        for departure in DEPARTURES:
            off = [_speed_change_m_s(pressure_kPa, payload_g, departure) for payload_g in payloads_g]
            rms_m_s = math.sqrt(float(np.mean(np.square(off)))) if off else math.nan
            rows.append(("Fig. 5", float(pressure_kPa), departure.name, math.nan, rms_m_s, math.nan))
    return pd.DataFrame(rows, columns=list(DEPARTURE_COLUMNS))


def follow(trial: Trial, departure: Departure, B: float) -> Trajectory:
    """Simulate the motion at the camera's frames, until it ends or for `LASTS_S`."""
    time_s = np.arange(0, LASTS_S, 1 / published.CAPTURE_FPS)
    return simulate(departure.model(B), departure.trial(trial), time_s)


def position_rms_m(plain: Trajectory, moved: Trajectory, trial: Trial) -> float:
    """Return the root mean square difference of two positions from release until Eq. (2) has grown to 95 %."""
    stop = int(np.searchsorted(plain.lead_position_m, WITHIN * trial.length_m))
    return math.sqrt(float(np.mean((moved.lead_position_m[:stop] - plain.lead_position_m[:stop]) ** 2)))


def _speed_trial(pressure_kPa: float, payload_g: float) -> tuple[Trial, float]:
    """A trial of the paper's Fig. 5 and its B, which is not printed and taken as proportional to the wall."""
    wall_um = published.FINAL_SPEED_THICKNESS_UM
    B = published.DAMPING_B[4] * wall_um / published.THICKNESS_UM[4]
    return paper_trial(published.DIAMETER_MM[4], wall_um, published.LONGEST_VINE_MM, pressure_kPa, payload_g), B


def _speed_change_m_s(pressure_kPa: float, payload_g: float, departure: Departure) -> float:
    """Change of the leading edge's speed at the paper's 12 cm against Eq. (2)."""
    trial, B = _speed_trial(pressure_kPa, payload_g)
    at_m = published.FINAL_SPEED_AT_MM / 1e3
    speeds = []
    for assumed in (departure, NONE):
        moved = follow(trial, assumed, B)
        speeds.append(lead_velocity_at(moved.lead_position_m, moved.lead_velocity_m_s, at_m))
    return speeds[0] - speeds[1] if math.isfinite(speeds[0]) else -speeds[1]


def motion_table(instants: int = 200) -> pd.DataFrame:
    """Simulate the motions of Fig. 4 by Eq. (2) and with each departure, columns `MOTION_COLUMNS`."""
    parts = []
    for trial in position_trials():
        for departure in (NONE, *DEPARTURES):
            moved = follow(trial, departure, published.DAMPING_B[4])
            end_s = moved.end_time_s if math.isfinite(moved.end_time_s) else LASTS_S
            time_s = np.linspace(0, end_s, instants)
            position_m = np.interp(time_s, moved.time_s, moved.lead_position_m)
            columns = (trial.pressure_Pa / 1e3, departure.name, time_s, position_m)
            parts.append(pd.DataFrame(dict(zip(MOTION_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True)


def pressure_table(instants: int = 60) -> pd.DataFrame:
    """Compute the remaining gauge pressure along the growth of Fig. 4's vine."""
    rows = []
    for trial in position_trials():
        for departure in DEPARTURES[:2]:
            for y in np.linspace(0, trial.length_m, instants):
                change = area_m2(1e3 * trial.diameter_m) * float(y) / trial.chamber_m3
                left = gauge_left(trial.pressure_Pa, change, departure.gamma or 1.0)
                rows.append((trial.pressure_Pa / 1e3, departure.name, float(y), left))
    return pd.DataFrame(rows, columns=["pressure_kPa", "departure", "lead_position_m", "gauge_left"])


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
