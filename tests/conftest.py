"""What every test has in common: nothing is remembered beyond a test, so that their order does not matter."""

import gc
import os
from collections.abc import Generator
from itertools import count
from pathlib import Path

import pytest

# A worker for every core already: threads of the linear algebra would wait for one another, and the last digits of a
# sum would depend on how many cores a machine has. Asked for before NumPy is loaded, here and in what tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Garbage is looked for after 50 000 new objects, not 700: among all that thousands of tests have imported, it took a
# twentieth of their time.
gc.set_threshold(50_000, 20, 50)

FOLDERS = count()  # Numbers the folders of one process


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Thousands of tests and all modules are gathered, none of it garbage: to look for some takes half of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _folder_of_memories(tmp_path_factory):
    """A folder for what programs remember of their user, for fixtures that live longer than a test too."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("state")
        patch.setenv("XDG_STATE_HOME", str(folder / "fixtures"))
        yield folder


@pytest.fixture(scope="session")
def real():
    """The folder of recordings made by others."""
    if not os.environ.get("VINETRACK_REAL_DATA"):
        pytest.skip("VINETRACK_REAL_DATA is unset: no real recordings to try")
    return Path(os.environ["VINETRACK_REAL_DATA"])


@pytest.fixture(autouse=True)
def _no_memory_of_the_user(_folder_of_memories, monkeypatch):
    """Each test, and the processes that it starts, meet own effects for the first time."""
    monkeypatch.setenv("XDG_STATE_HOME", str(_folder_of_memories / str(next(FOLDERS))))
