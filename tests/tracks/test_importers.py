"""Positions measured elsewhere: CSV, Physics Tracker projects and exports, all written by hand here."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.records import FLAGS, Track, Trial
from vinetrack.tracks.importers import TrackError, attach_pressure, load_track, read_pressure_trace, read_track

TIMES = np.arange(8) / 100
POSITIONS = 0.5 * 9.81 * TIMES**2


def write(folder: Path, text: str, name: str = "track.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def rows(*columns: np.ndarray, separator: str = ",", decimal: str = ".") -> str:
    lines = (separator.join(f"{value:.9f}" for value in row) for row in zip(*columns, strict=True))
    return "\n".join(lines).replace(".", decimal) + "\n"


def refused(path: Path) -> str:
    with pytest.raises(TrackError) as caught:
        read_track(path)
    return str(caught.value)


def test_a_table_of_positions(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, "time_s,position_m\n" + rows(TIMES, POSITIONS)))
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-12)
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=1e-9)
    assert np.isnan(track.lead_position_sigma_m).all()
    assert np.isnan(track.edge_px).all()
    assert set(track.flag) == {""}
    assert track.pressure_Pa is None
    assert track.notes == ()
    assert track.usable.all()


def test_flags_can_be_written_into_an_imported_track(tmp_path: Path) -> None:
    """The text type must hold the longest join of flags, not just the blanks it starts with."""
    track = read_track(write(tmp_path, "time_s,position_m\n" + rows(TIMES, POSITIONS)))
    flag = track.flag.copy()
    flag[0] = ";".join(FLAGS)
    assert flag[0] == ";".join(FLAGS)


def test_a_packed_project_is_to_be_unpacked(tmp_path: Path) -> None:
    assert "unpack it" in refused(write(tmp_path, "PK", "tip.trz"))


def test_sigma_and_pressure_come_along(tmp_path: Path) -> None:
    sigma, pressure = np.linspace(1e-4, 2e-4, 8), np.linspace(28, 24, 8)
    header = "pressure_kPa,time_s,sigma_m,position_m\n"
    track = read_track(write(tmp_path, header + rows(pressure, TIMES, sigma, POSITIONS)))
    np.testing.assert_allclose(track.lead_position_sigma_m, sigma, atol=1e-9)
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, 1000 * pressure, atol=1e-4)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_semicolons_and_decimal_commas(tmp_path: Path, encoding: str) -> None:
    text = "time_s;position_m\r\n" + rows(TIMES, POSITIONS, separator=";", decimal=",").replace("\n", "\r\n")
    track = read_track(write(tmp_path, text, encoding=encoding))
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=1e-9)


def test_blank_sigma_is_unknown_and_so_is_zero(tmp_path: Path) -> None:
    lines = [f"{t},{p},{s}" for t, p, s in zip(TIMES, POSITIONS, ["0.1", "", "0", *["0.2"] * 5], strict=True)]
    track = read_track(write(tmp_path, "time_s,position_m,sigma_m\n" + "\n".join(lines)))
    np.testing.assert_array_equal(track.lead_position_sigma_m, [0.1, np.nan, np.nan, *[0.2] * 5])
    assert len(track.notes) == 1


def test_blank_pressures_are_interpolated_with_a_note(tmp_path: Path) -> None:
    lines = [f"{t},{p},{x}" for t, p, x in zip(range(5), range(5), ["20", "", "24", "", "28"], strict=True)]
    track = read_track(write(tmp_path, "time_s,position_m,pressure_kPa\n" + "\n".join(lines)))
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, [20e3, 22e3, 24e3, 26e3, 28e3])
    assert "2 points" in track.notes[0]


def test_a_track_that_runs_backwards_is_kept_and_noted(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, "time_s,position_m\n" + rows(TIMES, -POSITIONS)))
    assert track.lead_position_m[-1] < 0
    assert "decreases" in track.notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("time_s,position_m\n", "has 0 points: at least 5"),
        ("time_s,position_m\n1,1\n", "has 1 point: at least 5"),
        ("time_s,position_m\n1,1\n2,2\n3,3\n4,4\n", "has 4 points"),
        ("time_s,position_mm\n1,1\n", "lacks the column position_m (found: time_s, position_mm)"),
        ("frame,position_m\n1,1\n", "lacks the column time_s"),
        ("\tt,x\n1,1\n", "has no columns t and x or y"),
        ("time_s,position_m\n0,0\n1,1\n1,2\n2,3\n3,4\n", "line 4, column time_s: time does not increase (1 after 1 s)"),
        ("time_s,position_m\n0,0\n1,x\n2,2\n3,3\n4,4\n", "line 3, column position_m: 'x' is not a number"),
        ("time_s,position_m\n0,0\n1,\n2,2\n3,3\n4,4\n", "line 3, column position_m: '' is blank"),
        ("time_s,position_m\n0,0\n1,nan\n2,2\n3,3\n4,4\n", "is not a number"),
        ("time_s,position_m\n0,0\n1,1e300\n2,2\n3,3\n4,4\n", "too large"),
        ("time_s,position_m,sigma_m\n0,0,1\n1,1,-1\n2,2,1\n3,3,1\n4,4,1\n", "line 3, column sigma_m is negative"),
        (
            "time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},24000\n" for i in range(5)),
            "line 2, column pressure_kPa: 24000 is above 1000 kPa: looks like Pa, 24000 Pa is 24 kPa",
        ),
        ("time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},-200\n" for i in range(5)), "below vacuum"),
    ],
)
def test_an_invalid_track_is_refused_with_the_place(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(write(tmp_path, text))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "none.csv")


def export(header: str, t: np.ndarray, *axes: np.ndarray, separator: str = "\t", decimal: str = ".") -> str:
    return header + rows(t, *axes, separator=separator, decimal=decimal)


@pytest.mark.parametrize(
    ("header", "separator", "decimal"),
    [
        ("mass A\nt\tx\ty\n", "\t", "."),
        ("\tmass A\t\nt\tx\ty\n", "\t", ","),
        ("mass A\nt,x,y\n", ",", "."),
        ("mass A\nt;x;y\n", ";", ","),
        ("t\tx\ty\n", "\t", "."),
        ("#t\tx\ty\n", "\t", "."),
        ("mass A\n\nt (s)\tx (m)\ty (m)\n", "\t", "."),
    ],
)
def test_exports_of_a_straight_motion(tmp_path: Path, header: str, separator: str, decimal: str) -> None:
    """Along the direction (-0.6, 0.8) the principal axis is exact, whatever the origin."""
    x, y = 0.3 - 0.6 * POSITIONS, 0.1 + 0.8 * POSITIONS
    track = read_track(write(tmp_path, export(header, TIMES, x, y, separator=separator, decimal=decimal), "a.txt"))
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-9)
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=2e-9)
    assert "principal axis" in " ".join(track.notes)


@pytest.mark.parametrize(("across", "up"), [(0.6, 0.8), (-0.6, -0.8), (0.6, -0.8), (-1.0, 0.0), (0.0, -1.0)])
def test_position_grows_whichever_way_the_motion_goes(tmp_path: Path, across: float, up: float) -> None:
    text = export("t,x,y\n", TIMES, across * POSITIONS, up * POSITIONS, separator=",")
    np.testing.assert_allclose(read_track(write(tmp_path, text)).lead_position_m, POSITIONS, atol=2e-9)


def test_the_net_displacement_decides_the_sign_not_the_way_between(tmp_path: Path) -> None:
    """Out to +1 m and back to 0.2 m on the other side: the end counts as forwards."""
    there = np.array([0.0, 0.5, 0.9, 1.0, 0.9, 0.5, 0.1, -0.2])
    text = export("t,x,y\n", TIMES, 0.6 * there, 0.8 * there, separator=",")
    np.testing.assert_allclose(read_track(write(tmp_path, text)).lead_position_m, -there, atol=2e-9)


def test_an_export_of_one_coordinate_keeps_its_zero(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, export("mass A\nt\tx\n", TIMES, 0.2 + POSITIONS)))
    np.testing.assert_allclose(track.lead_position_m, 0.2 + POSITIONS, atol=1e-9)


def test_a_fall_counted_upwards_is_turned_round(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, export("ball\nt\ty\n", TIMES, -POSITIONS)))
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=1e-9)
    assert any("Turned round" in note for note in track.notes)


def test_units_in_the_header_of_an_export(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, export("t (ms)\tx (cm)\n", 1000 * TIMES, 100 * POSITIONS)))
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-9)
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=1e-9)


def test_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    assert "unknown unit" in refused(write(tmp_path, export("t (s)\tx (furlong)\n", TIMES, POSITIONS)))


def test_a_frame_without_a_point_in_an_export_has_no_position(tmp_path: Path) -> None:
    text = "mass A\nt\tx\ty\n0\t0\t0\n1\t\t\n2\t2\t0\n3\t3\t0\n4\t4\t0\n5\t5\t0\n"
    track = read_track(write(tmp_path, text))
    np.testing.assert_allclose(track.lead_position_m, [0, np.nan, 2, 3, 4, 5], atol=1e-12)
    assert list(track.usable) == [True, False, True, True, True, True]
    assert track.flag[1] == ""
    assert any("1 rows have no position" in note for note in track.notes)


FRAME_MS = 4.0
SCALE = 400.0  # px per m


def project(
    marks: dict[int, tuple[float, float]],
    *,
    axes: str | None = None,
    unit: str | None = "m",
    clock: str = f'<property name="delta_t" type="double">{FRAME_MS}</property>',
    more: str = "",
) -> str:
    """A Tracker project with one point mass; `marks` in px, image y downwards."""
    kind = "org.opensourcephysics.cabrillo.tracker.PointMass$FrameData"
    points = "".join(
        f'<property name="[{n}]" type="object"><object class="{kind}">'
        f'<property name="x" type="double">{float(x)!r}</property>'
        f'<property name="y" type="double">{float(y)!r}</property></object></property>'
        for n, (x, y) in marks.items()
    )
    unit_line = "" if unit is None else f'<property name="length_unit" type="string">{unit}</property>'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<object class="org.opensourcephysics.cabrillo.tracker.TrackerPanel">
  <property name="description" type="string"><![CDATA[Growth <of> a vine & more]]></property>
  <property name="videoclip" type="object"><object class="org.opensourcephysics.media.core.VideoClip">
    <property name="startframe" type="int">2</property>
    <property name="stepsize" type="int">1</property>
    <property name="starttime" type="double">100.0</property>
  </object></property>
  <property name="clipcontrol" type="object"><object class="org.opensourcephysics.media.core.StepperClipControl">
    {clock}
  </object></property>
  <property name="coords" type="object"><object class="org.opensourcephysics.media.core.ImageCoordSystem">
    <property name="framedata" type="array">{axes if axes is not None else system(0)}</property>
  </object></property>
  {unit_line}
  <property name="tracks" type="collection">
    <property name="item" type="object"><object class="org.opensourcephysics.cabrillo.tracker.CoordAxes"/></property>
    <property name="item" type="object"><object class="org.opensourcephysics.cabrillo.tracker.PointMass">
      <property name="name" type="string">tip</property>
      <property name="framedata" type="array">{points}</property>
    </object></property>
    {more}
  </property>
</object>
"""


