"""The controls of one page: the trials shown, the effects in the model with their sizes, and saving."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from bokeh.models import (
    Checkbox,
    CheckboxButtonGroup,
    Column,
    ColumnDataSource,
    CustomJS,
    Div,
    PrintfTickFormatter,
    Slider,
    Toggle,
    UIElement,
)

from vinetrack.core.problems import ExperimentError, UserError, format_problems
from vinetrack.core.tables import TableError
from vinetrack.diagnosis.result import UNEXPLAINED
from vinetrack.effects import BASE_EFFECTS, Effect, load_effect
from vinetrack.experiment.folder import save_model
from vinetrack.pages.campaign import (
    BackgroundFit,
    Campaign,
    FitJob,
    FitProgress,
    Fitted,
    ModelChoice,
    SizeControl,
    choice_in_use,
    commands,
    model_text,
    read_campaign,
    sizes_of,
    slider_range,
)
from vinetrack.pages.plots import (
    button,
    command_block,
    escaped,
    html_div,
    progress_bar,
    side_by_side,
    stacked,
    stylesheet,
)
from vinetrack.pipeline.effects_stage import WrittenProposal, propose_effect

if TYPE_CHECKING:
    from vinetrack.pages.page import Page


HEADING = """
:host { margin-top: .5rem; }
.bk-btn { text-align: left; border: 0 !important; border-bottom: 1px solid var(--grid) !important; border-radius: 0; }
.bk-btn { background: none !important; box-shadow: none !important; font-weight: 650; padding: .3rem 0; width: 100%; }
.bk-btn, .bk-btn.bk-active { color: var(--ink) !important; }
.bk-btn::before { content: "▸ "; color: var(--muted); } .bk-btn.bk-active::before { content: "▾ "; }
"""
TICK = """
:host { font-weight: 600; }
input { accent-color: var(--accent); width: 1rem; height: 1rem; margin-right: .4rem; }
"""


class EffectRow:
    """Controls of one effect: tick box, sliders, formula and fitted values."""

    def __init__(self, campaign: Campaign, effect: Effect, choice: ModelChoice) -> None:
        self.effect, self.sizes = effect, sizes_of(campaign, effect, choice.numbers)
        unusable = campaign.unusable.get(effect.name, "")
        self.tick = Checkbox(
            label=effect.name.replace("_", " "),
            active=effect.name in choice,
            disabled=bool(unusable) or effect.name in BASE_EFFECTS,  # all others are added to these
            name=f"tick_{effect.name}",
            stylesheets=[stylesheet(TICK)],
            margin=(6, 0, 0, 0),
        )
        self.sliders = [_slider(size, choice, bool(unusable)) for size in self.sizes]
        self.fitted_texts = [html_div(visible=False, name=f"found_{size.name}") for size in self.sizes]
        about = f"<small>{escaped(unusable or effect.formula)}</small>"
        pairs = [part for pair in zip(self.sliders, self.fitted_texts, strict=True) for part in pair]
        self.root = stacked(self.tick, html_div(about), *pairs, margin=(0, 0, 4, 0))

    def value(self, k: int) -> float:
        """Return the value of a slider in SI units."""
        return float(self.sliders[k].value) / self.sizes[k].shown[1]


def _slider(size: SizeControl, choice: ModelChoice, disabled: bool) -> Slider:
    unit, factor = size.shown
    low, high = factor * size.low, factor * size.high
    what = size.vine or size.parameter.meaning
    return Slider(
        start=low,
        end=high,
        value=factor * choice.numbers.get(size.name, size.parameter.default),
        step=_step(low, high),
        title=f"{size.parameter.symbol}, {what}" if what else size.parameter.symbol,
        format=PrintfTickFormatter(format=f"%.4g {unit}".rstrip()),
        sizing_mode="stretch_width",
        disabled=disabled,
        name=f"size_{size.name}",
        stylesheets=[stylesheet(":host { padding: 0 10px 0 4px; }")],
        margin=(2, 0, 6, 0),
    )


def _step(low: float, high: float) -> float:
    # 400: steps of a slider; chosen: about one per pixel
    return (high - low) / 400 or 1.0


def _opens(inside: UIElement, title: str, css: str, **keywords: Any) -> Toggle:
    """A toggle that shows and hides what is inside."""
    head = Toggle(label=title, active=inside.visible, stylesheets=[stylesheet(css)], margin=0, **keywords)
    head.js_on_change("active", CustomJS(args={"inside": inside}, code="inside.visible = cb_obj.active"))
    return head


class EffectPanel:
    """All effects in groups; calls `ticked(effect, wanted)` and `moved(effect, parameter, value)` on user input."""

    def __init__(
        self,
        campaign: Campaign,
        choice: ModelChoice,
        suspects: Sequence[str],
        ticked: Callable[[str, bool], None],
        moved: Callable[[str, str, float], None],
    ) -> None:
        self.campaign, self._ticked, self._moved = campaign, ticked, moved
        self._updating = False
        self.rows = {name: EffectRow(campaign, effect, choice) for name, effect in campaign.effects.items()}
        for name, row in self.rows.items():
            row.tick.on_change("active", partial(self._on_tick, name))
            for k, slider in enumerate(row.sliders):
                slider.on_change("value", partial(self._on_size, name, k))
        self.root = stacked(*self._groups(choice, suspects), name="effects")

    def _groups(self, choice: ModelChoice, suspects: Sequence[str]) -> list[Column]:
        in_use = [name for name in self.rows if name in choice]
        likely = [name for name in suspects if name in self.rows and name not in in_use][:6]
        others = [name for name in self.rows if name not in in_use and name not in likely]
        kinds = {name: self.campaign.effects[name].kind for name in others}
        groups = [
            ("Suspected by the diagnosis", likely, True),
            ("Physical effects", [name for name in others if kinds[name] != "measurement"], not likely),
            ("Measurement effects", [name for name in others if kinds[name] == "measurement"], False),
            ("In the model in use", in_use, True),
        ]
        return [self._group(title, names, shown) for title, names, shown in groups if names]

    def _group(self, title: str, names: Sequence[str], shown: bool) -> Column:
        inside = stacked(*(self.rows[name].root for name in names), visible=shown)
        return stacked(_opens(inside, title, HEADING, sizing_mode="stretch_width"), inside)

    def _on_tick(self, name: str, _attr: str, _old: bool, new: bool) -> None:
        if not self._updating:
            self._ticked(name, new)

    def _on_size(self, name: str, k: int, _attr: str, _old: float, _new: float) -> None:
        if not self._updating:
            row = self.rows[name]
            self._moved(name, row.sizes[k].name, row.value(k))

    def show(self, choice: ModelChoice, fitted: Fitted | None = None, *, sliders: bool = True) -> None:
        """Set tick boxes and, optionally, sliders to a choice; show the fitted value at each slider."""
        self._updating = True
        try:
            for name, row in self.rows.items():
                if row.tick.active != (name in choice):
                    row.tick.active = name in choice
                for k, size in enumerate(row.sizes):
                    if sliders:
                        _set_slider(row.sliders[k], size, choice.numbers.get(size.name, size.parameter.default))
                    _show_fitted_value(row.fitted_texts[k], size, fitted if name in choice else None)
        finally:
            self._updating = False


def _set_slider(slider: Slider, size: SizeControl, value: float) -> None:
    low, high = slider_range(size.key, size.parameter, value)
    low, high = (bound * size.shown[1] for bound in (min(low, size.low), max(high, size.high)))
    shown = value * size.shown[1]
    if (slider.start, slider.end) != (low, high):
        slider.update(start=low, end=high, step=_step(low, high))
    if slider.value != shown:
        slider.value = shown


def _show_fitted_value(div: Div, size: SizeControl, fitted: Fitted | None) -> None:
    number = None if fitted is None else fitted.number(size.name)
    if number is None:
        div.visible = False
        return
    unit, factor = size.shown
    low, high, value = (factor * x for x in (number.low, number.high, number.value))
    if math.isfinite(number.bound):
        text = f"<small>fitted: <b>{factor * number.bound:.4g}</b> {escaped(unit)}, at its bound</small>"
    else:
        error = f" ± {factor * number.sigma:.2g}" if math.isfinite(number.sigma) else ""
        ends = f" (its {number.ends_at} bound)" if number.ends_at else ""
        text = f"<small>fitted: <b>{value:.4g}{error}</b> {escaped(unit)} · 95 %: {low:.4g} to {high:.4g}{ends}</small>"
    div.update(text=text, visible=True)


CHIPS = """
:host { max-height: 10.5rem; overflow-y: auto; }
.bk-btn-group { display: flex; flex-wrap: wrap; gap: 4px; }
.bk-btn-group > .bk-btn { flex: 0 1 auto; border-radius: 999px !important; margin: 0 !important; padding: 3px 10px; }
.bk-btn-group > .bk-btn { border: 1px solid var(--grid); background: var(--card); color: var(--muted); }
.bk-btn-group > .bk-btn.bk-active { background: var(--chosen); border-color: var(--accent); color: var(--ink); }
.bk-btn-group > .bk-btn.bk-active { box-shadow: none; }
"""


class TrialSelector:
    """Buttons to select conditions and trials; calls `on_change` when the selection changes."""

    def __init__(self, campaign: Campaign, on_change: Callable[[], None]) -> None:
        small = ".bk-btn { font-size: 12px; padding: 2px 9px; }"
        self.campaign, self._on_change = campaign, on_change
        self._conditions = self._chips([campaign.labels[name] for name in campaign.conditions], "conditions")
        self._trials = self._chips([aligned.name for aligned in campaign.trials], "trials", small, visible=False)
        tools = side_by_side(
            button("all", "choose_all", self._all, css=small),
            button("none", "choose_none", self._none, css=small),
            _opens(self._trials, "single trials …", small, name="single_trials"),
            css=":host { gap: 4px; }",
        )
        self.root = stacked(self._conditions, tools, self._trials, name="choose")

    def _chips(self, labels: list[str], name: str, css: str = "", **keywords: Any) -> CheckboxButtonGroup:
        """Buttons that are all chosen at first."""
        margin = (4, 0, 0, 0) if css else (0, 0, 4, 0)
        look: dict[str, Any] = {"stylesheets": [stylesheet(CHIPS + css)], "margin": margin, **keywords}
        chips = CheckboxButtonGroup(labels=labels, active=list(range(len(labels))), name=name, **look)
        chips.on_change("active", lambda _attr, _old, _new: self._on_change())
        return chips

    def _all(self) -> None:
        self._trials.active = list(range(len(self.campaign.trials)))
        self._conditions.active = list(range(len(self.campaign.conditions)))

    def _none(self) -> None:
        self._conditions.active = []

    def toggle(self, condition: str) -> None:
        """Select this condition alone; if it is alone already, select all."""
        index = self.campaign.conditions.index(condition)
        is_alone = self._conditions.active == [index]
        self._conditions.active = list(range(len(self.campaign.conditions))) if is_alone else [index]

    @property
    def conditions(self) -> list[str]:
        """Names of the selected conditions."""
        return [self.campaign.conditions[k] for k in sorted(self._conditions.active)]

    @property
    def shown(self) -> list[int]:
        """Indices of the trials to draw: those selected, of the selected conditions."""
        conditions = set(self.conditions)
        return [i for i in sorted(self._trials.active) if self.campaign.trials[i].condition in conditions]


class SavePanel:
    """Button of one page to save the model."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self.message = html_div(name="saved")
        save = button("Save the model to experiment.yaml", "save", self._save)
        self.root = stacked(side_by_side(save), self.message, name="keep")

    def _save(self) -> None:
        page = self._page
        folder = page.campaign.experiment.folder
        try:
            path = save_model(folder, page.choice.effects, page.campaign.own_files(page.choice.effects))
        except (ExperimentError, TableError, OSError) as error:
            lines = format_problems(error.problems) if isinstance(error, ExperimentError) else [str(error)]
            self.message.text = f'<p class="bad">{escaped("; ".join(lines))}</p>'
            return
        rerun = f"snakemake --cores 2 --config experiment={folder.as_posix()}"
        lines = self._lines(save=True)
        same = f" The same as a command:</p>{command_block(lines)}<p>" if lines else " "
        self.message.text = (
            f'<p><span class="good">Saved.</span> {escaped(path.as_posix())} now has the'
            f" {escaped(model_text(page.choice.effects))}.{same}"
            f"For new tables and a new report:</p>{command_block([rerun])}"
        )

    def _lines(self, *, save: bool = False) -> list[str]:
        page = self._page
        return commands(page.campaign, page.choice, fitted=page.is_fitted(), save=save)

    def commands(self) -> str:
        """The commands that reproduce the state of the page, as HTML."""
        lines = self._lines()
        return "<small>The same from the command line:</small>" + command_block(lines) if lines else ""


