"""What a vine will do: position, speed and tension along its growth, with the uncertainty of its inputs.

Every uncertainty of the inputs is drawn, every draw simulated from release to the end of growth. Stated are medians and
the band of nine draws in ten. As growth never turns back, the quantiles of the time at which a place is passed are
those of the position at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.planning.predictive_inputs import BAND, PredictiveInputs
from vinetrack.planning.scaling_priors import hoop_stress_Pa

LONGEST_S = 600.0
"""A vine that has not grown by then is taken for one that does not get there. Chosen: a thousand times a usual growth.
At half or twice only vines at the edge of growing at all change sides."""

POINTS = 400
"""Instants of each draw: linear between them, speeds are good to a thousandth up to 0.99 of the length. Derived: linear
interpolation errs by (1/400)²/8 of the curvature."""

MOST_TENSIONS = 300
"""Draws whose forces are looked at one by one, a third of a millisecond each. Chosen for time: the ends of a 90 % band
are then known to 1.3 % of the draws. At half to 1.8 %, at twice to 0.9 %."""

ROUNDING = 1e-9
"""Of the drive, below which a tension is none: forces of a slack tail cancel to rounding. Chosen: far above rounding of
sums (1e-15), far below any force of interest."""

SLACK_SHARE = 0.01
"""Of the drive ½PA that a tail must lack before it counts as slack: the mere weight of a bare tail does no harm.
Chosen: half of it names vines whose bare tail pushes by less than its weight; twice passes payloads that run ahead by 2
% of the drive."""


@dataclass(frozen=True)
class Runs:
    """Draws simulated, SI. Arrays have shape (n_draws,), or (n_draws, n_places) along `places_m`.

    A place that a draw never reaches has the time inf and the speed 0. Speeds are the leading edge's. Tensions and
    pressures are those of the first `MOST_TENSIONS` draws, NaN where not reached; `least_tension_N` is the least up to
    the last place. `slack` tells which of them would have a tail that pushes, or that goes slack where it may.
    """

    places_m: Floats
    time_s: Floats
    lead_velocity_m_s: Floats
    end_s: Floats
    end_lead_velocity_m_s: Floats
    steady_tail_m_s: Floats
    tension_N: Floats
    least_tension_N: Floats
    pressure_Pa: Floats
    slack: Floats


def run(
    inputs: PredictiveInputs,
    places_m: Floats,
    samples: int,
    seed: int,
    *,
    only: Iterable[str] | None = None,
    with_tension: bool = True,
) -> Runs:
    """Draw predictive inputs and simulate every draw.

    Parameters
    ----------
    inputs : what is drawn.
    places_m : array, shape (n_places,), m
        Growth at which values are taken, rising.
    samples : int
        Number of draws.
    seed : int
        Of the random numbers.
    only : iterable of str, optional
        Names of the uncertainties that vary; all by default.
    with_tension : bool
        Whether tensions and pressures are computed, for the first `MOST_TENSIONS` draws.

    Returns
    -------
    Runs

    Raises
    ------
    EffectError
        If the trial lacks what an effect of the model needs.
    SimulationError
        If a draw cannot be integrated.
    """
    trials, rows = inputs.laid_out(inputs.draw(samples, seed, only))
    moved, until_s = follow(inputs, trials, rows)
    time_s, velocity_m_s = np.full((samples, places_m.size), math.inf), np.zeros((samples, places_m.size))
    for i, trajectory in enumerate(moved):
        reached = places_m <= trajectory.lead_position_m[-1]
        time_s[i, reached] = np.interp(places_m[reached], trajectory.lead_position_m, trajectory.time_s)
        velocity_m_s[i, reached] = np.interp(
            places_m[reached], trajectory.lead_position_m, trajectory.lead_velocity_m_s
        )
    looked_at = min(samples, MOST_TENSIONS) if with_tension else 0
    tension_N, pressure_Pa, least_N, slack = _forces(inputs, trials[:looked_at], rows, moved, places_m)
    return Runs(
        places_m=places_m,
        time_s=time_s,
        lead_velocity_m_s=velocity_m_s,
        end_s=until_s,
        end_lead_velocity_m_s=np.where(
            np.isfinite(until_s), [trajectory.lead_velocity_m_s[-1] for trajectory in moved], 0.0
        ),
        steady_tail_m_s=_steady(inputs, trials, rows),
        tension_N=tension_N,
        least_tension_N=least_N,
        pressure_Pa=pressure_Pa,
        slack=slack,
    )


def follow(inputs: PredictiveInputs, trials: Sequence[Trial], rows: Floats) -> tuple[list[Trajectory], Floats]:
    """Every draw at `POINTS` instants of its growth, and when it ends.

    Parameters
    ----------
    inputs : their model is simulated.
    trials : sequence, n_draws
    rows : array, shape (n_draws, n_parameters)
        Parameters of the model, SI.

    Returns
    -------
    trajectories : list of Trajectory
    end_s : array, shape (n_draws,)
        inf where a draw does not end.
    """
    asked = [np.array([0.0, LONGEST_S])] * len(trials)
    ends = simulate_many(inputs.model, trials, asked, parameters=rows)
    over = np.array([last.end_time_s if last.status in ("ended", "stalled") else LONGEST_S for last in ends])
    # An instant short of the end: there the bare vine's speed has left for infinity, and behind it is none.
    times = [max(end, 1e-9) * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS) for end in over]
    moved = simulate_many(inputs.model, trials, times, parameters=rows)
    return moved, np.where([last.status == "ended" for last in ends], over, math.inf)


def _forces(
    inputs: PredictiveInputs, trials: Sequence[Trial], rows: Floats, moved: Sequence[Trajectory], places_m: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Tension and pressure at the places, least tension up to the last of them, and whether the tail goes slack."""
    names = inputs.model.parameter_names
    tension_N, pressure_Pa = (np.full((len(trials), places_m.size), math.nan) for _ in range(2))
    least_N, slack = np.full(len(trials), math.nan), np.zeros(len(trials))
    for i, trial in enumerate(trials):
        model = replace(inputs.model, values=dict(zip(names, rows[i].tolist(), strict=True)))
        trajectory = moved[i]
        terms = evaluate(model, trial, trajectory.time_s, trajectory.lead_position_m, trajectory.lead_velocity_m_s)
        drive_N = trial.pressure_Pa * trial.area_m2 / trial.travel_ratio
        tension = np.where(np.abs(terms.tension_N) < ROUNDING * drive_N, 0.0, terms.tension_N)
        reached = places_m <= trajectory.lead_position_m[-1]
        tension_N[i, reached] = np.interp(places_m[reached], trajectory.lead_position_m, tension)
        pressure_Pa[i, reached] = np.interp(places_m[reached], trajectory.lead_position_m, terms.pressure_Pa)
        moving = (trajectory.lead_position_m <= places_m[-1]) & (trajectory.lead_velocity_m_s > 0)
        if moving.any():
            least_N[i] = np.min(tension[moving])
        free = trial.tail_slack == "free"
        slack[i] = math.isfinite(trajectory.slack_from_s) if free else least_N[i] < -SLACK_SHARE * drive_N
    return tension_N, pressure_Pa, least_N, slack


