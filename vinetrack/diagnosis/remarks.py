"""A reason, a warning or a note as a code with its numbers; `vinetrack.narrative` makes the sentence of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer


def in_words(told: Any) -> str:
    """Return a remark or a result in words."""
    # "vinetrack.narrative": room whose function `in_words(object)` makes sentences; it lies above, and is
    # imported when words are requested
    words: str = import_module("vinetrack.narrative").in_words(told)
    return words


def joined(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them; blank for none."""
    return f"{', '.join(names[:-1])} {last} {names[-1]}" if len(names) > 1 else "".join(names)


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


StoredRemark = Annotated[Remark, BeforeValidator(Remark.from_json), PlainSerializer(Remark.to_json)]


def remark(code: str, **facts: Any) -> Remark:
    """Return a remark with these facts."""
    return Remark(code, facts)
