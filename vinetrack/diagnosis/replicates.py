"""Alignment of the replicates of one condition, their scatter (the replicate floor), and the residuals of a model.

Every trial has its own release, and its own origin where no standstill was filmed, not even imprecisely; a model may
shift the same two. They are found by Gauss–Newton steps towards the mean of all replicates until they have converged.
No model enters, so that the same recordings have the same scatter whatever model they are compared with: the floor
below which no model can fall.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Track, Trial, plain_track, with_flag
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.result import ADEQUATE, ARTEFACT, DROPPED_FRAMES, UNEXPLAINED, Diagnosis, Round
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit import FEWEST_AT_REST, aligned_to_trials, rest_is_seen, scaled_least_squares
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs
from vinetrack.inference.fit_result import DAMPING, Fit, TrialFit
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE, Predictor, middle_speed
from vinetrack.tracks.frame_timing import correct_frames, frames_surely_missing
from vinetrack.tracks.position_noise import FEWEST_POINTS, local_fit, rest_points, rough_noise

# ------------------------------------------------------------------------------
# Outlying trials: a row of the sheet that belongs to another recording, or a typing error.
#
# One such trial among thirty causes a misfit that no effect explains, and the verdict is `unexplained`. Outliers are
# detected without the model that failed: over the middle of the growth damping roughly balances the force,
#
#     ln F_j = ln B_vine + n ln v_j + c (ln v_j)²,    F = (P − P_y) A + r m̄ g cos θ
#
# with a curvature c for a force of another power of speed. The residual of a trial from a robust fit of these curves is
# compared with the residuals of the others. An effect that the model lacks changes all trials of a condition alike; a
# pressure with its digits swapped does not.

Indices = NDArray[np.int_]


CHANCE = 1e-4  # Probability that normal scatter makes any trial of a campaign an outlier (chosen)


FEWEST_TRIALS = 8  # Number of trials from which outliers are looked for (chosen)


@dataclass(frozen=True)
class OddTrial:
    """An outlying trial, with its stated pressure and the pressure that its motion implies, Pa. `implied_pressure_Pa`
    is NaN where it is not known.
    """

    name: str
    stated_Pa: float
    implied_pressure_Pa: float


def odd_trials(data: Sequence[FitTrial]) -> list[OddTrial]:
    """Find trials whose speed contradicts the sheet although the other trials agree with it."""
    trials = [trial_data.trial for trial_data in data]
    if len(data) < FEWEST_TRIALS or any(trial.travel_ratio != 2 for trial in trials):
        return []
    speed = np.array([middle_speed(trial_data) for trial_data in data])
    stated = [_stated_Pa(trial_data) for trial_data in data]
    force = np.array([_force_N(trial, pressure_Pa) for trial, pressure_Pa in zip(trials, stated, strict=True)])
    driven = force > 0
    if np.count_nonzero(driven) < FEWEST_TRIALS:
        return []
    names = [trial.vine for trial in trials]
    vines, vine_index = np.unique(
        [name for name, is_driven in zip(names, driven, strict=True) if is_driven], return_inverse=True
    )
    # 2: slope and curvature of the fitted curves, common to all vines, besides a level for each vine (derived)
    remaining = int(np.count_nonzero(driven)) - vines.size - 2
    if remaining < 1:
        return []
    curves = _fit_curves(np.log(force[driven]), np.log(speed[driven]), vine_index)
    index_of = {vine: k for k, vine in enumerate(vines)}
    residual = np.full(len(data), -np.inf)
    residual[driven] = np.log(force[driven]) - curves(np.log(speed[driven]), vine_index)
    # Fitted curves follow the trials: the scatter about them is smaller by the degrees of freedom that they take.
    median_deviation = float(np.median(np.abs(residual[driven]))) / 0.6745
    # 0.02: lower limit of the scatter of ln F: the scatter of careful trials (chosen)
    scatter = max(median_deviation * math.sqrt(np.count_nonzero(driven) / remaining), 0.02)
    allowed = _limit(len(data), remaining) * scatter
    replicates = [[j for j, other in enumerate(trials) if other.condition == trial.condition and j != k]
             for k, trial in enumerate(trials)]  # fmt: skip
    # Where a replicate deviates as much, the cause is physics of the condition.
    odd = [
        k
        for k in np.flatnonzero(np.abs(residual) > allowed).tolist()
        if all(abs(residual[j]) < allowed < abs(residual[k] - residual[j]) for j in replicates[k])
    ]
    # 0.125: the largest fraction that may be outliers (chosen)
    if len(odd) > max(2, int(0.125 * len(data))):
        return []
    expected = {
        k: float(curves(np.log(speed[k]), index_of[names[k]])) if names[k] in index_of else math.nan for k in odd
    }
    return [OddTrial(trials[k].name, stated[k], _implied_pressure_Pa(trials[k], math.exp(expected[k]))) for k in odd]


def _limit(count: int, remaining: int) -> float:
    """Residual, in standard deviations, beyond which one of so many trials is an outlier (Bonferroni). `remaining` are
    the degrees of freedom that the fitted curves leave to the residuals.
    """
    from scipy.stats import t

    # 0.37, 1.0: efficiency of a standard deviation from the median absolute deviation, relative to that from the
    # mean square, and degrees of freedom added to so many times those that the fitted curves leave (derived)
    return float(t.isf(CHANCE / (2 * count), max(0.37 * remaining + 1.0, 3.0)))


def _stated_Pa(trial_data: FitTrial) -> float:
    """Pressure of the row, or the median of the recorded pressure."""
    return trial_data.trial.pressure_Pa if trial_data.trace is None else float(np.median(trial_data.trace[1]))


def _force_N(trial: Trial, pressure_Pa: float) -> float:
    """Twice the driving force on the tip: pressure above the yield pressure, and weight; as in `kinematics.force`."""
    return (pressure_Pa - float(np.nan_to_num(trial.yield_pressure_Pa))) * trial.area_m2 + _weight_N(trial)


def _weight_N(trial: Trial) -> float:
    middle_m = np.array([0.25 * np.nan_to_num(trial.length_m)])
    mass_kg = float(np.nan_to_num(trial.moving_mass_kg(middle_m))[0])
    return trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)


def _implied_pressure_Pa(trial: Trial, force_N: float) -> float:
    """Pressure at which this force would act."""
    return (force_N - _weight_N(trial)) / trial.area_m2 + float(np.nan_to_num(trial.yield_pressure_Pa))


def _fit_curves(log_force: Floats, log_speed: Floats, vine_index: Indices) -> Callable[[Floats, Indices | int], Floats]:
    """Fit ln F against ln v robustly (Cauchy loss): a level for each vine, a slope and a curvature common to all."""
    from scipy.optimize import least_squares

    usual_exponent = 0.37  # Starting value of the exponent (PHYSICS)
    n_vines, middle = int(vine_index.max()) + 1, float(np.median(log_speed))

    def curve(values: Floats, log_v: Floats, vine: Indices | int) -> Floats:
        return np.asarray(values[vine] + values[-2] * (log_v - middle) + values[-1] * (log_v - middle) ** 2)

    straight = log_force - usual_exponent * (log_speed - middle)
    levels = [float(np.median(straight[vine_index == vine])) for vine in range(n_vines)]
    # 0.05: residual of ln F at which the robust fit halves the weight of a trial (chosen)
    fit = least_squares(
        lambda values: log_force - curve(values, log_speed, vine_index),
        [*levels, usual_exponent, 0.0],
        loss="cauchy",
        f_scale=0.05,
    )
    return partial(curve, fit.x)


def with_odd_trials(result: Diagnosis, odd: Sequence[OddTrial], without: Callable[[list[str]], Diagnosis]) -> Diagnosis:
    """Add what outlying trials mean for a diagnosis. Where the model is adequate, or the other trials support the same
    effect, they are a note. Where no effect explains all trials but one explains the others, the explanation says so.
    """
    if not odd:
        return result
    noted = replace(result, notes=(*result.notes, remark("odd_trials", odd=odd, count=len(result.fits[0].trials))))
    if result.verdict == ADEQUATE:
        return noted
    try:
        others = without([trial.name for trial in odd])
    except (FitError, SimulationError):
        return noted
    unexplained = UNEXPLAINED in (result.verdict, result.final_verdict)
    if UNEXPLAINED in (others.verdict, others.final_verdict):
        return result if unexplained else noted
    if not unexplained and set(result.answer_set) & set(others.answer_set):
        return noted
    result = replace(result, odd_trials=tuple(trial.name for trial in odd))
    facts = {"odd": odd, "count": len(result.fits[0].trials), "others": others, "with_them": result.explanation}
    words = str(Remark("odd_trials_decide", {**facts, "withdrawn": not unexplained}))
    return replace(result, explanation=words) if unexplained else _withdrawn(result, words)


def _withdrawn(result: Diagnosis, words: str) -> Diagnosis:
    """The diagnosis as `unexplained`, with its effects withdrawn."""
    first = result.rounds[0]
    ranking = tuple(replace(candidate, in_answer_set=False) for candidate in first.ranking)
    withdrawn = replace(
        first, verdict=UNEXPLAINED, answer_set=(), ranking=ranking, explanation=words, fits={}, sets=(), partial=()
    )
    return Diagnosis(
        rounds=(replace(withdrawn, partial_fits=()),),
        effects=(),
        explanation=words,
        fits=result.fits[:1],
        notes=result.notes,
        power=result.power,
        odd_trials=result.odd_trials,
    )


# ------------------------------------------------------------------------------
# Recordings with dropped frames: their times are corrected, and dropped frames beyond doubt become the verdict.


@dataclass(frozen=True)
class LostFrames:
    """Trials that may have dropped frames, and those among them that have for certain."""

    trials: tuple[str, ...] = ()
    certain: tuple[str, ...] = ()

    def including(self, trial: str, track: Track) -> LostFrames:
        """Add a trial if its times were corrected for dropped frames."""
        if not with_flag(track.flag, "retimed").any():
            return self
        certain = (trial,) if frames_surely_missing(track) else ()
        return LostFrames((*self.trials, trial), (*self.certain, *certain))


def correct_dropped_frames(pairs: Pairs) -> tuple[list[tuple[Trial, Track]], LostFrames]:
    """Correct the times of tracks with dropped and repeated frames. Returns pairs, dropped."""
    corrected: list[tuple[Trial, Track]] = []
    dropped = LostFrames()
    for trial, track in pairs:
        if trial.video is None and not with_flag(track.flag, "retimed").any():
            track = correct_frames(track)
        dropped = dropped.including(trial.name, track)
        corrected.append((trial, track))
    return corrected, dropped


def dropped_frames_in(fit: Fit) -> LostFrames:
    """Find trials of a fit whose dropped frames were not corrected."""
    dropped = LostFrames()
    for trial_data in fit.predictor.data:
        track = correct_frames(plain_track(trial_data.time_s, trial_data.lead_position_m))
        dropped = dropped.including(trial_data.trial.name, track)
    return dropped


def with_lost_frames(result: Diagnosis, dropped: LostFrames) -> Diagnosis:
    """Put certain dropped frames first in a diagnosis, and its verdict with corrected times into a note. A jump that a
    few outlying points may have caused becomes a note only.
    """
    if not dropped.trials:
        return result
    if not dropped.certain:
        return replace(result, notes=(*result.notes, remark("frames_perhaps_missing", trials=dropped.trials)))
    first = result.rounds[0]
    words = str(remark("frames_missing", trials=dropped.trials))
    artefact = Round(
        model=first.model,
        verdict=ARTEFACT,
        answer_set=(DROPPED_FRAMES,),
        ranking=first.ranking,
        explanation=words,
        cosine_names=first.cosine_names,
        cosines=first.cosines,
        fit=first.fit,
    )
    note = remark("with_corrected_times", verdict=result.verdict, explanation=result.explanation)
    return Diagnosis(
        rounds=(artefact,), effects=(), explanation=words, fits=result.fits[:1], notes=(note,), power=result.power
    )


# ------------------------------------------------------------------------------
# Best-fit value of one parameter for each trial, with all other parameters at their common values.


MAX_DEVIATION_SCALES = 3.0  # Largest deviation from the common value, in scales (chosen)


@dataclass(frozen=True)
class PerTrialEstimates:
    """Estimates of one parameter by trial; arrays of shape (n_trials,), SI, NaN where a trial does not depend on it.
    `value` is the best fit of the trial, `base` the common value, and `deviation` their difference, of logarithms where
    `logarithmic`. `variance` is the variance of `value` from a typical scatter of pressure and B, up to a factor.
    """

    key: str
    symbol: str
    unit: str
    per_vine: bool
    logarithmic: bool
    trials: tuple[Trial, ...]
    value: Floats
    base: Floats
    deviation: Floats
    variance: Floats
    trial_effects: Floats


@dataclass(frozen=True)
class AlignedTrials:
    """A fitted model aligned with its trials: each has its own release and origin, but no deviation of pressure or B.
    `columns` are the sensitivities there, see `vinetrack.inference.sensitivity`.
    """

    predictor: Predictor
    trial_effects: Floats
    columns: tuple[Floats, ...]


def align_trials(fit: Fit) -> AlignedTrials:
    """Align the model with the trials that it was fitted to, by release and origin."""
    predictor, trial_effects, _ = aligned_to_trials(fit, fit.predictor.data, from_rest=True)
    try:
        return AlignedTrials(predictor, trial_effects, tuple(predictor.linearise(np.empty(0), trial_effects)))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error


def per_trial_estimates(fit: Fit, key: str, aligned: AlignedTrials) -> PerTrialEstimates:
    """Fit the value of `key` to each trial by least squares of position, with its release free."""
    predictor, trial_effects = aligned.predictor, aligned.trial_effects
    parameter = {f"{effect.name}.{one.name}": one for effect in fit.model for one in effect.parameters}[key]
    column = fit.model.parameter_names.index(key)
    base = predictor.layout.base[:, column].copy()
    logarithmic = key == DAMPING
    low, high = parameter.plausible or (0.0, 0.0)
    of_parameter = max(float(np.max(np.abs(base - parameter.zero))), 0.1 * (high - low), 1e-12)
    scale = np.full_like(base, 1.0 if logarithmic else of_parameter)
    scaled = np.zeros_like(base)
    projected = [np.zeros(0)] * base.size
    # 5: gauss–Newton steps (chosen)
    for _ in range(5):
        scaled, trial_effects, projected = _gauss_newton_step(
            predictor, trial_effects, column, base, scaled, scale, logarithmic
        )
    response = np.array([float(np.sum(sensitivity**2)) for sensitivity in projected])
    known = response > 1e-12 * np.array(
        [np.ptp(trial_data.lead_position_m) ** 2 * trial_data.time_s.size for trial_data in predictor.data]
    )
    known &= np.abs(scaled) < 0.99 * MAX_DEVIATION_SCALES
    deviation = np.where(known, scaled * scale, np.nan)
    if logarithmic:
        trial_effects[:, DAMPING_DEVIATION] = scaled
    return PerTrialEstimates(
        key=key,
        symbol=parameter.symbol,
        unit=parameter.unit,
        per_vine=any(number.key == key and number.vine for number in fit.numbers),
        logarithmic=logarithmic,
        trials=tuple(trial_data.trial for trial_data in predictor.data),
        value=np.where(known, base * np.exp(scaled) if logarithmic else base + scaled * scale, np.nan),
        base=base,
        deviation=deviation,
        variance=_variance(aligned, projected, scale),
        trial_effects=trial_effects,
    )


def _gauss_newton_step(
    predictor: Predictor,
    trial_effects: Floats,
    column: int,
    base: Floats,
    scaled: Floats,
    scale: Floats,
    logarithmic: bool,
) -> tuple[Floats, Floats, list[Floats]]:
    """One Gauss–Newton step for every trial: scaled deviation, trial effects, and the projected sensitivities. The
    sensitivities of position to the parameter are projected off those to release and origin.
    """
    largest_step = 0.3  # Largest step of ln B, or of a parameter in units of its scale (chosen)
    step = 1e-3
    plain = predictor.jobs(np.empty(0), trial_effects)

    def at(shift: float) -> list[Floats]:
        rows = []
        for i, job in enumerate(plain):
            row = job.row.copy()
            deviation = scaled[i] + shift
            row[column] = base[i] * np.exp(deviation) if logarithmic else base[i] + deviation * scale[i]
            rows.append(row)
        return rows

    jobs = [job._replace(row=row) for shift in (0.0, step) for job, row in zip(plain, at(shift), strict=True)]
    runs = predictor.run(jobs)
    trial_effects, scaled, projected = trial_effects.copy(), scaled.copy(), []
    origin_fixed = rest_is_seen(predictor.data)
    for i, trial_data in enumerate(predictor.data):
        here, stepped = runs[i], runs[i + base.size]
        sensitivity = (stepped.observed_position_m - here.observed_position_m) / step
        others = [-here.lead_velocity_m_s] if origin_fixed[i] else [-here.lead_velocity_m_s, np.ones(sensitivity.size)]
        residual = trial_data.lead_position_m - trial_effects[i, ORIGIN] - here.observed_position_m
        design = np.column_stack([sensitivity, *others])
        best = np.linalg.lstsq(design, residual, rcond=1e-9)[0]
        scaled[i] = np.clip(
            scaled[i] + np.clip(best[0], -largest_step, largest_step), -MAX_DEVIATION_SCALES, MAX_DEVIATION_SCALES
        )
        trial_effects[i, RELEASE] += np.clip(best[1], -2 * trial_data.frame_s, 2 * trial_data.frame_s)
        trial_effects[i, ORIGIN] += 0.0 if origin_fixed[i] else best[2]
        projected.append(orthogonal_part(sensitivity, np.column_stack(others)))
    return scaled, trial_effects, projected


def orthogonal_part(column: Floats, others: Floats) -> Floats:
    """Component of a column that is orthogonal to all linear combinations of others. Shapes: column (n_points,); others
    (n_points, n) → (n_points,).
    """
    return np.asarray(column - others @ np.linalg.lstsq(others, column, rcond=1e-9)[0])


def _variance(aligned: AlignedTrials, projected: list[Floats], scale: Floats) -> Floats:
    """Variance of each trial's value from a typical scatter of pressure and B, and from its noise."""
    origin_fixed = rest_is_seen(aligned.predictor.data)
    variance = np.empty(scale.size)
    for i, (c, sensitivity) in enumerate(zip(aligned.columns, projected, strict=True)):
        square = max(float(np.sum(sensitivity**2)), 1e-300)
        others = c[:, [RELEASE]] if origin_fixed[i] else c[:, [RELEASE, ORIGIN]]
        levers = [float(sensitivity @ orthogonal_part(c[:, k], others)) / square for k in (PRESSURE, DAMPING_DEVIATION)]
        # (0.01, 0.03): typical standard deviations of pressure and ln B between trials (chosen)
        scatter = sum((sd * lever) ** 2 for sd, lever in zip((0.01, 0.03), levers, strict=True))
        noise = aligned.predictor.data[i].mean_noise_m ** 2 / square
        variance[i] = (scatter + noise + 1e-12) * scale[i] ** 2
    return variance


