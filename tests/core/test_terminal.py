"""Tables that line up, bars and colour on a terminal alone.

The terminal is a pseudo-terminal: what a child process writes to it is what a person would see.
"""

from __future__ import annotations

import io

import pytest

from vinetrack.core.terminal import colour_wanted, progress, severity_first, table, waiting


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_numbers_stand_to_the_right_and_words_to_the_left() -> None:
    lines = table([("long name", "1.50", "yes"), ("b", "–", "no")], ("trial", "rms", "used"), ("", "mm", ""))
    assert lines == ["trial       rms  used", "             mm", "long name  1.50  yes", "b             –  no"]


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert severity_first("error: a", Screen()) == "\x1b[31;1merror\x1b[0m: a"
    assert severity_first("error: a", io.StringIO()) == "error: a"
    monkeypatch.setenv("NO_COLOR", "1")
    assert not colour_wanted(Screen())
    monkeypatch.setenv("NO_COLOR", "")
    assert colour_wanted(Screen())
    monkeypatch.setenv("TERM", "dumb")
    assert not colour_wanted(Screen())


def test_nothing_is_shown_where_nobody_looks(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with progress(2, "steps", unit="step") as bar, waiting("fitting"):
        bar.advance()
        bar.reach(2, 2)
    assert capfd.readouterr() == ("", "")
