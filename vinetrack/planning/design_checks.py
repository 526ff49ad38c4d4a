"""Checks of a planned vine: burst, no growth, a compressed or slack tail, and effects that the model leaves out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.audit import TENSION_RULE, AuditedMotion, audit
from vinetrack.dynamics.host import host_for
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import Effect, EffectError, catalogue
from vinetrack.planning.prediction import (
    EJECTION,
    LEAST_TENSION,
    LONGEST_S,
    POINTS,
    VinePrediction,
    follow,
    told_by_payload,
)
from vinetrack.planning.predictive_inputs import BAND, YIELD, PredictiveInputs
from vinetrack.planning.scaling_priors import BURST_STRESS_PA, burst_pressure_Pa, hoop_stress_Pa

LEAST_FULL_GROWTH = 0.95  # Fraction of draws that must grow to the end, or a warning is given (chosen)

WARNING_FRACTION = 0.05  # Fraction of draws above which a hazard is reported (chosen)

FILM_MODULUS_PA = 25e6  # Young's modulus of the film, 10 to 50 MPa (chosen)

# Effects that every vine has to some extent; the others of the catalogue may be absent
UNIVERSAL_EFFECTS = (
    "air_drag",
    "fold_inertia",
    "gas_inertia",
    "inlet_loss",
    "payload_drag",
    "reservoir_depletion",
    "tail_friction",
    "wall_stretch",
)


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


def design_checks(prediction: VinePrediction) -> tuple[str, ...]:
    """Return warnings about a planned vine in sentences, most serious first. Returns empty where there is
    no warning.
    """
    return (
        *_burst(prediction.inputs.trial),
        *_no_growth(prediction),
        *_slack(prediction),
        *_rules(prediction),
        *prediction.inputs.notes,
    )


def _burst(trial: Trial) -> Iterator[str]:
    stress = hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m)
    highest_kPa = burst_pressure_Pa(trial.diameter_m, trial.thickness_m) / 1e3
    shown = f"hoop stress PD/2t is {stress / 1e6:.3g} MPa, film is guessed to burst at {BURST_STRESS_PA / 1e6:g} MPa"
    if stress > BURST_STRESS_PA:
        yield f"the vine would burst: its {shown}, so at {highest_kPa:.3g} kPa; lower the pressure or thicken the wall"
    elif stress > 0.9 * BURST_STRESS_PA:
        yield f"the vine is about to burst: its {shown}, so at {highest_kPa:.3g} kPa (a guess from one vine)"


def _no_growth(prediction: VinePrediction) -> Iterator[str]:
    trial = prediction.inputs.trial
    low, median, high = np.quantile(prediction.inputs.draw(2000, 1)[YIELD], BAND) / 1e3
    if median >= trial.pressure_Pa / 1e3:
        yield (
            f"{trial.pressure_Pa / 1e3:g} kPa lies below the yield pressure, {median:.3g} kPa ({low:.2g} to "
            f"{high:.2g}): nothing would evert; raise the pressure"
        )
    elif prediction.arrives < LEAST_FULL_GROWTH:
        yield (
            f"in {1 - prediction.arrives:.0%} of the draws the vine does not grow to its end; raise the pressure or "
            "measure its yield pressure"
        )


def _slack(prediction: VinePrediction) -> Iterator[str]:
    trial = prediction.inputs.trial
    if prediction.slack < WARNING_FRACTION:
        return
    frequency = "in every draw" if prediction.slack > 0.995 else f"in {prediction.slack:.0%} of the draws"
    if trial.tail_slack == "free":
        yield (
            f"the tail goes slack on the way {frequency}: tail speeds are then those of the film at the tip, and a "
            "payload falls freely, at a speed that is not predicted"
        )
        return
    payload = f", and the {EJECTION} is at least the one stated" if trial.payload_kg > 0 else ""
    yield (
        f"the model predicts compression in the tail {frequency} (least tension {_least_tension(prediction)}), which "
        f"thin film cannot carry: the payload runs ahead of the film{payload}; `--tail-slack free` allows that"
    )


def _least_tension(prediction: VinePrediction) -> str:
    """The median where it is negative; else also the 5 % quantile."""
    tension = prediction[LEAST_TENSION]
    return (
        f"{tension.median:.2g} N"
        if tension.median < 0
        else f"{tension.median:.2g} N, below {tension.low:.2g} N in one draw of twenty"
    )


def _rules(prediction: VinePrediction) -> Iterator[str]:
    """Warnings of the audit along the median motion, except the one about the tail, which `_slack` gives."""
    inputs = prediction.inputs
    (moved,), _ = follow(inputs, *_medians(inputs))
    keep = moved.lead_position_m <= prediction.at_fraction * inputs.trial.length_m
    motion = AuditedMotion(inputs.trial, moved.time_s[keep], moved.lead_position_m[keep], moved.lead_velocity_m_s[keep])
    violations = audit(inputs.model, [motion]).violations
    yield from (violation.words for violation in violations if violation.rule != TENSION_RULE)


def _medians(inputs: PredictiveInputs) -> tuple[list[Trial], Floats]:
    return inputs.laid_out(inputs.draw(1, 0, only=()))


def neglected(inputs: PredictiveInputs, at_fraction: float) -> tuple[Neglected, ...]:
    """Return the final speed at the medians with each of the universal effects added, largest change first. Each is
    added by itself at its typical size; effects whose columns are blank are left out.
    """
    host = host_for(inputs.model)
    without = final_m_s(inputs, inputs.model, host, at_fraction)
    neglected_effects = []
    for name in UNIVERSAL_EFFECTS:
        effect = catalogue()[name]
        is_in_model = name in inputs.model or any(name in other.replaces for other in inputs.model)
        if is_in_model or (name == "payload_drag" and inputs.trial.payload_kg == 0):
            continue
        sizes = typical_sizes(name, inputs.trial)
        model = (inputs.model + effect).with_values(sizes)
        try:
            final = final_m_s(inputs, model, host, at_fraction)
        except EffectError:
            continue
        neglected_effects.append(Neglected(name, _words(effect, sizes), final, without))
    return tuple(sorted(neglected_effects, key=lambda effect: -abs(np.nan_to_num(effect.change))))


def typical_sizes(name: str, trial: Trial) -> dict[str, float]:
    """Return parameters of an effect that follow from the vine: for wall stretch κ = (1 − ν/4) D/(2Et), ν = ½. Source:
    radial strain of a thin-walled closed tube under hoop stress PD/2t and half of it along the tube. Returns by
    `effect.parameter`, SI; empty where the defaults of the effect apply.
    """
    if name != "wall_stretch":
        return {}
    return {"wall_stretch.kappa": (1 - 0.5 / 4) * trial.diameter_m / (2 * FILM_MODULUS_PA * trial.thickness_m)}


def _words(effect: Effect, sizes: Mapping[str, float]) -> str:
    """Parameters of an effect at these or else their typical sizes, such as `C_D = 1`."""
    values = [(p, sizes.get(f"{effect.name}.{p.name}", p.default)) for p in effect.parameters]
    return ", ".join(f"{p.symbol} = {value:.3g}{'' if p.unit == '1' else ' ' + p.unit}" for p, value in values)


def final_m_s(inputs: PredictiveInputs, model: Model, host: Model, at_fraction: float) -> float:
    """Return the final speed at the medians under this model: a payload's at the end, else the leading edge's. Returns
    0 where the vine does not grow to its end.
    """
    (trial,), _ = _medians(inputs)
    (end,) = simulate_many(model, [trial], [np.array([0.0, LONGEST_S])], host=host)
    if end.status != "ended":
        return 0.0
    times = end.end_time_s * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS)
    (moved,) = simulate_many(model, [trial], [times], host=host)
    if told_by_payload(trial):
        return float(trial.travel_ratio * moved.lead_velocity_m_s[-1])
    return float(np.interp(at_fraction * trial.length_m, moved.lead_position_m, moved.lead_velocity_m_s))
