"""One open page: what a person does becomes a choice, a choice becomes curves, curves become figures and words."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.models import Button, Column, CustomJS, Row

from vinetrack.dynamics.simulate import SimulationError
from vinetrack.explorer.choice import ModelChoice, sized
from vinetrack.explorer.controls import Chooser, EffectPanel, KeepPanel
from vinetrack.explorer.curves import Curves, errors_m, follow
from vinetrack.explorer.film_panel import FilmPanel
from vinetrack.explorer.fitting import BackgroundFit, FitJob, FitProgress, Fitted, at_numbers, fit_choice
from vinetrack.explorer.look import escaped, page_style, page_template, progress_bar, screen_script, sheet, theme, words
from vinetrack.explorer.plots import Plots
from vinetrack.explorer.proposal import ProposalPanel, Reopen
from vinetrack.explorer.series import vine_colours
from vinetrack.explorer.sides import (
    DIAGNOSIS,
    DiagnosisSummary,
    FittedRung,
    HeldModel,
    headline,
    next_panel,
    numbers_words,
    read_summary,
    rung_of,
    side_by_side,
    tied_panel,
)
from vinetrack.figures.page_tokens import follows_screen
from vinetrack.inference.optimiser import Step

COALESCE_MS = 4
"""Chosen: a redraw waits a quarter of a screen's frame of 16 ms, so that moves of a slider come together."""

WORDS_MS = 150
"""Chosen: text follows a slider at reading speed, since each change makes the browser lay out the page again."""

LOOK_AGAIN_MS = 2000
"""Chosen: how often the page looks for a new diagnosis."""

CLOCK_MS = 200
"""Chosen: the status line counts tenths of a second."""

LET_SCROLL = """
for (const plot of plots) {
  Bokeh.index.find_one(plot)?.canvas_view?.events_el?.style.setProperty("touch-action", "pan-y");
}
"""
"""A finger that swipes over a figure scrolls the page, as everywhere else on it."""


