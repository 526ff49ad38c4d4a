"""`vinetrack design …`: what it says, what it writes, and how it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.core.tables import read_table
from vinetrack.experiment.folder import read_experiment
from vinetrack.pipeline.design_stage import read_list, read_range

TWO = ("--vine", "24x200x280", "--vine", "12×100×140")
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


def test_with_a_wall_speeds_are_told_and_a_supply_helps() -> None:
    output = run("reservoir", *INJECTOR, "--thickness-um", 50, "--B", 0.1, "--supply-s", 0.001).output
    assert "final speed at the medians at y/L = 0.95" in output
    assert "with a supply that refills the chamber in 1 ms" in output


def test_a_supply_without_a_wall_says_what_is_missing() -> None:
    assert "--supply-s needs --thickness-um" in run("reservoir", *INJECTOR, "--supply-s", 0.1).output


def test_a_campaign_is_planned_simulated_and_written_as_a_sheet(tmp_path: Path) -> None:
    sheet = tmp_path / "mine" / "trials.csv"
    done = run("campaign", *TWO, "--pressure-kPa", "9:40", "--payload-g", "0,35.6", "--check", 2, "--sheet", sheet,
               "--figure", tmp_path / "a.svg", "--yield-pressure-kPa", 3)  # fmt: skip
    assert done.exit_code == 0, done.output
    assert cells(done.output, "this campaign")[1] in done.output.splitlines()[3]
    assert "2 campaigns simulated" in done.output
    assert cells(done.output, "n ")[0] == "n"
    trials = read_experiment(sheet.parent).trials
    assert len(trials) == int(cells(done.output, "this campaign")[1])
    assert len({trial.vine for trial in trials}) == 2
    pressures = [row["pressure_kPa"] for row in read_table(sheet).rows]
    assert pressures != sorted(pressures, key=float)
    assert (tmp_path / "a.svg").exists()


def test_a_campaign_says_what_it_could_see_of_other_effects() -> None:
    output = run("campaign", "--vine", "24x200x280", "--pressure-kPa", "9:40", "--check", 0, "--power").output
    assert "to detect physics that their model lacks" in output
    drag = next(line for line in output.splitlines() if line.strip().startswith("air drag"))
    assert "C_D" in drag


def test_a_campaign_out_of_reach_says_what_would_help() -> None:
    output = run("campaign", *TWO, "--n-se", 1e-5, "--most-trials", 30, "--check", 0).output
    assert "! no campaign of 30 trials or fewer with the allowed pressures and replicates reaches that" in output
    assert "widen the pressures" in output


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
        (("campaign", "--vine", "24x200x280", "--effect", "inlet_loss"), "needs it: give it as --inlet-mm"),
        (("campaign",), "--vine is missing"),
        (("campaign", "--vine", "24x200"), "write diameter, wall and length in mm, µm, mm"),
        (("campaign", "--vine", "24x20000x280"), "quarter of the diameter"),
        (("campaign", "--vine", "24x200x280", "--payload-g", "heavy"), "--payload-g 'heavy'"),
        (("campaign", "--vine", "24x200x280", "--pressure-kPa", "1:2"), "No trial of the campaign could be filmed"),
    ],
)
def test_refusals_are_sentences(arguments: tuple[object, ...], words: str) -> None:
    done = run(*arguments)
    assert done.exit_code == 1
    assert words in done.output
    assert "internal error of the program" not in done.output


@pytest.mark.parametrize("text", ["8:4", "1:5", "4:20", "a", "4:5:6"])
def test_numbers_of_pressures_that_are_no_range_are_refused(text: str) -> None:
    done = run("campaign", *TWO, "--pressures", text)
    assert done.exit_code == 2
    assert "is not a range within 2:13" in " ".join(done.output.replace("│", " ").split())


def test_ranges_and_lists_are_in_si_and_judged_as_cells_are() -> None:
    assert read_range("diameter_mm", "5:25") == (0.005, 0.025)
    assert read_range("pressure_kPa", "62") == (62e3, 62e3)
    assert read_list("thickness_um", "50, 100,50") == pytest.approx((50e-6, 100e-6))


@pytest.mark.parametrize("old", [("--fps", "1000"), ("--of-burst=0.8",), ("--n-within", "0.02"), ("--from", "nowhere")])
def test_an_option_of_the_last_release_is_read_with_a_warning(old: tuple[str, ...]) -> None:
    done = run("campaign", *old)
    assert f"{old[0].partition('=')[0]} is now --" in done.stderr
    assert "No such option" not in done.stderr
