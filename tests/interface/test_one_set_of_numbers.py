"""Of one small experiment: the same quantity has one value in files, report, command line, explorer and Python."""

from __future__ import annotations

import html
import math
import re
from pathlib import Path

import numpy as np
import pytest
from explorer_campaign import run

from vinetrack.core.units import number
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.interface.loaded import LoadedResults
from vinetrack.narrative.verdict_text import estimate_text, summary_facts
from vinetrack.pages.page import open_campaign


@pytest.fixture(scope="module")
def diagnosis(loaded: LoadedResults) -> Diagnosis:
    assert loaded.diagnosis is not None
    return loaded.diagnosis


@pytest.fixture(scope="module")
def report(small_run: Path) -> str:
    """The words of the page."""
    page = (small_run / "report.html").read_text("utf-8")
    page = re.sub(r"<(script|style|svg)\b.*?</\1>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page)).split())


def test_numbers_of_the_initial_model_are_those_that_the_diagnosis_began_with(loaded: LoadedResults) -> None:
    moved = loaded.tables["diagnosis/moved"]
    first = moved[moved["added"] == ""].set_index(["parameter", "vine"])
    for entry in loaded.fit.numbers:
        row = first.loc[(entry.key, entry.vine)]
        assert row["value"] == pytest.approx(entry.value, rel=1e-9)
        assert row["sigma"] == pytest.approx(entry.sigma, rel=1e-9)


def test_errors_and_floor_of_the_ladder_are_those_of_the_comparison(loaded: LoadedResults) -> None:
    compared = loaded.tables["comparison"]
    rms_m = math.sqrt(float(np.mean(compared["rms_position_m"] ** 2)))  # as many replicates in every condition
    assert loaded.ladder["rms_in_sample_m"].iloc[0] == pytest.approx(rms_m, rel=1e-9)
    floor_m = math.sqrt(float(np.mean(compared["replicate_floor_m"] ** 2)))
    assert loaded.ladder["floor_m"].tolist() == pytest.approx([floor_m] * len(loaded.ladder), rel=1e-9)
    located = loaded.tables["diagnosis/conditions"].set_index("condition")
    for row in compared.itertuples():
        assert located.loc[str(row.condition), "rms_m"] == pytest.approx(row.rms_position_m, rel=1e-9)


def test_the_report_quotes_the_final_model_first(report: str, loaded: LoadedResults, diagnosis: Diagnosis) -> None:
    last = loaded.ladder.iloc[-1]
    first_mm, last_mm = (number(1e3 * loaded.ladder["rms_left_out_m"].iloc[k]) for k in (0, -1))
    assert f"{first_mm} → {last_mm} mm" in report
    assert f"replicate scatter {number(1e3 * last['floor_m'])} mm" in report
    for entry in diagnosis.parameters:
        assert estimate_text(entry).partition(" = ")[2].partition(" (")[0].split(" N·")[0].split(" kPa")[0] in report
    assert report.index("The final model:") < report.index("The initial model, which the diagnosis refutes")


def test_the_page_in_memory_and_the_page_in_the_file_say_the_same(report: str, diagnosis: Diagnosis) -> None:
    for fact in summary_facts(diagnosis, diagnosis.ladder):
        assert f"{fact.question} {fact.answer}" in report
        assert fact.note in report


def test_the_command_line_prints_the_numbers_of_the_files(small_run: Path, loaded: LoadedResults) -> None:
    said = run("compare", small_run)
    for row in loaded.tables["comparison"].itertuples():
        line = next(line for line in said.splitlines() if str(row.condition) in line)
        assert f"{1e3 * row.rms_position_m:.3f}" in line
        assert f"{1e3 * row.replicate_floor_m:.3f}" in line


def test_the_worst_condition_is_one(loaded: LoadedResults, diagnosis: Diagnosis, report: str, small_run: Path) -> None:
    compared = loaded.tables["comparison"]
    worst = str(compared.loc[compared["rms_position_m"].idxmax(), "condition"])
    assert loaded.tables["diagnosis/conditions"]["condition"].iloc[0] == worst
    pressure_kPa = float(re.search(r"_([\d.]+)kPa", worst)[1])  # type: ignore[index]
    assert f"Worst is {worst}" in report
    assert diagnosis.where[0].startswith(
        (f"The model fails most at {pressure_kPa:g} kPa", "In no condition does the mean")
    )
    drawn = (small_run / "figures" / "before_after.svg").read_text("utf-8")
    assert f"{pressure_kPa:g} kPa" in drawn


def test_the_explorer_starts_from_the_same_numbers_and_floors(small_run: Path, loaded: LoadedResults) -> None:
    campaign = open_campaign(small_run)
    assert dict(campaign.numbers) == {entry.name: entry.value for entry in loaded.fit.numbers}
    compared = loaded.tables["comparison"].set_index("condition")
    assert dict(campaign.floors_m) == compared["replicate_floor_m"].to_dict()
