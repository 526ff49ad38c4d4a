"""The further trials that separate hypotheses best, by the expected rise of −2 ln L of the wrong one.

If a is true, new trials show what a predicts. Hypothesis b, refitted to old and new trials, keeps a misfit of

    D² = min over δ, u of  Σ_new |W (y_a − y_b − X δ − Z u)|² + |u/s|² + δᵀ I δ

with X and Z its sensitivities to the free parameters and to the trial effects u of standard deviations s, W the
whitening of the noise, and I the information of the trials so far. √D² is a separation in standard deviations; of a
against b and b against a the smaller counts (T-optimality). It chooses the trials. What they promise is found by
simulating and refitting them, with s estimated anew: a wrong hypothesis may explain part of its misfit as scatter.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import END_FRACTION, Floats, Trial, plain_track
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.experiment.schema import COLUMNS, RIG, with_names
from vinetrack.experiment.settings import Limits
from vinetrack.inference.fit_data import FitError, FitTrial, prepare_trial
from vinetrack.inference.fit_result import DAMPING, EXPONENT, YIELD_PRESSURE, Fit, ParameterMap
from vinetrack.inference.marginal_likelihood import (
    DEVIATION_COLUMNS,
    LEAST_BETWEEN_TRIAL_SD,
    at_unknowns,
    eliminated,
    marginal,
    normal_equations,
    solve_per_trial,
)
from vinetrack.inference.optimiser import FixedTerms, make_problem, solve
from vinetrack.inference.position_errors import smooth_errors
from vinetrack.inference.sensitivity import (
    N_TRIAL_EFFECTS,
    ORIGIN,
    RELEASE,
    Jobs,
    Predictor,
    initial_trial_effects,
)
from vinetrack.planning.predictive_inputs import hoop_stress_Pa, prior_ratio
from vinetrack.tracks.position_noise import ar1_noise

# ------------------------------------------------------------------------------
# Candidate trials for the next experiment: pressures, payloads, vines and rigs within the user's limits.
#
# Where a limit is not given it follows from the experiment: pressures from the lowest used to a quarter above the
# highest and never above the strength of the film; no payload or the heaviest used; half and twice the chamber;
# connectors of half and twice the area; and vines of other diameters and film thicknesses. Only one part of a rig
# changes at a time.

SAME_RIG, OTHER_RIG, NEW_VINE = 0, 1, 2  # Effort of a trial: nothing new (defined)


@dataclass(frozen=True)
class Condition:
    """A trial that could be made. `like` is the index, among the trials of the experiment, of the trial it is modelled
    on: for an existing vine a trial with it, else one with the vine nearest in size.
    """

    trial: Trial
    like: int
    effort: int
    changed: tuple[str, ...] = ()


def feasible_conditions(trials: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Every candidate trial; empty where the limits exclude all."""
    used = [trial for trial in trials if trial.travel_ratio != 1]
    if not used:
        return []
    first = {trial.vine: k for k, trial in reversed(list(enumerate(trials))) if trial.travel_ratio != 1}
    models = [(trials[k], k) for k in sorted(first.values())]
    vines = [(trial, k, SAME_RIG) for trial, k in models if _allowed(trial, limits)]
    if limits.new_vines:
        vines += [(vine, like, NEW_VINE) for vine, like in _new_vines(models, limits)]
    conditions: list[Condition] = []
    for vine, like, effort_of_vine in vines:
        rigs = _rigs(vine, used, limits)
        least = min((effort for effort, _ in rigs), default=SAME_RIG)
        for effort, rig in rigs:
            if effort_of_vine == NEW_VINE and effort > least:
                continue
            for payload in _payloads(used, limits):
                for pressure, sigma in _pressures(rig, payload, used, limits):
                    settings: dict[str, Any] = {"pressure_Pa": pressure, "pressure_sigma_Pa": sigma}
                    name = f"next_{len(conditions) + 1}"
                    trial = replace(rig, name=name, payload_kg=payload, **settings)
                    changed = _changed(trial, trials[like])
                    conditions.append(Condition(trial, like, max(effort, effort_of_vine), changed))
    return conditions


