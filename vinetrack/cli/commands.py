"""The commands: about an experiment, its results, the catalogue, vines that do not exist yet; and one for each stage.

A command is a function of arguments and options that returns lines, and the same content for a program; `options.csv`
states what it takes.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vinetrack.cli.options import MORE, START, Answer, command
from vinetrack.core.problems import UserError
from vinetrack.core.tables import safe_join, write_csv, write_text
from vinetrack.core.terminal import table, waiting
from vinetrack.pipeline.stages import STAGES, Job, Kept, Stage, code_hash, compilation_told, identity

if TYPE_CHECKING:
    from vinetrack.effects import Effect

Say = Callable[[str], None]

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
    from vinetrack.pipeline.workflow import check_folder, find_experiment

    checked = check_folder(find_experiment(experiment))
    is_sound = all(problem.severity == "note" for problem in checked.problems)
    lines = [*checked.lines(), *[f"{experiment}: no problems found."] * is_sound]
    return lines, checked.to_json(), checked.failed


@command()
def _run(folder: Path, cores: int, results: Path | None, verbose: bool, say: Say) -> Answer:
    """Run everything: recordings to tracks, damping law, model, diagnosis and report; the verdict comes last."""
    from vinetrack.pipeline.workflow import check_before_run, run_chain, run_paths
    from vinetrack.results.folder_layout import Results, read_json

    paths = run_paths(folder, results)
    with compilation_told(say):
        check_before_run(*paths, say)
    run_chain(*paths, cores, say, verbose)
    to = Results(paths[1])
    lines, failed = _run_lines(to.folder)
    return lines, {"results": to.folder, "report": to.report, "diagnosis": read_json(to.diagnosis)}, failed


def _run_lines(folder: Path) -> tuple[list[str], bool]:
    """Summarise finished results in at most twelve lines: failed trials, report, the table in short, the verdict last,
    or why there is none and what to do; and whether most trials failed or there is no verdict. They are kept, since
    reading a diagnosis takes most of a second.
    """
    from vinetrack.results.folder_layout import Results, read_diagnosis, read_result

    results = Results(folder)

    def summary() -> tuple[list[str], bool]:
        from vinetrack.narrative.diagnosis_text import failures_told, table_lines
        from vinetrack.narrative.verdict_text import verdict_line, verdict_table

        trials, diagnosis = read_result(results.trials), read_diagnosis(results)
        told, failed = failures_told(trials)
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

    state = code_hash(), results.report, identity(results.trials), identity(results.diagnosis)
    return Kept(folder).made("lines", state, summary)


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
    from vinetrack.kinematics.summary import look_at_motions
    from vinetrack.pipeline.model_stage import diagnosed, write_diagnosis
    from vinetrack.pipeline.workflow import find_experiment
    from vinetrack.results.folder_layout import Results, measured_trials, read_json, read_source_experiment

    results = Results(target)
    if results.provenance.exists():
        source = read_source_experiment(target, experiment)
        pairs = measured_trials(source, results)
        diagnosis = diagnosed(source, results, pairs, report)
        if json is None:
            settings = run_settings(read_json(results.provenance)["settings"])
            write_diagnosis(results, diagnosis, partial(look_at_motions, pairs, settings), settings)
        return [str(diagnosis).replace("RESULTS", str(target))], diagnosis.to_json()
    read = read_experiment(find_experiment(target))
    if read.trials and all(trial.track is None for trial in read.trials):
        raise UserError(
            f"{target}: its trials are recordings, which must be tracked first: vinetrack run {target} tracks and "
            f"diagnoses them; after that, vinetrack diagnose {Path('results') / read.name}"
        )
    diagnosis = diagnose(read, report=report)
    return [str(diagnosis)], diagnosis.to_json()


@command()
def _add(effect: str, results: Path, save: bool, experiment: Path | None, report: Say) -> Answer:
    """Add an effect to the model, or several as A+B, refit, and show the error before and after."""
    from vinetrack.diagnosis.propose import add
    from vinetrack.narrative.diagnosis_text import added_in_words
    from vinetrack.pages.draft_files import save_model
    from vinetrack.pipeline.workflow import command_for_results
    from vinetrack.results.folder_layout import Results, measured_trials, read_source_experiment

    read = read_source_experiment(results, experiment)
    names = [effect] if Path(effect).is_file() else effect.split("+")
    own_files = [Path(name) for name in names if name.endswith(".py")]
    if save and any(file.resolve().parent != read.folder.resolve() for file in own_files):
        raise UserError(
            f"{effect}: to save the model, move the file into {read.folder} first; an experiment is one folder."
        )
    tracks = {trial.name: track for trial, track in measured_trials(read, Results(results))}
    before, after, ladder = add(read, tracks, names, report)
    lines = added_in_words(before, after, ladder)
    if save:
        added = [Path(name).stem for name in names]
        path = save_model(read.folder, [*read.settings.model, *added], [file.name for file in own_files])
        lines.append(f"Saved to {path}; to update all results: {command_for_results(read.folder, results)}")
    return lines, {"effect": effect, "saved": save, "lines": lines, "ladder": ladder.to_dict("records")}


@command()
def _propose(results: Path, experiment: Path | None, report: Say) -> Answer:
    """Write the force law that explains best what no known effect explains, as an effect file of your own."""
    from vinetrack.pipeline.model_stage import propose_effect
    from vinetrack.results.folder_layout import read_source_experiment

    lines, files = propose_effect(read_source_experiment(results, experiment), results, report)
    return lines, {"lines": lines, "files": files}


@command()
def _compare(results: Path) -> Answer:
    """Compare model and measurement of every condition, with the scatter of replicates."""
    from vinetrack.diagnosis.ladder import comparison_lines
    from vinetrack.narrative.verdict_text import verdict_line
    from vinetrack.results.folder_layout import Results, read_diagnosis, read_fit, read_result

    fit, compared = read_fit(Results(results)), read_result(Results(results).comparison)
    content, diagnosis = compared.to_dict("records"), read_diagnosis(Results(results))
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
    from vinetrack.pipeline.workflow import find_experiment

    folder = Path() if experiment is None else find_experiment(experiment)
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
    rows = [
        (
            p.symbol,
            p.unit,
            f"{p.default:g}",
            f"{p.bounds[0]:g} to {p.bounds[1]:g}",
            f"{p.plausible[0]:g} to {p.plausible[1]:g}" if p.plausible else "–",
            # A shape, such as an exponent or a length, does not make an effect vanish: its `zero` is its default.
            "–" if p.zero == p.default else f"{p.zero:g}",
            "all" if p.shared == "all" else f"each {p.shared}",
            f"{p.meaning} [{effect.name}.{p.name}]{', known beforehand' if p.held else ''}",
        )
        for p in effect.parameters
    ]
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
    from vinetrack.pipeline.planning_stage import PowerRequest, power_of_target, sheet_rows

    power = power_of_target(PowerRequest(target=target, **options))
    lines = [*str(power).splitlines(), *write_figure(figure, power.plot)]
    if rows_file is not None and (rows := sheet_rows(power)):
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
        from vinetrack.pipeline.workflow import RUN, find_experiment

        read = read_experiment(find_experiment(experiment))
        if unknown := [one for one in trials or () if one not in read.names]:
            raise typer.BadParameter(f"{unknown[0]!r} is not a trial of the sheet", param_hint="--trials")
        in_run = RUN in os.environ
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
        (app, START, (_setup, _track, _check, _run, _explore)),
        (app, MORE, (_diagnose, _add, _propose, _power, _predict, _settings, _effects, _compare, _overlay)),
        (design, None, (_vine, _reservoir)),
    )
    for group, panel, commands in groups:
        for one in commands:
            group.command(one.__name__.removeprefix("_"), rich_help_panel=panel)(one)
    app.add_typer(design, rich_help_panel=MORE)
    for name, stage in STAGES.items():
        app.command(name, rich_help_panel="Stages of the workflow")(_stage_command(name, stage))
