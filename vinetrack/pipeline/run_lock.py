"""Ownership of a results folder: only one run writes it at a time, and a killed run does not block the next one.

Snakemake locks the files of a run, but cannot tell later whether that run is still alive. Each run therefore records
its process and the start time of that process in its results; a process id alone may be reused by another program.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import write_text

START_TOLERANCE_S = 1.0  # Largest difference between two readings of the start time of one process (derived)
MIN_UNFINISHED_AGE_S = 60.0  # Age from which an unfinished file in the experiment folder counts as abandoned (chosen)
OWNER_FILE = ".run.json"  # File of a results folder that names the process writing it

LOCK_REMOVED = "Removed the lock of an interrupted run"
# Temporary names of files that are being written
UNFINISHED_FILES = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?|\.part-.+")


# Options of Snakemake with which it executes no jobs
NON_EXECUTING_OPTIONS = re.compile(
    r"-[a-zA-Z]*[nlhDS][a-zA-Z]*|--(dry-?run|unlock|lint|report|summary|detailed-summary|dag|rulegraph|filegraph|d3dag|list.*|help|"
    r"version|archive|print-compilation|cleanup-.*|delete-.*|containerize)(=.*)?"
)


@dataclass(frozen=True)
class RunOwner:
    """A process that runs a workflow: its id, its start time (s since 1970), and its computer."""

    pid: int
    started_s: float
    host: str

    @property
    def is_here(self) -> bool:
        """Whether it belongs to this computer, so that its state can be determined."""
        return self.host == socket.gethostname()

    @property
    def is_alive(self) -> bool:
        """Whether it is still running; a process of another computer is assumed to be."""
        if not self.is_here:
            return True
        started_s = _process_start_s(self.pid)
        return started_s is not None and abs(started_s - self.started_s) < START_TOLERANCE_S


def executes_nothing(options: Iterable[str]) -> bool:
    """Whether Snakemake executes no jobs with these options, as in a dry run, a listing, or an unlock."""
    return any(NON_EXECUTING_OPTIONS.fullmatch(option) for option in options)


def refuse_running(results: Path) -> None:
    """Refuse a results folder that another running process writes."""
    owner = _read_owner(results / OWNER_FILE)
    if owner is not None and owner.pid != os.getpid() and owner.is_alive:
        raise ExperimentError([_refusal(owner, results)])


def begin_run(results: Path, experiment: Path, working: Path, say: Callable[[str], None]) -> None:
    """Make this process the owner of a results folder, and clean up after a killed run. Removes the locks and the
    unfinished files of a run that has ended. The ownership ends with this process.
    """
    refuse_running(results)
    owner_file = (results / OWNER_FILE).absolute()  # Snakemake may change the working directory before it exits
    owner = _read_owner(owner_file)
    if owner is not None and owner.pid != os.getpid() and _remove_locks(working, results):
        say(f"{LOCK_REMOVED} (process {owner.pid}); the results that it finished are kept.")
    started_s = _process_start_s(os.getpid()) or time.time()
    write_text(owner_file, json.dumps(asdict(RunOwner(os.getpid(), started_s, socket.gethostname()))))
    atexit.register(_remove_owner_file, owner_file, os.getpid())
    clear_unfinished(results.rglob("*"))
    clear_unfinished(experiment.glob("*"), older_than_s=MIN_UNFINISHED_AGE_S)


def clear_unfinished(paths: Iterable[Path], older_than_s: float = 0.0) -> None:
    """Remove unfinished files of a program that was killed."""
    for path in [path for path in paths if UNFINISHED_FILES.fullmatch(path.name)]:
        with contextlib.suppress(OSError):
            if path.is_file() and time.time() - path.stat().st_mtime >= older_than_s:
                path.unlink()


def _remove_owner_file(owner_file: Path, pid: int) -> None:
    """Remove the owner file at exit, in the process that wrote it only, not in a fork of it."""
    if os.getpid() == pid:
        with contextlib.suppress(OSError):
            owner_file.unlink(missing_ok=True)


def _refusal(owner: RunOwner, results: Path) -> Problem:
    message = f"is being written by another run, process {owner.pid}"
    remedy = "wait until it ends, or stop it"
    if not owner.is_here:
        message += f" on the computer {owner.host}"
        remedy = f"wait until it ends; if it is no longer running, delete {results / OWNER_FILE}"
    since = time.strftime("%H:%M on %d %B", time.localtime(owner.started_s))
    return Problem(message=f"{message}, started at {since}", file=str(results), remedy=remedy)


def _read_owner(owner_file: Path) -> RunOwner | None:
    """Read the recorded owner; None if there is none, or the file cannot be read."""
    try:
        return RunOwner(**json.loads(owner_file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _remove_locks(working: Path, results: Path) -> int:
    """Remove Snakemake's locks on files of these results, not those of other results; return how many."""
    removed = 0
    inside = str(results.absolute()) + os.sep
    for lock in sorted((working / ".snakemake" / "locks").glob("*.lock")):
        with contextlib.suppress(OSError):
            files = lock.read_text(encoding="utf-8").splitlines()
            if any(str(working / file).startswith(inside) for file in files):
                lock.unlink()
                removed += 1
    return removed


def _process_start_s(pid: int) -> float | None:
    """Start time of a process, s since 1970; None if it does not exist or is a zombie."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else float(process.create_time())
    except psutil.Error:
        return None