def conditions_by_effort(
    conditions: Sequence[Condition], best_new_vines: Callable[[NDArray[np.intp]], Sequence[str]]
) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield the indices of the conditions to choose from with more and more effort: on the rig so far, with another
    rig as well, and with one new vine at a time as well, of those that `best_new_vines` chooses among their indices.
    """
    efforts = np.array([condition.effort for condition in conditions])
    for effort in (SAME_RIG, OTHER_RIG):
        if (efforts == effort).any():
            yield effort, np.flatnonzero(efforts <= effort)
    new = np.flatnonzero(efforts == NEW_VINE)
    for vine in best_new_vines(new) if new.size else ():
        vines = np.array([condition.trial.vine for condition in conditions])
        yield NEW_VINE, np.flatnonzero((efforts < NEW_VINE) | (vines == vine))


def exchanged(
    design: Sequence[int], best: float, allowed: NDArray[np.intp], worth_with: Callable[[list[int]], Floats]
) -> tuple[list[int], float]:
    """Exchange the trials of a design one at a time until none gains (Fedorov 1972, Theory of Optimal Experiments).
    `best` is its worth; `worth_with`, shape (n_allowed,), gives that of other trials with one of each `allowed` added.
    """
    design = list(design)
    for _ in range(4):
        before = best
        for k in range(len(design)):
            values = worth_with(design[:k] + design[k + 1 :])
            if np.max(values) > (1 + 1e-6) * best:  # a gain, not rounding
                design[k], best = int(allowed[int(np.argmax(values))]), float(np.max(values))
        if best <= before:
            break
    return design, best


def _of(trial: Trial, column: str) -> float:
    """The value of a column, SI."""
    value: float = getattr(trial, COLUMNS[column].field)
    return value


def _stated(limits: Limits, column: str) -> list[float] | None:
    """Values of a column that the user allows, SI; None for any."""
    values = getattr(limits, column)
    return None if values is None else [COLUMNS[column].to_si(value) for value in values]


def _is_among(value: float, values: Iterable[float]) -> bool:
    return any(math.isclose(value, listed, rel_tol=1e-4, abs_tol=1e-12) for listed in values)


def _alike(trial: Trial, other: Trial, columns: Iterable[str] = ("diameter_mm", "thickness_um", "length_mm")) -> bool:
    pairs = [(_of(trial, column), _of(other, column)) for column in columns]
    return all(_is_among(a, [b]) or (math.isnan(a) and math.isnan(b)) for a, b in pairs)


def _changed(rig: Trial, before: Trial) -> tuple[str, ...]:
    return tuple(column for column in RIG if not _alike(rig, before, [column]))


def _allowed(vine: Trial, limits: Limits) -> bool:
    """Whether the user's lists of sizes, where given, contain this vine."""
    columns = ("diameter_mm", "thickness_um", "length_mm")
    sizes = [(_of(vine, column), _stated(limits, column)) for column in columns]
    return all(values is None or math.isnan(size) or _is_among(size, values) for size, values in sizes)


def _rounded(value: float) -> float:
    """The value to two significant digits, as a person would order it."""
    return float(f"{value:.2g}")


def _rigs(vine: Trial, used: Sequence[Trial], limits: Limits) -> list[tuple[int, Trial]]:
    """The vine on every rig; chamber, connector and angle change one at a time unless the limits require more."""
    factors_of = {"chamber_l": (0.5, 2.0), "inlet_mm": (math.sqrt(0.5), math.sqrt(2.0)), "growth_angle_deg": ()}
    rigs: list[tuple[int, int, Trial]] = []
    for parts in itertools.product(*(_choices(vine, used, limits, *part) for part in factors_of.items())):
        changed: dict[str, Any] = {COLUMNS[column].field: part for column, part in zip(factors_of, parts, strict=True)}
        rig = replace(vine, **changed)
        changes = len(_changed(rig, vine))
        if changes == 0 or not rig.inlet_m > vine.diameter_m:
            at_hand = any(_alike(rig, trial, RIG) for trial in used)
            rigs.append((changes, SAME_RIG if at_hand else OTHER_RIG, rig))
    fewest = min((changes for changes, _, _ in rigs), default=0)
    return [(effort, rig) for changes, effort, rig in rigs if changes <= max(1, fewest)]


