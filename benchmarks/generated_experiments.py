"""Experiments drawn at random that `check` lets through, each to the end of its run: how many meet a fault.

    python benchmarks/generated_experiments.py [--first SEED] [--count N] [--minutes M] [--keep DIR]

Sheets of vines and of falling bodies with one to four trials, tables of positions with steady, accelerating, standing,
sticking and reversing motion, few points or many, with and without pressure; settings of all sorts. Every stage of
`vinetrack run` is called in this process. A fault is an exception that is no sentence for a person, or a trial, a fit
or a diagnosis whose reason says so. Seeds 21000 to 21499, 31000 to 31013, 31100 to
31130 and 31207 were looked at while faults were mended.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR, UserError
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.results import Results, read_json

SETTINGS = {"damping": {"resamples": 100}, "figures": {"formats": ["png"], "dpi": 50}}
"""Few resamplings and small figures: what they show is not looked at here."""


def write_experiment(folder: Path, seed: int) -> None:
    """Draw an experiment and write its sheet, settings and tables of positions.

    Parameters
    ----------
    folder : made.
    seed : of the draw.
    """
    draw = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    ball = draw.uniform() < 0.3
    rows = [_row(draw, folder, k, ball) for k in range(int(draw.integers(1, 5)))]
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [",".join(str(row.get(name, "")) for name in names) for row in rows]
    (folder / "trials.csv").write_text("\n".join([",".join(names), *cells, ""]), encoding="utf-8")
    (folder / "experiment.yaml").write_text(_settings(draw, ball), encoding="utf-8")


def _row(draw: np.random.Generator, folder: Path, number: int, ball: bool) -> dict[str, object]:
    """The cells of one trial; its table of positions is written."""
    length_m = float(draw.choice([0.05, 0.14, 0.3, 1.0]))
    row: dict[str, object] = {"trial": f"t{number}", "track": f"t{number}.csv"}
    row["diameter_mm"] = draw.choice([6, 12, 24, 40])
    if ball:
        row |= {"travel_ratio": 1, "payload_g": draw.choice([1, 20, 300])}
    else:
        row |= {"thickness_um": draw.choice([25, 100, 200]), "length_mm": 1e3 * length_m}
        row |= {"pressure_kPa": draw.choice([2, 15, 24, 60]), "yield_pressure_kPa": draw.choice([0, 3, 20])}
        row |= {"payload_g": draw.choice([0, 0, 20])}
    if draw.uniform() < 0.3:
        row["growth_angle_deg"] = draw.choice([-90, 0, 45, 90, 180])
    if draw.uniform() < 0.2 and not ball:
        row |= {"chamber_l": draw.choice([0.01, 2]), "inlet_mm": draw.choice([1, 6])}
    if draw.uniform() < 0.1 and not ball:
        row["bends"] = "10:20:15"
    if draw.uniform() < 0.15:
        row["steady"] = draw.choice(["0.01:0.05", "0:10", "5:6"])
    if draw.uniform() < 0.1 and number:
        row["use"] = "no"
    (folder / f"t{number}.csv").write_text(_track(draw, length_m, ball), encoding="utf-8")
    return row


def _track(draw: np.random.Generator, length_m: float, ball: bool) -> str:
    """A table of positions: a motion of some kind, its noise, and columns beside it."""
    n = int(draw.choice([5, 6, 8, 12, 30, 80]))
    step_s = float(draw.choice([1e-4, 1e-3, 1e-2, 0.1]))
    time_s = np.arange(n) * step_s
    since = np.clip(time_s - draw.uniform(0, 0.4) * time_s[-1], 0, None)
    share = since / max(since[-1], 1e-9)
    kinds = {
        "steady": share,
        "approach": share - 0.2 * (1 - np.exp(-share / 0.2)),
        "accelerating": share**2,
        "standing": 0 * share,
        "sticking": np.floor(4 * share) / 4,
        "back and forth": np.sin(3 * share),
        "reversing": -share,
        "jump": (share > 0.5).astype(float),
    }
    weights = np.array([3, 3, 3, 1, 1, 0.5, 0.5, 0.5])
    position_m = length_m * draw.uniform(0.2, 1.2) * kinds[str(draw.choice(list(kinds), p=weights / weights.sum()))]
    if ball and draw.uniform() < 0.5:
        position_m = 0.5 * 9.81 * since**2
    position_m = position_m + draw.normal(0, 1, n) * float(draw.choice([0, 1e-6, 1e-4, 1e-2]))
    columns = {"time_s": time_s, "position_m": position_m}
    if draw.uniform() < 0.2:
        columns["sigma_m"] = np.full(n, 1e-4)
    if draw.uniform() < 0.2 and not ball:
        columns["pressure_kPa"] = 24 - draw.choice([0, 10]) * share + draw.normal(0, 0.1, n)
    lines = [",".join(f"{column[i]:.7g}" for column in columns.values()) for i in range(n)]
    return "\n".join([",".join(columns), *lines, ""])


def _settings(draw: np.random.Generator, ball: bool) -> str:
    lines = []
    if ball:
        lines.append(f"model: [{draw.choice(['gravity', 'gravity, air_drag'])}]")
    elif draw.uniform() < 0.2:
        lines.append("tail_slack: free")
    if draw.uniform() < 0.2:
        lines.append("mass_loss: as_printed")
    if draw.uniform() < 0.1:
        lines.append("position_systematic_mm: 0")
    return "\n".join([*lines, ""])


def is_let_through(folder: Path) -> bool:
    """Whether `check` finds no error in an experiment.

    Parameters
    ----------
    folder : of the experiment.
    """
    return all(problem.severity != "error" for problem in check_experiment(folder))


def run_through(folder: Path, results: Path, figures: bool = True) -> list[str]:
    """Every stage of a run in this process; the faults of the program that it met.

    Parameters
    ----------
    folder : of the experiment.
    results : folder for its results.
    figures : whether figures are drawn and the report is written.
    """
    from vinetrack.pipeline.workflow import STAGES, Job

    read = read_experiment(folder)
    job = Job(read, results, run_settings(SETTINGS))
    for name in ("trials", "model", *(("report",) if figures else ())):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                STAGES[name].run(job)
        except UserError:
            return []
        except Exception:
            return [f"{name}: {traceback.format_exc()}"]
    rows = [read_json(Results(results).analysed(name))["row"] for name in read.names if name not in read.left_out]
    faults = [f"tracks: {row['trial']}: {row['reason']}" for row in rows if INTERNAL_ERROR in row["reason"]]
    refused = {path.stem: read_json(path)["refused"] for path in (Results(results).fit, Results(results).diagnosis)}
    return [*faults, *(f"{stage}: {reason}" for stage, reason in refused.items() if reason == INTERNAL_ERROR)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=31100)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long and say how many were run")
    parser.add_argument("--keep", type=Path, help="folder in which experiments with a fault are kept")
    chosen = parser.parse_args()
    drawn = run = faulty = 0
    begun = time.perf_counter()
    for seed in range(chosen.first, chosen.first + chosen.count):
        if time.perf_counter() - begun > 60 * chosen.minutes:
            break
        drawn += 1
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "drawn"
            write_experiment(folder, seed)
            if not is_let_through(folder):
                continue
            run += 1
            faults = run_through(folder, Path(scratch) / "results")
            faulty += bool(faults)
            for fault in faults:
                print(f"seed {seed}: {fault}", flush=True)
            if faults and chosen.keep:
                folder.rename(chosen.keep / f"drawn_{seed}")
    spent = time.perf_counter() - begun
    print(f"{drawn} drawn, {run} let through by check, {faulty} met a fault of the program; {spent:.0f} s")


if __name__ == "__main__":
    main()
