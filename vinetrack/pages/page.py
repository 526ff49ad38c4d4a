"""The explorer's server, and the controller of an open page: input changes the model, from which all else follows."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.models import CustomJS
from bokeh.server.server import Server
from bokeh.themes import Theme
from markupsafe import Markup
from tornado.web import ErrorHandler

from vinetrack.figures.style import TOKENS, follows_screen, page_frame
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.optimiser import Step
from vinetrack.pages.campaign import (
    BackgroundFit,
    Campaign,
    FitJob,
    FitProgress,
    Fitted,
    ModelChoice,
    Prediction,
    fit_choice,
    predict_choice,
    read_campaign,
)
from vinetrack.pages.controls import EffectPanel, ProposalPanel, Reopen, SavePanel, TrialSelector
from vinetrack.pages.film_panel import FilmPanel
from vinetrack.pages.local_page import LOOPBACK, is_from_page, secret_path, serve_on_free_port, serve_until_stopped
from vinetrack.pages.plots import (
    TEMPLATES,
    THEME,
    HeldModel,
    Plots,
    button,
    comparison_table,
    diagnosis_of,
    escaped,
    fitted_numbers_html,
    headline,
    html_div,
    next_panel,
    progress_bar,
    side_by_side,
    stacked,
    suspects,
    tied_panel,
    vine_colours,
)
from vinetrack.results.folder_layout import Results

# A swipe over a figure scrolls the page, as it does elsewhere
LET_SCROLL = """
for (const plot of plots) {
  Bokeh.index.find_one(plot)?.canvas_view?.events_el?.style.setProperty("touch-action", "pan-y");
}
"""


class Page:
    """Controller of one document. `_on_background_change` and `_on_step` are called from other threads."""

    def __init__(self, background: BackgroundFit, document: Document, reopen: Reopen | None = None) -> None:
        self.background, self.campaign, self.document = background, background.campaign, document
        self.choice: ModelChoice = background.opening_choice
        self.shown: Prediction | None = None
        self.fits: list[Fitted] = []
        self.held: HeldModel | None = None
        self.diagnosis, self._diagnosed_at = diagnosis_of(self.campaign.folder), self._diagnosis_time()
        self._sizes_changed = False
        self._redraw_pending = self._text_pending = False
        self._job: FitJob[Step, Fitted] | None = None
        self._refit_requested = False
        self._step: Step | None = None
        self._progress = FitProgress()
        self._build(reopen)
        background.add_listener(self._on_background_change)
        document.on_session_destroyed(lambda _context: self.close())
        # Chosen: interval at which the page looks for a new diagnosis
        document.add_periodic_callback(self._check_for_diagnosis, 2000)
        document.add_periodic_callback(self._update_status, 200)  # Chosen: the status line shows tenths of a second
        self._background_changed()

    # ---- layout ----------------------------------------------------------------------------------------------------

    def _build(self, reopen: Reopen | None) -> None:
        campaign = self.campaign
        self.headline, self.status = html_div(name="headline"), html_div(name="status")
        self.numbers, self.tied, self.next = html_div(name="numbers"), html_div(name="tied"), html_div(name="next")
        self.selector = TrialSelector(campaign, self._selection_changed)
        self.plots = Plots(campaign, self.selector.toggle)
        self.panel = EffectPanel(campaign, self.choice, suspects(self.diagnosis), self._ticked, self._size_moved)
        self.film = FilmPanel(campaign, self.document, self._instant)
        self.save_panel = SavePanel(self)
        self.proposal = ProposalPanel(self, reopen)
        self.refit = button("Refit", "refit", self._refit_or_stop, margin=5, width=110, button_type="primary")
        back = button("As fitted", "as_fitted", self._as_fitted, margin=5, width=96)
        self.hold = button("Hold to compare", "hold", self._hold, margin=5, width=132)
        self.command_text = html_div(name="commands")
        buttons = side_by_side(self.refit, back, self.hold, css=":host { gap: 6px; flex-wrap: wrap; }")
        hint = html_div(
            "<small>A tick refits. A size that was dragged stays until the next fit. <i>Hold to compare</i> keeps this "
            "model for comparison.</small>"
        )
        actions = stacked(buttons, hint, self.command_text, name="actions")
        roots = [self.headline, self.status, self.selector.root, self.plots.motion, self.plots.residual]
        roots += [self.plots.errors, self.panel.root, actions, self.numbers, self.tied, self.next]
        for root in (*roots, self.film.root, self.save_panel.root, self.proposal.root):
            self.document.add_root(root)
        figures = [self.plots.motion, self.plots.residual, self.plots.errors, self.film.figure]
        self.document.js_on_event("document_ready", CustomJS(args={"plots": figures}, code=LET_SCROLL))
        # A recording keeps its greys, and the edges their colours over them.
        code = (TEMPLATES / "screen.js").read_text(encoding="utf-8")
        screen = CustomJS(args={"plots": figures[:-1], "tokens": TOKENS}, code=code)
        self.document.js_on_event("document_ready", screen)
        self.document.title = f"{campaign.name} – vinetrack explorer"
        self.document.theme = Theme(json=THEME)
        self._set_template()

    def _set_template(self) -> None:
        from jinja2 import Environment

        trials, conditions = len(self.campaign.trials), len(self.campaign.conditions)
        out = len(self.campaign.left_out)
        page, style = ((TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.html", "page.css"))
        self.document.template = Environment(autoescape=True).from_string(page)
        self.document.template_variables.update(
            name=self.campaign.name,
            style=Markup(page_frame() + style),
            vines=[(vine, follows_screen(colour)) for vine, colour in vine_colours(self.campaign)],
            tally=f"{trials} trials, {conditions} conditions" + (f", {out} left out" if out else ""),
        )

    # ---- user input ------------------------------------------------------------------------------------------------

    def _ticked(self, effect: str, wanted: bool) -> None:
        self.choice = self.choice.with_effect(effect, wanted)
        self._mark_changed()
        self._begin_refit()

    def _size_moved(self, effect: str, number: str, value: float) -> None:
        known = effect in self.choice
        self.choice = self.choice.with_effect(effect).with_size(number, value)
        if not known:
            self.panel.show(self.choice, sliders=False)
        self._mark_changed()

    def _mark_changed(self) -> None:
        self._sizes_changed = True
        if self._job is not None:
            self._end_job("The fit was cancelled: the model has changed.")
        self._redraw_soon()

    def _selection_changed(self) -> None:
        self.plots.set_shown(self.selector.shown, self._reference.prediction if self._differs() else None)
        if self.shown is not None:
            self.plots.set_curves(self.shown, self.selector.shown)
            self._show_errors()

    def _as_fitted(self) -> None:
        """Return to the last fit, or to the model with which the page opened."""
        self.choice = self.background.initial if self.last is None else self.last.choice
        self._sizes_changed = False
        self.panel.show(self.choice, self.last)
        self._redraw_soon()

    def _refit_or_stop(self) -> None:
        if self._job is not None or self._refit_requested:
            self._end_job("The fit was stopped.")
            return
        self._begin_refit()

    def _begin_refit(self) -> None:
        self._refit_requested = True
        self._progress.begin(time.monotonic())
        self.refit.label = "Stop"
        self._background_changed()

    def _hold(self) -> None:
        """Hold the current model for comparison; pressed again, compare with the model in use."""
        if self.held is not None:
            self.held = None
        elif self.shown is not None:
            self.held = HeldModel(self.choice.effects, self.shown, None if self._sizes_changed else self.last)
        self.hold.label = "Hold to compare" if self.held is None else "Release"
        if self.shown is not None:
            self._draw()
            self._update_text()

    @property
    def last(self) -> Fitted | None:
        """The last fit."""
        return self.fits[-1] if self.fits else None

    @property
    def _reference(self) -> HeldModel:
        """The model for comparison: the one that is held, else the model in use."""
        if self.held is not None:
            return self.held
        return HeldModel(self.campaign.in_use, self.background.prediction, self.background.fitted)

    # ---- fits ----------------------------------------------------------------------------------------------------

    def _on_background_change(self) -> None:
        """Called from the background thread."""
        self.document.add_next_tick_callback(self._background_changed)

    def _background_changed(self) -> None:
        background = self.background
        if self.shown is None and background.prediction is not None:
            self._show_first_prediction(background.prediction)
        if self.last is None and background.fitted is not None:
            self._show_first_fit(background.fitted)
        if self._refit_requested and background.fitted is not None:
            self._begin_job(background.fitted)
        elif self._refit_requested and not background.running and background.fitted is None:
            self._end_job(background.failure)
        self._update_status()

    def _show_first_prediction(self, first: Prediction) -> None:
        self.shown = first
        self._selection_changed()
        self._update_text()
        self.film.set_predictions(first, first)
        worst = max(first.errors_m, key=lambda name: first.errors_m[name])
        self.film.show_trial(self.campaign.trials[self.campaign.indices_of_condition(worst)[0]].name)
        as_fitted = self.last is not None and self.choice is self.last.choice
        if self.choice is not self.background.initial and not as_fitted:
            self._sizes_changed = True
            self._redraw_soon()

    def _show_first_fit(self, fitted: Fitted) -> None:
        self.fits = [fitted]
        if self.choice is self.background.initial:
            self.choice = fitted.choice
            self.panel.show(self.choice, fitted)
        self._update_text()

    def _begin_job(self, first: Fitted) -> None:
        self._refit_requested = False
        before = (self.last or first).fit
        self._step = None
        self._job = FitJob(
            partial(fit_choice, self.campaign, before, self.choice),
            on_progress=self._on_step,
            on_success=lambda fitted: self._in_document(partial(self._fit_done, fitted)),
            on_failure=lambda reason: self._in_document(partial(self._end_job, reason)),
        )

    def _in_document(self, work: Any) -> None:
        """Called from a fit's thread: run `work` in the document's thread."""
        self.document.add_next_tick_callback(work)

    def _on_step(self, step: Step) -> None:
        """Called from a fit's thread. A page that cannot keep up draws only the newest step."""
        is_idle = self._step is None
        self._step = step
        if is_idle:
            self._in_document(self._show_step)

    def _show_step(self) -> None:
        step, self._step = self._step, None
        if step is None or self._job is None:
            return
        self._progress.update(step)
        self._update_status()
        self._predict(self.choice.with_sizes(step.values))
        self._update_text_soon()

    def _fit_done(self, fitted: Fitted) -> None:
        if self._job is None:
            return
        self._job = None
        self.fits.append(fitted)
        self.choice, self._sizes_changed = fitted.choice, False
        self.shown = fitted.prediction
        self.panel.show(self.choice, fitted)
        self._draw()
        self._update_text()
        self._end_job("")

    def _end_job(self, reason: str) -> None:
        if self._job is not None:
            self._job.cancel()
        self._job, self._refit_requested = None, False
        self._progress.message = reason
        self.refit.label = "Refit"
        self._update_status()
        self._update_text_soon()

    # ---- drawing -------------------------------------------------------------------------------------------------

    def _redraw_soon(self) -> None:
        if not self._redraw_pending:
            self._redraw_pending = True
            # Chosen: a quarter of a screen's frame of 16 ms, so that several moves of a slider cause one redraw
            self.document.add_timeout_callback(self._redraw, 4)

    def _redraw(self) -> None:
        self._redraw_pending = False
        if self.background.prediction is not None:
            self._predict(self.choice)
        self._update_text_soon()

    def _update_text_soon(self) -> None:
        if not self._text_pending:
            self._text_pending = True
            # 150: chosen: text follows a slider at reading speed, because each change makes the browser
            # lay out the page again
            self.document.add_timeout_callback(self._update_text, 150)

    def _predict(self, choice: ModelChoice) -> None:
        """Predict and draw a choice; if that fails, show the error and keep the former prediction."""
        try:
            self.shown = predict_choice(self.campaign, choice, None if self.shown is None else self.shown.floors_m)
        except FitError as error:
            self._progress.message = str(error)
            self._update_status()
            return
        self._progress.message = ""
        self._draw()

    def _draw(self) -> None:
        assert self.shown is not None
        self.plots.set_curves(self.shown, self.selector.shown)
        self.plots.set_reference(self._reference.prediction if self._differs() else None, self.selector.shown)
        self._show_errors()

    def _show_errors(self) -> None:
        assert self.shown is not None
        self.plots.set_errors(
            self.shown.errors_m, self._reference.errors_m, self.shown.floors_m, self.selector.conditions
        )

    def _differs(self) -> bool:
        """Whether the model drawn is another than the model for comparison."""
        return self.shown is not None and self.shown is not self._reference.prediction

    def _update_text(self) -> None:
        """Update all text of the page."""
        self._text_pending = False
        if self._job is None and not self._refit_requested:
            # The error at a step of a fit, or before a fit, says nothing about the effect.
            _set(self.headline, headline(self.campaign, self.choice, self.shown, self.background.prediction))
        if self.shown is not None:
            self.film.set_predictions(self.shown, self._reference.prediction)
            self.film.refresh()
        fit = None if self._sizes_changed else self.last
        comparison = (
            ""
            if self.shown is None
            else comparison_table(self.campaign, self.held, HeldModel(self.choice.effects, self.shown, fit))
        )
        _set(
            self.numbers,
            comparison + fitted_numbers_html(self.campaign, self.fits, self._sizes_changed),
        )
        _set(self.tied, tied_panel(self.campaign, self.diagnosis, self.last))
        _set(self.next, next_panel(self.campaign, self.diagnosis))
        _set(self.command_text, self.save_panel.commands())

    def _update_status(self) -> None:
        """Update the status line."""
        self.proposal.show()
        if self._job is not None or self._refit_requested:
            task = "refitting" if self._job is not None else "fitting the model in use first"
            share, text = self._progress.state(
                time.monotonic(), task, self.background.step if self._refit_requested else None
            )
            _set(self.status, progress_bar(share, text))
        elif self._progress.message:
            _set(self.status, f'<span class="bad">{escaped(self._progress.message)}</span>')
        elif self.background.running:
            what = (
                "preparing the model"
                if self.background.prediction is None
                else "fitting the model in use, in the background"
            )
            _set(self.status, f"<small>{what} …</small>")
        else:
            _set(
                self.status,
                f'<span class="bad">{escaped(self.background.failure)}</span>' if self.background.failure else "",
            )

    def _instant(self, trial: str, since_s: float | None) -> None:
        """Mark in the figure the time of the frame shown."""
        shown = {self.campaign.trials[i].name for i in self.selector.shown}
        self.plots.set_instant(since_s if trial in shown else None)

    def _diagnosis_time(self) -> float:
        path = Results(self.campaign.folder).diagnosis
        return path.stat().st_mtime if path.exists() else 0.0

    def _check_for_diagnosis(self) -> None:
        if self._diagnosis_time() != self._diagnosed_at:
            self.diagnosis, self._diagnosed_at = diagnosis_of(self.campaign.folder), self._diagnosis_time()
            self._update_text()

    def is_fitted(self) -> bool:
        """Whether the sizes are those of a fit."""
        return not self._sizes_changed

    def close(self) -> None:
        """The page was closed."""
        self.background.remove_listener(self._on_background_change)
        self.film.close()
        self.proposal.close()
        if self._job is not None:
            self._job.cancel()


