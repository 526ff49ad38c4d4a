"""An experiment folder and its settings read and checked: what becomes a trial, what fails one, what stops all."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hand_sheet import GOOD, HEADER, TRACK, one, stopped, two_vines, write
from pydantic import BaseModel

from vinetrack.core.problems import ExperimentError, Problem, format_problems
from vinetrack.core.records import Bend, Correction, PictureAxis, Trial
from vinetrack.core.tables import read_yaml
from vinetrack.core.units import convert, other_units, pressure_text, split_unit
from vinetrack.experiment import folder as sheets
from vinetrack.experiment import settings as keys
from vinetrack.experiment.folder import Experiment, check_experiment, planned_sheet, read_experiment
from vinetrack.experiment.schema import COLUMNS, SHARED, with_names
from vinetrack.experiment.settings import ExperimentSettings, RunSettings, read_experiment_settings, run_settings
from vinetrack.pipeline.workflow import model_problems
from vinetrack.video.survey import in_no_row

CONFIG = Path(__file__).parents[2] / "config" / "config.yaml"
PRESSURES = (20, 20, 24, 24, 28, 28, 32, 32, 36, 36)
VINE = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "28"}
PSI = 6894.757293168361
NUMBERS = [column for column in COLUMNS.values() if column.kind == "number" and other_units(column.name)]


@pytest.fixture
def folder(tmp_path):
    return two_vines(tmp_path)


def test_blanks_that_matter_are_noted_with_what_they_stand_for_or_keep_from_being_tried(folder):
    said = {note.split()[0]: note for note in read_experiment(folder).blank_notes}
    assert list(said) == ["growth_angle_deg", "chamber_l", "inlet_mm", "film_density_kg_m3"]
    assert "1200" in said["film_density_kg_m3"]
    assert "reservoir_depletion" in said["chamber_l"]
    stated = one(folder, payload_g=None, growth_angle_deg="0", film_density_kg_m3="920", chamber_l="2", inlet_mm="6")
    assert [note.split()[0] for note in stated.blank_notes] == ["payload_g"]
    for other, warned in (("35.6", []), ("0", [("blank", "b", "payload_g")])):
        read = read_experiment(write(folder, GOOD.replace(",3,0\n", ",3,\n").replace("35.6", other)))
        assert [(one.code, one.trial, one.column) for one in read.problems] == warned


def test_pressures_that_are_all_below_the_yield_pressure_stop_and_some_warn(folder):
    written = GOOD.replace("pressure_kPa,y", "pressure_bar,y").replace(",28,", ",0.028,").replace(",14,", ",0.014,")
    told = [one for one in stopped(write(folder, written)) if one.severity == "error"]
    assert [(one.code, one.trial) for one in told] == [("no_growth", "a"), ("no_growth", "b")]
    assert len(format_problems(told)) == 1
    pascal = GOOD.replace(",28,", ",28000,").replace(",14,", ",14000,")
    assert len(format_problems(read_experiment(write(folder, pascal)).problems)) == 1
    some = read_experiment(write(folder, GOOD.replace(",14,", ",2.5,"))).problems
    assert [(one.code, one.severity, one.trial) for one in some] == [("no_growth", "warning", "b")]


def test_a_row_becomes_a_trial_in_si_units(folder):
    def known(trial: Trial) -> dict[str, object]:
        return {name: value for name, value in vars(trial).items() if value == value}  # NaN equals nothing

    experiment = read_experiment(folder)
    a, b = experiment.trials
    expected = Trial(
        name="a", vine="24mm-200um-280mm", condition="24mm-200um-280mm_28kPa_35.6g", track=folder / "a.csv",
        diameter_m=0.024, thickness_m=200e-6, length_m=0.28, pressure_Pa=28e3, pressure_sigma_Pa=280.0,
        yield_pressure_Pa=3e3, yield_pressure_sigma_Pa=200.0, payload_kg=0.0356,
    )  # fmt: skip
    assert known(a) == known(expected)
    assert (b.payload_kg, experiment.problems) == (0.0, ())
    cells = {"capture_fps": "1000", "exposure_us": "100", "growth_angle_deg": "90", "chamber_l": "3.7", "inlet_mm": "6"}
    cells |= {"bends": "100:30:20;200:50:25", "film_density_kg_m3": "1180", "mm_per_px": "0.37", "steady": "0.05:0.2"}
    cells |= {"pressure_sigma_kPa": "0.5", "yield_pressure_sigma_kPa": "0.1", "frames_used": "5:15", "order": "9"}
    cells |= {"axis": "161,40:170,300:151.5,799:20", "specimen": "tube 1", "day": "monday"}
    expected = replace(
        expected, capture_fps=1000.0, exposure_s=1e-4, growth_angle_rad=math.pi / 2, chamber_m3=3.7e-3, inlet_m=6e-3,
        bends=(Bend(0.1, 0.03, 0.02), Bend(0.2, 0.05, 0.025)), film_density_kg_m3=1180.0, m_per_px=0.37e-3,
        steady_window_s=(0.05, 0.2), pressure_sigma_Pa=500.0, yield_pressure_sigma_Pa=100.0, frames_used=(5, 15),
        order=9.0, axis=PictureAxis((161.0, 40.0), (151.5, 799.0), 0.02, ((170.0, 300.0),)), specimen="tube 1",
        day="monday",
    )  # fmt: skip
    assert known(one(folder, **cells).trials[0]) == known(expected)


def test_shared_settings_fill_blank_cells_and_a_cell_overrides_them(folder):
    sheet = "trial,track,thickness_um,length_mm,pressure_kPa\na,a.csv,200,280,28\nb,b.csv,,280,\n"
    shared = "diameter_mm: 24\nthickness_um: 150\npressure_kPa: 14\nyield_pressure_kPa: 3\nambient_pressure_kPa: 84\n"
    a, b = read_experiment(write(folder, sheet, shared + "mass_loss: as_printed\ntail_slack: free\n")).trials
    assert (a.thickness_m, b.thickness_m) == (200e-6, 150e-6)
    assert (a.pressure_Pa, b.pressure_Pa) == (28e3, 14e3)
    assert a.diameter_m == 0.024
    assert (a.ambient_pressure_Pa, a.mass_loss, a.tail_slack) == (84e3, "as_printed", "free")


def test_a_fault_of_one_row_fails_that_trial_alone_unless_strict(folder):
    write(folder, GOOD.replace("b,b.csv,24", "b,b.csv,0.024"))
    experiment = read_experiment(folder)
    assert ([trial.name for trial in experiment.trials], list(experiment.failed)) == (["a"], ["b"])
    assert "0.024 metres (24 mm)" in experiment.failed["b"]
    assert experiment.names == ("a", "b")
    assert [problem.trial for problem in stopped(folder, strict=True)] == ["b"]
    (folder / "experiment.yaml").write_text("strict: true\n")
    assert [problem.trial for problem in stopped(folder)] == ["b"]
    assert list(read_experiment(folder, strict=False).failed) == ["b"]


def test_a_trial_put_aside_is_listed_and_not_judged(folder):
    sheet = f"{HEADER},use\na,a.csv,24,200,280,28,3,35.6,yes\nb,b.csv,,,,oops,,,no\n"
    experiment = read_experiment(write(folder, sheet), strict=True)
    assert [trial.name for trial in experiment.trials] == ["a"]
    assert list(experiment.left_out) == ["b"]
    assert experiment.failed == {}
    assert {problem.severity for problem in experiment.problems} == {"warning"}


def test_a_cell_may_state_a_unit_of_its_own(folder):
    given = {"diameter_mm": "2.4 cm", "thickness_um": "0.2mm", "pressure_kPa": "4 psi", "length_mm": "280 MM"}
    (trial,) = one(folder, **given).trials
    sizes = (trial.diameter_m, trial.thickness_m, trial.pressure_Pa, trial.length_m)
    assert sizes == pytest.approx((0.024, 200e-6, 27579.03, 0.28), rel=1e-6)
    told = one(folder, pressure_bar="220", pressure_kPa=None).failed["a"]
    assert told.endswith("is it 220 mbar (0.22 bar) or 220 kPa (2.2 bar)?")


FAULTS = {
    "diameter_mm": ("", "0.024", "abc", "nan", "-3", "301", "1e400", "24 kPa"),
    "thickness_um": ("", "0", "80000", "1_0"),
    "length_mm": ("", "1e9", "٣"),
    "pressure_kPa": ("24000", "-1", "28 furlong", "0x1F"),
    "yield_pressure_kPa": ("", "3000", "-0.1"),
    "payload_g": ("-1", "none", "1e9", "2\nerror: all is lost"),
    "growth_angle_deg": ("181", "down", "1 2"),
    "bends": ("1:2", "1:2:0", "a:b:c", "::"),
    "steady": ("1", "2:1", "1:1", "a:b", "1:2:3"),
    "trial": ("", "-rf", "v 1", "a/b", "..", "é", "x" * 200),
    "track": ("", "../a.csv", "/a.csv", "C:/a.csv", "a/../../b.csv"),
    "video": ("a.mp4",),  # beside a track
    "use": ("perhaps",),
    "travel_ratio": ("1.5",),
    "film_density_kg_m3": ("1.2",),
    "capture_fps": ("0",),
    "chamber_l": ("3700",),
    "axis": ("161,40", "161,40:165,40", "161,40:151,799:0", "161,40:162,41:151,799", "161,40:162:151,799"),
    "frames_used": ("20:5", "a:5"),
}


@pytest.mark.parametrize(("column", "cell"), [(column, cell) for column, cells in FAULTS.items() for cell in cells])
def test_a_broken_cell_is_named_with_file_line_trial_and_column(folder, column, cell):
    experiment = one(folder, **{column: cell})
    (problem,) = experiment.problems
    assert (problem.severity, problem.file, problem.line) == ("error", "trials.csv", 2)
    assert problem.trial == ("a" if column != "trial" else "line-2")
    assert problem.column in (column, "track", "")
    (line,) = format_problems(experiment.problems)
    assert len(line) < 400
    assert "\n" not in line
    assert experiment.trials == ()
    assert list(experiment.failed) == [problem.trial]


def test_a_legal_oddity_is_a_warning(folder):
    for cells in (
        {"pressure_kPa": "0.28", "yield_pressure_kPa": "0.03"},  # bar
        {"yield_pressure_kPa": "0"},
        {"payload_g": "0.0356"},  # kilograms
        {"thickness_um": "0.2"},  # millimetres
        {"length_mm": "0.28"},  # metres
        {"exposure_us": "1200", "capture_fps": "1000"},  # longer than a frame
        {"remarks": "nice"},
    ):
        experiment = one(folder, **cells)
        (problem,) = experiment.problems
        assert problem.severity == "warning"
        assert problem.column == next(iter(cells))
        assert len(experiment.trials) == 1
    # A yield pressure of zero with its error is believed.
    assert one(folder, yield_pressure_kPa="0", yield_pressure_sigma_kPa="2").problems == ()


def test_a_video_needs_its_rate_of_capture_but_dng_frames_carry_their_own(folder):
    sheet = GOOD.replace("track", "video").replace("trial,", "capture_fps,trial,").replace("\na", "\n1069,a")
    experiment = read_experiment(write(folder, sheet.replace("\nb", "\n,b")))
    assert [trial.capture_fps for trial in experiment.trials] == [1069]
    assert "playback" in experiment.failed["b"]
    (folder / "frames").mkdir()
    (folder / "frames" / "0001.DNG").write_bytes(b"II*")
    experiment = one(folder, track=None, video="frames")
    assert (experiment.trials[0].video, experiment.problems) == (folder / "frames", ())


def test_a_rate_of_playback_is_suspected(folder):
    for file, settings, cell in (("experiment.yaml", "capture_fps: 30\n", ""), ("trials.csv", "", "30")):
        experiment = one(folder, settings, track=None, video="a.mp4", capture_fps=cell)
        assert [trial.capture_fps for trial in experiment.trials] == [30]
        assert [(problem.severity, problem.file) for problem in experiment.problems] == [("warning", file)]


def test_a_falling_ball_needs_a_diameter_only(folder):
    experiment = read_experiment(write(folder, "trial,track,diameter_mm,travel_ratio\nball,a.csv,10,1\n"))
    (trial,) = experiment.trials
    assert (trial.vine, trial.condition) == ("10mm", "10mm_0kPa_0g")
    assert (trial.pressure_Pa, trial.pressure_sigma_Pa, trial.yield_pressure_Pa) == (0, 0, 0)
    assert trial.linear_density_kg_m == 0
    assert experiment.problems == ()


def test_a_blank_pressure_comes_from_the_track_or_the_trace_or_fails_the_trial(folder):
    lines = [line + f",{27.94 - i / 10}" for i, line in enumerate(TRACK.splitlines()[1:])]
    (folder / "b.csv").write_text("time_s,position_m,pressure_kPa\n" + "\n".join(lines))
    (folder / "p.csv").write_text("time_s,pressure_kPa\n0,13.96\n0.1,13\n")
    for cells, pressure_Pa in (({"track": "b.csv"}, 27.9e3), ({"pressure_trace": "p.csv"}, 14e3)):
        (trial,) = one(folder, pressure_kPa="", **cells).trials
        assert (trial.pressure_Pa, trial.pressure_sigma_Pa) == pytest.approx((pressure_Pa, 0.01 * pressure_Pa))
    assert trial.pressure_trace == folder / "p.csv"
    assert list(one(folder, pressure_kPa="").failed) == ["a"]
    for trace in ("time_s,pressure_kPa\n0,-3\n", "time_s,pressure_kPa\n", "time_s,pressure_psi\n0,3\n"):
        (folder / "p.csv").write_text(trace)
        assert list(one(folder, pressure_kPa="", pressure_trace="p.csv").failed) == ["a"], trace


def test_the_smooth_error_of_positions_from_elsewhere_is_unknown_unless_it_is_stated(folder):
    for setting, expected_m in (("", math.nan), ("_systematic_mm: 0.25", 2.5e-4), ("_systematic_mm: 0", 0)):
        trial = one(folder, f"position{setting}\n" if setting else "").trials[0]
        assert trial.position_systematic_m == pytest.approx(expected_m, nan_ok=True)
    demo = read_experiment_settings(Path(__file__).parents[2] / "data" / "demo" / "experiment.yaml")
    assert [sheets.systematic_of_travel(demo, elsewhere) for elsewhere in (False, True)] == [5e-5, 4e-4]


def test_check_names_the_trial_whose_track_is_wrong(folder):
    path = folder / "b.csv"
    path.unlink()
    one_moment, two_points = "time_s,position_m\n" + "1,1\n" * 6, "time_s,position_m\n0,0\n1,1\n"
    in_Pa = "time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},28000\n" for i in range(6))
    for content in (None, one_moment, two_points, TRACK.replace("0.0001", "oops"), in_Pa):
        if content is not None:
            path.write_text(content)
        (problem,) = check_experiment(folder)
        assert (problem.severity, problem.trial, problem.column) == ("error", "b", "track")


def filmed(folder: Path, videos: dict[str, str], files: Iterable[str], settings: str = "", aside: str = "") -> Path:
    """A sheet of recordings by trial, that one put aside, and the files that are there."""
    for name in files:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"film")
    rows = [f"{name},{video},24,200,280,28,3,,{'no' * (name == aside)}\n" for name, video in videos.items()]
    return write(folder, f"{HEADER.replace('track', 'video')},use\n{''.join(rows)}", settings)


def test_check_looks_at_videos_and_calls_who_can_open_them(folder):
    filmed(folder, {name: f"{name}.mp4" for name in "abc"}, ["a.mp4"], "capture_fps: 1000\n")
    (folder / "b.mp4").write_bytes(b"")
    opened: list[str] = []

    def open_videos(experiment: Experiment, trials: list[Trial]) -> list[Problem]:
        opened.extend(f"{experiment.name}/{trial.name}" for trial in trials)
        return [Problem("codec", column="video", trial="a"), Problem("no_scale", file="x")]

    found = check_experiment(folder, open_videos)
    assert opened == ["my-vines/a"]
    assert [(problem.file, problem.line, problem.trial, problem.code) for problem in found] == [
        ("trials.csv", 3, "b", "empty"),
        ("trials.csv", 4, "c", "no_file"),
        ("trials.csv", 2, "a", "codec"),
        ("x", 0, "", "no_scale"),
    ]


def test_a_misspelt_video_is_answered_with_the_file_that_no_trial_uses(folder):
    videos = {"a": "d12_24kPa_1.mp4", "b": "d12_24kP_2.mp4", "c": "other.avi", "d": "x.mp4"}
    filmed(folder, videos, ("d12_24kPa_1.mp4", "d12_24kPa_2.MP4", "day/x.mp4"), "capture_fps: 1000\n")
    remedies = {problem.trial: problem.remedy for problem in check_experiment(folder) if problem.trial}
    said = ("did you mean d12_24kPa_2.MP4?", "check the path and its upper and lower case", "did you mean day/x.mp4?")
    assert remedies == dict(zip("bcd", said, strict=True))


def test_one_recording_of_two_trials_is_a_warning(folder):
    for aside, named in (("", ["b"]), ("b", [])):
        filmed(folder, {"a": "v.mp4", "b": "v.mp4"}, [], "capture_fps: 1000\n", aside)
        assert [one.trial for one in read_experiment(folder).problems if one.code == "twice"] == named


def test_a_recording_that_no_row_names_is_named(folder):
    files = ["a.mp4", "left.mov", "day 2/extra.avi", "calibration/board.mp4", "target.mp4"]
    files += [f"burst/{i}.png" for i in range(5)]
    target = "calibration: {kind: checkerboard, image: target.mp4, squares: [5, 5], square_mm: 5}\n"
    videos = {"a": "./a.mp4", "b": "left.mov"}
    filmed(folder, videos, files, "capture_fps: 1000\n" + target, aside="b")
    (problem,) = in_no_row(read_experiment(folder))
    assert (problem.severity, problem.file, problem.column) == ("warning", "trials.csv", "")
    assert problem.message.endswith(" burst, day 2/extra.avi")
    filmed(folder, videos | {"c": "burst/0.png", "d": "day 2/extra.avi"}, files, "capture_fps: 1000\n" + target, "b")
    assert in_no_row(read_experiment(folder)) == []


def test_a_value_that_stands_in_the_settings_alone_is_faulted_there_and_once(folder):
    filmed(folder, {"a": "a.mp4", "b": "b.mp4"}, ("a.mp4", "b.mp4"), "capture_fps: 60\n")

    def slow(_experiment: Experiment, trials: list[Trial]) -> list[Problem]:
        return [Problem("playback", "is the rate of playback", "capture_fps", trial=trial.name) for trial in trials]

    found = check_experiment(folder, slow)
    assert [(one.file, one.line, one.trial) for one in found] == [("experiment.yaml", 0, name) for name in "ab"]
    assert format_problems(found) == ["error: experiment.yaml, trial a and 1 more: capture_fps is the rate of playback"]


def test_a_missing_column_stops_the_experiment_with_one_problem(folder):
    for column in ("trial", "diameter_mm", "thickness_um", "length_mm", "yield_pressure_kPa"):
        cells = [line.split(",") for line in GOOD.splitlines()]
        drop = cells[0].index(column)
        write(folder, "\n".join(",".join(row[:drop] + row[drop + 1 :]) for row in cells))
        assert [problem.code for problem in stopped(folder) if problem.column == column] == ["missing"]
    assert [problem.code for problem in stopped(write(folder, f"Vines of Tuesday,,,\n{GOOD}"))] == ["no_columns"]


def test_files_of_the_settings_are_there_and_inside(folder):
    target = "calibration: {kind: checkerboard, image: %s, squares: [5, 5], square_mm: 5}\n"
    (problem,) = check_experiment(write(folder, GOOD, target % "c.png"))
    assert (problem.file, problem.column, problem.code) == ("experiment.yaml", "calibration.image", "no_file")
    for settings in (target % "../a.png", "effects: [/home/me/drag.py]"):
        (problem,) = check_experiment(write(folder, GOOD, settings))
        assert (problem.file, stopped(folder)) == ("experiment.yaml", (problem,))


def test_all_problems_of_sheet_and_settings_come_at_once(folder):
    write(folder, GOOD.replace(",28,", ",28000,").replace("\nb,", "\na,"), "strikt: true\ntail_slack: none\n")
    assert {(problem.file, problem.column, problem.line) for problem in stopped(folder)} == {
        ("experiment.yaml", "strikt", 1),
        ("experiment.yaml", "tail_slack", 2),
        ("trials.csv", "trial", 3),
        ("trials.csv", "pressure_kPa", 2),
    }


def test_broken_settings_bring_no_false_alarms_about_the_sheet(folder):
    write(folder, "trial,track,pressure_kPa,payload_g\na,a.csv,,\nb,b.csv,,0\n", "diameter_mm: 24\nlength_mm: [\n")
    assert {problem.file for problem in stopped(folder)} == {"experiment.yaml"}


def test_names_in_the_settings_are_looked_up(folder):
    base = "pressure_drive, gravity, eversion_damping, yield_pressure"
    for settings, columns in (
        (f"model: [{base}, air_drag]\n", []),
        (f"model: [{base}, air_drg]\n", ["model"]),
        ("candidates: [leek]\n", ["candidates"]),
        (f"model: [{base}, reservoir_depletion]\n", ["model"]),  # it needs `chamber_l`
        ("effects: [not_there.py]\n", []),
    ):
        read_back = read_experiment(write(folder, GOOD, settings), strict=False)
        found = [(problem.file, problem.column) for problem in model_problems(read_back)]
        assert found == [("experiment.yaml", column) for column in columns], settings


def read(tmp_path: Path, text: str) -> ExperimentSettings:
    (tmp_path / "experiment.yaml").write_text(text, encoding="utf-8")
    return read_experiment_settings(tmp_path / "experiment.yaml")


def draft_problems(tmp_path: Path, text: str) -> tuple[Problem, ...]:
    with pytest.raises(ExperimentError) as caught:
        read(tmp_path, text)
    return caught.value.problems


def test_settings_cover_exactly_the_columns_of_the_sheet():
    assert set(SHARED) == set(COLUMNS) - {"trial", "video", "track", "order", "axis", "frames_used", "point_mass"}
    assert set(SHARED) <= set(ExperimentSettings.model_fields)


def test_limits_of_the_next_experiment_are_ranges_and_choices(tmp_path):
    text = "{pressure_kPa: 7:40, payload_g: [0, 50], diameter_mm: [24, 12], chamber_l: 3.7, growth_angle_deg: 0:180}"
    limits = read(tmp_path, f"limits: {text}\n").limits
    assert (limits.pressure_kPa, limits.payload_g) == ((7.0, 40.0), (0.0, 50.0))
    assert (limits.diameter_mm, limits.chamber_l) == ((12.0, 24.0), (3.7,))
    assert limits.growth_angle_deg == (0.0, 45.0, 90.0, 135.0, 180.0)
    assert (limits.thickness_um, limits.trials, limits.hoop_stress_MPa) == (None, 4, 7.8)
    assert read(tmp_path, "steady: 1:20\n").steady == (1.0, 20.0)  # no number in base sixty


def test_what_is_no_mapping_is_refused(tmp_path):
    for text in ("- a\n- b\n", "just text\n", "3\n", "payload_g: [1, 2\nuse: yes\n"):
        (problem,) = draft_problems(tmp_path, text)
        assert problem.file == "experiment.yaml"
    (problem,) = draft_problems(tmp_path, "strict: true\npayload_g: 1\nstrict: false\n")
    assert (problem.column, problem.line) == ("strict", 3)


NOT_ALLOWED = {
    "pressure_kPa": ("24000", ".nan", "12 furlong", "true", "[1, 2]"),
    "diameter_mm": ("0.024",),
    "travel_ratio": ("3",),
    "steady": ("0.2:0.1",),
    "bends": ("1:2",),
    "tail_slack": ("loose",),
    "position_systematic_mm": ("-1",),
    "mass_loss": ("none",),
    "model": ("[gravity, gravity]", "gravity"),
    "ambient_pressure_kPa": ("101325", "true"),
    "strict": ("3",),
    "axis": ("3", "{from_px: [1, 1], to_px: [9, 1]}", "{from_px: [1, 1], via_px: [[2, 2]], to_px: [9, 9]}"),
    "calibration": (
        "{kind: mm_per_px, mm_per_px: 0}",
        "{kind: mm_per_px}",
        "{kind: chess}",
        "{kind: mm_per_px, mm_per_px: 0.3, kinds: 3}",
        "{kind: charuco, image: a, squares: [5, 5], square_mm: 5, marker_mm: 5, dictionary: DICT_A}",
    ),
    "limits": (
        *("{pressure_kPa: 7}", "{pressure_kPa: 40:7}", "{payload_g: 0:1e6}", "{pressure_kPa: 7000:9000}"),
        *("{diameter_mm: [0.012]}", "{thickness_um: []}", "{chamber_l: [[1, 2]]}", "{trials: 0}", "{presure_kPa: 1:2}"),
    ),
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in NOT_ALLOWED.items() for value in values])
def test_a_value_that_is_not_allowed_is_named_with_its_key(tmp_path, key, value):
    (problem,) = draft_problems(tmp_path, f"# first line\n{key}: {value}\n")
    assert problem.line == 2
    assert problem.column.startswith(key)


def _keys(model: type[BaseModel]) -> dict:
    return {
        name: _keys(type(field.default)) if isinstance(field.default, BaseModel) else None
        for name, field in model.model_fields.items()
    }


def test_the_shipped_config_holds_every_key_at_its_default():
    assert run_settings(read_yaml(CONFIG).content) == RunSettings()
    content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    shipped = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in content.items()}
    assert shipped == _keys(RunSettings)
    assert run_settings({"experiment": 2024}).experiment == "2024"


def test_a_wrong_run_setting_is_named():
    for column, values in {
        "experimant": {"experimant": "x"},
        "damping.sead": {"damping": {"sead": 1}},
        "velocity.order": {"velocity": {"order": 0}},
        "figures.formats": {"figures": {"formats": []}},
        "figures.formats.0": {"figures": {"formats": ["bmp"]}},
        "final_at_fraction": {"final_at_fraction": 1.5},
        "efficiency_at_mm": {"efficiency_at_mm": float("nan")},
    }.items():
        with pytest.raises(ExperimentError) as caught:
            run_settings(values)
        assert [problem.column for problem in caught.value.problems] == [column]


def test_every_key_of_both_files_is_listed_once():
    names = [entry["name"] for part in ("experiment", "columns") for entry in keys.reference_content()[part]]
    assert {name for name in names if names.count(name) > 1} == {"axis"}  # of all trials, and of one
    assert set(ExperimentSettings.model_fields) <= set(names)
    assert set(RunSettings.model_fields) <= {entry.name for entry in keys.setting_entries(RunSettings)}


def test_the_page_of_the_docs_is_current():
    page = Path(__file__).parents[2] / "docs" / "settings.md"
    assert page.read_text(encoding="utf-8") == keys.reference_page(), "vinetrack settings --page docs/settings.md"


# What a sheet says of trials: conditions, order, columns of one alone, other units, corrections; planned ones.
def corrected(folder: Path, text: str) -> Path:
    row = "a.mp4,12,100,140,24,3,"
    (folder / "trials.csv").write_text(f"{HEADER.replace('track', 'video')},capture_fps\na,{row},1000\n")
    (folder / "corrections.csv").write_text(text)
    return folder


def test_corrections_reach_their_trial_and_are_written_as_they_are_read(tmp_path):
    corrected(tmp_path, "trial,frame,action,edge_px\na,12,move,310.5\na,3,drop,\na,40,confirm,\n")
    trial = read_experiment(tmp_path).trial("a")
    assert [(one.frame, one.action) for one in trial.corrections] == [(3, "drop"), (12, "move"), (40, "confirm")]
    assert trial.corrections[1].edge_px == 310.5
    given = {"a": (Correction(3, "drop"), Correction(12, "move", 310.5))}
    (tmp_path / "corrections.csv").write_text(sheets.corrections_text(given))
    found, problems = sheets.read_corrections(tmp_path)
    assert problems == []
    assert sheets.corrections_text(found) == sheets.corrections_text(given)


def test_a_line_that_makes_no_sense_stops_with_its_place(tmp_path):
    for line in ("a,3,remove,", "a,3.5,drop,", "a,-1,drop,", "a,3,move,", "a,three,drop,", "a,3,drop,\na,3,confirm,"):
        corrected(tmp_path, f"trial,frame,action,edge_px\n{line}\n")
        with pytest.raises(ExperimentError) as stopped:
            read_experiment(tmp_path)
        assert "corrections.csv" in {problem.file for problem in stopped.value.problems}, line


TRIAL = Trial(
    name="a", diameter_m=0.024, thickness_m=200e-6, length_m=0.28, pressure_Pa=28e3, yield_pressure_Pa=3e3, inlet_m=8e-3
)
ALWAYS_COMPARED = {"diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa", "payload_g"}
"""Columns of a vine's name and of every condition's name, and the yield pressure, which a vine's trials share."""
OF_A_REPLICATE = {
    *("trial", "use", "order", "specimen", "day"),
    *("video", "track", "point_mass", "frames_used", "axis", "steady", "mm_per_px", "compare_sizes"),
    *("capture_fps", "capture_fps_is_playback", "exposure_us"),
    *("pressure_trace", "pressure_sigma_kPa", "yield_pressure_sigma_kPa"),
}
"""Columns in which replicates may differ: they say how a trial was recorded and read, which trial of several it is, and
how well its numbers are known, not what was done to the vine."""
OTHER_VALUES = {"bends": (Bend(0.1, 0.05, 0.03),), "travel_ratio": 1.0}


