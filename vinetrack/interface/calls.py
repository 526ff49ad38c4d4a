"""`vt.fit`, `vt.diagnose`, `vt.power` and `vt.compare` for trials from any source."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from vinetrack.diagnosis.diagnose import diagnose as diagnose_pairs
from vinetrack.diagnosis.ladder import Comparison
from vinetrack.diagnosis.ladder import compare as compare_pairs
from vinetrack.diagnosis.power import Power
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.dynamics.model import Model, make_model
from vinetrack.experiment.folder import Experiment
from vinetrack.inference.fit import fit as fit_pairs
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.interface.loaded import LoadedResults, Source, read_source


def fit(model: Model, source: Source, **options: Any) -> Fit:
    """Fit a model to the trajectories of all trials.

    Parameters
    ----------
    model : a sum of effects.
    source : loaded results, a results folder, an experiment or its folder, a frame of tracks (see
        `tracks_from_frame`), or pairs of trial and track.
    options : options of `vinetrack.inference.fit.fit`, such as `fixed`, `free`, `start` and `tracks`.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If there is nothing to fit, or the model cannot be simulated.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False)
    >>> fit
    Fit(pressure_drive + gravity + eversion_damping + yield_pressure; 8 trials)
    >>> fit.table()["unit"].tolist()
    ['N·(s/m)ⁿ', '1', 'Pa']
    """
    if "tracks" in options:
        return fit_pairs(model, source, **options)  # type: ignore[arg-type]
    given = read_source(source)
    fitted = fit_pairs(model, given.pairs, **options)
    return replace(fitted, left_out={**given.left_out, **fitted.left_out})


def diagnose(source: Fit | Source, **options: Any) -> Diagnosis:
    """Diagnose what a model lacks: verdict, candidates with sizes, errors before and after, next experiment.

    Parameters
    ----------
    source : a fit, whose model is diagnosed, or any source of trials as in `fit`; the model is then that of the
        experiment, else the base model.
    options : options of `vinetrack.diagnosis.diagnose.diagnose`, such as `model`, `candidates`, `ladder` and `advice`.

    Returns
    -------
    Diagnosis

    Raises
    ------
    FitError
        If there is nothing to fit.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> diagnosis = vt.diagnose(vt.example_tracks(), ladder=False, advice=False)
    >>> diagnosis
    Diagnosis(missing: reservoir_depletion)
    >>> diagnosis.candidates().loc[0, ["effect", "status"]].tolist()
    ['reservoir_depletion', 'refitted']
    """
    if isinstance(source, Fit) or "tracks" in options:
        return diagnose_pairs(source, **options)  # type: ignore[arg-type]
    given = read_source(source)
    if given.experiment is None:
        return diagnose_pairs(given.pairs, **options)
    return diagnose_pairs(given.experiment, tracks=given.tracks, **options)


def power(source: Fit | Source, *effects: str, **options: Any) -> Power:
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate.

    Parameters
    ----------
    source : a fit; or a results folder, an experiment's folder, a sheet without recordings, loaded results, a frame of
        tracks, or pairs of trial and track.
    *effects : names, or `name=size` in the unit of the parameter; all by default.
    **options
        Options of `vinetrack.pipeline.power_stage.PowerRequest`: `noise_mm`, `noise_correlation`, `spread_P` and
        `spread_B` (relative), `capture_fps`, `B`, `n`; `simulate`, `jobs`, `first_seed` for complete diagnoses
        of simulated campaigns; `reach`, the probability with which further trials shall detect `name=size`;
        `recommend`, whether to search for the trials that would reveal most.

    Returns
    -------
    Power

    Raises
    ------
    FitError
        If there is nothing to fit.
    ExperimentError, ResultsError
        If the source cannot be read, or there is no such effect.

    Examples
    --------
    >>> import vinetrack as vt
    >>> power = vt.power(vt.example_tracks(), "leak")
    >>> round(power["leak"].probability_at(1.0), 2)
    1.0
    """
    from vinetrack.pipeline.power_stage import PowerRequest, power_of_target

    if isinstance(source, LoadedResults | Experiment):
        source = source.folder
    if isinstance(source, str | Path):
        return power_of_target(PowerRequest(Path(source), effects, **options))
    given = source if isinstance(source, Fit) else read_source(source).pairs
    return power_of_target(PowerRequest(Path("trials"), effects, **options), given)


def compare(fitted: Fit | Source, source: Source | None = None, **options: Any) -> Comparison:
    """Compare a fitted model with the trials, condition by condition, and with the scatter of replicates.

    Parameters
    ----------
    fitted : a fit; or any source of trials, to which the model of the experiment (else the base model) is first fitted.
    source : the trials to compare with, as in `fit`; None for those that the model was fitted to.
    options : options of `vinetrack.diagnosis.ladder.compare`, such as `final_at_fraction` and `tracks`.

    Returns
    -------
    Comparison

    Raises
    ------
    FitError
        If the model cannot be simulated.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> comparison = vt.compare(vt.fit(vt.base_model(), vt.example_tracks(), profile=False))
    >>> list(comparison.table.columns)[:3]
    ['model', 'condition', 'rms_position_m']
    """
    if not isinstance(fitted, Fit):
        given = read_source(fitted)
        fit_of_source = fit_pairs(named_model(given.experiment), given.pairs)
        return compare_pairs(fit_of_source, given.pairs, kinematics=given.kinematics, **options)
    if "tracks" in options:
        return compare_pairs(fitted, source, **options)  # type: ignore[arg-type]
    if source is None:
        if not fitted.pairs:
            raise FitError("The fit does not contain its tracks: pass the trials to compare with.")
        return compare_pairs(fitted, fitted.pairs, **options)
    given = read_source(source)
    return compare_pairs(fitted, given.pairs, **{"kinematics": given.kinematics, **options})


def named_model(experiment: Experiment | None) -> Model:
    """Return the model that an experiment names, including the user's own effects; without one, the base model."""
    from vinetrack.effects import own_effects

    if experiment is None:
        return make_model()
    settings = experiment.settings
    return make_model(settings.model, own_effects([experiment.folder / path for path in settings.effects]))


def example_tracks() -> pd.DataFrame:
    """Return eight trials of one vine from the virtual laboratory, supplied by a chamber of 2 L that depletes.

    Returns
    -------
    DataFrame
        A frame of tracks as `fit`, `diagnose` and `compare` take it: `trial, time_s, lead_position_m` and columns of
        the trial sheet.

    Examples
    --------
    >>> import vinetrack as vt
    >>> vt.example_tracks()["trial"].nunique()
    8
    """
    with (files("vinetrack.interface") / "example_tracks.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)
