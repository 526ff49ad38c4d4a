"""The paper's stage on a small part of its campaign, stage by stage: files, exact columns, and refusals.

The trials are those of `data/paper`, with its own seed; nothing was tuned on them.
"""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest
from commanded import run, succeed

from vinetrack.experiment.folder import read_experiment
from vinetrack.figures.registry import figures_of
from vinetrack.laboratory.tracks import grow, read_ground_truth, write_experiment
from vinetrack.pipeline.workflow import PAPER_TABLES

ROOT = Path(__file__).parents[2]
CHOSEN = (
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((1, "15p1"), (1, "19p4"), (1, "23p7"), (2, "12p7"), (2, "19p1"))),
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((2, "15p9"), (3, "17p3"), (3, "21"), (3, "24p7"), (4, "17"))),
    *("R4_19p7kPa_1", "R4_22p4kPa_1", "fig4_28kPa_1", "fig4_28kPa_2", "fig5_10g_41kPa_1", "fig5_50g_41kPa_1"),
)
HEADER = (
    "row,where,quantity,setting,unit,published,as_printed,ours,ours_low_95,ours_high_95,mark,how,beside"  # the contract
)


def small_part(folder: Path, published: str) -> Path:
    trials = [trial for trial in read_experiment(ROOT / "data" / "paper").trials if trial.name in CHOSEN]
    assert len(trials) == len(CHOSEN)
    nature = read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    write_experiment(grow(trials, nature), folder, f"chamber_l: 3.7\n{published}")
    return folder


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Results folder, and what the command said."""
    folder = tmp_path_factory.mktemp("paper")
    experiment = small_part(folder / "part", "published: simulated\ncandidates: [air_drag]\n")
    results = folder / "results"
    settings = ("--settings", '{"damping": {"resamples": 100}, "figures": {"formats": ["svg"], "dpi": 60}}')
    for stage in ("trials", "damping", "model", "paper"):
        said = succeed(stage, experiment, results, *settings)
    return results, said


@pytest.mark.slow
def test_the_table_has_its_columns_and_every_table_and_figure_is_there(beside: tuple[Path, str]) -> None:
    results, said = beside
    assert (results / "paper.csv").read_text(encoding="utf-8").splitlines()[0] == HEADER
    assert "not checkable" in said
    for name in PAPER_TABLES:
        assert len(pd.read_csv(results / f"{name}.csv")) > 0, name
    for name in figures_of("paper"):
        assert "<svg" in (results / "figures" / f"{name}.svg").read_text(encoding="utf-8"), name


@pytest.mark.slow
def test_what_was_grown_is_answered_and_what_was_not_is_blank(beside: tuple[Path, str]) -> None:
    rows = pd.read_csv(beside[0] / "paper.csv").set_index("row")
    assert rows.loc["n_both_axes", "ours"] == pytest.approx(0.37, abs=0.04)
    assert rows.loc["B_R4", "ours"] == pytest.approx(6.44, rel=0.05)
    assert 0 < rows.loc["position_rms_28kPa", "ours"] < 1.5
    assert 0 < rows.loc["final_speed_rms_41kPa", "ours"] < 0.5
    assert math.isnan(rows.loc["position_rms_7kPa", "ours"])
    assert math.isnan(rows.loc["fast_vine_measured", "ours"])
    assert "9.52" in rows.loc["position_rms_7kPa", "beside"]  # what departures would cause needs no trial
    assert math.isnan(rows.loc["efficiency_power_of_wall", "ours"])
    positions = pd.read_csv(beside[0] / "paper_positions.csv")
    assert positions["pressure_kPa"].tolist() == [28.0]
    assert rows.loc["position_rms_28kPa", "ours"] == pytest.approx(100 * positions["rms_mean_m"].iloc[0])


def test_a_stage_before_it_is_missed(tmp_path: Path) -> None:
    experiment = small_part(tmp_path / "part", "published: measured\n")
    done = run("paper", experiment, tmp_path / "results")
    assert done.exit_code == 1
    assert "does not exist" in done.output
