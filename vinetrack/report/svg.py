"""Pictures inside a page: matplotlib's SVG made fit for HTML, and tiny curves for tables, written by hand."""

from __future__ import annotations

import re
from html import escape

import numpy as np
from numpy.typing import NDArray

from vinetrack.figures.style import BLUE, GREEN, GRID, INK, MUTED, PAPER, VERMILLION

_THEMED = {
    INK: "currentColor",
    GRID: "var(--grid)",
    MUTED: "var(--muted)",
    PAPER: "var(--paper)",
    BLUE: "var(--blue)",
    VERMILLION: "var(--vermillion)",
    GREEN: "var(--green)",
}
_REFERENCE = re.compile(r"""(\bid="|url\(#|href="#)""")


def inline_svg(svg: str, prefix: str, description: str) -> str:
    """Return an SVG file's root element, ready to stand in a page.

    Neutral colours become the page's own, so that it follows a dark screen; identifiers get `prefix`, since several
    pictures share one page; the size becomes that of the page's column. `description` is for those who cannot see it.
    """
    root = svg[svg.index("<svg") :]
    root = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style[^>]*>.*?</style>", "", root, flags=re.DOTALL)
    root = _REFERENCE.sub(lambda match: f"{match[0]}{prefix}-", root)
    for colour, themed in _THEMED.items():
        root = re.sub(re.escape(colour), themed, root, flags=re.IGNORECASE)
    head, body = root.split(">", 1)
    width = re.search(r'width="([\d.]+)pt"', head)
    head = re.sub(r'\s(?:width|height|xmlns:xlink|version)="[^"]*"', "", head)
    # A picture is shown at most a third larger than drawn: text in it then keeps in step with the page's.
    size = f"max-width:{float(width[1]) * 1.33:.0f}px" if width else ""
    label = escape(description, quote=True)
    body = body.replace("xlink:href", "href")
    body = re.sub(r">\s+<", "><", body).strip()
    return f'{head} role="img" aria-label="{label}" style="{size}">{body}'


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
