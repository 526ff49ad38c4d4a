"""Stages on recordings: what is tracked again after which change or kill, one tracked by command, and clips."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pytest
from commanded import run, succeed
from explorer_campaign import write_bars
from plain_scene import Plan, plain_scene, write_video

from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import run_settings
from vinetrack.figures.motion_figures import TRACKED, ClipView, draw_strip
from vinetrack.figures.style import SKY, VERMILLION
from vinetrack.pipeline import analysis, report_stage
from vinetrack.pipeline.analysis import analyse_trials
from vinetrack.pipeline.workflow import Job, map_unordered
from vinetrack.report import build as clips
from vinetrack.results import Results, read_result
from vinetrack.video import survey
from vinetrack.video.track import NO_GROWTH, Tracking

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
    assert analyse_trials(Job(read_experiment(folder), results, PNG)) == ["2 of 2 analysed"]
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
        changed.setattr(analysis, "_draw", lambda *_: None)
        analyse_trials(Job(read_experiment(folder), results, run_settings({})))
    return films


CELLS: Mapping[str, object] = {
    "track": None, "video": None, "capture_fps": 900, "exposure_us": 100, "diameter_mm": 13,
    "thickness_um": 90, "length_mm": 200, "pressure_kPa": 31, "yield_pressure_kPa": 2, "pressure_sigma_kPa": 0.2,
    "yield_pressure_sigma_kPa": 0.1, "pressure_trace": None, "payload_g": 1, "growth_angle_deg": 90, "chamber_l": 2,
    "inlet_mm": 3, "bends": "10:20:50", "film_density_kg_m3": 1100, "mm_per_px": 0.29, "travel_ratio": None,
    "steady": "0.01:0.02", "use": "no", "axis": "30,80:600,80",
    "frames_used": "2:60", "point_mass": None, "compare_sizes": "no", "position_systematic_mm": 0.1,
    "capture_fps_is_playback": "yes",
}  # fmt: skip  # A changed cell of a column, else "other" or 2; None for those that make it another kind of trial
CELLS = {name: CELLS.get(name, "other" if column.kind == "text" else 2) for name, column in COLUMNS.items()}
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


# Workers of a pool: they answer in any order, and end with the process that started them, however it ends.
PARENT = """
import os, sys, time
from vinetrack.pipeline.workflow import map_unordered

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


# `vinetrack track`: one recording to a table, a strip and a clip; every obvious mistake is one sentence.


