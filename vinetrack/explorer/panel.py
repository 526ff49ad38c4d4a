"""The effects: a tick for each, a slider for each of its numbers, and what a fit found beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from bokeh.models import Checkbox, Column, CustomJS, Div, PrintfTickFormatter, Slider, Toggle

from vinetrack.effects import Effect
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import Choice, Size, can_leave, sizes_of, slider_range
from vinetrack.explorer.fitting import Fitted
from vinetrack.explorer.look import escaped, sheet, words

STEPS = 400
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


class Row:
    """One effect: its tick, its sliders, and words."""

    def __init__(self, campaign: Campaign, effect: Effect, choice: Choice) -> None:
        self.effect, self.sizes = effect, sizes_of(campaign, effect, choice.numbers)
        unusable = campaign.unusable.get(effect.name, "")
        self.tick = Checkbox(
            label=effect.name.replace("_", " "),
            active=effect.name in choice,
            disabled=bool(unusable) or not can_leave(effect.name),
            name=f"tick_{effect.name}",
            stylesheets=[sheet(TICK)],
            margin=(6, 0, 0, 0),
        )
        self.sliders = [_slider(size, choice, bool(unusable)) for size in self.sizes]
        self.found = [words(visible=False, name=f"found_{size.name}") for size in self.sizes]
        about = f"<small>{escaped(unusable or effect.formula)}</small>"
        pairs = [part for pair in zip(self.sliders, self.found, strict=True) for part in pair]
        self.root = Column(children=[self.tick, words(about), *pairs], sizing_mode="stretch_width", margin=(0, 0, 4, 0))

    def value(self, k: int) -> float:
        """SI value of a slider."""
        return float(self.sliders[k].value) / self.sizes[k].shown[1]


def _slider(size: Size, choice: Choice, disabled: bool) -> Slider:
    unit, factor = size.shown
    low, high = factor * size.low, factor * size.high
    slider = Slider(
        start=low,
        end=high,
        value=factor * choice.numbers.get(size.name, size.parameter.default),
        step=_step(low, high),
        title=_title(size),
        format=PrintfTickFormatter(format=f"%.4g {unit}".rstrip()),
        sizing_mode="stretch_width",
        disabled=disabled,
        name=f"size_{size.name}",
        stylesheets=[sheet(":host { padding: 0 10px 0 4px; }")],
        margin=(2, 0, 6, 0),
    )
    return slider


def _title(size: Size) -> str:
    what = size.vine or size.parameter.meaning
    return f"{size.parameter.symbol}, {what}" if what else size.parameter.symbol


def _step(low: float, high: float) -> float:
    return (high - low) / STEPS or 1.0


class EffectPanel:
    """All effects in groups. `ticked(effect, wanted)` and `moved(effect, number, value)` hear what a person does."""

    def __init__(
        self,
        campaign: Campaign,
        choice: Choice,
        suspects: Sequence[str],
        ticked: Callable[[str, bool], None],
        moved: Callable[[str, str, float], None],
    ) -> None:
        self.campaign, self._ticked, self._moved = campaign, ticked, moved
        self._quiet = False
        self.rows = {name: Row(campaign, effect, choice) for name, effect in campaign.effects.items()}
        for name, row in self.rows.items():
            row.tick.on_change("active", self._on_tick(name))
            for k, slider in enumerate(row.sliders):
                slider.on_change("value", self._on_size(name, k))
        self.root = Column(
            children=self._groups(choice, suspects), sizing_mode="stretch_width", name="effects", margin=0
        )

    def _groups(self, choice: Choice, suspects: Sequence[str]) -> list[Column]:
        in_use = [name for name in self.rows if name in choice]
        likely = [name for name in suspects if name in self.rows and name not in in_use][:6]
        rest = [name for name in self.rows if name not in in_use and name not in likely]
        kinds = {name: self.campaign.effects[name].kind for name in rest}
        groups = [
            ("Suspected by the diagnosis", likely, True),
            ("Physical effects", [name for name in rest if kinds[name] != "measurement"], not likely),
            ("Measurement effects", [name for name in rest if kinds[name] == "measurement"], False),
            ("In the model in use", in_use, True),
        ]
        return [self._group(title, names, shown) for title, names, shown in groups if names]

    def _group(self, title: str, names: Sequence[str], shown: bool) -> Column:
        inside = Column(
            children=[self.rows[name].root for name in names], sizing_mode="stretch_width", visible=shown, margin=0
        )
        head = Toggle(label=title, active=shown, sizing_mode="stretch_width", stylesheets=[sheet(HEADING)], margin=0)
        head.js_on_change("active", CustomJS(args={"inside": inside}, code="inside.visible = cb_obj.active"))
        return Column(children=[head, inside], sizing_mode="stretch_width", margin=0)

    def _on_tick(self, name: str) -> Callable[[str, bool, bool], None]:
        def heard(_attr: str, _old: bool, new: bool) -> None:
            if not self._quiet:
                self._ticked(name, new)

        return heard

    def _on_size(self, name: str, k: int) -> Callable[[str, float, float], None]:
        def heard(_attr: str, _old: float, _new: float) -> None:
            if not self._quiet:
                row = self.rows[name]
                self._moved(name, row.sizes[k].name, row.value(k))

        return heard

    def show(self, choice: Choice, fitted: Fitted | None = None, *, sliders: bool = True) -> None:
        """Set ticks and, where wanted, sliders to a choice; beside each number what a fit found of it."""
        self._quiet = True
        try:
            for name, row in self.rows.items():
                if row.tick.active != (name in choice):
                    row.tick.active = name in choice
                for k, size in enumerate(row.sizes):
                    if sliders:
                        _set_slider(row.sliders[k], size, choice.numbers.get(size.name, size.parameter.default))
                    _say_found(row.found[k], size, fitted if name in choice else None)
        finally:
            self._quiet = False


def _set_slider(slider: Slider, size: Size, value: float) -> None:
    low, high = slider_range(size.key, size.parameter, value)
    low, high = (bound * size.shown[1] for bound in (min(low, size.low), max(high, size.high)))
    shown = value * size.shown[1]
    if (slider.start, slider.end) != (low, high):
        slider.update(start=low, end=high, step=_step(low, high))
    if slider.value != shown:
        slider.value = shown


def _say_found(div: Div, size: Size, fitted: Fitted | None) -> None:
    number = None if fitted is None else fitted.number(size.name)
    if number is None:
        div.visible = False
        return
    unit, factor = size.shown
    low, high, value = (factor * x for x in (number.low, number.high, number.value))
    error = f" ± {factor * number.sigma:.2g}" if math.isfinite(number.sigma) else ""
    at_bound = " · at its bound" if math.isfinite(number.bound) else ""
    text = f"<small>fitted: <b>{value:.4g}{error}</b> {escaped(unit)} · 95 %: {low:.4g} to {high:.4g}{at_bound}</small>"
    div.update(text=text, visible=True)
