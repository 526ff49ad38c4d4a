"""The command `vinetrack effects`: description of the catalogue and of the user's own effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import ExperimentError, Problem

if TYPE_CHECKING:
    from vinetrack.effects import Effect

FORMATS = (".png", ".svg", ".pdf")


def describe_effects(name: str | None, experiment: Path | None, figure: Path | None) -> list[str]:
    """List all effects, or explain one and draw it."""
    from vinetrack.effects import catalogue, explanation, find_effect, listing

    user_effects = {} if experiment is None else effects_of(experiment)
    if name is None:
        if figure is not None:
            raise ExperimentError(
                [Problem(message="needs the name of one effect to draw", file=str(figure), remedy="give NAME")]
            )
        return listing(
            [*(e for e in catalogue().values() if e.name not in user_effects), *user_effects.values()], user_effects
        )
    effect = find_effect(name, user_effects)
    lines = explanation(effect)
    if figure is not None:
        _write_picture(effect, figure)
        lines.append(f"Picture: {figure}")
    return lines


def effects_of(experiment: Path) -> Mapping[str, Effect]:
    """Load and test the user's own effects of an experiment."""
    from vinetrack.core.tables import TableError, safe_join
    from vinetrack.effects import own_effects
    from vinetrack.experiment.settings import read_experiment_settings

    settings = read_experiment_settings(experiment / "experiment.yaml")
    try:
        return own_effects([safe_join(experiment, path) for path in settings.effects])
    except TableError as error:
        raise ExperimentError([Problem(message=str(error), file="experiment.yaml", column="effects")]) from None


def model_problems(experiment: Path) -> list[Problem]:
    """Find problems of the effects that an experiment names in `model`, `candidates` or `effects`. Returns nothing for
    the base model, nor if the experiment cannot be read, which `check_experiment` reports.
    """
    from vinetrack.core.constants import BASE_EFFECTS
    from vinetrack.dynamics.model import make_model
    from vinetrack.dynamics.trial_inputs import check_needs
    from vinetrack.effects import EffectError, find_effect
    from vinetrack.experiment.folder import read_experiment

    try:
        read = read_experiment(experiment, strict=False)
    except ExperimentError:
        return []
    settings = read.settings
    if settings.model == BASE_EFFECTS and not settings.effects and not settings.candidates:
        return []
    if not all((experiment / path).exists() for path in settings.effects):
        return []
    column = "effects"
    try:
        user_effects = effects_of(experiment)
        column = "candidates"
        for name in settings.candidates or ():
            find_effect(name, user_effects)
        column = "model"
        check_needs(make_model(settings.model, user_effects), *read.trials)
    except EffectError as error:
        message, _, remedy = str(error).rstrip(".").partition(": ")
        return [Problem(message=message, file="experiment.yaml", column=column, remedy=remedy)]
    return []


def _write_picture(effect: Effect, path: Path) -> None:
    """Draw the influence of an effect on the reference vine; the suffix of the file names the format."""
    from vinetrack.core.tables import write_bytes
    from vinetrack.dynamics.effect_motion import effect_motion, reference_words, size_words
    from vinetrack.figures.prediction_figures import draw_effect
    from vinetrack.figures.style import render

    if path.suffix.lower() not in FORMATS:
        raise ExperimentError(
            [
                Problem(
                    message="is not the name of a picture",
                    file=str(path),
                    remedy=f"end it in one of {', '.join(FORMATS)}",
                )
            ]
        )
    fig = draw_effect(effect.name, size_words(effect), reference_words(effect), effect_motion(effect))
    form = path.suffix.lower()[1:]
    write_bytes(path, render(fig, [form])[form])


def effects_content(name: str | None, experiment: Path | None) -> list[dict[str, Any]]:
    """Describe all effects, or one, for a program; see `describe_effects`."""
    from vinetrack.effects import catalogue, find_effect

    user_effects = {} if experiment is None else effects_of(experiment)
    effects = {**catalogue(), **user_effects}.values() if name is None else [find_effect(name, user_effects)]
    return [
        {
            "name": effect.name,
            "kind": effect.kind,
            "text": effect.text,
            "parameters": [asdict(parameter) for parameter in effect.parameters],
            "own": effect.name in user_effects,
        }
        for effect in effects
    ]
