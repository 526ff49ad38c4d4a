"""The command line, which starts quickly and prints no tracebacks.

A problem of the input is reported in one sentence; an internal error in one sentence that names the log with the
traceback.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vinetrack.cli.command_frame import (
    MORE,
    ExperimentPath,
    JsonFile,
    LogPath,
    ResultsPath,
    SettingsText,
    activity_sign,
    errors_as_sentences,
    print_result,
    settings_from_json,
)
from vinetrack.cli.diagnose_commands import register as register_diagnose
from vinetrack.cli.planning_commands import register as register_planning
from vinetrack.cli.start_commands import register as register_start
from vinetrack.core.local_page import THREAD_PREFIX

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment

app = typer.Typer(
    name="vinetrack",
    help="From recordings of everting vine robots to the physics that a model of them lacks.\n\n"
    "Three commands do most: vinetrack setup FOLDER, vinetrack run FOLDER, vinetrack explore RESULTS.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

TrialNames = Annotated[
    str | None, typer.Option("--trials", help="Names of the trials, a JSON list; all by default.", show_default=False)
]
Threads = Annotated[int, typer.Option("--threads", min=1, help="Processes to use.")]


def main() -> None:
    """Entry of the `vinetrack` command."""
    try:
        app()
    except SystemExit as ending:
        _exit_despite_threads(ending.code)
        raise


def _exit_despite_threads(status: str | int | None) -> None:
    """Exit immediately if a thread of a page is still fitting or tracking. At a normal exit the interpreter may stop
    such a thread within compiled code, which sometimes aborts the process (status -6). Files are written atomically, so
    nothing is lost by not waiting.
    """
    if isinstance(status, str) or not any(thread.name.startswith(THREAD_PREFIX) for thread in threading.enumerate()):
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status or 0)


def _show_version(wanted: bool) -> None:
    if wanted:
        import vinetrack

        typer.echo(f"vinetrack {vinetrack.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """See the commands below."""


register_start(app)


@app.command("settings", rich_help_panel=MORE)
def _settings(
    json_file: JsonFile = None,
    page: Annotated[
        Path | None,
        typer.Option("--page", metavar="FILE", help="Write them as a page of the documentation.", show_default=False),
    ] = None,
) -> None:
    """List all columns of the sheet and all keys of the settings, with unit, default, bounds and meaning."""
    with errors_as_sentences(None):
        from vinetrack.core.tables import write_text
        from vinetrack.experiment.reference import reference_content, reference_lines, reference_page

        if page is not None:
            write_text(page, reference_page())
            return
        print_result(reference_lines(), reference_content(), json_file)


@app.command("effects", rich_help_panel=MORE)
def _effects(
    name: Annotated[str | None, typer.Argument(help="Effect to explain.", metavar="NAME", show_default=False)] = None,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="Folder whose own effects to include.", show_default=False)
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="Draw the influence of NAME to this file.", show_default=False)
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """List all effects with formulas, parameters and units, or explain one."""
    with errors_as_sentences(None):
        from vinetrack.pipeline.effects_stage import describe_effects, effects_content
        from vinetrack.pipeline.workflow import find_experiment

        folder = None if experiment is None else find_experiment(experiment)
        print_result(describe_effects(name, folder, figure), effects_content(name, folder), json_file)


@app.command("compare", rich_help_panel=MORE)
def _compare(results: ResultsPath, json_file: JsonFile = None) -> None:
    """Compare model and measurement of every condition, with the scatter of replicates."""
    with errors_as_sentences(None):
        from vinetrack.pipeline.model_stage import comparison_lines
        from vinetrack.results.folder_layout import Results, read_result

        lines = comparison_lines(results)
        print_result(lines, read_result(Results(results).comparison).to_dict("records"), json_file)


@app.command("overlay", rich_help_panel=MORE)
def _overlay(
    results: ResultsPath,
    trial: Annotated[str, typer.Argument(help="Name of the trial.", metavar="TRIAL")],
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="The experiment, if it has moved.", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.5, help="Approximate duration of the clip.", show_default=False)
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Write a slowed-down clip of one trial with tracked and modelled edges."""
    with errors_as_sentences(None):
        from vinetrack.pipeline.overlays_stage import overlay_one

        with activity_sign(f"drawing over {trial}", None):
            path = overlay_one(results, trial, experiment, seconds)
        print_result([f"Clip: {path}"], {"clip": path}, json_file)


@app.command("overlays", rich_help_panel="Stages of the workflow")
def _overlays(
    experiment: ExperimentPath,
    results: ResultsPath,
    settings: SettingsText = "{}",
    threads: Threads = 1,
    log: LogPath = None,
) -> None:
    """Write clips of the recordings that the settings choose, with tracked and modelled edges."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.overlays_stage import draw_overlays

        for line in draw_overlays(_read(experiment), results, settings_from_json(settings).overlays, threads):
            typer.echo(f"  {line}")


register_diagnose(app)
register_planning(app)


@app.command("recording", rich_help_panel="Stages of the workflow")
def _recording(
    experiment: ExperimentPath,
    trial: Annotated[str, typer.Argument(help="Name of the trial.", metavar="TRIAL")],
    results: ResultsPath,
    settings: SettingsText = "{}",
    log: LogPath = None,
) -> None:
    """Analyse one recording: track, kinematics and strip figure."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.recordings_stage import analyse_recording

        read = _read(experiment)
        if trial not in [filmed.name for filmed in read.trials if filmed.video is not None]:
            raise typer.BadParameter(f"{trial!r} is not a trial with a recording in {experiment}", param_hint="TRIAL")
        with activity_sign(f"tracking {trial}", log):
            outcome = analyse_recording(read, trial, results, settings_from_json(settings))
        typer.echo(outcome)