def _choices(vine: Trial, used: Sequence[Trial], limits: Limits, column: str, factors: Sequence[float]) -> list[float]:
    """Values of one part of the rig: the user's, else those used and multiples of the present one; NaN stays."""
    now, stated = _of(vine, column), _stated(limits, column)
    if math.isnan(now):
        return [now]
    if stated is not None:
        return stated
    values = [
        now,
        *filter(math.isfinite, (_of(trial, column) for trial in used)),
        *(_rounded(now * f) for f in factors),
    ]
    return [value for i, value in enumerate(values) if not _is_among(value, values[:i])]


def _payloads(used: Sequence[Trial], limits: Limits) -> list[float]:
    """No payload (or the lightest allowed), the heaviest, and those used in between."""
    payloads = {trial.payload_kg for trial in used}
    heaviest = max(payloads) if max(payloads) > 0 else 0.05  # kg, where none was used yet
    low, high = _stated(limits, "payload_g") or (0.0, heaviest)
    return sorted({low, high, *(payload for payload in payloads if low <= payload <= high)})


def _pressures(rig: Trial, payload_kg: float, used: Sequence[Trial], limits: Limits) -> list[tuple[float, float]]:
    """Set pressures in equal ratios, Pa, each with its standard error."""
    pressure_step_pa = 100.0  # Resolution of set pressures, Pa (chosen)
    pressures = [trial.pressure_Pa for trial in used if trial.pressure_Pa > 0]
    if not pressures:
        return []
    # 1.25: a quarter above the highest used
    low, high = _stated(limits, "pressure_kPa") or (min(pressures), 1.25 * max(pressures))
    stress_Pa = hoop_stress_Pa(1.0, rig.diameter_m, rig.thickness_m)
    if math.isfinite(stress_Pa):
        # The default strength of film must not exclude pressures that this vine has held; a stated strength may.
        is_stated = "hoop_stress_MPa" in limits.model_fields_set
        held = [trial.pressure_Pa for trial in used if trial.vine == rig.vine and not is_stated]
        bursts_Pa = 1e6 * limits.hoop_stress_MPa / stress_Pa
        high = min(high, max([pressure_step_pa * math.floor(bursts_Pa / pressure_step_pa), *held]))
    if payload_kg == 0 and math.isfinite(rig.yield_pressure_Pa):
        # 1.15: lowest candidate pressure of a vine without payload, as a multiple of the yield pressure (chosen)
        low = max(low, 1.15 * rig.yield_pressure_Pa)
    if not low <= high:
        return []
    # 6: candidate pressures of a vine (chosen)
    steps = np.geomspace(low, high, 6) if high > 1.02 * low else np.array([high])
    relative = [t.pressure_sigma_Pa / t.pressure_Pa for t in used if t.pressure_Pa > 0]
    share = float(np.nanmedian(relative)) if np.isfinite(relative).any() else math.nan
    steps = np.clip(pressure_step_pa * np.round(steps / pressure_step_pa), low, high)
    return [(float(pressure), share * float(pressure)) for pressure in np.unique(steps.round(3))]