def _steady(inputs: PredictiveInputs, trials: Sequence[Trial], rows: Floats) -> Floats:
    """Tail speed of (P − P_y)A = B ẋⁿ, m/s, weight and further effects left out; NaN for a model without it."""
    names = inputs.model.parameter_names
    if DAMPING not in names:
        return np.full(len(trials), math.nan)
    B, n = rows[:, names.index(DAMPING)], rows[:, names.index(EXPONENT)]
    force_N = np.array([max(t.pressure_Pa - t.yield_pressure_Pa, 0.0) * t.area_m2 for t in trials])
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray((force_N / B) ** (1 / n))


SAMPLES = 1000
"""Draws of a prediction. Derived: the ends of the 90 % band are known to √(0.05 × 0.95/1000) = 0.7 % of the draws."""

SAMPLES_OF_A_SHARE = 400
"""Draws for the band of one uncertainty alone. Derived: its ends are known to 1.1 % of the draws."""

FINAL_AT_FRACTION = 0.95
"""y/L at which a bare vine's final speed is taken. Convention, as in a fit: the model's speed diverges at 1."""

ALONG = np.concatenate([[0.0, 0.0005, 0.001, 0.002, 0.004, 0.007], np.linspace(0.01, 0.99, 99)])
"""y/L of the curves, dense where everything begins. Farther on a bare vine is faster in the model than anything."""

