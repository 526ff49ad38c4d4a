"""The explorer's server, and the controller of an open page: input changes the model, from which all else follows."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from contextlib import suppress
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

from vinetrack.core.problems import ExperimentError, format_problems
from vinetrack.core.tables import TableError
from vinetrack.core.terminal import waiting
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.folder import save_model
from vinetrack.figures.style import TOKENS, follows_screen, page_frame
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.optimiser import Step
from vinetrack.pages.campaign import (
    BackgroundFit,
    Campaign,
    FitProgress,
    Fitted,
    Job,
    ModelChoice,
    Prediction,
    commands,
    fit_choice,
    model_text,
    predict_choice,
    read_campaign,
)
from vinetrack.pages.controls import EffectPanel, ProposalPanel, Reopen, TrialSelector
from vinetrack.pages.film_panel import FilmPanel
from vinetrack.pages.local_page import LOOPBACK, is_from_page, secret_path, serve_on_free_port, serve_until_stopped
from vinetrack.pages.plots import (
    TEMPLATES,
    THEME,
    HeldModel,
    Plots,
    button,
    command_block,
    escaped,
    headline,
    html_div,
    next_panel,
    numbers_panel,
    panel,
    progress_bar,
    set_text,
    side_by_side,
    stacked,
    suspects,
    templates,
    tied_panel,
    vine_colours,
)
from vinetrack.pipeline.effects_stage import effects_of
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_source_experiment

# A swipe over a figure scrolls the page, as it does elsewhere
LET_SCROLL = """
for (const plot of plots) {
  Bokeh.index.find_one(plot)?.canvas_view?.events_el?.style.setProperty("touch-action", "pan-y");
}
"""


REDRAW_MS = 4  # Chosen: a quarter of a screen's frame of 16 ms, so that several moves of a slider cause one redraw
# Chosen: text follows a slider at reading speed, because each change makes the browser lay out the page again
TEXT_MS = 150


class Page:
    """Controller of one document. `_on_background_change` and `_on_step` are called from other threads."""

    def __init__(self, background: BackgroundFit, document: Document, reopen: Reopen | None = None) -> None:
        self.background, self.campaign, self.document = background, background.campaign, document
        self.choice: ModelChoice = background.opening_choice
        self.shown: Prediction | None = None
        self.fits: list[Fitted] = []
        self.held: HeldModel | None = None
        self.diagnosis: Diagnosis | None = None
        self._diagnosed_at = 0.0
        self._read_diagnosis()
        self._sizes_changed = False
        self._pending: set[Callable[[], None]] = set()
        self._job: Job[Step, Fitted] | None = None
        self._refit_requested = False
        self._step: Step | None = None
        self._progress, self._message = FitProgress(0.0), ""
        self._build(reopen)
        background.listeners.append(self._on_background_change)
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
        self.saved = html_div(name="saved")
        save = side_by_side(button("Save the model to experiment.yaml", "save", self._save))
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
        texts = [self.headline, self.status, self.numbers, self.tied, self.next]
        figures = [self.plots.motion, self.plots.residual, self.plots.errors]
        panels = [self.selector.root, self.panel.root, self.film.root, self.proposal.root]
        for root in (*texts, *figures, *panels, actions, stacked(save, self.saved, name="keep")):
            self.document.add_root(root)
        swiped = {"plots": [*figures, self.film.figure]}
        self.document.js_on_event("document_ready", CustomJS(args=swiped, code=LET_SCROLL))
        # A recording keeps its greys, and the edges their colours over them.
        style, script = ((TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "screen.js"))
        self.document.js_on_event("document_ready", CustomJS(args={"plots": figures, "tokens": TOKENS}, code=script))
        self.document.title = f"{campaign.name} – vinetrack explorer"
        self.document.theme = Theme(json=THEME)
        self.document.template = templates().get_template("page.html")
        left_out = f", {len(campaign.left_out)} left out" if campaign.left_out else ""
        self.document.template_variables.update(
            name=campaign.name,
            style=Markup(page_frame() + style),
            vines=[(vine, follows_screen(colour)) for vine, colour in vine_colours(campaign)],
            tally=f"{len(campaign.trials)} trials, {len(campaign.conditions)} conditions{left_out}",
        )

    # ---- user input ------------------------------------------------------------------------------------------------

    def _ticked(self, effect: str, wanted: bool) -> None:
        self.choice = self.choice.with_effect(effect, wanted)
        self._mark_changed()
        self._begin_refit()

    def _size_moved(self, effect: str, number: str, value: float) -> None:
        known = effect in self.choice
        self.choice = self.choice.with_effect(effect).with_sizes({number: value})
        if not known:
            self.panel.show(self.choice, sliders=False)
        self._mark_changed()

    def _mark_changed(self) -> None:
        self._sizes_changed = True
        if self._job is not None:
            self._end_job("The fit was cancelled: the model has changed.")
        self._soon(self._redraw, REDRAW_MS)

    def _selection_changed(self) -> None:
        self.plots.set_shown(self.selector.shown)
        self._draw()

    def _as_fitted(self) -> None:
        """Return to the last fit, or to the model with which the page opened."""
        self.choice = self.background.initial if self.last is None else self.last.choice
        self._sizes_changed = False
        self.panel.show(self.choice, self.last)
        self._soon(self._redraw, REDRAW_MS)

    def _refit_or_stop(self) -> None:
        if self._job is not None or self._refit_requested:
            self._end_job("The fit was stopped.")
            return
        self._begin_refit()

    def _begin_refit(self) -> None:
        self._refit_requested = True
        self._progress, self._message = FitProgress(time.monotonic()), ""
        self.refit.label = "Stop"
        self._background_changed()

    def _hold(self) -> None:
        """Hold the current model for comparison; pressed again, compare with the model in use."""
        if self.held is not None:
            self.held = None
        elif self.shown is not None:
            self.held = HeldModel(self.choice.effects, self.shown, None if self._sizes_changed else self.last)
        self.hold.label = "Hold to compare" if self.held is None else "Release"
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
            self._soon(self._redraw, REDRAW_MS)

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
        work, soon = partial(fit_choice, self.campaign, before, self.choice), self.document.add_next_tick_callback
        self._job = Job(work, self._on_step, self._fit_ended, soon)

    def _on_step(self, step: Step) -> None:
        """Called from a fit's thread. A page that cannot keep up draws only the newest step."""
        is_idle = self._step is None
        self._step = step
        if is_idle:
            self.document.add_next_tick_callback(self._show_step)

    def _show_step(self) -> None:
        step, self._step = self._step, None
        if step is None or self._job is None:
            return
        self._progress.update(step)
        self._update_status()
        self._predict(self.choice.with_sizes(step.values))
        self._soon(self._update_text, TEXT_MS)

    def _fit_ended(self, fitted: Fitted | None, reason: str) -> None:
        if self._job is None:
            return
        if fitted is not None:
            self._job = None
            self.fits.append(fitted)
            self.choice, self._sizes_changed = fitted.choice, False
            self.shown = fitted.prediction
            self.panel.show(self.choice, fitted)
            self._draw()
            self._update_text()
        self._end_job(reason)

    def _end_job(self, reason: str) -> None:
        if self._job is not None:
            self._job.cancel()
        self._job, self._refit_requested = None, False
        self._message = reason
        self.refit.label = "Refit"
        self._update_status()
        self._soon(self._update_text, TEXT_MS)

    # ---- drawing -------------------------------------------------------------------------------------------------

    def _soon(self, work: Callable[[], None], delay_ms: int) -> None:
        """Do it once after a delay, however often it is asked for until then."""
        if work in self._pending:
            return

        def begin() -> None:
            self._pending.discard(work)
            work()

        self._pending.add(work)
        self.document.add_timeout_callback(begin, delay_ms)

    def _redraw(self) -> None:
        if self.background.prediction is not None:
            self._predict(self.choice)
        self._soon(self._update_text, TEXT_MS)

    def _predict(self, choice: ModelChoice) -> None:
        """Predict and draw a choice; if that fails, show the error and keep the former prediction."""
        try:
            self.shown = predict_choice(self.campaign, choice, None if self.shown is None else self.shown.floors_m)
        except FitError as error:
            self._message = str(error)
            self._update_status()
            return
        self._message = ""
        self._draw()

    def _draw(self) -> None:
        if self.shown is not None:
            self.plots.draw(self.shown, self._reference, self.selector.shown, self.selector.conditions)

    def _update_text(self) -> None:
        """Update all text of the page."""
        if self._job is None and not self._refit_requested:
            # The error at a step of a fit, or before a fit, says nothing about the effect.
            set_text(self.headline, headline(self.campaign, self.choice, self.shown, self.background.prediction))
        if self.shown is not None:
            self.film.set_predictions(self.shown, self._reference.prediction)
        now = HeldModel(self.choice.effects, self.shown, None if self._sizes_changed else self.last)
        set_text(self.numbers, numbers_panel(self.campaign, self.fits, self._sizes_changed, self.held, now))
        set_text(self.tied, tied_panel(self.campaign, self.diagnosis, self.last))
        set_text(self.next, next_panel(self.campaign, self.diagnosis))
        lines = self._commands()
        same = "<small>The same from the command line:</small>" + command_block(lines)
        set_text(self.command_text, same if lines else "")

    def _update_status(self) -> None:
        """Update the status line."""
        self.proposal.show()
        background, text = self.background, ""
        if self._job is not None or self._refit_requested:
            task = "refitting" if self._job is not None else "fitting the model in use first"
            other = background.step if self._refit_requested else None
            text = progress_bar(*self._progress.state(time.monotonic(), task, other))
        elif failure := self._message or background.failure:
            text = f'<span class="bad">{escaped(failure)}</span>'
        elif background.running:
            fitting = "fitting the model in use, in the background"
            text = f"<small>{'preparing the model' if background.prediction is None else fitting} …</small>"
        set_text(self.status, text)

    def _instant(self, trial: str, since_s: float) -> None:
        """Mark in the figure the time of the frame shown."""
        shown = {self.campaign.trials[i].name for i in self.selector.shown}
        self.plots.set_instant(since_s if trial in shown else None)

    def _read_diagnosis(self) -> bool:
        """Read the diagnosis of the results, None if there is none or it cannot be read; whether it has changed."""
        results = Results(self.campaign.folder)
        changed_at = results.diagnosis.stat().st_mtime if results.diagnosis.exists() else 0.0
        if changed_at == self._diagnosed_at:
            return False
        self.diagnosis, self._diagnosed_at = None, changed_at
        with suppress(ResultsError):
            self.diagnosis = read_diagnosis(results)
        return True

    def _check_for_diagnosis(self) -> None:
        if self._read_diagnosis():
            self._update_text()

    # ---- saving --------------------------------------------------------------------------------------------------

    def _commands(self, *, save: bool = False) -> list[str]:
        return commands(self.campaign, self.choice, fitted=not self._sizes_changed, save=save)

    def _save(self) -> None:
        folder, effects = self.campaign.experiment.folder, self.choice.effects
        try:
            path = save_model(folder, effects, self.campaign.own_files(effects))
        except (ExperimentError, TableError, OSError) as error:
            lines = format_problems(error.problems) if isinstance(error, ExperimentError) else [str(error)]
            self.saved.text = f'<p class="bad">{escaped("; ".join(lines))}</p>'
            return
        rerun = f"snakemake --cores 2 --config experiment={folder.as_posix()}"
        given = {"model": model_text(effects), "same": self._commands(save=True), "rerun": rerun}
        self.saved.text = panel("saved", path=path.as_posix(), **given)

    def close(self) -> None:
        """The page was closed."""
        with suppress(ValueError):
            self.background.listeners.remove(self._on_background_change)
        self.film.close()
        self.proposal.close()
        if self._job is not None:
            self._job.cancel()


# ------------------------------------------------------------------------------
# Server of the page, on the loopback address only and without external resources.


def start_server(background: BackgroundFit, port: int | None = None) -> Server:
    """Return a server that is bound to the loopback address and refuses requests from other pages."""
    shown = [background]

    def open_page(document: Document) -> None:
        Page(shown[-1], document, shown.append)

    def serve(number: int) -> Server:
        return Server(
            {"/": Application(FunctionHandler(open_page, trap_exceptions=False))},
            prefix=secret_path(),
            address=LOOPBACK,
            port=number,
            allow_websocket_origin=["*"],  # checked below, with all else
            # Interval of pings to an open page; chosen: a closed page is noticed within half a minute
            keep_alive_milliseconds=20_000,
            check_unused_sessions_milliseconds=5_000,
            unused_session_lifetime_milliseconds=10_000,
            use_index=False,
        )

    server = serve_on_free_port(serve, port)
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
    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(
    folder: Path, experiment: Path | None, say: Callable[[str], None], port: int | None, *, browser: bool
) -> None:
    """Serve the page of a results folder until Ctrl-C (or SIGTERM)."""
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