def conditions(field: str, value) -> set[str]:
    """Names of the conditions of a trial and of one with another value of a field."""
    return {trial.condition for trial in with_names([TRIAL, replace(TRIAL, **{"name": "b", field: value})])}


def test_every_column_says_whether_it_defines_a_condition() -> None:
    # A new column is either given a `condition_part`, or named above: else different settings count as replicates.
    shown = {name for name, column in COLUMNS.items() if column.condition_part}
    assert shown | ALWAYS_COMPARED | OF_A_REPLICATE == set(COLUMNS)
    assert not shown & (ALWAYS_COMPARED | OF_A_REPLICATE)


def test_trials_that_differ_in_a_setting_are_two_conditions():
    for name, column in COLUMNS.items():
        if name not in OF_A_REPLICATE:
            value = OTHER_VALUES[name] if name in OTHER_VALUES else column.scale.to_si(7.0)
            assert len(conditions(column.field, value)) == 2, name


def test_trials_that_differ_in_how_they_were_recorded_are_replicates():
    numbers = [column for name, column in COLUMNS.items() if name in OF_A_REPLICATE and column.kind == "number"]
    assert {len(conditions(column.field, column.scale.to_si(7.0))) for column in numbers} == {1}


def test_the_name_of_a_condition_shows_what_differs():
    base = "24mm-200um-280mm_28kPa_0g"
    for field, value, parts in (
        ("growth_angle_rad", 1.5707963267948966, {"0deg", "90deg"}),
        ("chamber_m3", 3.7e-3, {"", "chamber3.7l"}),
        ("inlet_m", 5.7e-3, {"inlet8mm", "inlet5.7mm"}),
        ("bends", (Bend(0.1, 0.05, 0.03), Bend(0.2, 0.06, 0.04)), {"", "bends100x50x30-200x60x40"}),
        ("film_density_kg_m3", 920.0, {"film1200", "film920"}),
        ("travel_ratio", 1.0, {"ratio2", "ratio1"}),
        ("yield_pressure_Pa", 5e3, {"yield3kPa", "yield5kPa"}),
    ):
        assert conditions(field, value) == {f"{base}_{part}".rstrip("_") for part in parts}
    in_psi = [replace(TRIAL, pressure_unit="psi", yield_pressure_Pa=psi * 6894.757293168361) for psi in (0.5, 0.7)]
    assert [trial.condition.split("_")[-1] for trial in with_names(in_psi)] == ["yield0.5psi", "yield0.7psi"]
    # Another vine has a yield pressure of its own.
    named = with_names([TRIAL, replace(TRIAL, name="b", diameter_m=0.012, thickness_m=1e-4, yield_pressure_Pa=5e3)])
    assert [trial.condition for trial in named] == [base, "12mm-100um-280mm_28kPa_0g"]


