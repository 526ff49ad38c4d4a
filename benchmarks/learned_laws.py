"""Whether a force that is in no list is learned: over what, how well, and what its law predicts.

    python benchmarks/learned_laws.py [--first-seed 20520] [--campaigns 10] [--propose] [--rows rows.csv]

Campaigns of `benchmarks/hidden`, which share no code with the package, with one of three forces in turn, by the seed:
`slip` (a friction that grows with the travel and levels off with the speed; growth and speed), `chirp` (waves along the
growth that become shorter; growth) and `squeeze` (with the square of the pressure, beyond a place; growth and
pressure). Seeds 20520–20529 tune, 32000–32009 score: nothing may be tuned on those.

Printed for each: the variables named, with their posterior weight, and those not excluded beside them; the part of
visited points, each variable within the middle 90 % of what was visited, where the learned force is within 10 % of the
range of the truth; the same but for a constant, which P_y takes over within its error; the same but for whatever
changes of the B of every vine, of n and of every P_y do along these motions, which positions cannot tell from a force;
and the part of points where the truth lies within the stated 95 % band. With `--propose` (several times as long) the
left-out error of the law that is proposed, in parts of what the true model gets; and with the learned force as a table,
where one is proposed: that has seen the conditions that are left out.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from hidden.campaigns import Hidden, make
from hidden.motion import Physics, Tube, tail_force
from hidden.questions import true_fit
from numpy.typing import NDArray

import vinetrack as vt
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import FittedMotion
from vinetrack.diagnosis.ladder import candidates_of, initial_fit, left_out_error
from vinetrack.diagnosis.missing_force import LearnedForce, missing_force
from vinetrack.diagnosis.propose import propose

LAWS = {"slip": "growth+speed", "chirp": "growth", "squeeze": "growth+pressure"}
FIRST_TUNING_SEED = 20520
MIDDLE, WITHIN = (0.05, 0.95), 0.1
SCORES = ("within", "within_shape", "within_beside", "covered")
REACH = 0.8
EVERY = 8
BAND = 1.96
STANDS_M_S = 1e-6
OUTSIDE = ("slip_F", "slip_x", "slip_speed", "chirp_F", "chirp_length", "chirp_phase")
OUTSIDE += ("squeeze_F", "squeeze_Pa", "squeeze_y", "squeeze_width")


def true_force(campaign: Hidden) -> Callable[[Floats, Floats, Floats, Floats], Floats]:
    """The hidden force alone, N, of time, growth, tail speed and pressure: the generator's own."""
    physics = campaign.truth.physics
    alone = Physics(B=0.0, n=1.0, **{name: getattr(physics, name) for name in OUTSIDE})
    tube = Tube(1.0, 0.0, 1e-2, 1e-4, 1.0, 0.0, 0.0)
    bends = np.empty((0, 3))
    return np.vectorize(lambda t, y, w, P: tail_force(t, y, w, P, 0.0, tube, alone, bends))


def gauge(campaign: Hidden, motion: FittedMotion, chosen: NDArray[np.int_]) -> Floats:
    """What changes of every B, of n and of every P_y do as forces along a motion, N, shape (n_points, 2 vines + 1)."""
    vines, n = list(campaign.truth.B), campaign.truth.n
    k, B = vines.index(motion.trial.vine), campaign.truth.B[motion.trial.vine]
    speed = np.maximum(motion.tail_velocity_m_s[chosen], STANDS_M_S)
    columns = np.zeros((chosen.size, 2 * len(vines) + 1))
    columns[:, k], columns[:, len(vines) + k] = speed**n, 1.0
    columns[:, -1] = B * speed**n * np.log(speed)
    return columns


def errors(campaign: Hidden, learned: LearnedForce) -> dict[str, float]:
    """Parts of the visited points where the learned force is within 10 % of the range of the truth, or in its band."""
    force_of = true_force(campaign)
    true, alone, sigma, values, shifts = [], [], [], [], []
    for motion in learned.motions:
        counts = (motion.lead_position_m > 0) & motion.is_visited
        chosen = np.flatnonzero(counts)[::EVERY]
        courses = (motion.time_s, motion.lead_position_m, motion.tail_velocity_m_s, motion.pressure_Pa)
        true.append(force_of(*(course[chosen] for course in courses)))
        at = [course[chosen] for course in learned.domain.values_along(motion)]
        force_N, sigma_N = learned.force(at)
        alone.append(force_N)
        sigma.append(sigma_N)
        values.append(np.column_stack(at))
        shifts.append(gauge(campaign, motion, chosen))
    truth_N, alone_N, sigma_N, at_all, shift = (np.concatenate(part) for part in (true, alone, sigma, values, shifts))
    low, high = np.quantile(at_all, MIDDLE, axis=0)
    middle = np.all((at_all >= low) & (at_all <= high), axis=1)
    span, off_N = float(np.ptp(truth_N[middle])), (alone_N - truth_N)[middle]
    size = np.sqrt(np.mean(shift[middle] ** 2, axis=0))
    columns = shift[middle][:, size > 0] / size[size > 0]
    beyond_N = off_N - columns @ np.linalg.lstsq(columns, off_N, rcond=1e-8)[0]
    return {
        "range_N": span,
        "within": float(np.mean(np.abs(off_N) < WITHIN * span)),
        "within_shape": float(np.mean(np.abs(off_N - np.median(off_N)) < WITHIN * span)),
        "within_beside": float(np.mean(np.abs(beyond_N) < WITHIN * span)),
        "covered": float(np.mean(np.abs(off_N) < BAND * sigma_N[middle])),
        "sigma_N": float(np.median(sigma_N[middle])),
    }


