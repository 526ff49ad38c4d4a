"""The paper's numbers beside ours, `paper.csv`: where each is printed, and how ours is found.

What is said about a row stands in `rows.csv` beside this file, one line a row: text with the names of facts in braces,
filled in by `row_of`. Here stands how ours is computed: from the experiment's protocol and results, by arithmetic from
other printed numbers, and by Eq. (2) with the printed B and n.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtr

from vinetrack.core.records import Trial
from vinetrack.core.units import GRAVITY_M_S2, convert, or_nan
from vinetrack.inference.fit_result import FitSummary
from vinetrack.kinematics.damping import regress
from vinetrack.paper import motions
from vinetrack.planning.prediction import GAMMAS, gauge_left
from vinetrack.planning.predictive_inputs import BURST_STRESS_PA, SOURCE, TABLE_I, damping_prior, hoop_stress_Pa

SIMULATED = "simulated from printed parameters"
MEASURED = "measured"
NOT_CHECKABLE = "not checkable"

MARKS = {
    "computed": f"follows by arithmetic, or by Eq. (2), from other numbers of {SOURCE}; ours is the corrected value "
    "where the two differ",
    SIMULATED: "found in virtual trials that were grown from the printed B and n: agreement checks the analysis, not "
    "the paper",
    MEASURED: "found in trials that were filmed",
    NOT_CHECKABLE: "rests on something that is not printed: a setting, a scatter, or a B that had to be guessed",
}

nan = math.nan

Row = dict[str, Any]


# ------------------------------------------------------------------------------
# One row of the table.


@lru_cache
def _texts() -> dict[str, dict[str, str]]:
    with Path(__file__).with_name("rows.csv").open(encoding="utf-8", newline="") as file:
        return {line["row"]: line for line in csv.DictReader(file)}


def row_of(
    name: str, ours: float = nan, interval: Sequence[float] = (nan, nan), *, published_as: float = nan, mark: str = "",
    **facts: Any,
) -> Row:  # fmt: skip
    """Return the row `name` of `rows.csv`, filled in with `facts`. `interval` is the 95 % interval of ours;
    `published_as` is NaN where the paper prints no number; `mark` tells whether the trials were simulated or filmed.
    """
    text = _texts()[name]
    facts |= {"paper": motions, "published": published_as}
    kind, how = text["mark"], text["how"]
    if kind.startswith("trials"):
        kind = NOT_CHECKABLE if kind == "trials if measured" and mark == SIMULATED else mark
        how = (mark == MEASURED and text["how_if_measured"]) or how
    try:
        beside = text["beside"].format(**facts)
    except KeyError:  # The trials did not give what it tells
        beside = ""
    filled = {key: text[key].format(**facts) for key in ("row", "where", "quantity", "setting", "unit")}
    as_printed = text["as_printed"].format(**facts) or (f"{published_as:g}" if math.isfinite(published_as) else "")
    unanswered = kind in (SIMULATED, MEASURED) and not math.isfinite(ours)
    return {
        **filled,
        "published": published_as,
        "as_printed": as_printed,
        "ours": ours,
        "ours_low_95": interval[0],
        "ours_high_95": interval[1],
        "mark": kind,
        "how": "the trials of this experiment do not tell" if unanswered else how.format(**facts),
        "beside": beside,
    }


# ------------------------------------------------------------------------------
# The protocol: the vines of Table I, their fabrication, how trials were run, and steady windows.


def protocol_rows(trials: Sequence[Trial], steady: pd.DataFrame, mark: str) -> Iterator[Row]:
    """Compare the protocol of an experiment with that of the paper."""
    bare = [trial for trial in trials if trial.payload_kg == 0 and trial.travel_ratio == 2]
    by_scale = {R: [t for t in bare if motions.scale_of(1e3 * t.diameter_m, 1e6 * t.thickness_m) == R] for R in TABLE_I}
    for R, vines in by_scale.items():
        thickness_um = _mean([1e6 * trial.thickness_m for trial in vines])
        diameter_mm = _mean([1e3 * trial.diameter_m for trial in vines])
        yield row_of("thickness_R{R}", thickness_um, published_as=TABLE_I[R].thickness_um, mark=mark, R=R)
        yield row_of("diameter_R{R}", diameter_mm, published_as=TABLE_I[R].diameter_mm, mark=mark, R=R)
        yield row_of("press_R{R}", published_as={1: 110.0, 2: 82.0, 3: 96.0, 4: 96.0}[R], R=R)  # °C, as printed
        yield row_of("laser_R{R}", published_as={1: 60.0, 2: 76.0, 3: 81.0, 4: 86.0}[R], R=R)  # %, as printed
    for R, vines in by_scale.items():
        replicates = pd.Series([round(trial.pressure_Pa, 3) for trial in vines], dtype=float).value_counts()
        yield row_of("pressures_R{R}", float(len(replicates)) if vines else nan, mark=mark, R=R)
        yield row_of("trials_R{R}", float(replicates.median()), mark=mark, R=R)
    rates = [trial.capture_fps for trial in trials if math.isfinite(trial.capture_fps)]
    yield row_of("capture_fps", _median(rates), published_as=motions.CAPTURE_FPS, mark=mark)
    names = {trial.name for vines in by_scale.values() for trial in vines}
    # What the published rule for a steady window accepts in trials without payload, and the gated rule
    windows = steady[steady["trial"].isin(names)]
    literal, gated = windows[windows["rule"] == "paper"], windows[windows["rule"] == "gated"]
    accepted = literal[literal["accepted"]]
    fewest, largest = accepted["points"].min(), 100 * accepted["cv"].max()
    drift: Row = {"drift_percent": 100 * accepted["drift"].abs().max()} if len(accepted) else {}
    share: Row = {"gated_percent": 100 * gated["accepted"].mean()} if len(gated) else {}
    limit = 3.0  # of the coefficient of variation of speed, %, as printed
    yield row_of("window_fewest_points", float(fewest), mark=mark, n=len(accepted))
    yield row_of("window_largest_cv", float(largest), published_as=limit, mark=mark, **drift)
    yield row_of("window_share_accepted", 100 * _mean(literal["accepted"].tolist()), mark=mark, **share)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else nan


# ------------------------------------------------------------------------------
# The results of an experiment: damping law, positions, speeds, dependence on size.


def paper_tables(
    trials: Sequence[Trial], mark: str, fit: FitSummary, kinematics: Callable[[str], pd.DataFrame],
    steady: pd.DataFrame, **files: Any,
) -> dict[str, pd.DataFrame]:  # fmt: skip
    """Return the tables of the paper's figures, and `paper` with every number; `kinematics` reads those of a trial."""
    tables = motions.comparison_tables(trials, fit, kinematics)
    files |= {name: tables[f"paper_{name}"] for name in ("positions", "speeds", "departures")}
    of_results = result_rows(mark, fit, **files)
    rows = [*protocol_rows(trials, steady, mark), *of_results, *computed_rows(), *theory_rows(trials)]
    return tables | {"paper": pd.DataFrame(rows)}


