"""Campaigns: which vines are grown at which pressures with which payloads, how often.

`paper_damping` and `paper_payload` are the published protocol: four isometric vines, about ten pressures each, four
trials a pressure without payload; and the 24 mm vine with 35.6 g. Where the paper gives no number (lengths other than
280 mm, the pressures themselves) ours are stated here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from vinetrack import published
from vinetrack.naming import with_names
from vinetrack.records import Trial

CAPTURE_FPS = published.CAPTURE_FPS
PAPER_B = published.DAMPING_B
PAPER_N = published.EXPONENT


@dataclass(frozen=True)
class Vine:
    """A vine of a campaign, in the units of a trial sheet."""

    diameter_mm: float
    thickness_um: float
    length_mm: float
    yield_pressure_kPa: float = 3.0

    def trial(self, name: str, pressure_kPa: float, payload_g: float = 0.0, capture_fps: float = CAPTURE_FPS) -> Trial:
        """One trial with this vine."""
        return Trial(
            name=name,
            capture_fps=capture_fps,
            diameter_m=self.diameter_mm / 1e3,
            thickness_m=self.thickness_um / 1e6,
            length_m=self.length_mm / 1e3,
            pressure_Pa=pressure_kPa * 1e3,
            pressure_sigma_Pa=10.0 * pressure_kPa,
            yield_pressure_Pa=self.yield_pressure_kPa * 1e3,
            yield_pressure_sigma_Pa=200.0,
            payload_kg=payload_g / 1e3,
        )


def isometric_vine(scale: int) -> Vine:
    """The paper's vine of scale R = 1…4: 50R µm, 6R mm and, isometric with the 280 mm of R = 4, 70R mm."""
    return Vine(6.0 * scale, 50.0 * scale, 70.0 * scale)


def campaign(
    vine: Vine, pressures_kPa: Iterable[float], replicates: int, payload_g: float = 0.0, prefix: str = ""
) -> list[Trial]:
    """Every pressure `replicates` times with one vine and payload."""
    return [
        vine.trial(f"{prefix}{pressure_kPa:g}kPa_{k + 1}".replace(".", "p"), pressure_kPa, payload_g)
        for pressure_kPa in pressures_kPa
        for k in range(replicates)
    ]


def damping_pressures_kPa(scale: int, count: int = 10) -> np.ndarray:
    """Pressures of the damping protocol for one scale, kPa, shape (count,), rounded to 0.1.

    The paper raises the pressure until speeds are still steady within the length of the vine. Lowest: 0.25 m/s of the
    tail, where a trial lasts a second; highest: 3.2 relaxation times (mass over slope of the damping) within the
    growth.
    """
    vine, B = isometric_vine(scale).trial("", 1.0), PAPER_B[scale]
    film_kg = vine.linear_density_kg_m * vine.length_m
    slowest = 0.25
    # x/x_relax = 2L / (v τ) with τ = m / (½ n B v^(n−1)), solved for v at 3.2.
    fastest = (vine.length_m * PAPER_N * B / (3.2 * film_kg)) ** (1 / (2 - PAPER_N))
    drive_Pa = B * np.array([slowest, fastest]) ** PAPER_N / vine.area_m2
    lowest, highest = (vine.yield_pressure_Pa + drive_Pa).tolist()
    return np.asarray(np.round(np.linspace(lowest, highest, count) / 1e3, 1))


def paper_damping(replicates: int = 4, count: int = 10) -> list[Trial]:
    """The protocol of the damping fit: R = 1…4, `count` pressures, `replicates` trials, no payload."""
    trials = [
        trial
        for scale in PAPER_B
        for trial in campaign(
            isometric_vine(scale), damping_pressures_kPa(scale, count), replicates, prefix=f"R{scale}_"
        )
    ]
    return list(with_names(trials))


def paper_payload(replicates: int = 4) -> list[Trial]:
    """The paper's Figs. 4 and 5: 24 mm × 200 µm at 7, 14, 28 kPa with 35.6 g; 150 µm with four payloads."""
    trials = campaign(isometric_vine(4), (7, 14, 28), replicates, payload_g=35.6, prefix="fig4_")
    thinner = replace(isometric_vine(4), thickness_um=150.0)
    for payload_g in (10.0, 20.0, 35.6, 50.0):
        trials += campaign(
            thinner, (14, 28, 41), replicates, payload_g=payload_g, prefix=f"fig5_{payload_g:g}g_".replace(".", "p")
        )
    return list(with_names(trials))


def damping_values(trials: Iterable[Trial]) -> dict[str, dict[str, float] | float]:
    """True parameters for the isometric vines among these trials: the printed B by vine, the printed n."""
    by_vine = {trial.vine: PAPER_B[round(trial.diameter_m / 6e-3)] for trial in trials}
    return {"eversion_damping.B": by_vine, "eversion_damping.n": PAPER_N}
