"""Properties of the intake over random bytes, numbers and hostile paths."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import pytest
from hand_sheet import two_vines
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vinetrack.core.problems import format_problems
from vinetrack.core.tables import TableError, parse_number, parse_table, safe_join
from vinetrack.experiment.folder import check_experiment
from vinetrack.tracks.importers import TrackError, read_pressure_trace, read_track

REPEATABLE = settings(derandomize=True, deadline=None)
NAMED_FILES = st.sampled_from(["trials.csv", "experiment.yaml", "a.csv", "a.trk"])
MARKS = "\n,;\"{['%\x00"
PIECES = [
    *(mark.encode() for mark in MARKS),
    *(b"trial,track\n", b"a;a.csv", b"sep=;\n", b"time_s,position_m\n", b"t\tx\n", b"1,5", b"1e400"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\xe9"),
    *(b": ", b"&a ", b"*a", b"- ", b"? ", b"<<: ", b"!!python/object:os.system "),
    *(b"<?xml version='1.0'?>", b"<object class='x.TrackerPanel'>", b"</object>"),
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
@example(name="a.trk", content=b"<object>" * 20_000)
def test_random_bytes_raise_nothing_but_our_errors(name: str, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as scratch:  # hypothesis reuses pytest's own folder across examples
        folder = two_vines(Path(scratch))
        (folder / "a.csv").unlink()
        (folder / name).write_bytes(content)
        problems = check_experiment(folder)
        assert len(format_problems(problems)) <= 20
        for path in (folder / "a.csv", folder / "a.trk"):
            for reader in (read_track, read_pressure_trace):
                with contextlib.suppress(TrackError):  # they may by chance be a trace of one row
                    reader(path)


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