def result_rows(
    mark: str, fit: FitSummary, *, damping: Mapping[str, Any], scaling: Mapping[str, Any], conditions: pd.DataFrame,
    positions: pd.DataFrame, speeds: pd.DataFrame, departures: pd.DataFrame,
) -> Iterator[Row]:  # fmt: skip
    """Yield every row that an experiment can answer; where it does not, ours is blank."""
    yield from _law_rows(mark, damping)
    yield from _motion_rows(mark, fit, positions, speeds, departures)
    yield from _scale_rows(mark, scaling)
    yield from _wall_rows(mark, damping, scaling)
    yield from _efficiency_rows(mark, scaling)
    yield _fast_row(mark, conditions)


def _bounds(pair: Sequence[float | None] | None) -> tuple[float, float]:
    """An interval of a JSON file, NaN for null."""
    low, high = pair or (nan, nan)
    return or_nan(low), or_nan(high)


def _fitted(line: Mapping[str, Any], key: str = "slope") -> dict[str, Any]:
    """Ours, its interval and its p-value, of a fitted line; blank if there is none."""
    p = {"p": line["p"]} if line else {}
    return {"ours": or_nan(line.get(key)), "interval": _bounds(line.get(f"{key}_95")), **p}


def _law_rows(mark: str, damping: Mapping[str, Any]) -> Iterator[Row]:
    laws = {method: damping.get(method) or {} for method in ("log_log", "both_axes", "paper")}
    for row, law in zip(("n_log_log", "n_both_axes", "n_literal"), laws.values(), strict=True):
        interval = _bounds(law.get("n_95_total"))
        yield row_of(row, or_nan(law.get("n")), interval, published_as=motions.PRINTED_EXPONENT, mark=mark)
    for R, printed in TABLE_I.items():
        log_log, ours, literal = (_vine_of(law, R) for law in laws.values())
        B, interval, n = or_nan(ours.get("B")), _bounds(ours.get("B_95_total")), ours.get("n_trials", 0)
        by_rule: Row = {"literal": literal["B"]} if math.isfinite(or_nan(literal.get("B"))) else {}
        yield row_of("B_R{R}", B, interval, published_as=printed.B, mark=mark, R=R, n=n, **by_rule)
        R2 = or_nan(log_log.get("R2"))
        yield row_of("R2_R{R}", R2, published_as=printed.R2, mark=mark, R=R)