def system(
    frame: int, origin: tuple[float, float] = (50.0, 300.0), angle_deg: float = 0.0, scale: float | tuple = SCALE
) -> str:
    xscale, yscale = scale if isinstance(scale, tuple) else (scale, scale)
    values = {"xorigin": origin[0], "yorigin": origin[1], "angle": angle_deg, "xscale": xscale, "yscale": yscale}
    cells = "".join(f'<property name="{key}" type="double">{value}</property>' for key, value in values.items())
    return f'<property name="[{frame}]" type="object"><object class="FrameData">{cells}</object></property>'


FRAMES = [2, 3, 4, 6, 7, 9]
TRAVEL = 0.05 * np.arange(6) ** 1.5
MARKS = {n: (100 + 0.8 * SCALE * s, 250 - 0.6 * SCALE * s) for n, s in zip(FRAMES, TRAVEL, strict=True)}


def test_a_project_with_frames_left_out(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, project(MARKS), "tip.trk"))
    np.testing.assert_allclose(track.time_s, 0.1 + (np.array(FRAMES) - 2) * 0.004, rtol=1e-12)
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)
    np.testing.assert_allclose(track.edge_px, SCALE * TRAVEL, atol=1e-9)
    assert any("2 frames between the first and the last point have none" in note for note in track.notes)
    assert any("(36.9° from x)" in note for note in track.notes)


