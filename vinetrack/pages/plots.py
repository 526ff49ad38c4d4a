"""Figures and texts that follow the choice of model: positions, residuals, errors, the fit, tied candidates."""

from __future__ import annotations

import html
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.models import (
    Button,
    CategoricalColorMapper,
    Column,
    ColumnDataSource,
    CustomJSTickFormatter,
    Div,
    HoverTool,
    InlineStyleSheet,
    Range1d,
    Row,
    Span,
    TapTool,
    UIElement,
)
from bokeh.plotting import figure
from jinja2 import Environment, FileSystemLoader

from vinetrack.core.records import Floats
from vinetrack.core.units import SLIDER_UNITS, decimals, display_unit
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.figures.diagnosis_figures import TIED_COSINE
from vinetrack.figures.style import GRID, INK, MUTED, VINE_COLOURS, vine_styles
from vinetrack.inference.fit_result import Number
from vinetrack.narrative.verdict_text import quantity_text, spaced_name
from vinetrack.pages.campaign import (
    Campaign,
    ExplorerTrial,
    Fitted,
    ModelChoice,
    Prediction,
    condition_labels,
    correlated_pairs_text,
    drawn_rows,
    likelihood_change_text,
    model_text,
    overall_m,
)

# ------------------------------------------------------------------------------
# Style shared with the report: colours, fonts, and the pieces of HTML of the page.

TEMPLATES = Path(__file__).with_name("templates")
SANS = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'

_AXIS = {
    "axis_label_text_font": SANS,
    "axis_label_text_font_size": "13px",
    "axis_label_text_font_style": "normal",
    "axis_label_text_color": INK,
    "axis_line_color": INK,
    "major_label_text_font": SANS,
    "major_label_text_font_size": "12px",
    "major_label_text_color": INK,
    "major_tick_line_color": INK,
    "minor_tick_line_color": None,
    "axis_label_standoff": 6,
}
THEME: dict[str, Any] = {
    "attrs": {
        "Plot": {"background_fill_color": None, "border_fill_color": None, "outline_line_color": None},
        "Axis": _AXIS,
        "Grid": {"grid_line_color": GRID, "grid_line_width": 0.8},
    }
}


def vine_colour() -> dict[str, Any]:
    """Return the colour of glyphs with a column `colour`: a palette, so that a page can change it."""
    colours = list(VINE_COLOURS)
    return {"field": "colour", "transform": CategoricalColorMapper(factors=colours, palette=colours)}


def stylesheet(more: str = "") -> InlineStyleSheet:
    """Return CSS inside a widget, which the CSS of the page does not reach."""
    return InlineStyleSheet(css=(TEMPLATES / "widgets.css").read_text(encoding="utf-8") + more)


def html_div(text: str = "", name: str | None = None, **keywords: Any) -> Div:
    """Return a piece of HTML as a widget."""
    return Div(text=text, name=name, sizing_mode="stretch_width", stylesheets=[stylesheet()], margin=0, **keywords)


def set_text(piece: Div, text: str) -> None:
    """Change a piece of HTML only if it differs, because whatever is sent is drawn again."""
    if piece.text != text:
        piece.text = text


def button(
    label: str, name: str, does: Callable[[], None], *, css: str = "", margin: int = 0, **options: Any
) -> Button:
    """Return a button that calls `does` when it is clicked."""
    made = Button(label=label, name=name, stylesheets=[stylesheet(css)], margin=margin, **options)
    made.on_click(does)
    return made


def stacked(*parts: UIElement, margin: Any = 0, **keywords: Any) -> Column:
    """Return parts below each other, as wide as their card."""
    return Column(children=list(parts), sizing_mode="stretch_width", margin=margin, **keywords)


def side_by_side(*parts: UIElement, css: str = ":host { gap: 6px; }", **keywords: Any) -> Row:
    """Return parts beside each other."""
    return Row(children=list(parts), margin=0, stylesheets=[stylesheet(css)], **keywords)


def plot(height: int, x_label: str, y_label: str, **keywords: Any) -> figure:
    """Return an empty figure as wide as its card."""
    fig = figure(
        height=height,
        sizing_mode="stretch_width",
        tools="box_zoom,pan,reset",
        active_drag=None,
        active_scroll=None,
        toolbar_location="above",
        x_axis_label=x_label,
        y_axis_label=y_label,
        min_border_right=14,
        margin=0,
        **keywords,
    )
    fig.toolbar.autohide = True
    fig.toolbar_inner = True
    fig.toolbar.logo = None
    return fig