@pytest.mark.slow
def test_a_film_gives_pixels_of_the_picture_and_with_rate_and_scale_seconds_and_metres(tmp_path, monkeypatch):
    scene = plain_scene(PLAN)
    clip = write_video(tmp_path / "vine.mp4", scene.frames, options={"crf": "12"})
    drawn: list[Tracking] = []
    monkeypatch.setattr(clips, "draw_strip", lambda *given: drawn.append(given[1]) or draw_strip(*given))
    assert "Capture rate unknown" in succeed("track", clip, "--out", tmp_path / "out")
    table = pd.read_csv(tmp_path / "out" / "track.csv")
    assert list(table) == [
        "frame", "time_s", "edge_px", "edge_sigma_px", "edge_systematic_px", "x_px", "y_px", "flag",
    ]  # fmt: skip
    assert len(table) == len(scene.frames)
    assert table["time_s"].isna().all()
    assert np.isnan(drawn[0].track.time_s).all()  # the strip counts frames where there are no seconds
    off = (table["x_px"] - (scene.edge_px + 30.0))[scene.moving]
    assert float(off.abs().median()) < 0.5
    assert table["y_px"].sub(80.0).abs().max() < 1.5
    assert (tmp_path / "out" / "strip.png").stat().st_size > 10_000
    with av.open(str(tmp_path / "out" / "overlay.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) > 20

    given = ("--capture-fps", 2000, "--exposure-us", 100, "--mm-per-px", 0.25)
    content = json.loads(run("track", clip, *given, "--out", tmp_path, "--json", "-").stdout)
    assert content["duration_s"] == pytest.approx(len(scene.frames) / 2000)
    assert content["mm_per_px"] == 0.25
    assert content["fastest_m_s"] == pytest.approx(20 * 0.25e-3 * 2000, rel=0.05)
    table = pd.read_csv(content["written"]["table"])
    assert np.allclose(np.diff(table["time_s"]), 1 / 2000)
    assert table["time_s"][0] == pytest.approx(50e-6)
    assert np.allclose(table["position_m"], 0.25e-3 * table["edge_px"])
    assert np.allclose(table["sigma_m"], 0.25e-3 * table["edge_sigma_px"])
    assert np.allclose(table["systematic_m"], 0.25e-3 * table["edge_systematic_px"])
    # Or the scale is that of the settings of an experiment.
    (tmp_path / "experiment.yaml").write_text(
        "calibration: {kind: two_points, from_px: [10, 20], to_px: [410, 20], length_mm: 200}\n"
    )
    done = run("track", clip, "--calibration", tmp_path, "--out", tmp_path / "out", "--json", "-")
    assert json.loads(done.stdout)["mm_per_px"] == pytest.approx(0.5)


def test_a_film_without_motion_and_an_axis_that_is_none_are_refused_in_a_sentence(tmp_path):
    still = write_video(tmp_path / "still.mp4", np.full((40, 160, 640), 90, np.uint8))
    done = run("track", still, "--out", tmp_path / "out")
    assert (done.exit_code, done.stderr.strip()) == (1, f"error: still.mp4: nothing moves in the picture; {NO_GROWTH}")
    assert not (tmp_path / "out").exists()
    assert run("track", still, "--axis", "10,20").exit_code == 2


# Clips from a results folder: which recordings get one, where predictions stand in pixels, and what is refused.
N, WIDTH, HEIGHT = 60, 480, 120
MM_PER_PX = 0.5
EDGE_PX = 40.0 + 10.0 * np.clip(np.arange(N) - 20, 0, 30)
"""At rest for 20 frames, then 10 px a frame for 30, then at rest."""


def campaign(folder: Path, diagnosed: bool = True) -> tuple[Path, Path]:
    """An experiment of two filmed replicates, one of another condition and one that failed, and its results."""
    experiment, results = folder / "vines", folder / "out"
    experiment.mkdir(parents=True)
    edge, time_s = EDGE_PX, np.arange(N) / 1000
    write_bars(experiment / "a.mp4", edge, WIDTH, HEIGHT)
    rows = ["trial,video,capture_fps,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,mm_per_px"]
    trials = {"a": 24, "b": 24, "c": 30, "torn": 36}
    rows += [f"{name},a.mp4,1000,20,100,180,{kPa},3,{MM_PER_PX}" for name, kPa in trials.items()]
    (experiment / "trials.csv").write_text("\n".join(rows) + "\n")
    for part in ("tracks", "analysed", "diagnosis/predictions"):
        (results / part).mkdir(parents=True)
    position_m = 1e-3 * MM_PER_PX * edge
    track = pd.DataFrame({"frame": range(N), "time_s": time_s, "edge_px": edge, "lead_position_m": position_m})
    track = track.assign(lead_position_sigma_m=1e-5, flag="")
    said = pd.DataFrame({"time_s": time_s, "lead_position_m": position_m})
    said = said.assign(model_before_m=position_m + 20e-3, model_after_m=position_m - 5e-3)
    axis = {"from_px": [0.0, 60.0], "to_px": [479.0, 60.0], "width_px": 40.0}
    for name in trials:
        track.iloc[: 0 if name == "torn" else N].to_csv(results / "tracks" / f"{name}.csv", index=False)
        content = {"row": {"mm_per_px": MM_PER_PX}, "axis": axis}
        (results / "analysed" / f"{name}.json").write_text(json.dumps(content))
        if diagnosed and name != "torn":
            said.to_csv(results / "diagnosis" / "predictions" / f"{name}.csv", index=False)
    status = ["ok", "ok", "warning", "failed"]
    pd.DataFrame({"trial": list(trials), "status": status}).to_csv(results / "trials.csv", index=False)
    provenance = {"experiment": str(experiment), "settings": {"overlays": {"seconds": 2.0, "width_px": 480}}}
    (results / "provenance.json").write_text(json.dumps(provenance))
    if diagnosed:
        (results / "diagnosis.json").write_text(json.dumps({"effects": ["air_drag"]}))
        (results / "fit.json").write_text(json.dumps({"trials": {"a": {"release_s": 0.02}}}))
    return experiment, results


def test_a_clip_shows_tracked_and_predicted_edges_where_they_are(tmp_path):
    _, results = campaign(tmp_path)
    path = report_stage.overlay_one(results, "a")
    assert path == results / "overlays" / "a.mp4"
    with av.open(str(path)) as container:
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    shown = clips.frames_to_show(read_result(Results(results).track("a")))
    assert len(pictures) == len(shown)
    frame = 35
    picture = pictures[frame - shown.start]
    # 20 mm ahead is 40 px, 5 mm behind 10 px.
    for colour, place in ((TRACKED, 190), (VERMILLION, 230), (SKY, 180)):
        target = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
        away = np.abs(picture[-HEIGHT:] - target).sum(axis=2)
        # Half of the colour is lost on lines of three pixels: the column that comes nearest is the line's.
        assert np.sort(away, axis=0)[:8].mean(axis=0).argmin() == pytest.approx(place, abs=2), colour


def test_edges_go_along_with_a_shaken_picture(tmp_path, monkeypatch):
    _, results = campaign(tmp_path)
    drawn: list[np.ndarray] = []

    def seen(view: ClipView, picture: np.ndarray, frame: int, _time_ms: float) -> np.ndarray:
        drawn.append(np.array([edge.along_px[frame] for edge in view.edges]))
        return np.repeat(picture[:, :, None], 3, axis=2)

    monkeypatch.setattr("vinetrack.report.build.compose", seen)
    report_stage.overlay_one(results, "a", seconds=2)
    path, shake_px = results / "analysed" / "a.json", 2.0 * np.sin(np.arange(N))
    content = json.loads(path.read_text())
    content["axis"]["shake_px"] = shake_px.tolist()
    path.write_text(json.dumps(content))
    report_stage.overlay_one(results, "a", seconds=2)
    still, shaken = np.split(np.array(drawn), 2)
    shown = clips.frames_to_show(read_result(Results(results).track("a")))
    np.testing.assert_allclose(shaken - still, np.tile(shake_px[shown, None], 3), atol=1e-9)


def test_metres_turn_into_pixels_through_lens_and_tilt():
    edge = np.linspace(10, 900, 200)
    metres = 2.4e-4 * edge * (1 + 5e-5 * edge)
    seen = np.where((np.arange(200) < 3) | (np.arange(200) > 9), edge, math.nan)
    track = pd.DataFrame({"edge_px": seen, "lead_position_m": metres})
    assert clips.position_to_px(track)(metres) == pytest.approx(edge, abs=0.6)


def test_one_recording_a_condition_is_drawn_and_one_that_cannot_be_does_not_stop_the_others(tmp_path):
    experiment, results = campaign(tmp_path)
    read = read_experiment(experiment)
    expected = {"one_per_condition": ["a", "c"], "all": ["a", "b", "c"], "none": []}
    for of, names in expected.items():
        assert report_stage.chosen_trials(read, Results(results), of) == names
    (results / "analysed" / "a.json").write_text(json.dumps({"row": {"mm_per_px": 0.5}}))
    settings = run_settings({"overlays": {"seconds": 1, "width_px": 320}})
    (said,) = report_stage.draw_overlays(Job(read, results, settings))
    assert said.startswith("  a: no clip: ")
    assert [path.name for path in (results / "overlays").iterdir()] == ["c.mp4"]
    assert report_stage.chosen_trials(read, Results(results), "none") == ["c"]  # or it would show an old model


def test_a_clip_goes_from_before_to_after_the_motion_about_as_long_as_asked_at_a_rate_that_players_know():
    shown, margin = clips.frames_to_show(pd.DataFrame({"edge_px": EDGE_PX})), clips.MARGIN_FRAMES
    assert shown.start == 21 - margin
    assert 49 + margin <= shown.stop <= 51 + margin
    for n_frames in (10, 30, 200, 1000, 20_000):
        play_fps, stride = clips.playback_rate(n_frames, 6.0)
        assert 4 <= play_fps <= 30
        lasts_s = n_frames / stride / play_fps
        assert lasts_s == pytest.approx(6, rel=0.2) or (n_frames < 24 and lasts_s < 6)
