"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.experiment.provenance import describe_run
from vinetrack.figures.registry import RegisteredFigure, campaign_figures, draw, figures_of
from vinetrack.narrative.diagnosis_text import METHOD_NAMES
from vinetrack.pipeline.diagnosis_stage import DiagnosisTables, read_diagnosis_section, read_diagnosis_tables
from vinetrack.pipeline.tracks_stage import map_trials
from vinetrack.pipeline.workflow import SHARED_FILES
from vinetrack.results.folder_layout import Results, ResultsError, read_fit, read_json, read_result
from vinetrack.results.folder_layout import read_diagnosis as stored_diagnosis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings
    from vinetrack.report.build import Clip, ModelResult, ReportContent, ReportFigure, ReportSection, TrackedRecording


# ------------------------------------------------------------------------------
# Figures of a results folder: one per trial, and those of the whole experiment.

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
    from vinetrack.figures.style import blank

    drawn = _trial_figure(picture, results) or blank(f"{picture.title}: no positions to draw.")
    _write(drawn, partial(results.trial_figure, picture.name), settings)


def _trial_figure(picture: _TrialPicture, results: Results) -> Figure | None:
    from vinetrack.figures.motion_figures import draw_trial_motion

    track, kinematics = read_result(results.track(picture.name)), read_result(results.kinematics(picture.name))
    return draw_trial_motion(picture.title, track, kinematics, picture.windows, picture.travel_ratio)


def draw_trial(folder: Path, trial: Trial | None, name: str) -> Figure | None:
    """Draw position, speed and steady windows of one trial of a results folder."""
    results = Results(folder)
    windows = read_result(results.steady)
    title, ratio = (_describe_trial(trial), trial.travel_ratio) if trial is not None else (name, 2.0)
    return _trial_figure(_TrialPicture(name, title, ratio, windows[windows["trial"] == name]), results)


def draw_campaign(experiment: Experiment, folder: Path, settings: FigureSettings) -> list[str]:
    """Draw the figures of the whole experiment that have content; remove those of an earlier run."""
    results = Results(folder)
    for name in campaign_figures():
        for form in ("png", "svg", "pdf"):
            results.figure(name, f".{form}").unlink(missing_ok=True)
    tables, drawn = FigureTables(folder, experiment.trials), []
    for name in campaign_figures():
        if picture := draw(name, tables):
            _write(picture, partial(results.figure, name), settings)
            drawn.append(name)
            log.info("drew %s", name)
    write_json(results.figure_list, {"figures": drawn})
    return drawn


class FigureTables:
    """The tables of a results folder by the names that figures give them; each is read when a figure first needs it.
    Those of the diagnosis are empty if there is none; those named `paper…` are the files of that name.
    """

    def __init__(self, folder: Path, known: tuple[Trial, ...]) -> None:
        self.results = Results(folder)
        self.known = known

    def __getattr__(self, name: str) -> Any:
        if name.startswith("paper"):
            return read_result(self.results.folder / f"{name}.csv")
        return getattr(self.diagnosed or DiagnosisTables(), name)

    @cached_property
    def damping(self) -> dict[str, Any]:
        """The damping law, `damping.json`."""
        return read_json(self.results.damping)

    @cached_property
    def scaling(self) -> dict[str, Any]:
        """Powers of the size, `scaling.json`."""
        return read_json(self.results.scaling)

    @cached_property
    def points(self) -> pd.DataFrame:
        """Points of the damping law; none counts as used if there is no fit."""
        points = read_result(self.results.points)
        is_fitted = any(self.damping[method]["vines"] for method in METHOD_NAMES)
        return points.assign(used=points["used"] & is_fitted)

    @cached_property
    def trials(self) -> pd.DataFrame:
        """`trials.csv` with pressure and label of the condition."""
        return describe_conditions(read_result(self.results.trials), self.known)

    @cached_property
    def kinematics(self) -> dict[str, pd.DataFrame]:
        """Motion of every trial that is not left out, by name."""
        return {name: read_result(self.results.kinematics(name)) for name in self._names}

    @property
    def _names(self) -> list[str]:
        return self.trials.loc[self.trials["status"] != "left_out", "trial"].tolist()

    @property
    def subpixel_px(self) -> np.ndarray:
        """Positions of all edges within a pixel."""
        from vinetrack.figures.overlay import subpixel_positions

        return subpixel_positions({name: read_result(self.results.track(name)) for name in self._names})

    @cached_property
    def comparison(self) -> pd.DataFrame:
        """`comparison.csv` with vines and labels; a refuted model says so in its name."""
        compared = label_conditions(read_result(self.results.comparison), self.trials)
        diagnosis = stored_diagnosis(self.results)
        if diagnosis is not None and diagnosis.refutes:
            compared = compared.assign(model="refuted initial model: " + compared["model"])
        return compared

    @cached_property
    def trajectories(self) -> dict[str, pd.DataFrame]:
        """Measurement and models by condition, with the final model if effects were added."""
        tables = {name: read_result(self.results.trajectories(name)) for name in self.comparison["condition"]}
        return with_final_model(tables, self.diagnosed)

    @property
    def curves(self) -> pd.DataFrame:
        """Measured and modelled growth of all trials, at most `MAX_CURVE_ROWS` rows at an even stride."""
        return _curves(self.results)

    @cached_property
    def diagnosed(self) -> DiagnosisTables | None:
        """Tables of the diagnosis; None if there is none."""
        return read_diagnosis_tables(self.results, self.trials)


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


