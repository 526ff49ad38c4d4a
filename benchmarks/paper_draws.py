"""How much of the paper's Table II is chance: errors of position that nothing but scatter of B and P causes.

    python benchmarks/paper_draws.py [--draws 400] [--seed 20700]

Four trials at 7, 14 and 28 kPa (24 mm × 200 µm × 280 mm, 35.6 g) are grown by Eq. (2) with the printed B and n; B
scatters by 3 % and P by 1 %, as in `data/paper`. Their mean since release is held against Eq. (2) with the printed
numbers until either has grown to 95 %. Printed are the 5, 50 and 95 % quantiles of the root mean square over draws,
and what a yield pressure of 3.2 kPa with pressures of whole psi would cause.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.paper import motions
from vinetrack.paper.motions import END_FRACTION, LASTS_S, Departure, follow, position_rms_m, position_trials

TRIALS, B_SCATTER, PRESSURE_SCATTER = 4, 0.03, 0.01
PSI_PA, OTHER_YIELD_PA = 6894.76, 3200.0


def mean_error_m(trial: Trial, draw: np.random.Generator) -> float:
    """Root mean square of the mean of four trials about Eq. (2), m."""
    plain = follow(trial, Departure(), motions.TABLE_I[4].B)
    grown: list[Floats] = []
    for _ in range(TRIALS):
        B = motions.TABLE_I[4].B * math.exp(B_SCATTER * draw.standard_normal())
        scattered = replace(trial, pressure_Pa=trial.pressure_Pa * (1 + PRESSURE_SCATTER * draw.standard_normal()))
        grown.append(follow(scattered, Departure(), B).lead_position_m)
    stop = min(int(np.searchsorted(one, END_FRACTION * trial.length_m)) for one in (plain.lead_position_m, *grown))
    off_m = np.mean([one[:stop] for one in grown], axis=0) - plain.lead_position_m[:stop]
    return float(np.sqrt(np.mean(off_m**2)))


def otherwise_m(trial: Trial) -> float:
    """Root mean square between Eq. (2) as printed and with P_y 3.2 kPa at whole psi, m."""
    rounded_Pa = PSI_PA * round(trial.pressure_Pa / PSI_PA)
    other = replace(trial, pressure_Pa=rounded_Pa, yield_pressure_Pa=OTHER_YIELD_PA)
    plain, moved = (follow(one, Departure(), motions.TABLE_I[4].B) for one in (trial, other))
    return position_rms_m(plain, moved, trial)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=20700)
    given = parser.parse_args()
    print(f"{given.draws} draws of {TRIALS} trials, {LASTS_S:g} s at most, seed {given.seed}; cm")
    for trial in position_trials():
        draw = np.random.default_rng([given.seed, round(trial.pressure_Pa)])
        errors_cm = [100 * mean_error_m(trial, draw) for _ in range(given.draws)]
        low, middle, high = np.quantile(errors_cm, (0.05, 0.5, 0.95))
        print(
            f"{trial.pressure_Pa / 1e3:g} kPa: {low:.2f}, {middle:.2f}, {high:.2f};"
            f" P_y 3.2 kPa and whole psi {100 * otherwise_m(trial):.2f}"
        )


if __name__ == "__main__":
    main()