CURVE_COLUMNS = (
    "condition",
    "y_over_L",
    "lead_position_m",
    "time_s",
    "time_low_90_s",
    "time_high_90_s",
    "lead_velocity_m_s",
    "lead_velocity_low_90_m_s",
    "lead_velocity_high_90_m_s",
    "tail_velocity_m_s",
    "tension_N",
    "tension_low_90_N",
    "tension_high_90_N",
    "pressure_kPa",
)
TABLE_COLUMNS = ("condition", "quantity", "y_over_L", "median", "low_90", "high_90", "unit")

TIME, TO_THE_END = "time to get there", "time to the end"
EDGE, TAIL = "speed of the leading edge", "speed of the tail"
EJECTION = "ejection speed of the payload"
TENSION, LEAST_TENSION = "tension of the tail", "least tension of the tail"
STEADY = "steady tail speed, Eq. (3)"
HOOP = "hoop stress PD/2t"


@dataclass(frozen=True)
class Quantity:
    """One number that is predicted, with its 90 % band, SI.

    `y_over_L` is where it was taken, NaN where that is nowhere. Of draws that never get there the time is infinite and
    the speed 0.
    """

    name: str
    y_over_L: float
    low: float
    median: float
    high: float
    unit: str


@dataclass(frozen=True)
class Contribution:
    """The 90 % band of the final speed, m/s, with one uncertainty alone; `name` and `words` are those of the input."""

    name: str
    words: str
    low: float
    high: float


@dataclass(frozen=True)
class VinePrediction:
    """What is predicted of one trial.

    `curve` has a row a place along the growth, columns `CURVE_COLUMNS`. `shares` tell what each uncertainty alone
    leaves of `final`, largest first. `arrives` is the part of the draws that grow to the end, `slack` that of those
    whose tail would have to push (or goes slack, where it may) on the way.
    """

    inputs: PredictiveInputs
    at_fraction: float
    quantities: tuple[Quantity, ...]
    curve: pd.DataFrame
    shares: tuple[Contribution, ...]
    arrives: float
    slack: float
    samples: int

    @property
    def final(self) -> Quantity:
        """The speed that matters: a payload's as it leaves, else the leading edge's at the fraction asked for.

        Where the tail may go slack a payload has a speed of its own, which nobody follows: then the leading edge's.
        """
        return self[final_name(self.inputs)]

    def __getitem__(self, name: str) -> Quantity:
        """The quantity of that name; KeyError where there is none."""
        return {quantity.name: quantity for quantity in self.quantities}[name]

    @property
    def table(self) -> pd.DataFrame:
        """A row a quantity, columns `TABLE_COLUMNS`, SI."""
        condition = self.inputs.trial.condition
        rows = [(condition, q.name, q.y_over_L, q.median, q.low, q.high, q.unit) for q in self.quantities]
        return pd.DataFrame(rows, columns=list(TABLE_COLUMNS))


def told_by_payload(trial: Trial) -> bool:
    """Whether the final speed is a payload's: not where a slack tail lets it go its own way.

    Parameters
    ----------
    trial : its payload and `tail_slack`.

    Returns
    -------
    bool
    """
    return trial.payload_kg > 0 and trial.tail_slack != "free"


def final_name(inputs: PredictiveInputs) -> str:
    """Name of the speed that matters for this trial.

    Parameters
    ----------
    inputs : of the trial.

    Returns
    -------
    str
        Name of a `Quantity`.
    """
    return EJECTION if told_by_payload(inputs.trial) else EDGE