def _vine_of(law: Mapping[str, Any], R: int) -> Mapping[str, Any]:
    """What a law says of the vine of scale R."""
    vines: Iterable[Mapping[str, Any]] = (law.get("vines") or {}).values()
    return next((vine for vine in vines if motions.scale_of(vine["diameter_mm"], vine["thickness_um"]) == R), {})


def _motion_rows(
    mark: str, fit: FitSummary, positions: pd.DataFrame, speeds: pd.DataFrame, departures: pd.DataFrame
) -> Iterator[Row]:
    for kPa, printed in motions.POSITION_RMS_CM.items():
        lines = _at_pressure(positions, kPa)
        first: Any = lines.iloc[0] if len(lines) else {"n_trials": 0, "rms_mean_m": nan}
        facts: Row = {
            "n": first["n_trials"],
            "alone": f"; {100 * first['rms_single_m']:.2f} cm over single trials" if len(lines) else "",
            "departures": departures_in_words(departures, "Fig. 4", kPa),
        }
        rms_cm = 100 * float(first["rms_mean_m"])
        yield row_of("position_rms_{kPa:g}kPa", rms_cm, published_as=printed, mark=mark, kPa=kPa, **facts)
    pressures = [
        [value / 1e3 for value in (fitted.value, fitted.low, fitted.high)]
        for fitted in fit.numbers
        if fitted.key == "yield_pressure.P_y" and fitted.vine.startswith("24mm-200um")
    ]
    yield_kPa, *interval = pressures[-1] if pressures else (nan, nan, nan)
    yield row_of("yield_pressure", yield_kPa, interval, published_as=motions.YIELD_PRESSURE_KPA, mark=mark)
    for kPa, printed in motions.FINAL_SPEED_RMS_M_S.items():
        lines = _at_pressure(speeds, kPa)
        off = (lines["final_lead_velocity_m_s"] - lines["eq2_lead_velocity_m_s"]).to_numpy(float)
        facts = {
            "payloads": ", ".join(f"{payload:g}" for payload in lines["payload_g"]) or "none",
            "departures": departures_in_words(departures, "Fig. 5", kPa),
        }
        yield row_of(
            "final_speed_rms_{kPa:g}kPa", math.sqrt(_mean((off**2).tolist())), published_as=printed, kPa=kPa, **facts
        )


def _at_pressure(table: pd.DataFrame, pressure_kPa: float) -> pd.DataFrame:
    return table[np.isclose(table["pressure_kPa"].to_numpy(float), pressure_kPa)]


