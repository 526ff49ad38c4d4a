"""Tables that line up, bars and colour on a terminal alone.

The terminal is a pseudo-terminal: what a child process writes to it is what a person would see.
"""

from __future__ import annotations

import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios

import pytest

from vinetrack.core.terminal import colour_wanted, progress, severity_first, table, waiting

SLOW = """
import time
from vinetrack.core.terminal import progress
for _ in progress(range(12), "trials"):
    time.sleep(0.1)
"""


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def seen_on_a_terminal(code: str) -> str:
    """What a program writes to a terminal of 100 columns."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"}
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdout=slave, stderr=slave, env={**environment, "TERM": "xterm"}
    )
    os.close(slave)
    said = b""
    while True:
        try:
            part = os.read(master, 4096)
        except OSError:
            break
        if not part:
            break
        said += part
    os.close(master)
    assert child.wait() == 0
    return said.decode()


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


def test_a_bar_says_how_much_is_left() -> None:
    said = seen_on_a_terminal(SLOW)
    assert "trials:" in said
    assert "/12" in said
    assert " left" in said


def test_nothing_is_shown_where_nobody_looks(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with progress(2, "steps", unit="step") as bar, waiting("fitting"):
        bar.advance()
        bar.reach(2, 2)
    assert capfd.readouterr() == ("", "")


def test_things_without_a_length_are_counted() -> None:
    assert list(progress((letter for letter in "abc"), "letters")) == ["a", "b", "c"]
