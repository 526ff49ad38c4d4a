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
from vinetrack.experiment.naming import with_names
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.planning import scaling_priors as guess
from vinetrack.planning.fit_inputs import FitNumbers, alike, nearest_vine, numbers_of, same_vine, yield_place
from vinetrack.planning.predictive_inputs import (
    PRESSURE,
    YIELD,
    Draws,
    Move,
    PredictiveInputs,
    Size,
    Uncertainty,
    even,
    relative,
    scaled,
    shifted,
    wanted_model,
)

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit


@dataclass(frozen=True)
class StatedValues:
    """What a person says of the numbers, in place of any other source; NaN where nothing.

    `B_error` is relative, `n_error` absolute, both standard deviations. `effects` are further effects of the model
    beside `model`, `sizes` their parameters where they are given; `spreads` those of pressure and B from trial to
    trial, relative.

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


class _Making:
    """Predictive inputs while they are put together."""

    def __init__(self, trial: Trial, fit: FitNumbers | None) -> None:
        self.trial = trial if trial.vine else with_names([trial])[0]
        self.fit = fit
        self.values: dict[str, float] = {}
        self.origins: dict[str, str] = {}
        self.uncertainties: list[Uncertainty] = []
        self.notes: list[str] = []
        self.drawn: dict[str, int] = {}
        """Numbers that the fit gives, and where they stand in it."""

    def know(self, name: str, value: float, origin: str) -> None:
        self.values[name], self.origins[name] = value, origin

    def doubt(self, name: str, words: str, key: str, move: Move) -> None:
        self.uncertainties.append(Uncertainty(name, words, key, move))


def predictive_inputs(
    trial: Trial, stated: StatedValues | None = None, fit: FitNumbers | Fit | None = None
) -> PredictiveInputs:
    """Assemble the predictive inputs of a trial, each from its first source: stated values, a fit, printed values.

    Parameters
    ----------
    trial : the vine and its rig; a yield pressure of NaN is taken from the fit or the printed values.
    stated : numbers that a person gives.
    fit : a fit, or the numbers of one; its model is then the model.

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
    making = _Making(trial, fit)
    model = wanted_model(fit.model if fit else stated.model, stated.effects, stated.user_effects)
    if fit is not None and DAMPING not in fit.keys:
        raise FitError(f"{fit.source} is not a fit of everting vines: it has no B to predict with.")
    anchor = _anchor(making)
    _damping(making, stated, anchor)
    _exponent(making, stated)
    _yield_pressure(making, anchor)
    _further(making, stated, model, anchor)
    _from_fit(making)
    spreads = _spreads(making, stated)
    values = {name: value for name, value in making.values.items() if name in model.parameter_names}
    return PredictiveInputs(
        trial=replace(making.trial, yield_pressure_Pa=making.values[YIELD]),
        model=model.with_values(values),
        origins=making.origins,
        uncertainties=tuple(making.uncertainties),
        spreads=spreads,
        notes=tuple(making.notes),
    )


def _anchor(making: _Making) -> tuple[str, bool]:
    """The vine of the fit that this one is taken for, and whether it is the same; blank where there is no fit."""
    if making.fit is None:
        return "", False
    same = same_vine(making.fit, making.trial)
    if same is not None:
        return same, True
    return nearest_vine(making.fit, making.trial) or "", False


def _damping(making: _Making, stated: StatedValues, anchor: tuple[str, bool]) -> None:
    vine, is_same = anchor
    trial, fit = making.trial, making.fit
    if math.isfinite(stated.B):
        making.know(DAMPING, stated.B, "given")
        if stated.B_error > 0:
            words = f"B is given to {100 * stated.B_error:.2g} % (one standard deviation)"
            making.doubt("error of B", words, f"B given|{trial.vine}", scaled(DAMPING, stated.B_error))
        return
    place = fit.place(DAMPING, vine) if fit else None
    if fit is not None and place is not None:
        making.drawn[DAMPING] = place
        fitted_B = math.exp(float(fit.mean[place])) if fit.log[place] else float(fit.mean[place])
        if is_same or fit.vines[place] == "":
            making.know(DAMPING, fitted_B, f"fitted, {fit.source}")
            return
        size = fit.sizes()[vine]
        factor = guess.damping_prior(trial.diameter_m, trial.thickness_m) / guess.damping_prior(*size)
        making.know(DAMPING, fitted_B * factor, f"scaled from {vine} of {fit.source} as t·D^0.75: a guess")
        making.notes.append(
            f"no vine of {fit.source} has this diameter and wall: B is carried over from {vine} by a guess"
        )
        split = guess.split_leverage(trial.diameter_m, trial.thickness_m) - guess.split_leverage(*size)
    elif (scale := _printed_scale(trial)) is not None:
        making.know(DAMPING, published.DAMPING_B[scale], f"printed, {published.SOURCE}")
        words = f"that of the printed B is not printed: taken for {100 * guess.PRINTED_ERROR:.0f} %"
        making.doubt("error of B", words, f"B printed|{trial.vine}", scaled(DAMPING, guess.PRINTED_ERROR))
        return
    else:
        making.know(
            DAMPING,
            guess.damping_prior(trial.diameter_m, trial.thickness_m),
            "guess: 6.44 (t/200 µm)(D/24 mm)^0.75",
        )
        split = guess.split_leverage(trial.diameter_m, trial.thickness_m)
    _doubt_guess(making, split)


