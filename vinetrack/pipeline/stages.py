"""The stages of a run: one table of what each reads and writes, from which Snakemake's rules and the commands are made.

A stage is a function of an experiment, a results folder and settings; it returns lines for the terminal. Every command
that does part of a run calls the same function. Imports stay light: Snakemake loads this module in every job.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings


@dataclass(frozen=True)
class Job:
    """What a stage is asked for: `trials` are the names of some trials, None for all; `say` shows what it is doing."""

    experiment: Experiment
    results: Path
    settings: RunSettings
    trials: Sequence[str] | None = None
    threads: int = 1
    say: Callable[[str], None] = lambda _: None


@dataclass(frozen=True)
class Stage:
    """One stage. `settings` are the keys of a run that it depends on; `reads` and `writes` are files of the results,
    or groups of files that the plan of a run knows, in `<…>`; a folder ends with `/`.
    """

    run: Callable[[Job], list[str]]
    settings: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    done: str
    parallel: bool = False
    priority: int = 0


def _trials(job: Job) -> list[str]:
    """Track recordings, analyse the motion of every trial, and draw both."""
    from vinetrack.pipeline.trials import analyse_trials

    failed = analyse_trials(job.experiment, job.results, job.settings, job.threads, job.trials, job.say)
    return [f"  {name}: {reason}" for name, reason in list(failed.items())[:10]]


def _damping(job: Job) -> list[str]:
    """Gather the trials in the tables of the experiment, and fit the damping law and its scaling with size."""
    from vinetrack.narrative.diagnosis_text import damping_headline
    from vinetrack.pipeline.trials import fit_law, gather

    table = gather(job.experiment, job.results, job.settings)
    law = damping_headline(fit_law(job.results, job.settings.damping))
    return [f"{len(table)} trials, {int((table['status'] == 'failed').sum())} failed.", law]


def _model(job: Job) -> list[str]:
    """Fit the model in use and compare it with the tracks, audit neglected effects, and diagnose what it lacks."""
    from vinetrack.pipeline.model_stage import comparison_lines, diagnose_results, diagnosis_lines, fit_model

    job.say("fitting the model")
    _, fitted = fit_model(job.experiment, job.results, job.settings)
    diagnose_results(job.experiment, job.results, job.say, job.settings, fitted)
    return [*comparison_lines(job.results), *diagnosis_lines(job.results)]


def _figures(job: Job) -> list[str]:
    """Draw the figures of the whole experiment."""
    from vinetrack.pipeline.report_stage import draw_campaign

    drawn = draw_campaign(job.experiment, job.results, job.settings.figures)
    return [f"{len(drawn)} figures."]


def _paper(job: Job) -> list[str]:
    """Compare with the published numbers and figures of the paper."""
    from vinetrack.pipeline.report_stage import compare_with_paper, draw_paper
    from vinetrack.report.section import tally

    table = compare_with_paper(job.experiment, job.results)
    draw_paper(job.results, job.settings.figures)
    return [f"Comparison with the paper: {tally(table)}"]


def _overlays(job: Job) -> list[str]:
    """Write slowed-down clips of the recordings with tracked and modelled edges."""
    from vinetrack.pipeline.overlays_stage import draw_overlays

    return [f"  {line}" for line in draw_overlays(job.experiment, job.results, job.settings.overlays, job.threads)]


def _report(job: Job) -> list[str]:
    """Write the report, a single file, and the provenance of the results."""
    from vinetrack.pipeline.report_stage import write_report

    settings: dict[str, Any] = job.settings.model_dump(mode="json", exclude={"experiment", "results"})
    return [f"Report: {write_report(job.experiment, job.results, settings)}"]


STAGES = {
    "trials": Stage(
        _trials,
        ("steady", "velocity", "final_at_fraction", "efficiency_at_mm", "figures"),
        ("<experiment>", "<measurements>"),
        ("<tracks>", "<kinematics>", "<analysed>", "<pictures>"),
        "trials analysed",
        parallel=True,
    ),
    "damping": Stage(
        _damping,
        ("final_at_fraction", "efficiency_at_mm", "damping"),
        ("<experiment>", "<analysed>"),
        ("trials.csv", "conditions.csv", "steady.csv", "damping_points.csv", "damping.json", "scaling.json"),
        "damping law fitted",
    ),
    "model": Stage(
        _model,
        ("steady", "velocity", "damping", "final_at_fraction"),
        ("<experiment>", "<tracks>", "<kinematics>", "trials.csv", "damping.json"),
        ("fit.json", "comparison.csv", "model_check.csv", "audit.csv", "comparison/", "diagnosis.json", "ladder.csv",
         "diagnosis/"),
        "model fitted and diagnosed",
        priority=1,
    ),
    "figures": Stage(
        _figures,
        ("figures",),
        ("<kinematics>", "trials.csv", "damping.json", "fit.json", "diagnosis.json", "diagnosis/"),
        ("figures/campaign.json",),  # which figures have content is not known in advance
        "figures of the experiment drawn",
    ),
    "paper": Stage(
        _paper,
        ("figures",),
        ("<experiment>", "<kinematics>", "steady.csv", "damping.json", "fit.json"),
        ("<paper>",),
        "comparison with the paper made",
    ),
    "overlays": Stage(
        _overlays,
        ("overlays",),
        ("<measurements>", "<tracks>", "<analysed>", "trials.csv", "fit.json", "diagnosis.json", "diagnosis/"),
        ("overlays/",),
        "clips drawn",
        parallel=True,
    ),
    "report": Stage(
        _report,
        (),
        ("<inputs>", "<pictures>", "figures/campaign.json", "<made of paper>", "<made of overlays>", "diagnosis.json"),
        ("report.html", "provenance.json"),
        "report written",
    ),
}  # fmt: skip
