"""Recordings of a real everting tube that sticks and slips: where Eq. (2) fails on them, and what mends how much.

    VINETRACK_REAL_DATA=FOLDER python benchmarks/everting_tube.py [--recordings FOLDER ...] [--keep FOLDER]
                                                                  [--picture FILE.png] [--no-diagnosis]
                                                                  [--models NAME ...]

The recordings (blake5634/evtMod on GitHub, `dataAndyMay24`; no licence, so nothing of them is kept here) are six
trials, two each of three tubes of low-density polyethylene, 2 mil, about an inch wide, that grew to 0.56 m off a reel
with a brake, one tube with little friction and two with much. They give length by the reel's encoder, gauge pressure
and flow some fifty times a second. Their authors fit a pressure to start (113.1 kPa absolute), a lower one to stop
(108.0 kPa), drag that rises with the length, and the supply.

Printed are: what can be read off the recordings without any equation of motion; the errors of named models, each fitted
to every tube by itself, on these trials and on each trial predicted from the other of its tube; their numbers in SI;
thresholds beside the authors'; and what `diagnose` says of all trials, and of the tube that sticks alone.
Absolute pressures take the air at 101.325 kPa: the recordings do not say what it was. No constant of the package was
tuned on these recordings; the starts of the fits (`tube.models`) were chosen looking at them.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from tube.folder import write_folder
from tube.models import Outcome, fit_tubes, models, threshold_kPa
from tube.picture import draw
from tube.recordings import Recording, balance, read_recordings, thresholds

import vinetrack as vt
from vinetrack.experiment.folder import Experiment

AMBIENT_KPA = 101.325
AUTHORS_START_KPA, AUTHORS_STOP_KPA = 113.1, 108.0
LEAST_EVENTS = 4
"""Starts and stops of a recording above which it counts as sticking."""


def events_table(recordings: Sequence[Recording]) -> pd.DataFrame:
    """Every start and stop."""
    return pd.DataFrame(
        [
            {
                "trial": one.name,
                "friction": one.friction,
                "event": event.kind,
                "time_s": round(event.time_s, 2),
                "grown_mm": round(event.lead_position_m * 1e3),
                "gauge_kPa": round(event.pressure_Pa / 1e3, 2),
                "absolute_kPa": round(event.pressure_Pa / 1e3 + AMBIENT_KPA, 1),
            }
            for one in recordings
            for event in one.events
        ]
    )


def balance_table(recordings: Sequence[Recording]) -> pd.DataFrame:
    """What the pressure goes into while the tubes grow."""
    return pd.DataFrame([{"trial": one.name, **balance(one)} for one in recordings]).round(3)


def errors_table(outcomes: Sequence[Outcome]) -> pd.DataFrame:
    """A row a model."""
    first = outcomes[0]
    rows = [
        {
            "model": one.name,
            "rms_in_sample_mm": one.rms_m * 1e3,
            "falls_by": first.rms_m / one.rms_m,
            "rms_left_out_mm": one.left_out_m * 1e3,
            **{f"left_out_tube_{tube}": error_m * 1e3 for tube, error_m in one.left_out_by_tube.items()},
            **{trial.name: one.rms_of(trial.name) * 1e3 for trial in one.trials},
        }
        for one in outcomes
    ]
    return pd.DataFrame(rows).round(2)


def threshold_table(outcome: Outcome, experiment: Experiment) -> pd.DataFrame:
    """Thresholds of a model at the beginning and the end of growth, absolute, beside the authors'."""
    lengths = {trial.name: trial.length_m for trial in experiment.trials}
    rows = []
    for tube, fit in outcome.fits.items():
        length_m = lengths[fit.trials[0].name]
        for kind, authors in (("start", AUTHORS_START_KPA), ("stop", AUTHORS_STOP_KPA)):
            at = (round(threshold_kPa(fit, kind, part * length_m) + AMBIENT_KPA, 1) for part in (0.0, 1.0))
            rows.append((tube, kind, *at, authors))
    return pd.DataFrame(rows, columns=["tube", "threshold", "at_0_m_kPa", "at_full_length_kPa", "authors_kPa"])


def numbers_lines(outcome: Outcome) -> list[str]:
    """The fitted numbers with their errors, a line a tube."""
    lines = []
    for tube, fit in outcome.fits.items():
        said = [
            f"{one.symbol} {one.value:.4g}{f' ± {one.sigma:.2g}' if math.isfinite(one.sigma) else ' (not felt)'}"
            for one in fit.numbers
        ]
        lines.append(f"    tube {tube}: {', '.join(said)}")
    return lines


def show(title: str, text: object) -> None:
    """A part of the report."""
    print(f"\n== {title}\n{text}", flush=True)


def readings(recordings: Sequence[Recording]) -> None:
    """What needs no equation of motion."""
    show("starts and stops read off the recordings", events_table(recordings).to_string(index=False))
    show("pressure while growing, as a sum of forces read off", balance_table(recordings).to_string(index=False))
    for one in recordings:
        for kind in ("start", "stop"):
            line = thresholds(one, kind)
            if line:
                print(f"{one.name}: {kind}s at {line[0]:.1f} kPa, and {line[1]:+.1f} kPa for every metre grown")


def diagnose(what: str, experiment: Experiment) -> None:
    """What the package says is missing from Eq. (2)."""
    began = time.process_time()
    said = vt.diagnose(experiment)
    show(f"diagnose, {what}, {time.process_time() - began:.0f} s of processor time", said)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, nargs="+", help="folders of the CSV files")
    parser.add_argument("--models", nargs="+", choices=list(models()), default=list(models()), metavar="NAME")
    parser.add_argument("--keep", type=Path, help="where the experiment folder is written and stays")
    parser.add_argument("--picture", type=Path, help="PNG of measured and modelled length")
    parser.add_argument("--no-diagnosis", action="store_true")
    given = parser.parse_args()
    real = Path(os.environ.get("VINETRACK_REAL_DATA", ""))
    folders = given.recordings or [real / "everting_tube", real / "everting_tube_repeats"]
    try:
        recordings = [one for folder in folders for one in read_recordings(folder)]
    except FileNotFoundError as error:
        raise SystemExit(f"{error}: set VINETRACK_REAL_DATA, or give --recordings.") from error
    readings(recordings)
    with tempfile.TemporaryDirectory() as scratch:
        experiment = vt.read_experiment(write_folder(recordings, given.keep or Path(scratch) / "tube"))
        outcomes = []
        for name, model in ((name, models()[name]) for name in given.models):
            began = time.process_time()
            outcomes.append(fit_tubes(name, model, experiment, recordings))
            print(f"{name}: fitted in {time.process_time() - began:.0f} s of processor time", flush=True)
        show("errors of position", errors_table(outcomes).to_string(index=False))
        for one in outcomes:
            show(one.name, "\n".join(numbers_lines(one)))
        best = min(outcomes, key=lambda one: one.rms_m)
        show(f"thresholds of {best.name}", threshold_table(best, experiment).to_string(index=False))
        if given.picture:
            draw(recordings, outcomes[0], best).savefig(given.picture, dpi=110, facecolor="white")
        if not given.no_diagnosis:
            diagnose("all trials", experiment)
            sticks = [one for one in recordings if len(one.events) > LEAST_EVENTS]
            diagnose("those that stick", vt.read_experiment(write_folder(sticks, Path(scratch) / "sticks")))


if __name__ == "__main__":
    main()
