"""The stage of the trials on recordings: what is tracked again after which change, and after a kill."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plain_scene import Plan, plain_scene, write_video

from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import run_settings
from vinetrack.pipeline.stages import Job, map_unordered
from vinetrack.pipeline.trials import Kept, analyse_trials, packed, unpacked
from vinetrack.results.folder_layout import Results, read_result
from vinetrack.video import survey
from vinetrack.video.track import Tracking, in_metres

SHEET: dict[str, object] = {
    "capture_fps": 1000, "diameter_mm": 13.2, "thickness_um": 100, "length_mm": 190, "pressure_kPa": 30,
    "yield_pressure_kPa": 3, "mm_per_px": 0.3,
}  # fmt: skip
PNG = run_settings({"figures": {"formats": ["png"]}})
PLAN = Plan(seed=20940, width=640, height=160, from_px=(30.0, 80.0), end_px=560.0, radius=22.0)


def write_sheet(folder: Path, settings: str = "", **cells: object) -> None:
    """Two trials; the cells are those of the first, and `SHEET` those of the second."""
    rows = [SHEET | {"trial": "a", "video": "a.mp4"} | cells, SHEET | {"trial": "b", "video": "b.mp4"}]
    pd.DataFrame(rows).to_csv(folder / "trials.csv", index=False)
    (folder / "experiment.yaml").write_text(settings)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """An experiment of two films, and its results."""
    folder = tmp_path_factory.mktemp("kept") / "vines"
    folder.mkdir()
    frames = plain_scene(PLAN).frames
    for name in ("a", "b"):
        write_video(folder / f"{name}.mp4", frames, options={"crf": "12"})
    write_sheet(folder)
    results = folder.parent / "results"
    assert analyse_trials(Job(read_experiment(folder), results, PNG)) == []
    return folder, results


def again(tracked: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The films that are tracked when the stage runs once more; figures are left out."""
    folder, results = tracked
    films: list[str] = []

    def track(frames: object, *given: object) -> Tracking:
        films.append(frames.recording.path.stem)  # type: ignore[attr-defined]
        return track_pixels(frames, *given)  # type: ignore[arg-type]

    track_pixels = survey.track_pixels
    with monkeypatch.context() as changed:
        changed.setattr(survey, "track_pixels", track)
        changed.setattr(Kept, "figure", lambda *_: None)
        analyse_trials(Job(read_experiment(folder), results, run_settings({})))
    return films


CELLS: Mapping[str, object] = {
    "trial": "other", "track": None, "video": None, "capture_fps": 900, "exposure_us": 100, "diameter_mm": 13,
    "thickness_um": 90, "length_mm": 200, "pressure_kPa": 31, "yield_pressure_kPa": 2, "pressure_sigma_kPa": 0.2,
    "yield_pressure_sigma_kPa": 0.1, "pressure_trace": None, "payload_g": 1, "growth_angle_deg": 90, "chamber_l": 2,
    "inlet_mm": 3, "bends": "10:20:50", "film_density_kg_m3": 1100, "mm_per_px": 0.29, "travel_ratio": None,
    "steady": "0.01:0.02", "use": "no", "specimen": "s", "day": "monday", "order": 2, "axis": "30,80:600,80",
    "frames_used": "2:60", "point_mass": None, "compare_sizes": "no", "position_systematic_mm": 0.1,
    "capture_fps_is_playback": "yes",
}  # fmt: skip
"""A changed cell of every column; None for those that make it another kind of trial."""
RETRACKED = {"capture_fps", "exposure_us", "axis", "frames_used"}
KEYS = (
    "model: [pressure_drive, gravity, eversion_damping, yield_pressure, leak]\nchamber_l: 3\n",
    "candidates: [air_drag]\n",
    "ambient_pressure_kPa: 99\n",
    "limits: {trials: 2}\n",
)


