"""Simulation of trials by a model."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from vinetrack.core.problems import UserError
from vinetrack.core.records import Bend, Floats, Trial
from vinetrack.dynamics.equations import TOO_HARD
from vinetrack.dynamics.kernel import RELATIVE_TOLERANCE, Batch, Trace, lay_out, starts_of
from vinetrack.dynamics.model import Model, base_model, check_needs, host_for
from vinetrack.effects import REFERENCE_TRIAL, Effect, TrialInputs, catalogue


@dataclass(frozen=True)
class Trajectory:
    """Motion of one trial since release; arrays have shape (n_times,), SI. `observed_position_m` is the lead position
    as the camera reports it, which differs if the model has measurement effects.
    """

    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    lead_acceleration_m_s2: Floats
    observed_position_m: Floats
    travel_ratio: float
    status: str
    end_time_s: float
    end_lead_velocity_m_s: float
    n_steps: int
    slack_from_s: float = math.nan

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Speed of the tail while it is taut, shape (n_times,)."""
        return self.travel_ratio * self.lead_velocity_m_s


class SimulationError(UserError, RuntimeError):
    """A trajectory could not be integrated; the message names the trial."""


def simulate(
    model: Model,
    trial: Trial,
    times_s: Floats,
    *,
    trace: Trace | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> Trajectory:
    """Simulate one trial from rest at release.

    Parameters
    ----------
    model : the sum of effects with its values
    trial : the vine and its settings
    times_s : array, shape (n_times,), s since release, increasing; before 0 the vine is at rest
    trace : measured gauge pressure, which replaces the set pressure and the effects in the chamber
    relative_tolerance : local tolerance on the speed

    Returns
    -------
    Trajectory
        At `times_s`.

    Raises
    ------
    EffectError
        If the trial lacks a value that an effect needs.
    SimulationError
        If the integration fails.

    >>> import vinetrack as vt
    >>> trial, _ = vt.tracks_from_frame(vt.example_tracks())[0]
    >>> vt.simulate(vt.base_model(), trial, np.array([0.0, 0.02])).status
    'running'
    """
    return simulate_many(model, [trial], [times_s], traces=[trace], relative_tolerance=relative_tolerance)[0]


def simulate_many(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    host: Model | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> list[Trajectory]:
    """Simulate many trials in one call of the compiled kernel, see `simulate`. Shapes: parameters (n_trials,
    n_parameters).
    """
    batch = prepare(model, trials, times_s, traces=traces, parameters=parameters, host=host)
    out, ends = batch.run(relative_tolerance)
    check_completed(ends, [trial.name for trial in trials])
    return trajectories(batch, out, ends, [trial.travel_ratio for trial in trials])


def trajectories(batch: Batch, out: Floats, ends: Floats, ratios: Sequence[float]) -> list[Trajectory]:
    """The trajectories of a batch that was run."""
    edges = batch.starts.tolist()
    motion = np.ascontiguousarray(out[:, :3].T) / np.repeat(ratios, np.diff(batch.starts))
    # ("running", "ended", "stalled", "too hard"): in the order of the integrator's codes
    return [
        Trajectory(
            time_s=batch.stamps[a:b],
            lead_position_m=motion[0, a:b],
            lead_velocity_m_s=motion[1, a:b],
            lead_acceleration_m_s2=motion[2, a:b],
            observed_position_m=out[a:b, 3],
            travel_ratio=ratio,
            status=("running", "ended", "stalled", "too hard")[int(status)],
            end_time_s=end_s,
            end_lead_velocity_m_s=end_speed / ratio,
            n_steps=int(n_steps),
            slack_from_s=slack_from_s,
        )
        for ratio, (a, b), (status, end_s, end_speed, n_steps, slack_from_s) in zip(
            ratios, itertools.pairwise(edges), ends.tolist(), strict=True
        )
    ]


def check_completed(ends: Floats, names: Sequence[str]) -> None:
    """Raise an error for a trial that the integrator could not complete. Shapes: ends (n_trials, 5)."""
    failed = np.flatnonzero(ends[:, 0] == TOO_HARD)
    if failed.size:
        end_s = float(ends[failed[0], 1])
        raise SimulationError(f"Trial {names[failed[0]]}: the model could not be integrated beyond {end_s:.6g} s.")


def prepare(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    host: Model | None = None,
) -> Batch:
    """Lay out trials for the compiled kernel."""
    check_needs(model, *trials)
    inputs = np.array([TrialInputs.of(trial) for trial in trials], dtype=float).reshape(-1, len(TrialInputs._fields))
    if parameters is None:
        groups = [(trial.vine, trial.group("day")) for trial in trials]
        of_group = {group: model.parameters_for(*group) for group in set(groups)}
        parameters = np.array([of_group[group] for group in groups])
    bends = [bends_of(trial) for trial in trials]
    given = [np.asarray(t, dtype=float) for t in times_s]
    stamps = np.concatenate(given) if given else np.empty(0)
    return lay_out(model, inputs, bends, stamps, starts_of(given), traces=traces, parameters=parameters, host=host)


def bends_of(trial: Trial) -> list[tuple[float, float, float]]:
    """The bends of a trial as numbers."""
    return [(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]


# ------------------------------------------------------------------------------
# Motion of a reference vine with and without one effect: the data of the effect's figure.

REFERENCE_VALUES = {"eversion_damping.B": 6.44, "eversion_damping.n": 0.37}


def _reference(effect: Effect) -> tuple[Trial, Trace | None, str]:
    """The trial in which an effect shows, its measured pressure, and both in words."""
    vine = "24 mm × 200 µm × 400 mm, P_y 3 kPa, B 6.44 N·(s/m)ⁿ, n 0.37, 35.6 g"
    still = f"{vine}, 28 kPa, straight down, chamber 3.7 L, inlet 6 mm"
    if set(effect.functions) == {"rest_force"}:
        level = replace(REFERENCE_TRIAL, growth_angle_rad=math.pi / 2)
        trace = np.array([0.0, 0.15, 0.3, 0.45, 0.6]), np.array([2e3, 9e3, 1e3, 5.9e3, 1e3])
        return level, trace, f"{vine}, horizontal, pressure rising from 2 to 9 kPa, down to 1, up to 5.9 and down again"
    if "trace_time" in effect.functions:
        trace = np.array([0.0, 0.02, 0.15]), np.array([0.0, 28e3, 28e3])
        return REFERENCE_TRIAL, trace, f"{vine}, straight down, a pressure recorded while it rises to 28 kPa in 20 ms"
    if effect.name == "capstan_friction":
        return replace(REFERENCE_TRIAL, bends=(Bend(0.1, 0.1, 0.1),)), None, f"{still}, one radian of bend after 100 mm"
    return REFERENCE_TRIAL, None, still


def reference_words(effect: Effect) -> str:
    """Describe the vine and trial of `effect_motion`, for the caption of a picture."""
    return _reference(effect)[2]


def size_words(effect: Effect) -> str:
    """List the parameters of an effect with their values in `effect_motion`, such as `C_D = 1`."""
    return ", ".join(p.words(REFERENCE_VALUES.get(f"{effect.name}.{p.name}", p.default)) for p in effect.parameters)


def effect_motion(effect: Effect) -> pd.DataFrame:
    """Motion of the reference vine with an effect at its default size and without it. An effect of the base model is
    removed from it, any other is added.
    """
    models = _models(effect)
    trial, trace, _ = _reference(effect)
    # Shortly before the earlier end of growth; to that of the pressure if it is measured.
    grown = [] if trace is not None else [simulate(model, trial, np.linspace(0.0, 2.0, 50)) for model in models]
    end_s = 0.99 * min((motion.end_time_s for motion in grown if motion.status == "ended"), default=0.5 / 0.99)
    times = np.linspace(0.0, end_s if trace is None else float(trace[0][-1]), 400)
    with_m, without_m = (simulate(model, trial, times, trace=trace).observed_position_m for model in models)
    return pd.DataFrame(
        {
            "time_s": times,
            "without_position_m": without_m,
            "with_position_m": with_m,
            "without_velocity_m_s": np.gradient(without_m, times),
            "with_velocity_m_s": np.gradient(with_m, times),
            "difference_m": with_m - without_m,
        }
    )


def _models(effect: Effect) -> tuple[Model, Model]:
    """The base model with an effect and without. Both are the whole catalogue with all other effects at size zero, so
    that one compiled model serves all figures.
    """
    if effect.kind == "base" and not effect.parameters:
        base = base_model().with_values(REFERENCE_VALUES)
        return base, base - effect
    whole = host_for(base_model()) if catalogue().get(effect.name) == effect else base_model() + effect
    nothing = {f"{e.name}.{p.name}": p.zero for e in whole for p in e.parameters if e.kind != "base"}
    none = whole.with_values({**nothing, **REFERENCE_VALUES})
    sizes = {f"{effect.name}.{p.name}": p for p in effect.parameters}
    if effect.kind == "base":
        return none, none.with_values({name: p.zero for name, p in sizes.items()})
    return none.with_values({name: p.default for name, p in sizes.items()}), none
