"""Prediction of a vine: position, speed and tension along its growth, with the uncertainty of its inputs.

The uncertain inputs are drawn at random (Monte Carlo), and every draw is simulated from release to the end of growth.
Results are medians and 90 % bands. Because growth is monotonic, the quantiles of the time at which a place is passed
are those of the position at a time.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import brentq

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.core.units import AMBIENT_PRESSURE_PA, display_unit
from vinetrack.dynamics.audit import DOUBTFUL_COMPRESSION, AuditedMotion, audit, evaluate
from vinetrack.dynamics.model import Model, host_for
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.effects import EffectError, catalogue
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit_result import DAMPING, EXPONENT
from vinetrack.planning.predictive_inputs import (
    BAND,
    BURST_STRESS_PA,
    YIELD,
    Band,
    FitNumbers,
    PredictiveInputs,
    StatedValues,
    hoop_stress_Pa,
    predictive_inputs,
)


def grown(
    model: Model, trials: Sequence[Trial], rows: Floats | None = None, host: Model | None = None
) -> tuple[list[Trajectory], Floats]:
    """Simulate every trial at 400 times of its growth. Returns trajectories, end_s (inf where a vine does not reach its
    end). Shapes: rows (n_trials, n_parameters) → (n_trials,).
    """
    longest_s = 600.0  # Duration of a simulation, s (chosen)
    until_longest = [np.array([0.0, longest_s])] * len(trials)
    ends = simulate_many(model, trials, until_longest, parameters=rows, host=host)
    stop_s = np.array([last.end_time_s if last.status in ("ended", "stalled") else longest_s for last in ends])
    # Just before the end: without payload the speed diverges there, and is 0 after it.
    times = [max(end, 1e-9) * (1 - 1e-9) * np.linspace(0.0, 1.0, 400) for end in stop_s]
    moved = simulate_many(model, trials, times, parameters=rows, host=host)
    return moved, np.where([last.status == "ended" for last in ends], stop_s, math.inf)


def final_speeds(
    model: Model, trials: Sequence[Trial], at_fraction: float, rows: Floats | None = None, host: Model | None = None
) -> Floats:
    """Return the final speed of every trial, m/s: a payload's at the end, else the leading edge's at `at_fraction`; 0
    for a vine that does not grow to its end. Shape (n_trials,).
    """
    moved, end_s = grown(model, trials, rows, host)
    speeds = [
        trial.travel_ratio * m.lead_velocity_m_s[-1]
        if told_by_payload(trial)
        else np.interp(at_fraction * trial.length_m, m.lead_position_m, m.lead_velocity_m_s)
        for trial, m in zip(trials, moved, strict=True)
    ]
    return np.where(np.isfinite(end_s), speeds, 0.0)


def drawn_final_speeds(
    inputs: PredictiveInputs, at_fraction: float, samples: int, seed: int, only: Collection[str] | None = None
) -> Floats:
    """Return the final speed in every draw, m/s, see `final_speeds`. Shape (n_draws,)."""
    trials, rows = inputs.drawn_trials(samples, seed, only)
    return final_speeds(inputs.model, trials, at_fraction, rows)


@dataclass(frozen=True)
class Neglected:
    """An effect that the model leaves out, its typical size, and the median final speed, m/s, with and without it."""

    effect: str
    size: str
    final_m_s: float
    without_m_s: float

    @property
    def change(self) -> float:
        """Relative change of the final speed."""
        return self.final_m_s / self.without_m_s - 1 if self.without_m_s > 0 else math.nan


@dataclass(frozen=True)
class VinePrediction:
    """Prediction of one trial. `curve` has a row for each place along the growth, with 90 % bands. `shares` is
    the uncertainty budget: the band of `final` with one uncertain input each, widest first. `arrives` and `slack` are
    the fractions of draws that reach the end, and whose tail is compressed or slack.
    """

    inputs: PredictiveInputs
    at_fraction: float
    quantities: tuple[Band, ...]
    curve: pd.DataFrame
    shares: tuple[Band, ...]
    arrives: float
    slack: float
    samples: int
    burst_stress_Pa: float = BURST_STRESS_PA

    @property
    def final(self) -> Band:
        """The final speed: of the payload as it leaves, else of the leading edge at `at_fraction`. Where the tail may
        go slack, the payload moves on its own and is not simulated: then that of the leading edge.
        """
        return self[
            "ejection speed of the payload" if told_by_payload(self.inputs.trial) else "speed of the leading edge"
        ]

    def __getitem__(self, name: str) -> Band:
        """Return the quantity of that name; KeyError where there is none."""
        return {quantity.name: quantity for quantity in self.quantities}[name]

    @cached_property
    def hazards(self) -> tuple[Remark, ...]:
        """Warnings about the vine, most serious first: burst, no growth, a compressed or slack tail, and the audit."""
        found: list[Remark] = []
        warned_from = 0.05  # Fraction of draws above which a hazard is reported (chosen)
        inputs, trial = self.inputs, self.inputs.trial
        stress = hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m)
        burst_Pa = self.burst_stress_Pa
        if stress > 0.9 * burst_Pa * (1 + 1e-9):
            highest, guess = (trial.pressure_Pa * burst_Pa / stress, trial.pressure_unit), burst_Pa == BURST_STRESS_PA
            facts = {"MPa": stress / 1e6, "burst_MPa": burst_Pa / 1e6, "highest": highest, "guess": guess}
            found.append(remark("bursts" if stress > burst_Pa else "nearly_bursts", **facts))
        given = trial.pressure_Pa, *np.quantile(inputs.draw(2000, 1)[YIELD], BAND).tolist()
        if given[0] <= given[2]:
            shown = zip(("pressure", "low", "middle", "high"), given, strict=True)
            found.append(remark("below_yield", **{name: (at_Pa, trial.pressure_unit) for name, at_Pa in shown}))
        elif self.arrives < 1 - warned_from:
            found.append(remark("stalls", share=1 - self.arrives))
        if self.slack >= warned_from and trial.tail_slack == "free":
            found.append(remark("goes_slack", share=self.slack))
        elif self.slack >= warned_from:
            tension, has_payload = self["least tension of the tail"], trial.payload_kg > 0
            facts = {"median_N": tension.median, "low_N": tension.low, "has_payload": has_payload}
            found.append(remark("tail_compressed", share=self.slack, **facts))
        # The audit along the median motion, except of the tail, whose compression is told above
        (moved,), _ = grown(inputs.model, [trial])
        keep = moved.lead_position_m <= self.at_fraction * trial.length_m
        motion = AuditedMotion(trial, moved.time_s[keep], moved.lead_position_m[keep], moved.lead_velocity_m_s[keep])
        violations = audit(inputs.model, [motion]).violations
        found += (remark("rule", words=violation.words) for violation in violations if violation.rule != "tension")
        return (*found, *self.inputs.notes)

    @cached_property
    def neglected(self) -> tuple[Neglected, ...]:
        """The final speed at the medians with each universal effect that the model leaves out, largest change first."""
        host, trial = host_for(self.inputs.model), self.inputs.trial
        # Radial strain of a thin-walled closed tube under hoop stress PD/2t and a quarter of it along the tube, ν = ½.
        # 25e6: young's modulus of the film, 10 to 50 MPa (chosen)
        kappa = (1 - 0.5 / 4) * trial.diameter_m / (2 * 25e6 * trial.thickness_m)
        (without,) = final_speeds(self.inputs.model, [trial], self.at_fraction, host=host).tolist()
        neglected_effects = []
        # Effects that every vine has to some extent; the others of the catalogue may be absent.
        universal = ("air_drag", "fold_inertia", "gas_inertia", "inlet_loss", "payload_drag", "reservoir_depletion")
        for name in (*universal, "tail_friction", "wall_stretch"):
            effect = catalogue()[name]
            is_in_model = name in self.inputs.model or any(name in other.replaces for other in self.inputs.model)
            if is_in_model or (name == "payload_drag" and trial.payload_kg == 0):
                continue
            sizes = {p: kappa if name == "wall_stretch" else p.default for p in effect.parameters}
            model = (self.inputs.model + effect).with_values({f"{name}.{p.name}": value for p, value in sizes.items()})
            try:
                (final,) = final_speeds(model, [trial], self.at_fraction, host=host).tolist()
            except EffectError:
                continue
            shown = ((p.symbol, value, *display_unit(p.unit, trial.pressure_unit)) for p, value in sizes.items())
            words = [f"{symbol} = {factor * value:.3g} {unit}".rstrip() for symbol, value, unit, factor in shown]
            neglected_effects.append(Neglected(name, ", ".join(words), final, without))
        return tuple(sorted(neglected_effects, key=lambda effect: -abs(np.nan_to_num(effect.change))))

    @property
    def table(self) -> pd.DataFrame:
        """A row for each quantity, SI."""
        condition = self.inputs.trial.condition
        rows = [(condition, q.name, q.y_over_L, q.median, q.low, q.high, q.unit) for q in self.quantities]
        columns = ["condition", "quantity", "y_over_L", "median", "low_90", "high_90", "unit"]
        return pd.DataFrame(rows, columns=columns)


def told_by_payload(trial: Trial) -> bool:
    """Return whether the final speed is that of a payload, which a slack tail would let move on its own."""
    return trial.payload_kg > 0 and trial.tail_slack != "free"


def predict_vine(
    inputs: PredictiveInputs, *, samples: int = 1000, seed: int = 1, at_fraction: float = 0.95
) -> VinePrediction:
    """Predict a trial by Monte Carlo: medians, 90 % bands, and the contribution of each uncertain input.

    Parameters
    ----------
    inputs : from `predictive_inputs`.
    samples : int
        Number of draws.
    seed : int
        Of the random numbers; the same gives the same numbers.
    at_fraction : float
        y/L at which the final speed without payload is evaluated: in the model it diverges as the moving mass
        vanishes.

    Returns
    -------
    VinePrediction

    Raises
    ------
    EffectError
        If the trial lacks what an effect of the model needs.
    SimulationError
        If a draw cannot be integrated.

    Examples
    --------
    >>> import vinetrack as vt
    >>> trial, _ = vt.tracks_from_frame(vt.example_tracks())[0]
    >>> vt.predict_vine(vt.predictive_inputs(trial), samples=40).arrives
    1.0
    """
    trial, model = inputs.trial, inputs.model
    # y/L of the curves, dense at the start
    along = np.union1d([0.0, 0.0005, 0.001, 0.002, 0.004, 0.007, *np.linspace(0.01, 0.99, 99)], [at_fraction])
    places_m, place = along * trial.length_m, int(np.searchsorted(along, at_fraction))
    trials, rows = inputs.drawn_trials(samples, seed)
    moved, end_s = grown(model, trials, rows)
    # At a place that a draw never reaches the time is inf and the speed 0.
    time_s = np.array([np.interp(places_m, m.lead_position_m, m.time_s, right=math.inf) for m in moved])
    lead_m_s = np.array([np.interp(places_m, m.lead_position_m, m.lead_velocity_m_s, right=0.0) for m in moved])
    # 300: draws whose forces are evaluated, a third of a millisecond each (chosen)
    tension_N, pressure_Pa, least_N, slack = _forces(model, trials[:300], rows, moved, places_m)

    r, stress_Pa = trial.travel_ratio, hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m)
    quantities: list[Band] = []

    def tell(name: str, where: float, values: Floats, unit: str) -> None:
        low, median, high = band(values).tolist()
        quantities.append(Band(name, unit, low, median, high, where))

    if trial.payload_kg > 0:
        if told_by_payload(trial) or not slack.any():
            ejected_m_s = r * np.array([m.lead_velocity_m_s[-1] for m in moved])
            tell("ejection speed of the payload", 1.0, np.where(np.isfinite(end_s), ejected_m_s, 0.0), "m/s")
        tell("time to the end", 1.0, end_s, "s")
    tell("speed of the leading edge", at_fraction, lead_m_s[:, place], "m/s")
    tell("speed of the tail", at_fraction, r * lead_m_s[:, place], "m/s")
    tell("time to get there", at_fraction, time_s[:, place], "s")
    if DAMPING in model.parameter_names:
        # Of (P − P_y)A = B ẋⁿ, without weight or further effects
        B, n = (rows[:, model.parameter_names.index(key)] for key in (DAMPING, EXPONENT))
        force_N = np.array([max(t.pressure_Pa - t.yield_pressure_Pa, 0.0) * t.area_m2 for t in trials])
        with np.errstate(divide="ignore", over="ignore"):
            tell("steady tail speed, Eq. (3)", math.nan, (force_N / B) ** (1 / n), "m/s")
    tell("tension of the tail", at_fraction, tension_N[:, place], "N")
    tell("least tension of the tail", math.nan, least_N, "N")
    tell("hoop stress PD/2t", math.nan, np.array([stress_Pa]), "Pa")

    curve: dict[str, Any] = {"condition": trial.condition, "y_over_L": along, "lead_position_m": places_m}
    for name, unit, drawn in (("time", "s", time_s), ("lead_velocity", "m_s", lead_m_s), ("tension", "N", tension_N)):
        low, median, high = band(drawn)
        curve |= {f"{name}_{unit}": median, f"{name}_low_90_{unit}": low, f"{name}_high_90_{unit}": high}
        curve |= {"tail_velocity_m_s": r * median} if name == "lead_velocity" else {}
    shares = []
    for uncertainty in inputs.uncertainties:
        # 400: draws for the band of one uncertainty alone (derived)
        alone = drawn_final_speeds(inputs, at_fraction, min(samples, 400), seed, [uncertainty.name])
        low, median, high = band(alone).tolist()
        shares.append(Band(uncertainty.name, "m/s", low, median, high, why=uncertainty.why))
    return VinePrediction(
        inputs=inputs,
        at_fraction=at_fraction,
        quantities=tuple(quantities),
        curve=pd.DataFrame(curve | {"pressure_kPa": band(pressure_Pa)[1] / 1e3}),
        shares=tuple(sorted(shares, key=lambda share: share.low - share.high)),
        arrives=float(np.mean(np.isfinite(end_s))),
        slack=float(np.mean(slack)),
        samples=samples,
    )


def _forces(
    model: Model, trials: Sequence[Trial], rows: Floats, moved: Sequence[Trajectory], places_m: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Tension, N, and pressure, Pa, (n_trials, n_places); least tension, N, and whether it is slack, (n_trials,)."""
    of_trials = []
    for trial, row, m in zip(trials, rows.tolist(), moved, strict=False):
        valued = replace(model, values=dict(zip(model.parameter_names, row, strict=True)))
        terms = evaluate(valued, trial, m.time_s, m.lead_position_m, m.lead_velocity_m_s)
        drive_N = trial.pressure_Pa * trial.area_m2 / trial.travel_ratio
        tension_N = np.where(np.abs(terms.tension_N) < 1e-6 * drive_N, 0.0, terms.tension_N)
        moving = (m.lead_position_m <= places_m[-1]) & (m.lead_velocity_m_s > 0)
        least_N = np.min(tension_N[moving]) if moving.any() else math.nan
        pushes = least_N < -DOUBTFUL_COMPRESSION * drive_N
        slack = math.isfinite(m.slack_from_s) if trial.tail_slack == "free" else pushes
        at_places = [np.interp(places_m, m.lead_position_m, y, right=math.nan) for y in (tension_N, terms.pressure_Pa)]
        of_trials.append((*at_places, least_N, slack))
    tension, pressure, least, is_slack = map(np.array, zip(*of_trials, strict=True))
    return tension, pressure, least, is_slack


