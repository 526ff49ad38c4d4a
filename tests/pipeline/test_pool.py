"""Workers of a pool: they answer in order, and end with the process that started them, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vinetrack.pipeline.tracks_stage import map_trials, map_unordered

PARENT = """
import os, sys, time
from vinetrack.pipeline.tracks_stage import map_unordered, map_trials

def task(number):
    os.write(1, b"%d\\n" % os.getpid())  # at once: two that print mix their lines
    time.sleep(0.02 if number < 4 else 600)

for _ in {share}(task, range(8), 2{label}):
    pass
"""


def square(number: int) -> int:
    return number**2


def test_answers_come_in_the_order_of_their_arguments() -> None:
    assert list(map_trials(square, range(20), 2, "squares")) == [k**2 for k in range(20)]
    assert sorted(map_unordered(square, range(20), 2)) == [k**2 for k in range(20)]


@pytest.mark.skipif(not Path("/proc").exists(), reason="which processes are there is read from /proc")
@pytest.mark.parametrize(("share", "label"), [("map_trials", ", 'tasks'"), ("map_unordered", "")])
def test_workers_of_a_killed_run_end_too(share: str, label: str, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(share=share, label=label))
    workers: set[int] = set()
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        while len(workers) < 2:
            workers.add(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
    ends = time.monotonic() + 60
    while any(map(_is_alive, workers)) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not any(map(_is_alive, workers))


def _is_alive(process: int) -> bool:
    """Whether a process is there, and not only waiting to be counted."""
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
