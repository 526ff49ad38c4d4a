"""One small results folder for every test of the explorer that needs no browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from explorer_campaign import SMALL, make_experiment, make_results

from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.server import open_campaign


@pytest.fixture(scope="session")
def small_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six trials of one vine, three conditions, two replicates each."""
    folder = tmp_path_factory.mktemp("explorer")
    return make_results(make_experiment(folder / "vines", SMALL), folder / "results" / "vines")


@pytest.fixture(scope="session")
def campaign(small_results: Path) -> Campaign:
    """The same, opened."""
    return open_campaign(small_results)