# ------------------------------------------------------------------------------
# Between-trial scatter from replicates alone, and the standard error of a condition's mean residual that follows.
#
# Residuals of one trial are correlated from frame to frame: a trial with 3 % more B is late everywhere. Frames are
# therefore not counted as independent. Every trial is cut into a few stretches, and the covariance of the stretch
# means between replicates has three parameters for all conditions: the scatter of pressure and of B, propagated by
# the sensitivities of the trajectories, and a residual scatter that is independent between stretches. They are
# estimated from differences between replicates alone, so that a model that fails does not inflate them.


# Lower limits of the standard deviations of pressure and B where both are needed (chosen)
LEAST_BETWEEN_TRIAL_SD = (0.005, 0.015)


@dataclass(frozen=True)
class Stretches:
    """Stretches of the motion that all replicates of a condition cover. `means_m`, shape (n_trials, n), are the mean
    residuals; `sensitivities`, shape (n, 2), their derivatives by pressure and ln B; `noise_m2`, shape (n, n), their
    covariance from the noise of the tracks alone.
    """

    means_m: Floats
    sensitivities: Floats
    noise_m2: Floats


@dataclass(frozen=True)
class Scatter:
    """Between-trial standard deviations of pressure (relative) and ln B, and of a residual, relative to their effect.
    `dof` counts replicates beyond the first of each condition. Where it is 0, the standard deviations of pressure and B
    are those of the fit.
    """

    pressure: float
    damping: float
    residual: float
    dof: int

    @property
    def variances(self) -> Floats:
        """Squares of the three, shape (3,)."""
        return np.array([self.pressure, self.damping, self.residual]) ** 2


