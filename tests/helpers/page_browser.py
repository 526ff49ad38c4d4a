"""Replacement of the browser in tests of the explorer's page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bokeh.document import Document
from chrome import until

from vinetrack.pages.campaign import BackgroundFit
from vinetrack.pages.page import Page


class Browser:
    """A document whose callbacks are run by hand."""

    def __init__(self, background: BackgroundFit, reopen: Callable[[BackgroundFit], None] | None = None) -> None:
        self.document = Document()
        self.page = Page(background, self.document, reopen)
        self.turn()

    def model(self, name: str) -> Any:
        found = self.document.get_model_by_name(name)
        assert found is not None, name
        return found

    def text(self, name: str) -> str:
        return str(self.model(name).text)

    def turn(self) -> None:
        """Run all pending callbacks once."""
        for callback in list(self.document.session_callbacks):
            if type(callback).__name__ != "PeriodicCallback":
                self.document.callbacks.remove_session_callback(callback)
                callback.callback()

    def until(self, asked: Callable[[], bool], seconds: float = 240) -> None:
        until(lambda: asked() or self.turn(), "the page", seconds)

    def click(self, name: str) -> None:
        from bokeh.events import ButtonClick

        button = self.model(name)
        button._trigger_event(ButtonClick(button))
