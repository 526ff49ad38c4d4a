"""A workflow that is killed goes on with the same command."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_pipeline import ROOT, write_campaign

from vinetrack.pipeline.workflow import LOCK_REMOVED


@pytest.mark.pipeline
@pytest.mark.slow
def test_the_same_snakemake_command_goes_on_after_kill_9(tmp_path: Path) -> None:
    write_campaign(tmp_path / "vines")
    results = tmp_path / "results" / "vines"
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--workflow-profile",
        str(ROOT / "profiles" / "default"), "--cores", "1", "results/vines/trials.csv", "--config", "experiment=vines",
    ]  # fmt: skip
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    first = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    end = time.monotonic() + 60
    while not list((tmp_path / ".snakemake" / "locks").glob("*.lock")) and time.monotonic() < end:
        time.sleep(0.05)
    first.kill()
    first.wait()
    assert list((tmp_path / ".snakemake" / "locks").glob("*.lock"))
    again = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    assert LOCK_REMOVED in again.stdout
    assert (results / "trials.csv").exists()
