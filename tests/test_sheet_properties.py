"""Properties of the intake over generated sheets: dialects, broken cells, random bytes, hostile paths."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vinetrack.core.problems import format_problems
from vinetrack.core.records import Trial
from vinetrack.core.tables import TableError, parse_number, parse_table, result_file, safe_join
from vinetrack.experiment.folder import ExperimentError, check_experiment, read_experiment
from vinetrack.experiment.schema import with_names
from vinetrack.tracks.importers import TrackError, read_pressure_trace, read_track

REPEATABLE = settings(derandomize=True, deadline=None)

COLUMNS = (
    "trial",
    "track",
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "pressure_kPa",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "bends",
    "steady",
)


@contextmanager
def scratch() -> Iterator[Path]:
    """A fresh folder per example: hypothesis reuses pytest's own across examples."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "vines"
        folder.mkdir()
        yield folder


def tenths(low: int, high: int) -> st.SearchStrategy[float]:
    return st.integers(low, high).map(lambda value: value / 10)


ROW = st.fixed_dictionaries(
    {
        "diameter_mm": tenths(60, 3000),
        "thickness_um": st.integers(10, 1400),
        "length_mm": tenths(50, 9999),
        "pressure_kPa": st.integers(5, 998_000).map(lambda value: 4 + value / 1003),
        "yield_pressure_kPa": tenths(0, 39),
        "payload_g": st.none() | tenths(1, 999),
        "growth_angle_deg": st.none() | tenths(-1800, 1800),
        "bends": st.none() | st.tuples(tenths(0, 99), tenths(1, 99), tenths(1, 99)),
        "steady": st.none() | st.tuples(tenths(-50, 0), tenths(1, 50)),
    }
)
SHEET = st.lists(ROW, min_size=1, max_size=6)
DIALECT = st.fixed_dictionaries(
    {
        "separator": st.sampled_from([",", ";", "\t"]),
        "decimal": st.sampled_from([".", ","]),
        "line_end": st.sampled_from(["\n", "\r\n", "\r"]),
        "encoding": st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
        "blank_after": st.booleans(),
        "empty_lines": st.booleans(),
        "columns": st.permutations(COLUMNS),
    }
)


def cell(row: dict[str, Any], column: str, decimal: str) -> str:
    value = row[column]
    if value is None:
        return ""
    if isinstance(value, tuple):
        return ":".join(f"{part:g}" for part in value).replace(".", decimal)
    return f"{value:.10g}".replace(".", decimal) if not isinstance(value, str) else value


def with_trials(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"trial": f"t{i}", "track": f"t{i}.csv", **row} for i, row in enumerate(rows)]


def write_sheet(folder: Path, rows: list[dict[str, Any]], dialect: dict[str, Any]) -> None:
    """A sheet as a spreadsheet would save it: cells that hold the separator are quoted."""
    separator, decimal = dialect["separator"], dialect["decimal"]
    joint = separator + (" " if dialect["blank_after"] else "")
    lines = [list(dialect["columns"])] + [[cell(row, name, decimal) for name in dialect["columns"]] for row in rows]
    text = [joint.join(f'"{part}"' if separator in part else part for part in line) for line in lines]
    if dialect["empty_lines"]:
        text = [part for line in text for part in (line, "", separator * 3)]
    joined = dialect["line_end"].join(text) + dialect["line_end"]
    (folder / "trials.csv").write_bytes(joined.encode(dialect["encoding"]))


def same(a: Trial, b: Trial, folder_a: Path, folder_b: Path) -> bool:
    def plain(trial: Trial, folder: Path) -> list[Any]:
        values = [getattr(trial, one.name) for one in fields(trial)]
        return [value.relative_to(folder) if isinstance(value, Path) else value for value in values]

    return repr(plain(a, folder_a)) == repr(plain(b, folder_b))


PLAIN = {
    "separator": ",",
    "decimal": ".",
    "line_end": "\n",
    "encoding": "utf-8",
    "blank_after": False,
    "empty_lines": False,
    "columns": COLUMNS,
}


