"""Monte Carlo check of a planned campaign: simulated with scatter and noise, fitted, compared with the truth.

The standard errors expected from the information of a campaign are a linear estimate. Here every trial has its own
pressure and B, every vine a misread yield pressure, release falls between frames and positions are noisy; then
`vinetrack.fit` fits the campaign as it would a real one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.planning.campaign_information import REST_FRAMES, FilmingPlan
from vinetrack.tracks.position_noise import ar1_noise


@dataclass(frozen=True)
class SimulatedCampaigns:
    """Errors of fits to `campaigns` simulated campaigns: root mean square of the true and of the stated errors. `n_rms`
    and `n_stated` are absolute; `B_rms`, `B_stated` relative, by vine. `covered` is the fraction of all 95 % intervals
    that contain the truth. `failed` counts campaigns that could not be fitted.
    """

    campaigns: int
    n_rms: float
    n_stated: float
    B_rms: dict[str, float]
    B_stated: dict[str, float]
    covered: float
    failed: int

    @property
    def uncertainty(self) -> float:
        """Relative standard error of a root mean square over this number of campaigns."""
        return 1 / math.sqrt(2 * max(self.campaigns, 1))


def simulate_campaign(
    model: Model,
    trials: Sequence[Trial],
    camera: FilmingPlan,
    spreads: tuple[float, float],
    *,
    campaigns: int = 20,
    seed: int = 1,
    watch: Callable[[], None] | None = None,
) -> SimulatedCampaigns:
    """Simulate a campaign several times, fit each, and compare with the truth."""
    fitted_model = replace(model, values={k: v for k, v in model.values.items() if k not in (DAMPING, EXPONENT)})
    rows: list[dict[str, tuple[float, float, bool]]] = []
    failed = 0
    for k in range(campaigns):
        pairs = make(model, trials, camera, spreads, np.random.default_rng([seed, k]))
        try:
            rows.append(_errors(model, fitted_model, pairs))
        except FitError:
            failed += 1
        if watch is not None:
            watch()
    return _summary(rows, failed)


def make(
    model: Model,
    trials: Sequence[Trial],
    camera: FilmingPlan | Sequence[FilmingPlan],
    spreads: tuple[float, float],
    draw: np.random.Generator,
    host: Model | None = None,
) -> list[tuple[Trial, Track]]:
    """Simulate one campaign: its trials as the sheet states them, and their tracks. The camera counts as calibrated:
    positions have no systematic error unless the sheet states one, as in `vinetrack.planning.campaign_information`,
    whose expected errors this checks.
    """
    trials = [
        trial if math.isfinite(trial.position_systematic_m) else replace(trial, position_systematic_m=0.0)
        for trial in trials
    ]
    count = len(trials)
    cameras = [camera] * count if isinstance(camera, FilmingPlan) else list(camera)
    frames_s = np.array([1 / of_trial.capture_fps for of_trial in cameras])
    pressure_factors = 1 + spreads[0] * draw.standard_normal(count)
    misread = {vine: draw.standard_normal() for vine in dict.fromkeys(trial.vine for trial in trials)}
    true_trials = [
        replace(
            trial,
            pressure_Pa=trial.pressure_Pa * float(factor),
            yield_pressure_Pa=max(trial.yield_pressure_Pa + trial.yield_pressure_sigma_Pa * misread[trial.vine], 0.0),
        )
        for trial, factor in zip(trials, pressure_factors, strict=True)
    ]
    theta = np.array([model.parameters_of(trial) for trial in trials])
    theta[:, model.parameter_names.index(DAMPING)] *= np.exp(spreads[1] * draw.standard_normal(count))
    longest_s = [2 * of_trial.longest_s for of_trial in cameras]
    ends = simulate_many(model, true_trials, [np.array([0.0, s]) for s in longest_s], parameters=theta, host=host)
    stop_s = [
        min(end.end_time_s if end.status == "ended" else longest, of_trial.stops_s)
        for end, longest, of_trial in zip(ends, longest_s, cameras, strict=True)
    ]
    release = (REST_FRAMES - draw.uniform(size=count)) * frames_s
    counts = [REST_FRAMES + int(end * of_trial.capture_fps) for end, of_trial in zip(stop_s, cameras, strict=True)]
    times: list[Floats] = [
        np.arange(frames, dtype=float) * frame_s for frames, frame_s in zip(counts, frames_s, strict=True)
    ]
    since_release = [time_s - begin for time_s, begin in zip(times, release.tolist(), strict=True)]
    moved = simulate_many(model, true_trials, since_release, parameters=theta, host=host)
    return [
        (trial, _track(time_s, trajectory.observed_position_m, of_trial, draw))
        for trial, time_s, trajectory, of_trial in zip(trials, times, moved, cameras, strict=True)
    ]


def _track(time_s: Floats, position_m: Floats, camera: FilmingPlan, draw: np.random.Generator) -> Track:
    """Positions with the camera's noise and an arbitrary origin."""
    noise_m = ar1_noise(time_s.size, camera.noise_m, camera.noise_correlation, draw)
    return plain_track(time_s, position_m + noise_m + draw.uniform(-0.05, 0.05))


def _errors(truth: Model, fitted: Model, pairs: Sequence[tuple[Trial, Track]]) -> dict[str, tuple[float, float, bool]]:
    """Error, stated standard error and whether the interval contains the truth, for n and for ln B (`B vine`)."""
    fit_result = fit(fitted, pairs, profile=False)
    names = truth.parameter_names
    rows = {}
    for number in fit_result.numbers:
        if number.key not in (DAMPING, EXPONENT):
            continue
        vine = number.vine or pairs[0][0].vine
        true = float(truth.parameters_for(vine)[names.index(number.key)])
        is_covered = number.low <= true <= number.high
        if number.key == EXPONENT:
            rows["n"] = number.value - true, number.sigma, is_covered
        else:
            rows[f"B {vine}"] = math.log(number.value / true), number.sigma / number.value, is_covered
    return rows


def _summary(rows: Sequence[dict[str, tuple[float, float, bool]]], failed: int) -> SimulatedCampaigns:
    names = list(dict.fromkeys(name for row in rows for name in row))

    def rms(name: str, which: int) -> float:
        values = [row[name][which] for row in rows if name in row]
        return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan

    vines = [name for name in names if name.startswith("B ")]
    covered = [row[name][2] for row in rows for name in row]
    return SimulatedCampaigns(
        campaigns=len(rows),
        n_rms=rms("n", 0),
        n_stated=rms("n", 1),
        B_rms={name[2:]: rms(name, 0) for name in vines},
        B_stated={name[2:]: rms(name, 1) for name in vines},
        covered=float(np.mean(covered)) if covered else math.nan,
        failed=failed,
    )
