"""The commands that a new user needs: `vinetrack setup`, `check`, `run`, `explore`, and `track` for one recording."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from vinetrack.cli.command_frame import (
    START,
    ExperimentPath,
    JsonFile,
    LogPath,
    ResultsPath,
    errors_as_sentences,
    json_to_terminal,
    print_result,
)
from vinetrack.cli.options import with_options
from vinetrack.core.problems import UserError

Port = Annotated[int | None, typer.Option("--port", min=0, max=65535, help="Port to serve on; 0 for any that is free.")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Whether to open a browser.")]


def _setup(
    folder: Annotated[Path, typer.Argument(help="A folder of recordings.", metavar="FOLDER")],
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Open a page, or write both files with blanks to fill in.")
    ] = True,
    port: Port = None,
    browser: Browser = True,
    log: LogPath = None,
) -> None:
    """Create trials.csv and experiment.yaml from a folder of recordings, on a local page or with blanks to fill in."""
    with errors_as_sentences(log):
        if page:
            from vinetrack.pages.setup_server import serve

            serve(folder, typer.echo, port, browser=browser)
        else:
            from vinetrack.pages.setup_server import write_templates

            write_templates(folder, typer.echo)


@with_options("track")
def _track(
    recording: Annotated[Path, typer.Argument(help="A film, a stack, or a folder of pictures.", metavar="RECORDING")],
    options: dict[str, Any],
) -> None:
    """Track the leading edge of one recording, without an experiment: a table, a strip figure and a clip."""
    from vinetrack.core.terminal import waiting
    from vinetrack.pipeline.overlays_stage import TrackOptions, track_file

    def say(line: str) -> None:
        if not json_to_terminal(json_file):
            print_result([line], None, None)

    json_file = options.pop("json")
    with waiting(f"tracking {recording.name}"):
        content = track_file(recording, TrackOptions(**options), say)
    print_result((), content, json_file)


def _check(
    experiment: ExperimentPath,
    json_file: JsonFile = None,
) -> None:
    """Check sheet, settings, effects, tracks and recordings in seconds; list facts about each recording."""
    with errors_as_sentences(None):
        from vinetrack.pipeline.run_stage import check_folder
        from vinetrack.pipeline.workflow import find_experiment

        checked = check_folder(find_experiment(experiment))
        lines = checked.lines()
        print_result(
            lines if checked.problems else [*lines, f"{experiment}: no problems found."], checked.to_json(), json_file
        )
        if checked.failed:
            raise typer.Exit(1)


def _run(
    folder: Annotated[
        Path, typer.Argument(help="The experiment's folder; by default this one.", metavar="[FOLDER]")
    ] = Path(),
    cores: Annotated[int, typer.Option("--cores", min=1, help="Processor cores to use.")] = 2,
    results: Annotated[
        Path | None,
        typer.Option(
            "--results", metavar="DIR", show_default=False,
            help="Results go to DIR/NAME of the experiment; by default to results/NAME of this folder.",
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:  # fmt: skip
    """Run everything: recordings to tracks, damping law, model, diagnosis and report; the verdict comes last."""
    with errors_as_sentences(None):
        from vinetrack.pipeline.run_stage import check_before_run, run_chain, run_lines, run_paths
        from vinetrack.results.folder_layout import Results, read_json

        def say(line: str) -> None:
            """Print a line of progress; to standard error if JSON goes to standard output."""
            typer.echo(line, err=json_to_terminal(json_file))

        paths = run_paths(folder, results)
        check_before_run(paths, say)
        run_chain(paths, cores, say)
        content: dict[str, Any] = {
            "results": paths.results,
            "report": Results(paths.results).report,
            "diagnosis": read_json(Results(paths.results).diagnosis),
        }
        print_result(run_lines(paths.results), content, json_file)


def _explore(
    results: ResultsPath,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="Where the experiment is, if it has moved.")
    ] = None,
    port: Port = None,
    browser: Browser = True,
    log: LogPath = None,
) -> None:
    """Open a local page that shows where the model fails, to try effects, refit, and compare errors."""
    with errors_as_sentences(log):
        if importlib.util.find_spec("bokeh") is None:
            raise UserError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
        from vinetrack.pages.explorer_server import explore

        explore(results, experiment, typer.echo, port, browser=browser)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    commands: dict[str, Callable[..., None]] = {
        "setup": _setup,
        "track": _track,
        "check": _check,
        "run": _run,
        "explore": _explore,
    }
    for name, command in commands.items():
        app.command(name, rich_help_panel=START)(command)
