"""What is no readable file fails its own trial, in a sentence; nothing waits for it; random bytes raise our errors."""

import contextlib
import errno
import json
import multiprocessing
import os
import tempfile
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from commanded import run, succeed
from generated_experiments import is_let_through, run_through, write_experiment
from hand_sheet import two_vines
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plain_scene import write_video
from test_pipeline import SHEET, write_track
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.core.problems import InputError, format_problems
from vinetrack.core.records import Trial
from vinetrack.core.tables import parse_number, parse_table
from vinetrack.experiment.folder import check_experiment
from vinetrack.pipeline.workflow import make_plan
from vinetrack.results import describe_run
from vinetrack.tracks.importers import read_pressure_trace, read_track
from vinetrack.video.frames import RecordingError, inspect_recording
from vinetrack.video.track import track_recording

NO_FILES = dict.fromkeys(("pipe", "zero"), "a pipe or a device") | {"folder": "a folder", "shut": "permission denied"}


@pytest.fixture
def vines(tmp_path, monkeypatch):
    """An experiment of one sound track and of everything that is none."""
    folder = tmp_path / "vines"
    write_track(folder / "good.csv", 12, 20.0, 1)
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "folder").mkdir()
    (folder / "shut").write_text("time_s,position_m\n")
    rows = [f"{name},{name}{'.csv' if name == 'good' else ''},12,100,300,20,3,0\n" for name in ("good", *NO_FILES)]
    (folder / "trials.csv").write_text(SHEET + "".join(rows))
    allowed = os.access
    # Who runs the tests may be allowed to read everything.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "shut" and allowed(path, mode))
    return folder


def test_what_is_no_file_is_named_and_fails_alone(vines, tmp_path):
    for name, words in NO_FILES.items():
        (problem,) = [problem for problem in check_experiment(vines) if problem.trial == name]
        assert words in problem.reason
    for name in ("pipe", "zero", "shut"):
        with pytest.raises(RecordingError):
            inspect_recording(vines / name)
    assert make_plan({"experiment": str(vines)}, tmp_path).trials == ("good", *NO_FILES)
    succeed("trials", vines, tmp_path)
    rows = {path.stem: json.loads(path.read_text())["row"] for path in (tmp_path / "analysed").iterdir()}
    assert rows.pop("good")["status"] in ("ok", "warning")
    assert {name: row["status"] for name, row in rows.items()} == dict.fromkeys(NO_FILES, "failed")
    assert all(words in rows[name]["reason"] for name, words in NO_FILES.items())


def test_provenance_says_what_could_not_be_read_and_a_full_disk_is_said_as_such(vines, tmp_path, monkeypatch):
    with monkeypatch.context() as shut:
        shut.setattr(Path, "open", Mock(side_effect=PermissionError(errno.EACCES, "permission denied", "shut")))
        inputs = describe_run(vines, [vines / "shut", vines / "pipe"], {}, ())["inputs"]
    assert inputs == {"shut": "unreadable", "pipe": "missing"}
    monkeypatch.setattr(Path, "write_bytes", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    done = run("trials", vines, tmp_path / "out")
    assert done.exit_code == 1
    assert done.output.startswith("error: the disk is full: ")


PLACES = {
    "track": ("bad.csv", "track,bad.csv", ""),
    "recording": ("bad.mp4", "video,bad.mp4", ""),
    "picture of a recording": ("shots/f0002a.png", "video,shots", ""),
    "side file of pictures": ("shots/shots.cih", "video,shots", ""),
    "pressure trace": ("log.csv", "track,good.csv", ""),
    "calibration picture": ("board.png", "video,shots", "image: board.png"),
    "one of many calibration pictures": ("boards/f0002a.png", "video,shots", "image: boards"),
    "effect": ("stick.py", "track,good.csv", "effects: [stick.py]"),
    "corrections": ("corrections.csv", "track,good.csv", ""),
    "settings": ("experiment.yaml", "track,good.csv", ""),
    "sheet": ("trials.csv", "", ""),
}
KINDS = ("pipe", "device", "itself")
LONGEST_S = 200  # Chosen: All folders are checked in 15 s on a quiet machine; what waits for a pipe waits for ever


def _experiment(folder: Path, place: str, kind: str) -> None:
    """An experiment of one trial in which one file is none."""
    name, recording, setting = PLACES[place]
    column, _, value = recording.partition(",")
    write_track(folder / "good.csv", 12, 20.0, 1)
    for pictures in ("shots", "boards"):  # of a few pictures, too few for a recording
        (folder / pictures).mkdir()
        for number in range(5):
            cv2.imwrite(str(folder / pictures / f"f{number:04d}.png"), np.full((40, 60), 20 * number, np.uint8))
    rate = "1000" if column == "video" else ""
    trace = name if place == "pressure trace" else ""
    scale = "" if setting.startswith("image") else "0.3"
    header = SHEET.replace("track,", f"{column},pressure_trace,mm_per_px,capture_fps,")
    (folder / "trials.csv").write_text(f"{header}bad,{value},{trace},{scale},{rate},12,100,300,20,3,0\n")
    if setting.startswith("image"):
        setting = f"calibration: {{kind: checkerboard, {setting}, squares: [5, 4], square_mm: 10}}"
    if setting:
        (folder / "experiment.yaml").write_text(setting + "\n")
    (folder / name).unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).symlink_to("/dev/zero" if kind == "device" else (folder / name).name)


