"""What is asked of one campaign, and the answer as one flat row: the package under test, and two baselines."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path

import vinetrack as vt
from hidden.campaigns import Hidden, Truth, make
from hidden.kinds import MEASUREMENT
from vinetrack.effects import Effect, EffectError, catalogue, load_effect
from vinetrack.inference.fit import FitError
from vinetrack.inference.fit_result import Fit, Number

Row = dict[str, object]
TIED = 9.0
"""Δχ² within which the data do not decide between two hypotheses, each fitted alone."""

OUTSIDERS = Path(__file__).with_name("outsiders")


@lru_cache
def true_effects(names: tuple[str, ...], outsider: str) -> tuple[Effect, ...]:
    """What is hidden, as effects of the package."""
    own = (load_effect(OUTSIDERS / f"{outsider}.py"),) if outsider else ()
    return (*(catalogue()[name] for name in names), *own)


def outsider_values(truth: Truth) -> dict[str, float]:
    """True parameters of an outsider, by the names of its file."""
    f = truth.physics
    values = {
        "rough_patch": {"F": f.patch_F, "place": f.patch_y, "width": f.patch_width},
        "ripple": {"F": f.ripple_F, "length": f.ripple_length, "phase": f.ripple_phase},
        "cubic": {"c": f.cubic},
        "beyond_a_speed": {"c": f.beyond, "speed": f.beyond_speed},
        "growing_friction": {"rate": f.growing_F / f.growing_s},
        "changed_film": {"delta": f.step_B, "place": f.step_y},
        "slip": {"F": f.slip_F, "travel": f.slip_x, "speed": f.slip_speed},
        "chirp": {"F": f.chirp_F, "length": f.chirp_length, "phase": f.chirp_phase},
        "squeeze": {"F": f.squeeze_F, "pressure": f.squeeze_Pa, "place": f.squeeze_y, "width": f.squeeze_width},
    }
    return {f"{truth.outsider}.{name}": value for name, value in values.get(truth.outsider, {}).items()}


def true_fit(base: Fit, truth: Truth, leave_out: str = "") -> Fit:
    """The base model with what is hidden, fitted from the true sizes; without `leave_out` of it."""
    names = tuple(name for name in truth.effects if name != leave_out)
    model = base.model
    for effect in true_effects(names, truth.outsider):
        model = model + effect
    values = {**truth.values, **outsider_values(truth)}
    start = {key: value for key, value in values.items() if key in model.parameter_names}
    # What shapes an outsider is known to the one who hid it: only its size is fitted.
    fixed = [*base.options["fixed"], *list(outsider_values(truth))[1:]]
    try:
        return vt.refit(base, model, start=start, fixed=fixed)
    except FitError:
        # What the base model has bent to do without it may stop a vine that grew: then from the true B and n.
        damping = {"eversion_damping.B": dict(truth.B), "eversion_damping.n": truth.n}
        return vt.refit(base, model, start={**start, **damping}, fixed=fixed, afresh=True)


def sigmas(better: Fit, worse: Fit) -> float:
    """√(2 Δ ln L), negative where the better one is worse."""
    gain = 2 * (better.log_likelihood - worse.log_likelihood)
    return math.copysign(math.sqrt(abs(gain)), gain)


def _spent(begun: float, work: float) -> Row:
    """Seconds by the clock, and of processors, since then: on a busy machine they differ."""
    return {"seconds": time.perf_counter() - begun, "processor_s": time.process_time() - work}


def identity(campaign: Hidden) -> Row:
    """What a campaign is."""
    truth = campaign.truth
    hidden = "+".join(truth.effects) or truth.outsider or ("dropped_frames" if truth.dropped_frames else "")
    return {
        "kind": campaign.kind,
        "seed": campaign.seed,
        "hidden": "" if truth.in_trace else hidden,
        "is_outsider": bool(truth.outsider),
        "n_trials": len(campaign.pairs),
        "n_vines": len({trial.vine for trial, _ in campaign.pairs}),
        "noise": truth.nuisances.noise,
        "B_scatter": truth.nuisances.damping_scatter,
        "P_scatter": truth.nuisances.pressure_scatter,
    }


def ask_vinetrack(kind: str, seed: int) -> Row:
    """`vt.diagnose` on one campaign: verdict, effects, answer set, seconds, sizes; and how visible the truth was."""
    campaign = make(kind, seed)
    row = {"method": "vinetrack", **identity(campaign)}
    begun, work = time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = vt.diagnose(list(campaign.pairs), ladder=False, advice=False)
        row |= _spent(begun, work)
        row |= {
            "verdict": said.verdict,
            "effects": "+".join(said.effects),
            "answer": "|".join(said.answer_set),
            "final": said.final_verdict,
            "final_answer": "|".join(said.rounds[-1].answer_set),
            "rounds": len(said.rounds),
        }
        row |= _visibility(said.fits[0], said.fits[-1], campaign.truth)
    best = max((c.delta_chi2 for c in said.rounds[0].ranking if c.status == "refitted"), default=0.0)
    best = max(best, 2 * (said.fits[-1].log_likelihood - said.fits[0].log_likelihood))
    left = max(_number(row["sigma"]) ** 2 - best, 0.0)
    row["sigma_left"] = math.sqrt(left) if math.isfinite(left) else math.nan
    numbers = [number for c in said.rounds[0].ranking if c.status == "refitted" for number in c.numbers]
    if len(campaign.truth.effects) > 1:
        numbers = list(said.fits[-1].numbers)
        # Beside a fault of the measurement the other size is the one stated along with it.
        numbers = next(([*c.numbers, *c.along] for c in said.rounds[-1].ranking if c.along), numbers)
    row["sizes"] = json.dumps(_sizes(numbers, campaign.truth.values))
    return row


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _visibility(base: Fit, last: Fit, truth: Truth) -> Row:
    """`sigma`: all that is hidden against the base model; `sigma_second`: the least of several, given the others."""
    if truth.in_trace or not (truth.effects or truth.outsider):
        return {"sigma": 0.0, "sigma_second": math.nan}
    try:
        true = true_fit(base, truth)
        if set(last.model.names) == set(true.model.names) and last.log_likelihood > true.log_likelihood:
            true = last
    except (FitError, EffectError):
        return {"sigma": math.nan, "sigma_second": math.nan}
    second = math.nan
    if len(truth.effects) > 1:
        second = min(sigmas(true, true_fit(base, truth, name)) for name in truth.effects)
    return {"sigma": sigmas(true, base), "sigma_second": second}


def _sizes(numbers: Iterable[Number], truth: Mapping[str, float]) -> list[tuple[str, float, float, float, float, str]]:
    """Parameter, truth, value and interval of every hidden size that was fitted."""
    return [
        (n.key, truth[n.key], float(n.value), float(n.low), float(n.high), n.method)
        for n in numbers
        if n.key in truth and math.isfinite(n.sigma)
    ]


def ask_bic(kind: str, seed: int, scatter: bool = True) -> Row:
    """Every candidate added alone and refitted; the lowest BIC wins, whatever that means.

    `scatter` lets the fits estimate the scatter of P and B and the correlation of the noise, as the package does;
    without, every trial has its own release and origin and nothing else, and the noise is white.
    """
    campaign = make(kind, seed)
    row = {"method": "bic" if scatter else "bic_plain", **identity(campaign)}
    begun, work = time.perf_counter(), time.process_time()
    plain = {} if scatter else {"spreads": (1e-6, 1e-6), "noise": (_rest_noise_m(campaign), 0.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        base = vt.fit(vt.base_model(), campaign.pairs, **plain)
        points = sum(trial.time_s.size for trial in base.trials)
        scores, chi2 = {"": _bic(base, points)}, {}
        for effect in catalogue().values():
            if effect.kind == "base" or effect.name == "static_yield":
                continue
            try:
                after = vt.refit(base, base.model + effect, hold_variances=not scatter)
            except (FitError, EffectError):
                continue
            scores[effect.name], chi2[effect.name] = _bic(after, points), -2 * after.log_likelihood
    best = min(scores, key=lambda name: scores[name])
    row |= {**_spent(begun, work), "verdict": _named(best), "answer": best, "effects": best}
    tied = [name for name in chi2 if chi2[name] < min(chi2.values()) + TIED]
    return row | {"tied": "|".join(sorted(tied, key=lambda name: chi2[name]))}


def _named(best: str) -> str:
    if not best:
        return "adequate"
    return "artefact" if best in MEASUREMENT else "missing"


def _bic(fit: Fit, points: int) -> float:
    return len(fit.numbers) * math.log(points) - 2 * fit.log_likelihood


def _rest_noise_m(campaign: Hidden) -> float:
    """What somebody in a hurry would take for the noise: the median of the tracks' own."""
    from statistics import median

    from vinetrack.tracks.position_noise import position_noise

    return median(position_noise(track.time_s, track.lead_position_m)[0] for _, track in campaign.pairs)


def ask_left_out(kind: str, seed: int) -> Row:
    """Error on left-out conditions with everything added that was found, against that of the true model."""
    from vinetrack.diagnosis.ladder import ladder

    campaign = make(kind, seed)
    row = {"method": "left_out", **identity(campaign)}
    begun, work = time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = vt.diagnose(list(campaign.pairs), advice=False)
        row |= {**_spent(begun, work), "verdict": said.verdict, "effects": "+".join(said.effects)}
        if set(said.effects) and said.ladder is not None and not campaign.truth.in_trace:
            errors = said.ladder["rms_left_out_m"]
            true = ladder((said.fits[0], true_fit(said.fits[0], campaign.truth)), ("", "truth"))["rms_left_out_m"]
            row |= {
                "left_out_before": float(errors.iloc[0] / true.iloc[-1]),
                "left_out_after": float(errors.iloc[-1] / true.iloc[-1]),
            }
    return row


def ask_bic_plain(kind: str, seed: int) -> Row:
    """See `ask_bic`."""
    return ask_bic(kind, seed, scatter=False)


METHODS = {"vinetrack": ask_vinetrack, "left_out": ask_left_out, "bic": ask_bic, "bic_plain": ask_bic_plain}
