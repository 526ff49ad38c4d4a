"""Steady windows: how often found, how far x_ss is off, and the exponent n that follows, by our rule and the paper's.

    python benchmarks/steady_windows.py [--trials 20]

Truth: everting vines integrated by SciPy (Radau, rtol 1e-10) at 1069 frames a second, 60 still frames, AR(1) noise,
every other trial with 30 flat frames after the end of growth. x_ss is held against the true mean tail speed in the
window, and against the speed at which drive, weight and damping balance at the mean mass in the window. n is the
shared slope of log F on log x_ss over four vines and ten speeds of 0.2–10 m/s, F = (P − P_y)A + 2 m̄ g, truth 0.37.
Last, trials that never become steady: the share on which each rule finds a window all the same. Thresholds were set
on seeds 0–99; this scores seeds 1000 and up.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from vine_truth import CAPTURE_FPS, G, Recording, Vine, ar1, make_track, record

from vinetrack.core.records import Window
from vinetrack.experiment.settings import SteadySettings
from vinetrack.kinematics.steady import gated_window, paper_window
from vinetrack.kinematics.velocity import estimate_kinematics

FIRST_SEED = 1000
NOISES = ((3e-5, 0.0), (1e-4, 0.0), (1e-4, 0.6), (3e-4, 0.3))
SPEEDS = np.geomspace(0.2, 10, 10)


@dataclass
class Tally:
    """What one rule gave: counts, relative errors, and points (scale, log x, log F) of the damping law."""

    tried: int = 0
    from_mean: list[float] = field(default_factory=list)
    from_balance: list[float] = field(default_factory=list)
    points: list[tuple[int, float, float]] = field(default_factory=list)

    def add(self, window: Window, vine: Vine, trial: Recording) -> None:
        """Score one window."""
        self.tried += 1
        if not window.accepted or not window.x_ss_m_s > 0:
            return
        inside = np.flatnonzero(
            (trial.track.time_s >= window.from_s - 1e-9) & (trial.track.time_s <= window.to_s + 1e-9)
        )
        lead = trial.lead_position_m[inside]
        mean = 2 * (lead[-1] - lead[0]) / (window.to_s - window.from_s)
        tail = 2 * (lead - trial.lead_position_m[0])
        force = vine.drive_N + 2 * float(vine.mass_kg(tail).mean()) * G
        if mean > 0:
            self.from_mean.append(window.x_ss_m_s / mean - 1)
        self.from_balance.append(window.x_ss_m_s / float(vine.quasi_steady_speed(tail.mean())) - 1)
        self.points.append((vine.scale, np.log(window.x_ss_m_s), np.log(force)))

    def exponent(self) -> float:
        """Shared slope of log F on log x, an intercept for each vine."""
        scale, x, y = (np.array(column) for column in zip(*self.points, strict=True))
        for one in np.unique(scale):
            x[scale == one] -= x[scale == one].mean()
            y[scale == one] -= y[scale == one].mean()
        return float(x @ y / (x @ x))

    def row(self) -> str:
        """Share found, median and 90 % of the errors, mean errors, n."""
        mean, balance = 100 * np.array(self.from_mean), 100 * np.array(self.from_balance)
        return (
            f"{100 * len(self.points) / self.tried:6.0f} {np.mean(mean):8.2f} {np.mean(np.abs(mean)):7.2f}"
            f" {np.mean(balance):10.2f} {np.mean(np.abs(balance)):7.2f}"
            f" {np.percentile(np.abs(balance), 95):9.2f} {self.exponent():8.4f}"
        )


def never_steady(seed: int, noise_m: float) -> Recording:
    """A trial whose speed grows evenly throughout, to a tail speed of 10 m/s in 60 frames."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(121) / CAPTURE_FPS
    moving = np.maximum(time_s - time_s[60], 0)
    lead = 0.5 * 5.0 / time_s[60] * moving**2
    track = make_track(time_s, lead + ar1(time_s.size, noise_m, 0.0, rng))
    return Recording(track, lead, 5.0 / time_s[60] * moving, float(time_s[60]), float(time_s[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10)
    trials = parser.parse_args().trials
    seeds = range(FIRST_SEED, FIRST_SEED + trials)
    print(f"seeds {seeds[0]}–{seeds[-1]}, 4 vines × {SPEEDS.size} speeds; errors of x_ss in %")
    print("noise mm  rho  rule   found  vs mean  (abs)  vs balance  (abs)  95 % abs        n")
    for noise_m, rho in NOISES:
        tallies = {"gated": Tally(), "paper": Tally()}
        for scale in (1, 2, 3, 4):
            for speed in SPEEDS:
                vine = Vine(scale, float(speed))
                for seed in seeds:
                    rng = np.random.default_rng(seed)
                    trial = record(vine, rng, noise_m=noise_m, rho=rho, rest_frames=60, end_frames=30 * (seed % 2))
                    kinematics = estimate_kinematics(trial.track, travel_ratio=2)
                    tallies["gated"].add(gated_window(trial.track, kinematics, SteadySettings()), vine, trial)
                    tallies["paper"].add(paper_window(trial.track, travel_ratio=2), vine, trial)
        for rule, tally in tallies.items():
            print(f"{noise_m * 1e3:8.2f}  {rho:3.1f}  {rule:5s} {tally.row()}")
    print("\nnever steady (speed grows evenly to 10 m/s in 60 frames): windows found, %")
    for noise_m in (0.0, 3e-5, 1e-4, 3e-4):
        found = np.zeros(2)
        for seed in range(FIRST_SEED, FIRST_SEED + 10 * trials):
            trial = never_steady(seed, noise_m)
            kinematics = estimate_kinematics(trial.track, travel_ratio=2)
            found += [
                gated_window(trial.track, kinematics, SteadySettings()).accepted,
                paper_window(trial.track, travel_ratio=2).accepted,
            ]
        gated, paper = 100 * found / (10 * trials)
        print(f"noise {noise_m * 1e3:4.2f} mm: gated {gated:5.1f}, paper {paper:5.1f}")


if __name__ == "__main__":
    main()
