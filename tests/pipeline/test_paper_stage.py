"""The paper's stage on a small part of its campaign, stage by stage: files, exact columns, and refusals.

The trials are those of `data/paper`, with its own seed; nothing was tuned on them.
"""

from pathlib import Path

import pandas as pd
import pytest
from commanded import succeed

from vinetrack.experiment.folder import read_experiment
from vinetrack.figures.registry import figures_of
from vinetrack.laboratory.tracks import grow, read_ground_truth, write_experiment
from vinetrack.pipeline.stages import STAGES
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


@pytest.mark.slow
def test_tables_and_figures_are_there_what_was_grown_is_answered_and_what_was_not_is_blank(tmp_path):
    experiment, results = tmp_path / "part", tmp_path / "results"
    trials = [trial for trial in read_experiment(ROOT / "data" / "paper").trials if trial.name in CHOSEN]
    assert len(trials) == len(CHOSEN)
    nature = read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    write_experiment(grow(trials, nature), experiment, "chamber_l: 3.7\npublished: simulated\ncandidates: [air_drag]\n")
    settings = ("--settings", '{"damping": {"resamples": 100}, "figures": {"formats": ["svg"], "dpi": 60}}')
    for stage in STAGES:
        said = succeed(stage, experiment, results, *settings)
    assert "not checkable" in said
    assert (results / "paper.csv").read_text(encoding="utf-8").splitlines()[0] == HEADER
    for name in PAPER_TABLES:
        assert len(pd.read_csv(results / f"{name}.csv")) > 0, name
    for name in figures_of("paper"):
        assert "<svg" in (results / "figures" / f"{name}.svg").read_text(encoding="utf-8"), name

    rows = pd.read_csv(results / "paper.csv").set_index("row")
    assert rows.loc["n_both_axes", "ours"] == pytest.approx(0.37, abs=0.04)
    assert rows.loc["B_R4", "ours"] == pytest.approx(6.44, rel=0.05)
    assert 0 < rows.loc["position_rms_28kPa", "ours"] < 1.5
    assert 0 < rows.loc["final_speed_rms_41kPa", "ours"] < 0.5
    blank = ["position_rms_7kPa", "fast_vine_measured", "efficiency_power_of_wall"]
    assert rows.loc[blank, "ours"].isna().all()
    assert "9.52" in rows.loc["position_rms_7kPa", "beside"]  # what departures would cause needs no trial
    positions = pd.read_csv(results / "paper_positions.csv")
    assert positions["pressure_kPa"].tolist() == [28.0]
    assert rows.loc["position_rms_28kPa", "ours"] == pytest.approx(100 * positions["rms_mean_m"].iloc[0])