def predict_vine(
    inputs: PredictiveInputs, *, samples: int = SAMPLES, seed: int = 1, at_fraction: float = FINAL_AT_FRACTION
) -> VinePrediction:
    """Simulate the predictive inputs of a trial: medians, 90 % bands, and what each uncertainty contributes.

    Parameters
    ----------
    inputs : from `predictive_inputs`.
    samples : int
        Number of draws.
    seed : int
        Of the random numbers; the same gives the same numbers.
    at_fraction : float
        y/L at which a bare vine's final speed is taken: in the model it diverges as the moving mass goes to zero.

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
    length_m = inputs.trial.length_m
    along = np.union1d(ALONG, [at_fraction])
    runs = run(inputs, along * length_m, samples, seed)
    place = int(np.searchsorted(along, at_fraction))
    return VinePrediction(
        inputs=inputs,
        at_fraction=at_fraction,
        quantities=tuple(_quantities(inputs, runs, along, place)),
        curve=_curve(inputs, runs, along),
        shares=_shares(inputs, at_fraction, min(samples, SAMPLES_OF_A_SHARE), seed),
        arrives=float(np.mean(np.isfinite(runs.end_s))),
        slack=float(np.mean(runs.slack)),
        samples=samples,
    )


def band(values: Floats) -> Floats:
    """5 %, 50 % and 95 % quantiles along the first axis: values that were drawn, so that infinite ones do no harm.

    Parameters
    ----------
    values : array, shape (n_draws, ...)
        NaN is left out.

    Returns
    -------
    array, shape (3, ...)
        NaN where all draws are.
    """
    nothing = np.isnan(values).all(axis=0)
    quantiles = np.asarray(np.nanquantile(np.where(nothing, 0.0, values), BAND, axis=0, method="inverted_cdf"))
    return np.where(nothing, np.nan, quantiles)


def _quantities(inputs: PredictiveInputs, runs: Runs, along: Floats, place: int) -> Iterator[Quantity]:
    r, at = inputs.trial.travel_ratio, float(along[place])
    speed = runs.lead_velocity_m_s[:, place]

    def quantity(name: str, where: float, values: Floats, unit: str) -> Quantity:
        low, median, high = (float(number) for number in band(values))
        return Quantity(name, where, low, median, high, unit)

    if inputs.trial.payload_kg > 0:
        if told_by_payload(inputs.trial) or not runs.slack.any():
            yield quantity(EJECTION, 1.0, r * runs.end_lead_velocity_m_s, "m/s")
        yield quantity(TO_THE_END, 1.0, runs.end_s, "s")
    yield quantity(EDGE, at, speed, "m/s")
    yield quantity(TAIL, at, r * speed, "m/s")
    yield quantity(TIME, at, runs.time_s[:, place], "s")
    if not math.isnan(runs.steady_tail_m_s[0]):
        yield quantity(STEADY, math.nan, runs.steady_tail_m_s, "m/s")
    yield quantity(TENSION, at, runs.tension_N[:, place], "N")
    yield quantity(LEAST_TENSION, math.nan, runs.least_tension_N, "N")
    trial = inputs.trial
    stress = hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m)
    yield Quantity(HOOP, math.nan, stress, stress, stress, "Pa")


def _curve(inputs: PredictiveInputs, runs: Runs, along: Floats) -> pd.DataFrame:
    time, speed, tension, pressure = (
        band(values) for values in (runs.time_s, runs.lead_velocity_m_s, runs.tension_N, runs.pressure_Pa)
    )
    columns = (
        np.full(along.size, inputs.trial.condition, dtype=object),
        along,
        runs.places_m,
        time[1],
        time[0],
        time[2],
        speed[1],
        speed[0],
        speed[2],
        inputs.trial.travel_ratio * speed[1],
        tension[1],
        tension[0],
        tension[2],
        pressure[1] / 1e3,
    )
    return pd.DataFrame(dict(zip(CURVE_COLUMNS, columns, strict=True)))


def _shares(inputs: PredictiveInputs, at_fraction: float, samples: int, seed: int) -> tuple[Contribution, ...]:
    """Each uncertainty by itself; a payload's final speed is taken at the end, another's at the fraction."""
    contributions = []
    place_m = np.array([at_fraction * inputs.trial.length_m])
    for uncertainty in inputs.uncertainties:
        runs = run(inputs, place_m, samples, seed, only=[uncertainty.name], with_tension=False)
        loaded = told_by_payload(inputs.trial)
        speed = inputs.trial.travel_ratio * runs.end_lead_velocity_m_s if loaded else runs.lead_velocity_m_s[:, 0]
        low, _, high = band(speed)
        contributions.append(Contribution(uncertainty.name, uncertainty.words, float(low), float(high)))
    return tuple(sorted(contributions, key=lambda share: share.low - share.high))