def _new_vines(models: Sequence[tuple[Trial, int]], limits: Limits) -> list[tuple[Trial, int]]:
    """Vines that could be made, each with the index of the trial whose vine is nearest in size."""
    vines = [trial for trial, _ in models]
    diameters = _sizes(vines, limits, "diameter_mm", (0.5, 0.75, 1.5))
    new_vines: list[tuple[Trial, int]] = []
    for diameter, wall in itertools.product(diameters, _sizes(vines, limits, "thickness_um", (0.5, 2.0))):
        if wall > diameter / 4 or not COLUMNS["diameter_mm"].low <= 1e3 * diameter <= COLUMNS["diameter_mm"].high:
            continue
        distances = [math.hypot(math.log(v.diameter_m / diameter), math.log(v.thickness_m / wall)) for v in vines]
        near, like = models[int(np.argmin(distances))]
        for length in _stated(limits, "length_mm") or [near.length_m]:
            size: dict[str, Any] = {"diameter_m": diameter, "thickness_m": wall, "length_m": length}
            sized = replace(near, video=None, track=None, pressure_trace=None, **size)
            if not any(_alike(sized, vine) for vine in vines):
                new_vines.append((with_names([sized])[0], like))
    most = 10  # New vines considered, at most (chosen)
    if len(new_vines) <= most:
        return new_vines
    return [new_vines[k] for k in np.linspace(0, len(new_vines) - 1, most).round().astype(int)]


def _sizes(vines: Sequence[Trial], limits: Limits, column: str, factors: Sequence[float]) -> list[float]:
    """Candidate sizes: the user's, else those used and multiples of the smallest and largest."""
    stated = _stated(limits, column)
    used = {size for vine in vines if math.isfinite(size := _of(vine, column))}
    if stated is not None or not used:
        return stated or []
    return sorted(used | {_rounded(f * (min(used) if f < 1 else max(used))) for f in factors})


# ------------------------------------------------------------------------------
# Extension of a fitted hypothesis to trials that have not been made.
#
# The free parameters of the fit stay as they are. Every new vine adds its own: B of the vine nearest in size, scaled by
# the ratio of their priors, and the yield pressure with the error to which it will be measured.


@dataclass(frozen=True)
class Hypothesis:
    """One of the tied fits, extended to further conditions. `layout` maps the free parameters to the trials of the
    conditions: those of the fit first, then those of new vines. All are scaled as in the fit; `theta`, shape (n_free,),
    are their best values. The experiment films `rest_frames` before release and `longest_s` of motion. For `so_far` and
    `each` see `refit_terms`.
    """

    name: str
    fit: Fit
    conditions: Sequence[Condition]
    layout: ParameterMap
    theta: Floats
    variance: float
    rest_frames: int
    longest_s: float
    so_far: Floats = field(default_factory=lambda: np.empty(0))
    each: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def n_old(self) -> int:
        """Number of free parameters of the fit."""
        return self.fit.solution.state.theta.size

    def frame_s(self, place: int) -> float:
        """Frame interval of a condition: that of the trial it is modelled on."""
        return self.fit.predictor.data[self.conditions[place].like].frame_s

    def predictor(self, places: Sequence[int], times_s: Sequence[Floats]) -> Predictor:
        """Return a predictor of trials at the conditions at `places`, at these times; a recorded pressure is constant.
        Their measured positions are placeholders.
        """
        items = []
        for place, time_s in zip(places, times_s, strict=True):
            trial, like = self.conditions[place].trial, self.fit.predictor.data[self.conditions[place].like]
            constant = (np.array([-1e3, 1e3]), np.full(2, trial.pressure_Pa))
            first, n_rest = np.arange(time_s.size) == 0, int(np.count_nonzero(time_s <= 0))
            trace = None if like.trace is None else constant
            items.append(FitTrial(trial, time_s, time_s, first, n_rest, like.noise_m, like.correlation, trace))
        rows = list(places)
        layout = replace(self.layout, index=self.layout.index[rows], base=self.layout.base[rows])
        return _stepped_as(self.fit, layout, items)


def _stepped_as(fit: Fit, layout: ParameterMap, data: Sequence[FitTrial]) -> Predictor:
    """A predictor with the finite-difference steps of a fit."""
    predictor = Predictor(layout, data, fit.predictor.host)
    predictor.steps = fit.predictor.steps.copy()
    return predictor


