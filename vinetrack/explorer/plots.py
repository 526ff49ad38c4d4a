"""Figures that follow the choice of model: positions, residuals, and the error of each condition."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bokeh.models import ColumnDataSource, CustomJSTickFormatter, HoverTool, Range1d, Span, TapTool

from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.curves import Curves
from vinetrack.explorer.look import GRID, INK, MUTED, plot, vine_colour
from vinetrack.explorer.series import (
    axis_ranges,
    error_bars,
    measured_lines,
    model_lines,
    replicate_bands,
    residual_lines,
    symmetric_range,
)

ROW_PX = 25  # Height of a bar of the errors; chosen: a label of 12 pixels and a gap of equal height

MAX_BANDS = 4  # Chosen: bands of more conditions overlap and hide the curves


class Plots:
    """Figures and their data sources; the `set_…` methods update the data."""

    def __init__(self, campaign: Campaign, on_condition_click: Callable[[str], None]) -> None:
        self.campaign, self._on_condition_click = campaign, on_condition_click
        self._reference_drawn: object = None
        self._curves_drawn: tuple[int, ...] | None = None
        empty: dict[str, Any] = {"xs": [], "ys": []}
        self._band = ColumnDataSource({**empty, "colour": []})
        self._measured = ColumnDataSource({**empty, "colour": [], "trial": [], "condition": []})
        self._reference = ColumnDataSource(empty)
        self._model = ColumnDataSource(empty, name="model_curves")
        self._residuals = ColumnDataSource(
            {**empty, "colour": [], "trial": [], "condition": []}, name="residual_curves"
        )
        self._bars = ColumnDataSource(error_bars(campaign, {}, {}, {}, ()), name="error_bars")
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
        height = 70 + ROW_PX * max(len(names), 2)
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

    def set_shown(self, shown: Sequence[int], reference: Curves | None) -> None:
        """Select the trials to draw, and the reference curves of their conditions."""
        lines = measured_lines(self.campaign, shown)
        (left, right), (bottom, top) = axis_ranges(lines)
        self.motion.x_range.update(start=left, end=right)
        self.motion.y_range.update(start=bottom, end=top)
        self.residual.x_range.update(start=bottom, end=top)
        self._measured.data = lines
        self.set_reference(reference, shown)
        few = len({self.campaign.trials[i].condition for i in shown}) <= MAX_BANDS
        self._band.data = replicate_bands(self.campaign, shown if few else [])

    def set_reference(self, reference: Curves | None, shown: Sequence[int]) -> None:
        """Set the curves for comparison."""
        key = (id(reference), tuple(shown))
        if key != self._reference_drawn:
            self._reference_drawn = key
            self._reference.data = (
                model_lines(self.campaign, reference, shown) if reference is not None else {"xs": [], "ys": []}
            )

    def set_instant(self, since_s: float | None) -> None:
        """Mark a time since release, or none."""
        self.instant.update(visible=since_s is not None, location=1e3 * (since_s or 0.0))

    def set_curves(self, curves: Curves, shown: Sequence[int]) -> None:
        """Set the curves of the current model; for lines already drawn only their ordinates are sent."""
        lines, residual = model_lines(self.campaign, curves, shown), residual_lines(self.campaign, curves, shown)
        low, high = symmetric_range(residual)
        if high != self.residual.y_range.end:
            self.residual.y_range.update(start=low, end=high)
        if tuple(shown) == self._curves_drawn:
            self._model.data["ys"] = lines["ys"]
            self._residuals.data["ys"] = residual["ys"]
        else:
            self._curves_drawn = tuple(shown)
            self._model.data, self._residuals.data = lines, residual

    def set_errors(
        self,
        now_m: Mapping[str, float],
        before_m: Mapping[str, float],
        floors_m: Mapping[str, float],
        conditions: Sequence[str],
    ) -> None:
        """Set the error of every condition; those not in `conditions` are drawn faint."""
        rows = error_bars(self.campaign, now_m, before_m, floors_m, conditions)
        known = [value for key in ("now", "before", "floor") for value in rows[key] if math.isfinite(value)]
        end = round_up(1.04 * max(known, default=1.0))
        if end != self.errors.x_range.end:
            self.errors.x_range.end = end
        for key, values in rows.items():
            if values != self._bars.data[key]:
                self._bars.data[key] = values


def round_up(value: float) -> float:
    """Return the next of 1, 1.5, 2, 3, 4, 5, 6, 8, 10 times a power of ten, so that an axis rarely changes."""
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(round(power * k, 12) for k in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if power * k >= value or k == 10)
