"""The diagnosis of `diagnosis.json` in sentences: what is missing, how sure that is, and what adding it changed.

The page, the figures and the explorer take these sentences; `verdict_text` prints a diagnosis that is still in memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number, with_error
from vinetrack.core.units import display_unit
from vinetrack.narrative.between_text import difference_headline, trials_differ

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
    "missing": "An effect is missing from the model. It was identified, added, and the model fitted again.",
    "ambiguous": "An effect is missing, and these trials cannot tell which of a few it is: nothing was added. "
    "The next trial, which would tell them apart, is below.",
    "artefact": "The misfit is explained by a fault of the measurement, not by physics: nothing was added. "
    "Correct the measurement first.",
    "adequate": "Every candidate was tested, and none improves the fit significantly. "
    "Upper limits on the size of each are listed below.",
    "unexplained": "The misfit exceeds the replicate scatter, and no effect of the catalogue explains it. "
    "The missing force is drawn below.",
}
"""What each verdict means."""

TRIALS_DIFFER = (
    "What the model misses is a difference between trials, not physics: nothing was added. What to do is said below."
)

THEREAFTER = {
    "missing": "A further effect is still missing.",
    "ambiguous": "A further effect is missing, and these trials cannot tell which.",
    "artefact": "The remaining misfit is explained by a fault of the measurement.",
    "adequate": "With it, no further effect can be detected.",
    "unexplained": "With it, the model still fails, and no effect of the catalogue explains the remaining misfit.",
}
"""The verdict on the model with all added effects."""


@dataclass(frozen=True)
class Fact:
    """One number of the first screen: the question it answers, the answer, and a line below it."""

    question: str
    answer: str
    note: str = ""


def plain(effect: str) -> str:
    """Return the name of an effect with blanks for its underscores.

    Parameters
    ----------
    effect : name with underscores.

    Returns
    -------
    str
    """
    return str(effect).replace("_", " ")


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names of effects as a sentence lists them, with blanks for underscores: `air drag, leak or gravity`.

    Parameters
    ----------
    names : with underscores.
    last : the conjunction before the last name.

    Returns
    -------
    str
    """
    return joined([plain(name) for name in names], last)