def extend(fit: Fit, name: str, conditions: Sequence[Condition]) -> Hypothesis:
    """Extend a fit to further conditions; new vines add parameters with priors."""
    old, state, names, data = fit.predictor.layout, fit.solution.state, fit.model.parameter_names, fit.predictor.data
    fitted_rows, _ = old.rows(state.theta)
    numbers, index, base = list(old.free), [], []
    places: dict[tuple[str, str], int] = {}
    for condition in conditions:
        trial, like = condition.trial, data[condition.like].trial
        row, values = old.index[condition.like].copy(), np.array(fitted_rows[condition.like])
        is_new = trial.vine != like.vine
        if is_new and fit.predictor.damping_column >= 0:
            values[fit.predictor.damping_column] *= prior_ratio(trial, like)
        for column, key in enumerate(old.keys):
            if is_new and row[column] >= 0 and (of_like := old.free[row[column]]).vine:
                if (key, trial.vine) not in places:
                    places[key, trial.vine] = len(numbers)
                    start = trial.yield_pressure_Pa if key == YIELD_PRESSURE else of_like.start
                    if key in names:
                        start = float(np.clip(values[names.index(key)], of_like.lower, of_like.upper))
                    numbers.append(replace(of_like, vine=trial.vine, start=start))
                row[column] = places[key, trial.vine]
        index.append(row)
        base.append(values)
    layout = ParameterMap(old.model, tuple(numbers), old.keys, np.array(index), np.array(base))
    everting = [trial_data for trial_data in data if trial_data.trial.travel_ratio != 1]
    moving_s = [trial_data.time_s[-1] - trial_data.time_s[max(trial_data.n_rest - 1, 0)] for trial_data in everting]
    return Hypothesis(
        name=name,
        fit=fit,
        conditions=conditions,
        layout=layout,
        theta=np.concatenate([state.theta, layout.start[state.theta.size :]]),
        variance=float(np.exp(np.mean(np.log(state.variance)))),
        rest_frames=max(int(np.median([trial_data.n_rest for trial_data in everting])), 3),
        longest_s=1.5 * float(max(moving_s)),  # a longer film than any so far
    )


# ------------------------------------------------------------------------------
# Simulated tracks of candidate trials, sampled as the camera of the experiment would.


def growth_courses(hypotheses: Sequence[Hypothesis]) -> list[float | None]:
    """Return when the first hypothesis nears the end of the growth, s, for every condition; None where it is not worth
    filming or the model is in doubt.
    """
    last = hypotheses[-1]
    every, longest_s, fit = range(len(last.conditions)), last.longest_s, last.fit
    trial_effects, times = np.zeros((len(every), N_TRIAL_EFFECTS)), [np.linspace(0.0, longest_s, 400)] * len(every)
    runs = []
    for hypothesis in hypotheses:
        predictor = hypothesis.predictor(every, times)
        jobs = predictor.jobs(hypothesis.theta, trial_effects)
        runs.append(_simulated(predictor, jobs))
    # The largest ratio of tail speed to steady speed among the trials so far
    made = fit.predictor.jobs(fit.solution.state.theta, np.zeros((len(fit.trials), N_TRIAL_EFFECTS)))
    seen = [
        _speed_ratio(fit, trial_fit.trial, job, trial_fit.trial.travel_ratio * trial_fit.predicted_velocity_m_s)
        for trial_fit, job in zip(fit.trials, made, strict=True)
        if trial_fit.trial.travel_ratio != 1
    ]
    # 1.05: the ratio above which the model predicts compression in the tail (chosen)
    largest_ratio = max(1.05, *filter(math.isfinite, seen))
    growth: list[float | None] = [None] * len(every)
    for i, condition in enumerate(last.conditions):
        trial, moving = condition.trial, [course for run in runs if (course := run[i]) is not None]
        if len(moving) < len(runs):
            continue
        near_m = np.nan_to_num(END_FRACTION * trial.length_m, nan=math.inf)
        near_s = min(float(np.interp(near_m, m.lead_position_m, m.time_s, right=longest_s)) for m in moving)
        grown_m = min(float(np.interp(near_s, m.time_s, m.lead_position_m)) for m in moving)
        ratio = _speed_ratio(fit, trial, jobs[i], moving[-1].tail_velocity_m_s)
        # 0.3: fraction of its length that a vine must grow while filmed for a trial to be worth making (chosen)
        grows_enough = grown_m > 0.3 * np.nan_to_num(trial.length_m) and near_s > 8 * last.frame_s(i)
        is_compressed = trial.tail_slack != "free" and ratio > largest_ratio
        if grows_enough and not is_compressed:
            growth[i] = near_s
    return growth


