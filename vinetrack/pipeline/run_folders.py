"""The folders of a run: an experiment's, found or the nearest named, and that of its results, which are of no other."""

from __future__ import annotations

import difflib
import json
import os
import re
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem

PACKAGE = Path(__file__).parents[1]

CLAIM_FILE = "experiment.json"
"""File of a results folder that names its experiment from the beginning of a run; `provenance.json` comes last."""


def find_experiment(folder: Path) -> Path:
    """Return `folder` if it exists; else raise an ExperimentError that names the nearest folder that does.

    Parameters
    ----------
    folder : Path
        As the user named it.

    Returns
    -------
    Path

    Raises
    ------
    ExperimentError
        If it does not exist.
    """
    if folder.exists():
        return folder
    parent = folder.absolute().parent
    while not parent.is_dir():
        parent = parent.parent
    folders = sorted(path.name for path in parent.iterdir() if path.is_dir() and not path.name.startswith("."))
    wanted = folder.absolute().relative_to(parent).parts[0]
    near = difflib.get_close_matches(wanted, folders, 1, 0.5)
    sheets = [name for name in folders if (parent / name / "trials.csv").is_file()][:3]
    if near:
        remedy = f"did you mean {_shown(parent / near[0])}?"
    elif sheets:
        remedy = f"there is {', '.join(_shown(parent / name) for name in sheets)}"
    else:
        remedy = f"the nearest that exists is {_shown(parent)}"
    raise ExperimentError([Problem(message="does not exist", file=str(folder), remedy=remedy)])


def _shown(path: Path) -> str:
    return os.path.relpath(path)


def find_ground_truth(folder: Path, base: Path) -> Path | None:
    """What is true in an experiment that is shipped with a sheet alone; None for a folder of anybody's own.

    The virtual laboratory has a file for each folder of `data/` that it makes, by the same name.

    Parameters
    ----------
    folder : of an experiment.
    base : the checkout in which `data/` may lie.

    Returns
    -------
    nature : the file of what is true.
    """
    for nature in sorted((PACKAGE / "laboratory").glob("*.yaml")):
        shipped = base / "data" / nature.stem
        if folder.exists() and shipped.exists() and folder.samefile(shipped):
            return nature
    return None


def refuse_shared_results(results: Path, experiment: Path) -> None:
    """Refuse a results folder that holds another experiment's.

    Parameters
    ----------
    results : the folder, which need not exist.
    experiment : whose results are to go there.

    Raises
    ------
    ExperimentError
        If what is there was made from another experiment that still exists, naming both.
    """
    for name in ("provenance.json", CLAIM_FILE):
        try:
            made_from = Path(str(json.loads((results / name).read_text(encoding="utf-8"))["experiment"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if made_from.is_dir() and experiment.is_dir() and not made_from.samefile(experiment):
            message = f"holds the results of {made_from}, not of {experiment.absolute()}"
            remedy = "name another folder (vinetrack run --results DIR, snakemake --config results=DIR), or rename one"
            raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)])


def claim_results(results: Path, experiment: Path) -> None:
    """Write down whose results a folder holds, before the first of them.

    Parameters
    ----------
    results : the folder, made where it does not exist.
    experiment : whose they are.
    """
    from vinetrack.core.tables import write_json

    write_json(results / CLAIM_FILE, {"experiment": experiment.absolute().as_posix()})


def path_problems(*folders: Path) -> list[Problem]:
    """What is wrong with the names of folders, which Snakemake would say in its own words.

    Parameters
    ----------
    folders : of an experiment or of results.

    Returns
    -------
    problems : an error for each that has braces or a word in angle brackets in its path.
    """
    return [
        Problem(
            message="has a brace or a word in < > in its path, which Snakemake cannot read", file=str(folder),
            remedy="rename the folder, or run the stages one by one with vinetrack",
        )
        for folder in folders
        if has_wildcard(folder)
    ]  # fmt: skip


def has_wildcard(path: Path) -> bool:
    """Whether Snakemake would take part of a path for a wildcard or a variable; it has no way to write such marks.

    Parameters
    ----------
    path : any.

    Returns
    -------
    bool
    """
    return re.search(r"[{}]|<\w+>", str(path)) is not None
