"""The commands: about an experiment, its results, the catalogue, vines that do not exist yet; and one for each stage.

A command is a function of arguments and options that returns lines, and the same content for a program. A line of
`options.csv` beside this file states one of them: the name of the value that the command gets, the option (blank for an
argument), its commands, kind, default, bounds and help. A number that is not given is NaN; `per` is what it is divided
by (100 for per cent). An option named after a column of the trial sheet comes from the columns' own table and is
checked like a cell of a sheet.
"""

from __future__ import annotations

import csv
import gc
import importlib.util
import inspect
import json
import logging
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import vinetrack.results as layout
from vinetrack.core.problems import ExperimentError, InputError, UserError, format_problems
from vinetrack.core.process import table, waiting
from vinetrack.core.tables import STANDARD_OUTPUT, is_disk_full, safe_join, write_csv, write_json, write_text
from vinetrack.experiment.schema import COLUMNS, Column, option
from vinetrack.pipeline import workflow
from vinetrack.pipeline.workflow import STAGES, Job, Stage, compilation_told

if TYPE_CHECKING:
    from vinetrack.effects import Effect

# ------------------------------------------------------------------------------
# Output of commands: lines for the user, or with `--json` the same content for a program.


@contextmanager
def errors_as_sentences(log: Path | None) -> Iterator[None]:
    """Report every exception in a sentence and exit with status 1; messages and tracebacks go to the log."""
    try:
        _log_to(log)
        yield
    except (typer.Exit, typer.BadParameter, typer.Abort):
        raise
    except ExperimentError as error:
        _exit_with("\n".join(format_problems(error.problems)), "")
    except KeyboardInterrupt:
        _exit_with("Stopped; finished results are kept.", "")
    except BrokenPipeError:
        # The reader (such as `| head`) has closed the pipe; redirect it, or Python reports the error again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except Exception as error:
        if is_disk_full(error):
            _exit_with("the disk is full: free some space and run the same command again; finished results are kept.")
        logging.getLogger(__name__).exception("stopped by %s", type(error).__name__)
        if isinstance(error, OSError) and error.strerror and (place := error.filename2 or error.filename):
            _exit_with(f"{place}: {error.strerror[:1].lower()}{error.strerror[1:]}: name another file or folder.")
        if isinstance(error, UserError):
            _exit_with(str(error))
        place = f"; the traceback is in {log}" if log else "; run it again with --log FILE for the traceback"
        _exit_with(f"internal error of the program, not a fault of your data ({type(error).__name__}: {error}){place}")


def _print_line(line: str, err: bool = False) -> None:
    """Print a line; on a terminal that wants colours, errors and warnings have theirs."""
    colour = {"error": "red", "warning": "yellow"}.get(line.partition(":")[0])
    typer.secho(line, fg=None if os.environ.get("NO_COLOR") else colour, err=err)


def _exit_with(message: str, severity: str = "error: ") -> None:
    for line in f"{severity}{message}".splitlines():
        _print_line(line, err=True)
    raise typer.Exit(1)


