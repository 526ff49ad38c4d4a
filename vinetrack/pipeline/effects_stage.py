"""The command `vinetrack effects`: description of the catalogue and of the user's own effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vinetrack.core.problems import Problem, remark
from vinetrack.core.tables import safe_join, write_text
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.dynamics.model import check_needs, make_model
from vinetrack.effects import Effect, EffectError, catalogue, explanation, find_effect, listing, own_effects, remember
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.results.folder_layout import Results, ResultsError, measured_trials, read_diagnosis


def describe_effects(name: str | None, experiment: Path | None) -> tuple[list[str], list[dict[str, Any]]]:
    """List all effects, or explain one. Returns lines, and the same for a program."""
    own = {} if experiment is None else effects_of(experiment)
    if name is None:
        shown = [*(effect for effect in catalogue().values() if effect.name not in own), *own.values()]
        lines = listing(shown, own)
    else:
        shown = [find_effect(name, own)]
        lines = explanation(shown[0])
    return lines, [
        {
            "name": effect.name,
            "kind": effect.kind,
            "text": effect.text,
            "parameters": [asdict(parameter) for parameter in effect.parameters],
            "own": effect.name in own,
        }
        for effect in shown
    ]


def effects_of(experiment: Path) -> Mapping[str, Effect]:
    """Load and test the user's own effects of an experiment."""
    settings = read_experiment_settings(experiment / "experiment.yaml")
    return own_effects([safe_join(experiment, path) for path in settings.effects])


def model_problems(experiment: Experiment) -> list[Problem]:
    """Find problems of the effects that an experiment names in `model`, `candidates` or `effects`."""
    settings = experiment.settings
    if settings.model == BASE_EFFECTS and not settings.effects and not settings.candidates:
        return []
    if not all((experiment.folder / path).exists() for path in settings.effects):
        return []
    column = "effects"
    try:
        user_effects = effects_of(experiment.folder)
        column = "candidates"
        for name in settings.candidates or ():
            find_effect(name, user_effects)
        column = "model"
        check_needs(make_model(settings.model, user_effects), *experiment.trials)
    except EffectError as error:
        return [Problem(message=str(error).rstrip("."), file="experiment.yaml", column=column)]
    return []


# ------------------------------------------------------------------------------
# Proposed effects: a force law or table that improves the model, written as an effect file of the user's own.

Report = Callable[[str], None]


def propose_effect(experiment: Experiment, folder: Path, to: Path | None, say: Report) -> tuple[list[str], list[Path]]:
    """Write the law of a force that no effect of the catalogue explains, and its table; return lines, and the files."""
    from vinetrack.diagnosis.propose import propose
    from vinetrack.diagnosis.result import UNEXPLAINED
    from vinetrack.narrative.diagnosis_text import proposal_lines
    from vinetrack.narrative.verdict_text import verdict_sentence

    results = Results(folder)
    diagnosis = read_diagnosis(results)
    if diagnosis is None:
        raise ResultsError(f"{folder}: it has no diagnosis; run vinetrack diagnose {folder}")
    if diagnosis.contradicted_columns:
        raise ResultsError(f"{folder}: {verdict_sentence(diagnosis)}")
    if UNEXPLAINED not in (diagnosis.verdict, diagnosis.final_verdict):
        raise ResultsError(str(remark("no_law_needed", folder=folder, verdict=diagnosis.final_verdict)))
    user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    model = make_model(dict.fromkeys([*experiment.settings.model, *diagnosis.effects]), user_effects)
    pairs, _ = measured_trials(experiment, results)
    proposal = propose(model, pairs, say)
    learned = (diagnosis.missing_force or {}).get("learned") or {}
    lines = [*([learned["sentence"]] if learned else []), *proposal_lines(proposal)]
    facts = {"count": len(proposal.before.trials), "experiment": experiment.name, "model": model.names}
    facts |= {"before_m": proposal.rms_left_out_m}
    files = []
    if proposal.tied:
        best = proposal.tied[0]
        origin = remark("law_origin", **facts, rms_m=best.rms_left_out_m, gain=best.ratio.delta_chi2)
        files.append((best.effect.path.name, best.text(str(origin))))
    if (table := proposal.table) is not None:
        origin = remark("table_origin", **facts, rms_m=table.rms_left_out_m)
        files.append((table.effect.path.name, table.text(str(origin))))
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
    return lines, paths
