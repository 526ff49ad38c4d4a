"""Motions by Eq. (2) with the printed numbers, departures from its assumptions, and the trials of Figs. 4 and 5.

The departures are a chamber that is not refilled, from slow (isothermal) to fast (adiabatic), a tail that cannot carry
compression, and both. They bound the effect of such a departure, with the printed B, n and P_y, and do not explain what
was measured: neither the rate at which the regulator refills nor the lengths of the vines are printed, and a payload
that has fallen to the tip rests there without pushing it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from vinetrack import effects
from vinetrack.core.records import END_FRACTION, Floats, Trial, plain_track
from vinetrack.core.units import AIR_DENSITY_KG_M3
from vinetrack.dynamics.model import Model, base_model
from vinetrack.dynamics.simulate import Trajectory, simulate, simulate_many
from vinetrack.inference.fit_result import FitSummary, TrialEstimates
from vinetrack.kinematics.damping import fit_damping
from vinetrack.kinematics.steady import paper_force_N, paper_window
from vinetrack.kinematics.summary import lead_velocity_at, mean_with_error
from vinetrack.planning.prediction import gauge_left
from vinetrack.planning.predictive_inputs import PRINTED_EXPONENT, TABLE_I, YIELD_PRESSURE_KPA, damping_prior

# ------------------------------------------------------------------------------
# Published numbers, beside those of Table I and the damping law; those with one use stand where they are used.

CAPTURE_FPS = 1069.0  # Frames a second of the recordings (published)
CHAMBER_L = 3.7  # Volume of the chamber, litres (published)
LONGEST_VINE_MM = 280.0  # Length of the largest vine, 24 mm in diameter (published)
CHAMBER_CHANGE, CHAMBER_ALLOWED = 0.035, 0.05  # Relative change of its volume by the largest vine (published)
PAYLOAD_G = 35.6  # Payload of Figs. 4 and 9 (published)
# RMS position error of the model by pressure in kPa, for the 24 mm × 200 µm vine with payload (Fig. 4, Table II)
POSITION_RMS_CM = {7: 1.90, 14: 0.29, 28: 0.31}
# RMS error of the final speed by pressure in kPa, for 24 mm × 150 µm vines with several payloads (Fig. 5, Table II)
FINAL_SPEED_RMS_M_S = {14: 0.27, 28: 0.56, 41: 1.35}
FINAL_SPEED_AT_MM = 120.0  # Travel at which the final speed of Fig. 5 is evaluated (published)
FINAL_SPEED_THICKNESS_UM = 150.0  # Wall of the vines of Fig. 5 (published)
STEADY_SPEED_KPA, STEADY_SPEED_R2 = 24.0, 0.935  # Steady speed against scale (published)
EFFICIENCY_KPA = 34.0  # Pressure of the energy efficiency with payload, Fig. 9 (published)
# The fastest vine, without payload, at a pressure just below its burst pressure
FAST_VINE = {"thickness_um": 100.0, "diameter_mm": 25.0, "length_mm": 400.0, "pressure_kPa": 62.0}


def scale_of(diameter_mm: float, thickness_um: float) -> int | None:
    """Return the scale R of the vine of Table I with this size, to within 1 %; None for any other."""
    for scale, vine in TABLE_I.items():
        if abs(diameter_mm / vine.diameter_mm - 1) < 0.01 and abs(thickness_um / vine.thickness_um - 1) < 0.01:
            return scale
    return None


def area_m2(diameter_mm: float) -> float:
    """Cross-section πD²/4."""
    return math.pi * (diameter_mm / 1e3) ** 2 / 4


def volume_change(chamber_m3: float, diameter_mm: float, length_mm: float) -> float:
    """Return the volume of a whole vine over that of its chamber."""
    return area_m2(diameter_mm) * length_mm / 1e3 / chamber_m3


LASTS_S = 60.0  # Duration of the simulated motions, s; the slowest, at 7 kPa, takes 7 s by Eq. (2) (chosen)


@dataclass(frozen=True)
class Departure:
    """A departure from Eq. (2): `gamma` of a chamber that is not refilled (None: refilled), and a slack tail."""

    name: str = "eq2"
    gamma: float | None = None
    slack: bool = False

    def model(self, B: float) -> Model:
        """Return Eq. (2) with the printed n and this departure."""
        model = base_model()
        if self.gamma is not None:
            model = (model + effects.reservoir_depletion).with_values({"reservoir_depletion.gamma": self.gamma})
        return model.with_values({"eversion_damping.B": B, "eversion_damping.n": PRINTED_EXPONENT})


DEPARTURES = (
    Departure("depletion_slow", gamma=1.0),  # Chamber not refilled, isothermal
    Departure("depletion_fast", gamma=1.4),  # Chamber not refilled, adiabatic
    Departure("slack", slack=True),  # Tail that cannot push
    Departure("depletion_slow_slack", gamma=1.0, slack=True),
    Departure("depletion_fast_slack", gamma=1.4, slack=True),
)


def paper_trial(
    diameter_mm: float, thickness_um: float, length_mm: float, pressure_kPa: float, payload_g: float = 0.0
) -> Trial:
    """Return a trial of the paper's rig: downwards, 3.7 L, P_y 3 kPa."""
    return Trial(
        name=f"{diameter_mm:g} mm × {thickness_um:g} µm at {pressure_kPa:g} kPa",
        capture_fps=CAPTURE_FPS,
        diameter_m=diameter_mm / 1e3,
        thickness_m=thickness_um / 1e6,
        length_m=length_mm / 1e3,
        pressure_Pa=1e3 * pressure_kPa,
        yield_pressure_Pa=1e3 * YIELD_PRESSURE_KPA,
        payload_kg=payload_g / 1e3,
        chamber_m3=CHAMBER_L / 1e3,
    )


