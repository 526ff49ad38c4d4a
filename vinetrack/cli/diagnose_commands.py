"""Commands of the diagnosis: `diagnose`, `add` and `propose`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vinetrack.cli.command_frame import (
    MORE,
    JsonFile,
    LogPath,
    ResultsPath,
    errors_as_sentences,
    print_result,
)
from vinetrack.core.problems import UserError

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment

Moved = Annotated[
    Path | None, typer.Option("--experiment", help="The experiment, if it has moved.", show_default=False)
]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("diagnose", rich_help_panel=MORE)(_diagnose)
    app.command("add", rich_help_panel=MORE)(_add)
    app.command("propose", rich_help_panel=MORE)(_propose)


def _diagnose(
    target: Annotated[Path, typer.Argument(help="A results folder, or an experiment.", metavar="TARGET")],
    json_file: Annotated[
        Path | None,
        typer.Option("--json", help="Write the diagnosis to this file only; - for the terminal.", show_default=False),
    ] = None,
    experiment: Moved = None,
    log: LogPath = None,
) -> None:
    """Diagnose what the model lacks: verdict, candidates with sizes, errors before and after, next experiment."""
    with errors_as_sentences(log):
        from vinetrack.diagnosis.diagnose import diagnose
        from vinetrack.pipeline.workflow import find_experiment
        from vinetrack.results.folder_layout import Results, read_json, read_source_experiment

        results = Results(target)
        with progress_line() as report:
            if results.provenance.exists():
                from vinetrack.experiment.settings import run_settings
                from vinetrack.pipeline.model_stage import diagnosed, write_diagnosis

                diagnosis, pairs = diagnosed(read_source_experiment(target, experiment), results, report)
                if json_file is None:
                    write_diagnosis(results, diagnosis, pairs, run_settings(read_json(results.provenance)["settings"]))
            else:
                diagnosis = diagnose(_tracks_only(find_experiment(target)), report=report)
        print_result([str(diagnosis)], diagnosis.to_json(), json_file)


def _add(
    effect: Annotated[str, typer.Argument(help="Name of the effect, or its file.", metavar="EFFECT")],
    results: ResultsPath,
    save: Annotated[bool, typer.Option("--save", help="Write it to `model:` in experiment.yaml.")] = False,
    experiment: Moved = None,
    json_file: JsonFile = None,
    log: LogPath = None,
) -> None:
    """Add an effect to the model, refit, and show the error before and after."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.model_stage import add_effect
        from vinetrack.results.folder_layout import read_source_experiment

        read = read_source_experiment(results, experiment)
        own_file = Path(effect) if effect.endswith(".py") else None
        if save and own_file is not None and own_file.resolve().parent != read.folder.resolve():
            raise UserError(
                f"{effect}: to save the model, move the file into {read.folder} first; an experiment is one folder."
            )
        with progress_line() as report:
            lines = add_effect(read, results, effect, report)
        if save:
            from vinetrack.experiment.folder import save_model
            from vinetrack.pipeline.workflow import command_for_results

            name = effect if own_file is None else own_file.stem
            path = save_model(read.folder, [*read.settings.model, name], [] if own_file is None else [own_file.name])
            lines.append(f"Saved to {path}; to update all results: {command_for_results(read.folder, results)}")
        print_result(lines, {"effect": effect, "saved": save, "lines": lines}, json_file)


def _propose(
    results: ResultsPath,
    to: Annotated[Path | None, typer.Option("--to", help="Write the effect to this file.", show_default=False)] = None,
    experiment: Moved = None,
    json_file: JsonFile = None,
    log: LogPath = None,
) -> None:
    """Write the force law that explains best what no known effect explains, as an effect file of your own."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.effects_stage import propose_effect
        from vinetrack.results.folder_layout import read_source_experiment

        with progress_line() as report:
            proposal = propose_effect(read_source_experiment(results, experiment), results, to, report)
        lines, files = list(proposal.lines), [path.as_posix() for path in proposal.files]
        print_result(lines, {"lines": lines, "files": files}, json_file)


def _tracks_only(folder: Path) -> Experiment:
    """Read an experiment whose trials are tracks; refuse recordings, which the workflow must track first."""
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.results.folder_layout import ResultsError

    experiment = read_experiment(folder)
    if experiment.trials and all(trial.track is None for trial in experiment.trials):
        raise ResultsError(
            f"{folder}: its trials are recordings, which must be tracked first: vinetrack run {folder} tracks and "
            f"diagnoses them; after that, vinetrack diagnose {Path('results') / experiment.name}"
        )
    return experiment


@contextmanager
def progress_line() -> Iterator[Callable[[str], None]]:
    """Show the current step on one line of a terminal, which is erased at the end; print nothing elsewhere."""
    on_terminal = sys.stderr.isatty()

    def report(step: str) -> None:
        if on_terminal:
            sys.stderr.write(f"\r\x1b[K{step} …")
            sys.stderr.flush()

    try:
        yield report
    finally:
        if on_terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
