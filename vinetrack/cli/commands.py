"""The commands that set up, run, explore and diagnose an experiment, and those about vines that do not exist yet."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vinetrack.cli.options import (
    MORE,
    START,
    ExperimentPath,
    JsonFile,
    LogPath,
    ResultsPath,
    errors_as_sentences,
    json_to_terminal,
    print_result,
    with_options,
)
from vinetrack.core.problems import UserError

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment
    from vinetrack.pipeline.predict_stage import PredictionRequest


# ------------------------------------------------------------------------------
# The commands that a new user needs: `vinetrack setup`, `check`, `run`, `explore`, and `track` for one recording.

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
        from vinetrack.pipeline.workflow import check_folder, find_experiment

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
        from vinetrack.pipeline.workflow import check_before_run, run_chain, run_lines, run_paths
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
        from vinetrack.pages.page import explore

        explore(results, experiment, typer.echo, port, browser=browser)


# ------------------------------------------------------------------------------
# Commands of the diagnosis: `diagnose`, `add` and `propose`.

Moved = Annotated[
    Path | None, typer.Option("--experiment", help="The experiment, if it has moved.", show_default=False)
]


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


YIELD_MEANING = "Yield pressure; a scaling prior if not given."

# Columns of the sheet that are options of each command
PREDICTED = (
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "film_density_kg_m3",
    "yield_pressure_kPa",
    "yield_pressure_sigma_kPa",
    "pressure_kPa",
    "pressure_sigma_kPa",
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
)
OF_A_RIG = ("film_density_kg_m3", "yield_pressure_kPa", "pressure_kPa", "payload_g", "growth_angle_deg", "inlet_mm")


def _request(options: dict[str, Any], **more: Any) -> PredictionRequest:
    """Take what a prediction is asked with out of the options of a command."""
    from vinetrack.pipeline.predict_stage import PredictionRequest

    names = [field.name for field in fields(PredictionRequest) if field.name in options]
    return PredictionRequest(**{name: options.pop(name) for name in names}, **more)


@with_options("predict", PREDICTED, yield_pressure_kPa=YIELD_MEANING)
def _predict(
    sheet: Annotated[
        Path | None,
        typer.Argument(
            help="An experiment's folder or a sheet, instead of the options below.", metavar="SHEET", show_default=False
        ),
    ] = None,
    *,
    options: dict[str, Any],
) -> None:
    """Predict a new vine: position, speed, tension, ejection speed, with their uncertainty."""
    from vinetrack.pipeline.predict_stage import predict_conditions

    request = _request(options, sheet=sheet)
    print_result(predict_conditions(request, **options), None, None)


@with_options(
    "vine",
    (*OF_A_RIG, "chamber_l"),
    pressure_kPa="Highest gauge pressure of the supply.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _vine(options: dict[str, Any]) -> None:
    """Find the fastest vine within limits of burst stress, diameter and length, for a choice of films."""
    from vinetrack.pipeline.design_stage import design_vine

    json_file, request = options.pop("json"), _request(options)
    print_result(*design_vine(request, **options), json_file)


@with_options(
    "reservoir",
    ("diameter_mm", "length_mm", "thickness_um", *OF_A_RIG, "chamber_l"),
    chamber_l="A chamber to evaluate as well.",
    thickness_um="Thickness of the wall; with it, speeds are predicted as well.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _reservoir(options: dict[str, Any]) -> None:
    """Find the chamber that limits the loss of gauge pressure, by the gas law in absolute pressure."""
    from vinetrack.pipeline.design_stage import design_reservoir

    json_file, request = options.pop("json"), _request(options)
    print_result(*design_reservoir(request, **options), json_file)


@with_options("power")
def _power(
    target: Annotated[
        Path, typer.Argument(help="A results folder, an experiment, or a sheet without recordings.", metavar="TARGET")
    ],
    options: dict[str, Any],
) -> None:
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate."""
    import pandas as pd

    from vinetrack.core.tables import write_csv
    from vinetrack.pipeline.power_stage import PowerRequest, power_of_target, sheet_rows
    from vinetrack.pipeline.predict_stage import check_figure, write_figure

    figure, rows_file, json_file = (options.pop(name) for name in ("figure", "rows_file", "json"))
    check_figure(figure)
    power = power_of_target(PowerRequest(target=target, **options))
    lines = str(power).splitlines()
    if figure is not None:
        write_figure(power.plot(), figure)
        lines.append(f"Figure: {figure}")
    if rows_file is not None and power.further:
        write_csv(rows_file, pd.DataFrame(sheet_rows(power)))
        lines.append(f"Rows of the sheet: {rows_file}")
    print_result(lines, power.to_json(), json_file)


design_app = typer.Typer(
    name="design",
    help="Design the fastest vine, or the reservoir it needs.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
design_app.command("vine")(_vine)
design_app.command("reservoir")(_reservoir)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    start = (_setup, _track, _check, _run, _explore)
    more = (_diagnose, _add, _propose, _power, _predict)
    for panel, commands in ((START, start), (MORE, more)):
        for command in commands:
            app.command(command.__name__.removeprefix("_"), rich_help_panel=panel)(command)
    app.add_typer(design_app, rich_help_panel=MORE)
