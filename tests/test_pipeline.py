"""Whole experiments of known truth, from sheet and tracks or films to the report, by Snakemake and stage by stage."""

import csv
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commanded import run, succeed
from lsoda_vine import grown_position, vine_trial

import vinetrack
from vinetrack.cli import main as commands
from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.campaigns import Filming, GroundTruth, film, grow, picture_target
from vinetrack.laboratory.render import Truth
from vinetrack.laboratory.scene import Camera, Target
from vinetrack.pipeline.workflow import STAGES

ROOT = Path(__file__).parents[1]
N = 0.4
B = {12: 2.0, 24: 6.0}
PRESSURES_KPA = (15.0, 20.0, 26.0, 33.0)
YIELD_KPA = 3.0
NOISE_M = 3e-5
HEADERS = {
    "trials.csv": "trial,vine,condition,status,reason,n_frames,mm_per_px,scale_rel_sigma,noise_m,steady_from_s,"
    "steady_to_s,steady_rule,x_ss_m_s,x_ss_sigma_m_s,x_ss_paper_m_s,cv,force_N,final_lead_velocity_m_s,efficiency,"
    "tube_width_mm,growth_mm",
    "tracks/d12_0.csv": "frame,time_s,edge_px,lead_position_m,lead_position_sigma_m,flag,tracked_edge_px,"
    "lead_position_systematic_m,pressure_Pa",
    "kinematics/d12_0.csv": "time_s,lead_position_m,lead_velocity_m_s,lead_velocity_sigma_m_s,tail_velocity_m_s,"
    "lead_acceleration_m_s2",
}
MODEL_HEADERS = {
    "comparison.csv": "model,condition,rms_position_m,rms_final_velocity_m_s,replicate_floor_m,ratio,worst_at_s,"
    "worst_at_m,expected_m,expected_low_m,expected_high_m\n",
    "model_check.csv": "vine,n_steady,n_trajectory,B_steady,B_trajectory,z\n",
    "audit.csv": "trial,condition,term,size,force_N,share_of_drive,shift_m,time_s,lead_position_m,y_over_L,"
    "slack_from_s,note\n",
}
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"


def through_snakemake(test: Callable[..., None]) -> Callable[..., None]:
    return pytest.mark.slow(pytest.mark.pipeline(test))


def steady_tail_speed(diameter_mm: float, pressure_kPa: float) -> float:
    force_N = (pressure_kPa - YIELD_KPA) * 1e3 * np.pi * (diameter_mm * 1e-3) ** 2 / 4
    return float((force_N / B[int(diameter_mm)]) ** (1 / N))