@app.command("tracks", rich_help_panel="Stages of the workflow")
def _tracks(
    experiment: ExperimentPath,
    results: ResultsPath,
    trials: TrialNames = None,
    settings: SettingsText = "{}",
    threads: Threads = 1,
    log: LogPath = None,
) -> None:
    """Analyse trials that are tracks: tracks, kinematics and steady windows."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.tracks_stage import analyse_tracks

        read = _read(experiment)
        failed = analyse_tracks(read, results, settings_from_json(settings), threads, _trial_names(trials, read))
        for line in failed[:10]:
            typer.echo(f"  {line}")


@app.command("gather", rich_help_panel="Stages of the workflow")
def _gather(
    experiment: ExperimentPath, results: ResultsPath, settings: SettingsText = "{}", log: LogPath = None
) -> None:
    """Gather the results of all trials in trials.csv, conditions.csv, steady.csv and damping_points.csv."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.tracks_stage import gather as gather_trials

        table = gather_trials(_read(experiment), results, settings_from_json(settings))
        typer.echo(f"{len(table)} trials, {int((table['status'] == 'failed').sum())} failed.")


@app.command("damping", rich_help_panel="Stages of the workflow")
def _damping(results: ResultsPath, settings: SettingsText = "{}", log: LogPath = None) -> None:
    """Fit the damping law to the steady points: damping.json."""
    with errors_as_sentences(log):
        from vinetrack.narrative.diagnosis_text import damping_headline
        from vinetrack.pipeline.tracks_stage import fit_law

        with activity_sign("fitting the damping law, with bootstrap", log):
            law = fit_law(results, settings_from_json(settings).damping)
        typer.echo(damping_headline(law))


@app.command("model", rich_help_panel="Stages of the workflow")
def _model(
    experiment: ExperimentPath, results: ResultsPath, settings: SettingsText = "{}", log: LogPath = None
) -> None:
    """Fit the model in use to the tracks: fit.json, comparison.csv, model_check.csv, audit.csv."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.model_stage import comparison_lines, fit_model

        with activity_sign("fitting the model", log):
            fit_model(_read(experiment), results, settings_from_json(settings))
        for line in comparison_lines(results):
            typer.echo(line)


@app.command("figures", rich_help_panel="Stages of the workflow")
def _figures(
    experiment: ExperimentPath,
    results: ResultsPath,
    of: Annotated[str, typer.Option("--of", help="`trials`, `campaign` or `all`.")] = "all",
    trials: TrialNames = None,
    settings: SettingsText = "{}",
    threads: Threads = 1,
    log: LogPath = None,
) -> None:
    """Draw the figures of the trials, of the whole experiment, or both."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.report_stage import draw_campaign, draw_trials

        if of not in ("trials", "campaign", "all"):
            raise typer.BadParameter(f"{of!r} is not one of trials, campaign, all", param_hint="--of")
        chosen = settings_from_json(settings).figures
        read = _read(experiment)
        if of != "campaign":
            draw_trials(read, results, chosen, threads, _trial_names(trials, read))
        if of != "trials":
            with activity_sign("drawing the experiment", log):
                draw_campaign(read, results, chosen)


@app.command("paper", rich_help_panel="Stages of the workflow")
def _paper(
    experiment: ExperimentPath, results: ResultsPath, settings: SettingsText = "{}", log: LogPath = None
) -> None:
    """Compare with the published numbers and figures of the paper: paper.csv."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.report_stage import compare_with_paper, draw_paper
        from vinetrack.report.paper_section import tally

        typer.echo(f"Comparison with the paper: {tally(compare_with_paper(_read(experiment), results))}")
        draw_paper(results, settings_from_json(settings).figures)


@app.command("report", rich_help_panel="Stages of the workflow")
def _report(
    experiment: ExperimentPath, results: ResultsPath, settings: SettingsText = "{}", log: LogPath = None
) -> None:
    """Write report.html and provenance.json."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.report_stage import write_report

        with activity_sign("writing the report", log):
            path = write_report(
                _read(experiment),
                results,
                settings_from_json(settings).model_dump(mode="json", exclude={"experiment", "results"}),
            )
        typer.echo(f"Report: {path}")


def _read(folder: Path) -> Experiment:
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.pipeline.workflow import find_experiment

    return read_experiment(find_experiment(folder))


def _trial_names(text: str | None, experiment: Experiment) -> list[str] | None:
    import json

    if text is None:
        return None
    try:
        names = json.loads(text)
    except ValueError as error:
        raise typer.BadParameter(f"is not JSON ({error})", param_hint="--trials") from None
    if not isinstance(names, list):
        raise typer.BadParameter('is not a JSON list such as ["t1", "t2"]', param_hint="--trials")
    if unknown := [name for name in names if name not in experiment.names]:
        raise typer.BadParameter(f"{unknown[0]!r} is not a trial of the sheet", param_hint="--trials")
    return names


if __name__ == "__main__":
    main()
