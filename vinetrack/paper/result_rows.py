"""Rows of the table that come from the results of an experiment: damping law, positions, speeds, dependence on size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.records import Trial, plain_track
from vinetrack.core.units import AIR_DENSITY_KG_M3
from vinetrack.dynamics.simulate import Trajectory, simulate, simulate_many
from vinetrack.inference.fit_summary import FitSummary
from vinetrack.kinematics.damping import fit_laws
from vinetrack.kinematics.force import paper_force_N
from vinetrack.kinematics.steady import paper_window
from vinetrack.kinematics.summary import lead_velocity_at
from vinetrack.paper.arithmetic import (
    COMPUTED,
    DEPARTURES,
    NONE,
    NOT_CHECKABLE,
    PREFERRED,
    SIMULATED,
    Departure,
    PaperRow,
    bounds,
    number,
    paper_trial,
)
from vinetrack.planning.predictive_inputs import damping_prior

# ------------------------------------------------------------------------------
# Rows of the table that follow from Eq. (2) with the paper's own numbers, by simulation and without an experiment.
#
# They cover the fast vine, air drag, and the published rule applied to simulated motions.

FAST_AT = (0.90, 0.95, 0.98, 0.99)  # Fractions of the length at which the speed of the fast vine is evaluated (chosen)

DRAG_AT = (0.50, 0.95, 0.99)  # Fractions of the length at which drag is evaluated (chosen)


def theory_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """Compute the rows on the fast vine, on air drag, and on the published rule for noise-free motions."""
    yield from _fast_rows()
    yield from _drag_rows()
    yield from _rule_rows(trials)


def _fast_rows() -> Iterator[PaperRow]:
    fast = published.FAST_VINE
    B = damping_prior(fast["diameter_mm"] / 1e3, fast["thickness_um"] / 1e6)
    size = f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm × {fast['length_mm']:g} mm"
    for fraction, speed in zip(FAST_AT, fast_vine_speeds(FAST_AT), strict=True):
        yield PaperRow(
            row=f"fast_vine_predicted_{100 * fraction:.0f}",
            where="Section IV-E",
            quantity="speed of the leading edge by Eq. (2)",
            setting=f"{size}, {fast['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="m/s",
            published=published.FAST_VINE_PREDICTED_M_S,
            ours=speed,
            mark=NOT_CHECKABLE,
            how=f"its B is not printed; with a guess, B = {B:.2f}; fold and gas are the least that moves",
            beside="in Eq. (2) the speed of a bare vine has no limit at its end: the place where it is taken decides",
        )


def _drag_rows() -> Iterator[PaperRow]:
    case = published.DRAG_EXAMPLE
    size = f"{case['diameter_mm']:g} mm × {case['thickness_um']:g} µm × {case['length_mm']:g} mm"
    for fraction, share, printed in drag_shares(DRAG_AT):
        yield PaperRow(
            row=f"drag_share_{100 * fraction:.0f}",
            where="Section II",
            quantity="air drag over drive, C_D = 0.82",
            setting=f"{size}, {case['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="%",
            published=100 * published.DRAG_SHARE,
            as_printed=f"{100 * published.DRAG_SHARE:g}, not before {case['pressure_kPa']:g} kPa",
            ours=100 * share,
            mark=NOT_CHECKABLE,
            how="¼ρ A C_D ẏ² over ½PA: the air meets the head at ẏ, and the pulley halves it; its B is a guess",
            beside=f"{100 * printed:.0f} % by the printed ½ρ A C_D ẋ²: the place along the growth decides",
        )


def _rule_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """Bias of the published rule in noise-free motions, with a full and with a depleting chamber."""
    chosen: dict[str, Trial] = {}
    for trial in trials:
        scale = published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m)
        if scale is not None and trial.payload_kg == 0 and trial.travel_ratio == 2:
            chosen.setdefault(trial.condition, trial)
    if len(chosen) < len(published.DAMPING_B):
        return
    cases = (
        ("rule_bias_n", None, "chamber kept full", "the weight of the film, which Eq. (3) leaves out, lifts n"),
        ("rule_n_depletion_slow", 1.0, "chamber not refilled, isothermal", "set pressure in place of what is left"),
        ("rule_n_depletion_fast", 1.4, "chamber not refilled, adiabatic", "set pressure in place of what is left"),
    )
    for row, gamma, setting, how in cases:
        n, B = rule_on_noise_free(gamma, list(chosen.values()))
        of_scales = ", ".join(f"{B[scale]:.2f}" for scale in sorted(B))
        yield PaperRow(
            row=row,
            where="Fig. 6",
            quantity="n that the published rule finds in noise-free motions with the printed n",
            setting=setting,
            published=published.EXPONENT,
            ours=n,
            mark=COMPUTED,
            how=f"{len(chosen)} pressures and vines, Eq. (2) with the printed B, no noise or scatter; {how}",
            beside=f"and B = {of_scales} for R = {', '.join(str(scale) for scale in sorted(B))}",
        )


def departures_in_words(table: pd.DataFrame, figure: str, pressure_kPa: float) -> str:
    """Describe the effect of departures from Eq. (2) in a sentence: positions in cm, speeds in m/s."""
    lines = table[(table["figure"] == figure) & (abs(table["pressure_kPa"] - pressure_kPa) < 1e-6)]
    column, factor, unit = (
        ("rms_position_m", 100.0, "cm") if figure == "Fig. 4" else ("rms_final_lead_velocity_m_s", 1.0, "m/s")
    )
    size = {row.departure: factor * float(getattr(row, column)) for row in lines.itertuples()}
    if not size:
        return ""
    slow, fast, slack, both_slow, both_fast = (size[departure.name] for departure in DEPARTURES)
    return (
        f"not in it: a chamber that nothing refills would cause {slow:.2f} to {fast:.2f} {unit}, a tail that "
        f"cannot push {slack:.2f}, both {both_slow:.2f} to {both_fast:.2f}"
    )


SLOWEST_S = 10.0  # Duration of the simulated motions, s (chosen)


def fast_vine_speeds(fractions: Sequence[float]) -> list[float]:
    """Compute the speed of the fast vine's leading edge by Eq. (2) with B from the scaling prior."""
    fast = published.FAST_VINE
    trial = paper_trial(fast["diameter_mm"], fast["thickness_um"], fast["length_mm"], fast["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    motion = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    return [lead_velocity_at(motion.lead_position_m, motion.lead_velocity_m_s, f * trial.length_m) for f in fractions]


def drag_shares(fractions: Sequence[float]) -> Iterator[tuple[float, float, float]]:
    """Compute the ratio of drag to drive in the paper's example of air drag, by mechanics and as printed. By mechanics
    the air meets the head at ẏ and the pulley halves the force: ¼ρ A C_D ẏ² over ½PA; printed is ½ρ A C_D ẋ². Speeds
    are those of Eq. (2) without drag, with B from the scaling prior.
    """
    case = published.DRAG_EXAMPLE
    trial = paper_trial(case["diameter_mm"], case["thickness_um"], case["length_mm"], case["pressure_kPa"])
    model = NONE.model(damping_prior(trial.diameter_m, trial.thickness_m))
    motion = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    for fraction in fractions:
        lead = lead_velocity_at(motion.lead_position_m, motion.lead_velocity_m_s, fraction * trial.length_m)
        share = 0.5 * AIR_DENSITY_KG_M3 * published.DRAG_COEFFICIENT * lead**2 / trial.pressure_Pa
        yield fraction, share, 8 * share


def rule_on_noise_free(gamma: float | None, trials: Sequence[Trial]) -> tuple[float, dict[int, float]]:
    """Apply the published rule to noise-free motions of these trials, simulated with the printed B and n.
    Returns n, B.
    """
    departure = Departure("", "", gamma=gamma)
    time_s = np.arange(0, SLOWEST_S, 1 / published.CAPTURE_FPS)
    rows = []
    for scale, B in published.DAMPING_B.items():
        of_scale = [
            replace(trial, chamber_m3=published.CHAMBER_L / 1e3, yield_pressure_Pa=1e3 * published.YIELD_PRESSURE_KPA)
            for trial in trials
            if published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m) == scale
        ]
        runs = simulate_many(departure.model(B), of_scale, [time_s] * len(of_scale))
        rows += [_point(scale, trial, moved) for trial, moved in zip(of_scale, runs, strict=True)]
    law = fit_laws(pd.DataFrame(rows), resamples=100)["paper"]
    return float(law["n"]), {int(vine): float(vine_law["B"]) for vine, vine_law in law["vines"].items()}


def _point(scale: int, trial: Trial, moved: Trajectory) -> dict[str, object]:
    """A row of the damping fit that only the published rule uses."""
    unknown = dict.fromkeys(("x_ss_m_s", "x_ss_sigma_m_s", "force_N", "force_sigma_N"), math.nan)
    return {
        "trial": trial.name,
        "vine": str(scale),
        "diameter_mm": 1e3 * trial.diameter_m,
        "thickness_um": 1e6 * trial.thickness_m,
        **unknown,
        "yield_force_sigma_N": 0.0,
        "x_ss_paper_m_s": _published_window(moved, trial.travel_ratio),
        "force_paper_N": paper_force_N(trial),
        "eligible": True,
        "used": False,
    }


def _published_window(moved: Trajectory, travel_ratio: float) -> float:
    """Steady tail speed by the published rule in a motion without noise, m/s."""
    stop = int(np.searchsorted(moved.time_s, moved.end_time_s)) if math.isfinite(moved.end_time_s) else None
    time_s, position_m = moved.time_s[:stop], moved.lead_position_m[:stop]
    track = plain_track(time_s, position_m)
    window = paper_window(
        track, travel_ratio=travel_ratio, cv_limit=published.STEADY_CV, min_points=published.STEADY_FEWEST_POINTS
    )
    return window.x_ss_m_s if window.accepted else math.nan


nan = math.nan


@dataclass(frozen=True, kw_only=True)
class ExperimentResults:
    """Results of an experiment: tables and files of its results folder, by their names there. `mark` is `SIMULATED` or
    `MEASURED`.
    """

    mark: str
    damping: Mapping[str, Any]
    scaling: Mapping[str, Any]
    conditions: pd.DataFrame
    fit: FitSummary
    positions: pd.DataFrame
    speeds: pd.DataFrame
    departures: pd.DataFrame


def result_rows(results: ExperimentResults) -> Iterator[PaperRow]:
    """Yield every row that an experiment can answer; where it does not, ours is blank."""
    yield from _law_rows(results)
    yield from _position_rows(results)
    yield from _final_speed_rows(results)
    yield from size_rows(results.mark, results.damping, results.scaling)
    yield _fast_row(results)


def _law_rows(results: ExperimentResults) -> Iterator[PaperRow]:
    names = {
        "log_log": ("n_log_log", "least squares on logarithms, with the weight in the force"),
        PREFERRED: ("n_both_axes", "errors on both axes, with the weight in the force"),
        "paper": ("n_literal", "the published rule to the letter: set pressure, no weight, 3 % windows"),
    }
    for method, (row, how) in names.items():
        law = results.damping.get(method) or {}
        low, high = bounds(law.get("n_95_total"))
        yield PaperRow(
            row=row,
            where="Fig. 6",
            quantity="damping exponent n, shared by the scales",
            published=published.EXPONENT,
            ours=number(law.get("n")),
            low=low,
            high=high,
            mark=results.mark,
            how=how,
        )
    for scale, printed in published.DAMPING_B.items():
        yield from _coefficient_rows(results, scale, printed)


def _coefficient_rows(results: ExperimentResults, scale: int, printed: float) -> Iterator[PaperRow]:
    ours = {method: _law_of(results.damping.get(method) or {}, scale) for method in (PREFERRED, "log_log", "paper")}
    low, high = bounds(ours[PREFERRED].get("B_95_total"))
    literal = number(ours["paper"].get("B"))
    yield PaperRow(
        row=f"B_R{scale}",
        where="Fig. 6",
        quantity="damping coefficient B",
        setting=f"R = {scale}, N = {ours[PREFERRED].get('n_trials', 0)} steady trials",
        unit="N·(s/m)ⁿ",
        published=printed,
        ours=number(ours[PREFERRED].get("B")),
        low=low,
        high=high,
        mark=results.mark,
        how="errors on both axes",
        beside=f"{literal:.3g} by the published rule to the letter" if math.isfinite(literal) else "",
    )
    yield PaperRow(
        row=f"R2_R{scale}",
        where="Fig. 6",
        quantity="R² of the power law",
        setting=f"R = {scale}",
        published=published.DAMPING_R2[scale],
        ours=number(ours["log_log"].get("R2")),
        mark=NOT_CHECKABLE if results.mark == SIMULATED else results.mark,
        how="least squares on logarithms; in virtual trials R² says what scatter was assumed",
    )


def _law_of(law: Mapping[str, Any], scale: int) -> Mapping[str, Any]:
    for vine in (law.get("vines") or {}).values():
        if published.scale_of(vine["diameter_mm"], vine["thickness_um"]) == scale:
            return dict(vine)
    return {}


def _position_rows(results: ExperimentResults) -> Iterator[PaperRow]:
    names = ("n_trials", "rms_mean_m", "rms_single_m")
    for pressure_kPa, printed_cm in published.POSITION_RMS_CM.items():
        lines = results.positions[np.isclose(results.positions["pressure_kPa"].to_numpy(float), pressure_kPa)]
        n_trials, mean_m, single_m = (float(lines[name].iloc[0]) for name in names) if len(lines) else (0.0, nan, nan)
        alone = f"; {100 * single_m:.2f} cm over single trials" if len(lines) else ""
        yield PaperRow(
            row=f"position_rms_{pressure_kPa:g}kPa",
            where="Fig. 4, Table II",
            quantity="rms of the leading edge's position, mean of the trials against Eq. (2) with the printed numbers",
            setting=f"24 mm × 200 µm, {published.PAYLOAD_G:g} g, {pressure_kPa:g} kPa, N = {n_trials:g}",
            unit="cm",
            published=printed_cm,
            ours=100 * mean_m,
            mark=results.mark,
            how=("nothing but B and P that scatter by 3 and 1 %" if results.mark == SIMULATED else "as filmed") + alone,
            beside=departures_in_words(results.departures, "Fig. 4", pressure_kPa),
        )
    yield _yield_row(results)


def _yield_row(results: ExperimentResults) -> PaperRow:
    ours, low, high = nan, nan, nan
    for fitted in results.fit.numbers:
        if fitted.key == "yield_pressure.P_y" and fitted.vine.startswith("24mm-200um"):
            ours, low, high = (value / 1e3 for value in (fitted.value, fitted.low, fitted.high))
    return PaperRow(
        row="yield_pressure",
        where="Section IV-A",
        quantity="yield pressure",
        setting="24 mm × 200 µm",
        unit="kPa",
        published=published.YIELD_PRESSURE_KPA,
        ours=ours,
        low=low,
        high=high,
        mark=results.mark,
        how="fitted to whole trajectories with what the sheet says and its error",
    )


def _final_speed_rows(results: ExperimentResults) -> Iterator[PaperRow]:
    for pressure_kPa, printed in published.FINAL_SPEED_RMS_M_S.items():
        lines = results.speeds[np.isclose(results.speeds["pressure_kPa"].to_numpy(float), pressure_kPa)]
        off = (lines["final_lead_velocity_m_s"] - lines["eq2_lead_velocity_m_s"]).to_numpy(float)
        payloads = ", ".join(f"{payload:g}" for payload in lines["payload_g"])
        yield PaperRow(
            row=f"final_speed_rms_{pressure_kPa:g}kPa",
            where="Fig. 5, Table II",
            quantity="rms over payloads of the leading edge's speed at 12 cm, means against Eq. (2)",
            setting=f"24 mm × 150 µm, {pressure_kPa:g} kPa, payloads {payloads or 'none'} g",
            unit="m/s",
            published=printed,
            ours=math.sqrt(float(np.mean(off**2))) if off.size else nan,
            mark=NOT_CHECKABLE,
            how="B of this vine and the payloads are not printed: B in proportion to the wall, payloads ours",
            beside=departures_in_words(results.departures, "Fig. 5", pressure_kPa),
        )


def _fast_row(results: ExperimentResults) -> PaperRow:
    fast = published.FAST_VINE
    table = results.conditions
    same = np.ones(len(table), dtype=bool)
    for column in ("diameter_mm", "thickness_um", "pressure_kPa"):
        same &= np.isclose(table[column].to_numpy(float), fast[column], rtol=0.02)
    lines = table[same & (table["payload_g"] == 0).to_numpy()]
    row = lines.iloc[0] if len(lines) else None
    return PaperRow(
        row="fast_vine_measured",
        where="Section IV-E",
        quantity="speed of the leading edge, measured",
        setting=f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm, {fast['pressure_kPa']:g} kPa"
        + (f", at {row['final_at_mm']:.0f} mm, N = {int(row['n_final'])}" if row is not None else ""),
        unit="m/s",
        published=published.FAST_VINE_MEASURED_M_S,
        ours=float(row["final_lead_velocity_m_s"]) if row is not None else nan,
        mark=NOT_CHECKABLE if results.mark == SIMULATED else results.mark,
        how="its B is not printed; the virtual one has a guessed B, and where the 60 m/s were measured is not printed"
        if results.mark == SIMULATED
        else "as filmed",
    )


def size_rows(mark: str, damping: Mapping[str, Any], scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    """Yield the rows from `damping.json` and `scaling.json`; where these do not answer, ours is blank."""
    yield from _scale_rows(mark, scaling)
    yield from _steady_speed_rows(mark, scaling)
    yield from _wall_rows(mark, damping, scaling)
    yield from _efficiency_rows(mark, scaling)


def _scale_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    family = next((family for family in scaling.get("isometric") or () if len(family["vines"]) >= 4), None)
    line, power = ((family or {}).get(key) or {} for key in ("line", "power"))
    row_of = partial(PaperRow, where="Fig. 7A", setting="our four B against R", as_printed="near-linear", mark=mark)
    low, high = bounds(power.get("slope_95"))
    how = "least squares on the means of vines"
    yield row_of(
        row="our_B_power_of_scale",
        quantity="exponent on log axes",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        how=how,
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    yield row_of(row="our_B_line_R2", quantity="R² of a straight line", ours=number(line.get("R2")), how=how)


def _steady_speed_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    family = _at_pressure(scaling.get("steady_speed") or (), published.STEADY_SPEED_KPA)
    sizes = len(family.get("sizes", ()))
    counts = [int(count) for count in family.get("n_steady", ())]
    setting = f"{published.STEADY_SPEED_KPA:g} kPa, N = {sizes} vines"
    row_of = partial(PaperRow, where="Fig. 8", setting=setting, mark=mark)
    yield row_of(
        row="steady_speed_trials",
        quantity="steady trials a vine",
        published=float(published.REPLICATES),
        ours=float(np.median(counts)) if counts else nan,
        how="those whose speed the gated rule finds steady",
    )
    line, power = (family.get(key) or {} for key in ("line", "power"))
    why = "grown from the printed B, which do not rise evenly with R" if mark == SIMULATED else "as filmed"
    yield row_of(
        row="steady_speed_R2",
        quantity="R² of a straight line through the speeds",
        published=published.STEADY_SPEED_R2,
        ours=number(line.get("R2")),
        how=f"{why}: Fig. 6 and Fig. 8 cannot be tested on each other",
        beside=f"p = {line['p']:.2g}, monotonic: {'yes' if family.get('monotonic') else 'no'}" if line else "",
    )
    low, high = bounds(power.get("slope_95"))
    yield row_of(
        row="steady_speed_power",
        quantity="exponent of steady speed against scale, on log axes",
        as_printed="rises monotonically",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        how=f"least squares on the means of vines; {why}",
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    relative = (family.get("over_diameter") or {}).get("power") or {}
    low, high = bounds(relative.get("slope_95"))
    yield row_of(
        row="steady_speed_over_diameter_power",
        quantity="exponent of steady speed over diameter against scale",
        as_printed="no trend",
        ours=number(relative.get("slope")),
        low=low,
        high=high,
        how="least squares on the means of vines; four vines exclude little",
        beside=f"p = {relative['p']:.2g}" if relative else "",
    )


def _wall_rows(mark: str, damping: Mapping[str, Any], scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    diameter_mm = published.THICKNESS_SERIES_DIAMETER_MM
    families = scaling.get("thickness") or ()
    damping = (damping.get(PREFERRED) or {}).get("vines") or {}
    family: Mapping[str, Any] = {}
    for candidate in families:
        if any(
            abs(damping.get(vine, {}).get("diameter_mm", nan) / diameter_mm - 1) < 0.01 for vine in candidate["vines"]
        ):
            family = candidate
    power, line = (family.get(key) or {} for key in ("power", "line"))
    row_of = partial(
        PaperRow,
        where="Fig. 7B",
        setting=f"{diameter_mm:g} mm, walls of {', '.join(f'{size:g}' for size in family.get('sizes', ()))} µm",
        as_printed="rises linearly",
        mark=NOT_CHECKABLE if mark == SIMULATED else mark,
        how="of the four B one is printed; the virtual trials were grown with B in proportion to the wall"
        if mark == SIMULATED
        else "least squares on the means of vines",
    )
    low, high = bounds(power.get("slope_95"))
    yield row_of(
        row="B_power_of_wall",
        quantity="exponent of B against wall thickness",
        ours=number(power.get("slope")),
        low=low,
        high=high,
        beside=f"p = {power['p']:.2g}" if power else "",
    )
    yield row_of(row="B_wall_line_R2", quantity="R² of a straight line", ours=number(line.get("R2")))


def _efficiency_rows(mark: str, scaling: Mapping[str, Any]) -> Iterator[PaperRow]:
    families = [
        family
        for family in scaling.get("efficiency") or ()
        if math.isclose(family["pressure_kPa"], published.EFFICIENCY_KPA, rel_tol=0.02)
        and math.isclose(family["payload_g"], published.PAYLOAD_G, rel_tol=0.02)
    ]
    trends: Mapping[str, Any] = families[0]["trend"] if families else {}
    names = {
        "efficiency": "½ m(x) ẋ² / (P₀ A y)",
        "efficiency_payload": "payload alone",
        "efficiency_with_weight": "with the work of the weight in the denominator",
    }
    printed = {"thickness_um": ("wall", "higher for thinner walls"), "diameter_mm": ("diameter", "no clear trend")}
    for key, words in names.items():
        trend = trends.get(key) or {}
        for size, (name, statement) in printed.items():
            power = trend.get(size) or {}
            low, high = bounds(power.get("power_95"))
            yield PaperRow(
                row=f"{key}_power_of_{name}",
                where="Fig. 9",
                quantity=f"exponent of efficiency against {name}, {words}",
                setting=f"{published.EFFICIENCY_KPA:g} kPa, {published.PAYLOAD_G:g} g, after "
                f"{published.EFFICIENCY_AT_MM:g} mm, N = {trend.get('n', 0)} vines",
                as_printed=statement,
                ours=number(power.get("power")),
                low=low,
                high=high,
                mark=NOT_CHECKABLE if mark == SIMULATED else mark,
                how="values are drawn only, and B of six of the eight vines is not printed"
                if mark == SIMULATED
                else "powers of wall and diameter fitted together on logarithms",
                beside=f"p = {power['p']:.2g}" if power else "",
            )


def _at_pressure(families: Sequence[Mapping[str, Any]], pressure_kPa: float) -> Mapping[str, Any]:
    return next((family for family in families if math.isclose(family["pressure_kPa"], pressure_kPa, rel_tol=0.02)), {})
