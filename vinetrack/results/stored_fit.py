"""Reading the fit of a results folder as a typed object; the only reader of `fit.json`.

The diagnosis has a module of its own, `stored_diagnosis`, because the stage of the model reads fits and must not rerun
when the text of a diagnosis changes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from vinetrack.inference.fit_summary import FitSummary


def read_fit(results: Results) -> FitSummary:
    """Read `fit.json`."""
    from vinetrack.inference.fit_summary import FitSummary

    content = read_json(results.fit)
    try:
        return FitSummary.from_json(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unreadable_file_error(results.fit, error) from None


def unreadable_file_error(path: Path, error: Exception) -> ResultsError:
    """Return the error for a file of the results with unexpected content."""
    return ResultsError(f"{path} cannot be read ({error!r}): delete it and run snakemake again")