def position_trials() -> list[Trial]:
    """Return the trials of the paper's Fig. 4: the 24 mm × 200 µm vine, as long as the longest, with its payload."""
    size = (TABLE_I[4].diameter_mm, TABLE_I[4].thickness_um, LONGEST_VINE_MM)
    return [paper_trial(*size, pressure_kPa, PAYLOAD_G) for pressure_kPa in POSITION_RMS_CM]


def departure_table(payloads_g: Sequence[float]) -> pd.DataFrame:
    """Compute the differences of each departure from Eq. (2)."""
    rows: list[tuple[object, ...]] = []
    for trial in position_trials():
        plain = follow(trial, Departure(), TABLE_I[4].B)
        for departure in DEPARTURES:
            moved = follow(trial, departure, TABLE_I[4].B)
            rms_m = position_rms_m(plain, moved, trial)
            rows.append(("Fig. 4", trial.pressure_Pa / 1e3, departure.name, rms_m, math.nan, moved.slack_from_s))
    for pressure_kPa in FINAL_SPEED_RMS_M_S:
        size = (TABLE_I[4].diameter_mm, FINAL_SPEED_THICKNESS_UM, LONGEST_VINE_MM)
        trials = [paper_trial(*size, pressure_kPa, payload_g) for payload_g in payloads_g]
        plain_m_s = [final_speed_m_s(trial) for trial in trials]
        for departure in DEPARTURES:
            off = [final_speed_m_s(trial, departure) - plain for trial, plain in zip(trials, plain_m_s, strict=True)]
            rms_m_s = math.sqrt(float(np.mean(np.square(off)))) if off else math.nan
            rows.append(("Fig. 5", float(pressure_kPa), departure.name, math.nan, rms_m_s, math.nan))
    names = ("figure", "pressure_kPa", "departure", "rms_position_m", "rms_final_lead_velocity_m_s", "slack_from_s")
    return pd.DataFrame(rows, columns=list(names))


def follow(trial: Trial, departure: Departure, B: float) -> Trajectory:
    """Simulate the motion at the camera's frames, until it ends or for `LASTS_S`."""
    time_s = np.arange(0, LASTS_S, 1 / CAPTURE_FPS)
    return simulate(departure.model(B), replace(trial, tail_slack="free" if departure.slack else "taut"), time_s)


def position_rms_m(plain: Trajectory, moved: Trajectory, trial: Trial) -> float:
    """Return the root mean square difference of two positions from release until Eq. (2) has grown to 95 %."""
    stop = int(np.searchsorted(plain.lead_position_m, END_FRACTION * trial.length_m))
    return math.sqrt(float(np.mean((moved.lead_position_m[:stop] - plain.lead_position_m[:stop]) ** 2)))


def motion_table() -> pd.DataFrame:
    """Simulate the motions of Fig. 4 by Eq. (2) and with each departure, 200 instants of each."""
    parts = []
    for trial in position_trials():
        for departure in (Departure(), *DEPARTURES):
            moved = follow(trial, departure, TABLE_I[4].B)
            end_s = moved.end_time_s if math.isfinite(moved.end_time_s) else LASTS_S
            time_s = np.linspace(0, end_s, 200)
            motion = {"time_s": time_s, "lead_position_m": np.interp(time_s, moved.time_s, moved.lead_position_m)}
            parts.append(pd.DataFrame({"pressure_kPa": trial.pressure_Pa / 1e3, "departure": departure.name, **motion}))
    return pd.concat(parts, ignore_index=True)


