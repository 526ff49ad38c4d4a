"""The constant part of a fit (priors, bounds) and its initial state (noise, between-trial standard deviations)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import initial_trial_effects

FIRST_SPREADS = (0.01, 0.03)  # Initial between-trial standard deviations of pressure (relative) and ln B (chosen)

# Least noise, relative to a trial's travel, because the integrator is not more accurate (measured)
INTEGRATOR_ERROR = 2e-6

# Prior standard deviations of release, frames, and of origin, in standard deviations of the noise (chosen)
RELEASE_PRIOR_FRAMES, ORIGIN_PRIOR_SIGMAS = 10.0, 10.0

# Prior standard deviation of the release of a vine that was pressurised during the recording: it is known (chosen)
KNOWN_RELEASE_S = 1e-6

# A between-trial standard deviation is estimated where it applies to this many more trials than there are parameters
# without a prior (chosen)
FEWEST_TO_SPARE = 3


def make_problem(predictor: Predictor, trial_effects: Floats) -> MixedProblem:
    """The constant part of a fit. Shapes: trial_effects (n_trials, 4)."""
    layout, data = predictor.layout, predictor.data
    lower, upper = layout.bounds
    durations = np.array([trial_data.time_s[-1] - trial_data.time_s[0] for trial_data in data])
    spans = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
    frames = np.array([trial_data.frame_s for trial_data in data])
    rests = np.array([trial_data.shows_rest for trial_data in data])
    release_known = rests | np.array([trial_data.pressurised_in_recording for trial_data in data])
    rest_sigma_m = np.array(
        [0.0 if trial_data.imprecise_rest is None else trial_data.imprecise_rest.sigma_m for trial_data in data]
    )
    release_sd = np.where(rests, RELEASE_PRIOR_FRAMES * frames, 3 * durations)
    release_sd[[trial_data.pressurised_in_recording for trial_data in data]] = KNOWN_RELEASE_S
    noise = np.array([trial_data.noise_m for trial_data in data])
    origin_room_m = np.maximum(ORIGIN_PRIOR_SIGMAS * np.maximum(noise, rest_sigma_m), 1e-4 * spans)
    origin_sd = np.where(rests, origin_room_m, 3 * spans)
    return MixedProblem(
        index=layout.index,
        has_deviation=np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation]),
        gauge_error=np.array([trial_data.gauge_error for trial_data in data]),
        release_origin_mean=np.where(release_known[:, None], initial_trial_effects(data)[:, :2], trial_effects[:, :2]),
        release_origin_precision=np.column_stack([1 / release_sd**2, 1 / origin_sd**2]),
        prior_mean=layout.start,
        prior_precision=layout.prior_precision,
        lower=lower,
        upper=upper,
        free=np.ones(lower.size, dtype=bool),
        points=np.array([float(trial_data.time_s.size) for trial_data in data]),
        stretches=np.array([float(np.count_nonzero(trial_data.first)) for trial_data in data]),
        random=layout.random if layout.between else None,
    )


def first_state(data: Sequence[FitTrial], theta: Floats, trial_effects: Floats) -> FitState:
    """Initial state: noise of the tracks alone, between-trial standard deviations as stated in the sheet or typical.
    Shapes: theta (n_free,); trial_effects (n_trials, 4).
    """
    rho = track_correlation(data)
    variance = np.array([trial_data.noise_m**2 * (1 - trial_data.correlation**2) for trial_data in data])
    return FitState(
        theta, trial_effects, _stated_between_trial_sd(data), rho, np.maximum(variance, variance_floor(data))
    )


def track_correlation(data: Sequence[FitTrial]) -> float:
    """Lag-one correlation of the noise, estimated from the tracks without a model. Returns mean over trials, weighted
    by points.
    """
    return float(
        np.average(
            [trial_data.correlation for trial_data in data], weights=[trial_data.time_s.size for trial_data in data]
        )
    )


def _stated_between_trial_sd(data: Sequence[FitTrial]) -> tuple[float, float]:
    """Between-trial standard deviation of pressure as the sheet states it, and the typical one of ln B."""
    relative = [
        trial_data.trial.pressure_sigma_Pa / trial_data.trial.pressure_Pa
        for trial_data in data
        if trial_data.trial.pressure_Pa > 0 and np.isfinite(trial_data.trial.pressure_sigma_Pa)
    ]
    return (float(np.mean(relative)) if relative else FIRST_SPREADS[0]), FIRST_SPREADS[1]


def variance_floor(data: Sequence[FitTrial]) -> Floats:
    """Least variance of the noise of each trial, given the accuracy of the integrator. Shape (n_trials,)."""
    return np.array([(INTEGRATOR_ERROR * np.ptp(trial_data.lead_position_m)) ** 2 for trial_data in data])


def estimable(problem: MixedProblem) -> tuple[bool, bool]:
    """Whether there are enough trials to estimate the between-trial standard deviations of pressure and of ln B.
    Returns (bool, bool).
    """
    needed = np.count_nonzero(problem.prior_precision == 0) + FEWEST_TO_SPARE
    has_estimated_sd = problem.has_deviation & np.column_stack(
        [problem.gauge_error == 0, np.ones(problem.gauge_error.size, dtype=bool)]
    )
    pressure, damping = (bool(np.count_nonzero(has_estimated_sd[:, k]) >= needed) for k in range(2))
    return pressure, damping
