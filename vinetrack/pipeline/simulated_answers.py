"""Simulation of campaigns in one or several processes, with each answer stored in a file when it is ready.

When a simulation is resumed, only missing answers are simulated; stored answers of other designs are ignored.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vinetrack.diagnosis.campaign_power import CampaignDesign
from vinetrack.diagnosis.null_calibration import TESTS, CampaignPValues, null_p_values
from vinetrack.diagnosis.simulated_power import SimulatedDiagnosis, simulated_diagnosis
from vinetrack.pipeline.pool import map_unordered

Task = tuple[CampaignDesign, str, float, int]
ANSWER_COLUMNS = ("design", "effect", "value", "seed", "verdict", "answer_set", "effects", "seconds", "failed")
P_VALUE_COLUMNS = ("design", "seed", *TESTS, "failed")


@dataclass(frozen=True)
class Simulation:
    """Settings of a simulation: number of campaigns, first seed, number of processes, and file of answers."""

    campaigns: int
    first_seed: int
    jobs: int
    path: Path

    @property
    def seeds(self) -> range:
        """Seeds of the campaigns."""
        return range(self.first_seed, self.first_seed + self.campaigns)


def simulate_answers(
    design: CampaignDesign, wanted: Sequence[tuple[str, float]], simulation: Simulation
) -> dict[tuple[str, str, int], SimulatedDiagnosis]:
    """Simulate campaigns and diagnose each completely. Returns answers by effect, `size_key` of the size, and seed."""
    from vinetrack.core.terminal import Progress, progress

    mark = fingerprint(design)
    kept = {(a.effect, size_key(a.value), a.seed): a for a in stored_answers(simulation.path, mark)}
    tasks: list[Task] = [
        (design, effect, value, seed)
        for seed in simulation.seeds
        for effect, value in wanted
        if (effect, size_key(value), seed) not in kept
    ]
    total = len(wanted) * simulation.campaigns
    bar: Progress[None]
    with progress(total, "simulating", unit="campaign") as bar:
        bar.advance(total - len(tasks))
        for answer in map_unordered(_diagnose_task, tasks, simulation.jobs):
            _append_row(simulation.path, ANSWER_COLUMNS, _row(mark, answer))
            kept[answer.effect, size_key(answer.value), answer.seed] = answer
            bar.advance()
    return kept


def simulate_null_tests(design: CampaignDesign, simulation: Simulation) -> list[CampaignPValues]:
    """Apply every test to simulated null campaigns."""
    from vinetrack.core.terminal import Progress, progress

    mark = fingerprint(design)
    kept = {campaign.seed: campaign for campaign in _stored_p_values(simulation.path, mark)}
    tasks = [(design, seed) for seed in simulation.seeds if seed not in kept]
    bar: Progress[None]
    with progress(simulation.campaigns, "calibrating", unit="campaign") as bar:
        bar.advance(simulation.campaigns - len(tasks))
        for campaign in map_unordered(_test_task, tasks, simulation.jobs):
            values = [f"{campaign.p_values[name]:.6g}" if campaign.p_values else "" for name in TESTS]
            _append_row(simulation.path, P_VALUE_COLUMNS, [mark, campaign.seed, *values, campaign.failed])
            kept[campaign.seed] = campaign
            bar.advance()
    return [kept[seed] for seed in simulation.seeds]


def size_key(value: float) -> str:
    """Return the text of a size in the file of answers."""
    return "" if math.isnan(value) else f"{value:.9g}"


def _diagnose_task(task: Task) -> SimulatedDiagnosis:
    return simulated_diagnosis(*task)


def _test_task(task: tuple[CampaignDesign, int]) -> CampaignPValues:
    return null_p_values(*task)


def fingerprint(design: CampaignDesign) -> str:
    """Return a short hash of everything that simulated campaigns depend on."""
    parts = (design.model.names, sorted(design.model.values.items(), key=str), design.trials, design.cameras)
    around = (
        design.spreads,
        design.slow_error_m,
        design.has_trace,
        design.candidates,
        sorted(design.other_values.items()),
    )
    return hashlib.sha256(repr((parts, around)).encode()).hexdigest()[:12]


def stored_answers(path: Path, mark: str) -> list[SimulatedDiagnosis]:
    """Return the stored answers of a design."""
    return [
        SimulatedDiagnosis(
            effect=row["effect"],
            value=float(row["value"] or "nan"),
            seed=int(row["seed"]),
            verdict=row["verdict"],
            answer_set=tuple(row["answer_set"].split("|")) if row["answer_set"] else (),
            effects=tuple(row["effects"].split("|")) if row["effects"] else (),
            seconds=float(row["seconds"] or "nan"),
            failed=row["failed"],
        )
        for row in _stored_rows(path, mark)
    ]


def _stored_p_values(path: Path, mark: str) -> list[CampaignPValues]:
    """Chances that an earlier run has kept about this design."""
    return [
        CampaignPValues(int(row["seed"]), {name: float(row[name]) for name in TESTS if row[name]}, row["failed"])
        for row in _stored_rows(path, mark)
    ]


def _stored_rows(path: Path, mark: str) -> list[dict[str, str]]:
    """Return the complete rows of a design; none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return [row for row in csv.DictReader(stream) if row.get("design") == mark and row.get("failed") is not None]


def _row(mark: str, answer: SimulatedDiagnosis) -> list[object]:
    seconds = "" if math.isnan(answer.seconds) else f"{answer.seconds:.2f}"
    return [
        mark, answer.effect, size_key(answer.value), answer.seed, answer.verdict, "|".join(answer.answer_set),
        "|".join(answer.effects), seconds, answer.failed,
    ]  # fmt: skip


def _append_row(path: Path, columns: Sequence[str], row: Sequence[object]) -> None:
    """Append a row to the file; write the header first if the file is new."""
    new = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(columns)
        writer.writerow(row)