# ------------------------------------------------------------------------------
# Comparison of a results folder with the published numbers and figures: `paper.csv`, figures, and their tables.


def compare_with_paper(experiment: Experiment, folder: Path) -> pd.DataFrame:
    """Write `paper.csv` and the tables of the figures; return `paper.csv` as written."""
    from vinetrack.paper.arithmetic import MARKS, MEASURED, SIMULATED, as_table, computed_rows
    from vinetrack.paper.protocol import protocol_rows
    from vinetrack.paper.result_rows import result_rows, theory_rows

    kind = experiment.settings.published
    if kind is None:
        raise ResultsError("experiment.yaml has no key `published`: set it to `simulated` or `measured`")
    results = Results(folder)
    mark = SIMULATED if kind == "simulated" else MEASURED
    tables = _tables(experiment, results)
    results_given = _experiment_results(mark, results, tables)
    rows = [
        *protocol_rows(experiment.trials, read_result(results.steady), mark),
        *result_rows(results_given),
        *computed_rows(),
        *theory_rows(experiment.trials),
    ]
    table = as_table(rows)
    for name, table_of_figure in tables.items():
        write_csv(folder / f"{name}.csv", table_of_figure)
    write_csv(folder / "paper.csv", table)
    for mark in MARKS:
        log.info("%s: %d rows", mark, int((table["mark"] == mark).sum()))
    return table


