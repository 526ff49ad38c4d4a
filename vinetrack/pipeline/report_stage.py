"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.effects import EffectError, catalogue, own_effects
from vinetrack.experiment.folder import Experiment, describe_run
from vinetrack.experiment.settings import FigureSettings
from vinetrack.figures.diagnosis_figures import DiagnosisTables
from vinetrack.figures.registry import FigureTables, RegisteredFigure, campaign_figures, draw, figures_of
from vinetrack.figures.style import blank, render
from vinetrack.paper import rows as paper
from vinetrack.paper.motions import comparison_tables
from vinetrack.pipeline.overlays_stage import draw_overlays
from vinetrack.pipeline.stages import Job, map_unordered
from vinetrack.pipeline.workflow import SHARED_FILES, input_files
from vinetrack.report.build import (
    Clip,
    ReportContent,
    ReportFigure,
    ReportSection,
    TrackedRecording,
    build_report,
    paper_section,
    tally,
)
from vinetrack.results.folder_layout import Results, read_diagnosis, read_fit, read_json, read_result

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial


log = logging.getLogger(__name__)

# ------------------------------------------------------------------------------
# Figures of the whole experiment.


def draw_campaign(job: Job) -> list[str]:
    """Draw the figures of the whole experiment that have content; remove those of an earlier run."""
    job.say("drawing figures")
    import_module("matplotlib.backends.backend_svg")  # once, before processes are forked
    shares = [list(campaign_figures())[first :: job.threads] for first in range(job.threads)]
    work = partial(_drawn, folder=job.results, trials=job.experiment.trials, settings=job.settings.figures)
    return [f"{sum(map_unordered(work, shares, job.threads))} figures."]


def _drawn(names: Sequence[str], folder: Path, trials: tuple[Trial, ...], settings: FigureSettings) -> int:
    """Draw figures of the whole experiment from tables that are read once; how many have content."""
    tables, count = FigureTables(folder, trials), 0
    for name in names:
        for form in ("png", "svg", "pdf"):
            tables.results.figure(name, f".{form}").unlink(missing_ok=True)
        if picture := draw(name, tables):
            _write(picture, partial(tables.results.figure, name), settings)
            count += 1
    return count


def _write(figure: Figure, path: Callable[[str], Path], settings: FigureSettings) -> None:
    for form, data in render(figure, settings.formats, settings.dpi).items():
        write_bytes(path(f".{form}"), data)


# ------------------------------------------------------------------------------
# Comparison of a results folder with the published numbers and figures: `paper.csv`, figures, and their tables.


def compare_with_paper(job: Job) -> list[str]:
    """Write `paper.csv`, and the tables and figures of the comparison."""
    experiment, results = job.experiment, Results(job.results)
    mark = paper.SIMULATED if experiment.settings.published == "simulated" else paper.MEASURED
    fit = read_fit(results)
    tables = comparison_tables(experiment.trials, fit, lambda name: read_result(results.kinematics(name)))
    measured = paper.ExperimentResults(
        mark=mark,
        damping=read_json(results.damping),
        scaling=read_json(results.scaling),
        conditions=read_result(results.conditions),
        fit=fit,
        positions=tables["paper_positions"],
        speeds=tables["paper_speeds"],
        departures=tables["paper_departures"],
    )
    rows = [
        *paper.protocol_rows(experiment.trials, read_result(results.steady), mark),
        *paper.result_rows(measured),
        *paper.computed_rows(),
        *paper.theory_rows(experiment.trials),
    ]
    table = paper.as_table(rows)
    for name, content in {**tables, "paper": table}.items():
        write_csv(results.folder / f"{name}.csv", content)
    for mark in paper.MARKS:
        log.info("%s: %d rows", mark, int((table["mark"] == mark).sum()))
    shown = FigureTables(results.folder, ())
    for name in figures_of("paper"):
        drawn = draw(name, shown) or blank("No trial of this experiment is compared with this figure.")
        _write(drawn, partial(results.figure, name), job.settings.figures)
    return [f"Comparison with the paper: {tally(table)}"]


MAX_SVG_BYTES = 1_500_000  # Chosen: a tenth of the 15 MB that a report may have


