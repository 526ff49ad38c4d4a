"""Colours of pages with a light and a dark scheme, and their mapping from the colours of figures."""

from __future__ import annotations

from pathlib import Path

from vinetrack.figures.style import BLUE, GREEN, GRID, INK, MUTED, PAPER, VERMILLION

# CSS custom property by colour of a figure; purple, sky and orange are visible in either scheme
TOKENS = {
    INK.lower(): "--ink",
    GRID.lower(): "--grid",
    MUTED.lower(): "--muted",
    PAPER.lower(): "--paper",
    BLUE.lower(): "--blue",
    VERMILLION.lower(): "--vermillion",
    GREEN.lower(): "--green",
}


def page_tokens() -> str:
    """Return CSS with the values of the properties in the light and the dark scheme."""
    return Path(__file__).with_name("page_tokens.css").read_text(encoding="utf-8")


def page_frame() -> str:
    """Return CSS of local pages: the properties of `page_tokens`, and the style of page, heading and cards."""
    return page_tokens() + Path(__file__).with_name("page_frame.css").read_text(encoding="utf-8")


def follows_screen(colour: str) -> str:
    """Return the CSS of a figure's colour, as a property if the page may change it."""
    token = TOKENS.get(colour.lower())
    return colour if token is None else f"var({token})"
