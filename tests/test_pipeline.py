"""A whole experiment of analytic truth, from sheet and tracks to the report, by Snakemake and stage by stage."""

import csv
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commanded import run, succeed
from lsoda_vine import grown_position, vine_trial

import vinetrack
from vinetrack.cli import main as commands
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