def band(values: Floats) -> Floats:
    """The 5 %, 50 % and 95 % sample quantiles along the first axis, of values that may be inf. Shape (3, ...)."""
    is_empty = np.isnan(values).all(axis=0)
    quantiles = np.asarray(np.nanquantile(np.where(is_empty, 0.0, values), BAND, axis=0, method="inverted_cdf"))
    return np.where(is_empty, np.nan, quantiles)


# ------------------------------------------------------------------------------
# The fastest vine that can be built from given films, within ranges of diameter and length, burst stress
# and supply.
#
# For a given size a higher pressure always gives a higher speed, so the pressure is the highest that supply and wall
# allow, P = min(P_supply, f · 2tσ/D) with f the allowed fraction of the burst stress σ. Diameter and length are
# optimised by a grid search at the medians of the predictive inputs. How certain the choice of film is follows from
# their distributions: every draw has its own fastest film.


@dataclass(frozen=True)
class Room:
    """Limits of what can be built, SI. `rig` has what all share: payload, angle, chamber, yield pressure."""

    films_m: tuple[float, ...]
    diameter_m: tuple[float, float]
    length_m: tuple[float, float]
    pressure_Pa: float
    rig: Trial
    burst_share: float = 0.9
    burst_stress_Pa: float = BURST_STRESS_PA

    def bearable_Pa(self, diameter_m: float, thickness_m: float) -> float:
        """Return the highest pressure that the wall allows, f · 2tσ/D, Pa."""
        return self.burst_share * self.burst_stress_Pa / hoop_stress_Pa(1.0, diameter_m, thickness_m)

    def trial(self, diameter_m: float, thickness_m: float, length_m: float) -> Trial:
        """Return the trial with a vine of this size at the highest pressure allowed."""
        pressure_Pa = min(self.pressure_Pa, self.bearable_Pa(diameter_m, thickness_m))
        size: dict[str, Any] = {"diameter_m": diameter_m, "thickness_m": thickness_m, "length_m": length_m}
        sized = replace(self.rig, **size, pressure_Pa=pressure_Pa)
        return with_names([sized])[0]