def pressure_table() -> pd.DataFrame:
    """Compute the remaining gauge pressure along the growth of Fig. 4's vine, at 60 places."""
    parts = []
    for trial in position_trials():
        y = np.linspace(0, trial.length_m, 60)
        change = area_m2(1e3 * trial.diameter_m) * y / trial.chamber_m3
        for departure in DEPARTURES[:2]:
            columns = {"pressure_kPa": trial.pressure_Pa / 1e3, "departure": departure.name, "lead_position_m": y}
            left = gauge_left(trial.pressure_Pa, change, departure.gamma or 1.0)
            parts.append(pd.DataFrame(columns | {"gauge_left": left}))
    return pd.concat(parts, ignore_index=True)


# ------------------------------------------------------------------------------
# The fast vine, the example of air drag, and the published rule, by Eq. (2).


def speeds_at(fractions: Sequence[float], case: Mapping[str, float]) -> list[float]:
    """Compute the speed of a vine's leading edge by Eq. (2), B from the scaling prior, at fractions of its length."""
    trial = paper_trial(case["diameter_mm"], case["thickness_um"], case["length_mm"], case["pressure_kPa"])
    model = Departure().model(damping_prior(trial.diameter_m, trial.thickness_m))
    motion = simulate(model, trial, np.linspace(0, 0.05, 50_001))
    return [lead_velocity_at(motion.lead_position_m, motion.lead_velocity_m_s, f * trial.length_m) for f in fractions]


def drag_shares(fractions: Sequence[float]) -> Iterator[tuple[float, float, float]]:
    """Compute the ratio of drag to drive in the paper's example of air drag, by mechanics and as printed. By mechanics
    the air meets the head at ẏ and the pulley halves the force: ¼ρ A C_D ẏ² over ½PA; printed is ½ρ A C_D ẋ². Speeds
    are those of Eq. (2) without drag.
    """
    case = {"thickness_um": 50.0, "diameter_mm": 24.0, "length_mm": 150.0, "pressure_kPa": 56.0}  # as printed
    for fraction, lead in zip(fractions, speeds_at(fractions, case), strict=True):
        share = 0.5 * AIR_DENSITY_KG_M3 * 0.82 * lead**2 / (1e3 * case["pressure_kPa"])  # 0.82: the printed C_D
        yield fraction, share, 8 * share


def rule_on_noise_free(gamma: float | None, trials: Sequence[Trial]) -> tuple[float, dict[int, float]]:
    """Apply the published rule to noise-free motions with the printed B and n; return the n and B it finds."""
    departure = Departure("", gamma=gamma)
    # 10.0: duration of the simulated motions, s (chosen)
    time_s = np.arange(0, 10.0, 1 / CAPTURE_FPS)
    rows = []
    for scale, vine in TABLE_I.items():
        of_scale = [
            replace(trial, chamber_m3=CHAMBER_L / 1e3, yield_pressure_Pa=1e3 * YIELD_PRESSURE_KPA)
            for trial in trials
            if scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m) == scale
        ]
        runs = simulate_many(departure.model(vine.B), of_scale, [time_s] * len(of_scale))
        for trial, moved in zip(of_scale, runs, strict=True):
            growing = moved.time_s < np.nan_to_num(moved.end_time_s, nan=np.inf)
            track = plain_track(moved.time_s[growing], moved.lead_position_m[growing])
            window = paper_window(track, travel_ratio=trial.travel_ratio)
            if window.accepted:
                size = 1e3 * trial.diameter_m, 1e6 * trial.thickness_m
                rows.append((str(scale), *size, window.x_ss_m_s, paper_force_N(trial)))
    points = pd.DataFrame(rows, columns=["vine", "diameter_mm", "thickness_um", "x_ss_m_s", "force_N"])
    law = fit_damping(points, resamples=100)["log_log"]
    return float(law["n"]), {int(vine): float(vine_law["B"]) for vine, vine_law in law["vines"].items()}


# ------------------------------------------------------------------------------
# Comparison of the trials of the paper's Figs. 4 and 5 with Eq. (2) and the printed numbers, by the paper's method.

