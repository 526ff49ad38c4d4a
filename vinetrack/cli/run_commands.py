"""The commands `vinetrack check` and `vinetrack run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vinetrack.cli.command_frame import START, JsonFile, errors_as_sentences, json_to_terminal, print_result


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("check", rich_help_panel=START)(_check)
    app.command("run", rich_help_panel=START)(_run)


def _check(
    experiment: Annotated[Path, typer.Argument(help="The experiment's folder.", metavar="EXPERIMENT")],
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
        check_before_run(paths.experiment, say)
        run_chain(paths, cores, say)
        content: dict[str, Any] = {
            "results": paths.results,
            "report": Results(paths.results).report,
            "diagnosis": read_json(Results(paths.results).diagnosis),
        }
        print_result(run_lines(paths.results), content, json_file)
