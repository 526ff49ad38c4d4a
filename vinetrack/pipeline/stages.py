"""The stages of a run: one table of what each reads and writes, from which Snakemake's rules and the commands are made.

A stage is a function of an experiment, a results folder and settings; it returns lines for the terminal. Every command
that does part of a run calls the same function. Imports stay light: Snakemake loads this module in every job.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings


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
    knows, in `<…>`; a folder ends with `/`. `done` says that it is.
    """

    does: str
    function: str
    settings: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    done: str
    parallel: bool = False

    def run(self, job: Job) -> list[str]:
        """Do the job; return lines for the terminal."""
        module, name = self.function.split(":")
        with compilation_told(job.say):
            lines: list[str] = getattr(import_module(f"vinetrack.pipeline.{module}"), name)(job)
        return lines


STAGES = {
    "trials": Stage(
        "Track recordings, analyse the motion of every trial, and draw both.",
        "trials:analyse_trials",
        ("steady", "velocity", "final_at_fraction", "efficiency_at_mm", "figures"),
        ("<experiment>", "<measurements>"),
        ("<tracks>", "<kinematics>", "<analysed>", "<pictures>"),
        "trials analysed",
        parallel=True,
    ),
    "model": Stage(
        "Fit the damping law and the model in use to all trials, audit neglected effects, and diagnose what it lacks.",
        "model_stage:fit_and_diagnose",
        ("steady", "velocity", "damping", "final_at_fraction", "efficiency_at_mm"),
        ("<experiment>", "<tracks>", "<kinematics>", "<analysed>"),
        ("trials.csv", "conditions.csv", "steady.csv", "damping_points.csv", "damping.json", "scaling.json", "fit.json",
         "comparison.csv", "model_check.csv", "audit.csv", "comparison/", "diagnosis.json", "ladder.csv", "diagnosis/"),
        "model fitted and diagnosed",
    ),
    "report": Stage(
        "Draw the figures of the experiment and clips of its recordings, and write the report, a single file.",
        "report_stage:write_report",
        (),
        ("<inputs>", "<tracks>", "<kinematics>", "<analysed>", "<pictures>", "<made of model>"),
        ("<paper>", "report.html", "provenance.json"),  # which figures have content is not known in advance
        "report written",
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
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() and sys.platform == "linux" else "spawn"
    context = multiprocessing.get_context(method)
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
