"""The fit and the diagnosis of a results folder, read back as typed objects.

Report, figures, explorer and the Python interface read `fit.json` and `diagnosis.json` here and nowhere else; the keys
stand in the classes, beside what writes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json, read_result

if TYPE_CHECKING:
    from vinetrack.diagnosis.result import Diagnosis
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
        raise _broken(str(results.fit), error) from None


def read_diagnosis(results: Results) -> Diagnosis | None:
    """Read `diagnosis.json` and `ladder.csv`.

    Parameters
    ----------
    results : the folder.

    Returns
    -------
    Diagnosis or None
        None where there is none; `refused` holds the reason where none could be made.

    Raises
    ------
    ResultsError
        If the file is not one of ours.
    """
    from vinetrack.diagnosis.result import Diagnosis

    if not results.diagnosis.exists():
        return None
    content = read_json(results.diagnosis)
    ladder = read_result(results.ladder) if results.ladder.exists() else None
    try:
        return Diagnosis.from_json(content, ladder if ladder is not None and len(ladder) else None)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _broken(str(results.diagnosis), error) from None


def _broken(path: str, error: Exception) -> ResultsError:
    return ResultsError(f"{path} cannot be read ({error!r}): delete it and run snakemake again")
