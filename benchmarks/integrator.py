"""How exact the integrator is, and how much faster than SciPy's LSODA at the same error.

    python benchmarks/integrator.py [--repeats 5]

Every trial of the published protocol (`paper_damping` and `paper_payload`, one of each condition, printed B and n) and
the fast vine (100 µm, 25 mm, 400 mm, 62 kPa, B 3.3), from rest to the end of growth, at every frame of 1069 fps.

Error      largest difference of position at any frame, over the length grown, from a reference of rtol 10⁻¹² in
           another formulation (`tests/model/vine_reference.py`)
LSODA      `solve_ivp(method="LSODA")` on plain floats, stopped by an event at the end of growth, at the same frames.
           For each trial the cheapest of a grid of rtol and atol whose error is no more than ours, or than 10⁻⁶ if
           ours is less. Once more with a right-hand side compiled by numba, the same settings.
Ours       one by one through `simulate`, with all that Python does around it; COPIES of every trial in one call of
           `simulate_many`; and the same laid out once by `prepare` and run again, as a fit does: in one thread, in two.

Times are the best of several repeats, all in one run on one machine.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from vine_reference import G, masses, reference

from vinetrack.core.records import Trial
from vinetrack.dynamics.model import base_model
from vinetrack.dynamics.simulate import prepare, simulate, simulate_many
from vinetrack.laboratory.tracks import CAPTURE_FPS, PAPER_B, PAPER_N, Vine, paper_damping, paper_payload

FAST_B = 3.3
RELATIVE = 10.0 ** np.arange(-4, -11.5, -0.5)
ABSOLUTE = (1e-1, 1e-2, 1e-4, 1e-6)
"""atol of LSODA over its rtol."""
COPIES = 10
TARGET = 1e-6


@dataclass(frozen=True)
class Case:
    """One trial with its frames and the tail's true position there."""

    trial: Trial
    B: float
    end_s: float
    times_s: np.ndarray
    tail_m: np.ndarray

    def error(self, tail_m: np.ndarray) -> float:
        """Largest difference from the truth, over the length grown."""
        return float(np.abs(tail_m - self.tail_m).max() / (2 * self.trial.length_m))


def make_case(trial: Trial, B: float) -> Case:
    truth = reference(trial, B, PAPER_N, 1e6)
    times_s = np.arange(1, int(truth.end_s * CAPTURE_FPS) + 1) / CAPTURE_FPS
    return Case(trial, B, truth.end_s, times_s, truth.state(times_s)[0])


@njit
def compiled_rates(
    x: float, v: float, drive: float, k: float, film: float, lost: float, floor: float, payload: float
) -> tuple[float, float]:
    mass = max(film - lost * x, floor) + payload
    return v, (drive - k * max(v, 0.0) ** PAPER_N) / mass + G