def _set(piece: Any, text: str) -> None:
    """Change a piece of HTML only if it differs, because whatever is sent is drawn again."""
    if piece.text != text:
        piece.text = text


# ------------------------------------------------------------------------------
# Server of the page, on the loopback address only and without external resources.


def start_server(background: BackgroundFit, port: int | None = None) -> Server:
    """Return a server that is bound to the loopback address and refuses requests from other pages."""
    return serve_on_free_port(lambda number: _bind(background, number), port)


def _bind(background: BackgroundFit, port: int) -> Server:
    shown = [background]

    def open_page(document: Document) -> None:
        Page(shown[-1], document, shown.append)

    server = Server(
        {"/": Application(FunctionHandler(open_page, trap_exceptions=False))},
        prefix=secret_path(),
        address=LOOPBACK,
        port=port,
        allow_websocket_origin=["*"],  # checked below, with all else
        # Interval of pings to an open page; chosen: a closed page is noticed within half a minute
        keep_alive_milliseconds=20_000,
        check_unused_sessions_milliseconds=5_000,
        unused_session_lifetime_milliseconds=10_000,
        use_index=False,
    )
    tornado = server._tornado
    routed = tornado.find_handler

    def find_handler(request: Any, **given: Any) -> Any:
        """Answer 403 to other pages, on every route: bokeh checks only the origin of a web socket, which matches if a
        foreign name resolves to this machine.
        """
        if is_from_page(request.headers, server.port):
            return routed(request, **given)
        return tornado.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

    tornado.find_handler = find_handler
    server.start()
    return server


def address(server: Server) -> str:
    """Return the address of the page."""
    return f"http://{LOOPBACK}:{server.port}{server.prefix}/"


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """Open a results folder and its experiment."""
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.results.folder_layout import read_source_experiment

    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(
    folder: Path, experiment: Path | None, say: Callable[[str], None], port: int | None, *, browser: bool
) -> None:
    """Serve the page of a results folder until Ctrl-C (or SIGTERM)."""
    from vinetrack.core.terminal import waiting

    with waiting(f"opening {folder}"):
        background = BackgroundFit(open_campaign(folder, experiment))
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # A background fit would otherwise delay the page.
    sys.setswitchinterval(1e-3)  # Thread switch interval
    server = start_server(background, port)
    background.begin()
    loop = server.io_loop
    end = partial(loop.add_callback_from_signal, loop.stop)
    serve_until_stopped("Explorer", address(server), loop.start, end, say, browser=browser)
    server.stop()
