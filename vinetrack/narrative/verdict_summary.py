"""The first screen: what is missing from the model, how sure that is, and what adding it did, in words for anybody."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number, with_error
from vinetrack.core.units import display_unit

if TYPE_CHECKING:
    import pandas as pd

BADGES = {
    "missing": "missing",
    "ambiguous": "ambiguous",
    "artefact": "artefact",
    "adequate": "adequate",
    "unexplained": "unexplained",
    "none": "not diagnosed",
}

MEANINGS = {
    "missing": "An effect is missing from the model. It was found, added, and the model fitted again.",
    "ambiguous": "An effect is missing, and these trials cannot tell which of a few it is: nothing was added. "
    "The next trial that would tell is below.",
    "artefact": "What the model misses looks like a fault of the measurement, not like physics: nothing was added. "
    "Mend the measurement first.",
    "adequate": "Every candidate was tried, and none explains the trajectories noticeably better. "
    "How large each could still be is listed below.",
    "unexplained": "The model fails beyond what replicates differ by, and no effect of the catalogue mends it. "
    "The force that is missing is drawn below.",
}
"""What each verdict means."""

THEREAFTER = {
    "missing": "Something else is still missing.",
    "ambiguous": "What is then still missing cannot be told from these trials.",
    "artefact": "What is then left looks like a fault of the measurement.",
    "adequate": "With it, nothing more can be detected.",
    "unexplained": "Even then the model fails, and nothing in the catalogue mends the rest.",
}
"""How the model with everything added stands."""


@dataclass(frozen=True)
class Fact:
    """A number that answers one question of the first screen, with a line below it."""

    question: str
    answer: str
    note: str = ""


def plain(effect: str) -> str:
    """The name of an effect as a person says it."""
    return str(effect).replace("_", " ")


def listed(names: Sequence[str], last: str = "and") -> str:
    """Names of effects in a row: `air drag, leak or gravity`."""
    said = [plain(name) for name in names]
    if len(said) < 2:
        return "".join(said)
    return f"{', '.join(said[:-1])} {last} {said[-1]}"


def sentence(diagnosis: Mapping[str, Any]) -> str:
    """The verdict in one sentence."""
    verdict, answers = diagnosis.get("verdict"), list(diagnosis.get("answer_set") or [])
    added = list(diagnosis.get("effects") or [])
    if verdict == "missing":
        return f"Missing from the model: {listed(added or answers, 'and')}."
    if verdict == "ambiguous":
        return f"Missing from the model: {listed(answers, 'or')}. These trials cannot tell which."
    if verdict == "artefact":
        return f"The measurement is at fault, not the physics: {listed(answers, 'or')}."
    if verdict == "adequate":
        return "Nothing missing from the model can be detected."
    if verdict == "unexplained":
        return "The model fails, and nothing in the catalogue mends it."
    return "No diagnosis could be made."


def meaning(diagnosis: Mapping[str, Any]) -> str:
    """What the verdict means, and how the model stands with everything added."""
    said = MEANINGS.get(str(diagnosis.get("verdict")), str(diagnosis.get("refused") or ""))
    added = list(diagnosis.get("effects") or [])
    then = THEREAFTER.get(str(diagnosis.get("final_verdict")), "") if added else ""
    return f"{said} {then.replace('With it,', 'With them,') if len(added) > 1 else then}".strip()


def facts(diagnosis: Mapping[str, Any], ladder: pd.DataFrame | None) -> list[Fact]:
    """How sure, how large, and what it did to the error; as many as the verdict allows."""
    first = (diagnosis.get("rounds") or [{}])[0]
    ranking = list(first.get("ranking") or [])
    found = [_sure(diagnosis, ranking), *_sizes(diagnosis), _hidden(diagnosis), *_errors(ladder), *_moved(diagnosis)]
    return [fact for fact in found if fact is not None]


def known(value: Any) -> bool:
    """Whether a value of a JSON file is a number."""
    return isinstance(value, int | float) and math.isfinite(value)


def _sure(diagnosis: Mapping[str, Any], ranking: Sequence[Mapping[str, Any]]) -> Fact | None:
    verdict = diagnosis.get("verdict")
    tested = [row for row in ranking if known(row.get("delta_chi2"))]
    others = [row for row in tested if not row.get("in_answer_set")]
    best = max(tested, key=lambda row: float(row["delta_chi2"]), default=None)
    if verdict == "adequate":
        # By the score: what was only predicted may gain much with the wrong sign, and that counts for nothing.
        scored = [row for row in ranking if known(row.get("sigma"))]
        best = max(scored, key=lambda row: abs(float(row["sigma"])), default=None)
        note = f"the best of {len(scored)} candidates: {plain(best['effect'])}" if best else ""
        return Fact("Most suspicious", f"{_sigmas(best)} σ", note) if best else None
    if verdict == "unexplained" and best is not None:
        note = f"{_sigmas(best)} σ better" + (f", but {best['reason']}" if best.get("reason") else "")
        return Fact("Nearest candidate", plain(best["effect"]), note)
    inside = [row for row in tested if row.get("in_answer_set")]
    best = max(inside, key=lambda row: float(row["delta_chi2"]), default=None)
    if best is None:
        return None
    tried = sum(row.get("status") != "not testable here" for row in ranking)
    note = f"{tried} candidates were tried" if tried > 1 else "it was the only candidate"
    note = f"{len(inside)} of {tried} candidates fit alike" if len(inside) > 1 else note
    rival = max(others, key=lambda row: float(row["delta_chi2"]), default=None)
    if rival is not None:
        behind = float(best["delta_chi2"]) - float(rival["delta_chi2"])
        # Another's Δχ² may be the larger where it is implausible, or was predicted and not fitted.
        note = f"next best: {plain(rival['effect'])}" + (f", worse by Δχ² = {number(behind)}" if behind > 0 else "")
        note += "" if rival.get("plausible", True) else ", not plausible"
    return Fact("How sure", f"{_sigmas(best)} σ", note)


def _sigmas(row: Mapping[str, Any]) -> str:
    sigma = row.get("sigma")
    sigma = abs(float(sigma)) if known(sigma) and sigma is not None else math.sqrt(max(float(row["delta_chi2"]), 0.0))
    return f"{sigma:.0f}" if sigma >= 9.5 else f"{sigma:.1f}"


def size(entry: Mapping[str, Any]) -> str:
    """A fitted number with its error, in a unit that reads well: `γ = 1.170 ± 0.004`."""
    unit, factor = display_unit(entry["unit"])
    sigma = factor * float(entry["sigma"]) if known(entry.get("sigma")) else None
    vine = f" ({entry['vine']})" if entry.get("vine") else ""
    return f"{entry['symbol']}{vine} = {with_error(factor * float(entry['value']), sigma)} {unit}".strip()


def sizes(row: Mapping[str, Any]) -> str:
    """All fitted numbers of a candidate."""
    return ", ".join(size(entry) for entry in row.get("numbers") or [] if known(entry.get("value")))


def _sizes(diagnosis: Mapping[str, Any]) -> list[Fact]:
    """The size of every effect that was added, at the end; of those in the answer set where none was."""
    added = list(diagnosis.get("effects") or [])
    if added:
        numbers = list(diagnosis.get("parameters") or [])
        of = {name: [n for n in numbers if str(n["parameter"]).split(".")[0] == name] for name in added}
        return [Fact(f"Size of {plain(name)}", size(of[name][0]), _interval(of[name][0])) for name in added if of[name]]
    first = (diagnosis.get("rounds") or [{}])[0]
    members = [row for row in first.get("ranking") or [] if row.get("in_answer_set") and row.get("numbers")]
    return [Fact(f"If {plain(row['effect'])}", sizes(row)) for row in members[:3]]


def _interval(entry: Mapping[str, Any]) -> str:
    unit, factor = display_unit(entry["unit"])
    if not (known(entry.get("low_95")) and known(entry.get("high_95"))):
        return "95 %: open"
    low, high = (factor * float(entry[key]) for key in ("low_95", "high_95"))
    return f"95 %: {number(low, 4)} to {number(high, 4)} {unit}".strip()


def _hidden(diagnosis: Mapping[str, Any]) -> Fact | None:
    if diagnosis.get("verdict") != "adequate":
        return None
    first = (diagnosis.get("rounds") or [{}])[0]
    bounded = [row for row in first.get("ranking") or [] if row.get("largest")]
    if not bounded:
        return None
    return Fact(
        "What could still hide", f"{len(bounded)} candidates bounded", "the largest size of each is listed below"
    )


def _errors(ladder: pd.DataFrame | None) -> list[Fact]:
    if ladder is None or not len(ladder):
        return []
    first, last = ladder.iloc[0], ladder.iloc[-1]
    key, what = "rms_left_out_m", "Error on conditions left out"
    if not math.isfinite(float(first[key])):
        key, what = "rms_in_sample_m", "Error of position"
    before, floor = 1e3 * float(first[key]), 1e3 * float(last["floor_m"])
    answer = f"{number(before)} mm"
    if len(ladder) > 1:
        answer = f"{number(before)} → {number(1e3 * float(last[key]))} mm"
    return [Fact(what, answer, f"replicates differ by {number(floor)} mm" if math.isfinite(floor) else "")]


def _moved(diagnosis: Mapping[str, Any]) -> list[Fact]:
    """The damping exponent of the final model."""
    for entry in diagnosis.get("parameters") or []:
        if entry["parameter"] == "eversion_damping.n" and known(entry.get("value")):
            return [Fact("Damping exponent", size(entry), _interval(entry))]
    return []