def lsoda(case: Case, *, compiled: bool) -> Callable[[float, float], np.ndarray]:
    """The tail's positions at the frames, from rtol and atol."""
    trial, mass, k, stop = case.trial, masses(case.trial), case.B / 2, 2 * case.trial.length_m
    film, lost, floor, payload = mass.film, mass.lost_per_m, mass.floor, mass.payload
    drive = 0.5 * (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2

    def plain(_t: float, state: Any) -> tuple[float, float]:
        x, v = state.tolist()
        moving = film - lost * x
        if moving < floor:
            moving = floor
        return v, (drive - (k * v**PAPER_N if v > 0 else 0.0)) / (moving + payload) + G

    def quick(_t: float, state: Any) -> tuple[float, float]:
        return compiled_rates(state[0], state[1], drive, k, film, lost, floor, payload)

    def grown(_t: float, state: Any) -> float:
        return state[0] - stop

    grown.terminal = True  # type: ignore[attr-defined]
    slope = quick if compiled else plain
    until = (0.0, 1.01 * case.end_s)

    def run(rtol: float, atol: float) -> np.ndarray:
        done = solve_ivp(slope, until, (0.0, 0.0), "LSODA", t_eval=case.times_s, rtol=rtol, atol=atol, events=grown)
        tail_m = np.full(case.times_s.size, stop)
        tail_m[: done.y.shape[1]] = done.y[0]
        return tail_m

    return run


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Shortest time of several, s."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def cheapest(case: Case, limit: float, repeats: int) -> tuple[float, float, float, float] | None:
    """(time s, error, rtol, atol) of the cheapest LSODA within `limit`; None where no setting is."""
    run = lsoda(case, compiled=False)
    good = []
    for rtol, share in itertools.product(RELATIVE, ABSOLUTE):
        start = time.perf_counter()
        error = case.error(run(rtol, share * rtol))
        if error <= limit:
            good.append((time.perf_counter() - start, error, rtol, share * rtol))
    # The three that look cheapest are timed with care.
    timed = [(best_of(repeats, lambda c=choice: run(*c[2:])), *choice[1:]) for choice in sorted(good)[:3]]
    return min(timed) if timed else None


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    trials = [*paper_damping(1), *paper_payload(1)]
    cases = [make_case(trial, PAPER_B[round(trial.diameter_m / 6e-3)]) for trial in trials]
    cases.append(make_case(Vine(25, 100, 400).trial("fast", 62), FAST_B))
    model = base_model()

    def rows(chosen: list[Case]) -> np.ndarray:
        named = [model.with_values({"eversion_damping.B": case.B, "eversion_damping.n": PAPER_N}) for case in chosen]
        return np.array([one.parameters_for("") for one in named])

    def together(chosen: list[Case]) -> list[Any]:
        return simulate_many(
            model,
            [c.trial for c in chosen],
            [c.times_s for c in chosen],
            parameters=values[len(chosen), chosen[0].trial.name],
        )

    many = cases * COPIES
    values = {(len(part), part[0].trial.name): rows(part) for part in (cases, many)}
    lines = []
    print(f"{'trial':26}{'frames':>7}{'error':>10}{'steps':>6}{'ours µs':>9}{'LSODA µs':>10}{'error':>10}{'rtol':>9}"
          f"{'atol':>9}{'compiled':>10}{'ratio':>7}")  # fmt: skip
    for case, moved in zip(cases, together(cases), strict=True):
        own = model.with_values({"eversion_damping.B": case.B, "eversion_damping.n": PAPER_N})
        error = case.error(2 * moved.lead_position_m)
        alone = best_of(5 * repeats, lambda own=own, case=case: simulate(own, case.trial, case.times_s))
        found = cheapest(case, max(error, TARGET), repeats)
        if found is None:
            print(f"{case.trial.name:26}{case.times_s.size:7d}{error:10.1e}{moved.n_steps:6d}{1e6 * alone:9.0f}  none")
            continue
        quick = best_of(repeats, lambda case=case, found=found: lsoda(case, compiled=True)(*found[2:]))
        lines.append((error, alone, found[0], quick, found[1]))
        print(f"{case.trial.name:26}{case.times_s.size:7d}{error:10.1e}{moved.n_steps:6d}{1e6 * alone:9.0f}"
              f"{1e6 * found[0]:10.0f}{found[1]:10.1e}{found[2]:9.1e}{found[3]:9.1e}{1e6 * quick:10.0f}"
              f"{found[0] / alone:7.0f}", flush=True)  # fmt: skip
    table = np.array(lines)
    all_at_once = best_of(repeats, lambda: together(many)) / len(many)
    named = [case.trial for case in many]
    batch = prepare(model, named, [case.times_s for case in many], parameters=rows(many))
    one_thread = best_of(2 * repeats, lambda: batch.run(threads=1)) / len(many)
    two_threads = best_of(2 * repeats, lambda: batch.run(threads=2)) / len(many)
    plain, compiled = table[:, 2].mean(), table[:, 3].mean()
    errors = table[:, 0]
    most, usual = errors.max(), np.median(errors)
    print(f"\nlargest error {most:.1e}, without the fast vine {errors[:-1].max():.1e}, median {usual:.1e}")
    print(f"mean over {len(cases)} trials, µs a trajectory: LSODA {1e6 * plain:.0f}, compiled {1e6 * compiled:.0f}")
    for words, seconds in (
        ("one by one", table[:, 1].mean()),
        (f"{len(many)} in one call", all_at_once),
        ("the same prepared, one thread", one_thread),
        ("the same prepared, two threads", two_threads),
    ):
        print(
            f"ours, {words:34}{1e6 * seconds:8.1f} µs {1 / seconds:10.0f} a second {plain / seconds:7.0f} × LSODA"
            f"{compiled / seconds:7.0f} × compiled"
        )
    print(f"median of the ratios, trial by trial, one by one: {np.median(table[:, 2] / table[:, 1]):.0f}")


if __name__ == "__main__":
    main()