def written(folder: Path, columns: str = "", cells: tuple[str, ...] = ("",) * 10) -> Path:
    """Ten trials of one vine at five rising pressures."""
    (folder / "a.csv").write_text(TRACK)
    lines = [f"t{i},a.csv,24,200,280,{PRESSURES[i]},3,{cells[i]}" for i in range(10)]
    return write(folder, f"{HEADER}{columns}\n" + "\n".join(lines) + "\n")


def test_times_in_milliseconds_are_asked_about(tmp_path):
    written(tmp_path)
    for factor, codes in ((1.0, []), (1e3, ["times"] * 10)):
        lines = [f"{factor * i / 1069},{1e-5 * i**2}" for i in range(60)]
        (tmp_path / "a.csv").write_text("time_s,position_m\n" + "\n".join(lines) + "\n")
        assert [problem.code for problem in check_experiment(tmp_path) if problem.trial] == codes


def test_the_order_is_that_of_the_sheet_or_else_of_its_rows(tmp_path):
    cells = tuple(f",tube {i % 2},monday,{10 - i}" for i in range(10))
    trials = read_experiment(written(tmp_path, ",specimen,day,order", cells)).trials
    ranks, stated = sheets.trial_order(trials)
    assert (stated, ranks.tolist()) == (True, list(range(9, -1, -1)))
    assert len({trial.condition for trial in trials}) == 5, "they are replicates all the same"
    trials = read_experiment(written(tmp_path)).trials
    ranks, stated = sheets.trial_order(trials)
    assert (stated, ranks.tolist()) == (False, list(range(10)))
    assert sheets.order_pressure_correlation(trials) == pytest.approx(0.985, abs=0.005)