def _simulated(predictor: Predictor, jobs: Jobs) -> list[Trajectory | None]:
    """Trajectories of all jobs; None for those that cannot be simulated, found by bisection."""
    try:
        return list(predictor.run(jobs))
    except SimulationError:
        if len(jobs) == 1:
            return [None]
    middle = len(jobs) // 2
    return _simulated(predictor, jobs[:middle]) + _simulated(predictor, jobs[middle:])


def _speed_ratio(fit: Fit, trial: Trial, job: Jobs, tail_velocity_m_s: Floats) -> float:
    """Ratio of the largest tail speed to the steady speed without payload; 0 where the model has no damping."""
    names = fit.model.parameter_names
    if DAMPING not in names or EXPONENT not in names:
        return 0.0
    B, n = (float(job.row[names.index(key)]) for key in (DAMPING, EXPONENT))
    yield_Pa = trial.yield_pressure_Pa if np.isnan(job.yield_pressure_Pa) else float(job.yield_pressure_Pa)
    drive_N = (trial.pressure_Pa - yield_Pa) * trial.area_m2
    if not (drive_N > 0 and B > 0 and n > 0.05):
        return math.inf if not drive_N > 0 else 0.0
    return float(np.max(tail_velocity_m_s)) / (drive_N / B) ** (1 / n)


def film_trials(
    truth: Hypothesis, places: Sequence[int], deviations: Floats, rng: np.random.Generator
) -> list[tuple[int, FitTrial]]:
    """Simulate the tracks of the conditions at `places` under a hypothesis, with random release, origin and noise, and
    select usable points as for a fit; without those that have too few. Shapes: deviations (n_places, 2).
    """
    rho, frames_s = truth.fit.solution.state.rho, [truth.frame_s(place) for place in places]
    times = [s * np.arange(truth.rest_frames + math.ceil(truth.longest_s / s), dtype=float) for s in frames_s]
    predictor = truth.predictor(places, times)
    trial_effects = np.zeros((len(places), N_TRIAL_EFFECTS))
    trial_effects[:, RELEASE] = [(truth.rest_frames - 1 + rng.uniform()) * frame_s for frame_s in frames_s]
    trial_effects[:, ORIGIN] = rng.uniform(-0.02, 0.02, len(places))
    may_deviate = np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation])
    trial_effects[:, DEVIATION_COLUMNS] = np.where(may_deviate, deviations, 0.0)
    moved = predictor.run(predictor.jobs(truth.theta, trial_effects))
    filmed: list[tuple[int, FitTrial]] = []
    for place, blank, trajectory, effects in zip(places, predictor.data, moved, trial_effects, strict=True):
        stop = blank.time_s.size
        if trajectory.status == "ended":
            stop = int(np.searchsorted(blank.time_s, effects[RELEASE] + trajectory.end_time_s))
        noise = ar1_noise(stop, math.sqrt(truth.variance / (1 - rho**2)), rho, rng)
        position_m = effects[ORIGIN] + trajectory.observed_position_m[:stop] + noise
        pressure_Pa = None if blank.trace is None else np.full(stop, blank.trial.pressure_Pa)
        with suppress(FitError):
            track = plain_track(blank.time_s[:stop], position_m, pressure_Pa=pressure_Pa)
            filmed.append((place, prepare_trial(blank.trial, track)))
    return filmed


# ------------------------------------------------------------------------------
# Separation of hypotheses by designs, to first order.
#
# With its trial effects eliminated, a trial is a quadratic form in the unknowns of a campaign, and forms add up. Those
# of a refit are the free parameters of the hypothesis and, for each hypothesis that may be true, by how much the trial
# moves as it says: minimised over the first, the diagonal of the others is what the refit does not explain.