def scatter_sensitivities(aligned: AlignedTrials) -> list[Floats]:
    """Sensitivities of positions to pressure and ln B, orthogonal to those to release and origin, of every trial. Where
    growth has ended in the model they would be zero, but the vine may still grow: the last values are kept. Shape
    (n_points, 2).
    """
    origin_fixed = rest_is_seen(aligned.predictor.data)
    sensitivities = []
    for i, columns in enumerate(aligned.columns):
        moving = np.flatnonzero(columns[:, RELEASE] != 0)
        extended = columns.copy()
        if moving.size:
            extended[moving[-1] + 1 :, [RELEASE, PRESSURE, DAMPING_DEVIATION]] = columns[
                moving[-1], [RELEASE, PRESSURE, DAMPING_DEVIATION]
            ]
        others = extended[:, [RELEASE]] if origin_fixed[i] else extended[:, [RELEASE, ORIGIN]]
        sensitivities.append(
            np.column_stack([orthogonal_part(extended[:, k], others) for k in (PRESSURE, DAMPING_DEVIATION)])
        )
    return sensitivities


def find_scatter(fit: Fit, groups: Sequence[Stretches]) -> Scatter:
    """Maximum-likelihood estimate of the between-trial scatter from the differences between replicates."""
    from scipy.optimize import minimize

    start_values = (0.01, 0.03, 0.2)  # Starting values of the search: pressure, ln B, residual scatter (chosen)
    lower_bounds, upper_bounds = (1e-5, 1e-5, 1e-3), (0.2, 0.5, 3.0)  # Bounds of the search (chosen)
    dof = sum(len(group.means_m) - 1 for group in groups)
    if dof < 1:
        spreads = [fit.spreads[name].value if name in fit.spreads else 0.0 for name in ("pressure", "B")]
        return Scatter(spreads[0], spreads[1], start_values[2], 0)
    parts = []
    for group in groups:
        if len(group.means_m) > 1:
            deviations = group.means_m - group.means_m.mean(axis=0)
            parts.append((len(deviations) - 1, deviations.T @ deviations, group))

    def minus_two_log_likelihood(logs: Floats) -> float:
        variances = np.exp(2 * np.clip(logs, np.log(lower_bounds), np.log(upper_bounds)))
        total = 0.0
        for count, square, group in parts:
            covariance = _covariance(group, variances)
            total += count * float(np.linalg.slogdet(covariance)[1])
            total += float(np.trace(np.linalg.solve(covariance, square)))
        return total

    best = minimize(
        minus_two_log_likelihood, np.log(start_values), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01}
    )
    pressure, damping, residual = np.exp(np.clip(best.x, np.log(lower_bounds), np.log(upper_bounds))).tolist()
    return Scatter(pressure, damping, residual, dof)


