"""What does not change during a fit, and the state from which it begins: priors, bounds, first noise and spreads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import initial_trial_effects

FIRST_SPREADS = (0.01, 0.03)
"""Chosen as a usual batch of vines: one per cent of pressure and three of B."""

EXACT_PART = 2e-6
"""Least noise, as part of a trial's travel: the integrator is no better. Measured: the integrator errs by at most 7e-7
(benchmarks/integrator.py)."""

RELEASE_PRIOR_FRAMES, ORIGIN_PRIOR_SIGMAS = 10.0, 10.0
"""Where the rest is seen it says of release and origin what it says through its points, a hundred times less a second
time: that only counts where a wrong model would drag both along. Chosen: ten standard deviations make the prior a
hundredth of what the frames say."""

KNOWN_RELEASE_S = 1e-6
"""The release of a vine whose pressure was let in while it was recorded: nothing to find. Chosen far below any
frame."""

FEWEST_TO_SPARE = 3
"""A spread is estimated where this many more trials feel it than there are numbers without a prior. Chosen: with fewer
degrees of freedom a variance is known to worse than a factor of two."""


def make_problem(predictor: Predictor, trial_effects: Floats) -> MixedProblem:
    """What stays the same during the iterations; `own` holds the first guess of releases and origins.

    Parameters
    ----------
    predictor : of the trials to fit.
    trial_effects : array, shape (n_trials, 4)
        First guess of releases and origins.

    Returns
    -------
    MixedProblem
    """
    layout, data = predictor.layout, predictor.data
    lower, upper = layout.bounds
    durations = np.array([trial_data.time_s[-1] - trial_data.time_s[0] for trial_data in data])
    spans = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
    frames = np.array([trial_data.frame_s for trial_data in data])
    rests = np.array([trial_data.shows_rest for trial_data in data])
    known = rests | np.array([trial_data.pressurised_in_recording for trial_data in data])
    vague = np.array(
        [0.0 if trial_data.imprecise_rest is None else trial_data.imprecise_rest.sigma_m for trial_data in data]
    )
    release_sd = np.where(rests, RELEASE_PRIOR_FRAMES * frames, 3 * durations)
    release_sd[[trial_data.pressurised_in_recording for trial_data in data]] = KNOWN_RELEASE_S
    noise = np.array([trial_data.noise_m for trial_data in data])
    room = np.maximum(ORIGIN_PRIOR_SIGMAS * np.maximum(noise, vague), 1e-4 * spans)
    origin_sd = np.where(rests, room, 3 * spans)
    return MixedProblem(
        index=layout.index,
        has_deviation=np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation]),
        gauge_error=np.array([trial_data.gauge_error for trial_data in data]),
        release_origin_mean=np.where(known[:, None], initial_trial_effects(data)[:, :2], trial_effects[:, :2]),
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
    """A state to begin from: noise of the tracks alone, spreads as the sheet and experience say.

    Parameters
    ----------
    data : sequence of FitTrial
    theta : array, shape (n_free,)
        Numbers to begin from, scaled.
    trial_effects : array, shape (n_trials, 4)
        Trial effects to begin from.

    Returns
    -------
    FitState
    """
    rho = track_correlation(data)
    variance = np.array([trial_data.noise_m**2 * (1 - trial_data.correlation**2) for trial_data in data])
    return FitState(theta, trial_effects, _stated_spreads(data), rho, np.maximum(variance, variance_floor(data)))


def track_correlation(data: Sequence[FitTrial]) -> float:
    """Lag-one correlation of the noise as the tracks alone show it.

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    float
        Mean over trials, weighted by points.
    """
    return float(
        np.average(
            [trial_data.correlation for trial_data in data], weights=[trial_data.time_s.size for trial_data in data]
        )
    )


def _stated_spreads(data: Sequence[FitTrial]) -> tuple[float, float]:
    """Spread of pressure that the sheet states, and 3 % for B."""
    relative = [
        trial_data.trial.pressure_sigma_Pa / trial_data.trial.pressure_Pa
        for trial_data in data
        if trial_data.trial.pressure_Pa > 0 and np.isfinite(trial_data.trial.pressure_sigma_Pa)
    ]
    return (float(np.mean(relative)) if relative else FIRST_SPREADS[0]), FIRST_SPREADS[1]


def variance_floor(data: Sequence[FitTrial]) -> Floats:
    """Least variance of a position that the integrator can answer for, m², shape (n_trials,).

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    array, shape (n_trials,), m²
    """
    return np.array([(EXACT_PART * np.ptp(trial_data.lead_position_m)) ** 2 for trial_data in data])


def estimable(problem: MixedProblem) -> tuple[bool, bool]:
    """Whether there are trials enough to estimate the spread of pressure, and that of B.

    Parameters
    ----------
    problem : what does not change during the fit.

    Returns
    -------
    (bool, bool)
    """
    needed = np.count_nonzero(problem.prior_precision == 0) + FEWEST_TO_SPARE
    varied = problem.has_deviation & np.column_stack(
        [problem.gauge_error == 0, np.ones(problem.gauge_error.size, dtype=bool)]
    )
    pressure, damping = (bool(np.count_nonzero(varied[:, k]) >= needed) for k in range(2))
    return pressure, damping