def departures_in_words(table: pd.DataFrame, figure: str, pressure_kPa: float) -> str:
    """Describe the effect of departures from Eq. (2) in a sentence: positions in cm, speeds in m/s."""
    lines = table[(table["figure"] == figure) & (abs(table["pressure_kPa"] - pressure_kPa) < 1e-6)]
    column, factor, unit = (
        ("rms_position_m", 100.0, "cm") if figure == "Fig. 4" else ("rms_final_lead_velocity_m_s", 1.0, "m/s")
    )
    size = {row.departure: factor * float(getattr(row, column)) for row in lines.itertuples()}
    if not size:
        return ""
    slow, fast, slack, both_slow, both_fast = (size[departure.name] for departure in motions.DEPARTURES)
    return (
        f"not in it: a chamber that nothing refills would cause {slow:.2f} to {fast:.2f} {unit}, a tail that "
        f"cannot push {slack:.2f}, both {both_slow:.2f} to {both_fast:.2f}"
    )


def _scale_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[Row]:
    isometric: Mapping[str, Any] = next(
        (family for family in scaling.get("isometric") or () if len(family["vines"]) >= 4), {}
    )
    yield row_of("our_B_power_of_scale", **_fitted(isometric.get("power") or {}), mark=mark)
    yield row_of("our_B_line_R2", or_nan((isometric.get("line") or {}).get("R2")), mark=mark)

    families: Sequence[Mapping[str, Any]] = scaling.get("steady_speed") or ()
    family = next((one for one in families if _close(one["pressure_kPa"], motions.STEADY_SPEED_KPA)), {})
    n, line = len(family.get("sizes", ())), family.get("line") or {}
    counts = [int(count) for count in family.get("n_steady", ())]
    # 4: the printed N of Figs. 4, 5, 8 and 9
    yield row_of("steady_speed_trials", _median(counts), published_as=4.0, mark=mark, n=n)
    facts: Row = {"p": line["p"], "monotonic": "yes" if family.get("monotonic") else "no"} if line else {}
    R2 = or_nan(line.get("R2"))
    yield row_of("steady_speed_R2", R2, published_as=motions.STEADY_SPEED_R2, mark=mark, n=n, **facts)
    yield row_of("steady_speed_power", **_fitted(family.get("power") or {}), mark=mark, n=n)
    relative = (family.get("over_diameter") or {}).get("power") or {}
    yield row_of("steady_speed_over_diameter_power", **_fitted(relative), mark=mark, n=n)


def _close(ours: float, printed: float) -> bool:
    return math.isclose(ours, printed, rel_tol=0.02)


def _wall_rows(mark: str, damping: Mapping[str, Any], scaling: Mapping[str, Any]) -> Iterator[Row]:
    vines = (damping.get("both_axes") or {}).get("vines") or {}
    family: Mapping[str, Any] = {}  # of the diameter of Fig. 7B, 12 mm
    for candidate in scaling.get("thickness") or ():
        diameters_mm = [vines.get(vine, {}).get("diameter_mm", nan) for vine in candidate["vines"]]
        if any(abs(mm / 12.0 - 1) < 0.01 for mm in diameters_mm):
            family = candidate
    walls = ", ".join(f"{size:g}" for size in family.get("sizes", ()))
    yield row_of("B_power_of_wall", **_fitted(family.get("power") or {}), mark=mark, walls=walls)
    yield row_of("B_wall_line_R2", or_nan((family.get("line") or {}).get("R2")), mark=mark, walls=walls)


def _efficiency_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[Row]:
    families = [
        family
        for family in scaling.get("efficiency") or ()
        if _close(family["pressure_kPa"], motions.EFFICIENCY_KPA) and _close(family["payload_g"], motions.PAYLOAD_G)
    ]
    trends: Mapping[str, Any] = families[0]["trend"] if families else {}
    names = {
        "efficiency": "½ m(x) ẋ² / (P₀ A y)",
        "efficiency_payload": "payload alone",
        "efficiency_with_weight": "with the work of the weight in the denominator",
    }
    for key, words in names.items():
        trend = trends.get(key) or {}
        for row, size in (("{key}_power_of_wall", "thickness_um"), ("{key}_power_of_diameter", "diameter_mm")):
            power = _fitted(trend.get(size) or {}, "power")
            yield row_of(row, **power, mark=mark, key=key, words=words, n=trend.get("n", 0))