def stretch_covariance(scatter: Scatter, group: Stretches) -> Floats:
    """Covariance of the means of one trial's stretches, shape (n_stretches, n_stretches), m²."""
    return _covariance(group, scatter.variances)


def _covariance(group: Stretches, variances: Floats) -> Floats:
    shared = (group.sensitivities * variances[:2]) @ group.sensitivities.T
    residual = variances[2] * float(np.trace(shared)) / len(shared)
    # 1e-6: lower limit of the error of a stretch mean, m (chosen)
    return np.asarray(shared + group.noise_m2 + (residual + 1e-6**2) * np.eye(len(shared)))


def replicate_z(mean: Floats, covariance: Floats, trials: int, scatter: Scatter) -> float:
    """Test whether between-trial scatter explains stretch means as large as observed; the p-value as a normal deviate.
    The test statistic is the mean square of the means in units of their standard errors, with the effective degrees of
    freedom of Satterthwaite's approximation, because stretches are correlated. Shapes: mean (n_stretches,); covariance
    (n_stretches, n_stretches).
    """
    from scipy.stats import chi2, norm
    from scipy.stats import f as fisher

    sigma = np.sqrt(np.diag(covariance))
    degrees = mean.size**2 / float(np.sum((covariance / sigma[:, None] / sigma) ** 2))
    square = trials * float(np.mean((mean / sigma) ** 2))
    p = float(fisher.sf(square, degrees, scatter.dof) if scatter.dof else chi2.sf(square * degrees, degrees))
    return float(norm.isf(max(p, 1e-300)))


