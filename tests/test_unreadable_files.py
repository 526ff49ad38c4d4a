"""What is no readable file fails its own trial, in a sentence; nothing waits for it; a full disk is said as such."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_pipeline import ROOT, write_track
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.core.files import file_size, is_readable
from vinetrack.experiment.folder import check_experiment
from vinetrack.experiment.provenance import describe_run
from vinetrack.pipeline.workflow import make_plan
from vinetrack.video.frames import RecordingError, inspect_recording

HEADER = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"
NO_FILES = {
    "pipe": "a pipe or a device",
    "zero": "a pipe or a device",
    "folder": "a folder",
    "shut": "permission denied",
}


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


@pytest.mark.parametrize(("name", "words"), NO_FILES.items())
def test_check_names_what_is_no_file(vines: Path, name: str, words: str) -> None:
    problems = [problem for problem in check_experiment(vines) if problem.trial == name]
    assert len(problems) == 1
    assert words in problems[0].reason


@pytest.mark.parametrize("name", ["pipe", "zero", "shut"])
def test_a_recording_that_is_no_file_is_refused(vines: Path, name: str) -> None:
    with pytest.raises(RecordingError, match=rf"^{name}: cannot be read: .*{NO_FILES[name]}"):
        inspect_recording(vines / name)


def test_the_workflow_watches_readable_files_alone(vines: Path, tmp_path: Path) -> None:
    watched = [path.name for path in make_plan({"experiment": str(vines)}, tmp_path).inputs]
    assert watched == ["trials.csv", "good.csv", "folder"]


def test_the_stage_of_tracks_fails_those_and_analyses_the_rest(vines: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["tracks", str(vines), str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    rows = {name: json.loads((tmp_path / "out" / "analysed" / f"{name}.json").read_text())["row"] for name in NO_FILES}
    assert {name: row["status"] for name, row in rows.items()} == dict.fromkeys(NO_FILES, "failed")
    assert all(words in rows[name]["reason"] for name, words in NO_FILES.items())
    good = json.loads((tmp_path / "out" / "analysed" / "good.json").read_text())["row"]
    assert good["status"] in ("ok", "warning")


def test_provenance_says_what_could_not_be_read(vines: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def shut(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "permission denied", str(self))

    monkeypatch.setattr(Path, "open", shut)
    inputs = describe_run(vines, [vines / "shut", vines / "pipe"], {}, ())["inputs"]
    assert inputs == {"shut": "unreadable", "pipe": "missing"}


@pytest.mark.pipeline
def test_a_pipe_among_the_tracks_does_not_end_the_run(vines: Path, tmp_path: Path) -> None:
    assert (vines / "pipe").is_fifo()
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--cores", "1",
        "results/vines/trials.csv", "--config", "experiment=vines",
    ]  # fmt: skip
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "a pipe or a device" in (tmp_path / "results" / "vines" / "trials.csv").read_text()


def test_a_link_to_a_file_elsewhere_is_read(tmp_path: Path) -> None:
    """Recordings lie on another disk than their sheet; only the text of a path must stay inside the folder."""
    (tmp_path / "elsewhere.csv").write_text("time_s,position_m\n")
    (tmp_path / "link.csv").symlink_to(tmp_path / "elsewhere.csv")
    assert is_readable(tmp_path / "link.csv")
    assert file_size(tmp_path / "link.csv") == 18


def test_a_full_disk_is_said_as_such(vines: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    done = CliRunner().invoke(app, ["tracks", str(vines), str(tmp_path / "out")])
    assert done.exit_code == 1
    assert done.output.strip() == (
        "The disk is full: make room and run the same command again; what was finished is kept."
    )