def _fast_row(mark: str, table: pd.DataFrame) -> Row:
    same = np.array(table["payload_g"] == 0)
    for column in ("diameter_mm", "thickness_um", "pressure_kPa"):
        same &= np.isclose(table[column].to_numpy(float), motions.FAST_VINE[column], rtol=0.02)
    speed, place = nan, ""
    if same.any():
        first = table[same].iloc[0]
        speed = float(first["final_lead_velocity_m_s"])
        place = f", at {first['final_at_mm']:.0f} mm, N = {int(first['n_final'])}"
    # 60: the printed speed of its leading edge, m/s, as measured
    return row_of("fast_vine_measured", speed, published_as=60.0, mark=mark, place=place)


# ------------------------------------------------------------------------------
# What follows from the paper's own numbers by arithmetic.


def p_value(R2: float, n: int) -> float:
    """Return the two-sided p-value of the slope of a straight line from its R² and the number of points."""
    dof = n - 2
    return 2 * float(stdtr(dof, -math.sqrt(R2 * dof / (1 - R2))))


def weight_over_gas(diameter_mm: float) -> float:
    """Return the work of the payload's weight m g x over that of the gas P₀Ay, as in the paper's Fig. 9, x = 2y."""
    gas_Pa_m2 = 1e3 * motions.EFFICIENCY_KPA * motions.area_m2(diameter_mm)
    return motions.PAYLOAD_G / 1e3 * GRAVITY_M_S2 * 2 / gas_Pa_m2


def computed_rows() -> Iterator[Row]:
    """Yield every row of the table that needs no experiment and no simulation."""
    for R, printed in TABLE_I.items():
        relative = printed.thickness_um / printed.diameter_mm / (TABLE_I[1].thickness_um / TABLE_I[1].diameter_mm)
        yield row_of("isometry_R{R}", relative, published_as=1.0, R=R)
    change = motions.volume_change(motions.CHAMBER_L / 1e3, TABLE_I[4].diameter_mm, motions.LONGEST_VINE_MM)
    printed_change, allowed = 100 * motions.CHAMBER_CHANGE, 100 * motions.CHAMBER_ALLOWED
    yield row_of("chamber_volume_change", 100 * change, published_as=printed_change)
    for kPa in sorted(motions.POSITION_RMS_CM, reverse=True):
        for law, gamma in GAMMAS.items():
            drop = 100 * (1 - gauge_left(1e3 * kPa, change, gamma))
            facts: Row = {"kPa": kPa, "speed": law.split(",")[0], "process": law.split()[1]}
            yield row_of("gauge_drop_{kPa:g}kPa_{speed}", drop, published_as=printed_change, allowed=allowed, **facts)
    R2, n = motions.STEADY_SPEED_R2, len(TABLE_I)
    yield row_of("steady_speed_p_value", p_value(R2, n), published_as=0.32, n=n)  # 0.32: as printed
    scales, B = np.array([(R, printed.B) for R, printed in TABLE_I.items()]).T
    power, line = regress(np.log(scales), np.log(B)), regress(scales, B)
    yield row_of("B_power_of_scale", power["slope"], power["slope_95"])
    yield row_of("B_line_R2", line["R2"])
    yield row_of("B_line_intercept", line["intercept"], line["intercept_95"])
    gauge_Pa, yield_Pa = 1e3 * motions.STEADY_SPEED_KPA, 1e3 * motions.YIELD_PRESSURE_KPA
    for R, printed in TABLE_I.items():
        # By Eq. (3)
        forces_N = [(gauge_Pa - least_Pa) * motions.area_m2(printed.diameter_mm) for least_Pa in (0.0, yield_Pa)]
        bare, with_yield = ((force_N / printed.B) ** (1 / motions.PRINTED_EXPONENT) for force_N in forces_N)
        yield row_of("steady_speed_of_printed_B_R{R}", bare, R=R, with_yield=with_yield)
    for diameter_mm in (12.0, 18.0):  # of Fig. 9
        yield row_of("weight_share_{mm:g}mm", 100 * weight_over_gas(diameter_mm), mm=diameter_mm)
    # One vine of the dye injector, 2.5 mm × 12.5 mm at 48 kPa, and its chamber, 20 mm long and 15 mm in diameter
    injected = 100 * 0.017  # Relative change of its pressure
    change = motions.volume_change(motions.area_m2(15.0) * 20.0 / 1e3, 2.5, 12.5)
    slow, fast = (100 * (1 - gauge_left(1e3 * 48.0, change, gamma)) for gamma in GAMMAS.values())
    yield row_of("injector_volume_change", 100 * change, published_as=injected)
    yield row_of("injector_gauge_drop", slow, published_as=injected, fast=fast)
    for R, printed in TABLE_I.items():
        yield row_of("guessed_B_R{R}", damping_prior(*printed.size), published_as=printed.B, R=R)
    vine = motions.FAST_VINE
    stress_Pa = hoop_stress_Pa(1e3 * vine["pressure_kPa"], vine["diameter_mm"] / 1e3, vine["thickness_um"] / 1e6)
    yield row_of("fast_vine_hoop_stress", stress_Pa / 1e6, burst_MPa=BURST_STRESS_PA / 1e6)
    # The printed pressures look like rounded pounds per square inch: 14 kPa is 2 psi, 13.79 kPa.
    pressures_kPa, psi_kPa = (7, 14, 28, 34, 41, 48, 62), convert(1.0, "psi", "kPa")
    exact = [round(kPa / psi_kPa) * psi_kPa for kPa in pressures_kPa]
    errors = [abs(kPa / true - 1) for kPa, true in zip(pressures_kPa, exact, strict=True)]
    worst = int(np.argmax(errors))
    yield row_of("pressure_rounding", 100 * errors[worst], kPa=pressures_kPa[worst], exact=exact[worst])


