"""Campaigns: vines, pressures, payloads and number of replicates.

`paper_campaign` has all trials of the paper: four isometric vines at about ten pressures each, walls of one diameter,
payloads, 24 kPa for all scales, efficiencies, the fast vine; four trials of each. Numbers that the paper does not give
(lengths other than 280 and 400 mm, the pressures themselves, payloads other than 35.6 g, which walls) are stated here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.experiment.schema import with_names
from vinetrack.planning.predictive_inputs import damping_prior

CAPTURE_FPS = published.CAPTURE_FPS
PAPER_B = published.DAMPING_B
PAPER_N = published.EXPONENT
WALLS_UM = tuple(published.THICKNESS_UM.values())
PAYLOADS_G = (10.0, 20.0, published.PAYLOAD_G, 50.0)
EFFICIENCY_LENGTH_MM = 200.0  # Length of the vines whose efficiency is evaluated (chosen)


@dataclass(frozen=True)
class Vine:
    """A vine of a campaign, in the units of a trial sheet."""

    diameter_mm: float
    thickness_um: float
    length_mm: float
    yield_pressure_kPa: float = 3.0

    def trial(self, name: str, pressure_kPa: float, payload_g: float = 0.0, capture_fps: float = CAPTURE_FPS) -> Trial:
        """Make one trial with this vine."""
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
    """Make trials of every pressure, `replicates` times, with one vine and payload."""
    return [
        vine.trial(f"{prefix}{pressure_kPa:g}kPa_{k + 1}".replace(".", "p"), pressure_kPa, payload_g)
        for pressure_kPa in pressures_kPa
        for k in range(replicates)
    ]


def _paper_B(diameter_m: float, thickness_m: float) -> float:
    """B of a vine of the paper's campaign, N·(s/m)ⁿ: what is printed, where it is. Of a diameter of Table I with
    another wall it is in proportion to the wall, as Fig. 7B says ("linearly"), through the printed one; of any other
    diameter it is our guess.
    """
    for scale, diameter_mm in published.DIAMETER_MM.items():
        if abs(1e3 * diameter_m / diameter_mm - 1) < 0.01:
            return PAPER_B[scale] * 1e6 * thickness_m / published.THICKNESS_UM[scale]
    return damping_prior(diameter_m, thickness_m)


def damping_pressures_kPa(scale: int, count: int = 10) -> np.ndarray:
    """Return pressures of the damping protocol for one scale; see `_steady_pressures_kPa`. Shape (count,)."""
    return _steady_pressures_kPa(isometric_vine(scale), count)


def _steady_pressures_kPa(of: Vine, count: int = 10) -> np.ndarray:
    """Pressures at which a vine gets steady within its length, kPa, shape (count,), rounded to 0.1. The paper raises
    the pressure until speeds are still steady within the length of the vine.
    """
    vine = of.trial("", 1.0)
    B = _paper_B(vine.diameter_m, vine.thickness_m)
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
    payload = published.PAYLOAD_G
    trials = campaign(isometric_vine(4), published.POSITION_RMS_CM, replicates, payload_g=payload, prefix="fig4_")
    thinner = replace(isometric_vine(4), thickness_um=published.FINAL_SPEED_THICKNESS_UM)
    for payload_g in PAYLOADS_G:
        trials += campaign(
            thinner,
            published.FINAL_SPEED_RMS_M_S,
            replicates,
            payload_g=payload_g,
            prefix=f"fig5_{payload_g:g}g_".replace(".", "p"),
        )
    return list(with_names(trials))


def _paper_walls(replicates: int = 4, count: int = 8) -> list[Trial]:
    """The paper's Fig. 7B: walls of 12 mm vines other than that of R = 2, which is among the scales."""
    vines = [replace(isometric_vine(2), thickness_um=wall_um) for wall_um in WALLS_UM]
    trials = [
        trial
        for vine in vines
        if vine != isometric_vine(2)
        for trial in campaign(
            vine, _steady_pressures_kPa(vine, count), replicates, prefix=f"fig7_{vine.thickness_um:g}um_"
        )
    ]
    return list(with_names(trials))


def _paper_speed(replicates: int = published.REPLICATES) -> list[Trial]:
    """The paper's Fig. 8: every scale at 24 kPa."""
    pressures_kPa = (published.STEADY_SPEED_KPA,)
    trials = [
        trial
        for scale in PAPER_B
        for trial in campaign(isometric_vine(scale), pressures_kPa, replicates, prefix=f"fig8_R{scale}_")
    ]
    return list(with_names(trials))


def _paper_efficiency(replicates: int = published.REPLICATES) -> list[Trial]:
    """The paper's Fig. 9: 12 and 18 mm vines with every wall at 34 kPa, with 35.6 g."""
    pressures_kPa, payload_g = (published.EFFICIENCY_KPA,), published.PAYLOAD_G
    vines = [
        Vine(diameter_mm, wall_um, EFFICIENCY_LENGTH_MM)
        for diameter_mm in published.EFFICIENCY_DIAMETERS_MM
        for wall_um in WALLS_UM
    ]
    trials = [
        trial
        for vine in vines
        for trial in campaign(
            vine, pressures_kPa, replicates, payload_g, f"fig9_{vine.diameter_mm:g}mm_{vine.thickness_um:g}um_"
        )
    ]
    return list(with_names(trials))


def paper_campaign() -> list[Trial]:
    """Everything the paper grew but its dye injector; the fast vine once, as there."""
    fast = published.FAST_VINE
    fastest = Vine(fast["diameter_mm"], fast["thickness_um"], fast["length_mm"])
    trials = [
        *paper_damping(),
        *_paper_walls(),
        *paper_payload(),
        *_paper_speed(),
        *_paper_efficiency(),
        *campaign(fastest, (fast["pressure_kPa"],), 1, prefix="fast_"),
    ]
    return list(with_names(trials))


def paper_values(trials: Iterable[Trial]) -> dict[str, dict[str, float] | float]:
    """True parameters for the vines of the paper's campaign: B by vine, to four digits, and the printed n. Returns
    values as `GroundTruth.values` takes them; B in N·(s/m)ⁿ.
    """
    by_vine = {trial.vine: float(f"{_paper_B(trial.diameter_m, trial.thickness_m):.4g}") for trial in trials}
    return {"eversion_damping.B": by_vine, "eversion_damping.n": PAPER_N}


def damping_values(trials: Iterable[Trial]) -> dict[str, dict[str, float] | float]:
    """True parameters for the isometric vines among these trials: the printed B by vine, the printed n. Returns values
    as `GroundTruth.values` takes them; B in N·(s/m)ⁿ.
    """
    by_vine = {trial.vine: PAPER_B[round(trial.diameter_m / 6e-3)] for trial in trials}
    return {"eversion_damping.B": by_vine, "eversion_damping.n": PAPER_N}
