"""The stages of a run: one table of what each reads and writes, from which Snakemake's rules and the commands are made.

A stage is a function of an experiment, a results folder and settings; it returns lines for the terminal. Every command
that does part of a run calls the same function. Imports stay light: Snakemake loads this module in every job.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from vinetrack.core.tables import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings, RunSettings
    from vinetrack.video.track import Tracking

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Job:
    """What a stage is asked for: `trials` are the names of some trials, None for all; `say` shows what it is doing."""

    experiment: Experiment
    results: Path
    settings: RunSettings
    trials: Sequence[str] | None = None
    threads: int = 1
    say: Callable[[str], None] = lambda _: None


@dataclass(frozen=True)
class Stage:
    """One stage: what it does in words, and by which function, `module:name`, of a job. `settings` are the keys of a
    run that it depends on; `reads` and `writes` are files of the results, or groups of files that the plan of a run
    knows, in `<…>`.
    """

    does: str
    function: str
    settings: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    parallel: bool = False

    def run(self, job: Job) -> list[str]:
        """Do the job; return lines for the terminal, the first of which says what was done."""
        module, name = self.function.split(":")
        with compilation_told(job.say):
            lines: list[str] = getattr(import_module(f"vinetrack.pipeline.{module}"), name)(job)
        return lines


STAGES = {
    "trials": Stage(
        "Track recordings, analyse the motion of every trial, and draw both.",
        "trials:analyse_trials",
        ("steady", "velocity", "final_at_fraction", "efficiency_at_mm", "figures"),
        ("<measurements>",),
        ("<trials>",),
        parallel=True,
    ),
    "model": Stage(
        "Fit the damping law and the model in use to all trials, audit neglected effects, and diagnose what it lacks.",
        "model_stage:fit_and_diagnose",
        ("steady", "velocity", "damping", "final_at_fraction", "efficiency_at_mm"),
        ("<trials>",),
        ("trials.csv", "conditions.csv", "steady.csv", "damping_points.csv", "damping.json", "scaling.json", "fit.json",
         "comparison.csv", "model_check.csv", "audit.csv", "diagnosis.json", "ladder.csv"),
    ),
    "report": Stage(
        "Draw the figures of the experiment and clips of its recordings, and write the report, a single file.",
        "report_stage:write_report",
        (),
        ("diagnosis.json",),
        ("report.html", "provenance.json"),  # which figures have content is not known in advance
        parallel=True,
    ),
}  # fmt: skip


COMPILING = "compiling for this machine, once (half a minute)"


@contextmanager
def compilation_told(say: Callable[[str], None]) -> Iterator[None]:
    """Say so when code is first compiled meanwhile; what was compiled before is kept, so mostly nothing is said."""
    from numba.core import event

    class Listener(event.Listener):
        is_told = False

        def on_start(self, _: object) -> None:
            if not self.is_told:
                say(COMPILING)
            self.is_told = True

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


# ------------------------------------------------------------------------------
# Applying a function to many trials in several processes.

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def map_unordered(function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int) -> Iterator[Answer]:
    """Yield `function(item)` of every item as soon as it is ready; both go to other processes, so are picklable."""
    if n_workers < 2 or len(items) < 2:
        yield from map(function, items)
        return
    # Forked on Linux, where workers are ready at once and share what is imported, and spawned elsewhere.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(min(n_workers, len(items)), mp_context=context, initializer=_end_with_parent) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:
            pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this worker when its parent process ends, even if the parent is killed. A worker waits for its next argument
    on a pipe that the other workers hold open as well: after a killed run all of them would wait forever and keep their
    memory.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()


# ------------------------------------------------------------------------------
# What a run need not make twice: the check, tracks in pixels, figures of trials; kept in the results by their inputs.
#
# It lies beside the results, in a folder that Snakemake does not know. A file that is replaced, or another version of
# the program, has another key; what no run asks for in a month is dropped.


@lru_cache
def code_hash() -> str:
    """Hash of the package."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def identity(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, size and time of modification of a file and of those that share its name, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else path.parent.glob(f"{path.stem}.*")
    stats = [(file.name, file.stat()) for file in sorted({path, *files}) if file.is_file()]
    return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)


class Kept:
    """The kept files of a results folder; `tracked` is the key of the last track that was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / ".kept"
        self.tracked = ""

    def track(self, inputs: tuple[object, ...], make: Callable[[], Tracking]) -> Tracking:
        """The tracking in pixels of a recording (the first input is its path), kept or made."""
        film, *others = inputs
        assert isinstance(film, Path)
        libraries = [import_module(name).__version__ for name in ("numpy", "scipy", "numba", "av", "cv2")]
        state = (code_hash(), libraries, film.resolve(), identity(film), others)
        self.tracked = _key(*state)
        return self.made("track", state, make)

    def made(
        self, kind: str, inputs: tuple[object, ...], make: Callable[[], Answer],
        lasts: Callable[[Answer], bool] = lambda _: True,
    ) -> Answer:  # fmt: skip
        """What was made for these inputs, kept or made: the same, bit by bit. It is kept if it `lasts`."""
        path = self.folder / f"{_key(*inputs)}.{kind}"
        try:
            os.utime(path)  # it counts as asked for now
            content = zlib.decompress(path.read_bytes())
        except FileNotFoundError:
            content = pickle.dumps(made := make())
            if lasts(made):
                write_bytes(path, zlib.compress(content, 1))
        found: Answer = pickle.loads(content)
        return found

    def figure(
        self, inputs: tuple[object, ...], path: Callable[..., Path], settings: FigureSettings,
        draw: Callable[[], Figure],
    ) -> None:  # fmt: skip
        """Write a figure in every format, kept for these inputs or drawn; `path` gives the path for a suffix."""

        def rendered() -> dict[str, bytes]:
            from vinetrack.figures.style import render

            return render(draw(), settings.formats, settings.dpi)

        state = code_hash(), settings.dpi, settings.formats, inputs
        for form, data in self.made("figure", state, rendered).items():
            write_bytes(path(suffix=f".{form}"), data)

    def forget(self) -> None:
        """Drop what no run has asked for in a long time."""
        for path in self.folder.glob("*"):
            if path.stat().st_mtime < time.time() - 30 * 86400:  # a month (chosen)
                path.unlink(missing_ok=True)


def _key(*inputs: object) -> str:
    return hashlib.sha256(repr(inputs).encode()).hexdigest()[:32]