@dataclass(frozen=True)
class Alignment:
    """Replicates on a common clock. `time_s`, shape (n_times,), is since the mean release; `deviation_m`, shape
    (n_trials, n_times), that of each trial from the mean of all trials present, NaN where it is absent; `present`,
    shape (n_times,), counts the trials present.
    """

    time_s: Floats
    deviation_m: Floats
    present: Floats
    release_s: Floats
    origin_m: Floats
    begin_s: float

    @property
    def variance_m2(self) -> Floats:
        """Unbiased variance of single replicates, shape (n_times,); NaN for one trial alone."""
        square = np.where(np.isfinite(self.deviation_m), self.deviation_m, 0.0) ** 2
        return np.where(self.present > 1, square.sum(axis=0) / np.maximum(self.present - 1, 1), math.nan)

    @property
    def floor_m(self) -> float:
        """Replicate floor: rms deviation of a replicate from the mean of infinitely many; NaN for one trial alone."""
        moving = (self.time_s >= self.begin_s) & (self.present > 1)
        if not moving.any():
            return math.nan
        return float(math.sqrt(np.average(self.variance_m2[moving], weights=self.present[moving])))

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the floor: one for each replicate beyond the first. Deviations vary slowly along the
        whole motion, by pressure and B: a trial counts once, however many its frames.
        """
        return self.release_s.size - 1

    @property
    def floor_sigma_m(self) -> float:
        """Standard error of the floor, m: σ/√(2ν) for a variance of ν degrees of freedom; NaN for one trial alone."""
        return self.floor_m / math.sqrt(2 * self.degrees) if self.degrees > 0 else math.nan


@dataclass(frozen=True)
class _Reference:
    """The smoothed motion of one replicate: the common shape, which cancels from the differences of replicates."""

    since_s: Floats
    growth_m: Floats

    def at(self, since_s: Floats) -> Floats:
        """Growth at times since release; extrapolated linearly beyond the ends."""
        inside = np.interp(since_s, self.since_s, self.growth_m)
        slopes = [self._slope(slice(0, 5)), self._slope(slice(-5, None))]
        before, after = np.minimum(since_s - self.since_s[0], 0.0), np.maximum(since_s - self.since_s[-1], 0.0)
        return np.asarray(inside + slopes[0] * before + slopes[1] * after)

    def _slope(self, part: slice) -> float:
        t, y = self.since_s[part], self.growth_m[part]
        return float((y[-1] - y[0]) / (t[-1] - t[0]))


def frames_at_rest(trial: TrialFit) -> int:
    """Number of frames before the motion; 0 where the track begins in motion."""
    count = rest_points(trial.lead_position_m)
    return count if count < trial.time_s.size else 0


def align_replicates(trials: Sequence[TrialFit]) -> Alignment:
    """Align the measured motions of one condition in time and position."""
    largest_step_frames = 2.0  # Largest shift of a round, in frames (chosen)
    rests = [frames_at_rest(trial) for trial in trials]
    release_s, origin_m = (np.array(values) for values in zip(*map(_begin, trials, rests), strict=True))
    rest_seen = np.array([n > 0 or trial.imprecise_rest is not None for trial, n in zip(trials, rests, strict=True)])
    longest = int(np.argmax([trial.time_s[-1] - at for trial, at in zip(trials, release_s, strict=True)]))
    reference = _reference(trials[longest], float(release_s[longest]), float(origin_m[longest]))
    for i, trial in enumerate(trials):
        if i != longest and not (rest_seen[i] and rest_seen[longest]):
            release_s[i], origin_m[i] = _coarse_alignment(trial, reference)
    frame_s = np.array([float(np.median(np.diff(trial.time_s))) for trial in trials])
    begin_s = min(trial.time_s[0] - at for trial, at in zip(trials, release_s, strict=True))
    end_s = float(reference.since_s[-1])
    time_s = begin_s + frame_s.min() * np.arange(math.floor((end_s - begin_s) / frame_s.min() + 1e-6) + 1)
    speed_m_s = np.gradient(reference.at(time_s), time_s)
    origin_known = np.array(
        [n >= FEWEST_AT_REST or trial.imprecise_rest is not None for trial, n in zip(trials, rests, strict=True)]
    )
    earliest_s, latest_s = np.array([_release_range(trial, reference) for trial in trials]).T
    # 200: maximum number of rounds, each of which shifts every replicate towards the mean (chosen)
    for _ in range(200):
        deviation_m, present = _deviations(trials, reference, time_s, release_s, origin_m)
        time_shift_s, position_shift_m = _shifts(deviation_m, speed_m_s, origin_known)
        time_shift_s = np.clip(time_shift_s, -largest_step_frames * frame_s, largest_step_frames * frame_s)
        # Only differences of releases are determined: a common shift would drift away from the reference.
        time_shift_s -= time_shift_s.mean()
        shifted_s = release_s + time_shift_s
        shifted_s = np.where(rest_seen, shifted_s, np.clip(shifted_s, earliest_s, latest_s))
        time_shift_s, release_s, origin_m = shifted_s - release_s, shifted_s, origin_m + position_shift_m
        # 1e-3: largest shift of a round, in frames, at which the alignment has converged (chosen)
        if np.all(np.abs(time_shift_s) < 1e-3 * frame_s):
            break
    deviation_m, present = _deviations(trials, reference, time_s, release_s, origin_m)
    motion_begin_s = min(_begin(trial, n)[0] - at for trial, n, at in zip(trials, rests, release_s, strict=True))
    return Alignment(time_s, deviation_m, present.astype(float), release_s, origin_m, motion_begin_s - 1e-9)


def sampled(at_s: Floats, release_s: float, time_s: Floats, values: Floats) -> Floats:
    """Values of the frames nearest to times since release, NaN where none is within half a frame's spacing.
    Interpolation would average the noise of positions away. Shapes: at_s (n,); time_s, values (n_points,) → (n,).
    """
    target_s = at_s + release_s
    k = np.clip(np.searchsorted(time_s, target_s), 1, time_s.size - 1)
    k -= target_s - time_s[k - 1] < time_s[k] - target_s
    spacing = float(np.median(np.diff(time_s)))
    return np.where(np.abs(time_s[k] - target_s) <= 0.51 * spacing, values[k], math.nan)


def _reference(trial: TrialFit, release_s: float, origin_m: float) -> _Reference:
    """A trial's motion, smoothed by a cubic fitted to the neighbours of each point."""
    y = trial.lead_position_m
    if y.size >= FEWEST_POINTS:
        y = y - local_fit(trial.time_s, y, rough_noise(y)).residual_m
    return _Reference(trial.time_s - release_s, y - origin_m)


