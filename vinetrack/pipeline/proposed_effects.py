"""Laws and tables that mend a model, written beside the experiment as effects of the user's own."""

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
    """Lines for the terminal, and the effect files that were written, the law first."""

    lines: tuple[str, ...]
    files: tuple[Path, ...]


def propose_effect(experiment: Experiment, folder: Path, to: Path | None, report: Report) -> WrittenProposal:
    """Write the law that mends what no effect of the catalogue does, and the learned force where no law does.

    Parameters
    ----------
    experiment : sheet and settings.
    folder : results folder, diagnosed.
    to : where the file goes; without it, into the experiment's folder.
    report : callable
        Called with a sentence at each step.

    Returns
    -------
    WrittenProposal

    Raises
    ------
    ResultsError
        If a stage before this one has not run, or the diagnosis did not end as `unexplained`.
    FitError
        If the model cannot be followed.
    """
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
            f"{folder}: its verdict is `{diagnosis.final_verdict}`. A law of its own is proposed only for what no"
            " effect of the catalogue explains (`unexplained`); `vinetrack diagnose` prints what was found."
        )
    user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    model = make_model(dict.fromkeys([*experiment.settings.model, *diagnosis.effects]), user_effects)
    pairs, _ = measured_trials(experiment, results)
    proposal = propose(model, pairs, report)
    learned = (diagnosis.missing_force or {}).get("learned") or {}
    lines = [*([learned["sentence"]] if learned else []), *proposal.sentences()]
    misses = (
        f"From {len(proposal.before.trials)} trials of {experiment.name}, where {' + '.join(model.names)} misses"
        f" left-out conditions by {1e3 * proposal.rms_left_out_m:.2f} mm, and with this"
    )
    files = []
    if proposal.tied:
        best = proposal.tied[0]
        remark = f"{misses} law by {1e3 * best.rms_left_out_m:.2f} mm (Δχ² = {best.ratio.delta_chi2:.0f})."
        files.append((best.effect.path.name, effect_text(best.law, remark)))
    if proposal.table is not None:
        table = proposal.table
        remark = f"{misses} table, which was learned from them all, by {1e3 * table.rms_left_out_m:.2f} mm."
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
        lines.append(f"Written to {path}. Read it; `vinetrack add {path} {folder}` fits it.")
    if files:
        settings = experiment.folder / "experiment.yaml"
        lines.append(f"To test it in the diagnosis, list it under `effects:` in {settings}.")
    return WrittenProposal(tuple(lines), tuple(paths))