def test_check_warns_of_an_order_or_a_specimen_that_follows_the_pressure(tmp_path):
    for column, cells, codes in (
        ("", ("",) * 10, ["confounded"]),  # the rows are in order of pressure
        ("order", tuple(f",{i + 1}" for i in range(10)), ["confounded"]),
        ("order", tuple(f",{i + 1}" for i in np.random.default_rng(1).permutation(10)), []),
        ("specimen", tuple(f",{pressure}" for pressure in PRESSURES), ["confounded"]),
        ("specimen", tuple(f",{i % 2}" for i in range(10)), []),
    ):
        found = check_experiment(written(tmp_path, f",{column}" if column else "", cells))
        assert [problem.code for problem in found if problem.column == (column or "order")] == codes


def test_settings_are_those_of_the_experiment_and_faults_are_named_as_there(tmp_path):
    folder = write(two_vines(tmp_path), GOOD, "chamber_l: 2\nmodel: [pressure_drive, gravity, leak]\n")
    planned = planned_sheet(folder)
    assert planned.trials[0].chamber_m3 == pytest.approx(2e-3)
    assert planned.settings.model[-1] == "leak"
    write(folder, GOOD.replace(",28,", ",28000,"))
    with pytest.raises(ExperimentError) as caught:
        planned_sheet(folder)
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.trial, problem.column) == ("trials.csv", 2, "a", "pressure_kPa")
    with pytest.raises(ExperimentError) as caught:
        sheets.planned_trial({**VINE, "travel_ratio": "1"})  # a body that moves as a whole is not predicted
    assert any("--travel-ratio" in str(problem) for problem in caught.value.problems)