@dataclass(frozen=True)
class Choice:
    """The fastest vine of one film; `limits` are the constraints that are active, `odds` is how often it is fastest.
    `others` has columns diameter, m, and lead speed, m/s, of the fastest vine of every diameter of the first round.
    """

    prediction: VinePrediction
    limits: tuple[str, ...]
    odds: float
    others: Floats


def fastest(
    room: Room,
    stated: StatedValues | None = None,
    fit: FitNumbers | None = None,
    *,
    samples: int = 400,
    seed: int = 1,
    at_fraction: float = 0.95,
) -> tuple[Choice, ...]:
    """Find the fastest vine of every film, fastest first."""
    best = [_best(room, film, stated, fit, at_fraction) for film in room.films_m]
    # Inputs that vines share have the same draws in all.
    drawn = np.array([drawn_final_speeds(inputs, at_fraction, samples, seed) for inputs, _ in best])
    fastest_of_draw = np.argmax(drawn, axis=0)
    choices = []
    for k, (inputs, others) in enumerate(best):
        predicted = predict_vine(inputs, samples=samples, seed=seed, at_fraction=at_fraction)
        predicted = replace(predicted, burst_stress_Pa=room.burst_stress_Pa)
        odds = float(np.mean(fastest_of_draw == k))
        choices.append(Choice(predicted, _limits(room, inputs.trial), odds, others))
    return tuple(sorted(choices, key=lambda choice: -choice.prediction.final.median))


