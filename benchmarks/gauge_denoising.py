"""How well recorded pressures are denoised: traces of laboratories and made ones, whose true pressure is known.

    python benchmarks/gauge_denoising.py [--first-seed 60001] [--campaigns 3]

For every kind of gauge: root mean square of denoised minus true pressure without its mean, in standard deviations of
the readings; its largest value; root mean square of the error of the mean, and of the errors along their columns, in
stated standard deviations (1 is right); number of columns; processor seconds of a campaign.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from hidden import shots
from hidden.laboratory_rows import campaign

from vinetrack.core.records import Floats, Track
from vinetrack.inference.gauge_noise import denoised_traces
from vinetrack.laboratory.campaigns import plain_track

LABORATORIES = (
    *("gauge_slow", "gauge_slow_depletion", "gauge_rounded", "gauge_held", "gauge_steps", "gauge_coarse"),
    *("gauge_coarse_quiet", "gauge_coarse_depletion", "gauge_filtered", "trace_clock"),
)
TIME_S = np.arange(0.0, 0.6, 1e-3)
GROWTH_M = 0.3 * -np.expm1(-np.maximum(TIME_S - 0.06, 0.0) / 0.3)
MADE: dict[str, tuple[int, Callable[[np.random.Generator, int], Floats]]] = {
    "constant": (12, lambda _, k: np.full(TIME_S.size, 8e3 + 500.0 * k)),
    "constant, one trial": (1, lambda *_: np.full(TIME_S.size, 8e3)),
    "chamber that empties": (12, lambda *_: 127e3 * (1 + 0.1 * GROWTH_M) ** -1.4 - 101e3),
    "the same, one trial": (1, lambda *_: 127e3 * (1 + 0.1 * GROWTH_M) ** -1.4 - 101e3),
    "let down and filled": (4, lambda *_: np.interp(TIME_S, [0.1, 0.12, 0.2, 0.5], [16e3, 3e3, 3e3, 16e3])),
    "pulsation": (12, lambda draw, _: 20e3 * (1 + 0.05 * np.sin(50.0 * TIME_S + draw.uniform(0, 6)))),
    "valve that opens": (12, lambda _, k: (12e3 + 800.0 * k) * -np.expm1(-TIME_S / 0.05)),
    "leak": (12, lambda _, k: (8e3 + 500.0 * k) * np.exp(-TIME_S / 2)),
    "jump": (12, lambda *_: np.where(TIME_S < 0.3, 15e3, 14e3)),
}


def laboratory(name: str, seed: int) -> list[tuple[Track, Floats]]:
    """Tracks of one laboratory with the pressures that its gauge would have told without noise, Pa."""
    told: list[tuple[Floats, Floats]] = []

    def keeping(times: Floats, pressure_Pa: Floats, *how: object) -> Floats:
        told.append((recorded(times, pressure_Pa, *how), pressure_Pa))  # type: ignore[arg-type]
        return told[-1][0]

    recorded = shots._recorded
    with patch.object(shots, "_recorded", keeping):
        recordings = campaign(name, seed, weighed=False).recordings
    found = []
    for one in recordings:
        assert one.pressure_kPa is not None
        seen_Pa = 1e3 * one.pressure_kPa
        true_Pa = next(true for trace, true in told if trace.size == seen_Pa.size and np.allclose(trace, seen_Pa))
        found.append(
            (plain_track(one.time_s, one.position_m, pressure_Pa=1e3 * np.round(one.pressure_kPa, 5)), true_Pa)
        )
    return found


def made(name: str, seed: int) -> list[tuple[Track, Floats]]:
    """Traces of 600 samples with 100 Pa of white noise."""
    draw = np.random.default_rng(seed)
    count, pressure = MADE[name]
    pairs = []
    for k in range(count):
        true_Pa = pressure(draw, k)
        noisy_Pa = true_Pa + 100.0 * draw.standard_normal(TIME_S.size)
        track = plain_track(TIME_S, GROWTH_M + 4e-5 * draw.standard_normal(TIME_S.size), pressure_Pa=noisy_Pa)
        pairs.append((track, true_Pa))
    return pairs


def row(campaigns: Iterator[list[tuple[Track, Floats]]]) -> str:
    """The numbers of one kind of gauge."""
    left, largest, of_mean, along, columns, seconds = [], [], [], [], [], []
    for pairs in campaigns:
        begun = time.process_time()
        denoised = denoised_traces([track for track, _ in pairs])
        seconds.append(time.process_time() - begun)
        for trace, (track, true_Pa) in zip(denoised, pairs, strict=True):
            assert trace is not None
            assert track.pressure_Pa is not None
            sigma_Pa = float(np.std(track.pressure_Pa - true_Pa)) or math.inf
            off_Pa = trace.pressure_Pa - true_Pa
            of_mean += [off_Pa.mean() / trace.mean_error_Pa] if trace.mean_error_Pa else []
            off_Pa -= off_Pa.mean()
            left.append(np.sqrt(np.mean(off_Pa**2)) / sigma_Pa)
            largest.append(np.max(np.abs(off_Pa)) / sigma_Pa)
            columns.append(trace.errors_Pa.shape[1])
            if columns[-1]:
                directions, sizes_Pa, _ = np.linalg.svd(trace.errors_Pa, full_matrices=False)
                along += list(directions.T @ off_Pa / sizes_Pa)
    rms, mean_z, along_z = (float(np.sqrt(np.mean(np.square(each)))) for each in (left, of_mean, along))
    others = f"{np.mean(columns):.1f} | {np.mean(seconds):.1f}"
    return f"{rms:.3f} | {max(largest):.1f} | {mean_z:.2f} | {along_z:.2f} | {others}"


def main() -> None:
    """Print a table of all kinds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=60001)
    parser.add_argument("--campaigns", type=int, default=3)
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.campaigns)
    print("| gauge | rms, σ | largest, σ | z of mean | z of errors | columns | s |\n|---|---|---|---|---|---|---|")
    for source, names in ((laboratory, LABORATORIES), (made, MADE)):
        for name in names:
            print(f"| {name} | {row(source(name, seed) for seed in seeds)} |", flush=True)


if __name__ == "__main__":
    main()
