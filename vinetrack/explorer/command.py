"""The command `vinetrack explore`: the page for a results folder, or what the page does, without it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.local_page import PageError

if TYPE_CHECKING:
    from vinetrack.explorer.campaign import Campaign
    from vinetrack.explorer.choice import ModelChoice


@dataclass(frozen=True)
class ExploreOptions:
    """What the command line asks for; see `vinetrack explore --help`."""

    add: Sequence[str] = ()
    drop: Sequence[str] = ()
    sizes: Sequence[str] = ()
    refit: bool = False
    export: Sequence[Path] = ()
    save: bool = False
    port: int | None = None
    browser: bool = True

    @property
    def is_for_a_page(self) -> bool:
        """Whether somebody is to look: what is only computed, written or saved needs no page."""
        return not (self.refit or self.export or self.save)


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """A results folder with the experiment it was made from.

    Parameters
    ----------
    folder : the results.
    experiment : its folder where it has moved.

    Returns
    -------
    Campaign

    Raises
    ------
    ResultsError
        If it is no results folder, or its experiment has moved.
    ExperimentError
        If the experiment cannot be read.
    """
    from vinetrack.explorer.campaign import read_campaign
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.pipeline.source_experiment import read_source_experiment

    read = read_source_experiment(folder, experiment)
    return read_campaign(folder, read, effects_of(read.folder))


def explore(folder: Path, experiment: Path | None, wanted: ExploreOptions, say: Callable[[str], None]) -> None:
    """Serve the page, or do what was asked for and say what came of it.

    Parameters
    ----------
    folder : the results.
    experiment : its folder where it has moved.
    wanted : the options of the command.
    say : prints a line.

    Raises
    ------
    ResultsError, ExperimentError, ChoiceError, PageError, FitError, EffectError, SimulationError
        In one sentence each.
    """
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.choice import chosen, first_choice

    with waiting(f"opening {folder}"):
        campaign = open_campaign(folder, experiment)
        start = first_choice(campaign)
        choice = chosen(campaign, start, wanted.add, wanted.drop, wanted.sizes)
    if wanted.is_for_a_page:
        if importlib.util.find_spec("bokeh") is None:
            raise PageError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
        from vinetrack.explorer.fitting import BackgroundFit
        from vinetrack.explorer.server import serve

        serve(BackgroundFit(campaign, start if choice == start else choice), say, wanted.port, browser=wanted.browser)
        return
    _without_a_page(campaign, start, choice, wanted, say)


def _without_a_page(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, wanted: ExploreOptions, say: Callable[[str], None]
) -> None:
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.choice import sized
    from vinetrack.explorer.curves import errors_m, follow
    from vinetrack.explorer.export import model_words, write_export
    from vinetrack.explorer.fitting import first_fit, fit_choice, gained_words
    from vinetrack.pipeline.source_experiment import save_model

    with waiting("simulating the trials"):
        before = errors_m(campaign, follow(campaign, sized(campaign, start)))
    if wanted.refit:
        with waiting("fitting the model in use"):
            first = first_fit(campaign, start)
        with waiting(f"fitting {model_words(choice.effects)}"):
            fitted = fit_choice(campaign, first.fit, choice)
        choice = fitted.choice
        say(str(fitted.fit))
        say(gained_words(first.fit, fitted.fit))
    curves = follow(campaign, sized(campaign, choice))
    for line in error_lines(campaign, choice, errors_m(campaign, curves), before):
        say(line)
    for path in wanted.export:
        write_export(campaign, choice, curves, path)
        say(f"Written: {path}")
    if wanted.save:
        files = campaign.own_files(choice.effects)
        say(f"Saved: {save_model(campaign.experiment.folder, choice.effects, files)}")


def error_lines(campaign: Campaign, choice: ModelChoice, now: dict[str, float], before: dict[str, float]) -> list[str]:
    """The error of every condition before and now beside what replicates differ by, aligned, with units.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    now, before : errors by condition, m.

    Returns
    -------
    list of str
    """
    from vinetrack.core.terminal import table
    from vinetrack.explorer.curves import overall_m
    from vinetrack.explorer.export import model_words

    def cells(values: dict[str, float]) -> list[str]:
        return [f"{1e3 * values[key]:.3f}" if values[key] == values[key] else "–" for key in ("was", "now", "floor")]

    floors = campaign.floors_m
    rows = [
        (campaign.labels[c], *cells({"was": before[c], "now": now[c], "floor": floors.get(c, float("nan"))}))
        for c in campaign.conditions
    ]
    sums = (overall_m(errors, campaign.conditions) for errors in (before, now, floors))
    rows.append(("all", *cells(dict(zip(("was", "now", "floor"), sums, strict=True)))))
    head = ("condition", "model in use", "now", "replicates")
    return [model_words(choice.effects), *table(rows, head, ("", "mm", "mm", "mm"), align="<>>>")]