def escaped(text: object) -> str:
    """Return text escaped for HTML."""
    return html.escape(str(text))


@cache
def templates() -> Environment:
    """The templates of the page."""
    return Environment(loader=FileSystemLoader(TEMPLATES, encoding="utf-8"), autoescape=True)


def panel(name: str, **given: Any) -> str:
    """Return a piece of HTML that `panels.html` makes of what is given."""
    return str(getattr(templates().get_template("panels.html").module, name)(**given))


def progress_bar(share: float, text: str) -> str:
    """Return a bar filled to a fraction, with text below it."""
    percent = 100 * min(max(share, 0.02), 1.0)
    return f'<div class="bar"><i style="width:{percent:.0f}%"></i></div><small>{escaped(text)}</small>'


def command_block(lines: Sequence[str]) -> str:
    """Return commands to copy, as HTML."""
    return panel("commands", lines=lines)


# ------------------------------------------------------------------------------
# Figures and their data, as plain columns in milliseconds and millimetres.

Columns = dict[str, list[Any]]
Errors = Mapping[str, float]


def vine_colours(campaign: Campaign) -> list[tuple[str, str]]:
    """Return a distinguishing label and the colour of each vine."""
    styles = vine_styles(campaign.vines)
    first = {aligned.data.trial.vine: aligned.data.trial for aligned in reversed(campaign.trials)}
    bare = {vine: replace(trial, pressure_Pa=math.nan, payload_kg=0.0) for vine, trial in first.items()}
    labels = condition_labels(bare) if len(bare) > 1 else dict.fromkeys(bare, "measured")
    return [(labels[vine], styles[vine].colour) for vine in campaign.vines]


def axis_range(lines: Sequence[Floats]) -> dict[str, float]:
    """Return the ends of an axis that holds lines with a margin."""
    if not lines:
        return {"start": 0.0, "end": 1.0}
    low, high = (float(of(np.concatenate(lines))) for of in (np.nanmin, np.nanmax))
    margin = 0.05 * ((high - low) or 1.0)
    return {"start": low - margin, "end": high + margin}


def round_up(value: float, steps: Sequence[float]) -> float:
    """Return the next of these steps times a power of ten, so that an axis rarely changes; 1 for nothing."""
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(round(power * step, 12) for step in steps if power * step >= value or step == steps[-1])


@dataclass(frozen=True)
class HeldModel:
    """A model for comparison: its effects, what it predicts, and its fit, if it was fitted."""

    effects: tuple[str, ...]
    prediction: Prediction | None
    fitted: Fitted | None

    @property
    def errors_m(self) -> Mapping[str, float]:
        """Errors by condition, m."""
        return {} if self.prediction is None else self.prediction.errors_m


