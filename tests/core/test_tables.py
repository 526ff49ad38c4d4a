"""Tables, numbers, paths, whole files or none, a key of YAML set in place; what people read, and threads of algebra."""

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vinetrack.core import tables
from vinetrack.core.problems import ExperimentError, InputError
from vinetrack.core.process import in_one_blas_thread, njit, progress, waiting
from vinetrack.core.tables import parse_number, parse_table, parse_yaml, safe_join
from vinetrack.core.units import UNITS, convert, interval, number, split_unit, with_error, with_interval
from vinetrack.dynamics.simulate import _cache_folder
from vinetrack.pages.draft_files import save_model, with_value
from vinetrack.pipeline.workflow import COMPILING, compilation_told
from vinetrack.results import Results

PLAIN = "trial,pressure_kPa\na,28.5\nb,14\n"
ROWS = ({"trial": "a", "pressure_kPa": "28.5"}, {"trial": "b", "pressure_kPa": "14"})
OUTSIDE = ("", ".", "..", "../a", "a/../../b", r"..\a", "/etc/passwd", r"\\server\share", "C:/a", r"c:\a", "C:a")
NO_NAMES = ("", ".", "..", "../x", "a/b", r"a\b", ".hidden", "a b", "é", "a\n")
NO_NUMBERS = ("nan", "inf", "-Infinity", "1e400", "1_000", "12 kPa", "١٢", "²", "0x10", "1,2,3", "1.2.3", "1 000")
NO_NUMBERS += ("--1", "e5", ".", "−5", "1e", "=1", "", "  ", "\t")


def table_of(tmp_path: Path, data: bytes) -> tables.Table:
    path = tmp_path / "table.csv"
    path.write_bytes(data)
    return tables.read_table(path)


@pytest.mark.parametrize(
    "data",
    [
        PLAIN.encode(),
        *(PLAIN.encode(encoding) for encoding in ("utf-8-sig", "utf-16")),
        *(PLAIN.replace("\n", end).encode() for end in ("\r\n", "\r", "\n\n,\n", ",,\n")),
        *(PLAIN.replace(",", mark).encode() for mark in (";", "\t", ", ", " ,  ")),
        PLAIN.replace(",", "\t").encode("utf-16"),  # as Excel saves "Unicode text"
        ("\n\n" + PLAIN).encode(),
        ("sep=,\n" + PLAIN).encode(),
        ("sep=;\n" + PLAIN.replace(",", ";")).encode("utf-8-sig"),
        PLAIN.replace("28.5", '"28.5"').encode(),
        PLAIN.rstrip("\n").encode(),
    ],
)
def test_every_dialect_reads_to_the_same_rows(tmp_path, data):
    table = table_of(tmp_path, data)
    assert table.columns == ("trial", "pressure_kPa")
    assert table.rows == ROWS
    np.testing.assert_array_equal(table.numbers("pressure_kPa"), [28.5, 14.0])


def test_cells_and_lines_stay_where_they_are(tmp_path):
    assert table_of(tmp_path, "trial,Größe\na,µ\n".encode("cp1252")).rows == ({"trial": "a", "Größe": "µ"},)
    assert parse_table('a,b\n\n1,2\n,\n"x\ny",3\n4,5\n').lines == (3, 5, 7)
    table = parse_table("a,b\n1\n1,2,3,\n")
    assert (table.rows, table.extra) == (({"a": "1", "b": ""}, {"a": "1", "b": "2"}), ((), ("3", "")))
    # A decimal comma may have split a number, and pushed out a blank; a separator at every end is a habit.
    assert [parse_table(f"p,m,angle\n2.5,0,{end}\n3,5,0,\n").extra for end in ("", ",")] == [((), ("",)), ((), ())]
    assert parse_table("p,m\n3,5,\n4,5,\n2\n").extra == (("",), ("",), ())
    assert [parse_table(f"a,,b\n1,{cell},2\n").nameless for cell in ("remark", "")] == [True, False]
    np.testing.assert_array_equal(parse_table("x,y\n1,1\n,1\n").numbers("x", blank_is_nan=True), [1, np.nan])


@pytest.mark.parametrize(
    "data",
    [b"PK\x03\x04\x00\x00trials.xlsx", b"", b"\n \n", b",,\n", b"x,y,x\n1,2,3\n", b'a,b\n1,"2\n3,4\n'],
    ids=["binary", "empty", "blank", "commas", "named twice", "quote not closed"],
)
def test_what_is_no_table_is_refused(tmp_path, data):
    with pytest.raises(InputError):
        table_of(tmp_path, data)


def test_a_recording_named_as_a_table_is_not_read(tmp_path):
    (tmp_path / "film.mp4").write_bytes(bytes(11))
    with pytest.raises(InputError):
        tables.read_bytes(tmp_path / "film.mp4", most=10)


def test_numbers_and_what_is_none():
    texts = ("0", "-1.5", "+2", ".5", "5.", "1e3", "2,5E-1", " 7 ")
    assert [parse_number(text) for text in texts] == [0.0, -1.5, 2.0, 0.5, 5.0, 1000.0, 0.25, 7.0]
    for text in NO_NUMBERS:
        with pytest.raises(InputError):
            parse_number(text)


