"""Tables that line up, bars and colour on a terminal alone.

The terminal is a pseudo-terminal: what a child process writes to it is what a person would see.
"""

from __future__ import annotations

import doctest
import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios

import pytest

from vinetrack.core import terminal
from vinetrack.core.terminal import colour_wanted, progress, severity_first, styled, table, waiting, width

SLOW = """
import time
from vinetrack.core.terminal import progress
for _ in progress(range(12), "trials"):
    time.sleep(0.1)
"""
QUICK = SLOW.replace("range(12)", "range(2)")
WAITING = """
import time
from vinetrack.core.terminal import waiting
with waiting("compiling the model"):
    time.sleep(1.2)
print("done")
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
        [sys.executable, "-c", code],
        stdout=slave,
        stderr=slave,
        env={**environment, "TERM": "xterm"},
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


def test_the_examples_of_the_docstrings_hold() -> None:
    assert doctest.testmod(terminal).failed == 0


def test_numbers_stand_to_the_right_and_words_to_the_left() -> None:
    lines = table([("long name", "1.50", "yes"), ("b", "–", "no")], ("trial", "rms", "used"), ("", "mm", ""))
    assert lines == [
        "trial       rms  used",
        "             mm",
        "long name  1.50  yes",
        "b             –  no",
    ]


@pytest.mark.parametrize("cell", ["1", "-0.5", "−0.5", "± 0.1", "1.2 ± 0.3", "3e-05", "95 %", "2.1×", "<0.01", "+4"])
def test_what_looks_like_a_number_is_one(cell: str) -> None:
    assert table([(cell,), ("10000000000",)])[0] == cell.rjust(11)


@pytest.mark.parametrize("cell", ["a", "12mm-200um", "1 of 2", "0.1 to 0.2"])
def test_words_with_digits_are_words(cell: str) -> None:
    assert table([(cell,), ("x" * 20,)])[0] == cell


def test_styles_and_combining_marks_take_no_room() -> None:
    assert width("\x1b[31mreservoir\x1b[0m") == 9
    assert width("x̂") == 1
    assert width("長さ") == 4


def test_a_table_of_nothing_has_no_lines_and_of_a_header_alone_one() -> None:
    assert table([]) == []
    assert table([], ("a", "b")) == ["a  b"]


def test_alignment_and_indent_can_be_given() -> None:
    assert table([("1", "x")], ("number", "word"), align="<>", indent="  ") == ["  number  word", "  1          x"]


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert styled("bad", "red", "bold", stream=Screen()) == "\x1b[31;1mbad\x1b[0m"
    assert styled("bad", "red", stream=io.StringIO()) == "bad"
    monkeypatch.setenv("NO_COLOR", "1")
    assert not colour_wanted(Screen())
    monkeypatch.setenv("NO_COLOR", "")
    assert colour_wanted(Screen())
    monkeypatch.setenv("TERM", "dumb")
    assert not colour_wanted(Screen())


def test_only_the_severity_of_a_problem_is_coloured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert severity_first("error: trials.csv: a", Screen()) == "\x1b[31;1merror\x1b[0m: trials.csv: a"
    assert severity_first("… and 3 more", Screen()) == "… and 3 more"


def test_a_bar_says_how_much_is_left() -> None:
    said = seen_on_a_terminal(SLOW)
    assert "trials:" in said
    assert "/12" in said
    assert "<00:0" in said


def test_what_is_quick_shows_no_bar() -> None:
    assert "trials:" not in seen_on_a_terminal(QUICK)


def test_a_wait_of_unknown_length_shows_a_sign_of_life_and_leaves_no_trace() -> None:
    said = seen_on_a_terminal(WAITING)
    assert "compiling the model … 1 s" in said
    assert said.rpartition("\x1b[2K")[2].strip() == "done"


def test_nothing_is_shown_where_nobody_looks(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with progress(2, "steps", unit="step") as bar, waiting("fitting"):
        bar.advance()
        bar.reach(2)
        bar.say("refit")
    assert capfd.readouterr() == ("", "")


def test_things_without_a_length_are_counted() -> None:
    assert list(progress((letter for letter in "abc"), "letters")) == ["a", "b", "c"]
