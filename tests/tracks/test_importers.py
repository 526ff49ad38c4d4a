"""Positions and pressures measured elsewhere: CSV, Physics Tracker, TDMS, written by hand here."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter

from vinetrack.core.problems import InputError
from vinetrack.core.records import Trial, plain_track, with_flag
from vinetrack.tracks import importers
from vinetrack.tracks.importers import read_pressure_trace, read_track

TIMES = np.arange(8) / 100
POSITIONS = 0.5 * 9.81 * TIMES**2
SCALE = 400.0  # px per m
FRAMES = [2, 3, 4, 6, 7, 9]
TRAVEL = 0.05 * np.arange(6) ** 1.5
MARKS = {n: (100 + 0.8 * SCALE * s, 250 - 0.6 * SCALE * s) for n, s in zip(FRAMES, TRAVEL, strict=True)}
CLOCK_S = np.arange(120) / 200
TRACE_S = np.arange(12) * 2e-3 + 0.1
PRESSURE_KPA = 20 + np.arange(12) ** 2 / 8.0
OTHER_TIMES = {
    "even to the digit": np.arange(100) / 500,
    "not rounded": np.arange(100) / 1069,
    "to the microsecond": np.round(np.arange(100) / 1069, 6),
    "frames are missing": np.round(np.delete(np.arange(100), [40, 41]) / 1069, 3),
    "exact, two are missing": np.delete(np.arange(102), [31, 71]) / 1000,
    "uneven": np.round(np.cumsum(np.random.default_rng(2).uniform(0.5e-3, 1.5e-3, 100)), 3),
    "few": np.array([0.0, 0.001, 0.002, 0.002, 0.003]),
    "standing": np.zeros(20),
}


def write(folder: Path, text: str, name: str = "track.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def rows(*columns: np.ndarray, separator: str = ",", decimal: str = ".") -> str:
    lines = (separator.join(f"{value:.9f}" for value in row) for row in zip(*columns, strict=True))
    return "\n".join(lines).replace(".", decimal) + "\n"


@pytest.mark.parametrize(("encoding", "separator"), [("utf-8", ","), ("utf-8-sig", ";"), ("utf-16", ";")])
def test_a_table_of_positions_and_what_comes_along(tmp_path, encoding, separator):
    """Semicolons with decimal commas."""
    sigma, pressure = np.linspace(1e-4, 2e-4, 8), np.linspace(28, 24, 8)
    text = rows(pressure, TIMES, sigma, POSITIONS, separator=separator, decimal="." if separator == "," else ",")
    text = "pressure_kPa,time_s,sigma_m,position_m\n".replace(",", separator) + text
    track = read_track(write(tmp_path, text.replace("\n", "\r\n"), encoding=encoding))
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-12)
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=1e-9)
    np.testing.assert_allclose(track.lead_position_sigma_m, sigma, atol=1e-9)
    np.testing.assert_allclose(track.pressure_Pa, 1000 * pressure, atol=1e-4)
    assert np.isnan(track.edge_px).all()
    assert track.usable.all()


def test_a_track_of_a_results_folder_keeps_its_errors_and_flags(tmp_path):
    header = "frame,time_s,edge_px,lead_position_m,lead_position_sigma_m,flag,lead_position_systematic_m,pressure_Pa\n"
    flags = ["before_release;doubtful", "", "", "", "", "", "", "after_end"]
    seen = zip(TIMES, POSITIONS, flags, strict=True)
    lines = [f"{k},{t},{9 * k},{y},2e-5,{flag},3e-5,NaN" for k, (t, y, flag) in enumerate(seen)]
    track = read_track(write(tmp_path, header + "\n".join(lines)))
    np.testing.assert_array_equal(track.lead_position_m, POSITIONS)
    assert track.flag.tolist() == flags
    assert {*track.lead_position_sigma_m, *track.lead_position_systematic_m} == {2e-5, 3e-5}
    assert track.pressure_Pa is None
    assert len(track.notes) == 1


def test_blank_pressures_are_interpolated_and_a_frame_without_a_point_has_no_position(tmp_path):
    text = "time_s,position_m,pressure_kPa\n0,0,20\n1,1,\n2,2,24\n3,3,\n4,4,28\n"
    track = read_track(write(tmp_path, text))
    np.testing.assert_allclose(track.pressure_Pa, [20e3, 22e3, 24e3, 26e3, 28e3])
    track = read_track(write(tmp_path, "mass A\nt\tx\ty\n0\t0\t0\n1\t\t\n2\t2\t0\n3\t3\t0\n4\t4\t0\n5\t5\t0\n"))
    np.testing.assert_allclose(track.lead_position_m, [0, np.nan, 2, 3, 4, 5], atol=1e-12)
    assert list(track.usable) == [True, False, True, True, True, True]
    assert track.pressure_Pa is None


HEADER = "time_s,position_m\n"
NO_TRACKS = [
    "",
    HEADER + "1,1\n2,2\n3,3\n4,4\n",
    "frame,position_m\n" + rows(TIMES, POSITIONS),
    *(HEADER + f"0,0\n1,1\n{row}\n2,3\n3,4\n" for row in ("1,2", "1.5,x", "1.5,", "1.5,nan", "1.5,1e300")),
    "time_s,position_m,sigma_m\n0,0,1\n1,1,-1\n2,2,1\n3,3,1\n4,4,1\n",
    *("time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},{kPa}\n" for i in range(5)) for kPa in (24000, -200)),
    "\tt,x\n1,1\n",
    "t (s)\tx (furlong)\n" + rows(TIMES, POSITIONS, separator="\t"),
]


@pytest.mark.parametrize("text", NO_TRACKS)
def test_an_invalid_track_is_refused(tmp_path, text):
    with pytest.raises(InputError):
        read_track(write(tmp_path, text))


@pytest.mark.parametrize(
    ("header", "separator", "decimal", "scales"),
    [
        ("mass A\nt\tx\ty\n", "\t", ".", (1, 0.6, 0.8)),
        ("\tmass A\t\nt\tx\ty\n", "\t", ",", (1, -0.6, 0.8)),
        ("mass A\nt,x,y\n", ",", ".", (1, -0.6, 0.8)),
        ("mass A\nt;x;y\n", ";", ",", (1, -0.6, 0.8)),
        ("t\tx\ty\n", "\t", ".", (1, -0.6, -0.8)),
        ("#t\tx\ty\n", "\t", ".", (1, -0.6, 0.8)),
        ("mass A\n\nt (s)\tx (m)\ty (m)\n", "\t", ".", (1, -0.6, 0.8)),
        ("ball\nt\ty\n", "\t", ".", (1, -1)),
        ("t (ms)\tx (cm)\n", "\t", ".", (1000, 100)),
        ("time_ms,position_mm\n", ",", ".", (1000, 1000)),
        ("time,position\n", ",", ".", (1, 1)),
    ],
)
def test_exports_of_a_straight_motion(tmp_path, header, separator, decimal, scales):
    """In a plane the principal axis is exact along any direction, whatever the origin."""
    origin_m = 0.3 if len(scales) > 2 else 0.0
    columns = (TIMES * scales[0], *(origin_m + scale * POSITIONS for scale in scales[1:]))
    text = header + rows(*columns, separator=separator, decimal=decimal)
    track = read_track(write(tmp_path, text, "a.txt"))
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-9)
    np.testing.assert_allclose(track.lead_position_m, POSITIONS, atol=2e-9)


FPS, MM_PER_PX = 500.0, 0.4
GROWN_M = 0.002 * np.arange(30) ** 1.3
X_PX, Y_PX = 100 + 800 * GROWN_M / MM_PER_PX, 400 - 600 * GROWN_M / MM_PER_PX
SHEET = {"capture_fps": FPS, "m_per_px": MM_PER_PX / 1e3}
PIXELS = list(zip(X_PX.tolist(), Y_PX.tolist(), strict=True))
DLC = "scorer" + ",net" * 6 + "\nbodyparts" + ",base" * 3 + ",tip" * 3 + "\ncoords" + ",x,y,likelihood" * 2 + "\n"
FOREIGN = {
    "trackpy": ",y,x,mass,ep,frame,particle\n"
    + "".join(f"0,7,9,300,0.1,{i},0\n" * (i < 20) + f"1,{y},{x},310,,{i},3\n" for i, (x, y) in enumerate(PIXELS)),
    "DeepLabCut": DLC + "".join(f"{i},5,6,{0.9 * (i < 20)},{x},{y},0.99\n" for i, (x, y) in enumerate(PIXELS)),
    "Kinovea, ms": '"Time";"ball/0/X";"ball/0/Y"\r\n'
    + "".join(f'"{i / FPS * 1e3:.2f}";"{x:.7f}";"{y:.7f}"\r\n'.replace(".", ",") for i, (x, y) in enumerate(PIXELS)),
    "Kinovea, text": "#Kinovea Trajectory data export\n#T X Y\n\n# cup\n0 1 1\n0.002 1 1\n\n# tip\n"
    + "".join(f"{i / FPS:.4f} {x} {y}\n" for i, (x, y) in enumerate(PIXELS)),
    "DLTdv": "pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y\nNaN,NaN,NaN,NaN\n"
    + "".join(f"{x},{y},NaN,NaN\n" for x, y in PIXELS),
    "Tracker in pixels": "mass_A,,\nt,x,y\n" + "".join(f"{i / FPS},{x},{y}\n" for i, (x, y) in enumerate(PIXELS)),
    "pixels by name": "t,x (px),y (px)\n" + "".join(f"{i / FPS},{x},{y}\n" for i, (x, y) in enumerate(PIXELS)),
    "DLTdv in space": "pt1_X,pt1_Y,pt1_Z\n" + "".join(f"{0.6 * x},{y},{0.8 * x}\n" for x, y in PIXELS),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_table_of_another_program_is_read_with_rate_and_scale_of_the_sheet(tmp_path, name):
    """Of several points the one with the most places; what is unlikely, or marked NaN, is none."""
    path = write(tmp_path, FOREIGN[name])
    track = read_track(path, **SHEET)
    found = track.usable
    np.testing.assert_allclose(np.diff(track.time_s), 1 / FPS, atol=1e-9)
    np.testing.assert_allclose(np.ptp(track.lead_position_m[found]), np.ptp(GROWN_M), rtol=1e-5)
    np.testing.assert_allclose(np.diff(track.lead_position_m[found]), np.diff(GROWN_M), atol=1e-9)
    if not name.startswith(("Kinovea", "Tracker", "pixels")):
        with pytest.raises(InputError, match="capture_fps"):
            read_track(path)
    with pytest.raises(InputError):
        read_track(path, point_mass="toe", **SHEET)


def test_times_of_a_clock_are_refused_and_a_particle_has_its_number_as_name(tmp_path):
    clock = "#Kinovea Trajectory data export\n#T X Y\n\n# tip\n" + "".join(f"0:00:00:{i:02} {i} 0\n" for i in range(9))
    with pytest.raises(InputError, match="in seconds"):
        read_track(write(tmp_path, clock), **SHEET)
    floats = FOREIGN["trackpy"].replace(",3\n", ",3.0\n")
    assert read_track(write(tmp_path, floats), point_mass="3", **SHEET).usable.sum() == len(PIXELS)
    tip = read_track(write(tmp_path, FOREIGN["DeepLabCut"]), point_mass=" Tip", **SHEET)
    assert tip.usable.sum() == len(PIXELS)


def test_the_net_displacement_decides_the_sign_not_the_way_between(tmp_path):
    """Out to +1 m and back to 0.2 m on the other side: the end counts as forwards."""
    there = np.array([0.0, 0.5, 0.9, 1.0, 0.9, 0.5, 0.1, -0.2])
    track = read_track(write(tmp_path, "t,x,y\n" + rows(TIMES, 0.6 * there, 0.8 * there)))
    np.testing.assert_allclose(track.lead_position_m, -there, atol=2e-9)


def tracker(name: str, content: object) -> str:
    """A property of a Tracker project."""
    return f'<property name="{name}">{content}</property>'


def thing(kind: str, *properties: str) -> str:
    return f'<object class="org.opensourcephysics.{kind}">{"".join(properties)}</object>'


def system(frame: int, origin: tuple[float, float] = (50.0, 300.0), scale: float = SCALE) -> str:
    values = {"xorigin": origin[0], "yorigin": origin[1], "angle": 0.0, "xscale": scale, "yscale": scale}
    return tracker(f"[{frame}]", thing("FrameData", *(tracker(key, value) for key, value in values.items())))


def project(marks, axes: str | None = None, unit: str = "m", clock: str = tracker("delta_t", 4.0)) -> str:
    """A Tracker project with one point mass; `marks` in px, image y downwards."""
    points = "".join(
        tracker(f"[{n}]", thing("PointMass$FrameData", tracker("x", float(x)), tracker("y", float(y))))
        for n, (x, y) in marks.items()
    )
    tip = thing("cabrillo.tracker.PointMass", tracker("name", "tip"), tracker("framedata", points))
    coordinates = thing("media.core.ImageCoordSystem", tracker("framedata", system(0) if axes is None else axes))
    return '<?xml version="1.0" encoding="UTF-8"?>' + thing(
        "cabrillo.tracker.TrackerPanel",
        tracker("description", "<![CDATA[Growth <of> a vine & more]]>"),
        tracker("videoclip", thing("media.core.VideoClip", tracker("startframe", 2), tracker("starttime", 100.0))),
        tracker("clipcontrol", thing("media.core.StepperClipControl", clock)),
        tracker("coords", coordinates),
        tracker("length_unit", unit),
        tracker("tracks", tracker("item", thing("cabrillo.tracker.CoordAxes")) + tracker("item", tip)),
    )


def test_a_project_with_frames_left_out_and_a_camera_that_moved(tmp_path):
    """From frame 6 on everything in the picture is 40 px further right, and so is the origin: a key frame says so."""
    track = read_track(write(tmp_path, project(MARKS), "tip.trk"))
    np.testing.assert_allclose(track.time_s, 0.1 + (np.array(FRAMES) - 2) * 0.004, rtol=1e-12)
    np.testing.assert_allclose(track.lead_position_m, TRAVEL, atol=1e-12)
    np.testing.assert_allclose(track.edge_px, SCALE * TRAVEL, atol=1e-9)
    marks = {n: (x + 40 * (n >= 6), y) for n, (x, y) in MARKS.items()}
    moved = read_track(write(tmp_path, project(marks, axes=system(0) + system(6, origin=(90.0, 300.0))), "tip.trk"))
    np.testing.assert_allclose(moved.lead_position_m, TRAVEL, atol=1e-12)


NO_PROJECTS = [
    *(project(MARKS, axes=axes) for axes in (system(0, scale=1.0), system(0, scale=0.0), "")),
    *(project(MARKS, clock=""), project(MARKS, unit="parsec"), project({}), project({1: (1.0, 2.0)})),
    *(project(MARKS).replace("TrackerPanel", "Launcher"), project(MARKS)[:-40]),
    '<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><object>&b;</object>',
]


@pytest.mark.parametrize("text", NO_PROJECTS)
def test_projects_that_cannot_be_used(tmp_path, text):
    with pytest.raises(InputError):
        read_track(write(tmp_path, text, "tip.trk"))


def test_a_trace_is_interpolated_on_the_times_of_the_track_unless_it_is_of_another_clock(tmp_path):
    time_s, pressure_Pa = read_pressure_trace(write(tmp_path, "time_s;pressure_kPa\n-1;30,5\n0,5;29\n10;10\n"))
    np.testing.assert_allclose(pressure_Pa, [30500, 29000, 10000])
    track = plain_track(np.arange(5.0), np.arange(5.0))
    np.testing.assert_allclose(
        importers.attach_pressure(track, time_s, pressure_Pa).pressure_Pa, [29500, 28000, 26000, 24000, 22000]
    )
    short = importers.attach_pressure(track, np.array([0.0, 2.0]), np.array([2e4, 1e4]))
    np.testing.assert_allclose(short.pressure_Pa, [2e4, 1.5e4, 1e4, 1e4, 1e4])
    with pytest.raises(InputError):
        importers.attach_pressure(track, np.array([100.0, 200.0]), np.array([2e4, 1e4]))


@pytest.mark.real
def test_a_real_project_is_read_in_its_own_scale(real):
    """Published with the file: 11 points from frame 2, 398.71 px/m, 66 ms a frame."""
    track = read_track(real / "balltoss" / "balltoss.trk")
    assert len(track.time_s) == 11
    assert track.time_s[0] == pytest.approx(2 * 0.066)
    np.testing.assert_allclose(np.diff(track.time_s), 0.066)
    scale = np.ptp(track.edge_px) / np.ptp(track.lead_position_m)
    assert scale == pytest.approx(398.71, abs=0.01)


@pytest.mark.parametrize(("rate_hz", "digits"), [(240.0, 3), (240.0, 4), (1069.0, 3), (2400.0, 3), (2400.0, 4)])
def test_rounded_times_of_even_frames_become_even(rate_hz, digits):
    for seed in range(5):
        true_s = float(np.random.default_rng(seed).uniform(0, 0.3)) + np.arange(150) / rate_hz
        for written_s in (np.round(true_s, digits), np.floor(true_s * 10**digits) / 10**digits):
            restored_s, note = importers.unrounded_times(written_s)
            # Less than a fifth of what rounding does, but for a shift of them all.
            off_s = restored_s - true_s
            assert np.max(np.abs(off_s - off_s.mean())) < 0.1 * 10.0**-digits
            assert note


@pytest.mark.parametrize("name", OTHER_TIMES)
def test_other_times_stay_as_they_are(name):
    kept_s, note = importers.unrounded_times(OTHER_TIMES[name])
    assert (kept_s is OTHER_TIMES[name], note) == (True, "")


def test_a_file_with_times_to_the_millisecond_is_read(tmp_path):
    time_s, position_m = np.arange(60) / 1069, 1e-3 * np.arange(60) ** 1.5
    lines = [f"{t:.3f},{y:.6f}" for t, y in zip(time_s, position_m, strict=True)]
    table = write(tmp_path, "\n".join(["time_s,position_m", *lines]))
    export = write(tmp_path, "mass_A,\n" + "\n".join(["t,x", *lines]), "b.txt")
    for path in (table, export):
        assert np.diff(read_track(path).time_s) == pytest.approx(1 / 1069, rel=2e-3)


def ended(position_m: np.ndarray, seed: int = 620, **stated: float):
    trial = Trial(name="t", **({"travel_ratio": 1.0} | stated))
    noise = np.random.default_rng(seed).normal(0, 2e-4, position_m.size)
    track = importers.flag_end_of_motion(trial, plain_track(CLOCK_S, position_m + noise))
    return np.flatnonzero(with_flag(track.flag, "after_end")), track.notes


def fall(floor_m: float = 1e3, restitution: float = 0.0) -> np.ndarray:
    """Falling from rest, and once thrown back by a floor."""
    free = 0.5 * 9.81 * CLOCK_S**2
    hit_s = np.sqrt(2 * floor_m / 9.81)
    later = np.clip(CLOCK_S - hit_s, 0, None)
    back = restitution * 9.81 * hit_s * later - 0.5 * 9.81 * later**2
    return np.where(hit_s > CLOCK_S, free, floor_m - np.maximum(back, 0.0))


@pytest.mark.parametrize("restitution", [0.0, 0.2, 0.6])
def test_a_bounce_or_an_abrupt_stop_ends_the_motion(restitution):
    after, _ = ended(fall(0.7, restitution))
    impact = int(np.argmax(np.sqrt(2 * 0.7 / 9.81) < CLOCK_S))
    assert after[-1] == 119
    assert abs(after[0] - impact) <= 2


@pytest.mark.parametrize(("length_m", "is_cut"), [(0.4, True), (0.3, True), (0.2, False)])
def test_an_abrupt_stop_ends_the_motion_of_a_vine_unless_it_is_the_end_of_its_length(length_m, is_cut):
    position_m = np.minimum(np.maximum(CLOCK_S - 0.05, 0.0), 0.2)
    after, notes = ended(position_m, 625, travel_ratio=2.0, length_m=length_m)
    assert after.size == (CLOCK_S > 0.25 - 1e-9).sum() * is_cut
    assert len(notes) == is_cut


@pytest.mark.parametrize(
    "position_m",
    [fall(), np.maximum(CLOCK_S - 0.2, 0.0), 0.3 * (1 - np.exp(-CLOCK_S / 0.1)), np.zeros(120)],
    ids=["fall", "starts late", "slides to rest", "stands"],
)
def test_a_motion_without_an_end_keeps_its_points(position_m):
    for seed in range(621, 625):
        after, notes = ended(position_m, seed)
        assert after.size == 0
        assert notes == ()


@pytest.mark.parametrize(
    ("travel_ratio", "frames_used", "ends"), [(1.0, None, True), (2.0, None, False), (1.0, (0, 119), False)]
)
def test_only_bodies_without_chosen_frames_are_cut(tmp_path, travel_ratio, frames_used, ends):
    path = write(tmp_path, "time_s,position_m\n" + rows(CLOCK_S, fall(0.7, 0.6)))
    track = importers.load_track(Trial(name="ball", track=path, travel_ratio=travel_ratio, frames_used=frames_used))
    assert with_flag(track.flag, "after_end").any() == ends


def tdms(**channels: np.ndarray | tuple[np.ndarray, dict]) -> bytes:
    """A file with these channels: values, or values and properties."""
    file = io.BytesIO()
    made = [ChannelObject("g", name, *(v if isinstance(v, tuple) else (v,))) for name, v in channels.items()]
    with TdmsWriter(file) as writer:
        writer.write_segment(made)
    return file.getvalue()


BOTH_CHANNELS = tdms(time_s=TRACE_S, pressure_kPa=PRESSURE_KPA)


def read_tdms(folder: Path, made: bytes) -> tuple[np.ndarray, np.ndarray]:
    path = folder / "trace.tdms"
    path.write_bytes(made)
    return read_pressure_trace(path)


def test_times_and_pressures_come_out_as_they_were_written(tmp_path):
    time_s, pressure_Pa = read_tdms(tmp_path, BOTH_CHANNELS)
    assert np.array_equal(time_s, TRACE_S)
    assert np.allclose(pressure_Pa, 1000 * PRESSURE_KPA, rtol=1e-15)
    wave = {"wf_start_offset": 0.25, "wf_increment": 5e-4, "unit_string": "psi"}
    made = tdms(other=np.arange(3, dtype="<u1"), pressure=(np.arange(10, dtype="<i2"), wave))
    time_s, pressure_Pa = read_tdms(tmp_path, made)
    assert np.allclose(time_s, 0.25 + 5e-4 * np.arange(10))
    assert np.allclose(pressure_Pa, 6894.757 * np.arange(10), rtol=1e-6)


NO_TRACES = {
    "text": b"time_s,pressure_kPa\n0,1\n", "cut short": BOTH_CHANNELS[:-9], "half a segment": BOTH_CHANNELS + b"TDSm",
    "no pressure": tdms(volts=TRACE_S), "no times": tdms(pressure_kPa=TRACE_S),
}  # fmt: skip


@pytest.mark.parametrize("made", NO_TRACES.values(), ids=NO_TRACES)
def test_unsupported_content_is_refused(tmp_path, made):
    with pytest.raises(InputError):
        read_tdms(tmp_path, made)


def test_a_changed_byte_gives_numbers_or_a_refusal(tmp_path):
    for place in range(len(BOTH_CHANNELS)):
        damaged = bytearray(BOTH_CHANNELS)
        damaged[place] ^= 0x5A
        with contextlib.suppress(InputError):
            time_s, pressure_Pa = read_tdms(tmp_path, bytes(damaged))
            assert time_s.shape == pressure_Pa.shape
