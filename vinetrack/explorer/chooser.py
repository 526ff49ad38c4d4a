"""Which conditions and trials are drawn: a button for each, and three for what is wanted most often."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bokeh.models import Button, CheckboxButtonGroup, Column, CustomJS, Row, Toggle

from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.look import sheet

SMALL = ".bk-btn { font-size: 12px; padding: 2px 9px; }"
CHIPS = """
:host { max-height: 10.5rem; overflow-y: auto; }
.bk-btn-group { display: flex; flex-wrap: wrap; gap: 4px; }
.bk-btn-group > .bk-btn { flex: 0 1 auto; border-radius: 999px !important; margin: 0 !important; padding: 3px 10px; }
.bk-btn-group > .bk-btn { border: 1px solid var(--grid); background: var(--card); color: var(--muted); }
.bk-btn-group > .bk-btn.bk-active { background: var(--chosen); border-color: var(--accent); color: var(--ink); }
.bk-btn-group > .bk-btn.bk-active { box-shadow: none; }
"""


class Chooser:
    """Buttons; `heard` is called when the selection has changed."""

    def __init__(self, campaign: Campaign, heard: Callable[[], None]) -> None:
        self.campaign, self._heard = campaign, heard
        everything = list(range(len(campaign.conditions)))
        self._conditions = CheckboxButtonGroup(
            labels=[campaign.labels[name] for name in campaign.conditions],
            active=everything,
            name="conditions",
            stylesheets=[sheet(CHIPS)],
            margin=(0, 0, 4, 0),
        )
        self._trials = CheckboxButtonGroup(
            labels=[seen.name for seen in campaign.trials],
            active=list(range(len(campaign.trials))),
            name="trials",
            visible=False,
            stylesheets=[sheet(CHIPS + SMALL)],
            margin=(4, 0, 0, 0),
        )
        self._conditions.on_change("active", lambda _attr, _old, _new: self._heard())
        self._trials.on_change("active", lambda _attr, _old, _new: self._heard())
        self.root = Column(
            children=[self._conditions, self._tools(), self._trials],
            sizing_mode="stretch_width",
            name="choose",
            margin=0,
        )

    def _tools(self) -> Row:
        single = Toggle(
            label="single trials …", active=False, stylesheets=[sheet(SMALL)], margin=0, name="single_trials"
        )
        single.js_on_change("active", CustomJS(args={"t": self._trials}, code="t.visible = cb_obj.active"))
        return Row(
            children=[self._button("all", self._all), self._button("none", self._none), single],
            margin=0,
            stylesheets=[sheet(":host { gap: 4px; }")],
        )

    def _button(self, label: str, does: Callable[[], None]) -> Any:
        button = Button(label=label, stylesheets=[sheet(SMALL)], margin=0, name=f"choose_{label}")
        button.on_click(does)
        return button

    def _all(self) -> None:
        self._trials.active = list(range(len(self.campaign.trials)))
        self._conditions.active = list(range(len(self.campaign.conditions)))

    def _none(self) -> None:
        self._conditions.active = []

    def toggle(self, condition: str) -> None:
        """Choose this condition alone; where it is alone already, all of them again."""
        place = self.campaign.conditions.index(condition)
        alone = self._conditions.active == [place]
        self._conditions.active = list(range(len(self.campaign.conditions))) if alone else [place]

    @property
    def conditions(self) -> list[str]:
        """Names of the conditions chosen."""
        return [self.campaign.conditions[k] for k in sorted(self._conditions.active)]

    @property
    def shown(self) -> list[int]:
        """Places of the trials to draw: those ticked, of the conditions chosen."""
        wanted = set(self.conditions)
        return [i for i in sorted(self._trials.active) if self.campaign.trials[i].condition in wanted]
