"""The command `vinetrack check`: what was understood of an experiment, and what is wrong with it, before any work."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import ExperimentError, Problem, format_problems

if TYPE_CHECKING:
    from vinetrack.core.records import Trial


@dataclass(frozen=True)
class Checked:
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


def check_folder(folder: Path) -> Checked:
    """Check sheet, settings, effects, tracks and recordings of an experiment.

    Parameters
    ----------
    folder : folder of the experiment.

    Returns
    -------
    Checked
    """
    from vinetrack.experiment.folder import check_experiment, read_experiment
    from vinetrack.pipeline.effects_stage import model_problems
    from vinetrack.pipeline.workflow import path_problems
    from vinetrack.planning.pressure_plausibility import pressure_problems
    from vinetrack.video.recording_facts import facts_entry, facts_rows
    from vinetrack.video.survey import Surveyor

    surveyor = Surveyor()
    problems = [*path_problems(folder.absolute()), *check_experiment(folder, surveyor), *model_problems(folder)]
    try:
        experiment = read_experiment(folder, strict=False)
    except ExperimentError:
        return Checked(tuple(problems), (), (), ())
    facts = {trial.name: known for trial, known in surveyor.facts.items()}
    trials = [trial for trial in experiment.trials if trial.name in facts]
    speeds = [(trial, facts[trial.name].mean_speed_m_s) for trial in trials]
    speeds += [(trial, _track_speed(trial)) for trial in experiment.trials if trial.track is not None]
    # Sizes that are wrong make the damping wrong that speeds imply.
    if not any(problem.severity == "error" for problem in problems):
        problems += pressure_problems(speeds)
    seen = [facts[trial.name] for trial in trials]
    lines = facts_rows(seen, trials) if seen else []
    if 0 < len(surveyor.looked_into) < len(seen):
        lines.append(f"{len(surveyor.looked_into)} of {len(seen)} recordings were looked into, one of each condition")
    return Checked(tuple(problems), tuple(map(facts_entry, seen)), tuple(lines), tuple(experiment.blank_notes))


def _track_speed(trial: Trial) -> float:
    """Mean speed of the leading edge over the middle of its travel, m/s; NaN where the track does not say."""
    from vinetrack.tracks.importers import TrackError, load_track

    try:
        track = load_track(trial)
    except TrackError:
        return math.nan
    time_s, position_m = track.time_s[track.usable], track.lead_position_m[track.usable]
    travel_m = np.maximum.accumulate(position_m - position_m[0]) if position_m.size else position_m
    if travel_m.size < 5 or not travel_m[-1] > 0:
        return math.nan
    early, late = (int(np.searchsorted(travel_m, part * travel_m[-1])) for part in (0.2, 0.9))
    duration_s = float(time_s[late] - time_s[early])
    return float(travel_m[late] - travel_m[early]) / duration_s if duration_s > 0 else math.nan
