"""Whether a prediction from a fit holds: how often the 90 % band of a final speed has the trial that is then made.

    python benchmarks/prediction_coverage.py [--campaigns 80] [--first-seed 3100]

Campaigns of 24 trials, two vines at four pressures, three trials each, are grown in the virtual laboratory (B scatters
by 3 %, P by 1 %, noise 0.1 mm, yield pressures misread by 0.2 kPa), fitted, and kept as `fit.json` would keep them.
Then three trials are predicted that the fit has not seen, each with a pressure and a B of its own:

same       a vine of the fit at a pressure between those filmed
beyond     the same at twice the highest pressure that was filmed
longer     a vine of the same diameter and wall, 1.5 times as long, with a payload

Seeds 0–9 were used while this was built; seeds 3000–3079 showed that the error of the spreads counts; seeds from
3100 score.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pandas as pd
from rich.progress import track

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory.campaigns import GroundTruth, campaign, damping_values, grow, isometric_vine
from vinetrack.planning.prediction import drawn_final_speeds
from vinetrack.planning.predictive_inputs import FitNumbers, predictive_inputs

DAMPING_SCATTER, PRESSURE_SCATTER = 0.03, 0.01
SAMPLES = 400


def sheet() -> list[Trial]:
    """Two vines, four pressures each, three trials a pressure."""
    trials = campaign(isometric_vine(4), (14, 18, 23, 28), 3, prefix="a")
    return list(with_names(trials + campaign(isometric_vine(3), (14, 20, 28, 40), 3, prefix="b")))


def unseen() -> dict[str, Trial]:
    """The trials that are predicted."""
    big = isometric_vine(4)
    found = {"same": big.trial("same", 20.5), "beyond": big.trial("beyond", 56.0)}
    found["longer"] = replace(big, length_mm=420.0).trial("longer", 25.0, payload_g=35.6)
    return dict(zip(found, with_names(list(found.values())), strict=True))


def made(trial: Trial, nature: GroundTruth, yield_Pa: float, draw: np.random.Generator) -> float:
    """Final speed of such a trial when it is made: the edge's at 0.95, a payload's as it leaves."""
    model = nature.model()
    values = dict(zip(model.parameter_names, model.parameters_for(sheet()[0].vine).tolist(), strict=True))
    values["eversion_damping.B"] *= 1 + DAMPING_SCATTER * draw.standard_normal()
    pressure_Pa = trial.pressure_Pa * (1 + PRESSURE_SCATTER * draw.standard_normal())
    true = replace(trial, pressure_Pa=pressure_Pa, yield_pressure_Pa=yield_Pa)
    moved = simulate(model.with_values(values), true, np.linspace(0.0, 1.0, 8000) ** 2 * 20.0)
    if trial.payload_kg > 0:
        return 2 * moved.end_lead_velocity_m_s
    return float(np.interp(0.95 * trial.length_m, moved.lead_position_m, moved.lead_velocity_m_s))


def measure(seed: int) -> list[dict[str, object]]:
    """One campaign fitted, and what was predicted beside what was made."""
    nature = GroundTruth(
        values=damping_values(sheet()),
        damping_scatter=DAMPING_SCATTER,
        pressure_scatter=PRESSURE_SCATTER,
        yield_error_kPa=0.2,
        seed=seed,
    )
    grown = grow(sheet(), nature)
    numbers = FitNumbers(vt.fit(vt.base_model(), [(one.stated, one.track) for one in grown]))
    rows = []
    for k, (name, trial) in enumerate(unseen().items()):
        inputs = predictive_inputs(
            replace(trial, yield_pressure_Pa=np.nan, yield_pressure_sigma_Pa=np.nan), None, numbers
        )
        speeds = drawn_final_speeds(inputs, 0.95, SAMPLES, seed)
        low, median, high = np.quantile(speeds, (0.05, 0.5, 0.95))
        truth = made(trial, nature, grown[0].true.yield_pressure_Pa, np.random.default_rng([seed, 5, k]))
        rows.append(
            {
                "seed": seed,
                "trial": name,
                "held": bool(low <= truth <= high),
                "error": truth / median - 1,
                "half_width": (high - low) / 2 / median,
            }
        )
    return rows


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=80)
    parser.add_argument("--first-seed", type=int, default=3100)
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.campaigns)
    table = pd.DataFrame([row for seed in track(seeds) for row in measure(seed)])
    print(f"\n{given.campaigns} campaigns of 24 trials, seeds {seeds[0]}–{seeds[-1]}; final speeds, relative\n")
    lines = []
    for name, part in table.groupby("trial", sort=False):
        held = float(part["held"].mean())
        lines.append(
            {
                "predicted": name,
                "in the 90 % band": f"{100 * held:.0f} ± {100 * np.sqrt(held * (1 - held) / len(part)):.0f} %",
                "half of the band": f"{100 * part['half_width'].mean():.1f} %",
                "made − median": f"{100 * part['error'].mean():+.1f} ± {100 * part['error'].std():.1f} %",
            }
        )
    print(pd.DataFrame(lines).to_string(index=False))


if __name__ == "__main__":
    main()