def refit_terms(hypotheses: Sequence[Hypothesis], near_ends_s: Sequence[float]) -> list[Hypothesis]:
    """The hypotheses with the cross products of a refit: `so_far`, shape (n, n), of the trials so far near the best
    values; `each`, shape (n_conditions, n, n), of one trial of each condition, filmed until it nears its end.
    """
    points = 100  # Times at which a condition is evaluated; each stands for the frames around it (chosen)
    every, steps_s = range(len(near_ends_s)), np.array(near_ends_s) / points
    frames_s = np.array([hypotheses[0].frame_s(place) for place in every])
    # The first time represents the frames at rest.
    times_s = np.insert(np.outer(steps_s, np.arange(points) + 0.5), 0, -frames_s, axis=1)
    frames = np.insert(np.outer(steps_s / frames_s, np.ones(points)), 0, hypotheses[0].rest_frames, axis=1)
    trial_effects = np.zeros((len(every), N_TRIAL_EFFECTS))
    columns = [
        np.stack(hypothesis.predictor(every, list(times_s)).linearise(hypothesis.theta, trial_effects))
        for hypothesis in hypotheses
    ]
    # The last column is placeholder − motion; the placeholder cancels in the difference of two hypotheses.
    motions = np.stack([-block[:, :, -1] for block in columns], axis=2)
    terms = []
    for k, (hypothesis, sensitivities) in enumerate(zip(hypotheses, columns, strict=True)):
        solution, old, size = hypothesis.fit.solution, hypothesis.n_old, hypothesis.theta.size
        state, total = solution.state, size + len(hypotheses)
        # For smooth curves AR(1) noise is equivalent to white noise of variance σ²_innovation/(1 − ρ)².
        scale = (1 - state.rho) / np.sqrt(hypothesis.variance) * np.sqrt(frames)[:, :, None]
        both = scale * np.concatenate([sensitivities[:, :, :-1], motions - motions[:, :, [k]]], axis=2)
        precision = np.full(trial_effects.shape, 1e-9)
        precision[:, DEVIATION_COLUMNS] = 1 / np.maximum(state.spread, LEAST_BETWEEN_TRIAL_SD) ** 2
        index = np.hstack([hypothesis.layout.index, np.tile(np.arange(size, total), (len(every), 1))])
        each = at_unknowns(eliminated(np.swapaxes(both, 1, 2) @ both, precision)[0], index, total)
        so_far, new = np.zeros((total, total)), np.arange(old, size)
        reduced = marginal(solution.cross_products, solution.problem, state)
        so_far[:old, :old] = normal_equations(reduced, solution.problem, state, state.spread)[0]
        # 1.0: prior standard deviation of the parameters of a new vine, scaled as in the fit (chosen)
        so_far[new, new] = 1 / 1.0**2 + hypothesis.layout.prior_precision[old:]
        terms.append(replace(hypothesis, so_far=so_far, each=each))
    return terms


def separations(terms: Sequence[Hypothesis], designs: Sequence[Sequence[int]] | NDArray[np.int_]) -> Floats:
    """Return the separation of every ordered pair (true, refitted), in standard deviations; 0 on the diagonal. Shapes:
    designs (n_designs, n_trials) → (n_designs, n, n).
    """
    squares = []
    for refitted in terms:
        size = refitted.theta.size
        form = refitted.so_far + sum(refitted.each[conditions] for conditions in np.transpose(designs))
        explained = form[:, size:, :size] @ solve_per_trial(form[:, :size, :size], form[:, :size, size:])
        squares.append(np.einsum("naa->na", form[:, size:, size:] - explained))
    return np.sqrt(np.maximum(np.stack(squares, axis=2), 0.0))


def worth(between: Floats) -> Floats:
    """Return the worth of designs: the sum over pairs of d²/(d² + 5²), d the smaller separation of the two directions.
    Shapes: between (n_designs, n, n) → (n_designs,).
    """
    first, second = np.triu_indices(between.shape[1], 1)
    square = np.minimum(between[:, first, second], between[:, second, first]) ** 2
    # 5.0: separation, in standard deviations, at which a pair has half of its largest worth (chosen)
    return np.asarray(np.sum(square / (square + 5.0**2), axis=1))


