"""An experiment folder read whole: what becomes a trial, and a fault of one row."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hand_sheet import GOOD, HEADER, TRACK, one, stopped, two_vines, write

from vinetrack.core.problems import format_problems
from vinetrack.core.records import Bend, Trial
from vinetrack.experiment.folder import read_experiment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return two_vines(tmp_path)


def test_a_row_becomes_a_trial_in_si_units(folder: Path) -> None:
    experiment = read_experiment(folder)
    expected = Trial(
        name="a",
        vine="24mm-200um-280mm",
        condition="24mm-200um-280mm_28kPa_35.6g",
        track=folder / "a.csv",
        diameter_m=0.024,
        thickness_m=200e-6,
        length_m=0.28,
        pressure_Pa=28e3,
        pressure_sigma_Pa=280.0,
        yield_pressure_Pa=3e3,
        yield_pressure_sigma_Pa=200.0,
        payload_kg=0.0356,
        position_systematic_m=1e-4,
    )
    assert known(experiment.trials[0]) == known(expected)
    assert experiment.trials[1].payload_kg == 0.0
    assert experiment.problems == ()


def known(trial: Trial) -> dict[str, object]:
    """Fields that are not NaN, which equals nothing, not even itself."""
    return {name: value for name, value in vars(trial).items() if value == value}


def test_optional_columns_in_si_units(folder: Path) -> None:
    columns = (
        "capture_fps,exposure_us,growth_angle_deg,chamber_l,inlet_mm,bends,film_density_kg_m3,mm_per_px,steady,"
        "pressure_sigma_kPa,yield_pressure_sigma_kPa"
    )
    trial = one(folder, columns, "1000,100,90,3.7,6,100:30:20;200:50:25,1180,0.37,0.05:0.2,0.5,0.1").trials[0]
    assert trial.capture_fps == 1000
    assert trial.exposure_s == pytest.approx(1e-4)
    assert trial.growth_angle_rad == pytest.approx(math.pi / 2)
    assert trial.chamber_m3 == pytest.approx(3.7e-3)
    assert trial.inlet_m == pytest.approx(6e-3)
    assert trial.bends == (Bend(0.1, 0.03, 0.02), Bend(0.2, 0.05, 0.025))
    assert trial.film_density_kg_m3 == 1180
    assert trial.m_per_px == pytest.approx(0.37e-3)
    assert trial.steady_window_s == (0.05, 0.2)
    assert (trial.pressure_sigma_Pa, trial.yield_pressure_sigma_Pa) == (500, 100)


def test_shared_settings_fill_blank_cells_and_a_cell_overrides_them(folder: Path) -> None:
    sheet = "trial,track,thickness_um,length_mm,pressure_kPa\na,a.csv,200,280,28\nb,b.csv,,280,\n"
    shared = "diameter_mm: 24\nthickness_um: 150\npressure_kPa: 14\nyield_pressure_kPa: 3\nambient_pressure_kPa: 84\n"
    a, b = read_experiment(write(folder, sheet, shared + "mass_loss: as_printed\ntail_slack: free\n")).trials
    assert (a.thickness_m, b.thickness_m) == (200e-6, 150e-6)
    assert (a.pressure_Pa, b.pressure_Pa) == (28e3, 14e3)
    assert a.diameter_m == 0.024
    assert (a.ambient_pressure_Pa, a.mass_loss, a.tail_slack) == (84e3, "as_printed", "free")


@pytest.mark.parametrize("spelling", ["my-vines", "my-vines/", "./my-vines", "my-vines/."])
def test_the_name_is_the_last_part_of_the_path(folder: Path, spelling: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    assert read_experiment(spelling).name == "my-vines"


def test_the_folder_one_stands_in_has_a_name_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert read_experiment(".").name == "my-vines"


def test_a_linked_folder_keeps_the_name_of_the_link(folder: Path) -> None:
    link = folder.parent / "spring"
    link.symlink_to(folder)
    assert read_experiment(link).name == "spring"


def test_a_fault_of_one_row_fails_that_trial_alone(folder: Path) -> None:
    write(folder, GOOD.replace("b,b.csv,24", "b,b.csv,0.024"))
    experiment = read_experiment(folder)
    assert [trial.name for trial in experiment.trials] == ["a"]
    assert list(experiment.failed) == ["b"]
    assert "looks like metres: 0.024 metres is 24 mm" in experiment.failed["b"]
    assert experiment.names == ("a", "b")


def test_strict_stops_at_a_fault_of_one_row(folder: Path) -> None:
    write(folder, GOOD.replace("b,b.csv,24", "b,b.csv,0.024"), "strict: true\n")
    assert [problem.trial for problem in stopped(folder)] == ["b"]
    assert list(read_experiment(folder, strict=False).failed) == ["b"]
    (folder / "experiment.yaml").unlink()
    assert [problem.trial for problem in stopped(folder, strict=True)] == ["b"]


def test_a_trial_put_aside_is_listed_and_not_judged(folder: Path) -> None:
    sheet = f"{HEADER},use\na,a.csv,24,200,280,28,3,35.6,yes\nb,b.csv,,,,oops,,,no\n"
    experiment = read_experiment(write(folder, sheet), strict=True)
    assert [trial.name for trial in experiment.trials] == ["a"]
    assert list(experiment.left_out) == ["b"]
    assert experiment.failed == {}
    assert {problem.severity for problem in experiment.problems} == {"warning"}


@pytest.mark.parametrize(
    ("column", "cell", "words"),
    [
        ("pressure_kPa", "24000", "is above 1000 kPa (allowed: 0 to 1000 kPa): looks like Pa: 24000 Pa is 24 kPa"),
        ("pressure_kPa", "-1", "is below 0 kPa"),
        ("pressure_kPa", "12 kPa", "is not a number"),
        ("pressure_kPa", "nan", "is not a number"),
        ("pressure_kPa", "1e400", "is too large"),
        ("yield_pressure_kPa", "3000", "looks like Pa: 3000 Pa is 3 kPa"),
        ("diameter_mm", "0.024", "looks like metres: 0.024 metres is 24 mm"),
        ("diameter_mm", "301", "is above 300 mm"),
        ("diameter_mm", "0.49", "is below 0.5 mm"),
        ("thickness_um", "6001", "is more than a quarter of the diameter (24 mm) (allowed: at most 6000 µm)"),
        ("thickness_um", "0", "is not above 0"),
        ("length_mm", "280000", "looks like µm: 280000 µm is 280 mm"),
        ("payload_g", "-3", "is below 0 g"),
        ("capture_fps", "0", "is not above 0"),
        ("growth_angle_deg", "200", "-180 to 180"),
        ("film_density_kg_m3", "1.2", "looks like g/cm³: 1.2 g/cm³ is 1200 kg/m³"),
        ("travel_ratio", "1.5", "2 for eversion, 1 for a body"),
        ("steady", "0.2", "is not a window (allowed: from_s:to_s, such as 0.05:0.20)"),
        ("steady", "0.2:0.1", "ends before it starts"),
        ("steady", "0.1:x", "is not a number"),
        ("bends", "1:2:3;4", "bend '4' that is not three numbers"),
        ("bends", "1:0:3", "not positive"),
        ("use", "perhaps", "neither yes nor no"),
        ("trial", "v 1", "is not a valid trial name"),
        ("trial", "-rf", "begins with a hyphen"),
        ("trial", "--help", "begins with a hyphen"),
        ("trial", "", "is blank"),
        ("trial", "../x", "is not a valid trial name"),
        ("trial", "x" * 101, "too long"),
        ("track", "../a.csv", "leads out of the experiment folder"),
        ("track", "/data/a.csv", "absolute path"),
        ("track", "C:/a.csv", "absolute path"),
        ("track", "", "neither a video nor a track"),
        ("video", "a.mp4", "has both a video and a track"),
        ("diameter_mm", "", "is blank"),
        ("thickness_um", "", "is blank"),
        ("length_mm", "", "is blank"),
        ("yield_pressure_kPa", "", "is blank"),
    ],
)
def test_a_broken_cell_is_named_with_file_line_trial_and_column(
    folder: Path, column: str, cell: str, words: str
) -> None:
    row = dict(zip(HEADER.split(","), ["a", "a.csv", "24", "200", "280", "28", "3", "35.6"], strict=True))
    row[column] = cell
    experiment = read_experiment(write(folder, ",".join(row) + "\n\n" + ",".join(row.values()) + "\n"))
    (problem,) = experiment.problems
    assert (problem.severity, problem.file, problem.line) == ("error", "trials.csv", 3)
    assert problem.trial == (row["trial"] if column != "trial" else "line-3")
    assert problem.column in (column, "track", "")
    assert words in str(problem)
    assert experiment.trials == ()
    assert list(experiment.failed) == [problem.trial]


@pytest.mark.parametrize(
    ("column", "cell", "words"),
    [
        ("pressure_kPa", "2.5", "psi"),
        ("yield_pressure_kPa", "0", "states that the vine grows at any pressure"),
        ("payload_g", "0.0356", "looks like kilograms"),
        ("thickness_um", "0.2", "looks like millimetres"),
        ("length_mm", "0.28", "looks like metres"),
        ("exposure_us,capture_fps", "1200,1000", "1.2 times the frame interval"),
        ("payload_gg", "3", "did you mean payload_g?"),
        ("remarks", "nice", "is not a column of the trial sheet and is ignored"),
    ],
)
def test_a_legal_oddity_is_a_warning(folder: Path, column: str, cell: str, words: str) -> None:
    row = dict(zip(HEADER.split(","), ["a", "a.csv", "24", "200", "280", "28", "3", "35.6"], strict=True))
    if column == "payload_gg":
        del row["payload_g"]
    row |= dict(zip(column.split(","), cell.split(","), strict=True))
    experiment = read_experiment(write(folder, ",".join(row) + "\n" + ",".join(row.values()) + "\n"))
    (problem,) = experiment.problems
    assert problem.severity == "warning"
    assert words in str(problem)
    assert len(experiment.trials) == 1


def test_a_yield_pressure_of_zero_with_its_error_is_believed(folder: Path) -> None:
    sheet = f"{HEADER},yield_pressure_sigma_kPa\na,a.csv,24,200,280,28,0,35.6,2\n"
    assert read_experiment(write(folder, sheet)).problems == ()


def test_a_pressure_that_looks_like_bar_is_a_warning(folder: Path) -> None:
    write(folder, GOOD.replace(",28,3,", ",0.28,0.03,"))
    (problem,) = read_experiment(folder).problems
    assert "looks like bar" in str(problem)


def test_the_same_oddity_in_many_rows_is_said_once(folder: Path) -> None:
    rows = "".join(f"t{i},a.csv,24,200,280,28,3,0.05\n" for i in range(30))
    (line,) = format_problems(read_experiment(write(folder, f"{HEADER}\n{rows}")).problems)
    assert "t0 and 29 more" in line


def test_names_that_differ_in_case_alone_are_a_warning(folder: Path) -> None:
    write(folder, GOOD.replace("\nb,", "\nA,"))
    (problem,) = read_experiment(folder).problems
    assert problem.severity == "warning"
    assert "in case only" in problem.message


def test_a_video_needs_its_rate_of_capture(folder: Path) -> None:
    sheet = GOOD.replace("track", "video").replace("trial,", "capture_fps,trial,").replace("\na", "\n1069,a")
    experiment = read_experiment(write(folder, sheet.replace("\nb", "\n,b")))
    assert [trial.capture_fps for trial in experiment.trials] == [1069]
    assert "playback" in experiment.failed["b"]


def test_videos_without_any_rate_of_capture_are_a_fault_of_the_sheet(folder: Path) -> None:
    (problem,) = stopped(write(folder, GOOD.replace("track", "video")))
    assert (problem.column, problem.message) == ("capture_fps", "is missing")


def test_dng_frames_carry_their_own_rate(folder: Path) -> None:
    (folder / "frames").mkdir()
    (folder / "frames" / "0001.DNG").write_bytes(b"II*")
    sheet = GOOD.replace("track", "video").replace("a.csv", "frames").replace("b.csv", "frames")
    experiment = read_experiment(write(folder, sheet))
    assert [trial.video for trial in experiment.trials] == [folder / "frames"] * 2
    assert experiment.problems == ()


@pytest.mark.parametrize("shared", [True, False])
def test_a_rate_of_playback_is_suspected(folder: Path, shared: bool) -> None:
    """30 fps is legal, but nobody films a vine at it."""
    row = "a,a.mp4,24,200,280,28,3,," + ("" if shared else "30")
    sheet = f"{HEADER.replace('track', 'video')},capture_fps\n{row}\n"
    experiment = read_experiment(write(folder, sheet, "capture_fps: 30\n" if shared else ""))
    assert [trial.capture_fps for trial in experiment.trials] == [30]
    (problem,) = experiment.problems
    assert (problem.severity, problem.file) == ("warning", "experiment.yaml" if shared else "trials.csv")
    assert "not the playback rate" in str(problem)


def test_a_falling_ball_needs_a_diameter_only(folder: Path) -> None:
    experiment = read_experiment(write(folder, "trial,track,diameter_mm,travel_ratio\nball,a.csv,10,1\n"))
    (trial,) = experiment.trials
    assert (trial.vine, trial.condition) == ("10mm", "10mm_0kPa_0g")
    assert (trial.pressure_Pa, trial.pressure_sigma_Pa, trial.yield_pressure_Pa) == (0, 0, 0)
    assert trial.linear_density_kg_m == 0
    assert experiment.problems == ()


def test_a_body_that_moves_as_a_whole_under_pressure_is_suspected(folder: Path) -> None:
    (problem,) = one(folder, "travel_ratio", "1").problems
    assert (problem.severity, problem.column) == ("warning", "pressure_kPa")


def test_a_blank_pressure_comes_from_the_track(folder: Path) -> None:
    lines = [line + f",{27.94 - i / 10}" for i, line in enumerate(TRACK.splitlines()[1:])]
    (folder / "a.csv").write_text("time_s,position_m,pressure_kPa\n" + "\n".join(lines))
    sheet = GOOD.replace("28,3", ",3")
    trial = read_experiment(write(folder, sheet)).trials[0]
    assert trial.pressure_Pa == pytest.approx(27.9e3)
    assert trial.pressure_sigma_Pa == pytest.approx(279)


def test_a_blank_pressure_comes_from_the_trace(folder: Path) -> None:
    (folder / "p.csv").write_text("time_s,pressure_kPa\n0,13.96\n0.1,13\n")
    sheet = f"{HEADER},pressure_trace\na,a.csv,24,200,280,,3,,p.csv\n"
    trial = read_experiment(write(folder, sheet)).trials[0]
    assert trial.pressure_Pa == pytest.approx(14.0e3)
    assert trial.pressure_trace == folder / "p.csv"


@pytest.mark.parametrize(
    ("trace", "words"),
    [
        (None, "carries no pressure"),
        ("time_s,pressure_kPa\n0,-3\n", "starts at -3 kPa"),
        ("time_s,pressure_kPa\n", "has no rows"),
        ("time_s,pressure_psi\n0,3\n", "lacks the column pressure_kPa"),
    ],
)
def test_a_blank_pressure_without_a_measured_one_fails_the_trial(folder: Path, trace: str | None, words: str) -> None:
    sheet = f"{HEADER},pressure_trace\na,a.csv,24,200,280,,3,,{'p.csv' if trace else ''}\n"
    if trace:
        (folder / "p.csv").write_text(trace)
    assert words in read_experiment(write(folder, sheet)).failed["a"]


def test_replicates_share_a_condition_whatever_the_capture(folder: Path) -> None:
    sheet = f"{HEADER},capture_fps,exposure_us,mm_per_px,steady\n"
    sheet += "a,a.csv,24,200,280,28,3,,1000,100,0.3,0:1\nb,b.csv,24.0,2e2,280.00,28.0,3,0,500,50,0.4,\n"
    a, b = read_experiment(write(folder, sheet)).trials
    assert a.condition == b.condition == "24mm-200um-280mm_28kPa_0g"


def test_a_condition_names_further_settings_only_where_they_differ(folder: Path) -> None:
    sheet = f"{HEADER},growth_angle_deg,chamber_l\na,a.csv,24,200,280,28,3,,0,3.7\nb,b.csv,24,200,280,28,3,,90,3.7\n"
    conditions = [trial.condition for trial in read_experiment(write(folder, sheet)).trials]
    assert conditions == ["24mm-200um-280mm_28kPa_0g_0deg", "24mm-200um-280mm_28kPa_0g_90deg"]


def test_the_yield_pressure_belongs_to_the_vine(folder: Path) -> None:
    sheet = f"{HEADER}\na,a.csv,24,200,280,28,3,\nb,b.csv,12,100,280,28,5,\n"
    assert [t.condition for t in read_experiment(write(folder, sheet)).trials] == [
        "24mm-200um-280mm_28kPa_0g",
        "12mm-100um-280mm_28kPa_0g",
    ]
    sheet = f"{HEADER}\na,a.csv,24,200,280,28,3,\nb,b.csv,24,200,280,28,5,\n"
    assert [t.condition for t in read_experiment(write(folder, sheet)).trials] == [
        "24mm-200um-280mm_28kPa_0g_yield3kPa",
        "24mm-200um-280mm_28kPa_0g_yield5kPa",
    ]


def test_a_sheet_from_a_german_spreadsheet(folder: Path) -> None:
    sheet = GOOD.replace(",", ";").replace("35.6", "35,6").replace("\n", "\r\n")
    (folder / "trials.csv").write_bytes(sheet.encode("utf-8-sig"))
    assert read_experiment(folder).trials[0].payload_kg == pytest.approx(0.0356)


@pytest.mark.parametrize(
    ("setting", "expected_m"), [("", 1e-4), ("position_systematic_mm: 0.25", 2.5e-4), ("position_systematic_mm: 0", 0)]
)
def test_positions_from_elsewhere_have_a_smooth_error_unless_it_is_stated(
    folder: Path, setting: str, expected_m: float
) -> None:
    (folder / "experiment.yaml").write_text(setting + "\n")
    assert read_experiment(folder).trials[0].position_systematic_m == pytest.approx(expected_m)
