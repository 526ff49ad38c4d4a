"""What every test has in common: nothing is remembered beyond the tests."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session", autouse=True)
def _no_memory_of_the_user(tmp_path_factory: pytest.TempPathFactory):
    """Own effects that tests run are remembered in a folder of theirs, here and in processes that they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield
