"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.experiment.folder import describe_run
from vinetrack.experiment.settings import FigureSettings
from vinetrack.figures.registry import FigureTables, campaign_figures, draw, figures_of
from vinetrack.figures.style import blank, render
from vinetrack.paper import rows as paper
from vinetrack.paper.motions import comparison_tables
from vinetrack.pipeline.overlays_stage import draw_overlays
from vinetrack.pipeline.stages import Job, map_unordered
from vinetrack.pipeline.workflow import SHARED_FILES, input_files
from vinetrack.report.build import build_report, report_content, tally
from vinetrack.results.folder_layout import Results, read_fit, read_json, read_result

if TYPE_CHECKING:
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


def write_report(job: Job) -> list[str]:
    """Draw what the report shows, and write `provenance.json` and `report.html`."""
    lines = [*draw_overlays(job), *draw_campaign(job)]
    lines += compare_with_paper(job) if job.experiment.settings.published else []
    job.say("writing the report")
    experiment, results = job.experiment, Results(job.results)
    settings = job.settings.model_dump(mode="json", exclude={"experiment", "results"})
    inputs = [path for path in input_files(experiment) if path.exists() or path.name not in SHARED_FILES]
    provenance = describe_run(experiment.folder, inputs, settings, experiment.settings.model)
    page = build_report(report_content(experiment, job.results, provenance))
    write_json(results.provenance, provenance)
    write_text(results.report, page)
    return [*lines, f"Report: {results.report}"]
