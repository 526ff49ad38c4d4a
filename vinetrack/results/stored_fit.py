"""The fit of a results folder, read back as a typed object; the diagnosis: `stored_diagnosis`.

Pipeline, report, explorer and the Python interface read `fit.json` here and nowhere else; its keys stand in the class,
beside what writes them. Two modules, because the stage of the model reads a fit and must not run again when sentences
of a diagnosis change.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from vinetrack.inference.fit_summary import FitSummary


def read_fit(results: Results) -> FitSummary:
    """Read `fit.json`.

    Parameters
    ----------
    results : the folder.

    Returns
    -------
    FitSummary
        `refused` holds the reason where the model could not be fitted.

    Raises
    ------
    ResultsError
        If the model has not been fitted there, or the file is not one of ours.
    """
    from vinetrack.inference.fit_summary import FitSummary

    content = read_json(results.fit)
    try:
        return FitSummary.from_json(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unreadable_file_error(results.fit, error) from None


def unreadable_file_error(path: Path, error: Exception) -> ResultsError:
    """Return what is said of a file of the results that does not hold what it should.

    Parameters
    ----------
    path : the file.
    error : what went wrong in reading it.

    Returns
    -------
    ResultsError
    """
    return ResultsError(f"{path} cannot be read ({error!r}): delete it and run snakemake again")
