"""One small experiment taken through every stage, for the tests of what is quoted from its results."""

from __future__ import annotations

from pathlib import Path

import pytest
from explorer_campaign import FEW_CANDIDATES, SETTINGS, SMALL, make_experiment, make_results, run

import vinetrack as vt
from vinetrack.interface.loaded import LoadedResults


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`results/demo` of six trials of one vine: three conditions, two replicates each, with figures and report."""
    folder = tmp_path_factory.mktemp("small_run")
    experiment = make_experiment(folder / "demo", SMALL, SETTINGS + FEW_CANDIDATES)
    results = folder / "results" / "demo"
    make_results(experiment, results)
    run("model", experiment, results)
    run("figures", experiment, results)
    run("report", experiment, results)
    return results


@pytest.fixture(scope="session")
def loaded(small_run: Path) -> LoadedResults:
    return vt.load(small_run)
