"""`vinetrack design …`: what it says, what it writes, and how it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.pipeline.design_stage import read_list, read_range

INJECTOR = ("--diameter-mm", 2.5, "--length-mm", 12.5, "--pressure-kPa", 48, "--chamber-l", 0.003534)


RESERVOIR = ("reservoir", *INJECTOR, "--thickness-um", 50)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["design", *map(str, arguments)], catch_exceptions=False)


def cells(output: str, begins: str) -> list[str]:
    line = next(line for line in output.splitlines() if line.strip().startswith(begins))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def test_the_fast_vine_is_found_and_its_choice_of_film_is_open(tmp_path: Path) -> None:
    done = run("vine", "--pressure-kPa", 62, "--burst-fraction", 1, "--samples", 60, "--figure", tmp_path / "a.svg")
    assert done.exit_code == 0, done.output
    film, diameter, length, pressure, hoop, *_ = cells(done.output, "100")
    assert (film, diameter, length, pressure, hoop) == ("100", "25", "400", "62", "7.75")
    assert "the choice of film is uncertain" in done.output
    assert "not included: the burst stress, a guess from one vine" in done.output
    assert (tmp_path / "a.svg").read_text().startswith("<?xml")


def test_a_payload_and_a_range_that_is_one_number() -> None:
    done = run("vine", "--pressure-kPa", 40, "--films-um", 100, "--diameter-mm", 20, "--length-mm", "100:200",
               "--payload-g", 5, "--samples", 60)  # fmt: skip
    assert "fastest by ejection speed of the payload;" in done.output
    assert cells(done.output, "100")[1] == "20"


def test_the_injectors_chamber_loses_5_per_cent_of_gauge_and_not_1_7(tmp_path: Path) -> None:
    done = run("reservoir", *INJECTOR, "--figure", tmp_path / "a.png")
    assert done.exit_code == 0, done.output
    assert cells(done.output, "asked about")[1:] == ["3.53 mL", "5.3", "7.4"]
    assert cells(done.output, "needed if slow")[2] == "5.0"
    assert "sweeps 0.0614 mL" in done.output
    assert "speed" not in done.output
    assert (tmp_path / "a.png").exists()


def test_the_answers_of_both_designs_are_numbers_in_json(tmp_path: Path) -> None:
    run("reservoir", *INJECTOR, "--json", tmp_path / "r.json")
    asked = next(e for e in json.loads((tmp_path / "r.json").read_text())["chambers"] if e["chamber"] == "asked about")
    assert asked["volume_l"] == pytest.approx(0.003534)
    assert list(asked["loss_of_gauge_pressure"].values()) == pytest.approx([0.053, 0.074], abs=5e-4)
    run("vine", "--pressure-kPa", 62, "--burst-fraction", 1, "--samples", 60, "--json", tmp_path / "v.json")
    best = json.loads((tmp_path / "v.json").read_text())["films"][0]
    assert (best["thickness_um"], best["diameter_mm"]) == pytest.approx((100, 25), rel=0.01)
    speed = best["final_speed_m_s"]
    assert speed["low_90"] < speed["median"] < speed["high_90"]


def test_with_a_wall_speeds_are_told_and_a_supply_helps() -> None:
    output = run("reservoir", *INJECTOR, "--thickness-um", 50, "--B", 0.1, "--supply-s", 0.001).output
    assert "final speed at the medians at y/L = 0.95" in output
    assert "with a supply that refills the chamber in 1 ms" in output


def test_a_supply_without_a_wall_says_what_is_missing() -> None:
    assert "--supply-s needs --thickness-um" in run("reservoir", *INJECTOR, "--supply-s", 0.1).output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("vine",), "--pressure-kPa is missing"),
        (("vine", "--pressure-kPa", 62000), "62000 Pa is 62 kPa"),
        (
            ("vine", "--pressure-kPa", 2, "--yield-pressure-kPa", 3),
            "to its end, against a yield pressure of 3 kPa: raise",
        ),
        (
            ("vine", "--pressure-kPa", 62, "--burst-fraction", 0.05, "--diameter-mm", 25, "--yield-pressure-kPa", 30),
            # 0.05 × 2 × 200 µm × 7.8 MPa/25 mm
            "their walls may carry at most 6.24 kPa: raise --burst-fraction",
        ),
        (("vine", "--pressure-kPa", 62, "--diameter-mm", "25:5"), "write the lower value first"),
        (("vine", "--pressure-kPa", 62, "--diameter-mm", "5:15:25"), "write low:high"),
        (("vine", "--pressure-kPa", 62, "--diameter-mm", "5000"), "5000 µm is 5 mm"),
        (("vine", "--pressure-kPa", 62, "--films-um", "2000"), "begin at 8 mm or more"),
        (("vine", "--pressure-kPa", 62, "--films-um", "thin"), "--films-um 'thin'"),
        (("vine", "--pressure-kPa", 62, "--films-um", ","), "names 0 films"),
        (
            ("vine", "--pressure-kPa", 62, "--effect", "reservoir_depletion"),
            "reservoir_depletion needs it: give it as --chamber-l",
        ),
        (("reservoir", "--diameter-mm", 25), "--length-mm is missing"),
        ((*RESERVOIR, "--effect", "inlet_loss"), "needs it: give it as --inlet-mm"),
    ],
)
def test_refusals_are_sentences(arguments: tuple[object, ...], words: str) -> None:
    done = run(*arguments)
    assert done.exit_code == 1
    assert words in done.output
    assert "internal error of the program" not in done.output


def test_ranges_and_lists_are_in_si_and_judged_as_cells_are() -> None:
    assert read_range("diameter_mm", "5:25") == (0.005, 0.025)
    assert read_range("pressure_kPa", "62") == (62e3, 62e3)
    assert read_list("thickness_um", "50, 100,50") == pytest.approx((50e-6, 100e-6))
