"""Figures of the report for objects in memory and for results folders, by name in the registry."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.diagnosis.ladder import Comparison
from vinetrack.diagnosis.power import Power
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.figures.prediction_figures import draw_power
from vinetrack.figures.registry import campaign_figures, draw
from vinetrack.inference.fit_result import Fit
from vinetrack.interface.loaded import LoadedResults
from vinetrack.results.folder_layout import ResultsError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.figures.diagnosis_figures import DiagnosisTables


def figure_of(shown: Any, name: str = "", *, trial: str = "") -> Figure:
    """Draw an object of the Python interface as in the report.

    Parameters
    ----------
    shown : loaded results, a fit, a comparison, a diagnosis or a power.
    name : name of the figure; blank for the main figure of the object.
    trial : name of the trial, for figures of one trial.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ResultsError
        If the object has no such figure.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False)
    >>> type(fit.plot("model_residuals")).__name__
    'Figure'
    """
    if isinstance(shown, LoadedResults):
        return _results_figure(shown, name, trial)
    if isinstance(shown, Fit):
        from vinetrack.interface.calls import compare

        shown = compare(shown)
    if isinstance(shown, Power):
        return _with_content(draw_power(shown), "power")
    if isinstance(shown, Comparison):
        return _draw_figure(_comparison_tables(shown), name or "model_comparison")
    return _draw_figure(_tables_in_memory(shown) if shown.rounds else None, name)


def _draw_figure(tables: Any, name: str = "") -> Figure:
    """Draw a figure, or the first with content."""
    known = {one: entry for one, entry in campaign_figures().items() if all(hasattr(tables, t) for t in entry.reads)}
    names = [name] if name else list(known)
    return _with_content(next((drawn for one in names if one in known and (drawn := draw(one, tables))), None), name)


def _with_content(drawn: Figure | None, name: str) -> Figure:
    if drawn is None:
        names = ", ".join(campaign_figures())
        raise ResultsError(f"There is no figure {name!r} with content; figures are {names}, trial_motion and power.")
    return drawn


def _comparison_tables(shown: Comparison) -> SimpleNamespace:
    from vinetrack.figures.registry import label_conditions

    table = label_conditions(shown.table, _condition_labels([compared.trial for compared in shown.trials]))
    return SimpleNamespace(comparison=table, trajectories=dict(shown.trajectories))


def _condition_labels(trials: list[Trial]) -> Any:
    import pandas as pd

    from vinetrack.figures.registry import describe_conditions

    rows = pd.DataFrame(
        {
            "trial": [trial.name for trial in trials],
            "vine": [trial.vine for trial in trials],
            "condition": [trial.condition for trial in trials],
            "status": "ok",
        }
    )
    return describe_conditions(rows, tuple(trials))


def _tables_in_memory(shown: Diagnosis) -> DiagnosisTables:
    import pandas as pd

    from vinetrack.diagnosis.drift import drift_groups
    from vinetrack.diagnosis.ladder import in_sample
    from vinetrack.figures.diagnosis_figures import CURVE_COLUMNS, assemble_tables

    nothing = pd.DataFrame()
    if not shown.fits:
        curves = pd.DataFrame(columns=list(CURVE_COLUMNS))
        return assemble_tables(shown, _condition_labels([]), curves, nothing, nothing, nothing)
    before, after = shown.fits[0], shown.fits[-1]
    final = {motion.name: motion for motion in in_sample(after).trials} if after is not before else {}
    parts = []
    for motion in in_sample(before).trials:
        final_m = final[motion.name].predicted_position_m if final else np.full(motion.time_s.size, math.nan)
        positions = (motion.lead_position_m, motion.predicted_position_m, final_m)
        columns = (
            motion.name,
            motion.trial.condition,
            motion.time_s - motion.release_s,
            *(y - motion.origin_m for y in positions),
        )
        parts.append(pd.DataFrame(dict(zip(CURVE_COLUMNS, columns, strict=True))))
    located, drifting = nothing, nothing
    if shown.failure is not None:
        located = shown.failure.along_position
        drifting = drift_groups(shown.failure.drift, after if final else None)
    force = nothing if shown.force_table is None else shown.force_table
    conditions = _condition_labels([fitted.trial for fitted in before.trials])
    trials = pd.concat(parts, ignore_index=True)
    return assemble_tables(shown, conditions, trials, located, drifting, force, shown.learned_table)


def _results_figure(shown: LoadedResults, name: str, trial: str) -> Figure:
    from vinetrack.figures.registry import FigureTables
    from vinetrack.pipeline.trials import draw_trial

    trials: tuple[Trial, ...] = ()
    try:
        trials = shown.experiment.trials
    except Exception as error:  # without the sheet, the figures have simpler labels
        if name == "trial_motion":
            raise ResultsError(f"{error}") from None
    tables = FigureTables(shown.folder, trials)
    if name == "trial_motion":
        names = list(shown.trials["trial"])
        if trial not in names:
            raise ResultsError(f"There is no trial {trial!r}; there are {', '.join(names)}.")
        stated = next((row for row in trials if row.name == trial), None)
        return _with_content(draw_trial(tables.results, stated, trial), name)
    return _draw_figure(tables, name or ("ladder" if len(tables.ladder) else "damping_law"))
