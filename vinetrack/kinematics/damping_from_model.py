"""The damping law once more, with the pressure along the way that a fitted model gives.

A chamber that runs down lets the speed sag: no window is then steady with the pressure that was set, or the force in it
is too large and n and B are wrong. Once the model holds what happens to the pressure, the same tracks give the law
anew. Windows that no model is asked for are found once, however many models follow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.records import Track, Trial
from vinetrack.dynamics.model import Model
from vinetrack.effects import EffectError
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.damping import fit_laws, mark_half_steady
from vinetrack.kinematics.summary import TrialError, TrialMotion, damping_point, look_at_motion, steadiness_under

if TYPE_CHECKING:
    import pandas as pd

LAW_COLUMNS = ("model", "method", "vine", "n", "n_low_95", "n_high_95", "B", "B_low_95", "B_high_95", "n_trials")


@dataclass(frozen=True)
class DampingLaw:
    """`points` has a row a trial as `damping_points.csv`, `laws` is `damping.json`.

    `left_out` gives trials that could not be looked at under the model, and why.
    """

    points: pd.DataFrame
    laws: Mapping[str, Any]
    left_out: Mapping[str, str]


def look_at_motions(pairs: Iterable[tuple[Trial, Track]], settings: RunSettings | None = None) -> list[TrialMotion]:
    """Find velocity, release and windows of every track; trials with too few points are passed over.

    Parameters
    ----------
    pairs : trial and its track.
    settings : of the run; defaults if None.

    Returns
    -------
    motions, in the order of `pairs`.
    """
    settings, motions = settings or RunSettings(), []
    for trial, track in pairs:
        try:
            motions.append(look_at_motion(trial, track, settings))
        except TrialError:
            continue
    return motions


def redo_damping(model: Model, motions: Sequence[TrialMotion], settings: RunSettings | None = None) -> DampingLaw:
    """Steady windows and the damping law with the pressure that a model gives.

    Parameters
    ----------
    model : a fitted model (`Fit.model`): its effects on the pressure count with their fitted sizes.
    motions : from `look_at_motions`.
    settings : of the run; defaults if None.

    Returns
    -------
    the points of the fit, the laws by method, and the trials left out with the reason.

    Raises
    ------
    ValueError
        If no trial can be looked at under this model.
    """
    import pandas as pd

    settings = settings or RunSettings()
    rows, left_out = [], {}
    for motion in motions:
        try:
            rows.append(damping_point(motion.trial, steadiness_under(motion, model)))
        except EffectError as error:
            left_out[motion.trial.name] = str(error)
    if not rows:
        raise ValueError(
            f"no trial can be looked at under this model: {'; '.join(left_out.values()) or 'there is none'}"
        )
    points = mark_half_steady(pd.DataFrame(rows))
    laws = fit_laws(points, resamples=settings.damping.resamples, seed=settings.damping.seed)
    return DampingLaw(points, laws, left_out)


def law_table(laws: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Laws under several models as one table: a row a model, method and vine, columns `LAW_COLUMNS`; SI.

    Parameters
    ----------
    laws : `DampingLaw.laws`, or `damping.json`, by name of model. A fit that was refused has no row.

    Returns
    -------
    the table.
    """
    import pandas as pd

    rows = [
        (name, method, vine, law["n"], *law["n_95"], vine_law["B"], *vine_law["B_95"], vine_law["n_trials"])
        for name, methods in laws.items()
        for method, law in methods.items()
        for vine, vine_law in law["vines"].items()
    ]
    return pd.DataFrame(rows, columns=list(LAW_COLUMNS))
