"""A results folder in memory: the same quantity has one value in files, report, command line, explorer and Python; the
story of the README and the notebook of the documentation run on it."""

import json
import re
from pathlib import Path

import notebook
import pytest
from explorer_campaign import FEW_CANDIDATES, ROUGH_FIGURES, SETTINGS, SMALL, make_experiment, make_results, run
from matplotlib.figure import Figure

import vinetrack as vt
from vinetrack.core.problems import ExperimentError
from vinetrack.core.units import number
from vinetrack.pages.page import open_campaign
from vinetrack.results import ResultsError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    """`results/demo` of six trials of one vine: three conditions, two replicates each, with figures and report."""
    folder = tmp_path_factory.mktemp("small_run")
    experiment = make_experiment(folder / "demo", SMALL, SETTINGS + FEW_CANDIDATES)
    results = folder / "results" / "demo"
    make_results(experiment, results)
    for stage in ("model", "report"):
        run(stage, experiment, results, "--settings", ROUGH_FIGURES)
    return results


@pytest.fixture(scope="module")
def loaded(small_run):
    return vt.load(small_run)


def test_every_table_of_the_folder_is_there_with_units_in_its_columns(loaded):
    assert {"trials", "conditions", "steady", "ladder", "comparison", "diagnosis/steps"} <= set(loaded.tables)
    assert loaded.tables["ladder"].equals(loaded.ladder)
    assert [name for name in loaded.ladder.columns if "rms" in name and not name.endswith("_m")] == []
    # Models carry fitted values and what was added.
    assert "reservoir_depletion" in loaded.final_model
    assert "reservoir_depletion" not in loaded.initial_model
    assert loaded.diagnosis is not None
    (n,) = [one.value for one in loaded.diagnosis.parameters if one.key == "eversion_damping.n"]
    assert loaded.final_model.parameters_for("24mm-200um-200mm")[2] == n


def test_figures_of_the_report_are_figures_and_what_is_not_there_is_said(loaded, tmp_path):
    for name in ("", "model_comparison", "before_after", "candidates"):
        assert isinstance(loaded.plot(name), Figure)
    assert isinstance(loaded.plot("trial_motion", trial="d24_24kPa_1"), Figure)
    with pytest.raises(ResultsError):
        loaded.plot("trial_motion", trial="nobody")
    with pytest.raises(ResultsError):
        vt.load(tmp_path)


@pytest.mark.slow
def test_the_story_of_the_readme_runs(small_run, tmp_path, monkeypatch):
    pattern = r"\n((?:    [^\n]*\n|\n)*    import vinetrack as vt\n(?:    [^\n]*\n|\n)*)"
    story = re.search(pattern, (ROOT / "README.md").read_text("utf-8"))
    assert story is not None
    lines = [line.removeprefix("    ") for line in story[1].splitlines() if line.strip()]
    assert len(lines) <= 10
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "demo").symlink_to(small_run)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec("\n".join(lines), names)
    assert (tmp_path / "ladder.png").exists()


def test_a_frame_without_a_column_or_with_a_wrong_setting_is_refused_and_a_pressure_is_a_trace():
    frame = vt.example_tracks()
    wrong = [frame.drop(columns="time_s"), frame.drop(columns="thickness_um"), frame.assign(diameter_mm=3000.0)]
    for one in (*wrong, frame.assign(length_mm=280.0 + frame["time_s"])):
        with pytest.raises(ExperimentError):
            vt.tracks_from_frame(one)
    _, track = vt.tracks_from_frame(frame.assign(pressure_kPa=frame["pressure_kPa"] - frame["time_s"]))[0]
    assert track.pressure_Pa is not None
    assert track.pressure_Pa[0] == pytest.approx(24e3)


@pytest.mark.slow
def test_every_cell_of_the_notebook_runs_and_shows_what_is_stored():
    def kinds(outputs: list[dict]) -> list[list[str]]:
        return [sorted(one.get("data", one)) for one in outputs]

    page = ROOT / "docs" / "python.ipynb"
    shown = [one for outputs in notebook.run(page) for one in outputs]
    cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
    stored = [one for cell in cells for one in cell.get("outputs", [])]
    assert kinds(shown) == kinds(stored)
    assert sum("image/png" in kind for kind in kinds(shown)) == 3
    texts = [["".join(one["data"]["text/plain"]) for one in each if "data" in one] for each in (shown, stored)]
    objects = [[text for text in each if text.startswith(("Fit(", "Diagnosis("))] for each in texts]
    assert objects[0] == objects[1]
    assert objects[0][1] == "Diagnosis(missing: reservoir_depletion)"
    printed = [["".join(one["text"]) for one in each if "text" in one] for each in (shown, stored)]
    assert printed[0] == printed[1]
    assert "n = 0.369 instead of" in printed[0][0]


def test_commands_and_explorer_give_the_numbers_of_the_files(small_run, loaded):
    said, compared = run("compare", small_run), loaded.tables["comparison"]
    for row in compared.itertuples():
        line = next(line for line in said.splitlines() if str(row.condition) in line)
        assert number(1e3 * row.rms_position_m) in line
        assert number(1e3 * row.expected_high_m) in line
    campaign = open_campaign(small_run)
    assert campaign.stored.numbers == loaded.fit.numbers
    assert dict(campaign.highest_m) == compared.set_index("condition")["expected_high_m"].to_dict()
