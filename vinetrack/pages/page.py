"""The page of the explorer: what it says, its controls, its controller, and its server."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from html import escape
from pathlib import Path

from bokeh import models as bk
from bokeh.document import Document
from bokeh.server.tornado import BokehTornado
from markupsafe import Markup
from tornado.ioloop import IOLoop

from vinetrack.core.problems import ExperimentError, InputError, format_problems
from vinetrack.core.process import waiting
from vinetrack.core.units import DISPLAY_UNITS, display_unit, number
from vinetrack.diagnosis.result import ADEQUATE, Diagnosis
from vinetrack.effects import BASE_EFFECTS
from vinetrack.figures.registry import features
from vinetrack.figures.style import vine_styles
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Number, number_row, numbers_text
from vinetrack.inference.optimiser import Step, Watch
from vinetrack.narrative.verdict_text import Row, quantity_text, spaced_name, verdict_table
from vinetrack.pages import plots
from vinetrack.pages.campaign import (
    BackgroundFit,
    Campaign,
    Evaluated,
    Job,
    ModelChoice,
    Prediction,
    SizeControl,
    fit_choice,
    model_text,
    open_campaign,
    predict_choice,
    sizes_of,
    slider_range,
)
from vinetrack.pages.draft_files import save_model
from vinetrack.pages.local_page import TEMPLATES, PageServer, page_frame
from vinetrack.pipeline.workflow import command_for_results
from vinetrack.report.build import TOKENS, beyond_adequate, next_experiment
from vinetrack.results import Results, ResultsError, read_diagnosis

# ------------------------------------------------------------------------------
# Numbers and words of the text panels, which `panels.html` lays out.


def _in_mm(value_m: float) -> str:
    return f"{number(1e3 * value_m)} mm" if math.isfinite(value_m) else ""


def numbers_panel(fits: Sequence[Evaluated], sizes_changed: bool, compared: Sequence[tuple[str, str, str]]) -> str:
    """Return two models compared, the last fit of this page as it is printed, and all its fits."""
    if not fits:
        return plots.panel("numbers", compared=compared)
    before, fit = fits[max(len(fits) - 2, 0)].fit, fits[-1].fit
    gain, more = 2 * (fit.log_likelihood - before.log_likelihood), len(fit.numbers) - len(before.numbers)
    ladder = [(model_text(each.choice.effects), _in_mm(each.prediction.rms_m)) for each in fits]
    return plots.panel(
        "numbers",
        compared=compared,
        rows=[number_row(number) for number in fit.numbers],
        sizes_changed=sizes_changed,
        notes=numbers_text(fit)[1 + len(fit.numbers) :],
        ladder=ladder,
        gained=f"Δχ² = {gain:,.1f} for {more:+d} parameters." if len(fits) > 1 else "",
    )


def suspects(diagnosis: Diagnosis | None) -> tuple[str, ...]:
    """Return the effects worth trying first, best first; none where the model is adequate."""
    if diagnosis is None or diagnosis.verdict == ADEQUATE:
        return ()
    ranked = [candidate.effect for candidate in diagnosis.ranking if math.isfinite(candidate.delta_chi2)]
    return tuple(dict.fromkeys([*diagnosis.answer_set, *ranked]))


# ------------------------------------------------------------------------------
# The controls: the trials shown, and the effects in the model with their sizes.


class SizeSlider:
    """Slider of one parameter, and the text of its fitted value; calls `moved(name, value)` with the value in SI."""

    def __init__(self, size: SizeControl, value: float, disabled: bool, moved: Callable[[str, float], None]) -> None:
        self.size = size
        shown = {**DISPLAY_UNITS, "m": ("mm", 1e3), "m²": ("cm²", 1e4)}
        unit, self._factor = display_unit(size.parameter.unit, size.pressure_unit, shown)
        what = size.vine or size.parameter.meaning
        self._opened = slider_range(size.key, size.parameter, value)
        self.slider = bk.Slider(
            **self._ends(value),
            value=self._factor * value,
            title=f"{size.parameter.symbol}, {what}" if what else size.parameter.symbol,
            format=bk.PrintfTickFormatter(format=f"%.4g {unit}".rstrip()),
            sizing_mode="stretch_width",
            disabled=disabled,
            name=f"size_{size.name}",
            css_classes=["size"],
            margin=(2, 0, 6, 0),
        )
        self.fitted = bk.Div(visible=False, name=f"found_{size.name}")
        self.slider.on_change("value", lambda _attr, _old, new: moved(size.name, float(new) / self._factor))

    def _ends(self, value: float) -> dict[str, float]:
        """Ends and step of a range that holds a value and the range of the beginning."""
        low, high = slider_range(self.size.key, self.size.parameter, value)
        low, high = self._factor * min(low, self._opened[0]), self._factor * max(high, self._opened[1])
        # 400: steps of a slider; chosen: about one per pixel
        return {"start": low, "end": high, "step": (high - low) / 400 or 1.0}

    def show(self, value: float, number: Number | None) -> None:
        """Move the slider to a value, and show the estimate of a fit below it, or none."""
        self.slider.update(**self._ends(value), value=value * self._factor)
        text = ""
        if number is not None:
            _, estimate, error, _, interval, unit = number_row(number)
            ends = f" (its {number.ends_at} bound)" if number.ends_at else ""
            reach = f" · 95 %: {interval}{ends}" if interval else ""
            text = f"<small>fitted: <b>{estimate} {error}</b> {escape(unit)}{reach}</small>"
        self.fitted.update(text=text, visible=number is not None)


class EffectPanel:
    """All effects in groups; calls `ticked(effect, wanted)` and `moved(effect, parameter, value)` at each change."""

    def __init__(
        self,
        campaign: Campaign,
        choice: ModelChoice,
        suspects: Sequence[str],
        ticked: Callable[[str, bool], None],
        moved: Callable[[str, str, float], None],
    ) -> None:
        self.ticks: dict[str, bk.Checkbox] = {}
        self.sliders: dict[str, list[SizeSlider]] = {}
        rows: dict[str, bk.Column] = {}
        for name, effect in campaign.effects.items():
            unusable = campaign.unusable.get(name, "")
            self.ticks[name] = bk.Checkbox(
                label=spaced_name(name),
                active=name in choice.effects,
                disabled=bool(unusable) or name in BASE_EFFECTS,  # all others are added to these
                name=f"tick_{name}",
                css_classes=["tick"],
                margin=(6, 0, 0, 0),
            )
            self.ticks[name].on_change("active", lambda _attr, _old, new, name=name: ticked(name, new))
            self.sliders[name] = [
                SizeSlider(size, choice.numbers[size.name], bool(unusable), partial(moved, name))
                for size in sizes_of(campaign, effect)
            ]
            about = bk.Div(text=f"<small>{escape(unusable or effect.formula)}</small>")
            parts = [part for one in self.sliders[name] for part in (one.slider, one.fitted)]
            rows[name] = bk.Column(self.ticks[name], about, *parts, margin=(0, 0, 4, 0))
        in_use = [name for name in rows if name in choice.effects]
        likely = [name for name in suspects if name in rows and name not in in_use][:6]
        others = [name for name in rows if name not in in_use and name not in likely]
        measured = [name for name in others if campaign.effects[name].kind == "measurement"]
        groups = [
            ("Suspected by the diagnosis", likely, True),
            ("Physical effects", [name for name in others if name not in measured], not likely),
            ("Measurement effects", measured, False),
            ("In the model in use", in_use, True),
        ]
        shown = []
        for title, names, visible in groups:
            if names:
                inside = bk.Column(*(rows[name] for name in names), visible=visible)
                head = bk.Toggle(label=title, active=visible, css_classes=["heading"], sizing_mode="stretch_width")
                head.js_on_change("active", bk.CustomJS(args={"inside": inside}, code="inside.visible = cb_obj.active"))
                shown.append(bk.Column(head, inside))
        self.root = bk.Column(*shown, name="effects")

    def show(self, choice: ModelChoice, numbers: Mapping[str, Number]) -> None:
        """Set tick boxes and sliders to a choice, with the fitted numbers of its effects by name."""
        for name, tick in self.ticks.items():
            tick.active = name in choice.effects
            for one in self.sliders[name]:
                one.show(choice.numbers[one.size.name], numbers.get(one.size.name) if name in choice.effects else None)


class TrialSelector:
    """Buttons to select conditions; calls `on_change` when the selection changes."""

    def __init__(self, campaign: Campaign, on_change: Callable[[], None]) -> None:
        self.campaign = campaign
        labels = [campaign.labels[name] for name in campaign.conditions]
        given = {"name": "conditions", "css_classes": ["chips"], "margin": (2, 0)}
        self._conditions = bk.CheckboxButtonGroup(labels=labels, active=self._every, **given)
        self._conditions.on_change("active", lambda _attr, _old, _new: on_change())
        tools = plots.beside(
            plots.button(
                "all", "choose_all", lambda: self._conditions.update(active=self._every), css_classes=["small"]
            ),
            plots.button("none", "choose_none", lambda: self._conditions.update(active=[]), css_classes=["small"]),
            css=":host { gap: 4px; }",
        )
        self.root = bk.Column(self._conditions, tools, name="choose")

    @property
    def _every(self) -> list[int]:
        return list(range(len(self.campaign.conditions)))

    def toggle(self, condition: str) -> None:
        """Select this condition alone; if it is alone already, select all."""
        alone = [self.campaign.conditions.index(condition)]
        self._conditions.active = self._every if self._conditions.active == alone else alone

    @property
    def conditions(self) -> list[str]:
        """Names of the selected conditions."""
        return [self.campaign.conditions[k] for k in sorted(self._conditions.active)]

    @property
    def shown(self) -> list[int]:
        """Indices of the trials of the selected conditions."""
        conditions = set(self.conditions)
        return [i for i, aligned in enumerate(self.campaign.trials) if aligned.condition in conditions]


# ------------------------------------------------------------------------------
# The controller of an open page.

# Chosen: text follows a slider at reading speed, because each change makes the browser lay out the page again
TEXT_MS = 150


class Page:
    """Controller of one document. `_on_background_change` and `_on_step` are called from other threads."""

    def __init__(self, background: BackgroundFit, document: Document) -> None:
        self.background, self.campaign, self.document = background, background.campaign, document
        self.choice: ModelChoice = background.initial
        self.shown: Prediction | None = None
        self.fits: list[Evaluated] = []
        self.held: tuple[Prediction, dict[str, str]] | None = None
        self.diagnosis: Diagnosis | None = None
        with suppress(ResultsError):
            self.diagnosis = read_diagnosis(Results(self.campaign.folder))
        self._sizes_changed = False
        self._pending: set[Callable[[], None]] = set()
        self._job: Job[Step, Evaluated] | None = None
        self._begun_s, self._message = 0.0, ""
        self._step: Step | None = None
        self._build()
        background.listeners.append(self._on_background_change)
        document.on_session_destroyed(lambda _context: self.close())
        document.add_periodic_callback(self._update_status, 200)  # Chosen: the status line shows tenths of a second
        self._background_changed()

    # ---- layout ----------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        campaign = self.campaign
        self.headline, self.status = bk.Div(name="headline"), bk.Div(name="status")
        self.numbers, self.verdict, self.next = bk.Div(name="numbers"), bk.Div(name="verdict"), bk.Div(name="next")
        self.selector = TrialSelector(campaign, self._selection_changed)
        self.plots = plots.Plots(campaign, self.selector.toggle)
        self.panel = EffectPanel(campaign, self.choice, suspects(self.diagnosis), self._ticked, self._size_moved)
        self.film = plots.FilmPanel(campaign, self.document, self.plots.set_instant)
        self.saved = bk.Div(name="saved")
        save = plots.beside(plots.button("Save the model to experiment.yaml", "save", self._save))
        self.refit = plots.button("Refit", "refit", self._refit_or_stop, margin=5, width=110, button_type="primary")
        back = plots.button("As fitted", "as_fitted", self._as_fitted, margin=5, width=96)
        self.hold = plots.button("Hold to compare", "hold", self._hold, margin=5, width=132)
        buttons = plots.beside(self.refit, back, self.hold, css=":host { gap: 6px; flex-wrap: wrap; }")
        actions = bk.Column(buttons, name="actions")
        texts = [self.headline, self.status, self.numbers, self.verdict, self.next]
        figures = [self.plots.motion, self.plots.residual, self.plots.errors]
        panels = [self.selector.root, self.panel.root, self.film.root]
        for root in (*texts, *figures, *panels, actions, bk.Column(save, self.saved, name="keep")):
            self.document.add_root(root)
        style, script = ((TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "screen.js"))
        shown = {"plots": figures, "film": self.film.figure}
        self.document.js_on_event("document_ready", bk.CustomJS(args=shown, code=script))
        self.document.title = f"{campaign.folder.name} – vinetrack explorer"
        self.document.theme = plots.theme()
        self.document.template = plots.templates().get_template("page.html")
        left_out = f", {len(campaign.left_out)} left out" if campaign.left_out else ""
        on_screen = {colour: f"var({token})" for colour, token in TOKENS.items()}
        styles = vine_styles(campaign.vines)
        sizes = {aligned.data.trial.vine: features(aligned.data.trial)[0] for aligned in campaign.trials}
        self.document.template_variables.update(
            name=campaign.folder.name,
            style=Markup(page_frame() + style),
            vines=[(sizes[vine], on_screen.get(colour.lower(), colour)) for vine, (colour, _) in styles.items()],
            tally=f"{len(campaign.trials)} trials, {len(campaign.conditions)} conditions{left_out}",
        )

    # ---- user input ------------------------------------------------------------------------------------------------

    def _ticked(self, effect: str, wanted: bool) -> None:
        if wanted == (effect in self.choice.effects):  # a tick that follows the choice
            return
        self.choice = self.choice.with_effect(effect, wanted)
        self._mark_changed()
        self._begin_refit()

    def _size_moved(self, effect: str, number: str, value: float) -> None:
        if math.isclose(value, self.choice.numbers[number]):  # a slider that follows the choice
            return
        self.choice = self.choice.with_effect(effect).with_sizes({number: value})
        self.panel.ticks[effect].active = True
        self._mark_changed()

    def _mark_changed(self) -> None:
        self._sizes_changed = True
        if self._job is not None:
            self._end_job("The fit was cancelled: the model has changed.")
        self._soon(self._redraw)

    def _selection_changed(self) -> None:
        self.plots.set_shown(self.selector.shown)
        self._draw()

    def _as_fitted(self) -> None:
        """Return to the last fit, or to the model with which the page opened."""
        self.choice = self.background.initial if self.last is None else self.last.choice
        self._sizes_changed = False
        self.panel.show(self.choice, {} if self.last is None else self.last.numbers)
        self._soon(self._redraw)

    def _hold(self) -> None:
        """Hold the current model for comparison; pressed again, compare with the model in use."""
        self.held = None if self.held is not None or self.shown is None else (self.shown, self._described(self.shown))
        self.hold.label = "Hold to compare" if self.held is None else "Release"
        self._draw()
        self._update_text()

    def _described(self, shown: Prediction) -> dict[str, str]:
        """Effects, error and fitted parameters of the model in words."""
        numbers = () if self._sizes_changed or self.last is None else self.last.fit.numbers
        words = {"effects": model_text(self.choice.effects), "rms of position": _in_mm(shown.rms_m)}
        return words | {number.title: quantity_text(number) for number in numbers}

    @property
    def last(self) -> Evaluated | None:
        """The last fit."""
        return self.fits[-1] if self.fits else None

    @property
    def _reference(self) -> Prediction | None:
        """Of the model for comparison: the one that is held, else the model in use."""
        return self.background.prediction if self.held is None else self.held[0]

    # ---- fits ----------------------------------------------------------------------------------------------------

    def _refit_or_stop(self) -> None:
        if self._job is not None:
            self._end_job("The fit was stopped.")
        else:
            self._begin_refit()

    def _begin_refit(self) -> None:
        self._begun_s, self._step, self._message = time.monotonic(), None, ""
        self.refit.label = "Stop"
        last, choice = self.last, self.choice

        def work(watch: Watch) -> Evaluated:
            return fit_choice(self.campaign, (last or self.background.wait()).fit, choice, watch)

        self._job = Job(work, self._on_step, self._fit_ended, self.document.add_next_tick_callback)
        self._update_status()

    def _on_background_change(self) -> None:
        """Called from the background thread."""
        self.document.add_next_tick_callback(self._background_changed)

    def _background_changed(self) -> None:
        background, fitted = self.background, self.background.fitted
        if self.shown is None and (first := background.prediction) is not None:
            self.shown = first
            self._selection_changed()
            self._update_text()
            worst = max(first.errors_m, key=lambda name: first.errors_m[name])
            self.film.show_trial(self.campaign.trials[self.campaign.indices_of_condition(worst)[0]].name)
        if not self.fits and fitted is not None:
            self.fits = [fitted]
            if self.choice is background.initial:
                self.choice = fitted.choice
                self.panel.show(self.choice, fitted.numbers)
            self._update_text()
        self._update_status()

    def _on_step(self, step: Step) -> None:
        """Called from a fit's thread; the status line shows it."""
        self._step = step

    def _fit_ended(self, fitted: Evaluated | None, reason: str) -> None:
        if fitted is not None:
            self.fits.append(fitted)
            self.choice, self.shown, self._sizes_changed = fitted.choice, fitted.prediction, False
            self.panel.show(self.choice, fitted.numbers)
            self._draw()
        self._end_job(reason)

    def _end_job(self, reason: str) -> None:
        if self._job is not None:
            self._job.cancel()
        self._job, self._message = None, reason
        self.refit.label = "Refit"
        self._update_status()
        self._soon(self._update_text, TEXT_MS)

    # ---- drawing -------------------------------------------------------------------------------------------------

    def _soon(self, work: Callable[[], None], delay_ms: int = 4) -> None:
        """Do it once after a delay, by default a quarter of a screen's frame, however often it is asked for."""
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
            self.shown = predict_choice(self.campaign, choice)
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
        if self._job is None:
            # The error at a step of a fit, or before a fit, says nothing about the effect.
            plots.set_text(self.headline, self._headline())
        compared = []
        if self.shown is not None:
            self.film.set_predictions(self.shown, self._reference)
            if self.held is not None:
                held, now = self.held[1], self._described(self.shown)
                compared = [(title, held.get(title, "–"), now.get(title, "–")) for title in held | now]
        plots.set_text(self.numbers, numbers_panel(self.fits, self._sizes_changed, compared))
        diagnosis, rows, advice = self.diagnosis, list[Row](), None
        if diagnosis is not None:
            rows = verdict_table(diagnosis)
            advice = next_experiment(diagnosis.next_experiment)
        command = shlex.join(["vinetrack", "diagnose", self.campaign.folder.as_posix()])
        plots.set_text(self.verdict, plots.panel("verdict", diagnosis=diagnosis, diagnose=command, rows=rows))
        plots.set_text(self.next, plots.panel("next", diagnosed=diagnosis is not None, diagnose=command, advice=advice))

    def _headline(self) -> str:
        """The error of the model now and as the page opened, beside that of an adequate model, as a heading."""
        campaign, shown, known, effects = self.campaign, self.shown, self.diagnosis, self.choice.effects
        errors_m, words = {} if shown is None else shown.errors_m, model_text(effects)
        highest_m = [campaign.highest_m.get(name, math.nan) for name in errors_m]
        now, before = ("" if one is None else _in_mm(one.rms_m) for one in (shown, self.background.prediction))
        return plots.panel(
            "headline",
            model=words[:1].upper() + words[1:],
            now=now,
            before=before,
            beyond=beyond_adequate(errors_m.values(), highest_m, bool(known and known.refutes(effects))),
            refused=campaign.stored.refused,
            named=model_text(campaign.experiment.settings.model),
            in_use=model_text(campaign.in_use),
            command=command_for_results(campaign.experiment.folder, campaign.folder),
        )

    def _update_status(self) -> None:
        """Update the status line."""
        background, text = self.background, ""
        told = () if self.last is None else self.last.fit.messages
        unfinished = next((str(message) for message in told if message.code == "not_converged"), "")
        if self._job is not None:
            # A fit starts from that of the model in use.
            waits = background.running
            task, step = ("fitting the model in use first", background.step) if waits else ("refitting", self._step)
            done, since_s = 0 if step is None else step.iteration, time.monotonic() - self._begun_s
            # 5: steps after which the bar is half full; how many there will be is not known (chosen)
            text = plots.progress_bar(done / (done + 5), f"{task} · step {done} · {since_s:.1f} s")
        elif failure := self._message or background.failure or unfinished:
            text = f'<span class="bad">{escape(failure)}</span>'
        elif background.running:
            fitting = "fitting the model in use, in the background"
            text = f"<small>{'preparing the model' if background.prediction is None else fitting} …</small>"
        plots.set_text(self.status, text)

    # ---- saving --------------------------------------------------------------------------------------------------

    def _save(self) -> None:
        folder, effects = self.campaign.experiment.folder, self.choice.effects
        try:
            path = save_model(folder, effects)
        except (ExperimentError, InputError, OSError) as error:
            lines = format_problems(error.problems) if isinstance(error, ExperimentError) else [str(error)]
            self.saved.text = f'<p class="bad">{escape("; ".join(lines))}</p>'
            return
        rerun = command_for_results(folder, self.campaign.folder)
        self.saved.text = plots.panel("saved", path=path.as_posix(), model=model_text(effects), rerun=rerun)

    def close(self) -> None:
        """The page was closed."""
        with suppress(ValueError):
            self.background.listeners.remove(self._on_background_change)
        self.film.close()
        if self._job is not None:
            self._job.cancel()


# ------------------------------------------------------------------------------
# Server of the page, on the loopback address only and without external resources.


def start_server(background: BackgroundFit, port: int | None = None) -> PageServer:
    """Return the server of the page, which answers once its loop runs."""

    def application(secret: str) -> BokehTornado:
        made = BokehTornado(
            lambda document: Page(background, document),
            prefix=secret,
            extra_websocket_origins=["*"],  # checked by the server, with all else
            use_index=False,
        )
        made.initialize(IOLoop.current())
        made.start()
        return made

    return PageServer(application, port)


def explore(
    folder: Path, experiment: Path | None, say: Callable[[str], None], port: int | None, *, browser: bool
) -> None:
    """Serve the page of a results folder until Ctrl-C (or SIGTERM)."""
    with waiting(f"opening {folder}"):
        background = BackgroundFit(open_campaign(folder, experiment))
    # A background fit would otherwise delay the page.
    sys.setswitchinterval(1e-3)  # Thread switch interval
    server = start_server(background, port)
    background.begin()
    server.run("Explorer", say, browser=browser)
