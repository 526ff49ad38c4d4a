"""Work that is counted instead of timed: a count is the same on every machine, and on one that is busy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from vinetrack.inference.sensitivity import Predictor


def trajectories(patch: pytest.MonkeyPatch) -> list[int]:
    """How many trajectories each later call simulates; the list grows as fits and predictions are made."""
    counts: list[int] = []
    simulate = Predictor._simulated

    def counted(self: Predictor, model: Any, jobs: Sequence[Any], *more: Any) -> Any:
        counts.append(len(jobs))
        return simulate(self, model, jobs, *more)

    patch.setattr(Predictor, "_simulated", counted)
    return counts
