"""What is no readable file fails its own trial, in a sentence; nothing waits for it; a full disk is said as such."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from commanded import run, succeed
from test_pipeline import write_track
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.effects._catalogue import remember
from vinetrack.experiment.folder import check_experiment
from vinetrack.experiment.provenance import describe_run
from vinetrack.pipeline.workflow import make_plan
from vinetrack.video.frames import RecordingError, inspect_recording

HEADER = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"
NO_FILES = dict.fromkeys(("pipe", "zero"), "a pipe or a device") | {"folder": "a folder", "shut": "permission denied"}


@pytest.fixture
def vines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An experiment of one sound track and of everything that is none."""
    folder = tmp_path / "vines"
    write_track(folder / "good.csv", 12, 20.0, 1)
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "folder").mkdir()
    (folder / "shut").write_text("time_s,position_m\n")
    rows = [f"{name},{name}{'.csv' if name == 'good' else ''},12,100,300,20,3,0\n" for name in ("good", *NO_FILES)]
    (folder / "trials.csv").write_text(HEADER + "".join(rows))
    allowed = os.access
    # Who runs the tests may be allowed to read everything.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "shut" and allowed(path, mode))
    return folder


def test_what_is_no_file_is_named_and_not_watched_and_fails_alone(vines: Path, tmp_path: Path) -> None:
    for name, words in NO_FILES.items():
        (problem,) = [problem for problem in check_experiment(vines) if problem.trial == name]
        assert words in problem.reason
    for name in ("pipe", "zero", "shut"):
        with pytest.raises(RecordingError):
            inspect_recording(vines / name)
    watched = [path.name for path in make_plan({"experiment": str(vines)}, tmp_path).inputs]
    assert watched == ["trials.csv", "good.csv", "folder"]
    succeed("trials", vines, tmp_path)
    rows = {path.stem: json.loads(path.read_text())["row"] for path in (tmp_path / "analysed").iterdir()}
    assert rows.pop("good")["status"] in ("ok", "warning")
    assert {name: row["status"] for name, row in rows.items()} == dict.fromkeys(NO_FILES, "failed")
    assert all(words in rows[name]["reason"] for name, words in NO_FILES.items())


def test_provenance_says_what_could_not_be_read_and_a_full_disk_is_said_as_such(
    vines: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as shut:
        shut.setattr(Path, "open", Mock(side_effect=PermissionError(errno.EACCES, "permission denied", "shut")))
        inputs = describe_run(vines, [vines / "shut", vines / "pipe"], {}, ())["inputs"]
    assert inputs == {"shut": "unreadable", "pipe": "missing"}
    monkeypatch.setattr(Path, "write_bytes", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    done = run("trials", vines, tmp_path / "out")
    assert done.exit_code == 1
    assert done.output.startswith("The disk is full: ")


PLACES = {
    "track": ("bad.csv", "track,bad.csv", ""),
    "track of a vine": ("good.csv", "track,good.csv", ""),
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
SOUND = {
    "log.csv": "time_s,pressure_kPa\n0,20\n5,20\n",
    "stick.py": (
        '"""Stick: a force that holds.\n\n    tip force −F\n"""\n\nfrom vinetrack.effects import Parameter\n\n'
        'PARAMETERS = (Parameter("F", "F", "N", 0.1, bounds=(0.0, 9.0), plausible=(0.0, 1.0)),)\n\n\n'
        "def tip_force(s, rig, F):\n    return -F\n"
    ),
}
KINDS = ("pipe", "device", "itself")
LONGEST_S = 200
"""Chosen: 33 folders are checked in 15 s on a quiet machine; what waits for a pipe waits for ever."""


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
    header = HEADER.replace("track,", f"{column},pressure_trace,mm_per_px,capture_fps,")
    (folder / "trials.csv").write_text(f"{header}bad,{value},{trace},{scale},{rate},12,100,300,20,3,0\n")
    if setting.startswith("image"):
        setting = f"calibration: {{kind: checkerboard, {setting}, squares: [5, 4], square_mm: 10}}"
    if setting:
        (folder / "experiment.yaml").write_text(setting + "\n")
    if kind:
        (folder / name).unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(folder / name)
    elif kind:
        (folder / name).symlink_to("/dev/zero" if kind == "device" else (folder / name).name)
    elif name in SOUND:
        (folder / name).write_text(SOUND[name])


def _check_all(root: Path) -> None:
    """What `vinetrack check` says of every experiment, beside each."""
    for place, kind in product(PLACES, KINDS):
        done = CliRunner().invoke(app, ["check", str(root / kind / place)])
        ended = done.exception is None or isinstance(done.exception, SystemExit)
        said = " ".join(done.output.split()) if ended else repr(done.exception)
        (root / kind / f"{place}.txt").write_text(f"{done.exit_code} {said}")


@pytest.mark.slow
def test_pipes_and_devices_are_refused_wherever_a_file_is_asked_for(tmp_path: Path) -> None:
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
            assert "it is a pipe or a device, not a file" in said, (place, kind)
        assert int(status) == (0 if (place, kind) == ("picture of a recording", "itself") else 1), (place, kind)


@pytest.mark.parametrize("place", ["track of a vine", "picture of a recording", "pressure trace", "effect"])
def test_what_a_link_out_of_the_folder_leads_to_is_as_good_as_the_file(
    tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recordings lie on another disk than their sheet: `check` says of links what it says of the files."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    answers = []
    for name in ("files", "links"):
        folder = tmp_path / name / "vines"
        _experiment(folder, place, "")
        entries = [entry for entry in folder.iterdir() if entry.name not in ("trials.csv", "experiment.yaml")]
        for entry in entries if name == "links" else []:
            elsewhere = tmp_path / "disk" / entry.name
            elsewhere.parent.mkdir(exist_ok=True)
            entry.rename(elsewhere)
            entry.symlink_to(elsewhere)
        assert all(entry.is_symlink() == (name == "links") for entry in entries)
        if place == "effect":
            remember(folder / "stick.py")
        done = run("check", folder)
        answers.append((done.exit_code, done.output.replace(str(folder), "FOLDER")))
    assert answers[0] == answers[1]
    assert "is a link" not in answers[1][1]
    assert "does not exist" not in answers[1][1]


@pytest.mark.parametrize("name", ["trials.csv", "experiment.yaml", "corrections.csv", "good.csv"])
def test_a_link_whose_disk_is_not_there_is_said_and_not_taken_for_a_file_left_out(tmp_path: Path, name: str) -> None:
    """Settings on a disk that is not connected would otherwise be the defaults."""
    _experiment(tmp_path / "vines", "track of a vine", "")
    path = tmp_path / "vines" / name
    path.unlink(missing_ok=True)
    path.symlink_to(tmp_path / "disk" / name)
    words = [str(problem) for problem in check_experiment(tmp_path / "vines") if problem.severity == "error"]
    assert len(words) == 1
    assert "is a link to something that does not exist: connect the disk" in words[0]
