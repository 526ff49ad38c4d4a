"""The explorer's page: what it says, its controller, from whose model all else follows, and its server."""

from __future__ import annotations

import logging
import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from html import escape
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
from vinetrack.core.units import SLIDER_UNITS, decimals, display_unit
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.folder import save_model
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.figures.diagnosis_figures import TIED_COSINE
from vinetrack.figures.style import TOKENS, follows_screen, page_frame
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Number
from vinetrack.inference.optimiser import Step
from vinetrack.narrative.verdict_text import quantity_text, spaced_name
from vinetrack.pages.campaign import (
    BackgroundFit,
    Campaign,
    FitProgress,
    Fitted,
    Job,
    ModelChoice,
    Prediction,
    commands,
    correlated_pairs_text,
    fit_choice,
    likelihood_change_text,
    model_text,
    overall_m,
    predict_choice,
    read_campaign,
)
from vinetrack.pages.controls import EffectPanel, ProposalPanel, Reopen, TrialSelector
from vinetrack.pages.local_page import LOOPBACK, is_from_page, secret_path, serve_on_free_port, serve_until_stopped
from vinetrack.pages.plots import (
    TEMPLATES,
    THEME,
    FilmPanel,
    HeldModel,
    Plots,
    button,
    html_div,
    panel,
    progress_bar,
    set_text,
    side_by_side,
    stacked,
    templates,
    vine_colours,
)
from vinetrack.pipeline.effects_stage import effects_of
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_source_experiment

# ------------------------------------------------------------------------------
# Numbers and words of the text panels, which `panels.html` lays out.


def headline(
    campaign: Campaign, choice: ModelChoice, prediction: Prediction | None, opened_with: Prediction | None
) -> str:
    """Return the error of the model now and as the page opened, with the replicate scatter, as a heading."""
    now, before = (overall_m({} if one is None else one.errors_m) for one in (prediction, opened_with))
    floor = overall_m(campaign.floors_m if prediction is None else prediction.floors_m)
    words = model_text(choice.effects)
    return panel(
        "headline",
        model=words[:1].upper() + words[1:],
        now=_in_mm(now),
        before=_in_mm(before),
        floor=_in_mm(floor),
        at_floor=now <= 1.15 * floor,  # chosen: an error up to 1.15 times the replicate scatter counts as equal to it
        refused=campaign.refused,
        named=model_text(campaign.experiment.settings.model),
        in_use=model_text(campaign.in_use),
        command=f"vinetrack run {shlex.quote(campaign.experiment.folder.as_posix())}",
    )


def _in_mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g} mm" if math.isfinite(value_m) else ""


def numbers_panel(
    campaign: Campaign, fits: Sequence[Fitted], sizes_changed: bool, held: HeldModel | None, now: HeldModel
) -> str:
    """Return the held model beside the current one, the parameters of the last fit of this page, and all its fits."""
    compared = [] if held is None else _compared((held, now))
    if not fits:
        return panel("numbers", compared=compared)
    seconds, fit = fits[-1].seconds, fits[-1].fit
    labels = {vine: label for vine, (label, _) in zip(campaign.vines, vine_colours(campaign), strict=True)}
    known = labels if len(labels) > 1 else {}
    fixed = {name: "" if spread.estimated else " (fixed)" for name, spread in fit.spreads.items()}
    spreads = "; ".join(f"{name} {100 * fit.spreads[name].value:.2g} %{words}" for name, words in fixed.items())
    facts = (
        f"noise {1e3 * fit.noise_m:.2g} mm",
        f"χ² per degree of freedom {fit.chi2_per_dof:.3g}" if math.isfinite(fit.chi2_per_dof) else "",
        f"between-trial standard deviations: {spreads}" if spreads else "",
        f"{seconds:.2g} s",
    )
    floor = overall_m(campaign.floors_m)
    ladder = []
    for fitted in fits:
        rms = overall_m(fitted.prediction.errors_m)
        beyond = math.sqrt(max(rms**2 - floor**2, 0.0)) if math.isfinite(floor) else math.nan
        ladder.append((model_text(fitted.choice.effects), _in_mm(rms), _in_mm(beyond) or "–"))
    return panel(
        "numbers",
        compared=compared,
        rows=[_number_row(number, known.get(number.vine, number.vine) or "all") for number in fit.numbers],
        sizes_changed=sizes_changed,
        facts=facts,
        messages=list(map(str, fit.messages)),
        ladder=ladder,
        gained=likelihood_change_text(fits[-2].fit, fit) if len(fits) > 1 else "",
    )


def _compared(models: Sequence[HeldModel]) -> list[tuple[str, ...]]:
    """Error and every fitted parameter of either of two models."""
    rows = [
        ("effects", *(model_text(model.effects) for model in models)),
        ("rms of position", *(_in_mm(overall_m(model.errors_m)) for model in models)),
    ]
    fits = [{} if model.fitted is None else {n.name: n for n in model.fitted.fit.numbers} for model in models]
    for name in dict.fromkeys(name for numbers in fits for name in numbers):
        title = next(numbers[name].title for numbers in fits if name in numbers)
        rows.append((title, *(quantity_text(n[name]) if name in n else "–" for n in fits)))
    return rows


def _number_row(number: Number, vine: str) -> tuple[str, ...]:
    unit, factor = display_unit(number.unit, SLIDER_UNITS)
    name = f"{number.symbol}, {unit}" if unit else number.symbol
    if math.isfinite(number.bound):
        return name, vine, f"{number.bound * factor:.4g}", "at its bound", ""
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return name, vine, f"{number.value * factor:.4g}", "undetermined", ""
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    return name, vine, value, f"± {number.sigma * factor:.{digits}f}", f"{low} to {high}"


def tied_panel(campaign: Campaign, diagnosis: Diagnosis | None, fitted: Fitted | None) -> str:
    """Return what the data cannot separate: effects, by the diagnosis; parameters, by their correlations."""
    tied = () if diagnosis is None or len(diagnosis.answer_set) < 2 else diagnosis.answer_set
    titles, cosines = ([], []) if diagnosis is None or not diagnosis.rounds else _cosine_grid(diagnosis)
    return panel(
        "tied",
        diagnosis=diagnosis,
        diagnose=f"vinetrack diagnose {campaign.folder.as_posix()}",
        names=[spaced_name(name) for name in tied],
        titles=titles,
        cosines=cosines,
        fitted=fitted is not None,
        # 6: pairs of correlated parameters shown; chosen: the card has room for six lines
        pairs=[] if fitted is None else correlated_pairs_text(fitted.fit)[:6],
    )


def _cosine_grid(diagnosis: Diagnosis) -> tuple[list[str], list[list[tuple[str, str]]]]:
    """The titles of the likeliest candidates and the cosines between their effects; none for fewer than two."""
    known, cosines = diagnosis.rounds[0].cosine_names, diagnosis.rounds[0].cosines
    pairs = [(abs(cosines[i][k]), name, other) for i, name in enumerate(known) for k, other in enumerate(known[:i])]
    tied = sorted((pair for pair in pairs if pair[0] >= TIED_COSINE), key=lambda pair: -pair[0])
    likely = [name for name in suspects(diagnosis) if name in known]
    # Candidates in the grid of cosines; chosen: eight columns fit the card of 380 pixels
    names = list(dict.fromkeys([*likely, *(name for _, *pair in tied for name in pair)]))[:8]
    if len(names) < 2:
        return [], []
    place = [known.index(name) for name in names]

    def cell(cosine: float) -> tuple[str, str]:
        """A cosine and its style: blue if it is positive, vermillion if negative, the deeper the larger."""
        if not math.isfinite(cosine):
            return "–", ""
        strength = min(abs(cosine), 1.0) ** 2
        colour = f"rgba({'0,114,178' if cosine > 0 else '213,94,0'},{strength:.2f})"
        return f"{cosine:+.2f}", f"background:{colour};color:{'#fff' if strength > 0.6 else 'inherit'}"

    return [spaced_name(name) for name in names], [[cell(cosines[i][k]) for k in place] for i in place]


def next_panel(campaign: Campaign, diagnosis: Diagnosis | None) -> str:
    """Return the next experiment of the diagnosis, as HTML."""
    advice = None if diagnosis is None else diagnosis.next_experiment or {}
    separations = (advice or {}).get("separation_sigma") or {}
    return panel(
        "next",
        advice=advice,
        diagnose=f"vinetrack diagnose {campaign.folder.as_posix()}",
        trials=[_trial_row(trial) for trial in (advice or {}).get("trials", ())],
        separations=[
            (spaced_name(pair.replace(" | ", " from ")), f"{sigma:.2g} σ")
            for pair, sigma in separations.items()
            if sigma is not None
        ],
    )


def _trial_row(trial: Mapping[str, Any]) -> tuple[str, ...]:
    """One condition in the units of the sheet, with what differs from the present rig."""
    size = f"{_cell(trial.get('diameter_mm'))} mm × {_cell(trial.get('thickness_um'))} µm"
    changed = trial.get("changed") or ()
    other = [COLUMNS[key].in_words(trial[key]) for key in LIMITED["choice"] if key in changed and trial.get(key)]
    return (
        f"{size}{' (new)' if trial.get('new_vine') else ''}",
        f"{_cell(trial.get('pressure_kPa'))} kPa",
        f"{_cell(trial.get('payload_g') or 0)} g",
        _cell(trial.get("replicates", 1)),
        ", ".join(other),
    )


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def suspects(diagnosis: Diagnosis | None) -> tuple[str, ...]:
    """Return the effects worth trying first, best first."""
    if diagnosis is None:
        return ()
    ranked = [candidate.effect for candidate in diagnosis.ranking if math.isfinite(candidate.delta_chi2)]
    return tuple(dict.fromkeys([*diagnosis.answer_set, *ranked]))


# ------------------------------------------------------------------------------
# The controller of an open page.

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
        style, script = ((TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "screen.js"))
        shown = {"plots": figures, "film": self.film.figure, "tokens": TOKENS}
        self.document.js_on_event("document_ready", CustomJS(args=shown, code=script))
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
        self.held = None if self.held is not None or self.shown is None else self._now
        self.hold.label = "Hold to compare" if self.held is None else "Release"
        self._draw()
        self._update_text()

    @property
    def last(self) -> Fitted | None:
        """The last fit."""
        return self.fits[-1] if self.fits else None

    @property
    def _now(self) -> HeldModel:
        return HeldModel(self.choice.effects, self.shown, None if self._sizes_changed else self.last)

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
            self.fits = [background.fitted]
            if self.choice is background.initial:
                self.choice = background.fitted.choice
                self.panel.show(self.choice, background.fitted)
            self._update_text()
        if self._refit_requested and background.fitted is not None:
            self._refit_requested, self._step = False, None
            work = partial(fit_choice, self.campaign, (self.last or background.fitted).fit, self.choice)
            self._job = Job(work, self._on_step, self._fit_ended, self.document.add_next_tick_callback)
        elif self._refit_requested and not background.running and background.fitted is None:
            self._end_job(background.failure)
        self._update_status()

    def _show_first_prediction(self, first: Prediction) -> None:
        self.shown = first
        self._selection_changed()
        self._update_text()
        worst = max(first.errors_m, key=lambda name: first.errors_m[name])
        self.film.show_trial(self.campaign.trials[self.campaign.indices_of_condition(worst)[0]].name)
        as_fitted = self.last is not None and self.choice is self.last.choice
        if self.choice is not self.background.initial and not as_fitted:
            self._sizes_changed = True
            self._soon(self._redraw, REDRAW_MS)

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
        set_text(self.numbers, numbers_panel(self.campaign, self.fits, self._sizes_changed, self.held, self._now))
        set_text(self.tied, tied_panel(self.campaign, self.diagnosis, self.last))
        set_text(self.next, next_panel(self.campaign, self.diagnosis))
        lines = self._commands()
        same = "<small>The same from the command line:</small>" + panel("commands", lines=lines)
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
            text = f'<span class="bad">{escape(failure)}</span>'
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
            self.saved.text = f'<p class="bad">{escape("; ".join(lines))}</p>'
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

    def serve(number: int) -> Server:
        return Server(
            {"/": Application(FunctionHandler(lambda document: Page(shown[-1], document, shown.append)))},
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
