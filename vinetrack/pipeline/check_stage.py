"""The command `vinetrack check`: what was understood of an experiment, and what is wrong with it, before any work."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem, format_problems


@dataclass(frozen=True)
class CheckReport:
    """Problems of an experiment; `recordings` what was understood of each; `notes` what a blank cell stands for."""

    problems: tuple[Problem, ...]
    recordings: tuple[dict[str, Any], ...]
    recording_lines: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def failed(self) -> bool:
        """Whether any problem is an error."""
        return any(problem.severity == "error" for problem in self.problems)

    def lines(self) -> list[str]:
        """What was understood, then the problems in at most 20 lines."""
        understood = [*self.recording_lines, *self.notes]
        return [*understood, *format_problems(self.problems, 20 - len(self.notes))]

    def to_json(self) -> dict[str, Any]:
        """The same for a program."""
        problems = [{key: value for key, value in vars(problem).items() if value} for problem in self.problems]
        return {"recordings": list(self.recordings), "notes": list(self.notes), "problems": problems}


def check_folder(folder: Path) -> CheckReport:
    """Check sheet, settings, effects, tracks and recordings of an experiment.

    Parameters
    ----------
    folder : folder of the experiment.

    Returns
    -------
    CheckReport
    """
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
    facts = {trial.name: known for trial, known in surveyor.facts.items()}
    trials = [trial for trial in experiment.trials if trial.name in facts]
    speeds = [(trial, facts[trial.name].mean_speed_m_s) for trial in trials]
    handed_in = []
    for trial in experiment.trials:
        if trial.track is not None:
            with contextlib.suppress(TrackError):
                handed_in.append((trial, load_track(trial)))
    speeds += [(trial, track_speed(track)) for trial, track in handed_in]
    # Sizes that are wrong make the damping wrong that speeds imply.
    if not any(problem.severity == "error" for problem in problems):
        stated_in = SHEET if "pressure_kPa" in experiment.columns else SETTINGS
        problems += [replace(problem, file=stated_in) for problem in pressure_problems(speeds)]
    seen = [facts[trial.name] for trial in trials]
    lines = facts_rows(seen, trials) if seen else []
    if 0 < len(surveyor.looked_into) < len(seen):
        lines.append(f"{len(surveyor.looked_into)} of {len(seen)} recordings were looked into, one of each condition")
    notes = [*experiment.blank_notes, *direction_notes(seen, trials, experiment.angle_blank), *axis_notes(seen, trials)]
    rounding_m = common_rounding_noise([track.lead_position_m[track.usable] for _, track in handed_in])
    smoothing = detect_smoothing(handed_in, rounding_m)
    if smoothing is not None:
        notes.append(smoothing.note)
    if rounding_m > 0:
        notes.append(
            f"Positions are rounded to {1e3 * math.sqrt(12) * rounding_m:.3g} mm, and rounding is most of their noise:"
            " hand them in with all digits that were measured."
        )
    return CheckReport(tuple(problems), tuple(map(facts_entry, seen)), tuple(lines), tuple(notes))
