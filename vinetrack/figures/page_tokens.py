"""Colours of pages that follow a light or a dark screen, and which of them stands for which colour of a figure."""

from __future__ import annotations

from pathlib import Path

from vinetrack.figures.style import BLUE, GREEN, GRID, INK, MUTED, PAPER, VERMILLION

TOKENS = {
    INK.lower(): "--ink",
    GRID.lower(): "--grid",
    MUTED.lower(): "--muted",
    PAPER.lower(): "--paper",
    BLUE.lower(): "--blue",
    VERMILLION.lower(): "--vermillion",
    GREEN.lower(): "--green",
}
"""Custom property of a page's style sheet by colour of a figure; purple, sky and orange are seen on either screen."""


def page_tokens() -> str:
    """CSS that gives the properties their values on a light and on a dark screen."""
    return Path(__file__).with_name("page_tokens.css").read_text(encoding="utf-8")


def page_frame() -> str:
    """CSS of local pages: the properties of `page_tokens`, and what frames a page, its heading and its cards."""
    return page_tokens() + Path(__file__).with_name("page_frame.css").read_text(encoding="utf-8")


def follows_screen(colour: str) -> str:
    """CSS of a figure's colour, where a page may change it.

    Parameters
    ----------
    colour : hexadecimal code of a colour of figures.

    Returns
    -------
    str

    >>> follows_screen("#0072B2"), follows_screen("#CC79A7")
    ('var(--blue)', '#CC79A7')
    """
    token = TOKENS.get(colour.lower())
    return colour if token is None else f"var({token})"
