"""What a vine will do: position, speed and tension along its growth, with the uncertainty of what is believed of it.

    belief = believe(planned_trial({"diameter_mm": "25", "thickness_um": "100", …}).trials[0])
    print(foresee(belief).table)

Every uncertainty of a belief is drawn, every draw simulated from release to the end of growth. Stated are medians and
the band of nine draws in ten. As growth never turns back, the quantiles of the time at which a place is passed are
those of the position at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vinetrack.core.records import Floats, Trial
from vinetrack.planning.prediction_runs import Runs, run
from vinetrack.planning.predictive_inputs import BAND, PredictiveInputs
from vinetrack.planning.scaling_priors import hoop_stress_Pa

SAMPLES = 1000
SAMPLES_OF_A_SHARE = 400
FINAL_AT_FRACTION = 0.95
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
    """One number that is foretold, with its 90 % band, SI; `y_over_L` is where it was taken, NaN where that is nowhere.

    Of draws that never get there the time is infinite and the speed 0.
    """

    name: str
    y_over_L: float
    low: float
    median: float
    high: float
    unit: str


@dataclass(frozen=True)
class Contribution:
    """The 90 % band of the final speed, m/s, with one uncertainty alone; `name` and `words` are the belief's."""

    name: str
    words: str
    low: float
    high: float


@dataclass(frozen=True)
class VinePrediction:
    """What is foretold of one trial.

    `curve` has a row a place along the growth, columns `CURVE_COLUMNS`. `shares` tell what each uncertainty alone
    leaves of `final`, largest first. `arrives` is the part of the draws that grow to the end, `slack` that of those
    whose tail would have to push (or goes slack, where it may) on the way.
    """

    belief: PredictiveInputs
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
        return self[final_name(self.belief)]

    def __getitem__(self, name: str) -> Quantity:
        """The quantity of that name; KeyError where there is none."""
        return {one.name: one for one in self.quantities}[name]

    @property
    def table(self) -> pd.DataFrame:
        """A row a quantity, columns `TABLE_COLUMNS`, SI."""
        condition = self.belief.trial.condition
        rows = [(condition, q.name, q.y_over_L, q.median, q.low, q.high, q.unit) for q in self.quantities]
        return pd.DataFrame(rows, columns=list(TABLE_COLUMNS))


def told_by_payload(trial: Trial) -> bool:
    """Whether the final speed is a payload's: not where a slack tail lets it go its own way."""
    return trial.payload_kg > 0 and trial.tail_slack != "free"


def final_name(belief: PredictiveInputs) -> str:
    """Name of the speed that matters for this trial."""
    return EJECTION if told_by_payload(belief.trial) else EDGE


def predict_vine(
    belief: PredictiveInputs, *, samples: int = SAMPLES, seed: int = 1, at_fraction: float = FINAL_AT_FRACTION
) -> VinePrediction:
    """Simulate what is believed of a trial.

    Parameters
    ----------
    samples
        Number of draws.
    seed
        Of the random numbers; the same gives the same numbers.
    at_fraction
        y/L at which a bare vine's final speed is taken: in the model it diverges as the moving mass goes to nothing.

    Raises
    ------
    EffectError
        If the trial lacks what an effect of the model needs.
    SimulationError
        If a draw cannot be integrated.
    """
    length_m = belief.trial.length_m
    along = np.union1d(ALONG, [at_fraction])
    runs = run(belief, along * length_m, samples, seed)
    place = int(np.searchsorted(along, at_fraction))
    return VinePrediction(
        belief=belief,
        at_fraction=at_fraction,
        quantities=tuple(_quantities(belief, runs, along, place)),
        curve=_curve(belief, runs, along),
        shares=_shares(belief, at_fraction, min(samples, SAMPLES_OF_A_SHARE), seed),
        arrives=float(np.mean(np.isfinite(runs.end_s))),
        slack=float(np.mean(runs.slack)),
        samples=samples,
    )


def band(values: Floats) -> Floats:
    """5 %, 50 % and 95 % quantiles along the first axis: values that were drawn, so that infinite ones do no harm."""
    nothing = np.isnan(values).all(axis=0)
    found = np.asarray(np.nanquantile(np.where(nothing, 0.0, values), BAND, axis=0, method="inverted_cdf"))
    return np.where(nothing, np.nan, found)


def _quantities(belief: PredictiveInputs, runs: Runs, along: Floats, place: int) -> Iterator[Quantity]:
    r, at = belief.trial.travel_ratio, float(along[place])
    speed = runs.lead_velocity_m_s[:, place]

    def quantity(name: str, where: float, values: Floats, unit: str) -> Quantity:
        low, median, high = (float(one) for one in band(values))
        return Quantity(name, where, low, median, high, unit)

    if belief.trial.payload_kg > 0:
        if told_by_payload(belief.trial) or not runs.slack.any():
            yield quantity(EJECTION, 1.0, r * runs.end_lead_velocity_m_s, "m/s")
        yield quantity(TO_THE_END, 1.0, runs.end_s, "s")
    yield quantity(EDGE, at, speed, "m/s")
    yield quantity(TAIL, at, r * speed, "m/s")
    yield quantity(TIME, at, runs.time_s[:, place], "s")
    if not math.isnan(runs.steady_tail_m_s[0]):
        yield quantity(STEADY, math.nan, runs.steady_tail_m_s, "m/s")
    yield quantity(TENSION, at, runs.tension_N[:, place], "N")
    yield quantity(LEAST_TENSION, math.nan, runs.least_tension_N, "N")
    trial = belief.trial
    stress = hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m)
    yield Quantity(HOOP, math.nan, stress, stress, stress, "Pa")


def _curve(belief: PredictiveInputs, runs: Runs, along: Floats) -> pd.DataFrame:
    time, speed, tension, pressure = (
        band(values) for values in (runs.time_s, runs.lead_velocity_m_s, runs.tension_N, runs.pressure_Pa)
    )
    columns = (
        np.full(along.size, belief.trial.condition, dtype=object),
        along,
        runs.places_m,
        time[1],
        time[0],
        time[2],
        speed[1],
        speed[0],
        speed[2],
        belief.trial.travel_ratio * speed[1],
        tension[1],
        tension[0],
        tension[2],
        pressure[1] / 1e3,
    )
    return pd.DataFrame(dict(zip(CURVE_COLUMNS, columns, strict=True)))


def _shares(belief: PredictiveInputs, at_fraction: float, samples: int, seed: int) -> tuple[Contribution, ...]:
    """Each uncertainty by itself; a payload's final speed is taken at the end, another's at the fraction."""
    found = []
    place_m = np.array([at_fraction * belief.trial.length_m])
    for one in belief.uncertainties:
        runs = run(belief, place_m, samples, seed, only=[one.name], with_tension=False)
        loaded = told_by_payload(belief.trial)
        speed = belief.trial.travel_ratio * runs.end_lead_velocity_m_s if loaded else runs.lead_velocity_m_s[:, 0]
        low, _, high = band(speed)
        found.append(Contribution(one.name, one.words, float(low), float(high)))
    return tuple(sorted(found, key=lambda share: share.low - share.high))
