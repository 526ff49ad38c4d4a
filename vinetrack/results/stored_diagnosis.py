"""Reading the diagnosis of a results folder as a typed object; the only reader of `diagnosis.json`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, read_json, read_result
from vinetrack.results.stored_fit import unreadable_file_error

if TYPE_CHECKING:
    from vinetrack.diagnosis.result import Diagnosis


def read_diagnosis(results: Results) -> Diagnosis | None:
    """Read `diagnosis.json` and `ladder.csv`."""
    from vinetrack.diagnosis.result import Diagnosis

    if not results.diagnosis.exists():
        return None
    content = read_json(results.diagnosis)
    ladder = read_result(results.ladder) if results.ladder.exists() else None
    try:
        return Diagnosis.from_json(content, ladder if ladder is not None and len(ladder) else None)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unreadable_file_error(results.diagnosis, error) from None
