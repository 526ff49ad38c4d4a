"""What the report of a results folder shows: clips of its recordings, figures, the comparison with the paper, the page;
and the same of a single recording, without an experiment.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import vinetrack.results as layout
from vinetrack.core.problems import INTERNAL_ERROR, UserError
from vinetrack.core.process import table
from vinetrack.core.records import PictureAxis, Trial
from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.core.units import number
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import ExperimentSettings, FigureSettings, OverlaySettings, read_experiment_settings
from vinetrack.figures.registry import FigureTables, draw, figures_of
from vinetrack.figures.style import render
from vinetrack.paper import rows as paper
from vinetrack.pipeline.workflow import SHARED_FILES, Job, input_files, map_unordered
from vinetrack.report.build import build_report, recording_facts, report_content, tally, write_overlay, write_recording
from vinetrack.video.frames import inspect_recording
from vinetrack.video.survey import measure_recording

log = logging.getLogger(__name__)


def write_report(job: Job) -> list[str]:
    """Draw what the report shows, write the tables of the paper's numbers, `provenance.json` and `report.html`."""
    experiment, results, lines = job.experiment, layout.Results(job.results), list[str]()
    if experiment.settings.published:
        tables = paper.paper_tables(
            experiment.trials,
            paper.SIMULATED if experiment.settings.published == "simulated" else paper.MEASURED,
            layout.read_fit(results),
            lambda name: layout.read_result(results.kinematics(name)),
            layout.read_result(results.steady),
            damping=layout.read_json(results.damping),
            scaling=layout.read_json(results.scaling),
            conditions=layout.read_result(results.conditions),
        )
        for name, content in tables.items():
            write_csv(results.folder / f"{name}.csv", content)
        lines.append(f"Comparison with the paper: {tally(tables['paper'])}")
    lines += [*draw_overlays(job), *draw_figures(job)]
    job.say("writing the report")
    settings = job.settings.model_dump(mode="json", exclude={"experiment", "results"})
    inputs = [path for path in input_files(experiment) if path.exists() or path.name not in SHARED_FILES]
    provenance = layout.describe_run(experiment.folder, inputs, settings, experiment.settings.model)
    page = build_report(report_content(experiment, job.results, provenance))
    write_json(results.provenance, provenance)
    write_text(results.report, page)
    return ["written", *lines, f"Report: {results.report}"]


# ------------------------------------------------------------------------------
# Slowed-down clips of recordings with tracked and modelled edges, `overlays/<trial>.mp4`.


def draw_overlays(job: Job) -> list[str]:
    """Write the clips that the settings request, and again those that there are; a line for each that could not be."""
    experiment, results, settings = job.experiment, layout.Results(job.results), job.settings.overlays
    chosen = chosen_trials(experiment, results, settings.of)
    for path in results.overlays.glob("*.mp4"):  # of a trial that is not tracked any more
        if path.stem not in chosen:
            path.unlink()
    work = partial(_try_overlay, results=results, settings=settings)
    messages = []
    for count, line in enumerate(map_unordered(work, [experiment.trial(name) for name in chosen], job.threads), 1):
        messages += [f"  {line}"] if line else []
        job.say(f"{count} of {len(chosen)} clips")
    return sorted(messages)


def overlay_one(folder: Path, trial: str, experiment: Path | None = None, seconds: float = math.nan) -> Path:
    """Write the clip of one trial of a results folder with the settings of its run; return its path."""
    results, read = layout.Results(folder), layout.read_source_experiment(folder, experiment)
    filmed = [one.name for one in read.trials if one.video is not None]
    if trial not in filmed:
        existing = ", ".join(filmed[:6]) + ", …" * (len(filmed) > 6) or "none"
        raise layout.ResultsError(f"{trial!r} is not a trial with a recording in {read.folder}: there are {existing}")
    of_run = layout.read_json(results.provenance).get("settings") or {}
    asked = {"seconds": seconds} if math.isfinite(seconds) else {}
    return write_overlay(read.trial(trial), results, OverlaySettings(**(of_run.get("overlays") or {}) | asked))


def chosen_trials(experiment: Experiment, results: layout.Results, of: str) -> list[str]:
    """Names of trials to draw: the first recording of every condition, all, or none; and those that have a clip."""
    trials = layout.read_result(results.trials)
    tracked = set(trials.loc[~trials["status"].isin(("failed", "left_out")), "trial"])
    filmed = {trial.name: trial.condition for trial in experiment.trials if trial.video and trial.name in tracked}
    first = {condition: name for name, condition in reversed(filmed.items())}
    wanted: dict[str, Collection[str]] = {"all": filmed.keys(), "one_per_condition": first.values(), "none": ()}
    return [name for name in filmed if name in wanted[of] or results.overlay(name).exists()]


