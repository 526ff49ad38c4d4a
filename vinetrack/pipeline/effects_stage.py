"""The command `vinetrack effects`: the catalogue, with a user's own, in words and pictures."""

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
    """Lines for the terminal: all effects, or the one named; with `figure`, its picture is written there.

    Parameters
    ----------
    name : str or None
        Name of an effect.
    experiment : Path or None
        Folder whose own effects are listed too.
    figure : Path or None
        Where the picture of the effect is written.

    Returns
    -------
    list of str

    Raises
    ------
    ExperimentError
        If the experiment, its settings or the place of the figure will not do.
    EffectError
        If there is no such effect, or one of the user's own is none.
    """
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
    """The user's own effects of an experiment, read from the files its settings name, and tried out.

    Parameters
    ----------
    experiment : Path
        Folder with `experiment.yaml`.

    Returns
    -------
    dict of Effect
        By name.

    Raises
    ------
    ExperimentError
        If the settings cannot be read, or a file lies outside the folder.
    EffectError
        If a file is no effect.
    """
    from vinetrack.core.tables import TableError, safe_join
    from vinetrack.effects import own_effects
    from vinetrack.experiment.settings import read_experiment_settings

    settings = read_experiment_settings(experiment / "experiment.yaml")
    try:
        return own_effects([safe_join(experiment, path) for path in settings.effects])
    except TableError as error:
        raise ExperimentError([Problem(message=str(error), file="experiment.yaml", column="effects")]) from None


def model_problems(experiment: Path) -> list[Problem]:
    """What is wrong with the effects that an experiment names, in its model, its candidates or as files of its own.

    Nothing where it keeps to the base model, or cannot be read, which the check of the sheet says.

    Parameters
    ----------
    experiment : Path
        Experiment folder.

    Returns
    -------
    list of Problem
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
    """Draw what an effect does to the reference vine; the file's ending says in which form."""
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
    """All effects, or the one named, for a program; see `describe_effects`.

    Parameters
    ----------
    name : str or None
        Name of an effect.
    experiment : Path or None
        Folder whose own effects are listed too.

    Returns
    -------
    list of dict, one an effect
    """
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