def _printed_scale(trial: Trial) -> int | None:
    """Scale R of the printed vine of just this size; a vine of nearly this size is guessed, so that B has no steps."""
    for scale in published.DAMPING_B:
        size = 1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]
        if alike(size, (trial.diameter_m, trial.thickness_m)):
            return scale
    return None


def _doubt_guess(making: _Making, split: float) -> None:
    """Errors of the guessed law of B: the scatter of the printed values about it, and t against D."""
    scatter = guess.damping_log_sigma(making.trial.diameter_m, making.trial.thickness_m)
    words = (
        f"the four printed B scatter by {100 * guess.damping_scatter():.0f} % about it: {100 * scatter:.0f} % at this "
        f"size (Student's t, {guess.SCATTER_DOF} degrees of freedom)"
    )
    making.doubt("guess of B", words, f"B scatter|{making.trial.vine}", scaled(DAMPING, scatter, guess.SCATTER_DOF))
    if abs(split) > 1e-9:
        words = (
            f"t and D apart are not printed: exponents ±{guess.SPLIT_SIGMA:g} against each other, "
            f"{100 * abs(split) * guess.SPLIT_SIGMA:.0f} % at this t/D"
        )
        making.doubt("t against D", words, "B split", scaled(DAMPING, split * guess.SPLIT_SIGMA))


def _exponent(making: _Making, stated: StatedValues) -> None:
    if math.isfinite(stated.n):
        making.know(EXPONENT, stated.n, "given")
        if stated.n_error > 0:
            words = f"n is given to {stated.n_error:.2g} (one standard deviation)"
            making.doubt("error of n", words, "n given", shifted(EXPONENT, stated.n_error))
        return
    place = making.fit.place(EXPONENT) if making.fit else None
    if making.fit is not None and place is not None:
        making.drawn[EXPONENT] = place
        making.know(EXPONENT, float(making.fit.mean[place]), f"fitted, {making.fit.source}")
        return
    sigma = guess.exponent_sigma()
    making.know(EXPONENT, published.EXPONENT, f"printed, {published.SOURCE}")
    words = f"±{sigma:.2g}, from the printed R² of the fits"
    making.doubt("error of n", words, "n printed", shifted(EXPONENT, sigma))


def _yield_pressure(making: _Making, anchor: tuple[str, bool]) -> None:
    vine, is_same = anchor
    trial, fit = making.trial, making.fit
    place = yield_place(fit, vine, trial.yield_pressure_Pa) if fit and is_same else None
    if fit is not None and place is not None and _agrees(fit, place, trial):
        making.drawn[YIELD] = place
        making.know(YIELD, float(fit.mean[place]), f"fitted, {fit.source}")
    elif math.isfinite(trial.yield_pressure_Pa):
        making.know(YIELD, trial.yield_pressure_Pa, "given")
        sigma = trial.yield_pressure_sigma_Pa
        if sigma > 0:
            words = f"stated to {sigma / 1e3:.2g} kPa"
            making.doubt("stated P_y", words, f"P_y stated|{trial.vine}", shifted(YIELD, sigma))
    elif _printed_scale(trial) == published.YIELD_PRESSURE_SCALE:
        making.know(YIELD, guess.YIELD_PRESSURE_PA, f"printed, {published.SOURCE}")
        words = f"printed to a whole number: ±{guess.PRINTED_YIELD_SIGMA_PA / 1e3:.2g} kPa"
        making.doubt("printed P_y", words, "P_y printed", shifted(YIELD, guess.PRINTED_YIELD_SIGMA_PA))
    else:
        making.know(YIELD, guess.YIELD_PRESSURE_PA, "guess: the one that is printed, for another vine")
        words = (
            f"{published.YIELD_PRESSURE_KPA:g} kPa is printed for one vine; nine of ten others within a factor "
            f"{guess.YIELD_FACTOR:g}"
        )
        making.doubt("guess of P_y", words, "P_y guess", scaled(YIELD, guess.yield_log_sigma()))


