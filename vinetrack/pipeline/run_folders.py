"""The folders of a run: that of the experiment, and that of its results, which belong to one experiment only."""

from __future__ import annotations

import difflib
import json
import os
import re
import shlex
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem

PACKAGE = Path(__file__).parents[1]

CLAIM_FILE = "experiment.json"  # File of a results folder that names its experiment from the start of a run


def find_experiment(folder: Path) -> Path:
    """Return `folder` if it exists."""
    if folder.exists():
        return folder
    parent = folder.absolute().parent
    while not parent.is_dir():
        parent = parent.parent
    folders = sorted(path.name for path in parent.iterdir() if path.is_dir() and not path.name.startswith("."))
    missing = folder.absolute().relative_to(parent).parts[0]
    close = difflib.get_close_matches(missing, folders, 1, 0.5)
    experiments = [name for name in folders if (parent / name / "trials.csv").is_file()][:3]
    if close:
        remedy = f"did you mean {_shown(parent / close[0])}?"
    elif experiments:
        remedy = f"existing experiments are {', '.join(_shown(parent / name) for name in experiments)}"
    else:
        remedy = f"the nearest existing folder is {_shown(parent)}"
    raise ExperimentError([Problem(message="does not exist", file=str(folder), remedy=remedy)])


def _shown(path: Path) -> str:
    return os.path.relpath(path)


def command_for_results(experiment: Path, results: Path) -> str:
    """Return the command that writes the results of an experiment to the folder where they are."""
    name, where = experiment.absolute().name, results.absolute()
    if where.name != name:
        return shlex.join(["snakemake", "--config", f"experiment={experiment}", f"results={results}"])
    command = ["vinetrack", "run", str(experiment)]
    beside = experiment.absolute().parent / "results"
    return shlex.join(command if where.parent == beside else [*command, "--results", _shown(where.parent)])


def find_ground_truth(folder: Path, base: Path) -> Path | None:
    """Return the ground truth of a shipped virtual experiment; None for any other folder. The virtual laboratory has a
    file for each folder of `data/` that it makes, with the same name.
    """
    for ground_truth in sorted((PACKAGE / "laboratory").glob("*.yaml")):
        shipped = base / "data" / ground_truth.stem
        if folder.exists() and shipped.exists() and folder.samefile(shipped):
            return ground_truth
    return None


def refuse_shared_results(results: Path, experiment: Path) -> None:
    """Refuse a results folder that holds the results of another experiment."""
    for name in ("provenance.json", CLAIM_FILE):
        try:
            made_from = Path(str(json.loads((results / name).read_text(encoding="utf-8"))["experiment"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if made_from.is_dir() and experiment.is_dir() and not made_from.samefile(experiment):
            message = f"holds the results of {made_from}, not of {experiment.absolute()}"
            remedy = (
                "choose another results folder (vinetrack run --results DIR, snakemake --config results=DIR), "
                "or rename one of the two"
            )
            raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)])


def claim_results(results: Path, experiment: Path) -> None:
    """Record to which experiment a results folder belongs, before the first result is written."""
    from vinetrack.core.tables import write_json

    write_json(results / CLAIM_FILE, {"experiment": experiment.absolute().as_posix()})


def path_problems(*folders: Path) -> list[Problem]:
    """Report folders whose path Snakemake would take for a pattern."""
    return [
        Problem(
            message="has braces or a word in < > in its path, which Snakemake cannot handle", file=str(folder),
            remedy="rename the folder, or run the stages one by one with vinetrack",
        )
        for folder in folders
        if has_wildcard(folder)
    ]  # fmt: skip


def has_wildcard(path: Path) -> bool:
    """Whether Snakemake would take part of a path for a wildcard or a variable, which cannot be escaped."""
    return re.search(r"[{}]|<\w+>", str(path)) is not None