def test_a_rotated_origin_changes_nothing_but_the_angle(tmp_path: Path) -> None:
    axes = system(0, origin=(7.0, 11.0), angle_deg=30.0)
    track = read_track(write(tmp_path, project(MARKS, axes=axes), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)
    assert any("(6.9° from x)" in note for note in track.notes)


def test_a_project_in_centimetres(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, project(MARKS, axes=system(0, scale=SCALE / 100), unit="cm"), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)


def test_an_older_project_names_no_unit(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, project(MARKS, unit=None), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)
    assert any("metres are assumed" in note for note in track.notes)


def test_a_moving_camera_followed_by_key_frames_of_the_origin(tmp_path: Path) -> None:
    """From frame 6 on everything in the picture is 40 px further right, and so is the origin."""
    marks = {n: (x + 40 * (n >= 6), y) for n, (x, y) in MARKS.items()}
    axes = system(0) + system(6, origin=(90.0, 300.0))
    track = read_track(write(tmp_path, project(marks, axes=axes), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)


def test_scales_that_differ_across_and_up(tmp_path: Path) -> None:
    marks = {n: (100.0, 250 - 200 * s) for n, s in zip(FRAMES, TRAVEL, strict=True)}
    track = read_track(write(tmp_path, project(marks, axes=system(0, scale=(400.0, 200.0))), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)


def test_the_mass_with_the_most_points_is_taken_and_named(tmp_path: Path) -> None:
    other = (
        '<property name="item" type="object"><object class="org.opensourcephysics.cabrillo.tracker.PointMass">'
        '<property name="name" type="string">door</property><property name="framedata" type="array">'
        '<property name="[0]" type="object"><object class="F"><property name="x" type="double">1</property>'
        '<property name="y" type="double">1</property></object></property></property></object></property>'
    )
    track = read_track(write(tmp_path, project(MARKS, more=other), "tip.trk"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)
    assert any("'tip'" in note and "door" in note for note in track.notes)


def test_a_project_is_known_by_its_content(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, project(MARKS), "renamed.xml"))
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (project(MARKS, axes=system(0, scale=1.0)), "never calibrated"),
        (project(MARKS, axes=system(0, scale=0.0)), "not positive"),
        (project(MARKS, axes=""), "no coordinate system"),
        (project(MARKS, clock=""), "how long a frame lasts"),
        (project(MARKS, unit="parsec"), "measures lengths in 'parsec'"),
        (project({}), "no point mass with marks"),
        (project({1: (1.0, 2.0)}), "has 1 point"),
        (project(MARKS).replace("TrackerPanel", "Launcher"), "no Tracker panel"),
        (project(MARKS)[:-40], "is not a Tracker project"),
        ("time_s,position_m\n0,0\n", "is not a Tracker project"),
    ],
)
def test_projects_that_cannot_be_used(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(write(tmp_path, text, "tip.trk"))


def test_entities_are_never_expanded(tmp_path: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><object>&b;</object>'
    assert "XML entities" in refused(write(tmp_path, bomb, "tip.trk"))


def flat_track() -> Track:
    blank = np.full(5, np.nan)
    return Track(np.arange(5.0), np.arange(5.0), blank, np.array([""] * 5), blank)


def test_a_trace_is_interpolated_on_the_times_of_the_track(tmp_path: Path) -> None:
    path = write(tmp_path, "time_s;pressure_kPa\n-1;30,5\n0,5;29\n10;10\n")
    time_s, pressure_Pa = read_pressure_trace(path)
    np.testing.assert_allclose(pressure_Pa, [30500, 29000, 10000])
    track = attach_pressure(flat_track(), time_s, pressure_Pa)
    expected = [29500, 28000, 26000, 24000, 22000]
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, expected)
    assert track.notes == ()


def test_a_trace_that_ends_early_is_held_with_a_note() -> None:
    track = attach_pressure(flat_track(), np.array([0.0, 2.0]), np.array([2e4, 1e4]))
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, [2e4, 1.5e4, 1e4, 1e4, 1e4])
    assert "2 of 5 points" in track.notes[0]


def test_a_trace_on_another_clock_is_refused() -> None:
    with pytest.raises(TrackError, match="share a clock"):
        attach_pressure(flat_track(), np.array([100.0, 200.0]), np.array([2e4, 1e4]))


def test_the_track_of_a_trial_comes_with_its_trace(tmp_path: Path) -> None:
    trial = Trial(
        name="a",
        track=write(tmp_path, "time_s,position_m\n" + rows(TIMES, POSITIONS)),
        pressure_trace=write(tmp_path, "time_s,pressure_kPa\n0,28\n", "p.csv"),
    )
    track = load_track(trial)
    assert track.pressure_Pa is not None
    np.testing.assert_array_equal(track.pressure_Pa[0], 28e3)


def test_a_fault_of_the_trace_names_the_trace(tmp_path: Path) -> None:
    track = write(tmp_path, "time_s,position_m\n" + rows(TIMES, POSITIONS))
    trial = Trial(name="a", track=track, pressure_trace=tmp_path / "none.csv")
    with pytest.raises(TrackError, match=r"pressure_trace none\.csv does not exist"):
        load_track(trial)


@pytest.mark.real
def test_a_real_project_is_read_in_its_own_scale() -> None:
    """Published with the file: 11 points from frame 2, 398.71 px/m, 66 ms a frame."""
    if "VINETRACK_REAL_DATA" not in os.environ:
        pytest.skip("VINETRACK_REAL_DATA is not set")
    track = read_track(Path(os.environ["VINETRACK_REAL_DATA"]) / "balltoss" / "balltoss.trk")
    assert len(track.time_s) == 11
    assert track.time_s[0] == pytest.approx(2 * 0.066)
    np.testing.assert_allclose(np.diff(track.time_s), 0.066)
    scale = np.ptp(track.edge_px) / np.ptp(track.lead_position_m)
    assert scale == pytest.approx(398.71, abs=0.01)
    assert math.isfinite(scale)