def _best(
    room: Room, film_m: float, stated: StatedValues | None, fit: FitNumbers | None, at_fraction: float
) -> tuple[PredictiveInputs, Floats]:
    """Inputs of the fastest vine of one film, and the highest speed at every diameter of the first round."""
    limits = [room.diameter_m, (max(room.length_m[0], 1e-6), room.length_m[1])]
    spans, rounds = limits, []
    # 17, 9: numbers of diameters and lengths in each round (chosen)
    # 3: rounds of the search, each a finer grid around the optimum of the one before (chosen)
    for _ in range(3):
        axes = [np.unique(np.geomspace(*span, count)) for span, count in zip(spans, (17, 9), strict=True)]
        vine_inputs = [predictive_inputs(room.trial(D, film_m, L), stated, fit) for D in axes[0] for L in axes[1]]
        rows = np.array([inputs.model.parameters_of(inputs.trial) for inputs in vine_inputs])
        trials = [inputs.trial for inputs in vine_inputs]
        speeds = final_speeds(vine_inputs[0].model, trials, at_fraction, rows)
        best = int(np.argmax(speeds))
        highest = speeds.reshape(axes[0].size, axes[1].size).max(axis=1)
        rounds.append((vine_inputs[best], np.column_stack([axes[0], highest])))
        # From the grid value below the optimum to the one above, within the limits.
        spans = [
            (max(low, float(axis[max(k - 1, 0)])), min(high, float(axis[min(k + 1, axis.size - 1)])))
            for axis, k, (low, high) in zip(axes, divmod(best, axes[1].size), limits, strict=True)
        ]
    return rounds[-1][0], rounds[0][1]


