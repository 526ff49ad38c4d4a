"""What a results folder was made from, and which run owns it: only one writes it at a time, and a killed run does not
block the next one.

A run holds a lock of the operating system as long as its process lives. Snakemake's own locks are files, which stay
when a run is killed; the profile and `vinetrack run` do without them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import time
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vinetrack
from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import PROVENANCE, write_text

if TYPE_CHECKING:
    from filelock import FileLock

CLAIM_FILE = "experiment.json"  # File of a results folder that names its experiment from the start of a run


def refuse_shared_results(results: Path, experiment: Path) -> None:
    """Refuse a results folder that holds the results of another experiment."""
    other = "choose another results folder (vinetrack run --results DIR, snakemake --config results=DIR)"
    for name in (PROVENANCE, CLAIM_FILE):
        made_from = Path(str(claim(results / name).get("experiment", "")))
        if made_from.name and made_from.is_dir() and experiment.is_dir() and not made_from.samefile(experiment):
            message = f"holds the results of {made_from}, not of {experiment.absolute()}"
            remedy = f"{other}, or rename one of the two"
            raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)])


def claim(path: Path) -> dict[str, Any]:
    """Read what a file of the results says of its experiment; empty where there is nothing readable."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        return dict(json.loads(path.read_text(encoding="utf-8")))
    return {}


def locked(results: Path) -> FileLock:
    """Return the lock of a results folder, held by this process."""
    from filelock import FileLock, Timeout

    results.mkdir(parents=True, exist_ok=True)
    lock = FileLock(results.absolute() / ".run.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        process = claim(results / CLAIM_FILE).get("process", "unknown")
        message, remedy = f"is being written by another run, process {process}", "wait until it ends, or stop it"
        raise ExperimentError([Problem(message=message, file=str(results), remedy=remedy)]) from None
    return lock


def begin_run(results: Path, experiment: Path) -> FileLock:
    """Make this process the owner of a results folder until it ends, record that, and clean up after a killed run."""
    lock = locked(results)
    claim = {"experiment": experiment.absolute().as_posix(), "process": os.getpid()}
    write_text(results / CLAIM_FILE, json.dumps(claim))
    unfinished = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?")  # names of files that are being written
    for path in [*results.rglob("*"), *experiment.glob("*")]:
        with contextlib.suppress(OSError):
            # 60.0: age from which an unfinished file counts as abandoned; others may be written now (chosen)
            if unfinished.fullmatch(path.name) and time.time() - path.stat().st_mtime >= 60.0:
                path.unlink()
    return lock


def describe_run(
    experiment: Path, inputs: Iterable[Path], settings: dict[str, Any], model: Iterable[str]
) -> dict[str, Any]:
    """Return the content of `provenance.json`: versions, platform, SHA-256 of every input, model, settings."""
    libraries = ("numpy", "scipy", "pandas", "numba", "av", "matplotlib", "opencv-python-headless")
    return {
        "vinetrack": vinetrack.__version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "libraries": {name: version(name) for name in libraries},
        "experiment": experiment.absolute().as_posix(),
        "inputs": {
            (path.relative_to(experiment) if path.is_relative_to(experiment) else path).as_posix(): _hash_file(path)
            for path in inputs
        },
        "model": list(model),
        "settings": settings,
    }


def _hash_file(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of a folder of frames; else "missing" or "unreadable"."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        lines = [f"{file.relative_to(path).as_posix()} {_hash_file(file)}\n" for file in files]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if not path.is_file():
        return "missing"
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "unreadable"