def _agrees(fit: FitNumbers, place: int, trial: Trial) -> bool:
    """Whether the sheet says nothing else of the yield pressure than the fit found."""
    stated, sigma = trial.yield_pressure_Pa, trial.yield_pressure_sigma_Pa
    room = 3 * math.hypot(sigma if sigma > 0 else 0.0, math.sqrt(fit.covariance[place, place]))
    return not math.isfinite(stated) or abs(stated - float(fit.mean[place])) <= max(room, 1.0)


def _further(making: _Making, stated: StatedValues, model: Model, anchor: tuple[str, bool]) -> None:
    """Parameters of all other effects: as said, as fitted, or at their typical size."""
    for effect in model:
        for parameter in effect.parameters:
            name = f"{effect.name}.{parameter.name}"
            if name in making.values:
                continue
            size = stated.sizes.get(name)
            place = making.fit.place(name, anchor[0]) if making.fit else None
            if size is not None:
                making.know(name, size.middle, "given")
                low, high = parameter.plausible or parameter.bounds
                if size.low < low or size.high > high:
                    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                    making.notes.append(
                        f"{parameter.symbol} of {effect.name} is beyond what is plausible, {low:g} to {high:g}{unit}"
                    )
                if size.high > size.low:
                    words = f"{parameter.symbol} of {effect.name} evenly between {size.low:g} and {size.high:g}"
                    making.doubt(f"{parameter.symbol} ({effect.name})", words, name, even(name, size))
            elif making.fit is not None and place is not None:
                making.drawn[name] = place
                making.know(name, float(making.fit.mean[place]), f"fitted, {making.fit.source}")
            else:
                fixed = "constant" if parameter.held else "typical size, without an error"
                making.know(name, parameter.default, fixed)


def _from_fit(making: _Making) -> None:
    """The numbers that the fit gives, drawn together."""
    fit = making.fit
    if fit is None or not making.drawn:
        return
    names, places = list(making.drawn), list(making.drawn.values())
    covariance = fit.covariance[np.ix_(places, places)]
    log = fit.log[places]

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        size = next(iter(draws.values())).size
        off = draw.multivariate_normal(np.zeros(len(places)), covariance, size, method="svd")
        moved = {
            name: draws[name] * np.exp(off[:, k]) if log[k] else draws[name] + off[:, k] for k, name in enumerate(names)
        }
        return {**draws, **moved}

    symbols = {DAMPING: "B", EXPONENT: "n", YIELD: "P_y"}
    shown = ", ".join(symbols.get(name, name) for name in names)
    words = f"{shown} as {fit.source} knows them, with their covariance ({fit.n_trials} trials)"
    making.uncertainties.insert(0, Uncertainty("fitted numbers", words, "fit", move))
    if fit.open:
        making.notes.append(
            f"{fit.source} leaves {', '.join(fit.open)} open: they stand at their values, without an error"
        )


def _spreads(making: _Making, stated_values: StatedValues) -> tuple[float, float]:
    """What differs from one trial to the next: relative spreads of pressure and B."""
    fit, trial = making.fit, making.trial
    stated = trial.pressure_sigma_Pa / trial.pressure_Pa if trial.pressure_Pa > 0 else guess.PRESSURE_SPREAD
    pressure = stated if math.isfinite(stated) else guess.PRESSURE_SPREAD
    damping, origin, dof = guess.DAMPING_SPREAD, "taken for", {"pressure": math.inf, "B": math.inf}
    if fit is not None and fit.spreads:
        pressure, damping = fit.spreads.get("pressure", pressure), fit.spreads.get("B", damping)
        origin, dof = f"found in {fit.source}:", {**dof, **fit.spread_dof}
    if stated_values.spreads is not None:
        (pressure, damping), origin, dof = stated_values.spreads, "given:", {"pressure": math.inf, "B": math.inf}
    making.know(PRESSURE, trial.pressure_Pa, "set")
    if pressure > 0:
        move = relative(PRESSURE, pressure, dof["pressure"])
        making.doubt("P from trial to trial", f"{origin} {100 * pressure:.2g} %", f"P trial|{trial.vine}", move)
    if damping > 0:
        move = scaled(DAMPING, damping, dof["B"])
        making.doubt("B from trial to trial", f"{origin} {100 * damping:.2g} %", f"B trial|{trial.vine}", move)
    return pressure, damping