class Plots:
    """Figures and their data sources, updated by `set_shown`, `draw` and `set_instant`."""

    def __init__(self, campaign: Campaign, on_condition_click: Callable[[str], None]) -> None:
        self.campaign, self._on_condition_click = campaign, on_condition_click
        styles = vine_styles(campaign.vines)
        # The colour of each condition is that of its vine, as in every figure.
        self._colour = {aligned.condition: styles[aligned.data.trial.vine].colour for aligned in campaign.trials}
        self._trials_drawn: tuple[int, ...] | None = None
        self._other_drawn: Prediction | None = None
        self._band = ColumnDataSource(self._replicate_bands(()))
        self._measured = ColumnDataSource(self._lines(()))
        self._reference = ColumnDataSource({"xs": [], "ys": []})
        self._model = ColumnDataSource({"xs": [], "ys": []}, name="model_curves")
        self._residuals = ColumnDataSource(self._lines(()), name="residual_curves")
        self._bars = ColumnDataSource(self._error_bars({}, {}, {}, ()), name="error_bars")
        self.motion, self.residual = self._draw_motion(), self._draw_residual()
        self.errors = self._draw_errors()

    def _draw_motion(self) -> Any:
        fig = plot(360, "since release (ms)", "growth (mm)", name="motion", x_range=Range1d(), y_range=Range1d())
        fig.patches("xs", "ys", source=self._band, fill_color=vine_colour(), fill_alpha=0.2, line_color=None)
        lines = fig.multi_line(
            "xs", "ys", source=self._measured, line_color=vine_colour(), line_width=1.6, line_alpha=0.9
        )
        ghost = {"line_color": MUTED, "line_width": 1.5, "line_dash": [2, 3]}
        fig.multi_line("xs", "ys", source=self._reference, **ghost)
        model = fig.multi_line("xs", "ys", source=self._model, line_color=INK, line_width=2, line_dash=[7, 4])
        values = [("since release", "$x{0.0} ms"), ("growth", "$y{0.0} mm")]
        tips = [("trial", "@trial"), ("", "@condition"), *values]
        fig.add_tools(
            HoverTool(renderers=[lines], tooltips=tips, line_policy="interp"),
            HoverTool(renderers=[model], tooltips=[("", "model"), *values], line_policy="interp"),
        )
        self.instant = Span(dimension="height", line_color=INK, line_width=1, line_alpha=0.5, visible=False)
        fig.add_layout(self.instant)
        return fig

    def _draw_residual(self) -> Any:
        fig = plot(
            230, "growth (mm)", "measured − model (mm)", name="residual", x_range=Range1d(), y_range=Range1d(-1, 1)
        )
        fig.add_layout(Span(location=0, dimension="width", line_color=INK, line_width=1.5, line_dash=[7, 4]))
        lines = fig.multi_line("xs", "ys", source=self._residuals, line_color=vine_colour(), line_width=1.4)
        values = [("growth", "$x{0.0} mm"), ("measured − model", "$y{0.00} mm")]
        tips = [("trial", "@trial"), ("", "@condition"), *values]
        fig.add_tools(HoverTool(renderers=[lines], tooltips=tips, line_policy="interp"))
        return fig

    def _draw_errors(self) -> Any:
        names = list(reversed(self.campaign.conditions))
        # Height of a bar of the errors; chosen: a label of 12 pixels and a gap of equal height
        height = 70 + 25 * max(len(names), 2)
        fig = plot(height, "rms error of position (mm)", "", name="errors", y_range=names, x_range=Range1d(0, 1))
        common = {"y": "condition", "source": self._bars}
        fig.hbar(
            right="before", height=0.8, fill_color=GRID, fill_alpha=0.65, line_color=MUTED, line_alpha=0.5, **common
        )
        bars = fig.hbar(
            right="now", height=0.44, fill_color=vine_colour(), line_color=None, fill_alpha="alpha", **common
        )
        floors = fig.scatter(
            x="floor", marker="dash", angle=math.pi / 2, size=17, line_color=INK, line_width=2.6, **common
        )
        for drawn in (bars, floors, fig.renderers[0]):
            drawn.nonselection_glyph = drawn.selection_glyph = None
        tips = [
            ("", "@label"),
            ("now", "@now{0.000} mm"),
            ("for comparison", "@before{0.000} mm"),
            ("replicates", "@floor{0.000} mm"),
        ]
        fig.add_tools(HoverTool(renderers=[bars], tooltips=tips), TapTool(renderers=[bars, fig.renderers[0]]))
        self._bars.selected.on_change("indices", self._tapped)
        labels = [self.campaign.labels[name] for name in names]
        fig.yaxis.formatter = CustomJSTickFormatter(
            args={"names": names, "labels": labels}, code="return labels[names.indexOf(tick)] ?? tick"
        )
        fig.ygrid.visible = False
        # Toolbar buttons would cover the first bar; tapping needs none.
        fig.toolbar_location = None
        fig.yaxis.major_tick_line_color = None
        return fig

    def _tapped(self, _attr: str, _old: list[int], new: list[int]) -> None:
        if not new:
            return
        names = list(reversed(self.campaign.conditions))
        self._bars.selected.indices = []
        self._on_condition_click(names[new[0]])

    def _lines(self, lines: Iterable[tuple[ExplorerTrial, Floats, Floats]]) -> Columns:
        """One line per trial, from its abscissae and ordinates in SI, scaled by 1000; none is drawn across frames that
        were left out.
        """
        columns: Columns = {"xs": [], "ys": [], "colour": [], "trial": [], "condition": []}
        for aligned, x, y in lines:
            gaps = np.diff(np.cumsum(aligned.data.first)[aligned.rows], prepend=0) > 0
            gaps[0] = False
            columns["xs"].append(1e3 * x[aligned.rows])
            columns["ys"].append(np.where(gaps, math.nan, 1e3 * y[aligned.rows]))
            columns["colour"].append(self._colour[aligned.condition])
            columns["trial"].append(aligned.name)
            columns["condition"].append(self.campaign.labels[aligned.condition])
        return columns

    def _replicate_bands(self, conditions: Sequence[str]) -> Columns:
        """Outlines of one standard deviation of the replicates around their mean, ms and mm."""
        columns: Columns = {"xs": [], "ys": [], "colour": []}
        for condition in conditions:
            band = self.campaign.bands.get(condition)
            if band is None or band.shape[1] < 2:
                continue
            rows = drawn_rows(band.shape[1], int(np.searchsorted(band[0], 0.0)))
            time_ms, mean_mm, sigma_mm = 1e3 * band[:, rows]
            columns["xs"].append(np.concatenate([time_ms, time_ms[::-1]]))
            columns["ys"].append(np.concatenate([mean_mm - sigma_mm, (mean_mm + sigma_mm)[::-1]]))
            columns["colour"].append(self._colour[condition])
        return columns

    def _model_lines(self, prediction: Prediction, shown: Sequence[int]) -> Columns:
        """One line per condition, of its longest trial that is shown: `xs` ms since release, `ys` mm of growth."""
        trials = self.campaign.trials
        longest: dict[str, int] = {}
        for i in sorted(shown, key=lambda i: trials[i].time_s[-1], reverse=True):
            longest.setdefault(trials[i].condition, i)
        conditions = [name for name in self.campaign.conditions if name in longest]
        drawn = [(trials[longest[name]], prediction.trials[longest[name]]) for name in conditions]
        return {
            "xs": [1e3 * trial.time_s[trial.rows] for trial, _ in drawn],
            "ys": [1e3 * (model.predicted_position_m - trial.origin_m)[trial.rows] for trial, model in drawn],
        }

    def _error_bars(
        self, now_m: Errors, before_m: Errors, floors_m: Errors, conditions: Sequence[str]
    ) -> dict[str, list[Any]]:
        """One row per condition, the first at the bottom, mm; those not in `conditions` are faint."""
        names = list(reversed(self.campaign.conditions))
        errors = {"now": now_m, "before": before_m, "floor": floors_m}
        return {
            "condition": names,
            "label": [self.campaign.labels[name] for name in names],
            **{key: [1e3 * of_condition.get(name, math.nan) for name in names] for key, of_condition in errors.items()},
            "colour": [self._colour[name] for name in names],
            "alpha": [0.95 if name in conditions else 0.3 for name in names],
        }

    def set_shown(self, shown: Sequence[int]) -> None:
        """Select the trials to draw."""
        trials = [self.campaign.trials[i] for i in shown]
        lines = self._lines((aligned, aligned.time_s, aligned.growth_m) for aligned in trials)
        self.motion.x_range.update(**axis_range(lines["xs"]))
        self.motion.y_range.update(**axis_range(lines["ys"]))
        self.residual.x_range.update(**axis_range(lines["ys"]))
        self._measured.data = lines
        conditions = [name for name in self.campaign.conditions if name in {one.condition for one in trials}]
        # Chosen: bands of more than four conditions overlap and hide the curves
        self._band.data = self._replicate_bands(conditions if len(conditions) <= 4 else [])

    def set_instant(self, since_s: float | None) -> None:
        """Mark a time since release, or none."""
        self.instant.update(visible=since_s is not None, location=1e3 * (since_s or 0.0))

    def draw(self, now: Prediction, reference: HeldModel, shown: Sequence[int], conditions: Sequence[str]) -> None:
        """Draw the current model, and the one for comparison where it is another; errors of conditions that are not
        selected are faint. Only what has changed is sent: for lines already drawn their ordinates.
        """
        trials = self.campaign.trials
        lines = self._model_lines(now, shown)
        residual = self._lines((trials[i], trials[i].growth_m, now.trials[i].residual_m) for i in shown)
        largest_mm = max((float(np.nanmax(np.abs(part))) for part in residual["ys"]), default=0.0)
        reach = round_up(1.05 * max(largest_mm, 0.1), (1.2, 2, 3, 5, 7, 10))
        if reach != self.residual.y_range.end:
            self.residual.y_range.update(start=-reach, end=reach)
        same_trials = tuple(shown) == self._trials_drawn
        if same_trials:
            self._model.data["ys"] = lines["ys"]
            self._residuals.data["ys"] = residual["ys"]
        else:
            self._model.data, self._residuals.data = lines, residual
        other = None if reference.prediction is now else reference.prediction
        if not same_trials or other is not self._other_drawn:
            self._reference.data = {"xs": [], "ys": []} if other is None else self._model_lines(other, shown)
        self._trials_drawn, self._other_drawn = tuple(shown), other
        rows = self._error_bars(now.errors_m, reference.errors_m, now.floors_m, conditions)
        known = [value for key in ("now", "before", "floor") for value in rows[key] if math.isfinite(value)]
        end = round_up(1.04 * max(known, default=1.0), (1, 1.5, 2, 3, 4, 5, 6, 8, 10))
        if end != self.errors.x_range.end:
            self.errors.x_range.end = end
        for key, values in rows.items():
            if values != self._bars.data[key]:
                self._bars.data[key] = values