@pytest.mark.parametrize("column", [name for name in COLUMNS if CELLS[name] is not None])
def test_a_changed_cell_tracks_its_film_again_only_where_the_picture_is_read_otherwise(tracked, monkeypatch, column):
    write_sheet(tracked[0], **{column: CELLS[column]})
    assert again(tracked, monkeypatch) == (["a"] if column in RETRACKED else [])


def test_a_replaced_film_is_tracked_again_alone(tracked, monkeypatch):
    for settings in KEYS:
        write_sheet(tracked[0], settings)
        assert again(tracked, monkeypatch) == [], settings
    write_sheet(tracked[0])
    os.utime(tracked[0] / "b.mp4", (1e9, 1e9))
    assert again(tracked, monkeypatch) == ["b"]
    assert again(tracked, monkeypatch) == []


@pytest.mark.slow
def test_a_changed_scale_gives_the_metres_of_a_new_track(tracked, tmp_path):
    folder, results = tracked
    write_sheet(folder, mm_per_px=0.29)
    for place in (results, tmp_path):
        analyse_trials(Job(read_experiment(folder), place, PNG, ["a"]))
    files = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*a.*") if ".kept" not in path.parts)
    assert len(files) == 5
    for file in files:
        assert (tmp_path / file).read_bytes() == (results / file).read_bytes(), file


def test_what_is_kept_is_every_bit_of_a_tracking(tracked):
    (path, *_) = (tracked[1] / ".kept").glob("*.npz")
    tracking = unpacked(path.read_bytes())
    again = unpacked(packed(tracking))
    assert (again.axis, again.ending, again.track.notes) == (tracking.axis, tracking.ending, tracking.track.notes)
    np.testing.assert_array_equal(again.kymograph, tracking.kymograph)
    np.testing.assert_array_equal(again.track.lead_position_sigma_m, tracking.track.lead_position_sigma_m)
    trial = read_experiment(tracked[0]).trial("b")
    assert np.nanmax(in_metres(again, trial, 3e-4).track.lead_position_m) > 0.15


@pytest.mark.slow
def test_a_killed_stage_goes_on_at_the_recording_where_it_stopped(tracked, tmp_path):
    folder, results = tracked
    write_sheet(folder)
    command = [sys.executable, "-m", "vinetrack.cli.main", "trials", str(folder), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ends = time.monotonic() + 120
    with subprocess.Popen(command, env=environment) as first:
        while not list((tmp_path / ".kept").glob("[!.]*.npz")) and time.monotonic() < ends:
            time.sleep(0.005)
        first.send_signal(signal.SIGKILL)
    kept = {path: path.stat().st_ino for path in (tmp_path / ".kept").glob("[!.]*.npz")}
    assert kept
    subprocess.run(command, env=environment, check=True)
    assert {path: path.stat().st_ino for path in kept} == kept
    analyse_trials(Job(read_experiment(folder), results, PNG))
    for name in ("a", "b"):
        pd.testing.assert_frame_equal(
            read_result(Results(tmp_path).track(name)), read_result(Results(results).track(name)), atol=1e-5
        )


# Workers of a pool: they answer in any order, and end with the process that started them, however it ends.
PARENT = """
import os, sys, time
from vinetrack.pipeline.stages import map_unordered

def task(number):
    os.write(1, b"%d\\n" % os.getpid())  # at once: two that print mix their lines
    time.sleep(0.02 if number < 4 else 600)

for _ in map_unordered(task, range(8), 2):
    pass
"""


@pytest.mark.skipif(not Path("/proc").exists(), reason="which processes are there is read from /proc")
def test_every_item_is_answered_and_workers_of_a_killed_run_end_too(tmp_path):
    def is_alive(process: int) -> bool:
        """Whether a process is there, and not only waiting to be counted."""
        try:
            return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except (ProcessLookupError, FileNotFoundError):
            return False

    assert sorted(map_unordered(abs, range(-19, 1), 2)) == list(range(20))
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    workers: set[int] = set()
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        while len(workers) < 2:
            workers.add(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
    ends = time.monotonic() + 60
    while any(map(is_alive, workers)) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not any(map(is_alive, workers))