def test_thousands_and_decimals_are_not_guessed():
    with pytest.raises(InputError, match=r"write 1\.0690 or 1069"):
        parse_number("1,069")
    with pytest.raises(InputError, match=r"write 1\.0690 or 1069"):
        parse_number("1.069", decimal=",")
    assert parse_number("1,069", decimal=",") == parse_number("1.069") == 1.069
    assert parse_number("0,069") == 0.069
    # A file that uses both marks is read where it is clear.
    table = parse_table("a;b;c\n0,5;0.5;1,069\n")
    assert table.decimal == ""
    assert table.numbers("a") == table.numbers("b") == [0.5]
    with pytest.raises(InputError):
        table.numbers("c")


def test_paths_inside(tmp_path):
    for relative in ("videos/a.mp4", r"videos\a.mp4", "./videos//a.mp4", "x/../videos/a.mp4", " videos/a.mp4 "):
        assert safe_join(Path("exp"), relative) == Path("exp/videos/a.mp4")
    assert safe_join(Path("exp"), "at 3.04\u202fPM.mov") == Path("exp/at 3.04\u202fPM.mov")  # as macOS names them
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "a.mp4").write_text("frames")
    (tmp_path / "exp").mkdir()
    (tmp_path / "exp" / "videos").symlink_to(tmp_path / "store")
    assert safe_join(tmp_path / "exp", "videos/a.mp4").read_text() == "frames"


def test_paths_outside_and_names_of_results_that_leave_their_folder_are_refused():
    for relative in (*OUTSIDE, "a\x00b", "a\nb", "a\u2028b"):
        with pytest.raises(InputError):
            safe_join(Path("exp"), relative)
    for name in NO_NAMES:
        with pytest.raises(InputError):
            Results(Path("results/x")).track(name)


def test_csv_is_read_back_to_the_same_values(tmp_path):
    frame = pd.DataFrame(
        {"trial": ["a", None], "x_m": [0.1 + 0.2, np.nan], "n": [1, 2], "flag": ["", "lost;gap"], "ok": [True, False]}
    )
    tables.write_csv(tmp_path / "deep" / "out.csv", frame)
    lines = (tmp_path / "deep" / "out.csv").read_bytes().decode().split("\n")
    assert lines[0] == "trial,x_m,n,flag,ok"
    assert lines[1:] == [f"a,{0.1 + 0.2!r},1,,True", ",NaN,2,lost;gap,False", ""]


def test_json_has_null_for_nan_and_plain_types(tmp_path):
    content = {"n": np.float64("nan"), "a": np.array([1.0, np.inf]), "i": np.int64(3)}
    content |= {"p": Path("a/b"), "t": (1, None)}
    tables.write_json(tmp_path / "x.json", content)
    read = json.loads((tmp_path / "x.json").read_text())
    assert read == {"n": None, "a": [1.0, None], "i": 3, "p": "a/b", "t": [1, None]}


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "figure.png"
    tables.write_text(path, "old")
    with pytest.raises(RuntimeError), tables.replacing(path) as temporary:  # noqa: PT012
        temporary.write_text("half a f")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


COMMENTED = """# by hand
capture_fps: 1000  # the camera's
calibration:
  # taken on Monday
  kind: two_points  # a ruler
  from_px: [10, 20]
  to_px: [110, 20]
  length_mm: 50

# the last line
"""


BLOCK = {"kind": "two_points", "from_px": [10, 20], "to_px": [110, 20], "length_mm": 50}
FLOW = "axis: {from_px: [1,2],   to_px: [30, 2]}"
LISTED = "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - leak # no\nchamber_l: 2\n"


@pytest.mark.parametrize(
    ("before", "key", "value", "after"),
    [
        (COMMENTED, "capture_fps", 1069, COMMENTED.replace("1000", "1069")),
        (COMMENTED, "calibration", BLOCK | {"to_px": [210, 20.5]}, COMMENTED.replace("[110, 20]", "[210, 20.5]")),
        ("chamber_l: 2  # of glass\n", "chamber_l", None, "chamber_l:    # of glass\n"),
        (FLOW, "axis", {"from_px": [1, 2], "to_px": [30, 2]}, FLOW),
        ("a: 1", "b", "of: text", "a: 1\nb: 'of: text'\n"),
        (LISTED, "model", ["gravity", "air_drag", "inlet_loss"], LISTED.replace("leak # no", "inlet_loss")),
        ("chamber_l: 2 # blue", "model", ["a"], "chamber_l: 2 # blue\nmodel: [a]\n"),
        ("", "model", ["a"], "model: [a]\n"),
        ("# nothing yet\n", "model", ["a"], "# nothing yet\nmodel: [a]\n"),
        ("model: [a, b]\n", "model", ["b", "a"], "model: [b, a]\n"),
    ],
)
def test_a_key_is_set_and_comments_stay(before, key, value, after):
    assert with_value(before, key, value) == after