@pytest.mark.slow
@settings(REPEATABLE, max_examples=120)
@given(rows=SHEET, dialect=DIALECT)
def test_a_sheet_reads_the_same_in_every_dialect(rows: list[dict[str, Any]], dialect: dict[str, Any]) -> None:
    rows = with_trials(rows)
    with scratch() as plain_folder, scratch() as folder:
        write_sheet(plain_folder, rows, PLAIN)
        plain = read_experiment(plain_folder)
        assert [trial.diameter_m for trial in plain.trials] == [row["diameter_mm"] / 1000 for row in rows]
        write_sheet(folder, rows, dialect)
        try:
            other = read_experiment(folder)
        except ExperimentError as error:  # pragma: no cover
            raise AssertionError(str(error)) from None
        ambiguous = [problem for problem in other.problems if "thousands or decimals" in problem.message]
        if not ambiguous:
            assert len(plain.trials) == len(other.trials) == len(rows)
            pairs = zip(plain.trials, other.trials, strict=True)
            assert all(same(a, b, plain_folder, folder) for a, b in pairs)
        # Three digits behind a decimal comma look like thousands wherever the separator does not speak for commas.
        assert not ambiguous or (dialect["decimal"] == "," and dialect["separator"] != ";")


BROKEN = {
    "diameter_mm": ("0.024", "abc", "nan", "-3", "301", "1e400", "24 mm"),
    "thickness_um": ("0", "abc", "inf", "80000", "1_0"),
    "length_mm": ("-1", "abc", "1e9", "٣"),
    "pressure_kPa": ("24000", "-1", "28 kPa", "0x1F", "1e5"),
    "yield_pressure_kPa": ("3000", "-0.1", "?"),
    "payload_g": ("-1", "none", "1e9"),
    "growth_angle_deg": ("181", "down", "1 2"),
    "bends": ("1:2", "1:2:0", "a:b:c", "::"),
    "steady": ("1", "2:1", "1:1", "a:b", "1:2:3"),
    "trial": ("v 1", "a/b", "..", "é", "x" * 200),
    "track": ("../a.csv", "/a.csv", "C:/a.csv", "a/../../b.csv"),
}


@pytest.mark.slow
@settings(REPEATABLE, max_examples=150)
@given(rows=SHEET, data=st.data())
def test_a_single_broken_cell_is_one_problem_that_names_it(rows: list[dict[str, Any]], data: st.DataObject) -> None:
    rows = with_trials(rows)
    which = data.draw(st.integers(0, len(rows) - 1))
    column = data.draw(st.sampled_from(sorted(BROKEN)))
    rows[which] = {**rows[which], column: data.draw(st.sampled_from(BROKEN[column]))}
    with scratch() as folder:
        write_sheet(folder, rows, PLAIN)
        experiment = read_experiment(folder)
        (problem,) = [problem for problem in experiment.problems if problem.severity == "error"]
        assert (problem.line, problem.column, problem.value) == (which + 2, column, rows[which][column])
        assert list(experiment.failed) == [problem.trial]
        assert len(experiment.trials) == len(rows) - 1
        assert all(len(line) < 400 for line in format_problems(experiment.problems))


NAMED_FILES = st.sampled_from(["trials.csv", "experiment.yaml", "t0.csv", "t0.trk"])
PIECES = [
    *(
        b"trial,track\n",
        b"t0;t0.csv",
        b"\n",
        b",",
        b";",
        b'"',
        b"\xff\xfe",
        b"\x00",
        b"1,5",
        b"1e400",
        b"\xe9",
        b"sep=;\n",
    ),
    *(
        b"{",
        b"[",
        b": ",
        b"&a ",
        b"*a",
        b"- ",
        b"'",
        b"!!python/object:os.system ",
        b"<<: ",
        b"\xef\xbb\xbf",
        b"? ",
        b"%",
    ),
    *(b"<?xml version='1.0'?>", b"<object class='x.TrackerPanel'>", b"</object>", b"time_s,position_m\n", b"t\tx\n"),
]
FRAGMENTS = st.lists(st.sampled_from(PIECES) | st.binary(max_size=8), max_size=30).map(b"".join)
BOMB = b"a0: &a0 [1]\n" + b"".join(b"a%d: &a%d [*a%d, *a%d]\n" % (i, i, i - 1, i - 1) for i in range(1, 60))


