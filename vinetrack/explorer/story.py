"""What a diagnosis found, for the page: read from `diagnosis.json` where there is one, and said where there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vinetrack.results.folder_layout import ResultsError, read_json

DIAGNOSIS = "diagnosis.json"


@dataclass(frozen=True)
class Suspect:
    """A candidate of the ranking: by how much −2 ln L falls with it, and whether the data cannot exclude it."""

    effect: str
    delta_chi2: float
    in_answer_set: bool
    reason: str


@dataclass(frozen=True)
class Story:
    """The first round of a diagnosis, and what to do next. `cosines` is a matrix in the order of `cosine_names`."""

    verdict: str
    explanation: str
    answer_set: tuple[str, ...]
    suspects: tuple[Suspect, ...]
    cosine_names: tuple[str, ...]
    cosines: tuple[tuple[float, ...], ...]
    next_experiment: Mapping[str, Any] | None

    @property
    def best(self) -> tuple[str, ...]:
        """Effects worth trying first, best first."""
        ranked = [one.effect for one in self.suspects if math.isfinite(one.delta_chi2)]
        return tuple(dict.fromkeys([*self.answer_set, *ranked]))

    def most_tied(self, least: float = 0.7) -> list[tuple[str, str, float]]:
        """Pairs of candidates whose marks look alike, |cosine| of `least` or more, closest first."""
        pairs = [
            (one, other, self.cosines[i][k])
            for i, one in enumerate(self.cosine_names)
            for k, other in enumerate(self.cosine_names[:i])
            if abs(self.cosines[i][k]) >= least
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))


def read_story(folder: Path) -> Story | None:
    """The diagnosis of a results folder, None where there is none or it cannot be understood."""
    path = folder / DIAGNOSIS
    if not path.exists():
        return None
    try:
        content = read_json(path)
        rounds: Sequence[Mapping[str, Any]] = content.get("rounds") or [{}]
        cosines = content.get("cosines") or rounds[0].get("cosines") or {}
        return Story(
            verdict=str(content["verdict"]),
            explanation=str(content.get("explanation", "")),
            answer_set=tuple(content.get("answer_set", ())),
            suspects=tuple(_suspect(entry) for entry in rounds[0].get("ranking", ())),
            cosine_names=tuple(cosines.get("effects", ())),
            cosines=tuple(tuple(_number(value) for value in row) for row in cosines.get("matrix", ())),
            next_experiment=content.get("next_experiment"),
        )
    except (ResultsError, KeyError, TypeError, AttributeError, ValueError):
        return None


def _suspect(entry: Mapping[str, Any]) -> Suspect:
    return Suspect(
        effect=str(entry["effect"]),
        delta_chi2=_number(entry.get("delta_chi2")),
        in_answer_set=bool(entry.get("in_answer_set")),
        reason=str(entry.get("reason", "")),
    )


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