def _log_to(path: Path | None) -> None:
    """Send log messages of all modules to a file only, never to the terminal."""
    logging.basicConfig(handlers=[logging.NullHandler()], level=logging.INFO, force=True)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(path, mode="w", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger().addHandler(file)


# What a command returns: lines, the same content for a program, and whether it found a fault, by default not
Answer = tuple[Iterable[str], Any] | tuple[Iterable[str], Any, bool]
_Command = Callable[..., Answer | None]
Say = Callable[[str], None]


def command(
    lines_of: str = "", columns: tuple[str, ...] = (), **meanings: str
) -> Callable[[_Command], Callable[..., None]]:
    """Give a function the arguments and options that the table states for its name (or `lines_of`), report its errors
    in sentences, and print the lines that it returns, or the content beside them as JSON.

    The function gets by name what it has parameters for, and the rest as a mapping `options` if it has that; `report`
    shows a step on a terminal, and `say` prints a line while it works. With `columns`, options for these columns of the
    trial sheet come first, and `options["cells"]` holds the given texts; `meanings` replaces the help of some of them.
    """

    def decorate(function: _Command) -> Callable[..., None]:
        wanted = inspect.signature(function).parameters
        table = _table(lines_of or function.__name__.strip("_"))

        def called(**given: Any) -> None:
            cells = {name: text for name in columns if (text := given.pop(name)) is not None}
            values = {line["field"]: _value(line, given[line["field"]]) for line in table}
            log, json_file = values.pop("log", None), values.get("json")
            with errors_as_sentences(log):
                tools: dict[str, Any] = {"say": partial(_print_line, err=json_file == STANDARD_OUTPUT)}
                on_terminal: Any = waiting("starting") if "report" in wanted and sys.stderr.isatty() else nullcontext()
                with on_terminal as bar:
                    tools["report"] = lambda step: bar and bar.update(bar.task_ids[0], description=step)
                    named = {name: value for name, value in {**values, **tools}.items() if name in wanted}
                    if "options" in wanted:
                        options = {name: value for name, value in values.items() if name not in {*wanted, "json"}}
                        named["options"] = {**options, "cells": cells} if columns else options
                    answer = function(**named)
                if answer is not None:
                    lines, content, *failed = answer
                    for text in () if json_file == STANDARD_OUTPUT else lines:
                        _print_line(text)
                    if json_file is not None and content is not None:
                        write_json(json_file, content)
                    if any(failed):
                        raise typer.Exit(1)

        parameters = [_column_parameter(COLUMNS[name], meanings.get(name, "")) for name in columns]
        parameters += [_parameter(line) for line in table]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in parameters}
        called.__name__, called.__doc__ = function.__name__, function.__doc__
        return called

    return decorate


@cache
def _table(command_name: str) -> list[dict[str, str]]:
    """The lines of `options.csv` for a command."""
    with Path(__file__).with_name("options.csv").open(encoding="utf-8", newline="") as file:
        return [line for line in csv.DictReader(file) if command_name in line["commands"].split()]


def _parameter(line: Mapping[str, str]) -> inspect.Parameter:
    """Return the parameter from which Typer makes the argument or option of a line."""
    kind, default = line["kind"], line["default"]
    bounds = {end: json.loads(line[name]) for end, name in (("min", "low"), ("max", "high")) if line[name]}
    value = json.loads(default) if kind in ("number", "count", "flag") and default else default or None
    value = False if kind == "flag" and not default else None if value == "null" else value
    said: dict[str, Any] = {"help": line["help"], "metavar": line["metavar"] or None}
    said["show_default"] = value is not None and value is not False
    required = not line["option"] and not default and kind != "texts"
    if line["option"]:
        info = typer.Option(line["option"], rich_help_panel=line["panel"] or None, **said, **bounds)
    else:
        info = typer.Argument(**said)
    types: dict[str, Any] = {"number": float, "count": int, "flag": bool, "texts": list[str], "path": Path}
    type_ = types.get(kind.replace("picture", "path"), str)
    return _keyword(
        line["field"], type_ if required else type_ | None, info, inspect.Parameter.empty if required else value
    )


def _column_parameter(column: Column, meaning: str) -> inspect.Parameter:
    """Return the parameter from which Typer makes the option of a column."""
    unset = "" if column.default in ("", "unknown") or column.default.startswith("required") else f" ({column.default})"
    of_vine = ("diameter_", "thickness_", "length_", "film_density_", "yield_pressure_")
    info = typer.Option(
        option(column.name),
        help=meaning or f"{column.meaning.rstrip('.')}{unset}.",
        metavar=(column.unit_key or "number").upper(),
        rich_help_panel="The vine" if column.name.startswith(of_vine) else "The rig",
        show_default=False,
    )
    return _keyword(column.name, str | None, info, None)