def write_track(path: Path, diameter_mm: float, pressure_kPa: float, seed: int, excel: bool = False) -> None:
    """Ten still frames, then growth up to 250 mm, at 1000 frames a second with white noise."""
    trial = vine_trial("", pressure_kPa, diameter_mm, length_m=0.3, growth_angle_rad=np.pi / 2)
    since_s = np.arange(-10, 250e3 / (1e3 * steady_tail_speed(diameter_mm, pressure_kPa) / 2)) * 1e-3
    noise_m = NOISE_M * np.random.default_rng(seed).standard_normal(since_s.size)
    position_m = 0.05 + grown_position(trial, since_s, B[int(diameter_mm)], N) + noise_m
    text = "time_s,position_m\n" + "".join(f"{i * 1e-3:.4f},{y:.7f}\n" for i, y in enumerate(position_m))
    if excel:
        text = text.replace(",", ";").replace(".", ",").replace("\n", "\r\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes((b"\xef\xbb\xbf" if excel else b"") + text.encode())


def write_campaign(folder: Path) -> None:
    """As Excel saves it in half of Europe: semicolons, decimal commas, BOM, CRLF. One broken trial, one left out."""
    rows = ["trial;track;diameter_mm;thickness_um;length_mm;pressure_kPa;yield_pressure_kPa;growth_angle_deg;use"]
    for diameter_mm in B:
        for i, pressure_kPa in enumerate(PRESSURES_KPA):
            name = f"d{diameter_mm}_{i}"
            write_track(folder / "tracks" / f"{name}.csv", diameter_mm, pressure_kPa, 10 * diameter_mm + i, i % 2 == 0)
            pressure = f"{pressure_kPa:.1f}".replace(".", ",")
            rows.append(f"{name};tracks/{name}.csv;{diameter_mm};{100 * diameter_mm // 12};300;{pressure};3,0;90;")
    (folder / "tracks" / "torn.csv").write_text("time_s,position_m\n0,0\n0.001,zero\n")
    rows.append("torn;tracks/torn.csv;12;100;300;20,0;3,0;90;")
    # Of these the stage of the diagnosis has enough to do; what the whole catalogue gives, `tests/diagnosis` asks.
    (folder / "experiment.yaml").write_text("candidates: [tail_friction, length_scale]\n")
    rows.append("aside;tracks/d12_0.csv;12;100;300;15,0;3,0;90;no")
    (folder / "trials.csv").write_bytes(b"\xef\xbb\xbf" + "\r\n".join([*rows, ""]).encode())


def snakemake(workdir: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Snakemake from a shell in which nothing is activated."""
    command = [str(Path(sys.executable).parent / "snakemake"), "--snakefile", str(ROOT / "Snakefile"), *arguments]
    environment = {**os.environ, "PATH": os.defpath}
    return subprocess.run(
        command, cwd=workdir, env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def read_rows(path: Path) -> dict[str, dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return {row["trial"]: row for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """The results folder of a run over an experiment whose path has blanks, and what Snakemake printed."""
    workdir = tmp_path_factory.mktemp("a folder")
    write_campaign(workdir / "my vines (1)")
    done = snakemake(workdir, "--cores", "2", "--config", "experiment=my vines (1)/")
    assert done.returncode == 0, done.stdout + done.stderr
    return workdir / "results" / "my vines (1)", done


@through_snakemake
def test_the_files_are_those_people_rely_on_and_nothing_is_left_to_do(campaign):
    results, done = campaign
    assert done.stdout.strip().splitlines()[-1] == f"Report: results/{results.name}/report.html"
    assert (results / "report.html").is_file()
    assert {name: (results / name).read_text().splitlines()[0] for name in HEADERS} == HEADERS

    figures = results / "figures"
    drawn = {path.stem for path in figures.glob("*.svg") if not path.stem.startswith(("trial_", "strip_"))}
    assert {"damping_law", "scaling", "model_comparison", "model_residuals"} <= drawn
    for name in (*drawn, "trial_d12_0", "trial_torn"):
        assert (figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "<svg" in (figures / f"{name}.svg").read_text(encoding="utf-8")

    provenance = json.loads((results / "provenance.json").read_text())
    sheet = results.parents[1] / "my vines (1)" / "trials.csv"
    assert provenance["vinetrack"] == vinetrack.__version__
    assert provenance["settings"]["damping"]["resamples"] == 2000
    assert provenance["inputs"]["trials.csv"] == hashlib.sha256(sheet.read_bytes()).hexdigest()
    assert set(provenance["inputs"]) >= {"tracks/d12_0.csv", "tracks/d24_3.csv", "tracks/torn.csv"}

    again = snakemake(results.parents[1], "--cores", "1", "--config", "experiment=my vines (1)")
    assert again.returncode == 0
    assert "Nothing to be done" in again.stderr
    assert again.stdout.strip().splitlines()[-1] == done.stdout.strip().splitlines()[-1]
    # Run from elsewhere, Snakemake knows nothing of the run before; results of another version are still told.
    shutil.rmtree(results.parents[1] / ".snakemake" / "metadata")
    version, track = results / "logs" / "version", results / "tracks" / "d12_0.csv"
    kept = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in (version, track)}
    for change, is_due in ((None, False), (track.unlink, True), (lambda: version.write_text("another"), True)):
        if change is not None:
            change()
        planned = snakemake(results.parents[1], "-n", "--config", "experiment=my vines (1)")
        assert ("Nothing to be done" not in planned.stdout + planned.stderr) == is_due
        for path, (content, time_ns) in kept.items():
            path.write_bytes(content)
            os.utime(path, ns=(time_ns, time_ns))


@through_snakemake
def test_speeds_and_the_damping_law_are_those_the_tracks_were_written_with(campaign):
    rows = read_rows(campaign[0] / "trials.csv")
    good = [f"d{diameter}_{i}" for diameter in B for i in range(len(PRESSURES_KPA))]
    assert list(rows) == [*good, "torn", "aside"]
    assert [rows[name]["status"] for name in rows] == ["ok"] * len(good) + ["failed", "left_out"]
    truth = [steady_tail_speed(diameter_mm, pressure_kPa) for diameter_mm in B for pressure_kPa in PRESSURES_KPA]
    assert [float(rows[name]["x_ss_m_s"]) for name in good] == pytest.approx(truth, rel=0.02)
    for method in ("log_log", "both_axes"):
        fit = json.loads((campaign[0] / "damping.json").read_text())[method]
        assert fit["refused"] is None
        assert fit["n"] == pytest.approx(N, abs=0.01)
        assert {law["diameter_mm"]: law["B"] for law in fit["vines"].values()} == pytest.approx(B, rel=0.02)
        assert fit["n_95"][0] < fit["n"] < fit["n_95"][1]


@through_snakemake
def test_snakemake_stops_with_a_sentence_where_there_is_no_experiment(tmp_path):
    write_track(tmp_path / "vines" / "a.csv", 12, 20, 1)
    done = snakemake(tmp_path, "--cores", "1", "--config", "experiment=vinse")
    assert done.returncode == 1
    assert "vines" in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert not (tmp_path / "results").exists()


def stages(experiment: Path, results: Path) -> dict[str, dict[str, str]]:
    """All stages by their own commands, in this process; the rows of trials.csv."""
    settings = '{"damping": {"resamples": 200}, "figures": {"dpi": 50}}'
    for stage in STAGES:
        succeed(stage, experiment, results, "--settings", settings)
    return read_rows(results / "trials.csv")


@pytest.mark.slow
def test_one_trial_gives_everything_but_a_law_says_why_and_gives_the_same_bytes_again(tmp_path):
    folder, first, second = (tmp_path / name for name in ("one", "first", "second"))
    write_track(folder / "a.csv", 12, 20, 7)
    (folder / "trials.csv").write_text(SHEET + "007,a.csv,12,100,300,20,3,90\n")
    rows = stages(folder, first)
    assert float(rows["007"]["x_ss_m_s"]) == pytest.approx(steady_tail_speed(12, 20), rel=0.02)
    law = json.loads((first / "damping.json").read_text())["both_axes"]
    assert law["n"] is None
    assert law["refused"] in (first / "report.html").read_text().replace("&#39;", "'")
    stages(folder, second)
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) > 12
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


@pytest.mark.slow
def test_stages_of_single_trials_do_those_they_are_told_and_refuse_others(tmp_path):
    folder, results = tmp_path / "v", tmp_path / "results"
    write_track(folder / "a.csv", 12, 20, 7)
    rows = [f"{name},a.csv,12,100,300,{kPa},3,0\n" for name, kPa in zip("abcd", (20, 20, 9999, 9999), strict=True)]
    (folder / "trials.csv").write_text(SHEET + "".join(rows))
    for stage, *options in (
        ("trials", "--trials", '["a", "c"]', "--settings", '{"figures": {"formats": ["png"]}}'),
        ("trials", "--trials", '["b", "d"]'),
        ("model",),
    ):
        succeed(stage, folder, results, *options)
    assert sorted(path.suffix for path in (results / "figures").glob("trial_[ad].*")) == [".png", ".png", ".svg"]
    assert {name: row["status"] for name, row in read_rows(results / "trials.csv").items()} == {
        "a": "ok", "b": "ok", "c": "failed", "d": "failed",
    }  # fmt: skip
    for given, said in (('["x"]', "'x' is not a trial"), ("x", "is not JSON"), ('"a"', "is not a JSON list")):
        refused = run("trials", folder, results, "--trials", given)
        assert refused.exit_code == 2
        assert said in " ".join(refused.output.split())


def test_where_all_trials_are_broken_the_report_still_lists_them_with_their_reasons(tmp_path):
    folder = tmp_path / "all broken"
    folder.mkdir()
    (folder / "a.csv").write_text("time_s,position_m\n1,1\n")
    rows = ("a,a.csv,12,100,300,20,3,0\n", "b,b.csv,12,100,300,20,3,0\n", "c,a.csv,12,100,300,9999,3,0\n")
    (folder / "trials.csv").write_text(SHEET + "".join(rows))
    results = tmp_path / "results"
    rows = stages(folder, results)
    assert {row["status"] for row in rows.values()} == {"failed"}
    assert "3 trials: 3 failed." in (results / "report.html").read_text()
    assert all(row["reason"] for row in rows.values())
    assert json.loads((results / "fit.json").read_text())["refused"].startswith("No trial can be fitted")
    assert {name: (results / name).read_text() for name in MODEL_HEADERS} == MODEL_HEADERS  # and no rows
    assert not list((results / "comparison").iterdir())
    lines, failed = commands._run_lines(results)
    assert failed
    assert lines[-1].startswith("error: 3 of 3 trials failed, a first")


# A workflow that is killed goes on with the same command.
@through_snakemake
def test_the_same_snakemake_command_goes_on_after_kill_9(tmp_path):
    write_campaign(tmp_path / "vines")
    results = tmp_path / "results" / "vines"
    command = [
        sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--workflow-profile",
        str(ROOT / "profiles" / "default"), "--cores", "1", "results/vines/trials.csv", "--config", "experiment=vines",
    ]  # fmt: skip
    where = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(ROOT)}}
    end = time.monotonic() + 60
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **where) as first:
        while not list((results / "tracks").glob("*.csv")) and time.monotonic() < end:
            time.sleep(0.05)
        first.kill()
    assert not (results / "trials.csv").exists()

    def again() -> int:
        return subprocess.run(command, capture_output=True, check=False, **where).returncode

    assert again() == 0
    analysed = {path: path.read_bytes() for path in (results / "analysed").glob("*.json")}
    # Earlier results stay where a job fails: here no file can be written in a folder that is a file.
    shutil.rmtree(results / "kinematics")
    (results / "kinematics").touch()
    (tmp_path / "vines" / "trials.csv").touch()
    assert again() == 1
    assert {path: path.read_bytes() for path in (results / "analysed").glob("*.json")} == analysed != {}


# From recordings: the truth is the motion that the virtual laboratory's camera filmed; the analysis sees files alone.
SHARED = "capture_fps: 1069\nexposure_us: 93.5\nyield_pressure_kPa: 3\ngrowth_angle_deg: 90\n"
FEW = "candidates: [tail_friction]\n"
"""Of recordings to report one candidate is enough; what the whole catalogue gives, `tests/diagnosis` asks."""
BOARD = (
    "calibration: {kind: charuco, image: calibration/board.png, squares: [14, 5], square_mm: 15, marker_mm: 11, "
    "dictionary: DICT_4X4_100}\n"
)
NATURE = GroundTruth(
    values={"eversion_damping.n": 0.37, "eversion_damping.B": {"12mm-100um-140mm": 1.83}},
    damping_scatter=0.0, pressure_scatter=0.0, release_frames=(14, 20), seed=411,
)  # fmt: skip
PLAIN = Camera(m_per_px=2.4e-4)
GOOD = {"p30": 30, "p36": 36, "p42": 42}


@dataclass(frozen=True)
class Filmed:
    """Results folder, the rows of its trials.csv, and what was filmed."""

    results: Path
    rows: dict[str, dict[str, str]]
    truth: dict[str, Truth]


def write_films(folder: Path, settings: str) -> None:
    header = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa\n"
    rows = [f"{name},videos/{name}.mp4,12,100,140,{kPa}\n" for name, kPa in GOOD.items()]
    (folder / "trials.csv").write_text("".join([header, *rows]))
    (folder / "experiment.yaml").write_text(SHARED + settings)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Trials grown and filmed into an experiment folder, and analysed."""
    workdir = tmp_path_factory.mktemp("filmed")
    folder, target = workdir / "vines", Target(squares=(14, 5), square_m=0.015, marker_m=0.011)
    filming = Filming(camera=Camera(m_per_px=2.4e-4, k1=-0.08, tilt_y_deg=0.8), target=target)
    (folder / "videos").mkdir(parents=True)
    write_films(folder, BOARD + FEW)
    picture_target(filming, folder / "calibration" / "board.png", seed=5)
    grown = grow(read_experiment(folder, strict=True).trials, NATURE)
    truth = {trial.stated.name: film(trial, filming, trial.stated.video, 40 + i) for i, trial in enumerate(grown)}
    few = ("damping={resamples: 200}", "figures={formats: [svg]}")
    done = snakemake(workdir, "--cores", "2", "--config", "experiment=vines", *few)
    assert done.returncode == 0, done.stdout + done.stderr
    results = workdir / "results" / "vines"
    return Filmed(results, read_rows(results / "trials.csv"), truth)


def errors_px(results: Path, name: str, truth: Truth) -> np.ndarray:
    """Tracked minus true position while the edge moves, the median taken off (origins are arbitrary), and stated, px.
    From half a pixel of growth on: before, a door may hide the tip, and the frame counts as lost.
    """
    track = pd.read_csv(results / "tracks" / f"{name}.csv")
    true_m = truth.lead_position_m[: len(track)]
    moving = (np.gradient(true_m) > 0.05 * PLAIN.m_per_px) & (true_m - true_m[0] > 0.5 * PLAIN.m_per_px)
    error_m = (track["lead_position_m"].to_numpy() - true_m)[moving]
    assert np.isfinite(error_m).all(), "a moving frame is lost"
    stated_m = np.hypot(track["lead_position_sigma_m"], track["lead_position_systematic_m"]).to_numpy()[moving]
    return np.column_stack([error_m - np.median(error_m), stated_m]) / PLAIN.m_per_px


@through_snakemake
@pytest.mark.parametrize("name", GOOD)
def test_a_good_recording_is_right_within_a_third_of_a_pixel(filmed, name):
    assert filmed.rows[name]["status"] in ("ok", "warning")
    found = errors_px(filmed.results, name, filmed.truth[name])
    # In the first moving frames the door still swings before the edge, and their stated errors say so.
    sure = found[:, 1] < 0.5
    assert sure.mean() > 0.8
    assert found[sure, 0].std() < 0.35
    assert (np.abs(found[:, 0]) < 6 * found[:, 1]).all()
    track = pd.read_csv(filmed.results / "tracks" / f"{name}.csv")
    stated_m = np.hypot(track["lead_position_sigma_m"], track["lead_position_systematic_m"]).to_numpy()
    sure = np.isfinite(track["lead_position_m"].to_numpy()) & (stated_m < 0.5 * PLAIN.m_per_px)
    assert sure.mean() > 0.5  # not where a door may hide the tip, which says so
    slope = np.polyfit(filmed.truth[name].lead_position_m[sure], track["lead_position_m"][sure], 1)[0]
    assert slope == pytest.approx(1, abs=1e-3)
    assert 0 < float(filmed.rows[name]["scale_rel_sigma"]) < 1e-3


@through_snakemake
def test_the_report_links_to_strips_and_shows_calibration_and_a_clip_of_every_condition(filmed):
    page = (filmed.results / "report.html").read_text(encoding="utf-8")
    for name in GOOD:
        assert f'href="figures/strip_{name}.' in page
        assert (filmed.results / "figures" / f"strip_{name}.svg").read_bytes().startswith(b"<?xml")
    axis = json.loads((filmed.results / "analysed" / f"{next(iter(GOOD))}.json").read_text())["axis"]
    assert np.hypot(*np.subtract(axis["to_px"], axis["from_px"])) > 100
    assert "ChArUco board" in page
    tracked = {name: row["condition"] for name, row in filmed.rows.items() if row["status"] in ("ok", "warning")}
    clips = [path.stem for path in (filmed.results / "overlays").glob("*.mp4")]
    assert sorted(tracked[name] for name in clips) == sorted(set(tracked.values()))
    assert page.count('src="data:video/mp4;base64,') == 1
    assert all(f'href="overlays/{name}.mp4"' in page for name in clips)


@through_snakemake
def test_a_sheet_that_contradicts_its_films_comes_before_the_verdict(filmed, tmp_path):
    """A tube that is 12 mm wide in the pictures, and 14 mm in the sheet of another folder."""
    films, folder, results = filmed.results.parents[1] / "vines", tmp_path / "wide", tmp_path / "out" / "wide"
    folder.mkdir()
    for name in ("videos", "calibration"):
        (folder / name).symlink_to(films / name)
    write_films(folder, BOARD + FEW)
    (folder / "trials.csv").write_text((folder / "trials.csv").read_text().replace(",12,", ",14,"))
    shutil.copytree(filmed.results / ".kept", results / ".kept")
    lines = succeed("run", folder, "--results", tmp_path / "out").splitlines()
    diagnosis = json.loads((results / "diagnosis.json").read_text())
    assert diagnosis["contradicted_columns"] == ["diameter_mm"]
    assert diagnosis["next_experiment"] is None
    assert "diameter_mm" in lines[-1]
    assert run("propose", results).exit_code == 1