@pytest.mark.slow
@settings(REPEATABLE, max_examples=250)
@given(name=NAMED_FILES, content=st.binary(max_size=300) | FRAGMENTS)
@example(name="experiment.yaml", content=b"[" * 5000)
@example(name="experiment.yaml", content=b"a: &a [*a]")
@example(name="experiment.yaml", content=BOMB)
@example(name="experiment.yaml", content=b"<<: 3")
@example(name="experiment.yaml", content=b"1: 2\n? [a]\n: 3")
@example(name="experiment.yaml", content=b"ambient_pressure_kPa: 1" + b"0" * 5000)
@example(name="trials.csv", content=b'trial,track\n"' + b"x" * 200_000 + b'",1')
@example(name="t0.trk", content=b"<object>" * 20_000)
def test_random_bytes_raise_nothing_but_our_errors(name: str, content: bytes) -> None:
    with scratch() as folder:
        write_sheet(folder, with_trials([_PLAIN_ROW]), PLAIN)
        (folder / name).write_bytes(content)
        problems = check_experiment(folder)
        assert len(format_problems(problems)) <= 20
        for path in (folder / "t0.csv", folder / "t0.trk"):
            for reader in (read_track, read_pressure_trace):
                with pytest.raises(TrackError):
                    raise_if_read(reader, path)


_PLAIN_ROW: dict[str, Any] = {
    "diameter_mm": 24.0,
    "thickness_um": 200,
    "length_mm": 280.0,
    "pressure_kPa": 28.0,
    "yield_pressure_kPa": 3.0,
    "payload_g": None,
    "growth_angle_deg": None,
    "bends": None,
    "steady": None,
}


def raise_if_read(reader: Any, path: Path) -> None:
    """Random bytes may by chance be a trace of one row; that counts as refused here."""
    reader(path)
    raise TrackError("was read")


@REPEATABLE
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_float_is_read_back(value: float) -> None:
    text = repr(value)
    assert parse_number(text) == value
    assert parse_table(f"x;y\n{text.replace('.', ',')};0,5\n").numbers("x")[0] == value


@pytest.mark.slow
@REPEATABLE
@given(st.text(alphabet=st.sampled_from("ab./\\: C~\x00\n\u2028é"), max_size=14) | st.text(max_size=20))
def test_no_path_escapes(relative: str) -> None:
    root = Path("/srv/experiment")
    try:
        path = safe_join(root, relative)
    except TableError:
        return
    assert os.path.normpath(path) == str(path)
    assert Path(os.path.commonpath([root, path])) == root
    assert path != root


@REPEATABLE
@given(st.lists(ROW, min_size=2, max_size=6))
def test_conditions_have_one_name_each_and_it_names_a_file(rows: list[dict[str, Any]]) -> None:
    trials = with_names(
        [
            Trial(
                name=f"t{i}",
                diameter_m=row["diameter_mm"] / 1000,
                thickness_m=row["thickness_um"] / 1e6,
                length_m=row["length_mm"] / 1000,
                pressure_Pa=row["pressure_kPa"] * 1000,
                yield_pressure_Pa=row["yield_pressure_kPa"] * 1000,
                payload_kg=(row["payload_g"] or 0.0) / 1000,
                growth_angle_rad=np.radians(row["growth_angle_deg"] or 0.0),
            )
            for i, row in enumerate(rows)
        ]
    )
    physical = [tuple(f"{row[name] or 0.0:.6g}" for name in ROW_PHYSICS) for row in rows]
    names = [trial.condition for trial in trials]
    for i, first in enumerate(physical):
        for j, second in enumerate(physical):
            assert (first == second) == (names[i] == names[j])
    assert all(result_file(Path("r"), name, "").name == name for name in names)
    assert all(trial.condition.startswith(trial.vine + "_") for trial in trials)


ROW_PHYSICS = (
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "pressure_kPa",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
)