def test_a_sheet_needs_no_recordings_and_an_unknown_column_is_not_passed_over(tmp_path):
    text = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,payload_gr\na,24,200,280,28,35.6\n"
    (tmp_path / "ideas.csv").write_text(text, encoding="utf-8")
    planned = planned_sheet(tmp_path / "ideas.csv")
    assert ([trial.name for trial in planned.trials], planned.folder) == (["a"], tmp_path)
    assert [problem.column for problem in planned.problems] == ["payload_gr"]


def test_other_units_of_sheet_and_settings_are_converted_and_said(tmp_path):
    own = {"diameter_in": "1", "pressure_psi": "4", "payload_oz": "2", "diameter_mm": None, "pressure_kPa": None}
    read = one(tmp_path, "yield_pressure_psi: 0.435\n", yield_pressure_kPa=None, payload_g=None, **own)
    (trial,) = read.trials
    assert trial.diameter_m == pytest.approx(0.0254, rel=1e-14)
    assert trial.payload_kg == pytest.approx(0.05669904625, rel=1e-14)
    assert (trial.pressure_Pa, trial.yield_pressure_Pa) == pytest.approx((4 * PSI, 0.435 * PSI), rel=1e-12)
    said = {problem.column: problem for problem in read.problems}
    assert {(problem.code, problem.severity) for problem in said.values()} == {("unit", "note")}
    assert said.keys() == {"diameter_in", "pressure_psi", "payload_oz", "yield_pressure_psi"}
    assert "6.89476" in said["pressure_psi"].message
    pressure = pressure_text(trial.pressure_Pa, trial.pressure_unit)
    assert (pressure, trial.condition.split("_")[1]) == ("4 psi (27.6 kPa)", "4psi")
    assert (said["yield_pressure_psi"].file, said["yield_pressure_psi"].line) == ("experiment.yaml", 1)


