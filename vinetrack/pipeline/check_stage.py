"""The command `vinetrack check`: facts about the recordings of an experiment, and all problems, before any analysis."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem, format_problems


@dataclass(frozen=True)
class CheckReport:
    """Result of a check: `problems`, facts about each recording (`recordings`, also as lines), and `notes`."""

    problems: tuple[Problem, ...]
    recordings: tuple[dict[str, Any], ...]
    recording_lines: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def failed(self) -> bool:
        """Whether there is an error."""
        return any(problem.severity == "error" for problem in self.problems)

    def lines(self) -> list[str]:
        """Return facts and notes, then the problems in at most 20 lines, notes included."""
        facts = [*self.recording_lines, *self.notes]
        return [*facts, *format_problems(self.problems, 20 - len(self.notes))]

    def to_json(self) -> dict[str, Any]:
        """Return the report for a program."""
        problems = [{key: value for key, value in vars(problem).items() if value} for problem in self.problems]
        return {"recordings": list(self.recordings), "notes": list(self.notes), "problems": problems}


def check_folder(folder: Path) -> CheckReport:
    """Check sheet, settings, effects, tracks and recordings of an experiment."""
    from vinetrack.experiment.folder import SETTINGS, SHEET, check_experiment, read_experiment
    from vinetrack.pipeline.effects_stage import model_problems
    from vinetrack.pipeline.run_folders import path_problems
    from vinetrack.planning.pressure_plausibility import pressure_problems, track_speed
    from vinetrack.tracks.importers import TrackError, load_track
    from vinetrack.tracks.position_noise import common_rounding_noise
    from vinetrack.tracks.smoothed_positions import detect_smoothing
    from vinetrack.video.recording_facts import axis_notes, direction_notes, facts_entry, facts_rows
    from vinetrack.video.survey import Surveyor

    surveyor = Surveyor()
    problems = [*path_problems(folder.absolute()), *check_experiment(folder, surveyor), *model_problems(folder)]
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError:
        return CheckReport(tuple(problems), (), (), ())
    facts = {trial.name: recording_facts for trial, recording_facts in surveyor.facts.items()}
    trials = [trial for trial in experiment.trials if trial.name in facts]
    speeds = [(trial, facts[trial.name].mean_speed_m_s) for trial in trials]
    tracks = []
    for trial in experiment.trials:
        if trial.track is not None:
            with contextlib.suppress(TrackError):
                tracks.append((trial, load_track(trial)))
    speeds += [(trial, track_speed(track)) for trial, track in tracks]
    # The plausibility of a pressure depends on the sizes, so it is tested only if these have no errors.
    if not any(problem.severity == "error" for problem in problems):
        stated_in = SHEET if "pressure_kPa" in experiment.columns else SETTINGS
        problems += [replace(problem, file=stated_in) for problem in pressure_problems(speeds)]
    entries = [facts[trial.name] for trial in trials]
    lines = facts_rows(entries, trials) if entries else []
    if 0 < len(surveyor.looked_into) < len(entries):
        lines.append(f"{len(surveyor.looked_into)} of {len(entries)} recordings were examined, one of each condition")
    notes = list(experiment.blank_notes)
    notes += [*direction_notes(entries, trials, experiment.angle_blank), *axis_notes(entries, trials)]
    rounding_m = common_rounding_noise([track.lead_position_m[track.usable] for _, track in tracks])
    smoothing = detect_smoothing(tracks, rounding_m)
    if smoothing is not None:
        notes.append(smoothing.note)
    if rounding_m > 0:
        notes.append(
            f"Positions are rounded to {1e3 * math.sqrt(12) * rounding_m:.3g} mm, and rounding is most of their noise:"
            " export them with all measured digits."
        )
    return CheckReport(tuple(problems), tuple(map(facts_entry, entries)), tuple(lines), tuple(notes))
