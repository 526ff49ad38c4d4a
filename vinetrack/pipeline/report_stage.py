"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.experiment.provenance import describe_run
from vinetrack.figures.registry import FigureTables, RegisteredFigure, campaign_figures, draw, figures_of
from vinetrack.pipeline.workflow import SHARED_FILES, input_files
from vinetrack.results.folder_layout import Results, ResultsError, read_fit, read_json, read_result
from vinetrack.results.folder_layout import read_diagnosis as stored_diagnosis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.effects import Effect
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings
    from vinetrack.figures.diagnosis_figures import DiagnosisTables
    from vinetrack.report.build import Clip, ReportContent, ReportFigure, ReportSection, TrackedRecording
    from vinetrack.report.section import DiagnosisResult


# ------------------------------------------------------------------------------
# Figures of a results folder: one per trial, and those of the whole experiment.

log = logging.getLogger(__name__)


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


def _write(figure: Figure, path: Callable[[str], Path], settings: FigureSettings) -> None:
    from vinetrack.figures.style import render

    for form, data in render(figure, settings.formats, settings.dpi).items():
        write_bytes(path(f".{form}"), data)


# ------------------------------------------------------------------------------
# Comparison of a results folder with the published numbers and figures: `paper.csv`, figures, and their tables.


def compare_with_paper(experiment: Experiment, folder: Path) -> pd.DataFrame:
    """Write `paper.csv` and the tables of the figures; return `paper.csv` as written."""
    from vinetrack.paper import rows as paper

    kind = experiment.settings.published
    if kind is None:
        raise ResultsError("experiment.yaml has no key `published`: set it to `simulated` or `measured`")
    results = Results(folder)
    mark = paper.SIMULATED if kind == "simulated" else paper.MEASURED
    tables = _tables(experiment, results)
    results_given = _experiment_results(mark, results, tables)
    rows = [
        *paper.protocol_rows(experiment.trials, read_result(results.steady), mark),
        *paper.result_rows(results_given),
        *paper.computed_rows(),
        *paper.theory_rows(experiment.trials),
    ]
    table = paper.as_table(rows)
    for name, table_of_figure in tables.items():
        write_csv(folder / f"{name}.csv", table_of_figure)
    write_csv(folder / "paper.csv", table)
    for mark in paper.MARKS:
        log.info("%s: %d rows", mark, int((table["mark"] == mark).sum()))
    return table


def _tables(experiment: Experiment, results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables of all figures, by file name."""
    from vinetrack.paper import motions

    trials = experiment.trials
    positions, speeds = motions.position_conditions(trials), motions.speed_conditions(trials)
    starts = {
        name: motions.Rest(fitted_trial.release_s, fitted_trial.origin_m)
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
        "paper_departures": motions.departure_table(payloads_g),
        "paper_motions": motions.motion_table(),
        "paper_means": motions.mean_motions(positions, kinematics, rests),
        "paper_positions": motions.position_errors(positions, kinematics, rests),
        "paper_pressures": motions.pressure_table(),
        "paper_speeds": motions.final_speeds(speeds, kinematics, rests),
        "paper_speed_curves": motions.speed_curves(speeds),
    }


def draw_paper(folder: Path, settings: FigureSettings) -> None:
    """Draw the figures of the comparison from the tables of `compare_with_paper`."""
    from vinetrack.figures.style import blank

    tables = FigureTables(folder, ())
    for name in figures_of("paper"):
        drawn = draw(name, tables) or blank("No trial of this experiment is compared with this figure.")
        _write(drawn, partial(Results(folder).figure, name), settings)


def _experiment_results(mark: str, results: Results, tables: Mapping[str, pd.DataFrame]) -> Any:
    from vinetrack.paper.rows import ExperimentResults

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
    from vinetrack.report.build import ModelResult, ReportContent

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
        trial_figures={name: picture for name in drawn if (picture := _picture(partial(results.trial_figure, name)))},
        recordings={name: _recording(results, name) for name in filmed},
        clips={name: f"overlays/{name}.mp4" for name in filmed if results.overlay(name).exists()},
        clip=_clip(results, tables.diagnosed, trials),
        model=ModelResult(
            read_fit(results),
            read_result(results.comparison),
            read_result(results.model_check),
            stored_diagnosis(results),
        ),
        diagnosis=read_diagnosis_section(results, experiment),
        sections=[_paper_section(tables)] if experiment.settings.published else [],
        notes=experiment.blank_notes,
    )


def read_diagnosis_section(results: Results, experiment: Experiment) -> DiagnosisResult | None:
    """Return the content of the report's section on the diagnosis; None if there is no diagnosis."""
    from vinetrack.report.section import DiagnosisResult

    diagnosis = stored_diagnosis(results)
    if diagnosis is None:
        return None
    paths = (results.diagnosed("moved.csv"), results.diagnosed("damping_laws.csv"))
    moved, laws = (table if path.exists() and len(table := read_result(path)) else None for path in paths)
    reported = [*diagnosis.effects, *diagnosis.answer_set]
    effects = _effects([*reported, *(row.effect for ranked in diagnosis.rounds for row in ranked.ranking)], experiment)
    return DiagnosisResult(
        diagnosis,
        diagnosis.ladder,
        moved,
        laws,
        {name: effects[name].summary for name in reported if name in effects},
        {f"{name}.{p.name}": (p.symbol, p.unit) for name, effect in effects.items() for p in effect.parameters},
    )


def _effects(names: Sequence[str], experiment: Experiment) -> dict[str, Effect]:
    """Return effects by name, without those whose file no longer exists."""
    from vinetrack.effects import EffectError, find_effect, own_effects

    try:
        user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    except EffectError:
        user_effects = {}
    effects = {}
    for name in dict.fromkeys(names):
        with contextlib.suppress(EffectError):
            effects[name] = find_effect(name, user_effects)
    return effects


def _provenance(experiment: Experiment, settings: Mapping[str, Any]) -> dict[str, Any]:
    inputs = [path for path in input_files(experiment) if path.exists() or path.name not in SHARED_FILES]
    return describe_run(experiment.folder, inputs, dict(settings), experiment.settings.model)


def _paper_section(tables: FigureTables) -> ReportSection:
    from vinetrack.report.section import paper_section

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