POSITION_COLUMNS = ("condition", "pressure_kPa", "n_trials", "rms_mean_m", "rms_single_m")
SPEED_COLUMNS = (
    *("condition", "vine", "pressure_kPa", "payload_g", "n_final", "final_at_mm"),
    *("final_lead_velocity_m_s", "final_lead_velocity_sigma_m_s", "eq2_lead_velocity_m_s"),
)


def comparison_tables(
    trials: Sequence[Trial], fit: FitSummary, kinematics_of: Callable[[str], pd.DataFrame]
) -> dict[str, pd.DataFrame]:
    """Compute the tables of the comparison, by file name; `kinematics_of` gives the kinematics of a trial."""
    positions, speeds = position_conditions(trials), speed_conditions(trials)
    known = {name: one for name, one in fit.trials.items() if math.isfinite(one.release_s + one.origin_m)}
    grown = {
        trial.name: since_release(kinematics_of(trial.name), known[trial.name])
        for replicates in (*positions.values(), *speeds.values())
        for trial in replicates
        if trial.name in known
    }
    means, errors = position_tables(positions, grown)
    payloads_g = sorted({round(1e3 * replicates[0].payload_kg, 6) for replicates in speeds.values()})
    return {
        "paper_departures": departure_table(payloads_g),
        "paper_motions": motion_table(),
        "paper_means": means,
        "paper_positions": errors,
        "paper_pressures": pressure_table(),
        "paper_speeds": final_speeds(speeds, grown),
        "paper_speed_curves": speed_curves(speeds),
    }


def since_release(kinematics: pd.DataFrame, estimates: TrialEstimates) -> pd.DataFrame:
    """The kinematics of a trial on the clock of its release, and its positions from where it rested."""
    time_s, position_m = kinematics["time_s"], kinematics["lead_position_m"]
    return kinematics.assign(time_s=time_s - estimates.release_s, lead_position_m=position_m - estimates.origin_m)


def position_conditions(trials: Sequence[Trial]) -> dict[float, list[Trial]]:
    """Trials of Fig. 4, the 24 mm × 200 µm vine with the paper's payload, by pressure in kPa; one condition each."""
    conditions: dict[float, list[Trial]] = {}
    for pressure_kPa in POSITION_RMS_CM:
        alike = [trial for trial in trials if _is(trial, TABLE_I[4].thickness_um, pressure_kPa, PAYLOAD_G)]
        if alike:
            conditions[float(pressure_kPa)] = [trial for trial in alike if trial.condition == alike[0].condition]
    return conditions


