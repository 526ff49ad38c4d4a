"""Predictive inputs assembled from stated values, a fit, and printed values or scaling laws."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import Model
from vinetrack.effects import BASE_EFFECTS, Effect
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.planning.predictive_inputs import (
    DAMPING_SPREAD,
    PRESSURE,
    PRESSURE_SPREAD,
    PRINTED_ERROR,
    PRINTED_YIELD_SIGMA_PA,
    SCATTER_DOF,
    SPLIT_SIGMA,
    YIELD,
    YIELD_FACTOR,
    YIELD_PRESSURE_PA,
    Draws,
    FitNumbers,
    PredictiveInputs,
    Sampler,
    Size,
    Uncertainty,
    alike,
    damping_log_sigma,
    damping_prior,
    damping_scatter,
    even,
    exponent_sigma,
    nearest_vine,
    numbers_of,
    relative,
    same_vine,
    scaled,
    shifted,
    split_leverage,
    wanted_model,
    yield_log_sigma,
    yield_place,
)

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit


@dataclass(frozen=True)
class StatedValues:
    """Values stated by the user, which take precedence over all other sources; NaN where none is stated.

    `B_error` is relative, `n_error` absolute, both standard deviations. `effects` are added to those of `model`,
    `sizes` are their parameters where stated; `spreads` are the relative between-trial standard deviations of pressure
    and B.

    Examples
    --------
    >>> StatedValues(n=0.37, n_error=0.01).n
    0.37
    """

    B: float = math.nan
    B_error: float = 0.0
    n: float = math.nan
    n_error: float = 0.0
    model: tuple[str, ...] = BASE_EFFECTS
    effects: tuple[str, ...] = ()
    sizes: Mapping[str, Size] = field(default_factory=dict)
    user_effects: Mapping[str, Effect] = field(default_factory=dict)
    spreads: tuple[float, float] | None = None


class _Sources:
    """Predictive inputs while they are being assembled."""

    def __init__(self, trial: Trial, fit: FitNumbers | None) -> None:
        self.trial = trial if trial.vine else with_names([trial])[0]
        self.fit = fit
        self.values: dict[str, float] = {}
        self.origins: dict[str, str] = {}
        self.uncertainties: list[Uncertainty] = []
        self.notes: list[str] = []
        self.from_fit: dict[str, int] = {}
        """Inputs taken from the fit, and their indices in it."""

    def set(self, name: str, value: float, origin: str) -> None:
        self.values[name], self.origins[name] = value, origin

    def add_uncertainty(self, name: str, words: str, key: str, sample: Sampler) -> None:
        self.uncertainties.append(Uncertainty(name, words, key, sample))


def predictive_inputs(
    trial: Trial, stated: StatedValues | None = None, fit: FitNumbers | Fit | None = None
) -> PredictiveInputs:
    """Assemble the predictive inputs of a trial, each from the first source: stated value, fit, printed value or prior.

    Parameters
    ----------
    trial : the vine and its rig; a yield pressure of NaN is taken from the fit or the printed values.
    stated : values stated by the user.
    fit : a fit, or the numbers of one, whose model is then used.

    Returns
    -------
    PredictiveInputs

    Raises
    ------
    EffectError
        If an effect of the model is unknown.
    FitError
        If the fit is not one of everting vines.

    Examples
    --------
    >>> import vinetrack as vt
    >>> texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "30"}
    >>> trial = vt.planned_trial(texts).trials[0]
    >>> inputs = vt.predictive_inputs(trial, vt.StatedValues(B=6.4, B_error=0.05, n=0.37, n_error=0.01))
    >>> inputs.model.values["eversion_damping.n"]
    0.37
    """
    stated = stated or StatedValues()
    if fit is not None and not isinstance(fit, FitNumbers):
        stated = replace(stated, user_effects={**{effect.name: effect for effect in fit.model}, **stated.user_effects})
        fit = numbers_of(fit)
    sources = _Sources(trial, fit)
    model = wanted_model(fit.model if fit else stated.model, stated.effects, stated.user_effects)
    if fit is not None and DAMPING not in fit.keys:
        raise FitError(f"{fit.source} is not a fit of everting vines: it has no B to predict with.")
    anchor = _fitted_vine(sources)
    _damping(sources, stated, anchor)
    _exponent(sources, stated)
    _yield_pressure(sources, anchor)
    _other_parameters(sources, stated, model, anchor)
    _joint_draw_of_fit(sources)
    spreads = _between_trial(sources, stated)
    values = {name: value for name, value in sources.values.items() if name in model.parameter_names}
    return PredictiveInputs(
        trial=replace(sources.trial, yield_pressure_Pa=sources.values[YIELD]),
        model=model.with_values(values),
        origins=sources.origins,
        uncertainties=tuple(sources.uncertainties),
        spreads=spreads,
        notes=tuple(sources.notes),
    )


def _fitted_vine(sources: _Sources) -> tuple[str, bool]:
    """The vine of the fit on which the prediction is based, and whether it is the same; blank without a fit."""
    if sources.fit is None:
        return "", False
    same = same_vine(sources.fit, sources.trial)
    if same is not None:
        return same, True
    return nearest_vine(sources.fit, sources.trial) or "", False


def _damping(sources: _Sources, stated: StatedValues, anchor: tuple[str, bool]) -> None:
    vine, is_same = anchor
    trial, fit = sources.trial, sources.fit
    if math.isfinite(stated.B):
        sources.set(DAMPING, stated.B, "given")
        if stated.B_error > 0:
            words = f"B is given to {100 * stated.B_error:.2g} % (one standard deviation)"
            sources.add_uncertainty("error of B", words, f"B given|{trial.vine}", scaled(DAMPING, stated.B_error))
        return
    place = fit.place(DAMPING, vine) if fit else None
    if fit is not None and place is not None:
        sources.from_fit[DAMPING] = place
        fitted_B = math.exp(float(fit.mean[place])) if fit.log[place] else float(fit.mean[place])
        if is_same or fit.vines[place] == "":
            sources.set(DAMPING, fitted_B, f"fitted, {fit.source}")
            return
        size = fit.sizes()[vine]
        factor = damping_prior(trial.diameter_m, trial.thickness_m) / damping_prior(*size)
        sources.set(DAMPING, fitted_B * factor, f"scaled from {vine} of {fit.source} as t·D^0.75: a guess")
        sources.notes.append(
            f"no vine of {fit.source} has this diameter and wall: B is carried over from {vine} by the scaling prior, "
            "a guess"
        )
        split = split_leverage(trial.diameter_m, trial.thickness_m) - split_leverage(*size)
    elif (scale := _printed_scale(trial)) is not None:
        sources.set(DAMPING, published.DAMPING_B[scale], f"printed, {published.SOURCE}")
        words = f"the error of the printed B is not printed: assumed to be {100 * PRINTED_ERROR:.0f} %"
        sources.add_uncertainty("error of B", words, f"B printed|{trial.vine}", scaled(DAMPING, PRINTED_ERROR))
        return
    else:
        sources.set(
            DAMPING,
            damping_prior(trial.diameter_m, trial.thickness_m),
            "guess: 6.44 (t/200 µm)(D/24 mm)^0.75",
        )
        split = split_leverage(trial.diameter_m, trial.thickness_m)
    _add_scaling_uncertainty(sources, split)


def _printed_scale(trial: Trial) -> int | None:
    """Scale R of the printed vine of exactly this size; None for other sizes, which use the scaling prior."""
    for scale in published.DAMPING_B:
        size = 1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]
        if alike(size, (trial.diameter_m, trial.thickness_m)):
            return scale
    return None


def _add_scaling_uncertainty(sources: _Sources, split: float) -> None:
    """Uncertainty of the scaling prior of B: scatter of the printed values about it, and exponents of t against D."""
    scatter = damping_log_sigma(sources.trial.diameter_m, sources.trial.thickness_m)
    words = (
        f"the four printed B scatter by {100 * damping_scatter():.0f} % about it: {100 * scatter:.0f} % at this "
        f"size (Student's t, {SCATTER_DOF} degrees of freedom)"
    )
    sources.add_uncertainty(
        "guess of B", words, f"B scatter|{sources.trial.vine}", scaled(DAMPING, scatter, SCATTER_DOF)
    )
    if abs(split) > 1e-9:
        words = (
            f"B is printed for one t/D only: exponents of t and D ±{SPLIT_SIGMA:g} against each other, "
            f"{100 * abs(split) * SPLIT_SIGMA:.0f} % at this t/D"
        )
        sources.add_uncertainty("t against D", words, "B split", scaled(DAMPING, split * SPLIT_SIGMA))


def _exponent(sources: _Sources, stated: StatedValues) -> None:
    if math.isfinite(stated.n):
        sources.set(EXPONENT, stated.n, "given")
        if stated.n_error > 0:
            words = f"n is given to {stated.n_error:.2g} (one standard deviation)"
            sources.add_uncertainty("error of n", words, "n given", shifted(EXPONENT, stated.n_error))
        return
    place = sources.fit.place(EXPONENT) if sources.fit else None
    if sources.fit is not None and place is not None:
        sources.from_fit[EXPONENT] = place
        sources.set(EXPONENT, float(sources.fit.mean[place]), f"fitted, {sources.fit.source}")
        return
    sigma = exponent_sigma()
    sources.set(EXPONENT, published.EXPONENT, f"printed, {published.SOURCE}")
    words = f"±{sigma:.2g}, from the printed R² of the fits"
    sources.add_uncertainty("error of n", words, "n printed", shifted(EXPONENT, sigma))


def _yield_pressure(sources: _Sources, anchor: tuple[str, bool]) -> None:
    vine, is_same = anchor
    trial, fit = sources.trial, sources.fit
    place = yield_place(fit, vine, trial.yield_pressure_Pa) if fit and is_same else None
    if fit is not None and place is not None and _agrees(fit, place, trial):
        sources.from_fit[YIELD] = place
        sources.set(YIELD, float(fit.mean[place]), f"fitted, {fit.source}")
    elif math.isfinite(trial.yield_pressure_Pa):
        sources.set(YIELD, trial.yield_pressure_Pa, "given")
        sigma = trial.yield_pressure_sigma_Pa
        if sigma > 0:
            words = f"stated to {sigma / 1e3:.2g} kPa"
            sources.add_uncertainty("stated P_y", words, f"P_y stated|{trial.vine}", shifted(YIELD, sigma))
    elif _printed_scale(trial) == published.YIELD_PRESSURE_SCALE:
        sources.set(YIELD, YIELD_PRESSURE_PA, f"printed, {published.SOURCE}")
        words = f"printed to a whole number: ±{PRINTED_YIELD_SIGMA_PA / 1e3:.2g} kPa"
        sources.add_uncertainty("printed P_y", words, "P_y printed", shifted(YIELD, PRINTED_YIELD_SIGMA_PA))
    else:
        sources.set(YIELD, YIELD_PRESSURE_PA, "guess: the one that is printed, for another vine")
        words = (
            f"{published.YIELD_PRESSURE_KPA:g} kPa is printed for one vine; nine of ten others within a factor "
            f"{YIELD_FACTOR:g}"
        )
        sources.add_uncertainty("guess of P_y", words, "P_y guess", scaled(YIELD, yield_log_sigma()))


def _agrees(fit: FitNumbers, place: int, trial: Trial) -> bool:
    """Whether the stated yield pressure agrees with the fitted one, within 3 standard errors."""
    stated, sigma = trial.yield_pressure_Pa, trial.yield_pressure_sigma_Pa
    tolerance = 3 * math.hypot(sigma if sigma > 0 else 0.0, math.sqrt(fit.covariance[place, place]))
    return not math.isfinite(stated) or abs(stated - float(fit.mean[place])) <= max(tolerance, 1.0)


def _other_parameters(sources: _Sources, stated: StatedValues, model: Model, anchor: tuple[str, bool]) -> None:
    """Parameters of all other effects: as stated, as fitted, or at their typical size."""
    for effect in model:
        for parameter in effect.parameters:
            name = f"{effect.name}.{parameter.name}"
            if name in sources.values:
                continue
            size = stated.sizes.get(name)
            place = sources.fit.place(name, anchor[0]) if sources.fit else None
            if size is not None:
                sources.set(name, size.middle, "given")
                low, high = parameter.plausible or parameter.bounds
                if size.low < low or size.high > high:
                    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                    sources.notes.append(
                        f"{parameter.symbol} of {effect.name} is outside its plausible range, {low:g} to {high:g}{unit}"
                    )
                if size.high > size.low:
                    words = f"{parameter.symbol} of {effect.name} uniform between {size.low:g} and {size.high:g}"
                    sources.add_uncertainty(f"{parameter.symbol} ({effect.name})", words, name, even(name, size))
            elif sources.fit is not None and place is not None:
                sources.from_fit[name] = place
                sources.set(name, float(sources.fit.mean[place]), f"fitted, {sources.fit.source}")
            else:
                fixed = "constant" if parameter.held else "typical size, without an error"
                sources.set(name, parameter.default, fixed)


def _joint_draw_of_fit(sources: _Sources) -> None:
    """Draw all inputs that the fit provides jointly, with their covariance."""
    fit = sources.fit
    if fit is None or not sources.from_fit:
        return
    names, places = list(sources.from_fit), list(sources.from_fit.values())
    covariance = fit.covariance[np.ix_(places, places)]
    log = fit.log[places]

    def sample(draws: Draws, draw: np.random.Generator) -> Draws:
        size = next(iter(draws.values())).size
        deviations = draw.multivariate_normal(np.zeros(len(places)), covariance, size, method="svd")
        moved = {
            name: draws[name] * np.exp(deviations[:, k]) if log[k] else draws[name] + deviations[:, k]
            for k, name in enumerate(names)
        }
        return {**draws, **moved}

    symbols = {DAMPING: "B", EXPONENT: "n", YIELD: "P_y"}
    shown = ", ".join(symbols.get(name, name) for name in names)
    words = f"{shown} of {fit.source}, with their covariance ({fit.n_trials} trials)"
    sources.uncertainties.insert(0, Uncertainty("fitted numbers", words, "fit", sample))
    if fit.open:
        sources.notes.append(
            f"{fit.source} does not determine {', '.join(fit.open)}: kept at the fitted values, without an error"
        )


def _between_trial(sources: _Sources, stated_values: StatedValues) -> tuple[float, float]:
    """Relative between-trial standard deviations of pressure and B; both become uncertainties."""
    fit, trial = sources.fit, sources.trial
    stated = trial.pressure_sigma_Pa / trial.pressure_Pa if trial.pressure_Pa > 0 else PRESSURE_SPREAD
    pressure = stated if math.isfinite(stated) else PRESSURE_SPREAD
    damping, origin, dof = DAMPING_SPREAD, "assumed:", {"pressure": math.inf, "B": math.inf}
    if fit is not None and fit.spreads:
        pressure, damping = fit.spreads.get("pressure", pressure), fit.spreads.get("B", damping)
        origin, dof = f"estimated in {fit.source}:", {**dof, **fit.spread_dof}
    if stated_values.spreads is not None:
        (pressure, damping), origin, dof = stated_values.spreads, "given:", {"pressure": math.inf, "B": math.inf}
    sources.set(PRESSURE, trial.pressure_Pa, "set")
    if pressure > 0:
        sample = relative(PRESSURE, pressure, dof["pressure"])
        words = f"{origin} {100 * pressure:.2g} %"
        sources.add_uncertainty("P from trial to trial", words, f"P trial|{trial.vine}", sample)
    if damping > 0:
        sample = scaled(DAMPING, damping, dof["B"])
        words = f"{origin} {100 * damping:.2g} %"
        sources.add_uncertainty("B from trial to trial", words, f"B trial|{trial.vine}", sample)
    return pressure, damping