def write_report(job: Job) -> list[str]:
    """Draw what the report shows, and write `provenance.json` and `report.html`."""
    lines = [*draw_overlays(job), *draw_campaign(job)]
    lines += compare_with_paper(job) if job.experiment.settings.published else []
    job.say("writing the report")
    results = Results(job.results)
    settings = job.settings.model_dump(mode="json", exclude={"experiment", "results"})
    content = report_content(job.experiment, job.results, settings)
    page = build_report(content)
    write_json(results.provenance, dict(content.provenance))
    write_text(results.report, page)
    return [*lines, f"Report: {results.report}"]


def report_content(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> ReportContent:
    """Collect the content of the report from a results folder."""
    results, tables = Results(folder), FigureTables(folder, experiment.trials)
    trials, diagnosis = read_result(results.trials), read_diagnosis(results)
    drawn = [name for name in trials["trial"] if results.kinematics(name).exists()]
    filmed = [trial.name for trial in experiment.trials if trial.video is not None and trial.name in drawn]
    inputs = [path for path in input_files(experiment) if path.exists() or path.name not in SHARED_FILES]
    paper: list[ReportSection] = []
    if experiment.settings.published:
        figures = _figures(tables, figures_of("paper").values(), diagnosis)
        paper = [paper_section(tables.paper, tables.paper_departures, figures)]
    known = dict(catalogue())
    with contextlib.suppress(EffectError):  # the file of an effect may no longer exist
        known |= own_effects([experiment.folder / path for path in experiment.settings.effects])
    return ReportContent(
        name=experiment.name,
        trials=trials,
        windows=read_result(results.steady),
        damping=read_json(results.damping),
        provenance=describe_run(experiment.folder, inputs, dict(settings), experiment.settings.model),
        kinematics={name: read_result(results.kinematics(name)) for name in drawn},
        figures=_figures(tables, campaign_figures().values(), diagnosis),
        trial_figures={name: picture for name in drawn if (picture := _picture(partial(results.trial_figure, name)))},
        recordings={
            name: TrackedRecording(
                strip=_picture(partial(results.strip_figure, name)),
                flags=read_result(results.track(name))["flag"].tolist(),
                calibration=read_json(results.analysed(name)).get("calibration"),
            )
            for name in filmed
        },
        clips={name: f"overlays/{name}.mp4" for name in filmed if results.overlay(name).exists()},
        clip=_clip(results, tables.diagnosed, trials),
        fit=read_fit(results),
        comparison=read_result(results.comparison),
        check=read_result(results.model_check),
        diagnosis=diagnosis,
        moved=_table_of(results, "moved.csv"),
        laws=_table_of(results, "damping_laws.csv"),
        effects=known,
        sections=paper,
        notes=experiment.blank_notes,
    )


def _table_of(results: Results, name: str) -> pd.DataFrame | None:
    """A table of the diagnosis; None if it wrote none."""
    return read_result(path) if (path := results.diagnosed(name)).exists() else None


def _picture(path: Callable[[str], Path]) -> str | bytes:
    """Return a figure for the page: its SVG, or its PNG if there is none or it is too large; empty if there is none."""
    svg, png = path(".svg"), path(".png")
    if svg.exists() and svg.stat().st_size <= MAX_SVG_BYTES:
        return svg.read_text(encoding="utf-8")
    return png.read_bytes() if png.exists() else b""


def _figures(
    tables: FigureTables, figures: Iterable[RegisteredFigure], diagnosis: Diagnosis | None
) -> list[ReportFigure]:
    """Return the drawn figures with their data: a file of the results, or a table of its own with five digits."""
    shown = []
    for one in figures:
        if picture := _picture(partial(tables.results.figure, one.name)):
            name, data = one.data, ""
            if "." in name:
                data = (tables.results.folder / name).read_text(encoding="utf-8")
            elif name:
                data = getattr(tables, name).to_csv(index=False, float_format="%.5g", lineterminator="\n")
                name = f"{one.name}.csv"
            refuted = one.if_refuted if diagnosis is not None and diagnosis.refutes else ""
            caption = f"{one.caption} {refuted}".strip()
            shown.append(ReportFigure(one.name, one.title, caption, picture, name, data))
    return shown


def _clip(results: Results, diagnosed: DiagnosisTables | None, trials: pd.DataFrame) -> Clip | None:
    """Return the clip for the page: of the condition that the model predicts worst if it has one, else the first."""
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
