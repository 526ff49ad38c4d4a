"""The notebook of the documentation runs, and shows what is stored in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from notebook import run

pytestmark = pytest.mark.slow

NOTEBOOK = Path(__file__).parents[2] / "docs" / "python.ipynb"


def kinds(outputs: list[dict[str, Any]]) -> list[list[str]]:
    return [sorted(one.get("data", one)) for one in outputs]


def test_every_cell_runs_and_shows_what_is_stored() -> None:
    shown = [one for outputs in run(NOTEBOOK) for one in outputs]
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    stored = [one for cell in cells for one in cell.get("outputs", [])]
    assert kinds(shown) == kinds(stored)
    assert sum("image/png" in kind for kind in kinds(shown)) == 3
    texts = [["".join(one["data"]["text/plain"]) for one in each if "data" in one] for each in (shown, stored)]
    objects = [[text for text in each if text.startswith(("Fit(", "Diagnosis("))] for each in texts]
    assert objects[0] == objects[1]
    assert objects[0][1] == "Diagnosis(missing: reservoir_depletion)"
    printed = [["".join(one["text"]) for one in each if "text" in one] for each in (shown, stored)]
    assert printed[0] == printed[1]
    assert "n = 0.369 instead of" in printed[0][0]
