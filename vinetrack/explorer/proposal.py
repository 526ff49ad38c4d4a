"""If no known effect explains the misfit: a button that proposes an effect, and one that opens the page with it."""

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
from vinetrack.explorer.choice import choice_in_use
from vinetrack.explorer.fitting import BackgroundFit, FitJob
from vinetrack.explorer.look import command_block, escaped, html_div, progress_bar, stylesheet
from vinetrack.pipeline.proposed_effects import WrittenProposal, propose_effect

if TYPE_CHECKING:
    from vinetrack.explorer.page import Page

Reopen = Callable[[BackgroundFit], None]  # Makes pages opened from now on show another campaign

PROPOSE = "Propose an effect"
INTRODUCTION = (
    "No effect of the catalogue explains these trials. The missing force can be learned from them and written"
    " as an effect file of your own, beside the experiment. It takes minutes."
)
RELOAD = "location.reload()"
# Fraction of the progress bar at the start, and the time in which it is two thirds full (chosen)
INITIAL_FRACTION, TYPICAL_DURATION_S = 0.04, 150.0


@dataclass(frozen=True)
class ReadProposal:
    """The files written, and the campaign with the proposed effects."""

    written: WrittenProposal
    campaign: Campaign


def propose_and_read(campaign: Campaign, on_progress: Callable[[str], None]) -> ReadProposal:
    """Propose an effect, write it to the experiment's folder, and read the campaign with it."""
    written = propose_effect(campaign.experiment, campaign.folder, None, on_progress)
    effects = {effect.name: effect for effect in map(load_effect, written.files)}
    known = {name: effect for name, effect in campaign.effects.items() if name not in effects}
    return ReadProposal(written, read_campaign(campaign.folder, campaign.experiment, known | effects))


class ProposalPanel:
    """Button, progress and outcome; visible if the verdict is `unexplained`."""

    def __init__(self, page: Page, reopen: Reopen | None) -> None:
        self._page, self._reopen = page, reopen
        self._job: FitJob[str, ReadProposal] | None = None
        self._task, self._started = "", 0.0
        self._outcome: ReadProposal | None = None
        self.button = Button(label=PROPOSE, name="propose", width=150, stylesheets=[stylesheet()], margin=0)
        self.button.on_click(self._propose_or_stop)
        self.open = Button(
            label="Open the page with it",
            name="open_proposed",
            width=170,
            stylesheets=[stylesheet()],
            margin=0,
            visible=False,
        )
        self.open.on_click(self._open)
        self.text = html_div(name="proposal")
        self._reload = ColumnDataSource({"times": [0]}, name="reload")
        self._reload.js_on_change("data", CustomJS(code=RELOAD))
        self.root = Column(
            children=[
                self.text,
                Row(children=[self.button, self.open], margin=0, stylesheets=[stylesheet(":host { gap: 6px; }")]),
            ],
            sizing_mode="stretch_width",
            name="propose_panel",
            margin=0,
            tags=[self._reload],
        )
        self.show()

    def show(self) -> None:
        """Update after a change of the diagnosis, and as time passes."""
        summary = self._page.summary
        self.root.visible = self._job is not None or self._outcome is not None or bool(summary and summary.unexplained)
        if self._job is not None:
            passed_s = time.monotonic() - self._started
            share = max(INITIAL_FRACTION, passed_s / (passed_s + TYPICAL_DURATION_S / 2))
            self._say(progress_bar(share, f"{self._task} · {passed_s:.0f} s"))
        elif self._outcome is None and not self.text.text:
            command = command_block([f"vinetrack propose {self._page.campaign.folder.as_posix()}"])
            self._say(f"<p>{INTRODUCTION} The same from the command line:</p>{command}")

    def close(self) -> None:
        """The page was closed."""
        if self._job is not None:
            self._job.cancel()

    def _say(self, text: str) -> None:
        if self.text.text != text:
            self.text.text = text

    def _propose_or_stop(self) -> None:
        if self._job is not None:
            self._job.cancel()
            self._ended("<p>The search was stopped; nothing was written.</p>")
            return
        self._task, self._started, self.button.label = "reading the results", time.monotonic(), "Stop"
        soon = self._page.document.add_next_tick_callback
        self._job = FitJob(
            partial(propose_and_read, self._page.campaign),
            on_progress=self._on_progress,
            on_success=lambda outcome: soon(partial(self._done, outcome)),
            on_failure=lambda reason: soon(partial(self._ended, f'<p class="bad">{escaped(reason)}</p>')),
        )
        self.show()

    def _on_progress(self, task: str) -> None:
        """Called from the job's thread; the status line shows it."""
        self._task = task

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
        """Show the campaign with the first of the effects (the law, if there is one) in the model."""
        if self._outcome is None or self._reopen is None:
            return
        campaign, first = self._outcome.campaign, self._outcome.written.files[0]
        try:
            choice = choice_in_use(campaign).with_effect(load_effect(first).name)
        except UserError as error:
            self._say(f'<p class="bad">{escaped(error)}</p>')
            return
        self._reopen(BackgroundFit(campaign, choice).begin())
        self._reload.data = {"times": [1]}
