"""Every figure of a results folder: a drawing function with the decorator `figure`, which says all about it.

The decorator gives name, section of the report, title and data to download; the docstring of the function is the
caption, and its parameters are the names of the tables that it shows. `draw` takes them from any object that has them
as attributes. A function without anything to show returns None, and the figure does not exist.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from vinetrack.figures.style import look

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Additions to the captions of figures that show the initial model, if the diagnosis refutes it
SHOWS_REFUTED = "It shows the initial model, which the diagnosis refutes."
DASHED_REFUTED = "The dashed model is the initial one, which the diagnosis refutes."

_Drawing = TypeVar("_Drawing", bound="Callable[..., Figure | None]")


@dataclass(frozen=True)
class RegisteredFigure:
    """One figure of a results folder. `data` is a file of the folder, or the name of a table (no dot), to download
    beside it; `if_refuted` is added to the caption if the diagnosis refutes the initial model.
    """

    name: str
    section: str
    title: str
    caption: str
    data: str
    if_refuted: str
    drawing: Callable[..., Figure | None]

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the tables that it shows."""
        parameters = inspect.signature(self.drawing).parameters.values()
        return tuple(one.name for one in parameters if one.default is one.empty)


_registered: dict[str, RegisteredFigure] = {}


def figure(
    name: str, section: str, title: str, *, data: str = "", if_refuted: str = ""
) -> Callable[[_Drawing], _Drawing]:
    """Register the decorated function as the drawing of a figure, and draw it in the common style."""

    def register(drawing: _Drawing) -> _Drawing:
        styled = look()(drawing)
        caption = " ".join((drawing.__doc__ or "").split())
        _registered[name] = RegisteredFigure(name, section, title, caption, data, if_refuted, styled)
        return styled

    return register


@cache
def all_figures() -> dict[str, RegisteredFigure]:
    """Return all figures by name."""
    from vinetrack.figures import (  # noqa: F401 - each registers its figures
        damping_figures,
        diagnosis_figures,
        motion_figures,
        overlay,
        paper_figures,
    )

    return dict(_registered)


def figures_of(*sections: str) -> dict[str, RegisteredFigure]:
    """Return the figures of some sections of the page by name."""
    return {name: one for section in sections for name, one in all_figures().items() if one.section == section}


def campaign_figures() -> dict[str, RegisteredFigure]:
    """Return the figures of a whole experiment by name, those of its diagnosis last."""
    return figures_of("damping", "model") | diagnosis_figures()


def diagnosis_figures() -> dict[str, RegisteredFigure]:
    """Return the figures that show the diagnosis by name."""
    return figures_of("verdict", "where", "candidates", "tied", "drift")


def draw(name: str, tables: Any) -> Figure | None:
    """Draw a figure from the attributes of `tables`; None if there is nothing to show."""
    entry = all_figures()[name]
    return entry.drawing(*(getattr(tables, table) for table in entry.reads))
