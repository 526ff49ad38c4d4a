"""An experiment folder read whole: what becomes a trial, what is refused and how it is said."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from vinetrack.experiment import (
    Experiment,
    ExperimentError,
    Problem,
    check_experiment,
    format_problems,
    read_experiment,
)
from vinetrack.records import Bend, Trial

HEADER = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,payload_g"
GOOD = f"{HEADER}\na,a.csv,24,200,280,28,3,35.6\nb,b.csv,24,200,280,14,3,\n"
TRACK = "time_s,position_m\n" + "".join(f"{i / 1000},{i * i / 1e6}\n" for i in range(20))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "my-vines"
    path.mkdir()
    write(path, GOOD)
    for name in "ab":
        (path / f"{name}.csv").write_text(TRACK)
    return path


def write(folder: Path, sheet: str, settings: str | None = None) -> Path:
    (folder / "trials.csv").write_text(sheet, encoding="utf-8")
    if settings is not None:
        (folder / "experiment.yaml").write_text(settings, encoding="utf-8")
    return folder


def one(folder: Path, columns: str, cells: str, settings: str | None = None) -> Experiment:
    """An experiment of the one trial `a` with further columns."""
    return read_experiment(write(folder, f"{HEADER},{columns}\na,a.csv,24,200,280,28,3,35.6,{cells}\n", settings))


def stopped(folder: Path, strict: bool | None = None) -> tuple[Problem, ...]:
    with pytest.raises(ExperimentError) as caught:
        read_experiment(folder, strict)
    return caught.value.problems


def test_a_row_becomes_a_trial_in_si_units(folder: Path) -> None:
    experiment = read_experiment(folder)
    assert experiment.trials[0] == Trial(
        name="a",
        vine="24mm-200um-280mm",
        condition="24mm-200um-280mm_28kPa_35.6g",
        track=folder / "a.csv",
        capture_fps=experiment.trials[0].capture_fps,
        exposure_s=experiment.trials[0].exposure_s,
        diameter_m=0.024,
        thickness_m=200e-6,
        length_m=0.28,
        pressure_Pa=28e3,
        pressure_sigma_Pa=280.0,
        yield_pressure_Pa=3e3,
        yield_pressure_sigma_Pa=200.0,
        payload_kg=0.0356,
        chamber_m3=experiment.trials[0].chamber_m3,
        inlet_m=experiment.trials[0].inlet_m,
        m_per_px=experiment.trials[0].m_per_px,
    )
    unknown = experiment.trials[0]
    assert all(math.isnan(x) for x in (unknown.capture_fps, unknown.exposure_s, unknown.chamber_m3, unknown.m_per_px))
    assert experiment.trials[1].payload_kg == 0.0
    assert experiment.problems == ()


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
        ("thickness_um", "6001", "is a wall above a quarter of the diameter of 24 mm (allowed: at most 6000 µm)"),
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
        ("trial", "v 1", "is no name for a trial"),
        ("trial", "", "is blank"),
        ("trial", "../x", "is no name for a trial"),
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
        ("payload_g", "0.0356", "looks like kilograms"),
        ("thickness_um", "0.2", "looks like millimetres"),
        ("length_mm", "0.28", "looks like metres"),
        ("exposure_us,capture_fps", "2000,1000", "longer than a frame"),
        ("payload_gg", "3", "did you mean payload_g?"),
        ("remarks", "nice", "is no column of a trial sheet and is ignored"),
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


def test_a_pressure_that_looks_like_bar_is_a_warning(folder: Path) -> None:
    write(folder, GOOD.replace(",28,3,", ",0.28,0.03,"))
    (problem,) = read_experiment(folder).problems
    assert "looks like bar" in str(problem)


def test_the_same_oddity_in_many_rows_is_said_once(folder: Path) -> None:
    rows = "".join(f"t{i},a.csv,24,200,280,28,3,0.05\n" for i in range(30))
    (problem,) = read_experiment(write(folder, f"{HEADER}\n{rows}")).problems
    assert "29 more rows" in problem.message


def test_names_that_differ_in_case_alone_are_a_warning(folder: Path) -> None:
    write(folder, GOOD.replace("\nb,", "\nA,"))
    (problem,) = read_experiment(folder).problems
    assert problem.severity == "warning"
    assert "in case alone" in problem.message


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
    assert "not that of playback" in str(problem)


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


@pytest.mark.parametrize("column", ["trial", "diameter_mm", "thickness_um", "length_mm", "yield_pressure_kPa"])
def test_a_missing_column_stops_the_experiment_with_one_problem(folder: Path, column: str) -> None:
    cells = [line.split(",") for line in GOOD.splitlines()]
    drop = cells[0].index(column)
    write(folder, "\n".join(",".join(cell for i, cell in enumerate(row) if i != drop) for row in cells))
    errors = [problem for problem in stopped(folder) if problem.column == column]
    assert len(errors) == 1
    assert "is missing" in str(errors[0])


def test_a_sheet_without_recordings_is_refused(folder: Path) -> None:
    write(folder, "trial,diameter_mm\na,24\n")
    assert any("neither a column video nor a column track" in str(problem) for problem in stopped(folder))


def test_a_name_used_twice_stops_the_experiment(folder: Path) -> None:
    write(folder, GOOD.replace("\nb,", "\na,"))
    (problem,) = stopped(folder)
    assert (problem.line, problem.message) == (3, "is also the name of line 2")


def test_a_sheet_without_rows_is_refused(folder: Path) -> None:
    assert "has no rows" in str(stopped(write(folder, HEADER + "\n"))[0])


def test_all_problems_of_sheet_and_settings_come_at_once(folder: Path) -> None:
    write(folder, GOOD.replace(",28,", ",28000,").replace("\nb,", "\na,"), "strikt: true\ntail_slack: none\n")
    found = stopped(folder)
    assert {(problem.file, problem.column) for problem in found} == {
        ("experiment.yaml", "strikt"),
        ("experiment.yaml", "tail_slack"),
        ("trials.csv", "trial"),
        ("trials.csv", "pressure_kPa"),
    }


def test_broken_settings_bring_no_false_alarms_about_the_sheet(folder: Path) -> None:
    write(folder, "trial,track,pressure_kPa\na,a.csv,\n", "diameter_mm: 24\nlength_mm: [\n")
    assert {problem.file for problem in stopped(folder)} == {"experiment.yaml"}


@pytest.mark.parametrize(
    "settings",
    [
        "calibration: {kind: checkerboard, image: ../a.png, squares: [5, 5], square_mm: 5}",
        "effects: [/home/me/drag.py]",
    ],
)
def test_paths_in_the_settings_stay_inside(folder: Path, settings: str) -> None:
    (problem,) = stopped(write(folder, GOOD, settings))
    assert problem.file == "experiment.yaml"


def test_a_folder_that_is_none_is_named(folder: Path) -> None:
    assert "does not exist" in str(stopped(folder / "none")[0])
    assert "is a file, not a folder" in str(stopped(folder / "trials.csv")[0])


def test_an_empty_folder_names_what_was_expected(tmp_path: Path) -> None:
    (problem,) = stopped(tmp_path)
    assert "the folder is empty; expected a folder with trials.csv" in str(problem)


@pytest.mark.parametrize(
    ("name", "remedy"), [("Trials.csv", "rename Trials.csv"), ("trials.xlsx", "save trials.xlsx as trials.csv")]
)
def test_a_sheet_of_nearly_the_right_name_is_pointed_at(tmp_path: Path, name: str, remedy: str) -> None:
    (tmp_path / name).write_text(GOOD)
    (problem,) = stopped(tmp_path)
    assert remedy in problem.remedy


def test_an_unquoted_decimal_comma_is_explained(folder: Path) -> None:
    experiment = read_experiment(write(folder, GOOD.replace("14,3,", "14,5,3,0")))
    assert "decimal commas" in experiment.failed["b"]


def test_a_sheet_from_a_german_spreadsheet(folder: Path) -> None:
    sheet = GOOD.replace(",", ";").replace("35.6", "35,6").replace("\n", "\r\n")
    (folder / "trials.csv").write_bytes(sheet.encode("utf-8-sig"))
    assert read_experiment(folder).trials[0].payload_kg == pytest.approx(0.0356)


def test_check_reads_every_track(folder: Path) -> None:
    (folder / "b.csv").write_text("time_s,position_m\n0,0\n1,1\n")
    (problem,) = check_experiment(folder)
    assert (problem.trial, problem.line, problem.column, problem.value) == ("b", 3, "track", "b.csv")
    assert "has 2 points: at least 5 are needed" in str(problem)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "does not exist"),
        ("time_s,position_m\n" + "1,1\n" * 6, "line 3, column time_s: time does not increase"),
        (TRACK.replace("0.0001", "oops"), "is not a number"),
        ("time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},28000\n" for i in range(6)), "looks like Pa"),
    ],
)
def test_check_names_what_is_wrong_with_a_track(folder: Path, content: str | None, words: str) -> None:
    (folder / "b.csv").unlink()
    if content is not None:
        (folder / "b.csv").write_text(content)
    (problem,) = check_experiment(folder)
    assert problem.severity == "error"
    assert words in str(problem)


def test_check_holds_the_spacing_against_the_rate_of_capture(folder: Path) -> None:
    sheet = f"{HEADER},capture_fps\na,a.csv,24,200,280,28,3,,1000\nb,b.csv,24,200,280,28,3,,240\n"
    (problem,) = check_experiment(write(folder, sheet))
    assert (problem.severity, problem.trial) == ("warning", "b")
    assert "0.24 frames" in problem.message


def test_check_suspects_millimetres_taken_for_metres(folder: Path) -> None:
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{10 * i}\n" for i in range(20)))
    (problem,) = check_experiment(folder)
    assert "are its positions in metres?" in problem.message


def test_check_suspects_psi_in_a_trace(folder: Path) -> None:
    (folder / "p.csv").write_text("time_s,pressure_kPa\n0,4.06\n1,4\n")
    (problem,) = check_experiment(write(folder, f"{HEADER},pressure_trace\na,a.csv,24,200,280,28,3,,p.csv\n"))
    assert "the sheet says 28 kPa" in problem.message


def test_check_looks_at_videos_and_calls_who_can_open_them(folder: Path) -> None:
    (folder / "a.mp4").write_bytes(b"film")
    (folder / "b.mp4").write_bytes(b"")
    rows = "".join(f"{name},{name}.mp4,24,200,280,28,3,\n" for name in "abc")
    write(folder, f"{HEADER.replace('track', 'video')}\n{rows}", "capture_fps: 1000\n")
    opened: list[str] = []

    def open_video(trial: Trial) -> list[Problem]:
        opened.append(trial.name)
        return [Problem(message="cannot be decoded", column="video")]

    found = check_experiment(folder, open_video)
    assert opened == ["a"]
    assert [(problem.trial, problem.message) for problem in found] == [
        ("a", "cannot be decoded"),
        ("b", "is an empty file"),
        ("c", "does not exist"),
    ]


def test_check_finds_a_missing_calibration_picture(folder: Path) -> None:
    write(folder, GOOD, "calibration: {kind: checkerboard, image: c.png, squares: [5, 5], square_mm: 5}\n")
    (problem,) = check_experiment(folder)
    assert (problem.file, problem.column, problem.message) == ("experiment.yaml", "calibration.image", "does not exist")


def test_check_returns_the_problems_of_an_experiment_that_cannot_be_read(tmp_path: Path) -> None:
    assert len(check_experiment(tmp_path / "none")) == 1


def test_twenty_lines_at_most_and_the_last_says_how_many_more() -> None:
    many = [Problem(message="is odd", column=f"c{i}", severity="warning") for i in range(30)]
    lines = format_problems([*many, Problem(message="is wrong")])
    assert len(lines) == 20
    assert lines[0] == "error: is wrong"
    assert lines[-1] == "… and 12 more (0 errors, 12 warnings)"
    assert len(format_problems(many[:20])) == 20


def test_a_cell_cannot_forge_lines_of_the_report(folder: Path) -> None:
    sheet = f'{HEADER}\na,a.csv,24,200,280,"2\nerror: all is lost",3,\n'
    (line,) = format_problems(read_experiment(write(folder, sheet)).problems)
    assert "\n" not in line
