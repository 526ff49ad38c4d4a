"""Figures of a results folder: one per trial, and those of the whole experiment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.tables import write_bytes, write_json
from vinetrack.pipeline.pool import map_trials
from vinetrack.results.folder_layout import Results, read_json, read_result
from vinetrack.results.stored_diagnosis import read_diagnosis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings
    from vinetrack.pipeline.diagnosis_tables import DiagnosisTables

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _TrialPicture:
    """Inputs of the figure of one trial, besides its own files."""

    name: str
    title: str
    travel_ratio: float
    windows: pd.DataFrame


def draw_trials(
    experiment: Experiment,
    folder: Path,
    settings: FigureSettings,
    n_workers: int = 1,
    only: Collection[str] | None = None,
) -> int:
    """Draw `figures/trial_<trial>` for every trial that is not left out; return the number of figures."""
    results = Results(folder)
    by_trial = dict(iter(read_result(results.steady).groupby("trial", sort=False)))
    no_windows = read_result(results.steady).iloc[:0]
    trials = {trial.name: trial for trial in experiment.trials}
    pictures = [
        _TrialPicture(
            name,
            _describe_trial(trials[name]) if name in trials else name,
            trials[name].travel_ratio if name in trials else 2.0,
            by_trial.get(name, no_windows),
        )
        for name in experiment.names
        if name not in experiment.left_out and (only is None or name in only)
    ]
    work = partial(_draw_trial, results=results, settings=settings)
    return sum(1 for _ in map_trials(work, pictures, n_workers, "trial figures"))


def _draw_trial(picture: _TrialPicture, results: Results, settings: FigureSettings) -> None:
    _write(_trial_figure(picture, results), partial(results.trial_figure, picture.name), settings)


def _trial_figure(picture: _TrialPicture, results: Results) -> Figure:
    from vinetrack.figures.registry import draw

    track, kinematics = read_result(results.track(picture.name)), read_result(results.kinematics(picture.name))
    return draw("trial_motion", picture.title, track, kinematics, picture.windows, picture.travel_ratio)


def draw_trial(folder: Path, trial: Trial | None, name: str) -> Figure:
    """Draw position, speed and steady windows of one trial of a results folder."""
    results = Results(folder)
    windows = read_result(results.steady)
    title, ratio = (_describe_trial(trial), trial.travel_ratio) if trial is not None else (name, 2.0)
    return _trial_figure(_TrialPicture(name, title, ratio, windows[windows["trial"] == name]), results)


def draw_campaign(experiment: Experiment, folder: Path, settings: FigureSettings) -> list[str]:
    """Draw the figures of the whole experiment that have content; remove those of an earlier run."""
    from vinetrack.figures.registry import CAMPAIGN_FIGURES, draw

    results = Results(folder)
    for name in CAMPAIGN_FIGURES:
        for form in ("png", "svg", "pdf"):
            results.figure(name, f".{form}").unlink(missing_ok=True)
    inputs = campaign_inputs(folder, experiment.trials)
    for name, values in inputs.items():
        _write(draw(name, *values), partial(results.figure, name), settings)
        log.info("drew %s", name)
    write_json(results.figure_list, {"figures": list(inputs)})
    return list(inputs)


def campaign_inputs(folder: Path, known: tuple[Trial, ...]) -> dict[str, tuple[Any, ...]]:
    """Read the data of all figures of a whole experiment. Returns arguments of the drawing function by name of the
    figure, for figures with content.
    """
    from vinetrack.figures.pixel_places import MIN_EDGES, subpixel_positions
    from vinetrack.figures.registry import CAMPAIGN_FIGURES
    from vinetrack.figures.size_figures import PAYLOAD_LINE
    from vinetrack.narrative.law_text import METHOD_NAMES
    from vinetrack.pipeline.diagnosis_tables import read_diagnosis_tables

    results = Results(folder)
    damping, points, trials = read_json(results.damping), read_result(results.points), read_result(results.trials)
    described = describe_conditions(trials, known)
    names = described.loc[described["status"] != "left_out", "trial"]
    moved = {name: read_result(results.kinematics(name)) for name in names}
    places = subpixel_positions({name: read_result(results.track(name)) for name in names})
    in_fit = [vine for method in METHOD_NAMES for vine in damping[method]["vines"]]
    points = points.assign(used=points["used"] & bool(in_fit))
    compared = label_conditions(read_result(results.comparison), described)
    trajectories = {name: read_result(results.trajectories(name)) for name in compared["condition"]}
    scaling, diagnosed = read_json(results.scaling), read_diagnosis_tables(results, described)
    payload, line = read_result(results.payload_model), PAYLOAD_LINE
    diagnosis = read_diagnosis(results)
    if diagnosis is not None and diagnosis.refutes:
        compared = compared.assign(model="refuted initial model: " + compared["model"])
        line = f"refuted initial model, {PAYLOAD_LINE.partition(' and ')[2]}"
    inputs: dict[str, tuple[Any, ...]] = {
        "damping_law": (points, damping) if len(points) else (),
        "exponents": (damping,) if in_fit else (),
        "scaling": (scaling,) if scaling["isometric"] or scaling["thickness"] else (),
        "speed_scaling": (scaling,) if scaling["steady_speed"] else (),
        "efficiency": (scaling,) if scaling["efficiency"] else (),
        "payload_speed": (read_result(results.conditions), payload, "", line) if len(payload) else (),
        "overview": (described, moved) if moved else (),
        "pixel_places": (places,) if len(places) >= MIN_EDGES else (),
        "model_comparison": (compared, with_final_model(trajectories, diagnosed)) if len(compared) else (),
        "model_residuals": (compared, trajectories) if len(compared) else (),
    }
    inputs |= {} if diagnosed is None else figure_inputs(diagnosed)
    return {name: inputs[name] for name in CAMPAIGN_FIGURES if inputs.get(name)}


def _write(figure: Figure, path: Callable[[str], Path], settings: FigureSettings) -> None:
    from vinetrack.figures.style import render

    for form, data in render(figure, settings.formats, settings.dpi).items():
        write_bytes(path(f".{form}"), data)


def _describe_trial(trial: Trial) -> str:
    """Return a title for a trial: name, vine, pressure and payload."""
    return f"{trial.name} · {' · '.join(_features(trial))}"


def _features(trial: Trial) -> list[str]:
    parts = [f"{1e3 * trial.diameter_m:g} mm"]
    if trial.thickness_m == trial.thickness_m:
        parts[0] += f" × {1e6 * trial.thickness_m:.4g} µm"
    if trial.length_m == trial.length_m:
        parts[0] += f" × {1e3 * trial.length_m:.4g} mm"
    parts.append(f"{1e-3 * trial.pressure_Pa:.3g} kPa")
    if trial.payload_kg:
        parts.append(f"{1e3 * trial.payload_kg:.3g} g")
    return parts


def describe_conditions(trials: pd.DataFrame, known: tuple[Trial, ...]) -> pd.DataFrame:
    """Add pressure and a short label of the condition to `trials.csv`, for the panels of the overview."""
    by_name: dict[str, Any] = {trial.name: trial for trial in known}
    labels, pressures = [], []
    for row in trials.itertuples():
        trial = by_name.get(str(row.trial))
        if trial is None:
            labels.append(str(row.condition) or "not readable")
            pressures.append(float("nan"))
            continue
        parts = _features(trial)
        labels.append(", ".join([f"{1e3 * trial.diameter_m:g} mm", *parts[1:]]))
        pressures.append(1e-3 * trial.pressure_Pa)
    return trials.assign(condition_label=labels, pressure_kPa=pressures)


def label_conditions(comparison: pd.DataFrame, described: pd.DataFrame) -> pd.DataFrame:
    """Add vine and label of each condition to `comparison.csv`, sorted by vine and then pressure."""
    first = described.drop_duplicates("condition").set_index("condition")
    vines = {vine: i for i, vine in enumerate(dict.fromkeys(described["vine"]))}
    labelled = comparison[comparison["condition"].isin(first.index)]
    labels = first.loc[labelled["condition"]]
    table = labelled.assign(vine=labels["vine"].to_numpy(), condition_label=labels["condition_label"].to_numpy())
    order = sorted(range(len(table)), key=lambda i: (vines[table["vine"].iloc[i]], labels["pressure_kPa"].iloc[i]))
    return table.iloc[order].reset_index(drop=True)


def figure_inputs(tables: DiagnosisTables) -> dict[str, tuple[Any, ...]]:
    """Return the data of the figures of a diagnosis that have content, by name. Returns arguments of the drawing
    function.
    """
    from vinetrack.figures.registry import DIAGNOSIS_FIGURES
    from vinetrack.pipeline.diagnosis_tables import figure_tables

    inputs: dict[str, tuple[Any, ...]] = {
        "ladder": (tables.ladder,),
        "before_after": (tables.labels.get(tables.worst, tables.worst), tables.before_after, tables.added),
        "where": (tables.where, tables.added),
        "missing_force": (tables.force,),
        "learned_force": (tables.learned,),
        "candidates": (tables.rounds,),
        "cosines": tables.cosines,
        "drift": (tables.drift, tables.added),
    }
    with_content = figure_tables(tables)
    return {name: inputs[name] for name in DIAGNOSIS_FIGURES if name in with_content}


def with_final_model(
    trajectories: Mapping[str, pd.DataFrame], diagnosed: DiagnosisTables | None
) -> dict[str, pd.DataFrame]:
    """Add the predictions of the final model to trajectories, if effects were added. Returns with a column
    `model_after_m`, m, if the table has as many rows as the prediction.
    """
    if diagnosed is None or not diagnosed.added or not len(diagnosed.trials):
        return dict(trajectories)
    final_m = {
        str(trial): part["model_after_m"].to_numpy() for trial, part in diagnosed.trials.groupby("trial", sort=False)
    }
    extended = {}
    for condition, table in trajectories.items():
        parts = [final_m.get(str(trial), np.empty(0)) for trial in dict.fromkeys(table["trial"])]
        after_m = np.concatenate(parts)
        extended[condition] = table.assign(model_after_m=after_m) if after_m.size == len(table) else table
    return extended
