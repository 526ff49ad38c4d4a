"""Results in words: the only room with prose. A result or a remark (a code with its numbers) becomes sentences here.

`sentences.csv` holds the sentence of each remark, with its facts in braces; what takes more is a function in
`diagnosis_text.REMARKS`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any


def in_words(told: Any) -> str:
    """Return a remark or a result of the diagnosis in words."""
    from vinetrack.narrative.diagnosis_text import diagnosis_text, power_lines
    from vinetrack.narrative.verdict_text import estimates_text, explain

    makers: dict[str, Callable[[Any], str]] = {
        "Remark": lambda remark: sentence(remark.code, remark.facts),
        "SelectionStep": explain,
        "Candidate": estimates_text,
        "Diagnosis": diagnosis_text,
        "Power": lambda power: "\n".join(power_lines(power)),
    }
    return str(makers[type(told).__name__](told))


def sentence(code: str, facts: Mapping[str, Any]) -> str:
    """Return the sentence of a remark."""
    from vinetrack.narrative.diagnosis_text import REMARKS

    return REMARKS[code](**facts) if code in REMARKS else _Words().vformat(templates()[code], (), facts)


class _Words(Formatter):
    """Formats of a sentence: those of Python, multiplied by `mm` or `%` before them; a name of `FORMS`; and
    `?yes|no`, one of two texts, the first for what is true or not empty.
    """

    def format_field(self, value: Any, form: str) -> str:
        from vinetrack.narrative.diagnosis_text import FORMS

        if form.startswith("?"):
            return form[1:].split("|")[0 if value else 1]
        for unit, factor in (("mm", 1e3), ("%", 100.0)):
            if form.startswith(unit):
                return format(factor * value, form.removeprefix(unit))
        return FORMS[form](value) if form in FORMS else format(value, form)


@cache
def templates() -> dict[str, str]:
    """The sentences of `sentences.csv` by code."""
    with Path(__file__).with_name("sentences.csv").open(encoding="utf-8", newline="") as file:
        return {row["code"]: row["sentence"] for row in csv.DictReader(file)}