# ------------------------------------------------------------------------------
# If no known effect explains the misfit: a button that proposes an effect, and one that opens the page with it.

Reopen = Callable[[BackgroundFit], None]  # Makes pages opened from now on show another campaign

PROPOSE = "Propose an effect"
INTRODUCTION = (
    "No effect of the catalogue explains these trials. The missing force can be learned from them and written"
    " as an effect file of your own, beside the experiment. It takes minutes."
)


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
        # Time in which the progress bar of a search is two thirds full (chosen)
        self._task, self._progress = "", FitProgress(150.0)
        self._outcome: ReadProposal | None = None
        self.button = button(PROPOSE, "propose", self._propose_or_stop, width=150)
        self.open = button("Open the page with it", "open_proposed", self._open, width=170, visible=False)
        self.text = html_div(name="proposal")
        self._reload = ColumnDataSource({"times": [0]}, name="reload")
        self._reload.js_on_change("data", CustomJS(code="location.reload()"))
        buttons = side_by_side(self.button, self.open)
        self.root = stacked(self.text, buttons, name="propose_panel", tags=[self._reload])
        self.show()

    def show(self) -> None:
        """Update after a change of the diagnosis, and as time passes."""
        diagnosis = self._page.diagnosis
        unexplained = diagnosis is not None and UNEXPLAINED in (diagnosis.verdict, diagnosis.final_verdict)
        self.root.visible = self._job is not None or self._outcome is not None or unexplained
        if self._job is not None:
            self._say(progress_bar(*self._progress.state(time.monotonic(), self._task)))
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
        self._task, self.button.label = "reading the results", "Stop"
        self._progress.begin(time.monotonic())
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