class Page:
    """The controller of one document. Everything here runs in the document's own turn, but `_heard_…`."""

    def __init__(self, ground: BackgroundFit, document: Document, reopen: Reopen | None = None) -> None:
        self.ground, self.campaign, self.document = ground, ground.campaign, document
        self.choice: ModelChoice = ground.opening
        self.curves: Curves | None = None
        self.errors_m: Mapping[str, float] = {}
        self.last: Fitted | None = None
        self.rungs: list[FittedRung] = []
        self.held: HeldModel | None = None
        self.story: DiagnosisSummary | None = read_summary(self.campaign.folder)
        self._story_time = self._diagnosed_at()
        self._touched = False
        self._redraw_pending = self._words_pending = False
        self._job: FitJob[Step, Fitted] | None = None
        self._wanted = False
        self._step: Step | None = None
        self._waiting = FitProgress()
        self._build(reopen)
        ground.listen(self._heard_ground)
        document.on_session_destroyed(lambda _context: self.close())
        document.add_periodic_callback(self._look_again, LOOK_AGAIN_MS)
        document.add_periodic_callback(self._clock, CLOCK_MS)
        self._ground_changed()

    # ---- what is on the page -------------------------------------------------------------------------------------

    def _build(self, reopen: Reopen | None) -> None:
        campaign = self.campaign
        self.headline, self.status = words(name="headline"), words(name="status")
        self.numbers, self.tied, self.next = words(name="numbers"), words(name="tied"), words(name="next")
        self.chooser = Chooser(campaign, self._selection_changed)
        self.plots = Plots(campaign, self.chooser.toggle)
        suspects = self.story.best if self.story is not None else ()
        self.panel = EffectPanel(campaign, self.choice, suspects, self._ticked, self._moved)
        self.film = FilmPanel(campaign, self.document, self._instant)
        self.keep = KeepPanel(self)
        self.proposal = ProposalPanel(self, reopen)
        self.refit = Button(label="Refit", button_type="primary", width=110, name="refit", stylesheets=[sheet()])
        self.back = Button(label="As fitted", width=96, name="as_fitted", stylesheets=[sheet()])
        self.hold = Button(label="Hold to compare", width=132, name="hold", stylesheets=[sheet()])
        self.refit.on_click(self._refit_or_stop)
        self.hold.on_click(self._hold)
        self.back.on_click(self._as_fitted)
        self.said = words(name="commands")
        wrapped = sheet(":host { gap: 6px; flex-wrap: wrap; }")
        buttons = Row(children=[self.refit, self.back, self.hold], margin=0, stylesheets=[wrapped])
        hint = words(
            "<small>A tick refits. A size that was dragged stays until the next fit. <i>Hold to compare</i> keeps this "
            "model beside the next. The same from the command line:</small>"
        )
        actions = Column(children=[buttons, hint, self.said], sizing_mode="stretch_width", name="actions", margin=0)
        roots = [self.headline, self.status, self.chooser.root, self.plots.motion, self.plots.residual]
        roots += [self.plots.errors, self.panel.root, actions, self.numbers, self.tied, self.next]
        for root in (*roots, self.film.root, self.keep.root, self.proposal.root):
            self.document.add_root(root)
        figures = [self.plots.motion, self.plots.residual, self.plots.errors, self.film.figure]
        self.document.js_on_event("document_ready", CustomJS(args={"plots": figures}, code=LET_SCROLL))
        # A recording keeps its greys, and the edges their colours over them.
        self.document.js_on_event("document_ready", screen_script(figures[:-1]))
        self.document.title = f"{campaign.name} – vinetrack explorer"
        self.document.theme = theme()
        self._set_template()

    def _set_template(self) -> None:
        from jinja2 import Environment

        trials, conditions = len(self.campaign.trials), len(self.campaign.conditions)
        out = len(self.campaign.left_out)
        self.document.template = Environment(autoescape=True).from_string(page_template())
        self.document.template_variables.update(
            name=self.campaign.name,
            style=_Markup(page_style()),
            vines=[(vine, follows_screen(colour)) for vine, colour in vine_colours(self.campaign)],
            tally=f"{trials} trials, {conditions} conditions" + (f", {out} left out" if out else ""),
        )

    # ---- what a person does --------------------------------------------------------------------------------------

    def _ticked(self, effect: str, wanted: bool) -> None:
        self.choice = self.choice.with_effect(effect, wanted)
        self._touch()
        self._begin_refit()

    def _moved(self, effect: str, number: str, value: float) -> None:
        known = effect in self.choice
        self.choice = self.choice.with_effect(effect).with_size(number, value)
        if not known:
            self.panel.show(self.choice, sliders=False)
        self._touch()

    def _touch(self) -> None:
        self._touched = True
        if self._job is not None:
            self._end_job("The fit was given up: the model has changed.")
        self._redraw_soon()

    def _selection_changed(self) -> None:
        self.plots.set_shown(self.chooser.shown, self._reference.curves if self._differs() else None)
        if self.curves is not None:
            self.plots.set_curves(self.curves, self.chooser.shown)
            self._show_errors()

    def _as_fitted(self) -> None:
        """Back to the last fit, or to how the page opened."""
        self.choice = self.ground.start if self.last is None else self.last.choice
        self._touched = False
        self.panel.show(self.choice, self.last)
        self._redraw_soon()

    def _refit_or_stop(self) -> None:
        if self._job is not None or self._wanted:
            self._end_job("The fit was stopped.")
            return
        self._begin_refit()

    def _begin_refit(self) -> None:
        self._wanted = True
        self._waiting.begin(time.monotonic())
        self.refit.label = "Stop"
        self._ground_changed()

    def _hold(self) -> None:
        """Keep the model as it is drawn, to compare with; pressed again, the page compares with how it opened."""
        if self.held is not None:
            self.held = None
        elif self.curves is not None:
            fit = self.last if not self._touched else None
            self.held = HeldModel(self.choice.effects, self.curves, dict(self.errors_m), fit)
        self.hold.label = "Hold to compare" if self.held is None else "Let go"
        if self.curves is not None:
            self._draw()
            self._say()

    @property
    def _reference(self) -> HeldModel:
        """What the page compares with: the model that is held, else the one in use as the page opened."""
        if self.held is not None:
            return self.held
        return HeldModel(self.campaign.in_use, self.ground.curves, self.ground.errors_m, self.ground.fitted)

    # ---- fits ----------------------------------------------------------------------------------------------------

    def _heard_ground(self) -> None:
        """From the background's thread."""
        self.document.add_next_tick_callback(self._ground_changed)

    def _ground_changed(self) -> None:
        ground = self.ground
        if self.curves is None and ground.curves is not None:
            self._first_curves()
        if self.last is None and ground.fitted is not None:
            self._first_fit(ground.fitted)
        if self._wanted and ground.fitted is not None:
            self._begin_job(ground.fitted)
        elif self._wanted and not ground.growing and ground.fitted is None:
            self._end_job(ground.trouble)
        self._clock()

    def _first_curves(self) -> None:
        assert self.ground.curves is not None
        self.curves, self.errors_m = self.ground.curves, self.ground.errors_m
        self._selection_changed()
        self._say()
        self.film.set_curves(self.curves, self.ground.curves)
        worst = max(self.errors_m, key=lambda name: self.errors_m[name])
        self.film.show_trial(self.campaign.trials[self.campaign.of_condition(worst)[0]].name)
        as_fitted = self.last is not None and self.choice is self.last.choice
        if self.choice is not self.ground.start and not as_fitted:
            self._touched = True
            self._redraw_soon()

    def _first_fit(self, fitted: Fitted) -> None:
        self.last = fitted
        self.rungs = [rung_of(self.campaign, fitted, None)]
        if self.choice is self.ground.start:
            self.choice = fitted.choice
            self.panel.show(self.choice, fitted)
        self._say()

    def _begin_job(self, ground: Fitted) -> None:
        self._wanted = False
        before = (self.last or ground).fit
        self._step = None
        self._job = FitJob(
            partial(fit_choice, self.campaign, before, self.choice),
            told=self._heard_step,
            done=lambda fitted: self._soon(partial(self._fit_done, fitted)),
            failed=lambda reason: self._soon(partial(self._end_job, reason)),
        )

    def _soon(self, work: Any) -> None:
        """From a fit's thread: the one way into the document's turn."""
        self.document.add_next_tick_callback(work)

    def _heard_step(self, step: Step) -> None:
        """From a fit's thread. A page that cannot keep up draws the newest step only."""
        first = self._step is None
        self._step = step
        if first:
            self._soon(self._show_step)

    def _show_step(self) -> None:
        step, self._step = self._step, None
        if step is None or self._job is None:
            return
        self._waiting.reach(step)
        self._clock()
        self._follow(at_numbers(self.choice, step.values))
        self._say_soon()

    def _fit_done(self, fitted: Fitted) -> None:
        if self._job is None:
            return
        self._job = None
        before, self.last = self.last, fitted
        self.rungs.append(rung_of(self.campaign, fitted, before))
        self.choice, self._touched = fitted.choice, False
        self.curves, self.errors_m = fitted.curves, fitted.errors_m
        self.panel.show(self.choice, fitted)
        self._draw()
        self._say()
        self._end_job("")

    def _end_job(self, reason: str) -> None:
        if self._job is not None:
            self._job.give_up()
        self._job, self._wanted = None, False
        self._waiting.end(reason)
        self.refit.label = "Refit"
        self._clock()
        self._say_soon()

    # ---- drawing -------------------------------------------------------------------------------------------------

    def _redraw_soon(self) -> None:
        if not self._redraw_pending:
            self._redraw_pending = True
            self.document.add_timeout_callback(self._redraw, COALESCE_MS)

    def _redraw(self) -> None:
        self._redraw_pending = False
        if self.ground.curves is not None:
            self._follow(self.choice)
        self._say_soon()

    def _say_soon(self) -> None:
        if not self._words_pending:
            self._words_pending = True
            self.document.add_timeout_callback(self._say, WORDS_MS)

    def _follow(self, choice: ModelChoice) -> None:
        """Curves of a choice, drawn; where the model cannot be followed, that is said and the old ones stay."""
        try:
            self.curves = follow(self.campaign, sized(self.campaign, choice), self.curves)
        except SimulationError as error:
            self._waiting.say(str(error))
            self._clock()
            return
        self._waiting.say("")
        self.errors_m = errors_m(self.campaign, self.curves)
        self._draw()

    def _draw(self) -> None:
        assert self.curves is not None
        self.plots.set_curves(self.curves, self.chooser.shown)
        self.plots.set_earlier(self._reference.curves if self._differs() else None, self.chooser.shown)
        self._show_errors()

    def _show_errors(self) -> None:
        floors = self.campaign.floors_m
        self.plots.set_errors(self.errors_m, self._reference.errors_m, floors, self.chooser.conditions)

    def _differs(self) -> bool:
        """Whether what is drawn is not the model that the page compares with."""
        return self.curves is not None and self.curves is not self._reference.curves

    def _say(self) -> None:
        """Everything that is in words."""
        self._words_pending = False
        if self._job is None and not self._wanted:
            # A step of a fit, or a model not fitted yet, says nothing of what the effect brings.
            _set(self.headline, headline(self.campaign, self.choice, self.errors_m, self.ground.errors_m))
        if self.curves is not None:
            self.film.set_curves(self.curves, self._reference.curves)
            self.film.refresh()
        fit = None if self._touched else self.last
        beside = (
            ""
            if self.curves is None
            else side_by_side(self.campaign, self.held, HeldModel(self.choice.effects, self.curves, self.errors_m, fit))
        )
        _set(self.numbers, beside + numbers_words(self.campaign, self.last, self.rungs, self._touched))
        _set(self.tied, tied_panel(self.campaign, self.story, self.last))
        _set(self.next, next_panel(self.campaign, self.story))
        _set(self.said, self.keep.commands())

    def _clock(self) -> None:
        """The line of what is going on; it is alive while anything is."""
        self.proposal.show()
        if self._job is not None or self._wanted:
            about = "refitting" if self._job is not None else "first the model in use is fitted"
            share, text = self._waiting.state(time.monotonic(), about, self.ground.step if self._wanted else None)
            _set(self.status, progress_bar(share, text))
        elif self._waiting.words:
            _set(self.status, f'<span class="bad">{escaped(self._waiting.words)}</span>')
        elif self.ground.growing:
            what = (
                "preparing the model" if self.ground.curves is None else "fitting the model in use, in the background"
            )
            _set(self.status, f"<small>{what} …</small>")
        else:
            _set(self.status, f'<span class="bad">{escaped(self.ground.trouble)}</span>' if self.ground.trouble else "")

    def _instant(self, trial: str, since_s: float | None) -> None:
        """Mark in the figure where the recording stands."""
        shown = {self.campaign.trials[i].name for i in self.chooser.shown}
        self.plots.set_instant(since_s if trial in shown else None)

    def _diagnosed_at(self) -> float:
        path = self.campaign.folder / DIAGNOSIS
        return path.stat().st_mtime if path.exists() else 0.0

    def _look_again(self) -> None:
        if self._diagnosed_at() != self._story_time:
            self._story_time = self._diagnosed_at()
            self.story = read_summary(self.campaign.folder)
            self._say()

    def is_fitted(self) -> bool:
        """Whether the sizes are those of a fit."""
        return not self._touched

    def close(self) -> None:
        """Nobody looks any more."""
        self.ground.forget(self._heard_ground)
        self.film.close()
        self.proposal.close()
        if self._job is not None:
            self._job.give_up()


def _set(piece: Any, text: str) -> None:
    """Change a piece of HTML only where it differs: what is sent is drawn anew."""
    if piece.text != text:
        piece.text = text


def _Markup(text: str) -> Any:
    from markupsafe import Markup

    return Markup(text)
