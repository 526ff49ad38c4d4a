"""Speed of a fit to trajectories, and whether its time grows in step with the number of trials.

    python benchmarks/fit_speed.py [--repeats 3]

Campaigns of the published protocol without payload: four vines, ten pressures, as many trials a pressure as it takes;
B scatters by 3 %, P by 1 %, 0.1 mm of noise. Free are B of every vine, n, every yield pressure, and the adiabatic
exponent of the chamber. The model is compiled before the clock starts.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

import vinetrack as vt
from vinetrack.core.published import CHAMBER_L
from vinetrack.core.records import Track, Trial
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow, paper_damping

SIZES = (12, 24, 48, 100, 200)
EFFECT = "reservoir_depletion"


def measured(count: int, seed: int) -> list[tuple[Trial, Track]]:
    """`count` trials of the protocol, spread over vines and pressures."""
    trials = [replace(trial, chamber_m3=CHAMBER_L / 1e3) for trial in paper_damping(replicates=5)]
    take = np.linspace(0, len(trials) - 1, count).astype(int)
    nature = GroundTruth(
        effects=(*BASE, EFFECT),
        values={**damping_values(trials), f"{EFFECT}.gamma": 1.2},
        yield_error_kPa=0.2,
        seed=seed,
    )
    return [(one.stated, one.track) for one in grow([trials[k] for k in take], nature)]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    model = vt.base_model() + getattr(vt.effects, EFFECT)
    vt.fit(model, measured(SIZES[0], 0))
    heads = ("trials", "positions", "numbers", "wall, s", "processor, s", "ms a trial", "refit, s")
    print(" ".join(f"{head:>12}" for head in heads))
    for count in SIZES:
        walls, works, refits = [], [], []
        for repeat in range(given.repeats):
            pairs = measured(count, 100 + repeat)
            begun, work = time.perf_counter(), time.process_time()
            fit = vt.fit(model, pairs)
            walls.append(time.perf_counter() - begun)
            works.append(time.process_time() - work)
            begun = time.process_time()
            vt.refit(fit)
            refits.append(time.process_time() - begun)
        points = sum(trial.time_s.size for trial in fit.trials)
        work = float(np.median(works))
        cells = (count, points, len(fit.numbers), *(f"{x:.2f}" for x in (np.median(walls), work)))
        print(" ".join(f"{cell:>12}" for cell in (*cells, f"{1e3 * work / count:.1f}", f"{np.median(refits):.2f}")))


if __name__ == "__main__":
    main()
