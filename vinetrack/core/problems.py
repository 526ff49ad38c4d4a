"""Problems of the user's input, each with its location, the value, what is allowed, and the remedy.

Reading an experiment collects all problems before it stops, so that a sheet can be corrected in one pass. At the end,
remarks on results: a reason, a warning or a note as a code with its numbers; `vinetrack.narrative` makes sentences.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from importlib import import_module
from typing import Any

# Reason given for a trial or stage that an unexpected exception stopped
INTERNAL_ERROR = "an internal error of the program; the traceback is in the log of this stage"


@dataclass(frozen=True)
class Problem:
    """An error, a warning or a note (`severity`): location, given value, allowed values, and remedy. `file` is relative
    to the experiment; `line` counts from 1 and is 0 if it does not apply; other fields are blank if they do not apply.
    `value` is None if there is none, "" for a blank cell. `code` says for a program what `message` says for a person.
    """

    code: str = ""
    message: str = ""
    column: str = ""
    _: KW_ONLY
    severity: str = "error"
    file: str = ""
    trial: str = ""
    line: int = 0
    value: str | None = None
    allowed: str = ""
    remedy: str = ""
    of_a_measurement: bool = False

    @classmethod
    def from_error(cls, error: InputError, file: str, **place: Any) -> Problem:
        """Make a problem of an error, at a place."""
        return cls(error.code, error.message, file=file, remedy=error.remedy, allowed=error.allowed, **place)

    @property
    def reason(self) -> str:
        """The problem without file, line and trial, as the reason of a failed trial.

        >>> Problem(message="is not a number", column="pressure_kPa", value="12 kPa", remedy="write 12").reason
        "pressure_kPa '12 kPa' is not a number: write 12"
        """
        value = self.value or ""
        shown = repr(value if len(value) <= 60 else f"{value[:59]}…") if value else ""
        allowed = f"(allowed: {self.allowed})" if self.allowed else ""
        said = " ".join(filter(None, (self.column, shown, self.message, allowed)))
        return _one_line(f"{said}{': ' + self.remedy if self.remedy else ''}")

    def __str__(self) -> str:
        """One line naming severity, file, line, trial, column, value, what is allowed and the remedy."""
        place = self.file + (f" line {self.line}" if self.line else "")
        where = ", ".join(filter(None, (place, self.trial and f"trial {self.trial}")))
        return _one_line(": ".join(filter(None, (self.severity, where, self.reason))))


class UserError(Exception):
    """An error that the user can correct, printed as its message; any other exception is a fault of the program."""


class InputError(UserError, ValueError):
    """A file or a value that cannot be used: what is wrong (`message`, `code`), the remedy, and what is allowed. In a
    settings model pydantic reports it as an error of its key.
    """

    def __init__(self, message: str, remedy: str = "", allowed: str = "", code: str = "") -> None:
        super().__init__(f"{message}: {remedy}" if remedy else message)
        self.message, self.remedy, self.allowed, self.code = message, remedy, allowed, code


class ExperimentError(UserError):
    """An experiment that cannot be read; `problems` holds all its problems, errors first."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda problem: problem.severity != "error"))
        super().__init__("\n".join(format_problems(self.problems)))


def format_problems(problems: Sequence[Problem], limit: int = 20) -> list[str]:
    """Format problems, errors first, as at most `limit` lines; the last counts the rest. Those that differ only in
    trial, line and measured number are one; so are cells beyond the same bound of a column, and files not found.
    """
    groups: dict[Problem, list[Problem]] = {}
    for problem in sorted(problems, key=lambda problem: ("error", "warning", "note").index(problem.severity)):
        alike = replace(problem, trial="", line=0, message="" if problem.of_a_measurement else problem.message)
        alike = replace(alike, value=None, remedy="") if problem.code.endswith(("_bounds", "no_file")) else alike
        groups.setdefault(alike, []).append(problem)
    merged = [
        group[0] if len(group) == 1 else replace(group[0], line=0, trial=f"{group[0].trial} and {len(group) - 1} more")
        for group in groups.values()
    ]
    lines, remaining = list(map(str, merged)), merged[limit - 1 :]
    if len(lines) <= limit:
        return lines
    errors = sum(problem.severity == "error" for problem in remaining)
    return [*lines[: limit - 1], f"… and {len(remaining)} more ({errors} errors, {len(remaining) - errors} warnings)"]


def confirmed(found: Iterable[tuple[str, str]], vines: Iterable[str]) -> set[tuple[str, str]]:
    """Vine and column of what several recordings of a vine contradict, or its only one: a wrong number of the sheet
    contradicts all; where one alone does, it was not followed well. `vines` are those of all recordings.
    """
    recordings = Counter(vines)
    return {pair for pair, count in Counter(found).items() if count >= min(2, recordings[pair[0]])}


def _one_line(text: str) -> str:
    """Replace line breaks and control characters, so that a cell cannot forge further lines of output."""
    return "".join(char if char.isprintable() else " " for char in text)


# ------------------------------------------------------------------------------
# A reason, a warning or a note as a code with its numbers.


def in_words(told: Any) -> str:
    """Return a remark or a result in words; they are made in a room above, imported when words are requested."""
    return str(import_module("vinetrack.narrative").in_words(told))


def joined(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them; blank for none."""
    return f"{', '.join(names[:-1])} {last} {names[-1]}" if len(names) > 1 else "".join(names)


def reasons_told(left_out: Mapping[str, str]) -> str:
    """The reasons by name of trial, each once with those that share it."""
    alike = {why: [name for name, other in left_out.items() if other == why] for why in left_out.values()}
    named = {why: names if len(names) < 5 else [*names[:3], "others"] for why, names in alike.items()}
    return "; ".join(f"{joined(names)}: {why}" for why, names in named.items())


@dataclass(frozen=True)
class Remark:
    """A code, and the names and numbers (SI) that belong to it. Blank and false without a code; as text, a sentence."""

    code: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.code)

    def __str__(self) -> str:
        return in_words(self) if self.code else ""

    def to_json(self) -> dict[str, Any] | None:
        """The code and its facts; None without a code."""
        return {"code": self.code, **self.facts} if self.code else None

    @classmethod
    def from_json(cls, content: Mapping[str, Any] | None) -> Remark:
        """Read what `to_json` wrote."""
        return cls(content["code"], {k: v for k, v in content.items() if k != "code"}) if content else cls()


def remark(code: str, **facts: Any) -> Remark:
    """Return a remark with these facts."""
    return Remark(code, facts)