def _begin(trial: TrialFit, n_rest: int) -> tuple[float, float]:
    """Time, s, and position, m, at which a trial begins to move; its first frame where no standstill was seen."""
    if n_rest == 0 and trial.imprecise_rest is not None:
        return trial.imprecise_rest.release_s, trial.imprecise_rest.origin_m
    return float(trial.time_s[max(n_rest - 1, 0)]), float(np.mean(trial.lead_position_m[: max(n_rest, 1)]))


def _release_range(trial: TrialFit, reference: _Reference) -> tuple[float, float]:
    """Earliest and latest release, s, with which a trial overlaps enough with the reference."""
    first_s, last_s = float(trial.time_s[0]), float(trial.time_s[-1])
    begin_s, end_s = float(reference.since_s[0]), float(reference.since_s[-1])
    # 0.8: fraction of the shorter motion that must overlap with the longer one where no standstill shows when it
    # began (chosen)
    overlap_s = 0.8 * min(last_s - first_s, end_s - begin_s)
    return overlap_s + first_s - end_s, last_s - begin_s - overlap_s


def _coarse_alignment(trial: TrialFit, reference: _Reference) -> tuple[float, float]:
    """Release and origin of a track that begins in motion, where it deviates least from the reference."""
    # 201: number of shifts in time tried for a track that begins in motion (chosen)
    tried_s = np.linspace(*_release_range(trial, reference), 201)
    differences_m = np.array([trial.lead_position_m - reference.at(trial.time_s - at) for at in tried_s])
    best = int(np.argmin(differences_m.std(axis=1)))
    return float(tried_s[best]), float(differences_m[best].mean())


