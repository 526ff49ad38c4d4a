"""The command `vinetrack setup` without its page: the two files with blanks to fill."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.experiment.folder import SETTINGS, check_experiment
from vinetrack.experiment.sheet import SHEET
from vinetrack.setup_page.draft_files import open_draft, write_draft


def write_templates(folder: Path, say: Callable[[str], None]) -> None:
    """Write the sheet and settings of a folder of recordings, with blanks to fill; existing content is kept."""
    draft = open_draft(folder)
    written = write_draft(folder, draft)
    rows = draft.sheet.rows
    filled = [name for name in draft.sheet.columns if name not in ("trial", "video") and any(r.get(name) for r in rows)]
    for name in written:
        say(f"Written: {folder / name}")
    if not written:
        say(f"{SHEET} and {SETTINGS} of {folder} already contain every recording.")
    say(f"{len(rows)} trials; from the names of recordings: {', '.join(filled) if filled else 'nothing'}.")
    blanks = sorted({problem.column for problem in _missing(folder) if problem.column}, key=_place)
    if blanks:
        say(f"To fill in: {', '.join(blanks)}. A value that all trials share goes into {SETTINGS}.")
    say(f"Then: vinetrack check {folder}")


def _missing(folder: Path) -> list[Problem]:
    """What is still missing in the files."""
    problems = [problem for problem in check_experiment(folder) if problem.severity == "error"]
    missing = [problem for problem in problems if problem.message in ("is missing", "is blank")]
    try:
        from vinetrack.experiment.settings import read_experiment_settings

        if read_experiment_settings(folder / SETTINGS).calibration is None:
            missing.append(Problem(message="is missing", file=SETTINGS, column="calibration"))
    except ExperimentError:
        pass
    return missing


def _place(column: str) -> int:
    from vinetrack.experiment.schema import COLUMNS

    return list(COLUMNS).index(column) if column in COLUMNS else len(COLUMNS)