def _check_all(root: Path) -> None:
    """What `vinetrack check` says of every experiment, beside each."""
    for place, kind in product(PLACES, KINDS):
        done = CliRunner().invoke(app, ["check", str(root / kind / place)])
        ended = done.exception is None or isinstance(done.exception, SystemExit)
        said = " ".join(done.output.split()) if ended else repr(done.exception)
        (root / kind / f"{place}.txt").write_text(f"{done.exit_code} {said}")


@pytest.mark.slow
def test_pipes_and_devices_are_refused_wherever_a_file_is_asked_for(tmp_path):
    for place, kind in product(PLACES, KINDS):
        _experiment(tmp_path / kind / place, place, kind)
    # In a process that is ended where it waits for a pipe.
    process = multiprocessing.get_context("spawn").Process(target=_check_all, args=(tmp_path,))
    process.start()
    process.join(LONGEST_S)
    process.kill()
    for place, kind in product(PLACES, KINDS):
        answer = tmp_path / kind / f"{place}.txt"
        assert answer.exists(), f"it waits for {place}, {kind}"
        status, _, said = answer.read_text().partition(" ")
        assert "Error(" not in said
        # A link that leads to itself is a file that is missing, and a picture may be.
        if kind != "itself":
            assert "a folder, a pipe or a device, not a file" in said, (place, kind)
        # (Of the pictures that are left nothing grows.)
        assert int(status) == 1, (place, kind)


@pytest.mark.parametrize("name", ["trials.csv", "experiment.yaml", "corrections.csv", "b.csv"])
def test_a_link_whose_disk_is_not_there_is_said_and_not_taken_for_a_file_left_out(tmp_path, name):
    path = two_vines(tmp_path) / name
    path.unlink(missing_ok=True)
    path.symlink_to(tmp_path / "disk" / name)
    words = [str(problem) for problem in check_experiment(path.parent) if problem.severity == "error"]
    assert len(words) == 1
    assert "is a link to something that does not exist: connect the disk" in words[0]


# Properties of the intake over random bytes, numbers and hostile paths.
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
def test_random_bytes_raise_nothing_but_our_errors(name, content):
    with tempfile.TemporaryDirectory() as scratch:  # hypothesis reuses pytest's own folder across examples
        folder = two_vines(Path(scratch))
        (folder / "a.csv").unlink()
        (folder / name).write_bytes(content)
        problems = check_experiment(folder)
        assert len(format_problems(problems)) <= 20
        for path in (folder / "a.csv", folder / "a.trk"):
            for reader in (read_track, read_pressure_trace):
                with contextlib.suppress(InputError):  # they may by chance be a trace of one row
                    reader(path)


@REPEATABLE
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_float_is_read_back(value):
    text = repr(value)
    assert parse_number(text) == value
    assert parse_table(f"x;y\n{text.replace('.', ',')};0,5\n").numbers("x")[0] == value


# Experiments that `check` lets through reach the end of their run, however odd their motion and their clips.
@pytest.mark.slow
@pytest.mark.parametrize("seed", [21402, 21403, 31114, 31207])
def test_a_drawn_experiment_meets_no_fault_of_the_program(tmp_path, seed):
    write_experiment(tmp_path / "drawn", seed)
    assert not is_let_through(tmp_path / "drawn") or run_through(tmp_path / "drawn", tmp_path / "out", False) == []


X, Y = np.meshgrid(np.arange(160), np.arange(64))
WALL = np.random.default_rng(0).integers(60, 120, X.shape)
TUBE = (Y > 20) & (Y < 40)
BAD_CLIPS = {
    "black": [0 * X] * 20,
    "still": [WALL] * 20,
    "flash": [np.full(X.shape, 255) if i == 10 else WALL for i in range(20)],
    "step of light": [WALL if i < 10 else WALL + 90 for i in range(20)],
    "blinking": [np.where((X > 60) & (X < 100) & TUBE & (i % 2 == 0), 200, WALL) for i in range(20)],
    "all at once": [np.where(i >= 5, 200, WALL) for i in range(20)],
    "teleport": [np.where((abs(X - (30 if i < 10 else 130)) < 10) & TUBE, 220, WALL) for i in range(20)],
    "cut off": [np.where((5 * i > X) & TUBE, 200, WALL) if i < 9 else 0 * X for i in range(19)],
}


@pytest.mark.parametrize("name", BAD_CLIPS)
def test_a_bad_clip_is_refused_in_a_sentence(tmp_path, name):
    """Warnings are errors in tests: nothing is computed from an empty stretch on the way."""
    frames = np.clip(BAD_CLIPS[name], 0, 255).astype(np.uint8)
    path = write_video(tmp_path / "a.mkv", frames, "ffv1", "gray", playback_fps=30)
    trial = Trial(name="a", video=path, capture_fps=1000.0, m_per_px=2e-4, diameter_m=0.004, length_m=0.03)
    with pytest.raises(RecordingError):
        track_recording(trial)
