"""The command `vinetrack campaign`: a folder's sequence of looks, kept in a ledger beside its sheet."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import write_json
from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.diagnosis.stopping import STOP, CampaignLook, look_at, trials_to_go
from vinetrack.experiment.provenance import PROVENANCE

if TYPE_CHECKING:
    from vinetrack.core.records import Track, Trial
    from vinetrack.diagnosis.result import Diagnosis

LEDGER = "campaign.json"
"""Name of the ledger, beside the sheet. A convention."""

DEFAULT_RISK = 0.03
"""Risk of stopping with a wrong name where none is stated. Chosen: three campaigns in a hundred; at half or twice a
campaign takes about a tenth more or fewer trials, for the risk enters by its logarithm."""


@dataclass(frozen=True)
class Ledger:
    """The looks at a campaign, in order. `risk` was stated at the first and stays; `marks` tell the data of each."""

    risk: float
    looks: tuple[CampaignLook, ...] = ()
    marks: tuple[str, ...] = ()
    next_text: str = ""

    def to_json(self) -> dict[str, Any]:
        """As the ledger holds it."""
        looks = [{**look.to_json(), "data": mark} for look, mark in zip(self.looks, self.marks, strict=True)]
        return {"risk": self.risk, "looks": looks, "next": self.next_text}


def look_at_folder(target: Path, risk: float | None = None, experiment: Path | None = None) -> Ledger:
    """CampaignLook at a campaign once more, and write its ledger.

    Parameters
    ----------
    target : a results folder, whose diagnosis is read, or an experiment of measured tracks, which is diagnosed.
    risk : float, optional
        Of stopping with a wrong name; it cannot be changed once a look was taken.
    experiment : Path, optional
        The experiment of a results folder, if it has moved.

    Returns
    -------
    Ledger
        With a further look where there are other trials than at the last, or the last one replaced.

    Raises
    ------
    ExperimentError, ResultsError, FitError
        If there is nothing to look at, or another risk was stated before.
    """
    diagnosis, pairs, folder = _diagnose_target(target, experiment)
    before = read_ledger(folder / LEDGER)
    if before is not None and risk is not None and risk != before.risk:
        remedy = f"keep {before.risk:g}, or delete {folder / LEDGER} to start a new campaign"
        problem = Problem(
            message="differs from the risk stated at the first look", column="--risk", value=f"{risk:g}", remedy=remedy
        )
        raise ExperimentError([problem])
    ledger = before or Ledger(DEFAULT_RISK if risk is None else risk)
    mark, look = _data_fingerprint(pairs), look_at(diagnosis, len(pairs), ledger.risk)
    looks, marks = ledger.looks, ledger.marks
    if marks and marks[-1] == mark:
        looks, marks = looks[:-1], marks[:-1]
    ledger = replace(ledger, looks=(*looks, look), marks=(*marks, mark), next_text=_next_step(diagnosis, look))
    write_json(folder / LEDGER, ledger.to_json())
    return ledger


def _diagnose_target(target: Path, experiment: Path | None) -> tuple[Diagnosis, Sequence[tuple[Trial, Track]], Path]:
    """Diagnosis, trials with their tracks, and the folder of the sheet."""
    from vinetrack.diagnosis.diagnose import diagnose
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.inference.fit_data import pairs_of
    from vinetrack.pipeline.model_stage import measured_trials
    from vinetrack.pipeline.run_folders import find_experiment
    from vinetrack.pipeline.source_experiment import read_source_experiment
    from vinetrack.results.folder_layout import Results, ResultsError
    from vinetrack.results.stored_diagnosis import read_diagnosis

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
    """A short text that changes with the trials and their positions."""
    code = hashlib.sha256()
    for trial, track in pairs:
        code.update(trial.name.encode())
        code.update(track.lead_position_m.tobytes())
    return code.hexdigest()[:12]


def _next_step(diagnosis: Diagnosis, look: CampaignLook) -> str:
    """What to do next, in a sentence or two."""
    if look.decision == STOP:
        return "Stop: film no more for this question."
    advice = diagnosis.next_experiment
    if advice is not None and advice.get("text"):
        return str(advice["text"])
    further = trials_to_go(look)
    if further:
        return f"About {further} further trials like those so far, by how the evidence has grown."
    if look.verdict == ADEQUATE:
        return (
            "Widen what varies: other pressures, payloads, chambers, connectors or vines. Or choose the effect and the "
            "size that matter: `vinetrack power TARGET --effect NAME=SIZE --reach 0.9` says which trials would show it."
        )
    return "Widen what varies from trial to trial: other pressures, payloads, chambers, connectors or vines."


def read_ledger(path: Path) -> Ledger | None:
    """Read a ledger.

    Parameters
    ----------
    path : of the file.

    Returns
    -------
    Ledger or None
        None where there is none.

    Raises
    ------
    ExperimentError
        If it is not one of ours.
    """
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
    """Return what `vinetrack campaign` prints: a row a look, why it goes on or stops, what to do next.

    Parameters
    ----------
    ledger : with one look at least.

    Returns
    -------
    list of str
    """
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
    why = f"{last.decision.capitalize()}: {last.why}."
    return [
        *table(rows, head, align=">><<>><"),
        f"Risk of stopping with a wrong name, at any of the looks: {100 * ledger.risk:g} %.",
        why,
        *([] if last.decision == STOP else [f"Next: {ledger.next_text}"]),
    ]
