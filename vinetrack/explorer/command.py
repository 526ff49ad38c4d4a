"""The command `vinetrack explore`: the page for a results folder, or its functions without the page."""

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
    """Options of the command line; see `vinetrack explore --help`."""

    add: Sequence[str] = ()
    drop: Sequence[str] = ()
    sizes: Sequence[str] = ()
    refit: bool = False
    export: Sequence[Path] = ()
    save: bool = False
    port: int | None = None
    browser: bool = True

    @property
    def needs_page(self) -> bool:
        """Whether to open the page: refitting, exporting and saving need none."""
        return not (self.refit or self.export or self.save)


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """Open a results folder and its experiment."""
    from vinetrack.explorer.campaign import read_campaign
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.pipeline.source_experiment import read_source_experiment

    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(folder: Path, experiment: Path | None, options: ExploreOptions, say: Callable[[str], None]) -> None:
    """Serve the page, or carry out the options and print the results."""
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.choice import choice_from_options, choice_in_use

    with waiting(f"opening {folder}"):
        campaign = open_campaign(folder, experiment)
        start = choice_in_use(campaign)
        choice = choice_from_options(campaign, start, options.add, options.drop, options.sizes)
    if options.needs_page:
        if importlib.util.find_spec("bokeh") is None:
            raise PageError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
        from vinetrack.explorer.fitting import BackgroundFit
        from vinetrack.explorer.server import serve

        serve(BackgroundFit(campaign, start if choice == start else choice), say, options.port, browser=options.browser)
        return
    _run_without_page(campaign, start, choice, options, say)


def _run_without_page(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, options: ExploreOptions, say: Callable[[str], None]
) -> None:
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.choice import sized_model
    from vinetrack.explorer.curves import errors_m, simulate_curves
    from vinetrack.explorer.export import model_text, write_export
    from vinetrack.explorer.fitting import first_fit, fit_choice, likelihood_change_text
    from vinetrack.pipeline.source_experiment import save_model

    with waiting("simulating the trials"):
        before = errors_m(campaign, simulate_curves(campaign, sized_model(campaign, start)))
    if options.refit:
        with waiting("fitting the model in use"):
            first = first_fit(campaign, start)
        with waiting(f"fitting {model_text(choice.effects)}"):
            fitted = fit_choice(campaign, first.fit, choice)
        choice = fitted.choice
        say(str(fitted.fit))
        say(likelihood_change_text(first.fit, fitted.fit))
    curves = simulate_curves(campaign, sized_model(campaign, choice))
    for line in error_lines(campaign, choice, errors_m(campaign, curves), before):
        say(line)
    for path in options.export:
        write_export(campaign, choice, curves, path)
        say(f"Written: {path}")
    if options.save:
        files = campaign.own_files(choice.effects)
        say(f"Saved: {save_model(campaign.experiment.folder, choice.effects, files)}")


def error_lines(campaign: Campaign, choice: ModelChoice, now: dict[str, float], before: dict[str, float]) -> list[str]:
    """Return a table of the error of every condition before and now, with the replicate scatter."""
    from vinetrack.core.terminal import table
    from vinetrack.explorer.curves import overall_m
    from vinetrack.explorer.export import model_text

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
    return [model_text(choice.effects), *table(rows, head, ("", "mm", "mm", "mm"), align="<>>>")]