def _deviations(
    trials: Sequence[TrialFit], reference: _Reference, time_s: Floats, release_s: Floats, origin_m: Floats
) -> tuple[Floats, Floats]:
    """Deviation of each trial from the mean at every instant, and the number of trials present. Differences from the
    reference are compared, because frames of different trials are not taken at the same instants.
    """
    difference_m = np.array(
        [
            sampled(
                time_s,
                release_s[i],
                trial.time_s,
                trial.lead_position_m - origin_m[i] - reference.at(trial.time_s - release_s[i]),
            )
            for i, trial in enumerate(trials)
        ]
    )
    present = np.isfinite(difference_m).sum(axis=0)
    return np.where(present > 1, difference_m - mean_of(difference_m, present), math.nan), present


def _shifts(deviation_m: Floats, speed_m_s: Floats, origin_known: Floats) -> tuple[Floats, Floats]:
    """Least-squares shifts of each trial in time, s, and position, m; the latter 0 where its origin is known."""
    shifts = np.zeros((2, len(deviation_m)))
    for i, trial_deviation_m in enumerate(deviation_m):
        use = np.isfinite(trial_deviation_m)
        if np.count_nonzero(use) > 2:
            free = 0.0 if origin_known[i] else 1.0
            design = np.column_stack([-speed_m_s[use], np.full(np.count_nonzero(use), free)])
            # 0.05: smallest scaled singular value with which a shift in time and one in position are both
            # fitted (chosen)
            shifts[:, i] = scaled_least_squares(design, trial_deviation_m[use], 0.05)
    return shifts[0], shifts[1]


