"""The controls of one page: the trials shown, and the effects in the model with their sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape

from bokeh import models as bk

from vinetrack.core.units import SLIDER_UNITS, display_unit
from vinetrack.effects import BASE_EFFECTS
from vinetrack.inference.fit_result import Number, number_row
from vinetrack.narrative.verdict_text import spaced_name
from vinetrack.pages.campaign import (
    Campaign,
    ModelChoice,
    SizeControl,
    sizes_of,
    slider_range,
)
from vinetrack.pages.plots import beside, button


class SizeSlider:
    """Slider of one parameter, and the text of its fitted value; calls `moved(name, value)` with the value in SI."""

    def __init__(self, size: SizeControl, value: float, disabled: bool, moved: Callable[[str, float], None]) -> None:
        self.size = size
        unit, self._factor = display_unit(size.parameter.unit, size.pressure_unit, SLIDER_UNITS)
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
    """All effects in groups; calls `ticked(effect, wanted)` and `moved(effect, parameter, value)` whenever a tick or a
    size changes.
    """

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
        tools = beside(
            button("all", "choose_all", lambda: self._conditions.update(active=self._every), css_classes=["small"]),
            button("none", "choose_none", lambda: self._conditions.update(active=[]), css_classes=["small"]),
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
