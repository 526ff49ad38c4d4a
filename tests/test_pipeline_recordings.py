"""A filmed experiment from recordings to the report, whose tracks are right.

The truth is the motion that the virtual laboratory's camera filmed; the analysis sees files alone.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commanded import run, succeed
from test_pipeline import read_rows, snakemake

from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.campaigns import Filming, GroundTruth, film, grow, picture_target
from vinetrack.laboratory.render import Truth
from vinetrack.laboratory.scene import Camera, Target

pytestmark = [pytest.mark.slow, pytest.mark.pipeline]

HEADER = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa"
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
TARGET = Target(squares=(14, 5), square_m=0.015, marker_m=0.011)
WARPED = Camera(m_per_px=2.4e-4, k1=-0.08, tilt_y_deg=0.8)
PLAIN = Camera(m_per_px=2.4e-4)
GOOD = {"p30": 30, "p36": 36, "p42": 42}


@dataclass(frozen=True)
class Filmed:
    """Results folder, the rows of its trials.csv, and what was filmed."""

    results: Path
    rows: dict[str, dict[str, str]]
    truth: dict[str, Truth]


def write_sheet(folder: Path, pressures_kPa: dict[str, int], settings: str) -> None:
    rows = [f"{name},videos/{name}.mp4,12,100,140,{kPa}" for name, kPa in pressures_kPa.items()]
    (folder / "trials.csv").write_text("\n".join([HEADER, *rows, ""]))
    (folder / "experiment.yaml").write_text(SHARED + settings)


def film_all(folder: Path, pressures_kPa: dict[str, int], camera: Camera) -> dict[str, Truth]:
    """Grow and film trials of these pressures into an experiment folder; the truth of each."""
    (folder / "videos").mkdir(parents=True)
    write_sheet(folder, pressures_kPa, BOARD)
    filming = Filming(camera=camera, target=TARGET)
    picture_target(filming, folder / "calibration" / "board.png", seed=5)
    grown = grow(read_experiment(folder, strict=True).trials, NATURE)
    return {trial.stated.name: film(trial, filming, trial.stated.video, 40 + i) for i, trial in enumerate(grown)}


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("filmed")
    truth = film_all(workdir / "vines", GOOD, WARPED)
    write_sheet(workdir / "vines", GOOD, BOARD + FEW)
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


def spread_px(found: np.ndarray) -> float:
    """Standard deviation of errors that are stated to be below half a pixel, as most must be.

    In the first moving frames the door still swings before the edge, and their stated errors say so.
    """
    sure = found[:, 1] < 0.5
    assert sure.mean() > 0.8
    return float(found[sure, 0].std())


@pytest.mark.parametrize("name", GOOD)
def test_a_good_recording_is_right_within_a_third_of_a_pixel(filmed, name):
    assert filmed.rows[name]["status"] in ("ok", "warning")
    found = errors_px(filmed.results, name, filmed.truth[name])
    assert spread_px(found) < 0.35
    assert (np.abs(found[:, 0]) < 6 * found[:, 1]).all()
    track = pd.read_csv(filmed.results / "tracks" / f"{name}.csv")
    stated_m = np.hypot(track["lead_position_sigma_m"], track["lead_position_systematic_m"]).to_numpy()
    sure = np.isfinite(track["lead_position_m"].to_numpy()) & (stated_m < 0.5 * PLAIN.m_per_px)
    assert sure.mean() > 0.5  # not where a door may hide the tip, which says so
    slope = np.polyfit(filmed.truth[name].lead_position_m[sure], track["lead_position_m"][sure], 1)[0]
    assert slope == pytest.approx(1, abs=1e-3)
    assert 0 < float(filmed.rows[name]["scale_rel_sigma"]) < 1e-3


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


def test_a_sheet_that_contradicts_its_films_comes_before_the_verdict(filmed, tmp_path):
    """A tube that is 12 mm wide in the pictures, and 14 mm in the sheet of another folder."""
    films, folder, results = filmed.results.parents[1] / "vines", tmp_path / "wide", tmp_path / "out" / "wide"
    folder.mkdir()
    for name in ("videos", "calibration"):
        (folder / name).symlink_to(films / name)
    write_sheet(folder, GOOD, BOARD + FEW)
    (folder / "trials.csv").write_text((folder / "trials.csv").read_text().replace(",12,", ",14,"))
    shutil.copytree(filmed.results / ".kept", results / ".kept")
    lines = succeed("run", folder, "--results", tmp_path / "out").splitlines()
    diagnosis = json.loads((results / "diagnosis.json").read_text())
    assert diagnosis["contradicted_columns"] == ["diameter_mm"]
    assert diagnosis["next_experiment"] is None
    assert "diameter_mm" in lines[-1]
    assert run("propose", results).exit_code == 1
