"""The command line, which starts quickly and prints no tracebacks.

A problem of the input is reported in one sentence; an internal error in one sentence that names the log with the
traceback.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vinetrack.cli.commands import progress_line, register
from vinetrack.cli.options import (
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
from vinetrack.pipeline.stages import STAGES, Job, Stage

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
    str | None,
    typer.Option(
        "--trials", help="Names of the trials, a JSON list; all by default, and if it is empty.", show_default=False
    ),
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
    from vinetrack.pages.local_page import THREAD_PREFIX

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


register(app)


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


def _stage_command(stage: Stage) -> Callable[..., None]:
    def command(
        experiment: ExperimentPath,
        results: ResultsPath,
        trials: TrialNames = None,
        settings: SettingsText = "{}",
        threads: Threads = 1,
        log: LogPath = None,
    ) -> None:
        from vinetrack.experiment.folder import read_experiment
        from vinetrack.pipeline.workflow import RUN, find_experiment

        with errors_as_sentences(log), progress_line() as say:
            read = read_experiment(find_experiment(experiment))
            in_run = RUN in os.environ
            chosen = _trial_names(trials, read)
            job = Job(read, results, settings_from_json(settings), chosen, threads, typer.echo if in_run else say)
            lines = stage.run(job)
        for line in [stage.done] if in_run else lines:
            typer.echo(line)

    command.__doc__ = stage.run.__doc__
    return command


def _register_stages() -> None:
    for name, stage in STAGES.items():
        app.command(name, rich_help_panel="Stages of the workflow")(_stage_command(stage))


_register_stages()


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
    return names or None


if __name__ == "__main__":
    main()