def test_the_bounds_hold_after_conversion_and_of_two_units_that_with_a_value_counts(tmp_path):
    assert "diameter_mm '25 in' is above 300 mm" in one(tmp_path, diameter_mm=None, diameter_in="25").failed["a"]
    read = one(tmp_path, diameter_in="2")
    assert read.trials[0].diameter_m == 24 / 1000
    assert [problem.code for problem in read.problems if problem.column == "diameter_in"] == ["twice"]
    (trial,) = one(tmp_path, pressure_kPa="", pressure_psi="4").trials
    assert trial.pressure_Pa == pytest.approx(4 * PSI, rel=1e-14)
    # As the set-up page writes keys: the unit of a quantity is changed, the line of the other one stays.
    for blank in ("yield_pressure_kPa:\nyield_pressure_psi: 0.435", "yield_pressure_kPa: 3\nyield_pressure_psi:"):
        (trial,) = one(tmp_path, blank, yield_pressure_kPa=None).trials
        assert trial.yield_pressure_Pa == pytest.approx(3000, rel=1e-3)
    with pytest.raises(ExperimentError):
        one(tmp_path, "yield_pressure_psi: 0.435\nyield_pressure_kPa: 3\n", yield_pressure_kPa=None)


@pytest.mark.parametrize("column", NUMBERS, ids=lambda column: column.name)
@pytest.mark.parametrize("place", ["sheet", "settings"])
def test_every_unit_of_every_column_is_read(tmp_path, column, place):
    usual = {"diameter_mm": 24, "thickness_um": 200, "length_mm": 280, "pressure_kPa": 28, "yield_pressure_kPa": 3}
    in_own_unit = {**usual, "film_density_kg_m3": 1100}.get(column.name, 12)
    for name, unit in other_units(column.name).items():
        value = f"{convert(in_own_unit, split_unit(column.name)[1], unit):.15g}"
        settings = f"{name}: {value}\n{column.name}:\n" if place == "settings" else ""
        cells = {name: value} if place == "sheet" else {}
        (trial,) = one(tmp_path, settings, **{column.name: None, **cells}).trials
        assert column.of_trial(trial) == pytest.approx(in_own_unit, rel=1e-12)


def test_keys_of_groups_and_ranges_are_converted(tmp_path):
    text = "limits: {pressure_psi: '1:5', diameter_in: [1, 2], hoop_stress_kPa: '7000,0'}\nambient_pressure_bar: 1,0\n"
    settings = one(tmp_path, text + "axis: {from_px: [1, 2], to_px: [9, 90], width_cm: 2}\n").settings
    assert settings.limits.pressure_kPa == pytest.approx((6.894757, 34.473786))
    assert (settings.limits.diameter_mm, settings.limits.hoop_stress_MPa) == ((25.4, 50.8), 7)
    assert (settings.ambient_pressure_kPa, settings.axis.width_mm) == (100, 20)
