"""Proposed effects: a force law or table that improves the model, written as an effect file of the user's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vinetrack.experiment.folder import Experiment
from vinetrack.pipeline.model_stage import measured_trials
from vinetrack.results.folder_layout import Results, ResultsError
from vinetrack.results.stored_diagnosis import read_diagnosis

Report = Callable[[str], None]


@dataclass(frozen=True)
class WrittenProposal:
    """Lines for the terminal, and the effect files written, the law first."""

    lines: tuple[str, ...]
    files: tuple[Path, ...]


def propose_effect(experiment: Experiment, folder: Path, to: Path | None, report: Report) -> WrittenProposal:
    """Write the force law that explains a misfit which no effect of the catalogue explains, or else a learned table."""
    from vinetrack.core.tables import write_text
    from vinetrack.diagnosis.learned_effect import table_text
    from vinetrack.diagnosis.propose import effect_text, propose
    from vinetrack.diagnosis.result import UNEXPLAINED
    from vinetrack.dynamics.model import make_model
    from vinetrack.effects import own_effects, remember

    results = Results(folder)
    diagnosis = read_diagnosis(results)
    if diagnosis is None:
        raise ResultsError(f"{folder}: it has no diagnosis; run vinetrack diagnose {folder}")
    if UNEXPLAINED not in (diagnosis.verdict, diagnosis.final_verdict):
        raise ResultsError(
            f"{folder}: its verdict is `{diagnosis.final_verdict}`. A new law is proposed only for a misfit that no"
            " effect of the catalogue explains (`unexplained`); `vinetrack diagnose` prints the diagnosis."
        )
    user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    model = make_model(dict.fromkeys([*experiment.settings.model, *diagnosis.effects]), user_effects)
    pairs, _ = measured_trials(experiment, results)
    proposal = propose(model, pairs, report)
    learned = (diagnosis.missing_force or {}).get("learned") or {}
    lines = [*([learned["sentence"]] if learned else []), *proposal.sentences()]
    origin = (
        f"From {len(proposal.before.trials)} trials of {experiment.name}. RMS error in left-out conditions:"
        f" {' + '.join(model.names)} {1e3 * proposal.rms_left_out_m:.2f} mm; with this"
    )
    files = []
    if proposal.tied:
        best = proposal.tied[0]
        remark = f"{origin} law {1e3 * best.rms_left_out_m:.2f} mm (Δχ² = {best.ratio.delta_chi2:.0f})."
        files.append((best.effect.path.name, effect_text(best.law, remark)))
    if proposal.table is not None:
        table = proposal.table
        remark = f"{origin} table, which was learned from all of them, {1e3 * table.rms_left_out_m:.2f} mm."
        files.append((table.effect.path.name, table_text(table.learned, remark)))
    paths = [experiment.folder / name if to is None else to.with_name(name) for name, _ in files]
    if to is not None and paths:
        paths[0] = to
    for path in paths:
        if path.exists():
            raise ResultsError(f"{path} exists already: move it away, or give another file with --to.")
    for path, (_, text) in zip(paths, files, strict=True):
        write_text(path, text)
        remember(path)
        lines.append(f"Written to {path}. Read it, then fit it with `vinetrack add {path} {folder}`.")
    if files:
        settings = experiment.folder / "experiment.yaml"
        lines.append(f"To test it in the diagnosis, list it under `effects:` in {settings}.")
    return WrittenProposal(tuple(lines), tuple(paths))
