"""The command `vinetrack campaign`: sequential looks at a growing set of trials, recorded in a ledger."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import write_json
from vinetrack.diagnosis.result import ADEQUATE, ARTEFACT, MISSING
from vinetrack.diagnosis.stopping import STOP, CampaignLook, look_at, trials_to_go
from vinetrack.experiment.provenance import PROVENANCE

if TYPE_CHECKING:
    from vinetrack.core.records import Track, Trial
    from vinetrack.diagnosis.result import Diagnosis

LEDGER = "campaign.json"  # File name of the ledger, beside the sheet (convention)

DEFAULT_RISK = 0.03  # Default risk of stopping with a wrong effect (chosen)

# What to do next where no particular trials can be recommended
VARY_MORE = "Vary more from trial to trial: other pressures, payloads, chambers, connectors or vines."


@dataclass(frozen=True)
class Ledger:
    """The looks at a campaign, in order. `risk` is stated at the first look and cannot change; `marks` are fingerprints
    of the data of each look; `next_text` says what to do next.
    """

    risk: float
    looks: tuple[CampaignLook, ...] = ()
    marks: tuple[str, ...] = ()
    next_text: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the content of the ledger file."""
        looks = [{**look.to_json(), "data": mark} for look, mark in zip(self.looks, self.marks, strict=True)]
        return {"risk": self.risk, "looks": looks, "next": self.next_text}


def look_at_folder(target: Path, risk: float | None = None, experiment: Path | None = None) -> Ledger:
    """Add a look at a campaign to its ledger."""
    diagnosis, pairs, folder = _diagnose_target(target, experiment)
    previous = read_ledger(folder / LEDGER)
    if previous is not None and risk is not None and risk != previous.risk:
        remedy = f"keep {previous.risk:g}, or delete {folder / LEDGER} to start a new campaign"
        problem = Problem(
            message="differs from the risk stated at the first look", column="--risk", value=f"{risk:g}", remedy=remedy
        )
        raise ExperimentError([problem])
    ledger = previous or Ledger(DEFAULT_RISK if risk is None else risk)
    mark, look = _data_fingerprint(pairs), look_at(diagnosis, len(pairs), ledger.risk)
    looks, marks = ledger.looks, ledger.marks
    if marks and marks[-1] == mark:
        looks, marks = looks[:-1], marks[:-1]
    ledger = replace(
        ledger, looks=(*looks, look), marks=(*marks, mark), next_text=_next_step(diagnosis, look, target, experiment)
    )
    write_json(folder / LEDGER, ledger.to_json())
    return ledger


def _diagnose_target(target: Path, experiment: Path | None) -> tuple[Diagnosis, Sequence[tuple[Trial, Track]], Path]:
    """Return the diagnosis of the target, its trials with their tracks, and the folder of its sheet."""
    from vinetrack.diagnosis.diagnose import diagnose
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.inference.fit_data import pairs_of
    from vinetrack.pipeline.effects_stage import read_source_experiment
    from vinetrack.pipeline.model_stage import measured_trials
    from vinetrack.pipeline.workflow import find_experiment
    from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis

    if (target / PROVENANCE).exists():
        read = read_source_experiment(target, experiment)
        results = Results(target)
        stored = read_diagnosis(results)
        if stored is None:
            raise ResultsError(f"{target} has no diagnosis yet: run `vinetrack run {read.folder}` first")
        return stored, measured_trials(read, results)[0], read.folder
    read = read_experiment(find_experiment(target))
    if all(trial.track is None for trial in read.trials):
        raise ResultsError(
            f"{target} holds recordings: track them first with `vinetrack run {target}`, then give its results folder"
        )
    return diagnose(read, ladder=False), pairs_of(read)[0], read.folder


def _data_fingerprint(pairs: Sequence[tuple[Trial, Track]]) -> str:
    """Return a short hash of the trials and their positions."""
    code = hashlib.sha256()
    for trial, track in pairs:
        code.update(trial.name.encode())
        code.update(track.lead_position_m.tobytes())
    return code.hexdigest()[:12]


def _next_step(diagnosis: Diagnosis, look: CampaignLook, target: Path, experiment: Path | None) -> str:
    """Say what to do next, in one or two sentences."""
    if look.decision == STOP:
        return "Stop: this question needs no further trials."
    advice = diagnosis.next_experiment
    if advice is not None and advice.get("text"):
        return str(advice["text"])
    text = _recommendation(look, target, experiment)
    if look.verdict == ADEQUATE:
        return (
            f"{text or VARY_MORE} Or choose an effect and a size that matter: `vinetrack power TARGET --effect "
            "NAME=SIZE --reach 0.9` says which trials would detect it."
        )
    further = trials_to_go(look)
    if further and text:
        return f"{text} With trials like those so far, about {further} would be needed."
    if further:
        return f"Run about {further} further trials like those so far, by the growth of the log-likelihood ratio."
    return text or VARY_MORE


def _recommendation(look: CampaignLook, target: Path, experiment: Path | None) -> str:
    """The trials that reveal most, or that confirm the one effect named; blank where none can be recommended."""
    from vinetrack.dynamics.simulate import SimulationError
    from vinetrack.inference.fit_data import FitError
    from vinetrack.pipeline.power_stage import recommended_trials

    one_named = look.verdict in (MISSING, ARTEFACT) and len(look.names) == 1
    if not (look.verdict == ADEQUATE or one_named):
        return ""
    try:
        return recommended_trials(target, experiment, look)
    except (FitError, SimulationError):
        return ""


def read_ledger(path: Path) -> Ledger | None:
    """Read a ledger."""
    import json

    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Ledger(
            float(content["risk"]),
            tuple(CampaignLook.from_json(entry) for entry in content["looks"]),
            tuple(str(entry["data"]) for entry in content["looks"]),
            str(content.get("next") or ""),
        )
    except (ValueError, KeyError, TypeError):
        remedy = "move it away to start a new campaign"
        raise ExperimentError([Problem(message="is not a campaign ledger", value=str(path), remedy=remedy)]) from None


def ledger_lines(ledger: Ledger) -> list[str]:
    """Return the output of `vinetrack campaign`: one row per look, the reason of the decision, and what to do next."""
    from vinetrack.core.terminal import table

    rows = [
        (
            str(k), str(look.trials), look.verdict, " or ".join(look.names) or "–",
            "–" if look.log_ratio != look.log_ratio else f"{look.log_ratio:.1f}", f"{look.needed:.1f}", look.decision,
        )
        for k, look in enumerate(ledger.looks, 1)
    ]  # fmt: skip
    head = ("look", "trials", "verdict", "named", "ln ratio", "needed", "")
    last = ledger.looks[-1]
    return [
        *table(rows, head, align=">><<>><"),
        f"Risk of stopping with a wrong effect, over all looks: {100 * ledger.risk:g} %.",
        f"{last.decision.capitalize()}: {last.why}.",
        *([] if last.decision == STOP else [f"Next: {ledger.next_text}"]),
    ]