def joined(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them; blank for none.

    Parameters
    ----------
    names : any texts.
    last : the conjunction before the last one.

    Returns
    -------
    str

    >>> joined(["leak", "air_drag", "gravity"], "or")
    'leak, air_drag or gravity'
    """
    return f"{', '.join(names[:-1])} {last} {names[-1]}" if len(names) > 1 else "".join(names)


def sentence(diagnosis: Mapping[str, Any]) -> str:
    """Return the verdict in one sentence.

    Parameters
    ----------
    diagnosis : content of `diagnosis.json`.

    Returns
    -------
    str
    """
    verdict, answers = diagnosis.get("verdict"), list(diagnosis.get("answer_set") or [])
    added = list(diagnosis.get("effects") or [])
    if verdict == "missing":
        return f"Missing from the model: {listed(added or answers, 'and')}."
    if verdict == "ambiguous":
        return f"Missing from the model: {listed(answers, 'or')}. These trials cannot tell which."
    if verdict == "artefact" and trials_differ(answers):
        return f"Trials differ, the physics holds: {difference_headline(answers)}."
    if verdict == "artefact":
        return f"A fault of the measurement, not of the physics: {listed(answers, 'or')}."
    if verdict == "adequate":
        return "No missing effect can be detected."
    if verdict == "unexplained":
        return "The model fails, and no effect of the catalogue explains it."
    return "No diagnosis could be made."


def meaning(diagnosis: Mapping[str, Any]) -> str:
    """Return what the verdict means, and the verdict on the model with all added effects.

    Parameters
    ----------
    diagnosis : content of `diagnosis.json`.

    Returns
    -------
    str
    """
    text = MEANINGS.get(str(diagnosis.get("verdict")), str(diagnosis.get("refused") or ""))
    if diagnosis.get("verdict") == "artefact" and trials_differ(list(diagnosis.get("answer_set") or [])):
        text = TRIALS_DIFFER
    added = list(diagnosis.get("effects") or [])
    then = THEREAFTER.get(str(diagnosis.get("final_verdict")), "") if added else ""
    return f"{text} {then.replace('With it,', 'With them,') if len(added) > 1 else then}".strip()


def facts(diagnosis: Mapping[str, Any], ladder: pd.DataFrame | None) -> list[Fact]:
    """Return significance, size and change of the error: as many numbers as the verdict has.

    Parameters
    ----------
    diagnosis : content of `diagnosis.json`.
    ladder : `ladder.csv`; None where there is none.

    Returns
    -------
    list of Fact
    """
    first = (diagnosis.get("rounds") or [{}])[0]
    ranking = list(first.get("ranking") or [])
    entries = [
        _significance(diagnosis, ranking),
        *_sizes(diagnosis),
        _upper_limits(diagnosis),
        *_errors(ladder),
        *_exponent(diagnosis),
    ]
    return [fact for fact in entries if fact is not None]


def known(value: Any) -> bool:
    """Return whether a value of a JSON file is a finite number.

    Parameters
    ----------
    value : of any type.

    Returns
    -------
    bool
    """
    return isinstance(value, int | float) and math.isfinite(value)


def _significance(diagnosis: Mapping[str, Any], ranking: Sequence[Mapping[str, Any]]) -> Fact | None:
    verdict = diagnosis.get("verdict")
    tested = [row for row in ranking if known(row.get("delta_chi2"))]
    others = [row for row in tested if not row.get("in_answer_set")]
    best = max(tested, key=lambda row: float(row["delta_chi2"]), default=None)
    if verdict == "adequate":
        # By the score: a predicted gain may belong to a size of the wrong sign.
        scored = [row for row in ranking if known(row.get("sigma"))]
        best = max(scored, key=lambda row: abs(float(row["sigma"])), default=None)
        note = f"the best of {len(scored)} candidates: {plain(best['effect'])}" if best else ""
        return Fact("Most significant candidate", f"{_sigmas(best)} σ", note) if best else None
    if verdict == "unexplained" and best is not None:
        note = f"{_sigmas(best)} σ better" + (f", but {best['reason']}" if best.get("reason") else "")
        return Fact("Nearest candidate", plain(best["effect"]), note)
    inside = [row for row in tested if row.get("in_answer_set")]
    best = max(inside, key=lambda row: float(row["delta_chi2"]), default=None)
    if best is None:
        return None
    tried = sum(row.get("status") != "not testable here" for row in ranking)
    note = f"of {tried} candidates tested" if tried > 1 else "the only candidate"
    note = f"{len(inside)} of {tried} candidates fit equally well" if len(inside) > 1 else note
    rival = max(others, key=lambda row: float(row["delta_chi2"]), default=None)
    if rival is not None:
        behind = float(best["delta_chi2"]) - float(rival["delta_chi2"])
        # An implausible candidate, or one predicted and not fitted, may have the larger Δχ².
        note = f"next best: {plain(rival['effect'])}" + (f", worse by Δχ² = {number(behind)}" if behind > 0 else "")
        note += "" if rival.get("plausible", True) else ", not plausible"
    return Fact("Significance", f"{_sigmas(best)} σ", note)


def _sigmas(row: Mapping[str, Any]) -> str:
    sigma = row.get("sigma")
    sigma = abs(float(sigma)) if known(sigma) and sigma is not None else math.sqrt(max(float(row["delta_chi2"]), 0.0))
    return f"{sigma:.0f}" if sigma >= 9.5 else f"{sigma:.1f}"


def size(entry: Mapping[str, Any]) -> str:
    """Return a fitted number with its error in its display unit: `γ = 1.170 ± 0.004`.

    Parameters
    ----------
    entry : a number of `diagnosis.json` or `fit.json`: `symbol, value, sigma, unit` (SI) and `vine` where it has one.

    Returns
    -------
    str
    """
    unit, factor = display_unit(entry["unit"])
    sigma = factor * float(entry["sigma"]) if known(entry.get("sigma")) else None
    vine = f" ({entry['vine']})" if entry.get("vine") else ""
    return f"{entry['symbol']}{vine} = {with_error(factor * float(entry['value']), sigma)} {unit}".strip()


def sizes(row: Mapping[str, Any]) -> str:
    """Return all fitted numbers of an entry of a ranking.

    Parameters
    ----------
    row : an entry of `ranking` in `diagnosis.json`.

    Returns
    -------
    str, blank where it has no fitted number
    """
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


def _upper_limits(diagnosis: Mapping[str, Any]) -> Fact | None:
    if diagnosis.get("verdict") != "adequate":
        return None
    first = (diagnosis.get("rounds") or [{}])[0]
    bounded = [row for row in first.get("ranking") or [] if row.get("largest")]
    if not bounded:
        return None
    return Fact("Upper limits", f"{len(bounded)} candidates", "the largest undetected size of each is listed below")


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
    return [Fact(what, answer, f"replicate scatter {number(floor)} mm" if math.isfinite(floor) else "")]


def _exponent(diagnosis: Mapping[str, Any]) -> list[Fact]:
    """The damping exponent of the final model."""
    for entry in diagnosis.get("parameters") or []:
        if entry["parameter"] == "eversion_damping.n" and known(entry.get("value")):
            return [Fact("Damping exponent", size(entry), _interval(entry))]
    return []
