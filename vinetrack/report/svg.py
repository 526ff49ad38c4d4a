"""Pictures inside a page: matplotlib's SVG made fit for HTML, and tiny curves for tables, written by hand."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from vinetrack.figures.page_tokens import TOKENS
from vinetrack.report.compact import compact_svg

_THEMED = {colour: "currentColor" if token == "--ink" else f"var({token})" for colour, token in TOKENS.items()}


def inline_svg(svg: str, prefix: str, description: str) -> str:
    """Return an SVG file as an element ready to stand in a page.

    Neutral colours become the page's own, so that it follows a dark screen; identifiers get `prefix`, since several
    pictures share one page. `description` is for those who cannot see it. The page's style sheet sets the size by
    `--wide`, at which text in the picture is as large as that of the page.
    """
    body, width_pt, height_pt = compact_svg(svg, prefix, _THEMED)
    label, box = escape(description, quote=True), f"0 0 {width_pt:g} {height_pt:g}"
    return f'<svg viewBox="{box}" role="img" aria-label="{label}" style="--wide:{1.33 * width_pt:.0f}px">{body}</svg>'


def speed_sparkline(
    time_s: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    steady_s: tuple[float, float],
    width_px: int = 132,
    height_px: int = 30,
) -> str:
    """Speed against time as a small SVG, the steady stretch thick; blank where there is nothing to draw."""
    good = np.isfinite(time_s) & np.isfinite(speed_m_s)
    time_s, speed_m_s = time_s[good], speed_m_s[good]
    if time_s.size < 2 or np.ptp(time_s) <= 0:
        return ""
    step = max(time_s.size // width_px, 1)
    time_s, speed_m_s = time_s[::step], speed_m_s[::step]
    top = max(float(np.percentile(speed_m_s, 99)), 1e-12)
    x = 1 + (width_px - 2) * (time_s - time_s[0]) / np.ptp(time_s)
    y = np.clip(height_px - 2 - (height_px - 5) * speed_m_s / top, 1, height_px - 1)
    steady = (time_s >= steady_s[0]) & (time_s <= steady_s[1])
    thick = f'<polyline class="steady" points="{_points(x[steady], y[steady])}"/>' if steady.sum() > 1 else ""
    return (
        f'<svg class="spark" viewBox="0 0 {width_px} {height_px}" width="{width_px}" height="{height_px}" '
        f'aria-hidden="true"><polyline points="{_points(x, y)}"/>{thick}</svg>'
    )


def _points(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
