"""Results folders for the explorer's tests: simulated tracks of the demonstration's vines, with a small chamber.
The truth is that of the demonstration: two vines, n 0.37, B 1.83 and 6.44, reservoir depletion (γ 1.4) that is
missing from the model in use. Seed 20 everywhere; nothing here scores a method.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
from commanded import fit_law
from commanded import succeed as run
from hand_diagnosis import diagnosis, next_experiment
from plain_scene import write_video

from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.laboratory.__main__ import DEMO
from vinetrack.laboratory.__main__ import main as grow
from vinetrack.pipeline.analysis import fit_model
from vinetrack.pipeline.workflow import Job
from vinetrack.results import Results

DEMO_SHEET = Path(__file__).parents[2] / "data" / "demo" / "trials.csv"
SETTINGS = "# what all trials share\ncapture_fps: 1069\nyield_pressure_kPa: 3   # from a slow ramp\nchamber_l: 2\n"
FEW_CANDIDATES = (
    "candidates: [reservoir_depletion, supply_refill, tail_friction, air_drag, length_scale, inlet_loss, trace_clock]\n"
)
"""For tests that use a diagnosis; the last two cannot be tested with these trials. `tests/diagnosis` tests verdicts
with the whole catalogue."""

ROUGH_FIGURES = '{"figures": {"formats": ["png"], "dpi": 50}}'
"""Settings of stages where nobody looks at the figures of single trials: they take half of the time."""
SMALL = ("d24_24kPa_1", "d24_24kPa_2", "d24_36kPa_1", "d24_36kPa_2", "d24_20g_48kPa_1", "d24_20g_48kPa_2")


def make_experiment(folder: Path, names: tuple[str, ...] = (), settings: str = SETTINGS, nature: Path = DEMO) -> Path:
    """The demonstration's trials, or those named, measured instead of filmed."""
    folder.mkdir(parents=True)
    with DEMO_SHEET.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if not names or row["trial"] in names]
    columns = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "payload_g")
    lines = [",".join(("trial", "track", *columns))]
    lines += [",".join([row["trial"], f"tracks/{row['trial']}.csv", *(row[c] for c in columns)]) for row in rows]
    (folder / "trials.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "experiment.yaml").write_text(settings, encoding="utf-8")
    grow([str(folder), "--nature", str(nature)])
    return folder


def make_results(experiment: Path, results: Path) -> Path:
    """The results of the workflow, as far as the explorer reads them."""
    run("trials", experiment, results, "--settings", ROUGH_FIGURES)
    fit_law(experiment, results, damping={"resamples": 100})
    fit_model(Job(read_experiment(experiment), results, run_settings({})))
    made = {"experiment": experiment.absolute().as_posix(), "settings": {"damping": {"resamples": 100}}}
    Results(results).provenance.write_text(json.dumps(made))
    return results


def write_diagnosis(results: Path) -> Path:
    """Write a `diagnosis.json` with a tie and a next trial."""
    advice = next_experiment() | {"text": "Grow the 24 mm vine at 60 kPa from a chamber of 4 L."}
    advice["trials"][0] |= {"chamber_l": 4.0, "changed": ["chamber_l"], "new_vine": False}
    path = results / "diagnosis.json"
    path.write_text(json.dumps(diagnosis("ambiguous", next_experiment=advice)), encoding="utf-8")
    return path


def film_of(experiment: Path, results: Path, trial: str) -> Path:
    """Give one trial of a results folder a recording: a bright bar whose end follows the track, 4 px/mm, row 48."""
    track = pd.read_csv(results / "tracks" / f"{trial}.csv", keep_default_na=False, na_values=["", "NaN"])
    position_m = track["lead_position_m"].interpolate(limit_direction="both").to_numpy()
    edge_px = 20 + 4e3 * (position_m - position_m[0])
    path = experiment / "videos" / f"{trial}.mp4"
    write_bars(path, 20 + edge_px)
    track.assign(edge_px=edge_px, flag="").to_csv(results / "tracks" / f"{trial}.csv", index=False)
    analysed = results / "analysed" / f"{trial}.json"
    axis = {"axis": {"from_px": [20, 48], "to_px": [940, 48], "width_px": 30}}
    analysed.write_text(json.dumps(json.loads(analysed.read_text()) | axis))
    sheet = pd.read_csv(experiment / "trials.csv")
    filmed = sheet["trial"] == trial
    sheet = sheet.assign(video=np.where(filmed, f"videos/{trial}.mp4", ""), track=sheet["track"].mask(filmed))
    sheet.to_csv(experiment / "trials.csv", index=False)
    return path


def write_bars(path: Path, ends_px: np.ndarray, width: int = 960, height: int = 96) -> Path:
    """Write a clip with a bright bar on dark grey in every frame, from the left to the given end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = np.full((len(ends_px), height, width), 40, np.uint8)
    for frame, end_px in zip(frames, ends_px, strict=True):
        frame[30:66, : max(round(float(end_px)), 0)] = 200
    return write_video(path, frames, options={"crf": "12"}, playback_fps=30)