def _keyword(name: str, kind: Any, info: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _value(line: Mapping[str, str], given: Any) -> Any:
    """Return the value of an option for the command."""
    kind = line["kind"]
    if kind == "number":
        return math.nan if given is None else given / float(line["per"] or 1)
    if kind == "texts":
        return tuple(given or ())
    if kind == "picture" and given is not None and given.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise _refused(line, f"'{given}' is not the name of a picture: end it in .png, .svg or .pdf")
    if kind == "column" and given is not None:
        try:
            return COLUMNS[line["field"]].read(given)
        except InputError as error:
            raise _refused(line, f"{given!r} {error.message}: {error.allowed or error.remedy}") from None
    if kind in ("list", "object") and given is not None:
        try:
            content = json.loads(given)
        except ValueError as error:
            raise _refused(line, f"is not JSON ({error})") from None
        type_, example = (list, '["t1", "t2"]') if kind == "list" else (dict, '{"damping": {"seed": 7}}')
        if not isinstance(content, type_):
            raise _refused(line, f"is not a JSON {kind} such as {example}")
        return content
    return given


def _refused(line: Mapping[str, str], message: str) -> typer.BadParameter:
    return typer.BadParameter(message, param_hint=line["option"])


# ------------------------------------------------------------------------------
# The commands that a new user needs: `vinetrack setup`, `check`, `run`, `explore`, and `track` for one recording.


@command()
def _setup(folder: Path, page: bool, port: int | None, browser: bool, say: Say) -> None:
    """Create trials.csv and experiment.yaml from a folder of recordings, on a local page or with blanks to fill in."""
    from vinetrack.pages.setup_server import serve, write_templates

    if page:
        serve(folder, say, port, browser=browser)
    else:
        write_templates(folder, say)


@command()
def _track(recording: Path, say: Say, options: dict[str, Any]) -> Answer:
    """Track the leading edge of one recording, without an experiment: a table, a strip figure and a clip."""
    from vinetrack.pipeline.report_stage import track_file

    with waiting(f"tracking {recording.name}"), compilation_told(say):
        return track_file(recording, **options)


@command()
def _check(experiment: Path) -> Answer:
    """Check sheet, settings, effects, tracks and recordings in seconds; list facts about each recording."""
    checked = workflow.check_folder(workflow.find_experiment(experiment))
    is_sound = all(problem.severity == "note" for problem in checked.problems)
    lines = [*checked.lines(), *[f"{experiment}: no problems found."] * is_sound]
    return lines, checked.to_json(), checked.failed


@command()
def _run(folder: Path, cores: int, results: Path | None, verbose: bool, say: Say) -> Answer:
    """Run everything: recordings to tracks, damping law, model, diagnosis and report; the verdict comes last."""
    paths = workflow.run_paths(folder, results)
    with compilation_told(say):
        workflow.check_before_run(*paths, say)
    workflow.run_chain(*paths, cores, say, verbose)
    to = layout.Results(paths[1])
    lines, failed = _run_lines(to.folder)
    return lines, {"results": to.folder, "report": to.report, "diagnosis": layout.read_json(to.diagnosis)}, failed


def _run_lines(folder: Path) -> tuple[list[str], bool]:
    """Summarise finished results in at most twelve lines: failed trials, report, the table in short, the verdict last,
    or why there is none and what to do; and whether most trials failed or there is no verdict.
    """
    from vinetrack.narrative.diagnosis_text import failures_told, table_lines
    from vinetrack.narrative.verdict_text import verdict_line, verdict_table

    results = layout.Results(folder)
    diagnosis, (told, failed) = layout.read_diagnosis(results), failures_told(layout.read_result(results.trials))
    lines = [f"Report: {results.report}"] if failed or not told else [told, f"Report: {results.report}"]
    if diagnosis is not None and diagnosis.verdict:
        lines += table_lines(diagnosis, in_short=True)
        notes = [f"! {note}" for note in diagnosis.notes[:1] if len(lines) < 11]
        then = verdict_table(diagnosis)[0].note
        lines += [*notes, f"{verdict_line(diagnosis)}{f'. {then}' if then else ''}"]
    elif diagnosis is not None and not failed:
        told, failed = diagnosis.explanation, True
    then = "The report gives the reason of every trial: mend that of the first, and run again."
    return [*lines, f"error: {told.rstrip('.')}. {then}"] if failed else lines, failed


@command()
def _explore(results: Path, experiment: Path | None, port: int | None, browser: bool, say: Say) -> None:
    """Open a local page that shows where the model fails, to try effects, refit, and compare errors."""
    if importlib.util.find_spec("bokeh") is None:
        raise UserError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
    from vinetrack.pages.page import explore

    explore(results, experiment, say, port, browser=browser)


# ------------------------------------------------------------------------------
# Commands about results: `diagnose`, `add`, `propose`, `compare` and `overlay`.


@command()
def _diagnose(target: Path, experiment: Path | None, json: Path | None, report: Say) -> Answer:
    """Diagnose what the model lacks: verdict, candidates with sizes, errors before and after, next experiment."""
    from vinetrack.diagnosis.diagnose import diagnose
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.experiment.settings import run_settings
    from vinetrack.pipeline.analysis import diagnosed, diagnosis_content, fit_model, write_diagnosis

    results = layout.Results(target)
    if results.provenance.exists():
        source = layout.read_source_experiment(target, experiment)
        if json is None:  # with the fit that it is of: model and sheet may have changed since the run
            settings = run_settings(layout.read_json(results.provenance)["settings"])
            fitted, pairs, motions = fit_model(workflow.Job(source, target, settings, say=report))
            diagnosis = diagnosed(source, results, pairs, report, fitted)
            write_diagnosis(results, diagnosis, lambda: motions, settings)
        else:
            diagnosis = diagnosed(source, results, layout.measured_trials(source, results), report)
        return [str(diagnosis).replace("RESULTS", str(target))], diagnosis_content(diagnosis)
    read = read_experiment(workflow.find_experiment(target))
    if read.trials and all(trial.track is None for trial in read.trials):
        raise UserError(
            f"{target}: its trials are recordings, which must be tracked first: vinetrack run {target} tracks and "
            f"diagnoses them; after that, vinetrack diagnose {Path('results') / read.name}"
        )
    diagnosis = diagnose(read, report=report)
    return [str(diagnosis)], diagnosis_content(diagnosis)


@command()
def _add(effect: str, results: Path, save: bool, experiment: Path | None, report: Say) -> Answer:
    """Add an effect to the model, or several as A+B, refit, and show the error before and after."""
    from vinetrack.diagnosis.propose import add
    from vinetrack.narrative.diagnosis_text import added_in_words
    from vinetrack.pages.draft_files import save_model

    read = layout.read_source_experiment(results, experiment)
    names = [effect] if Path(effect).is_file() else effect.split("+")
    own_files = [Path(name) for name in names if name.endswith(".py")]
    if save and any(file.resolve().parent != read.folder.resolve() for file in own_files):
        raise UserError(
            f"{effect}: to save the model, move the file into {read.folder} first; an experiment is one folder."
        )
    tracks = {trial.name: track for trial, track in layout.measured_trials(read, layout.Results(results))}
    before, after, ladder = add(read, tracks, names, report)
    lines, saved = added_in_words(before, after, ladder), save and after.converged
    if saved:
        added = [Path(name).stem for name in names]
        path = save_model(read.folder, [*read.settings.model, *added], [file.name for file in own_files])
        lines.append(f"Saved to {path}; to update all results: {workflow.command_for_results(read.folder, results)}")
    elif save:
        lines.append(
            "error: not saved, since the fit did not converge; a `model` in experiment.yaml may name it all the same"
        )
    content = {"effect": effect, "saved": saved, "lines": lines, "ladder": ladder.to_dict("records")}
    return lines, content, save and not saved


@command()
def _propose(results: Path, experiment: Path | None, report: Say) -> Answer:
    """Write the force law that explains best what no known effect explains, as an effect file of your own."""
    from vinetrack.pipeline.analysis import propose_effect

    lines, files = propose_effect(layout.read_source_experiment(results, experiment), results, report)
    return lines, {"lines": lines, "files": files}


@command()
def _compare(results: Path) -> Answer:
    """Compare model and measurement of every condition, with the scatter of replicates."""
    from vinetrack.diagnosis.ladder import comparison_lines
    from vinetrack.narrative.verdict_text import verdict_line

    fit, compared = layout.read_fit(layout.Results(results)), layout.read_result(layout.Results(results).comparison)
    content, diagnosis = compared.to_dict("records"), layout.read_diagnosis(layout.Results(results))
    if diagnosis is not None and diagnosis.contradicted_columns:
        return [str(diagnosis), "", *comparison_lines(compared)], content
    if fit.refused:
        return [f"{' + '.join(fit.names)} was not fitted: {fit.refused}"], content
    told = [verdict_line(diagnosis)] if diagnosis is not None and diagnosis.refutes() else []
    return [*comparison_lines(compared), *(f"! {message}" for message in (*told, *fit.messages))], content


@command()
def _overlay(results: Path, trial: str, experiment: Path | None, seconds: float) -> Answer:
    """Write a slowed-down clip of one trial with tracked and modelled edges."""
    from vinetrack.pipeline.report_stage import overlay_one

    with waiting(f"drawing over {trial}"):
        path = overlay_one(results, trial, experiment, seconds)
    return [f"Clip: {path}"], {"clip": path}


# ------------------------------------------------------------------------------
# Commands about what there is: `settings` and `effects`.


@command()
def _settings(page: Path | None) -> Answer | None:
    """List all columns of the sheet and all keys of the settings, with unit, default, bounds and meaning."""
    from vinetrack.experiment.settings import reference_content, reference_page

    if page is None:
        return reference_page().splitlines(), reference_content()
    write_text(page, reference_page())
    return None


@command()
def _effects(name: str | None, experiment: Path | None) -> Answer:
    """List all effects with formulas, parameters and units, or explain one."""
    from vinetrack.effects import catalogue, find_effect, own_effects
    from vinetrack.experiment.settings import read_experiment_settings

    folder = Path() if experiment is None else workflow.find_experiment(experiment)
    listed = () if experiment is None else read_experiment_settings(folder / "experiment.yaml").effects
    own = own_effects([safe_join(folder, path) for path in listed])
    if name is None:
        effects = list({**catalogue(), **own}.values())
        parameters = [", ".join(f"{p.symbol} ({p.unit})" for p in one.parameters) or "–" for one in effects]
        kinds = [f"{one.kind}, own" if one.name in own else one.kind for one in effects]
        entries = zip((one.name for one in effects), kinds, parameters, strict=True)
        head, *rows = table(entries, ("name", "kind", "parameters"))
        lines = [head, *(part for row, one in zip(rows, effects, strict=True) for part in (row, f"    {one.formula}"))]
    else:
        effects = [find_effect(name, own)]
        lines = _explanation(effects[0])
    facts = [{"name": one.name, "kind": one.kind, "text": one.text, "own": one.name in own} for one in effects]
    return lines, [
        fact | {"parameters": list(map(asdict, one.parameters))} for fact, one in zip(facts, effects, strict=True)
    ]


def _explanation(effect: Effect) -> list[str]:
    """Lines on one effect: the text of its file, its parameters and its relations to other effects."""
    lines = [f"{effect.name} ({effect.kind})", "", *effect.text.splitlines(), ""]
    rows = []
    for p in effect.parameters:
        spans = ["{:g} to {:g}".format(*ends) if ends else "–" for ends in (p.bounds, p.plausible)]
        # A shape, such as an exponent or a length, does not make an effect vanish: its `zero` is its default.
        no_size = "–" if p.zero == p.default else f"{p.zero:g}"
        shared = "all" if p.shared == "all" else f"each {p.shared}"
        meaning = f"{p.meaning} [{effect.name}.{p.name}]{', known beforehand' if p.held else ''}"
        rows.append((p.symbol, p.unit, f"{p.default:g}", *spans, no_size, shared, meaning))
    if rows:
        head = ("symbol", "unit", "default", "bounds", "plausible", "no size at", "one for", "meaning")
        lines += ["Parameters, in files by the name in brackets:"]
        lines += [*table(rows, head, indent="  ", align="<" * len(head)), ""]
    facts = {
        "Sizes that result from slips in the sheet": "; ".join(
            f"{p.symbol} = {size:.3g}, {done}" for p in effect.parameters for size, done in p.slips
        ),
        "Needs of the trial sheet": ", ".join(effect.needs),
        "Replaces, while in the model": ", ".join(effect.replaces),
        "A pressure measured during growth": "already includes it" if effect.in_trace else "",
        "File": str(effect.path),
    }
    return [*lines, *(f"{what}: {words}" for what, words in facts.items() if words)]


# ------------------------------------------------------------------------------
# Commands about vines that do not exist yet: `predict`, `design` and `power`.

YIELD_MEANING = "Yield pressure; a scaling prior if not given."

# Columns of the sheet that are options
OF_A_RIG = ("film_density_kg_m3", "yield_pressure_kPa", "pressure_kPa", "payload_g", "growth_angle_deg", "inlet_mm")


@command(
    columns=(
        *("diameter_mm", "thickness_um", "length_mm", "film_density_kg_m3"),
        *("yield_pressure_kPa", "yield_pressure_sigma_kPa", "pressure_kPa", "pressure_sigma_kPa"),
        *("payload_g", "growth_angle_deg", "chamber_l", "inlet_mm"),
    ),
    yield_pressure_kPa=YIELD_MEANING,
)
def _predict(sheet: Path | None, options: dict[str, Any]) -> Answer:
    """Predict a new vine: position, speed, tension, ejection speed, with their uncertainty."""
    from vinetrack.pipeline.planning_stage import predict_conditions

    return predict_conditions(sheet=sheet, **options)


@command(
    columns=(*OF_A_RIG, "chamber_l"),
    pressure_kPa="Highest gauge pressure of the supply.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _vine(options: dict[str, Any]) -> Answer:
    """Find the fastest vine within limits of burst stress, diameter and length, for a choice of films."""
    from vinetrack.pipeline.planning_stage import design_vine

    return design_vine(**options)


@command(
    columns=("diameter_mm", "length_mm", "thickness_um", *OF_A_RIG, "chamber_l"),
    chamber_l="A chamber to evaluate as well.",
    thickness_um="Thickness of the wall; with it, speeds are predicted as well.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _reservoir(options: dict[str, Any]) -> Answer:
    """Find the chamber that limits the loss of gauge pressure, by the gas law in absolute pressure."""
    from vinetrack.pipeline.planning_stage import design_reservoir

    return design_reservoir(**options)


@command()
def _power(target: Path, figure: Path | None, rows_file: Path | None, options: dict[str, Any]) -> Answer:
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate."""
    import pandas as pd

    from vinetrack.figures.style import write_figure
    from vinetrack.pipeline.planning_stage import PowerRequest, power_of_target

    power = power_of_target(PowerRequest(target=target, **options))
    lines = [*str(power).splitlines(), *write_figure(figure, power.plot)]
    rows = [
        {"trial": f"{plan.power.effect if len(power.further) > 1 else 'added'}_{k}"}
        | {name: value for name, value in trial.items() if name in COLUMNS}
        for plan in power.further
        for k, trial in enumerate(plan.trials, 1)
    ]
    if rows_file is not None and rows:
        write_csv(rows_file, pd.DataFrame(rows))
        lines.append(f"Rows of the sheet: {rows_file}")
    return lines, power.to_json()


# ------------------------------------------------------------------------------
# One command for each stage, and the order of all of them in the help.


def _stage_command(name: str, stage: Stage) -> Callable[..., None]:
    @command("stage")
    def run_stage(
        experiment: Path, results: Path, trials: list[str] | None, settings: dict[str, Any], threads: int, report: Say
    ) -> Answer:
        from vinetrack.experiment.folder import read_experiment
        from vinetrack.experiment.settings import run_settings

        read = read_experiment(workflow.find_experiment(experiment))
        if unknown := [one for one in trials or () if one not in read.names]:
            raise typer.BadParameter(f"{unknown[0]!r} is not a trial of the sheet", param_hint="--trials")
        in_run = workflow.RUN in os.environ
        say = typer.echo if in_run else report
        say(stage.does.rstrip("."))
        lines = stage.run(Job(read, results, run_settings(settings), trials or None, threads, say))
        return [f"{name}: {lines[0]}"] if in_run else lines, None

    run_stage.__doc__ = stage.does
    return run_stage


def new_app(name: str, text: str) -> typer.Typer:
    """A group of commands."""
    return typer.Typer(
        name=name, help=text, no_args_is_help=True, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    design = new_app("design", "Design the fastest vine, or the reservoir it needs.")
    groups: tuple[tuple[typer.Typer, str | None, tuple[Callable[..., None], ...]], ...] = (
        (app, "Start here", (_setup, _track, _check, _run, _explore)),
        (app, "More", (_diagnose, _add, _propose, _power, _predict, _settings, _effects, _compare, _overlay)),
        (design, None, (_vine, _reservoir)),
    )
    for group, panel, commands in groups:
        for one in commands:
            group.command(one.__name__.removeprefix("_"), rich_help_panel=panel)(one)
    app.add_typer(design, rich_help_panel="More")
    for name, stage in STAGES.items():
        app.command(name, rich_help_panel="Stages of the workflow")(_stage_command(name, stage))


# ------------------------------------------------------------------------------
# The command line itself, which starts quickly and prints no tracebacks.

app = new_app(
    "vinetrack",
    "From recordings of everting vine robots to the physics that a model of them lacks.\n\n"
    "Three commands do most: vinetrack setup FOLDER, vinetrack run FOLDER, vinetrack explore RESULTS.",
)


def main() -> None:
    """Entry of the `vinetrack` command."""
    gc.set_threshold(100_000, 50, 50)  # the usual 700, 10, 10 cost a twentieth of the processor time (measured)
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
    from vinetrack.core.process import THREAD_PREFIX

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


if __name__ == "__main__":
    main()
