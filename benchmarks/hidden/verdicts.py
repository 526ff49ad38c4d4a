"""Which answers are right about a campaign, and what is made of an answer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

ORDER = ("*order*", "*ageing*", "*aging*", "*wear*", "*drift*")
SPECIMEN = ("*specimen*", "*batch*")
DAY = ("*day*", "*batch*")
N_BY_VINE = ("*n_by_vine*", "*exponent*", "n_*vine*")
"""Patterns of names: what differs between trials has no formula, and no one name."""

FAINT = 8.0
"""Standard deviations of a whole campaign below which a fault need not be seen: `adequate` is right then."""


@dataclass(frozen=True)
class Should:
    """What is right to say of a campaign. Names are patterns as of file names.

    Parameters
    ----------
    verdicts : verdicts that are right
    any_of : unless the verdict is `adequate`, the answer set holds one of these
    all_of : the answer set, or the effects added, hold all of these where the verdict is `ambiguous`
    none_of : none of these stands in the answer set, whatever the verdict
    only : unless empty, the answer set holds nothing else
    true : names that are true of the campaign, so that to name one alone is never wrong
    holds : parameters whose 95 % interval holds the true size where it is named, with what it may include left open
    """

    verdicts: tuple[str, ...]
    any_of: tuple[str, ...] = ()
    all_of: tuple[str, ...] = ()
    none_of: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    true: tuple[str, ...] = ()
    holds: tuple[str, ...] = ()

    def to_json(self) -> dict[str, list[str]]:
        """As plain lists."""
        return {name: list(value) for name, value in vars(self).items()}


@dataclass(frozen=True)
class Judgement:
    """Whether an answer is right; if not, why. `wrong_name`: one name alone, and not a true one."""

    right: bool
    wrong_name: bool
    why: str = ""


@dataclass(frozen=True)
class Answer:
    """What matters of a `diagnosis.json`."""

    verdict: str
    answer_set: tuple[str, ...]
    effects: tuple[str, ...]
    final_verdict: str = ""
    final_answer: tuple[str, ...] = ()
    numbers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    parameters: tuple[Mapping[str, Any], ...] = ()
    confounders: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> Answer:
        """From the file. Sizes come from the first round that states them, else from the last model.

        Of the model's own numbers those count that a named fault of the measurement was fitted along with.
        """
        rounds = said["rounds"]
        numbers: dict[str, Mapping[str, Any]] = {}
        confounders: dict[str, list[Mapping[str, Any]]] = {}
        for one in rounds:
            for candidate in one["ranking"]:
                if candidate["in_answer_set"]:
                    for number in candidate["numbers"]:
                        numbers.setdefault(number["parameter"], number)
                    for other in candidate.get("confounded_by", ()):
                        confounders.setdefault(other["parameter"], []).append(other)
        return cls(
            said["verdict"],
            tuple(said["answer_set"]),
            tuple(said["effects"]),
            said["final_verdict"],
            tuple(rounds[-1]["answer_set"]),
            numbers,
            _stated(said),
            confounders,
        )


def _stated(said: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """The model's numbers as the verdict states them."""
    along = [c["along"] for c in said["rounds"][-1]["ranking"] if c["in_answer_set"] and c.get("along")]
    named = said["final_verdict"] == "artefact" and along
    return tuple(along[0] if named else said["parameters"])


def matches(name: str, patterns: Iterable[str]) -> bool:
    """Whether a name fits one of the patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def judge(answer: Answer, should: Should, truths: Mapping[str, float]) -> Judgement:
    """Hold an answer against what is right to say."""
    names = answer.answer_set
    alone = len(names) == 1 and answer.verdict in ("missing", "artefact", "ambiguous")
    wrong_name = alone and not matches(names[0], should.true)
    why = _wrong(answer, should, truths.get("visible_sigma", math.inf)) or _missed_size(answer, should, truths)
    if wrong_name and not why:
        why = f"{names[0]} is not what it is"
    return Judgement(not why, wrong_name, why)


def _wrong(answer: Answer, should: Should, visible: float) -> str:
    """What is wrong with verdict and names, in words; blank if nothing."""
    names = answer.answer_set
    if answer.verdict == "adequate" and visible < FAINT:
        return ""
    if answer.verdict not in should.verdicts:
        return f"said {answer.verdict}"
    barred = [name for name in names if matches(name, should.none_of)]
    if barred:
        return "holds " + ", ".join(barred)
    if answer.verdict == "adequate":
        return ""
    if should.any_of and not any(matches(name, should.any_of) for name in names):
        return "holds none of " + ", ".join(should.any_of)
    found = (*names, *answer.effects)
    lacking = [pattern for pattern in should.all_of if not any(fnmatchcase(name, pattern) for name in found)]
    if lacking and answer.verdict == "ambiguous":
        return "lacks " + ", ".join(lacking)
    others = [name for name in names if should.only and not matches(name, should.only)]
    return "holds " + ", ".join(others) if others else ""


def _missed_size(answer: Answer, should: Should, truths: Mapping[str, float]) -> str:
    if answer.verdict != "missing":
        return ""
    for key in should.holds:
        number = answer.numbers.get(key)
        if number is None or key not in truths:
            continue
        low, high = number["low_95"], number["high_95"]
        for other in answer.confounders.get(key, ()):
            low, high = min(low, other["low_95"]), max(high, other["high_95"])
        if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
            continue
        if not low <= truths[key] <= high:
            return f"{key} {number['value']:.4g} [{low:.4g}, {high:.4g}] for {truths[key]:.4g}"
    return ""