# ------------------------------------------------------------------------------
# Numbers and words of the text panels, which `panels.html` lays out.


def headline(
    campaign: Campaign, choice: ModelChoice, prediction: Prediction | None, opened_with: Prediction | None
) -> str:
    """Return the error of the model now and as the page opened, with the replicate scatter, as a heading."""
    now, before = (
        overall_m({} if one is None else one.errors_m, campaign.conditions) for one in (prediction, opened_with)
    )
    floor = overall_m(campaign.floors_m if prediction is None else prediction.floors_m, campaign.conditions)
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
    compared = [] if held is None else _compared(campaign, (held, now))
    if not fits:
        return panel("numbers", compared=compared)
    seconds, fit = fits[-1].seconds, fits[-1].fit
    vines = dict(zip(campaign.vines, (label for label, _ in vine_colours(campaign)), strict=True))
    known = vines if len(vines) > 1 else {}
    spreads = "; ".join(
        f"{name} {100 * s.value:.2g} %{'' if s.estimated else ' (fixed)'}" for name, s in fit.spreads.items()
    )
    facts = (
        f"noise {1e3 * fit.noise_m:.2g} mm",
        f"χ² per degree of freedom {fit.chi2_per_dof:.3g}" if math.isfinite(fit.chi2_per_dof) else "",
        f"between-trial standard deviations: {spreads}" if spreads else "",
        f"{seconds:.2g} s",
    )
    floor = overall_m(campaign.floors_m, campaign.conditions)
    ladder = []
    for fitted in fits:
        rms = overall_m(fitted.prediction.errors_m, campaign.conditions)
        beyond = math.sqrt(max(rms**2 - floor**2, 0.0)) if math.isfinite(floor) else math.nan
        ladder.append((model_text(fitted.choice.effects), _in_mm(rms), _in_mm(beyond) or "–"))
    return panel(
        "numbers",
        compared=compared,
        rows=[_number_row(number, known.get(number.vine, number.vine) or "all") for number in fit.numbers],
        sizes_changed=sizes_changed,
        facts=facts,
        messages=fit.messages,
        ladder=ladder,
        gained=likelihood_change_text(fits[-2].fit, fit) if len(fits) > 1 else "",
    )


def _compared(campaign: Campaign, models: Sequence[HeldModel]) -> list[tuple[str, ...]]:
    """Error and every fitted parameter of either of two models."""
    rows = [
        ("effects", *(model_text(model.effects) for model in models)),
        ("rms of position", *(_in_mm(overall_m(model.errors_m, campaign.conditions)) for model in models)),
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
    return [spaced_name(name) for name in names], [[_cosine_cell(cosines[i][k]) for k in place] for i in place]


def _cosine_cell(cosine: float) -> tuple[str, str]:
    """A cosine and its style: blue if it is positive, vermillion if negative, the deeper the larger."""
    if not math.isfinite(cosine):
        return "–", ""
    strength = min(abs(cosine), 1.0) ** 2
    colour = f"rgba({'0,114,178' if cosine > 0 else '213,94,0'},{strength:.2f})"
    return f"{cosine:+.2f}", f"background:{colour};color:{'#fff' if strength > 0.6 else 'inherit'}"


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
