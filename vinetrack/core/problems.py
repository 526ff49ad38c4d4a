"""What is wrong with an experiment, said so that a person can put it right.

Reading an experiment collects every problem before it gives up, so that a sheet is mended in one go.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

CLOSE_NAME_RATIO = 0.6
"""Chosen: part of the letters that two names share from which one may be a slip for the other; difflib's default."""

MAX_QUOTED_LENGTH = 60
"""Of a value quoted in a message; chosen: half a line, as a paragraph pasted in a cell would hide the message."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One fault (`severity` "error") or oddity ("warning"): where it is, what was given, what is allowed, what to do.

    `file` is relative to the experiment; `line` counts from 1, 0 where it makes no sense; other fields are blank
    where they do not apply. `value` is None where there is none, "" for a blank cell. `of_a_measurement`: the message
    quotes what was measured on this very trial; of another trial it is the same problem with another number.
    """

    message: str
    severity: str = "error"
    file: str = ""
    trial: str = ""
    line: int = 0
    column: str = ""
    value: str | None = None
    allowed: str = ""
    remedy: str = ""
    of_a_measurement: bool = False

    @classmethod
    def from_error(cls, error: Exception, file: str, **details: Any) -> Problem:
        """The problem that the words of an error state: what is wrong, then after a colon the remedy.

        Parameters
        ----------
        error : with such words.
        file : that it was met in.
        details : further fields.

        Returns
        -------
        Problem
        """
        message, _, remedy = str(error).partition(": ")
        return cls(message=message, file=file, remedy=remedy, **details)

    @property
    def reason(self) -> str:
        """The problem without file, line and trial, for the row of a trial that failed.

        >>> Problem(message="is not a number", column="pressure_kPa", value="12 kPa", remedy="write 12").reason
        "pressure_kPa '12 kPa' is not a number: write 12"
        """
        shown = "" if self.value is None or self.value == "" else repr(_shorten(self.value))
        subject = " ".join(part for part in (self.column, shown, self.message) if part)
        allowed = f" (allowed: {self.allowed})" if self.allowed else ""
        return _one_line(f"{subject}{allowed}{': ' + self.remedy if self.remedy else ''}")

    def __str__(self) -> str:
        """One line naming severity, file, line, trial, column, value, what is allowed and the remedy."""
        place = self.file + (f" line {self.line}" if self.line else "")
        trial = f"trial {self.trial}" if self.trial else ""
        where = ", ".join(part for part in (place, trial) if part)
        return _one_line(": ".join(part for part in (self.severity, where, self.reason) if part))


class UserError(Exception):
    """Something that a person can put right: the message says what is wrong and what to do, without a traceback.

    Errors that reach the terminal as their own sentence derive from it; any other is a fault of the program.
    """


class ExperimentError(UserError):
    """An experiment that cannot be read; `problems` holds everything that was found, errors first."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda problem: problem.severity != "error"))
        super().__init__("\n".join(format_problems(self.problems)))


def format_problems(problems: Sequence[Problem], limit: int = 20) -> list[str]:
    """Say the problems in at most `limit` lines, errors first; where there are more, the last line says how many.

    One that several trials have alike is said once.

    Parameters
    ----------
    problems : in any order.
    limit : lines at most.

    Returns
    -------
    lines : errors first.

    >>> format_problems([Problem(message="is blank", column=f"c{i}") for i in range(4)], limit=3)
    ['error: c0 is blank', 'error: c1 is blank', '… and 2 more (2 errors, 0 warnings)']
    """
    ordered = sorted(_merged(problems), key=lambda problem: problem.severity != "error")
    if len(ordered) <= limit:
        return [str(problem) for problem in ordered]
    remaining = ordered[limit - 1 :]
    errors = sum(problem.severity == "error" for problem in remaining)
    more = f"… and {len(remaining)} more ({errors} errors, {len(remaining) - errors} warnings)"
    return [*(str(problem) for problem in ordered[: limit - 1]), more]


def _merged(problems: Iterable[Problem]) -> list[Problem]:
    """Problems that differ in trial, line and what was measured alone as one that names the first, counting others."""
    alike: dict[Problem, list[Problem]] = {}
    for problem in problems:
        message = "" if problem.of_a_measurement else problem.message
        alike.setdefault(replace(problem, trial="", line=0, message=message), []).append(problem)
    return [
        group[0] if len(group) == 1 else replace(group[0], line=0, trial=f"{group[0].trial} and {len(group) - 1} more")
        for group in alike.values()
    ]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """What an unknown name may have meant: the nearest three of those that are known.

    Parameters
    ----------
    name : as it was written.
    known : names that would have been right.

    Returns
    -------
    a question where one comes close, else a list; blank where nothing is known.

    >>> did_you_mean("presure", ["pressure", "payload", "trial", "preview"])
    'did you mean pressure? (or preview, trial)'
    """
    nearest = difflib.get_close_matches(name, list(known), 3, 0.0)
    if not nearest:
        return ""
    if difflib.SequenceMatcher(None, nearest[0], name).ratio() < CLOSE_NAME_RATIO:
        return f"the closest names are {', '.join(nearest)}; vinetrack settings lists all"
    others = f" (or {', '.join(nearest[1:])})" if len(nearest) > 1 else ""
    return f"did you mean {nearest[0]}?{others}"


def _shorten(text: str) -> str:
    return text if len(text) <= MAX_QUOTED_LENGTH else text[: MAX_QUOTED_LENGTH - 1] + "…"


def _one_line(text: str) -> str:
    """Replace line breaks and control characters: a hostile cell must not forge further lines of a report."""
    return "".join(char if char.isprintable() else " " for char in text)
