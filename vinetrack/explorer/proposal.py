"""Where no known effect mends the model: a button that has an effect proposed, and opens the page with it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from bokeh.models import Button, Column, ColumnDataSource, CustomJS, Row

from vinetrack.core.problems import UserError
from vinetrack.effects import load_effect
from vinetrack.explorer.campaign import Campaign, read_campaign
from vinetrack.explorer.choice import first_choice
from vinetrack.explorer.fitting import BackgroundFit, FitJob
from vinetrack.explorer.look import command_block, escaped, progress_bar, sheet, words
from vinetrack.pipeline.proposed_effects import WrittenProposal, propose_effect

if TYPE_CHECKING:
    from vinetrack.explorer.page import Page

Reopen = Callable[[BackgroundFit], None]
"""Has pages that are opened from now on show another campaign."""

PROPOSE = "Propose an effect"
INTRODUCTION = (
    "No effect of the catalogue explains these trials. The force that is missing can be learned from them and written"
    " as an effect file of your own, beside the experiment. It takes minutes."
)
RELOAD = "location.reload()"
LEAST_SHARE, USUAL_S = 0.04, 150.0
"""Of the bar at first, and the time in which it is two thirds full. Chosen for the eye: half of the proposals timed
took less; no step tells how much is left."""


@dataclass(frozen=True)
class ReadProposal:
    """What was written, and the campaign with it among the effects."""

    written: WrittenProposal
    campaign: Campaign


def proposed(campaign: Campaign, told: Callable[[str], None]) -> ReadProposal:
    """Have an effect proposed and written beside the experiment, and read the campaign with it.

    Parameters
    ----------
    campaign : whose diagnosis ended as `unexplained`.
    told : callable
        Called with a sentence at each step; what it raises ends the search.

    Returns
    -------
    ReadProposal

    Raises
    ------
    UserError
        If there is no such diagnosis, the model cannot be followed, or the file is there already.
    """
    written = propose_effect(campaign.experiment, campaign.folder, None, told)
    effects = {effect.name: effect for effect in map(load_effect, written.files)}
    known = {name: effect for name, effect in campaign.effects.items() if name not in effects}
    return ReadProposal(written, read_campaign(campaign.folder, campaign.experiment, known | effects))


class ProposalPanel:
    """Button, progress and outcome; seen where the verdict is `unexplained`."""

    def __init__(self, page: Page, reopen: Reopen | None) -> None:
        self._page, self._reopen = page, reopen
        self._job: FitJob[str, ReadProposal] | None = None
        self._doing, self._begun = "", 0.0
        self._outcome: ReadProposal | None = None
        self.button = Button(label=PROPOSE, name="propose", width=150, stylesheets=[sheet()], margin=0)
        self.button.on_click(self._propose_or_stop)
        self.open = Button(
            label="Open the page with it",
            name="open_proposed",
            width=170,
            stylesheets=[sheet()],
            margin=0,
            visible=False,
        )
        self.open.on_click(self._open)
        self.words = words(name="proposal")
        self._reload = ColumnDataSource({"times": [0]}, name="reload")
        self._reload.js_on_change("data", CustomJS(code=RELOAD))
        self.root = Column(
            children=[
                self.words,
                Row(children=[self.button, self.open], margin=0, stylesheets=[sheet(":host { gap: 6px; }")]),
            ],
            sizing_mode="stretch_width",
            name="propose_panel",
            margin=0,
            tags=[self._reload],
        )
        self.show()

    def show(self) -> None:
        """After the diagnosis changed, or as time passes."""
        story = self._page.story
        self.root.visible = self._job is not None or self._outcome is not None or bool(story and story.unexplained)
        if self._job is not None:
            passed_s = time.monotonic() - self._begun
            share = max(LEAST_SHARE, passed_s / (passed_s + USUAL_S / 2))
            self._say(progress_bar(share, f"{self._doing} · {passed_s:.0f} s"))
        elif self._outcome is None and not self.words.text:
            command = command_block([f"vinetrack propose {self._page.campaign.folder.as_posix()}"])
            self._say(f"<p>{INTRODUCTION} The same from the command line:</p>{command}")

    def close(self) -> None:
        """Nobody looks any more."""
        if self._job is not None:
            self._job.give_up()

    def _say(self, text: str) -> None:
        if self.words.text != text:
            self.words.text = text

    def _propose_or_stop(self) -> None:
        if self._job is not None:
            self._job.give_up()
            self._ended("<p>The search was stopped; nothing was written.</p>")
            return
        self._doing, self._begun, self.button.label = "reading the results", time.monotonic(), "Stop"
        soon = self._page.document.add_next_tick_callback
        self._job = FitJob(
            partial(proposed, self._page.campaign),
            told=self._heard,
            done=lambda outcome: soon(partial(self._done, outcome)),
            failed=lambda reason: soon(partial(self._ended, f'<p class="bad">{escaped(reason)}</p>')),
        )
        self.show()

    def _heard(self, doing: str) -> None:
        """From the job's thread; the clock shows it."""
        self._doing = doing

    def _done(self, outcome: ReadProposal) -> None:
        if self._job is None:
            return
        self._outcome = outcome if outcome.written.files else None
        self.open.visible = self._outcome is not None and self._reopen is not None
        self._ended("".join(f"<p>{escaped(line)}</p>" for line in outcome.written.lines))

    def _ended(self, text: str) -> None:
        self._job, self.button.label = None, PROPOSE
        self.button.visible = self._outcome is None
        self._say(text)
        self.root.visible = True

    def _open(self) -> None:
        """Show the campaign with the first of the effects, the law where there is one, in the model."""
        if self._outcome is None or self._reopen is None:
            return
        campaign, first = self._outcome.campaign, self._outcome.written.files[0]
        try:
            choice = first_choice(campaign).with_effect(load_effect(first).name)
        except UserError as error:
            self._say(f'<p class="bad">{escaped(error)}</p>')
            return
        self._reopen(BackgroundFit(campaign, choice).begin())
        self._reload.data = {"times": [1]}