def speed_conditions(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Trials of Fig. 5, 24 mm × 150 µm vines at the paper's pressures with any payload, by condition."""
    conditions: dict[str, list[Trial]] = {}
    for pressure_kPa in FINAL_SPEED_RMS_M_S:
        for trial in trials:
            if _is(trial, FINAL_SPEED_THICKNESS_UM, pressure_kPa) and trial.payload_kg > 0:
                conditions.setdefault(trial.condition, []).append(trial)
    return conditions


def _is(trial: Trial, thickness_um: float, pressure_kPa: float, payload_g: float | None = None) -> bool:
    ours = (1e3 * trial.diameter_m, 1e6 * trial.thickness_m, trial.pressure_Pa / 1e3, 1e3 * trial.payload_kg)
    printed = (TABLE_I[4].diameter_mm, thickness_um, pressure_kPa, payload_g)
    return all(two is None or math.isclose(one, two, rel_tol=0.02) for one, two in zip(ours, printed, strict=True))


def _on_common_times(trials: Sequence[Trial], grown: Mapping[str, pd.DataFrame]) -> tuple[Floats, Floats]:
    """Common times since release, shape (n,), and positions from rest, shape (n_trials, n), of those that are known."""
    motions = []
    for trial in trials:
        if trial.name in grown:
            time_s, grown_m = (grown[trial.name][name].to_numpy(float) for name in ("time_s", "lead_position_m"))
            known = np.isfinite(grown_m)
            beyond = np.flatnonzero(known & (grown_m >= END_FRACTION * trial.length_m))
            stop = int(beyond[0]) + 1 if beyond.size else grown_m.size
            motions.append((time_s[:stop][known[:stop]], grown_m[:stop][known[:stop]]))
    if not motions:
        return np.empty(0), np.empty((0, 0))
    end_s = min(float(time_s[-1]) for time_s, _ in motions)
    common_s = np.arange(0, end_s, 1 / CAPTURE_FPS)
    return common_s, np.array([np.interp(common_s, *motion) for motion in motions])


def position_tables(
    conditions: Mapping[float, list[Trial]], grown: Mapping[str, pd.DataFrame]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Average the trials of each pressure since release until the first has grown to 95 %, and compare mean and single
    trials with Eq. (2) and the printed B and n until that has, too (`POSITION_COLUMNS`). The release
    comes from a fit in which each trial has its own pressure and B: with one B it would absorb deviations of speed.
    """
    names = ["pressure_kPa", "time_s", "lead_position_m", "lead_position_sigma_m", "n_trials"]
    parts, errors = [], []
    for pressure_kPa, trials in conditions.items():
        time_s, laid_m = _on_common_times(trials, grown)
        if not len(laid_m):
            continue
        sigma_m = np.std(laid_m, axis=0, ddof=1) if len(laid_m) > 1 else np.full(time_s.size, math.nan)
        columns = (pressure_kPa, time_s, laid_m.mean(axis=0), sigma_m, len(laid_m))
        parts.append(pd.DataFrame(dict(zip(names, columns, strict=True))))
        plain = follow(trials[0], Departure(), TABLE_I[4].B)
        stop = int(np.searchsorted(plain.lead_position_m, END_FRACTION * trials[0].length_m))
        counts = time_s <= plain.time_s[min(stop, plain.time_s.size - 1)]
        off_m = (laid_m - np.interp(time_s, plain.time_s, plain.lead_position_m))[:, counts]
        mean_m, single_m = (math.sqrt(float(np.mean(np.square(part_m)))) for part_m in (off_m.mean(axis=0), off_m))
        errors.append((trials[0].condition, pressure_kPa, len(laid_m), mean_m, single_m))
    means = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=names, dtype=float)
    return means, pd.DataFrame(errors, columns=list(POSITION_COLUMNS))


def final_speeds(conditions: Mapping[str, list[Trial]], grown: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Average the lead speed at the paper's 12 cm, and compute it by Eq. (2); columns `SPEED_COLUMNS`."""
    rows = []
    at_m = FINAL_SPEED_AT_MM / 1e3
    for condition, trials in conditions.items():
        moved = [grown[trial.name] for trial in trials if trial.name in grown]
        speeds = [
            lead_velocity_at(one["lead_position_m"].to_numpy(float), one["lead_velocity_m_s"].to_numpy(float), at_m)
            for one in moved
        ]
        mean, sigma, count = mean_with_error(np.array(speeds, dtype=float))
        if count:
            first = trials[0]
            sizes = (condition, first.vine, first.pressure_Pa / 1e3, 1e3 * first.payload_kg)
            rows.append((*sizes, count, 1e3 * at_m, mean, sigma, final_speed_m_s(first)))
    return pd.DataFrame(rows, columns=list(SPEED_COLUMNS))


def final_speed_m_s(trial: Trial, departure: Departure = Departure()) -> float:
    """Return the speed of the leading edge at the paper's 12 cm by Eq. (2), or with a departure from it; 0 where it
    does not get there. B of Fig. 5's vine is not printed and taken as proportional to the wall.
    """
    B = TABLE_I[4].B * 1e6 * trial.thickness_m / TABLE_I[4].thickness_um
    moved = follow(trial, departure, B)
    speed = lead_velocity_at(moved.lead_position_m, moved.lead_velocity_m_s, FINAL_SPEED_AT_MM / 1e3)
    return speed if math.isfinite(speed) else 0.0


def speed_curves(conditions: Mapping[str, list[Trial]]) -> pd.DataFrame:
    """Compute Eq. (2) at 15 payloads over the range of each pressure, in the columns of `final_speeds`."""
    rows = []
    by_pressure: dict[float, list[Trial]] = {}
    for trials in conditions.values():
        by_pressure.setdefault(trials[0].pressure_Pa, []).append(trials[0])
    for pressure_Pa, trials in by_pressure.items():
        payloads_kg = [trial.payload_kg for trial in trials]
        for payload_kg in np.linspace(min(payloads_kg), max(payloads_kg), 15):
            speed = final_speed_m_s(replace(trials[0], payload_kg=float(payload_kg)))
            rows.append((trials[0].vine, pressure_Pa / 1e3, 1e3 * payload_kg, speed, math.nan))
    names = ["vine", "pressure_kPa", "payload_g", "final_lead_velocity_m_s", "final_lead_velocity_sigma_m_s"]
    return pd.DataFrame(rows, columns=names)