def test_a_block_is_cleared_and_what_cannot_be_set_without_harm_is_refused():
    after = with_value(COMMENTED, "calibration", None)
    assert parse_yaml(after, "").content == {"capture_fps": 1000, "calibration": None}
    assert "# the last line" in after
    with pytest.raises(ExperimentError):
        with_value("a: &x {p: 1}\nb: *x\n", "b", {"p": 2})


def test_line_ends_and_the_mark_at_the_beginning_stay_and_a_broken_file_is_left_as_it_is(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_bytes(b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity]\r\n")
    save_model(tmp_path, ["gravity", "air_drag"])
    assert path.read_bytes() == b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity, air_drag]\r\n"
    path.write_text("model: [gravity\n")
    with pytest.raises(ExperimentError):
        save_model(tmp_path, ["gravity", "leak"])
    assert path.read_text() == "model: [gravity\n"
    assert [one.name for one in tmp_path.iterdir()] == ["experiment.yaml"]


# What people read: units and numbers, bars on a terminal, compilation; and threads of linear algebra.
def test_nothing_is_shown_where_nobody_looks(capfd):
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with waiting("fitting") as bar:
        bar.update(bar.task_ids[0], completed=1, total=3, description="clips")
    assert capfd.readouterr() == ("", "")


def test_compilation_is_told_once_and_code_is_compiled_where_no_folder_can_be_written(monkeypatch):
    import numba

    def unwritable(cache: bool = False, **flags):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return plain(**flags)

    plain = numba.njit
    said: list[str] = []
    with monkeypatch.context() as folders:
        folders.setattr(numba, "njit", unwritable)
        doubled, halved = njit(nogil=True)(lambda x: 2 * x), njit()(lambda x: x / 2)
    with compilation_told(said.append):
        assert halved(doubled(3)) == 3
        assert said == [COMPILING]
    with compilation_told(said.append):
        assert doubled(4) == 8
    assert said == [COMPILING]


def test_a_model_is_kept_in_a_folder_of_ones_own_where_no_other_can_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    for name in ("VINETRACK_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = _cache_folder.__wrapped__()
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("VINETRACK_CACHE", str(tmp_path))
    assert _cache_folder.__wrapped__() == tmp_path / "vinetrack" / "kernels"


def threads() -> set[int]:
    """Numbers of threads of the loaded libraries of linear algebra."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_threads_are_limited_within_a_function_only():
    np.ones((2, 2)) @ np.ones((2, 2))

    @in_one_blas_thread
    def asked(text: str, *, fails: bool = False) -> tuple[str, set[int]]:
        if fails:
            raise ValueError(text)
        return text, threads()

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert asked("kept") == ("kept", {1})
        with pytest.raises(ValueError, match="kept"):
            asked("kept", fails=True)
        assert threads() == before
    assert asked.__name__ == "asked"


def test_inches_pounds_and_psi_are_exact_by_definition():
    assert convert(1, "in", "mm") == convert(1000, "mil", "mm") == 25.4
    assert split_unit("film_density_g_cm3") == ("film_density", "g_cm3")
    assert convert(1, "ft", "in") == pytest.approx(12, rel=1e-15)
    assert convert(1, "lb", "oz") == pytest.approx(16, rel=1e-15)
    assert convert(1, "psi", "Pa") == pytest.approx(0.45359237 * 9.80665 / 0.0254**2, rel=1e-15)
    assert convert(1, "bar", "kPa") == 100
    assert convert(180, "deg", "rad") == math.pi


def test_a_number_goes_to_si_as_division_rounds_it_and_back():
    """28.7 · 0.001 is 0.028700000000000003; the double next to 0.0287 is wanted."""
    assert UNITS["mm"].to_si(28.7) == 28.7 / 1000
    assert UNITS["um"].to_si(207) == 207 / 1e6
    assert UNITS["deg"].to_si(33.3) == math.radians(33.3)
    for unit in UNITS.values():
        assert unit.from_si(unit.to_si(0.37)) == pytest.approx(0.37, rel=1e-15)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.36981, 0.0123, "0.370 ± 0.012"),
        (0.3712, 0.00999999, "0.371 ± 0.010"),
        (152.7, 31.0, "153 ± 31"),
        (-3.464e-9, 2.3e-6, "(0.0 ± 2.3)·10⁻⁶"),
        (1.2341e-5, 2.3e-7, "(12.34 ± 0.23)·10⁻⁶"),
        (2.5, 0.0, "2.50"),
        (2.5, math.nan, "2.50"),
    ],
)
def test_a_value_ends_where_its_error_does(value, sigma, text):
    assert with_error(value, sigma) == text


def test_a_number_has_three_digits_and_an_interval_shows_both_ends_to_the_same():
    values = (0.37, 1069.0, 0.0, -2.345, 1.5e-7, math.nan, None)
    assert [number(value) for value in values] == ["0.370", "1069", "0", "-2.35", "1.50e-07", "–", "–"]
    assert interval([0.36512, 0.37449]) == "0.3651 to 0.3745"
    assert with_interval(0.4001, [0.359, 0.4412]) == "0.400 (95 %: 0.359 to 0.441)"
    assert with_interval(0.4001, [None, None]) == "0.400"