def _limits(room: Room, trial: Trial) -> tuple[str, ...]:
    """The constraints that keep a vine from being faster: of its pressure, and bounds of its size."""
    bound_tolerance = 0.005  # Relative distance from a bound below which a vine counts as limited by it (chosen)
    bearable_Pa = room.bearable_Pa(trial.diameter_m, trial.thickness_m)
    limits = ["supply" if room.pressure_Pa <= bearable_Pa else "burst"]
    for name, value, (low, high) in (
        ("diameter", trial.diameter_m, room.diameter_m),
        ("length", trial.length_m, room.length_m),
    ):
        if high > low and value > high * (1 - bound_tolerance):
            limits.append(f"largest {name}")
        elif high > low and value < low * (1 + bound_tolerance):
            limits.append(f"smallest {name}")
    return tuple(limits)


# ------------------------------------------------------------------------------
# Volume of the chamber that keeps the gauge pressure nearly constant while a vine grows.
#
#     (P + P_atm) (V₀/(V₀ + S))^γ = (1 − ε) P + P_atm
#     V₀ = S q/(1 − q) with q = (((1 − ε) P + P_atm)/(P + P_atm))^(1/γ)
#
# with S = A·y the volume filled and ε the allowed loss as a fraction of the gauge pressure. The gas law needs
# *absolute* pressure. γ = 1 is isothermal: growth so slow that the gas stays at room temperature. γ = 1.4 is
# adiabatic: growth too fast for heat exchange.