def ask(seed: int, with_law: bool) -> dict[str, object]:
    """One campaign: what was learned of its hidden force."""
    law = list(LAWS)[seed % len(LAWS)]
    campaign = make(f"outsider:{law}", seed)
    pairs, begun = list(campaign.pairs), time.process_time()
    fit = initial_fit(vt.base_model(), pairs, candidates_of(vt.base_model(), None, {}))
    learned = missing_force(fit).learned
    row: dict[str, object] = {"seed": seed, "law": law, "n_trials": len(pairs), "chi2_per_dof": fit.chi2_per_dof}
    row["processor_s"] = time.process_time() - begun
    if learned is not None:
        row["variables"] = learned.domain.name
        row["weight"] = learned.weights[row["variables"]]
        row["beside"] = ", ".join(learned.not_excluded)
        row["in_set"] = LAWS[law] in (row["variables"], *learned.not_excluded)
        row["weight_of_truth"] = learned.weights.get(LAWS[law], 0.0)
        row |= {"explained": learned.explained, **errors(campaign, learned)}
    if with_law:
        begun = time.process_time()
        proposal = propose(vt.base_model(), pairs, lambda _: None)
        row["proposed"] = proposal.tied[0].effect.name if proposal.tied else ""
        row["propose_s"] = time.process_time() - begun
        true_m = left_out_error(true_fit(proposal.before, campaign.truth))
        row["before"] = proposal.rms_left_out_m / true_m
        row["after"] = proposal.tied[0].rms_left_out_m / true_m if proposal.tied else math.nan
        row["with_table"] = math.nan if proposal.table is None else proposal.table.rms_left_out_m / true_m
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=FIRST_TUNING_SEED)
    parser.add_argument("--campaigns", type=int, default=10)
    parser.add_argument("--propose", action="store_true", help="also fit laws, and hold the best against the truth")
    parser.add_argument("--rows", type=Path, help="keep every answer as it comes; what is there is not asked again")
    asked = parser.parse_args()
    kept = asked.rows is not None and asked.rows.is_file()
    rows: list[dict[str, object]] = pd.read_csv(asked.rows).to_dict("records") if kept else []
    for seed in range(asked.first_seed, asked.first_seed + asked.campaigns):
        if any(row["seed"] == seed for row in rows):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows.append(ask(seed, asked.propose))
        if asked.rows:
            pd.DataFrame(rows).to_csv(asked.rows, index=False)
        print(pd.DataFrame(rows[-1:]).to_string(index=False), flush=True)
    absent = {"variables": None, "beside": None, "in_set": False, **dict.fromkeys(SCORES, math.nan)}
    table = pd.DataFrame([absent | row for row in rows])
    print(table.to_string(index=False, float_format="%.3g"))
    named = table["variables"].notna()
    right = table["variables"] == table["law"].map(LAWS)
    alone = table["beside"].fillna("") == ""
    print(f"learned {named.sum()} of {len(table)}; variables right {right.sum()}, alone {(right & alone).sum()};")
    print(f"in the set {table['in_set'].eq(True).sum()}; a wrong name alone {(named & ~right & alone).sum()}")
    names = ("force", "but for a constant", "but for B, n and P_y", "in the 95 % band")
    medians = ", ".join(f"{name} {table[key].median():.2f}" for name, key in zip(names, SCORES, strict=True))
    print(f"within 10 % of the range, median of campaigns: {medians}")
    reached = ", ".join(f"{name} {(table[key] >= REACH).sum()}" for name, key in zip(names, SCORES, strict=True))
    print(f"campaigns with at least {REACH:.0%} of the points so: {reached}")
    print(f"processor time: median {table['processor_s'].median():.0f} s, most {table['processor_s'].max():.0f} s")


if __name__ == "__main__":
    main()