def _tables(experiment: Experiment, results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables of all figures, by file name."""
    from vinetrack.paper import protocol as comparison
    from vinetrack.paper.arithmetic import departure_table, motion_table, pressure_table

    trials = experiment.trials
    positions, speeds = comparison.position_conditions(trials), comparison.speed_conditions(trials)
    starts = {
        name: comparison.Rest(fitted_trial.release_s, fitted_trial.origin_m)
        for name, fitted_trial in read_fit(results).trials.items()
    }
    rests = {name: start for name, start in starts.items() if math.isfinite(start.release_s + start.origin_m)}
    kinematics = {
        trial.name: read_result(results.kinematics(trial.name))
        for replicates in (*positions.values(), *speeds.values())
        for trial in replicates
        if trial.name in rests
    }
    payloads_g = sorted({round(1e3 * replicates[0].payload_kg, 6) for replicates in speeds.values()})
    return {
        "paper_departures": departure_table(payloads_g),
        "paper_motions": motion_table(),
        "paper_means": comparison.mean_motions(positions, kinematics, rests),
        "paper_positions": comparison.position_errors(positions, kinematics, rests),
        "paper_pressures": pressure_table(),
        "paper_speeds": comparison.final_speeds(speeds, kinematics, rests),
        "paper_speed_curves": comparison.speed_curves(speeds),
    }


def draw_paper(folder: Path, settings: FigureSettings) -> None:
    """Draw the figures of the comparison from the tables of `compare_with_paper`."""
    from vinetrack.figures.style import blank

    tables = FigureTables(folder, ())
    for name in figures_of("paper"):
        drawn = draw(name, tables) or blank("No trial of this experiment is compared with this figure.")
        _write(drawn, partial(Results(folder).figure, name), settings)


def _experiment_results(mark: str, results: Results, tables: Mapping[str, pd.DataFrame]) -> Any:
    from vinetrack.paper.result_rows import ExperimentResults

    return ExperimentResults(
        mark=mark,
        damping=read_json(results.damping),
        scaling=read_json(results.scaling),
        conditions=read_result(results.conditions),
        fit=read_fit(results),
        positions=tables["paper_positions"],
        speeds=tables["paper_speeds"],
        departures=tables["paper_departures"],
    )


MAX_SVG_BYTES = 1_500_000  # Chosen: a tenth of the 15 MB that a report may have
MAX_CURVE_ROWS = 6000  # Largest number of rows of the downloadable curves (chosen)


def write_report(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> Path:
    """Write `provenance.json` and `report.html`; return the path of the report."""
    from vinetrack.report.build import build_report

    results = Results(folder)
    content = report_content(experiment, folder, settings)
    page = build_report(content)
    write_json(results.provenance, dict(content.provenance))
    write_text(results.report, page)
    return results.report


def report_content(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> ReportContent:
    """Collect the content of the report from a results folder."""
    from vinetrack.report.build import ReportContent

    results = Results(folder)
    trials = read_result(results.trials)
    drawn = [name for name in trials["trial"] if results.kinematics(name).exists()]
    filmed = [trial.name for trial in experiment.trials if trial.video is not None and trial.name in drawn]
    tables = FigureTables(folder, experiment.trials)
    return ReportContent(
        name=experiment.name,
        trials=trials,
        windows=read_result(results.steady),
        damping=read_json(results.damping),
        provenance=_provenance(experiment, settings),
        kinematics={name: read_result(results.kinematics(name)) for name in drawn},
        figures=[_figure(tables, figure) for figure in _drawn(results)],
        trial_figures=_trial_figures(results, drawn),
        recordings={name: _recording(results, name) for name in filmed},
        clips={name: f"overlays/{name}.mp4" for name in filmed if results.overlay(name).exists()},
        clip=_clip(results, tables.diagnosed, trials),
        model=_model_result(results),
        diagnosis=read_diagnosis_section(results, experiment),
        sections=[_paper_section(tables)] if experiment.settings.published else [],
        notes=experiment.blank_notes,
    )


def _provenance(experiment: Experiment, settings: Mapping[str, Any]) -> dict[str, Any]:
    inputs = [path for trial in experiment.trials for path in (trial.track, trial.video, trial.pressure_trace) if path]
    target = getattr(experiment.settings.calibration, "image", None)
    inputs += [experiment.folder / target] if target is not None else []
    inputs += [experiment.folder / path for path in experiment.settings.effects]
    shared = [path for name in SHARED_FILES if (path := experiment.folder / name).exists()]
    return describe_run(experiment.folder, dict.fromkeys([*shared, *inputs]), dict(settings), experiment.settings.model)


def _model_result(results: Results) -> ModelResult:
    from vinetrack.report.build import ModelResult

    compared, checked = read_result(results.comparison), read_result(results.model_check)
    return ModelResult(read_fit(results), compared, checked, stored_diagnosis(results))


def _paper_section(tables: FigureTables) -> ReportSection:
    from vinetrack.report.paper_section import paper_section

    figures = [
        _figure(tables, one)
        for one in figures_of("paper").values()
        if _picture(partial(tables.results.figure, one.name))
    ]
    return paper_section(tables.paper, tables.paper_departures, figures)


def _drawn(results: Results) -> list[RegisteredFigure]:
    """Return the figures of the whole experiment that were drawn."""
    names = set(read_json(results.figure_list)["figures"])
    figures = campaign_figures().items()
    return [figure for name, figure in figures if name in names and _picture(partial(results.figure, name))]


def _picture(path: Callable[[str], Path]) -> str | bytes:
    """Return a figure for the page: its SVG, or its PNG if there is none or it is too large; empty if there is none."""
    svg, png = path(".svg"), path(".png")
    if svg.exists() and svg.stat().st_size <= MAX_SVG_BYTES:
        return svg.read_text(encoding="utf-8")
    return png.read_bytes() if png.exists() else b""


def _figure(tables: FigureTables, figure: RegisteredFigure) -> ReportFigure:
    """Return a figure for the page, with its data: a file of the results, or a table of its own."""
    from vinetrack.report.build import ReportFigure

    is_file = "." in figure.data
    data_name = figure.data if is_file else f"{figure.name}.csv" if figure.data else ""
    data = ""
    if figure.data:
        path = tables.results.folder / figure.data
        data = path.read_text(encoding="utf-8") if is_file else _as_csv(getattr(tables, figure.data))
    picture = _picture(partial(tables.results.figure, figure.name))
    diagnosis = stored_diagnosis(tables.results)
    refuted = figure.if_refuted if diagnosis is not None and diagnosis.refutes else ""
    return ReportFigure(figure.name, figure.title, f"{figure.caption} {refuted}".strip(), picture, data_name, data)


def _as_csv(table: pd.DataFrame) -> str:
    """Return a table to download as CSV with five digits, more than a figure can show."""
    return str(table.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _curves(results: Results) -> pd.DataFrame:
    """Return measured and modelled growth of all trials, at most `MAX_CURVE_ROWS` rows at an even stride."""
    import pandas as pd

    conditions = read_result(results.comparison)["condition"]
    parts = [read_result(results.trajectories(name)).assign(condition=name) for name in conditions]
    if not parts:
        return pd.DataFrame()
    whole = pd.concat(parts, ignore_index=True)
    return whole.iloc[:: -(-len(whole) // MAX_CURVE_ROWS)]


def _clip(results: Results, diagnosed: DiagnosisTables | None, trials: pd.DataFrame) -> Clip | None:
    """Return the clip for the page: of the condition that the model predicts worst if it has one, else the first."""
    from vinetrack.report.build import Clip

    with_clip = trials[[results.overlay(name).exists() for name in trials["trial"]]]
    if not len(with_clip):
        return None
    worst = diagnosed.before_after["trial"] if diagnosed is not None and len(diagnosed.before_after) else ()
    chosen = with_clip[with_clip["trial"].isin(worst)] if with_clip["trial"].isin(worst).any() else with_clip
    name = str(chosen["trial"].iloc[0])
    note = " The condition is the one that the model predicts worst." if len(chosen) < len(with_clip) else ""
    edges = "the tracked edge (yellow)"
    if diagnosed is not None:
        edges += ", that of the initial model (vermillion)"
        edges += f", and that with {diagnosed.added} (blue)" if diagnosed.added else ""
    caption = f"The recording, slowed down, with {edges}.{note}"
    path = results.overlay(name)
    return Clip(name, path.read_bytes(), caption, _poster(path))


def _poster(path: Path) -> bytes:
    """Return a frame two thirds into a clip, where models differ visibly, as WebP; empty if it cannot be read."""
    import io

    import av

    try:
        with av.open(str(path)) as container:
            frames = list(container.decode(video=0))
            picture = frames[2 * len(frames) // 3].to_image()
    except av.error.FFmpegError:
        return b""
    file = io.BytesIO()
    picture.save(file, "WEBP", quality=60)
    return file.getvalue()


def _recording(results: Results, name: str) -> TrackedRecording:
    from vinetrack.report.build import TrackedRecording

    return TrackedRecording(
        strip=_picture(partial(results.strip_figure, name)),
        flags=read_result(results.track(name))["flag"].tolist(),
        calibration=read_json(results.analysed(name)).get("calibration"),
    )


def _trial_figures(results: Results, names: list[str]) -> dict[str, str | bytes]:
    return {name: picture for name in names if (picture := _picture(partial(results.trial_figure, name)))}