GAMMAS = {"slow, isothermal (γ = 1)": 1.0, "fast, adiabatic (γ = 1.4)": 1.4}  # Gas laws between which every growth lies


def swept_m3(trial: Trial) -> float:
    """Return the volume of the grown vine, m³."""
    return trial.area_m2 * trial.length_m


def gauge_left(gauge_Pa: float, change: Any, gamma: float = 1.0, ambient_Pa: float = AMBIENT_PRESSURE_PA) -> Any:
    """Fraction of the gauge pressure left after the volume has grown by `change`: P_abs V^γ is constant."""
    return ((gauge_Pa + ambient_Pa) * (1 + change) ** -gamma - ambient_Pa) / gauge_Pa


def gauge_loss(trial: Trial, chamber_m3: Any, gamma: float) -> Any:
    """Return the fraction of the gauge pressure that a closed chamber loses while a vine grows."""
    return 1 - gauge_left(trial.pressure_Pa, swept_m3(trial) / chamber_m3, gamma, trial.ambient_pressure_Pa)


def chamber_for(trial: Trial, loss: float, gamma: float) -> float:
    """Return the volume of the closed chamber, m³, that loses exactly this fraction of its gauge pressure."""
    pressure_Pa, ambient_Pa = trial.pressure_Pa, trial.ambient_pressure_Pa
    q = (((1 - loss) * pressure_Pa + ambient_Pa) / (pressure_Pa + ambient_Pa)) ** (1 / gamma)
    return swept_m3(trial) * q / (1 - q)


def chambers(trial: Trial, loss: float) -> dict[str, float]:
    """Return the volumes of the chambers to compare, m³: the stated one, those that keep the pressure, a wrong one."""
    return {
        **({"asked about": trial.chamber_m3} if math.isfinite(trial.chamber_m3) else {}),
        **{f"needed if {law.split(',')[0]}": chamber_for(trial, loss, gamma) for law, gamma in GAMMAS.items()},
        # Boyle's law with gauge instead of absolute pressure, V₁/V₂ = 1 − ε, gives too small a chamber.
        "by gauge pressure (wrong)": swept_m3(trial) * (1 - loss) / loss,
    }


def supplied_loss(inputs: PredictiveInputs, chamber_m3: float, tau_s: float, gamma: float) -> float:
    """Return the largest fraction of the gauge pressure lost at the medians with a supply of time constant `tau_s`."""
    trial = replace(inputs.trial, chamber_m3=chamber_m3)
    model = _with(inputs.model, "supply_refill", tau=tau_s, gamma=gamma)
    (moved,), _ = grown(model, [trial], host=host_for(inputs.model))
    terms = evaluate(model, trial, moved.time_s, moved.lead_position_m, moved.lead_velocity_m_s)
    return 1 - float(np.min(terms.pressure_Pa)) / trial.pressure_Pa


def supplied_chamber(inputs: PredictiveInputs, loss: float, tau_s: float, gamma: float) -> float:
    """Return the volume, m³, of the chamber that loses just this fraction with such a supply; 0 if none is needed."""

    def excess_loss(log_volume: float) -> float:
        return supplied_loss(inputs, math.exp(log_volume), tau_s, gamma) - loss

    closed = chamber_for(inputs.trial, loss, gamma)
    low, high = math.log(closed / 1e4), math.log(closed * 1.01)
    if excess_loss(low) <= 0:
        return 0.0
    return math.exp(brentq(excess_loss, low, high, xtol=1e-3))


def final_with(inputs: PredictiveInputs, chamber_m3: float, gamma: float, at_fraction: float) -> float:
    """Return the final speed at the medians with a closed chamber of this volume, m/s; see `VinePrediction.final`."""
    model = _with(inputs.model, "reservoir_depletion", gamma=gamma)
    trial = replace(inputs.trial, chamber_m3=chamber_m3)
    return float(final_speeds(model, [trial], at_fraction, host=host_for(inputs.model))[0])


def _with(model: Model, name: str, **values: float) -> Model:
    """The model with this effect in place of any other effect of the chamber."""
    for other in ("reservoir_depletion", "supply_refill"):
        model = model - other if other in model else model
    return (model + catalogue()[name]).with_values({f"{name}.{key}": value for key, value in values.items()})