# ------------------------------------------------------------------------------
# Separation by further trials, found by simulating them and refitting the hypotheses to old and new trials.
#
# Each hypothesis in turn is taken as the truth. The new trials are simulated with deviations of pressure and B,
# releases, origins and noise, and sampled as the experiment films. Every hypothesis is then fitted to all trials, old
# and new; between-trial standard deviations and noise are estimated anew as in a diagnosis, so a wrong hypothesis can
# explain part of its misfit as scatter. The squared separation is the increase in the difference of −2 ln L.


def simulated_rises(hypotheses: Sequence[Hypothesis], design: Sequence[int], draws: Sequence[int], seed: int) -> Floats:
    """Return the rise of −2 ln L of every (true, refitted) pair; NaN where a refit fails. The truth is at its best
    values and the deviations of the trials are plus or minus one standard deviation in turn, so that few draws show the
    average. Shape (n_draws, n, n).
    """
    n = len(hypotheses)
    # Deviations of pressure and B in standard deviations, balanced over replicates (derived)
    alternating = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    rises = np.full((len(draws), n, n), math.nan)
    before = np.array([-2 * hypothesis.fit.log_likelihood for hypothesis in hypotheses])
    for k, a in np.ndindex(len(draws), n):
        rng, truth = np.random.default_rng([seed, 0, draws[k], a]), hypotheses[a]
        deviations = alternating[(np.arange(len(design)) + draws[k]) % 4] * truth.fit.solution.state.spread
        try:
            new = film_trials(truth, design, deviations, rng)
        except SimulationError:
            continue
        if new:
            after = np.array([_refitted(hypothesis, new) for hypothesis in hypotheses])
            rises[k, a] = after - before - (after[a] - before[a])
    return rises


def _refitted(hypothesis: Hypothesis, new: Sequence[tuple[int, FitTrial]]) -> float:
    """−2 ln L of a hypothesis fitted to old trials and to new ones of these conditions; NaN where the fit fails."""
    most = 20  # Iterations of a refit, at most (chosen)
    fit, old = hypothesis.fit, hypothesis.fit.solution
    # Of the parameters of new vines only those that the new trials depend on are free.
    before, wide, rows = fit.predictor.layout, hypothesis.layout, [place for place, _ in new]
    used = np.union1d(np.arange(hypothesis.n_old), wide.index[rows][wide.index[rows] >= 0])
    index = np.where(wide.index[rows] < 0, -1, np.searchsorted(used, wide.index[rows]))
    layout = replace(
        wide,
        free=tuple(wide.free[k] for k in used),
        index=np.concatenate([before.index, index]),
        base=np.concatenate([before.base, wide.base[rows]]),
    )
    data = [trial_data for _, trial_data in new]
    predictor = _stepped_as(fit, layout, [*fit.predictor.data, *data])
    try:
        # The noise of the new trials is that of the old.
        state = replace(
            old.state,
            theta=hypothesis.theta[used],
            trial_effects=np.concatenate([old.state.trial_effects, initial_trial_effects(data)]),
            variance=np.concatenate([old.state.variance, np.full(len(data), hypothesis.variance)]),
        )
        problem = make_problem(predictor, state.trial_effects)
        problem.release_origin_mean[: len(fit.trials)] = old.problem.release_origin_mean
        # Scatter and noise are fixed at first, lest misfit that the parameters have yet to remove be taken as scatter.
        fixed = FixedTerms(state.spread, (state.rho, state.variance))
        solution = solve(predictor, problem, state, fixed, warm=True, most_iterations=most)
        solution = solve(predictor, problem, solution.state, warm=True, most_iterations=most)
        # These absorb part of what is wrong in a hypothesis, as in every fit.
        smooth = smooth_errors(predictor, solution)
    except SimulationError:
        return math.nan
    return -2 * (solution.log_likelihood() + (smooth.gain if smooth else 0.0))
