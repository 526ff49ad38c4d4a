"""Who writes a results folder: a run that was killed leaves nothing that keeps the next one from going on.

Snakemake locks the files of a run and cannot tell afterwards whether that run still lives. So each run writes down, in
its results, its process and when that began: a process number alone is given to another program in time.
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

START_TOLERANCE_S = 1.0
"""Difference of two readings of one process's start. Derived: systems count it in hundredths of a second; a number that
is given anew belongs to a process that began later by the time all others take, minutes at the least."""
MIN_UNFINISHED_AGE_S = 60.0
"""Age below which an unfinished file in the experiment may be somebody's save. Chosen: a save takes milliseconds; at
half or twice nothing changes but on network drives."""
OWNER_FILE = ".run.json"
"""File of a results folder that names the process that writes it."""

LOCK_REMOVED = "The lock of a run that was broken off"
UNFINISHED_FILES = re.compile(r"\.tmp-[0-9a-f]{32}(\.\w+)?|\.part-.+")
"""Names under which files are written before they take their own."""


NON_EXECUTING_OPTIONS = re.compile(
    r"-[a-zA-Z]*[nlhDS][a-zA-Z]*|--(dry-?run|unlock|lint|report|summary|detailed-summary|dag|rulegraph|filegraph|d3dag|list.*|help|"
    r"version|archive|print-compilation|cleanup-.*|delete-.*|containerize)(=.*)?"
)
"""Options of Snakemake with which it runs nothing."""


@dataclass(frozen=True)
class RunOwner:
    """A process that runs a workflow: its number, when it began (s since 1970), and on which computer."""

    pid: int
    started_s: float
    host: str

    @property
    def is_here(self) -> bool:
        """Whether it ran on this computer, so that it can be known whether it still does."""
        return self.host == socket.gethostname()

    @property
    def is_alive(self) -> bool:
        """Whether it still runs; a process of another computer counts as running."""
        if not self.is_here:
            return True
        started_s = _process_start_s(self.pid)
        return started_s is not None and abs(started_s - self.started_s) < START_TOLERANCE_S


def executes_nothing(options: Iterable[str]) -> bool:
    """Whether Snakemake runs nothing with these options: it draws, lists, unlocks or says what it would do.

    Parameters
    ----------
    options : of its command line.

    Returns
    -------
    True where nothing is run.
    """
    return any(NON_EXECUTING_OPTIONS.fullmatch(option) for option in options)


def refuse_running(results: Path) -> None:
    """Refuse results that a run which is still alive writes.

    Parameters
    ----------
    results : folder that is to be written.

    Raises
    ------
    ExperimentError
        Naming the process.
    """
    owner = _read_owner(results / OWNER_FILE)
    if owner is not None and owner.pid != os.getpid() and owner.is_alive:
        raise ExperimentError([_refusal(owner, results)])


def begin_run(results: Path, experiment: Path, working: Path, say: Callable[[str], None]) -> None:
    """Enter this process as the one that writes these results, and clear what a killed run left behind.

    Locks of a run that has ended are taken away, and files that were never finished; the entry goes when this process
    ends.

    Parameters
    ----------
    results : folder that is to be written.
    experiment : its folder; unfinished files at its top are cleared as well.
    working : folder in which Snakemake runs, which keeps its locks in `.snakemake`.
    say : takes a line.

    Raises
    ------
    ExperimentError
        If another run that is still alive writes these results, naming its process.
    """
    refuse_running(results)
    entry = (results / OWNER_FILE).absolute()  # Snakemake may end in another folder
    owner = _read_owner(entry)
    if owner is not None and owner.pid != os.getpid() and _remove_locks(working, results):
        say(f"{LOCK_REMOVED} (process {owner.pid}) is taken away; what it finished is kept.")
    started_s = _process_start_s(os.getpid()) or time.time()
    write_text(entry, json.dumps(asdict(RunOwner(os.getpid(), started_s, socket.gethostname()))))
    atexit.register(_remove_owner_file, entry, os.getpid())
    clear_unfinished(results.rglob("*"))
    clear_unfinished(experiment.glob("*"), older_than_s=MIN_UNFINISHED_AGE_S)


def clear_unfinished(paths: Iterable[Path], older_than_s: float = 0.0) -> None:
    """Remove files that were being written when their program was killed.

    Parameters
    ----------
    paths : where to look; only names that unfinished files have are touched.
    older_than_s : age at least, s.
    """
    for path in [path for path in paths if UNFINISHED_FILES.fullmatch(path.name)]:
        with contextlib.suppress(OSError):
            if path.is_file() and time.time() - path.stat().st_mtime >= older_than_s:
                path.unlink()


def _remove_owner_file(entry: Path, pid: int) -> None:
    """Remove the entry of this process; a copy of it that was forked leaves it alone."""
    if os.getpid() == pid:
        with contextlib.suppress(OSError):
            entry.unlink(missing_ok=True)


def _refusal(owner: RunOwner, results: Path) -> Problem:
    message = f"is being written by process {owner.pid}"
    remedy = "wait until it ends, or end it"
    if not owner.is_here:
        message += f" of the computer {owner.host}"
        remedy = f"wait until it ends; if it no longer runs, remove {results / OWNER_FILE}"
    since = time.strftime("%H:%M on %d %B", time.localtime(owner.started_s))
    return Problem(message=f"{message}, since {since}", file=str(results), remedy=remedy)


def _read_owner(entry: Path) -> RunOwner | None:
    """Who has entered last and not left; an entry that cannot be read says nothing."""
    try:
        return RunOwner(**json.loads(entry.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _remove_locks(working: Path, results: Path) -> int:
    """Remove Snakemake's locks that name files of these results; how many. Runs on other results keep theirs."""
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
    """When a process began, s since 1970; None where there is none, or only what is left of one that was killed."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else float(process.create_time())
    except psutil.Error:
        return None