# ------------------------------------------------------------------------------
# What follows by Eq. (2) with the paper's own numbers: the fast vine, air drag, and the published rule.


def theory_rows(trials: Sequence[Trial]) -> Iterator[Row]:
    """Compute the rows on the fast vine, on air drag, and on the published rule for noise-free motions."""
    # Fractions of the length at which the speed of the fast vine is evaluated (chosen)
    fast_at = (0.90, 0.95, 0.98, 0.99)
    fast = motions.FAST_VINE
    B = damping_prior(fast["diameter_mm"] / 1e3, fast["thickness_um"] / 1e6)
    for fraction, speed in zip(fast_at, motions.speeds_at(fast_at, fast), strict=True):
        # 56: the speed of its leading edge, m/s, that the authors predict
        yield row_of("fast_vine_predicted_{percent:.0f}", speed, published_as=56.0, percent=100 * fraction, B=B)
    # (0.50, 0.95, 0.99): fractions of the length at which drag is evaluated (chosen)
    for fraction, share, by_print in motions.drag_shares((0.50, 0.95, 0.99)):
        facts: Row = {"percent": 100 * fraction, "by_print": 100 * by_print}
        # 5 %: the largest part of the drive that drag is stated to be
        yield row_of("drag_share_{percent:.0f}", 100 * share, published_as=5.0, **facts)
    # Bias of the published rule in noise-free motions, with a full and with a depleting chamber
    chosen: dict[str, Trial] = {}
    for trial in trials:
        scale = motions.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m)
        if scale is not None and trial.payload_kg == 0 and trial.travel_ratio == 2:
            chosen.setdefault(trial.condition, trial)
    if len(chosen) < len(TABLE_I):
        return
    cases = {"rule_bias_n": None, "rule_n_depletion_slow": 1.0, "rule_n_depletion_fast": 1.4}
    for row, gamma in cases.items():
        n, found = motions.rule_on_noise_free(gamma, list(chosen.values()))
        scales = sorted(found)
        facts = {"B": ", ".join(f"{found[R]:.2f}" for R in scales), "scales": ", ".join(map(str, scales))}
        yield row_of(row, n, published_as=motions.PRINTED_EXPONENT, n=len(chosen), **facts)