def _try_overlay(trial: Trial, results: layout.Results, settings: OverlaySettings) -> str:
    """Write the clip of one trial; return why it could not be made, or blank."""
    try:
        write_overlay(trial, results, settings)
    except Exception as error:
        log.exception("%s: no clip", trial.name)
        return f"{trial.name}: no clip: {error if isinstance(error, layout.ResultsError) else INTERNAL_ERROR}"
    return ""


# ------------------------------------------------------------------------------
# Figures of the whole experiment.


def draw_figures(job: Job) -> list[str]:
    """Draw the figures of the whole experiment that have content; remove those of an earlier run."""
    job.say("drawing figures")
    import_module("matplotlib.backends.backend_svg")  # once, before processes are forked
    names = [*figures_of(), *(figures_of("paper") if job.experiment.settings.published else ())]
    shares = [names[first :: job.threads] for first in range(job.threads)]
    work = partial(_drawn, folder=job.results, trials=job.experiment.trials, settings=job.settings.figures)
    return [f"{sum(map_unordered(work, shares, job.threads))} figures."]


def _drawn(names: Sequence[str], folder: Path, trials: tuple[Trial, ...], settings: FigureSettings) -> int:
    """Draw figures of the whole experiment from tables that are read once; how many have content."""
    tables, count = FigureTables(folder, trials), 0
    for name in names:
        for form in ("png", "svg", "pdf"):
            tables.results.figure(name, f".{form}").unlink(missing_ok=True)
        if figure := draw(name, tables):
            for form, data in render(figure, settings.formats, settings.dpi).items():
                write_bytes(tables.results.figure(name, f".{form}"), data)
            count += 1
    return count


# ------------------------------------------------------------------------------
# The command `vinetrack track`: the leading edge of a single recording as a table, a strip figure and a clip.


def track_file(
    path: Path, *, capture_fps: float = math.nan, exposure_us: float = math.nan, mm_per_px: float = math.nan,
    calibration: Path | None = None, axis: PictureAxis | None = None, frames_used: tuple[int, int] | None = None,
    body: bool = False, out: Path | None = None,
) -> tuple[list[str], dict[str, Any]]:  # fmt: skip
    """Track the leading edge of one recording; write table, strip and clip in `out`. NaN and None for what is not
    given; the scale is `mm_per_px` or the `calibration:` of a settings file. Returns the facts as lines and as JSON.
    """
    scaled, settings = math.isfinite(mm_per_px) or calibration is not None, ExperimentSettings()
    if calibration is not None:
        if math.isfinite(mm_per_px):
            raise UserError("--mm-per-px and --calibration are two scales: give one")
        file = calibration / "experiment.yaml" if calibration.is_dir() else calibration
        settings = ExperimentSettings(calibration=read_experiment_settings(file).calibration)
        if settings.calibration is None:
            raise UserError(f"{file}: states no `calibration:`; give an experiment.yaml that does, or --mm-per-px")
    recording = inspect_recording(path)
    rate = capture_fps if recording.capture_fps is None else recording.capture_fps
    trial = Trial(
        name=path.stem,
        video=recording.path,
        capture_fps=capture_fps if math.isfinite(rate) else 1.0,
        capture_fps_is_playback=True,
        exposure_s=exposure_us / 1e6 if math.isfinite(rate) else math.nan,
        # Without a scale, the unit of length is one pixel.
        m_per_px=mm_per_px / 1e3 if scaled else 1.0,
        travel_ratio=1.0 if body else 2.0,
        axis=axis,
        frames_used=frames_used,
    )
    measured = measure_recording(trial, settings, file.parent if calibration else Path())
    if not math.isfinite(rate):
        track = measured.tracking.track
        untimed = replace(track, time_s=np.full(len(track.time_s), math.nan))
        measured = replace(measured, tracking=replace(measured.tracking, track=untimed))
    written = write_recording(out or Path(f"{recording.path.stem}_track"), measured, scaled)
    facts = recording_facts(measured, rate, 1e3 * measured.m_per_px if scaled else math.nan)
    rows = {name: number(fact) if isinstance(fact, float) else str(fact) for name, fact in facts.items()}
    ends = (*facts["axis"]["from_px"], *facts["axis"]["to_px"])
    rows |= {"axis": "({:z.0f}, {:z.0f}) → ({:z.0f}, {:z.0f}) px".format(*ends)}
    lines = table([(name, text) for name, text in rows.items() if text not in ("–", "None") and name != "notes"])
    lines += [] if math.isfinite(rate) else ["Capture rate unknown: without --capture-fps there are no times."]
    lines += [f"warning: {note}" for note in facts["notes"]]
    return [*lines, "Written: " + ", ".join(map(str, written.values()))], facts | {"written": written}