def mean_of(values: Floats, present: Floats) -> Floats:
    """Mean over trials of shape (n_trials, n_times) where they are present, NaN where none is. Shapes: values
    (n_trials, n_times); present (n_times,) → (n_times,).
    """
    total = np.where(np.isfinite(values), values, 0.0).sum(axis=0)
    return np.where(present > 0, total / np.maximum(present, 1), math.nan)


@dataclass(frozen=True)
class Replicates:
    """Residuals of the trials of one condition on a common clock; shapes (n_trials, n_times), NaN where absent.
    `time_s`, shape (n_times,), is since release. `residual_m` is measurement minus model; `present`, shape (n_times,),
    counts the trials. `model_m`, shape (n_times,), is the model's growth in the longest trial.
    """

    time_s: Floats
    model_m: Floats
    residual_m: Floats
    present: Floats
    begin_s: float
    variance_m2: Floats
    alignment: Alignment

    @property
    def mean_residual_m(self) -> Floats:
        """Mean of the replicates minus the model, shape (n_times,)."""
        return mean_of(self.residual_m, self.present)


def replicates_of(trials: Sequence[TrialFit]) -> Replicates:
    """Residuals of a model for the trials of one condition on a common clock. Each instant uses the nearest frame of
    each trial, because interpolation would average the noise of positions away.
    """
    longest = max(trials, key=lambda trial: trial.time_s[-1] - trial.release_s)
    frame_s = min(float(np.median(np.diff(trial.time_s))) for trial in trials)
    begin_s = min(trial.time_s[0] - trial.release_s for trial in trials)
    end_s = longest.time_s[-1] - longest.release_s
    time_s = begin_s + frame_s * np.arange(math.floor((end_s - begin_s) / frame_s + 1e-6) + 1)
    model_m = _growth(longest, time_s)
    residuals_m = np.array([sampled(time_s, t.release_s, t.time_s, t.residual_m) for t in trials])
    alignment = align_replicates(trials)
    # The two clocks differ by the mean difference of the releases, which the replicates do not determine.
    shift_s = float(np.mean(alignment.release_s - [trial.release_s for trial in trials]))
    variance_m2 = sampled(time_s, 0.0, alignment.time_s + shift_s, alignment.variance_m2)
    begin_moving_s = min(float(trial.time_s[first_that_counts(trial)]) - trial.release_s for trial in trials)
    present = np.isfinite(residuals_m).sum(axis=0).astype(float)
    return Replicates(time_s, model_m, residuals_m, present, begin_moving_s - 1e-9, variance_m2, alignment)


def first_that_counts(trial: TrialFit) -> int:
    """Index of the frame where model or measurement begins to move: a standstill would only dilute an error."""
    released = int(np.searchsorted(trial.time_s, trial.release_s))
    # While the pressure is still rising, nothing moves yet.
    moved = np.flatnonzero(trial.predicted_position_m > trial.origin_m)
    released = max(released, int(moved[0]) if moved.size else trial.time_s.size)
    return min(released, max(frames_at_rest(trial) - 1, 0), trial.time_s.size - 1)


def _growth(trial: TrialFit, since_release_s: Floats) -> Floats:
    """The model's growth at times since release; constant beyond the trial's frames."""
    from scipy.interpolate import PchipInterpolator

    t = trial.time_s - trial.release_s
    curve = PchipInterpolator(t, trial.predicted_position_m - trial.origin_m)
    return np.asarray(curve(np.clip(since_release_s, t[0], t[-1])))
