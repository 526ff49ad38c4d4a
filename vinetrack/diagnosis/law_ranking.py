"""Simple laws ranked by how well they explain the misfit of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceEstimate, LinearInversion
from vinetrack.diagnosis.force_laws import Law, laws_near, laws_on_grid
from vinetrack.diagnosis.force_refinement import refine_law
from vinetrack.diagnosis.force_sensitivities import FittedMotion, force_sensitivities
from vinetrack.diagnosis.linear_misfit import LinearMisfit
from vinetrack.inference.fit_result import Fit

DETECTION_SIGMAS = 5.0  # Standard errors that the amplitude of a law must differ from zero to be detected

# Laws that are fitted by nonlinear least squares, if the best linear fit leaves more than this multiple of the noise;
# otherwise the best alone (chosen)
LAWS_REFINED, ROUGH_CHI2_PER_POINT = 3, 1.5

# Part of χ² that a law must take away to be refined (chosen)
LEAST_CHI2_FRACTION, MAX_CHI2_RATIO = 0.5, 1.5

# Multiple of the largest drive, weight and inertia of the trials above which a force is not reported (chosen)
MAX_DRIVE_RATIO = 10.0


@dataclass(frozen=True)
class RankedLaw:
    """A law with its estimate, its BIC, and the largest force that these motions make plausible, N."""

    law: Law
    estimate: ForceEstimate
    bic: float
    explained: float = 0.0
    largest_N: float = math.inf

    @property
    def is_detected(self) -> bool:
        """Whether its amplitude differs significantly from zero, and is plausible for these motions."""
        size_N = math.hypot(*self.estimate.amplitude)
        return DETECTION_SIGMAS * self.estimate.sigma < size_N < self.largest_N and not self.law.is_unresolved

    @property
    def words(self) -> str:
        """Description of the law with its amplitude."""
        return self.law.words(self.estimate.amplitude.tolist(), self.estimate.sigma)


def ranked_laws(fit: Fit, linear: LinearMisfit) -> list[RankedLaw]:
    """Rank the best law of each kind: those detected first, then by BIC. All laws of a grid are estimated by the linear
    inversion, then laws near the best of each kind. The first few are fitted by nonlinear least squares and all are
    ranked again.
    """
    inversion, motions = linear.inversion, linear.motions

    def sensitivities(laws: Sequence[Law]) -> list[Floats]:
        return force_sensitivities(
            fit,
            inversion.trial_effects,
            motions,
            lambda motion: np.column_stack([law.unit_force(motion) for law in laws]),
        )

    return _refined(fit, inversion, motions, _ranked(inversion, sensitivities, motions, linear.smooth_force))


def _ranked(
    inversion: LinearInversion,
    sensitivities: Callable[[Sequence[Law]], list[Floats]],
    motions: Sequence[FittedMotion],
    smooth_force: ForceEstimate,
) -> list[RankedLaw]:
    """The best law of each kind by the linear inversion, best first: over the grid, then near the best of each kind."""

    def estimates(laws: Sequence[Law]) -> list[tuple[Law, ForceEstimate]]:
        each = inversion.estimate_each(sensitivities(laws), [law.n_amplitudes for law in laws])
        return [
            (law, estimate)
            for law, estimate in zip(laws, each, strict=True)
            if estimate.degrees_of_freedom or law.kind == "constant"
        ]

    estimated, largest_N = estimates(laws_on_grid(motions)), _largest_N(motions)
    largest_delta_chi2 = max(smooth_force.delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
    best = _best_of_kinds(_with_bic(inversion, estimated, largest_delta_chi2, largest_N))
    estimated += estimates([law for ranked in best for law in laws_near(ranked.law, motions)])
    largest_delta_chi2 = max(largest_delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
    return sorted(
        _best_of_kinds(_with_bic(inversion, estimated, largest_delta_chi2, largest_N)), key=_detected_then_bic
    )


def _refined(
    fit: Fit, inversion: LinearInversion, motions: Sequence[FittedMotion], laws: list[RankedLaw]
) -> list[RankedLaw]:
    """The laws ranked again, the best of them after a nonlinear fit, if its χ² hardly exceeds that of the linear fit.
    Where the linear fit of the best law leaves only noise, the others keep their linear fits.
    """
    chi2 = inversion.chi2_without_force
    rough = chi2 - laws[0].estimate.delta_chi2 > ROUGH_CHI2_PER_POINT * inversion.n_points
    estimates = [law.estimate for law in laws]
    for k, ranked in enumerate(laws[: LAWS_REFINED if rough else 1]):
        linear = ranked.estimate
        if not ranked.is_detected or linear.delta_chi2 < LEAST_CHI2_FRACTION * chi2:
            continue
        full = refine_law(fit, inversion, motions, ranked.law, linear, thorough=k == 0)
        if full is not None and full.chi2 < max(MAX_CHI2_RATIO * (chi2 - linear.delta_chi2), inversion.n_points):
            estimates[k] = ForceEstimate(
                chi2 - full.chi2, full.amplitude, full.sigma, full.parameter_shift, linear.degrees_of_freedom
            )
            laws = [*laws[:k], replace(ranked, law=full.law), *laws[k + 1 :]]
    largest_delta_chi2 = max(estimate.delta_chi2 for estimate in estimates)
    estimated = list(zip((law.law for law in laws), estimates, strict=True))
    return sorted(_with_bic(inversion, estimated, largest_delta_chi2, _largest_N(motions)), key=_detected_then_bic)


def _with_bic(
    inversion: LinearInversion,
    estimated: Sequence[tuple[Law, ForceEstimate]],
    largest_delta_chi2: float,
    largest_N: float,
) -> list[RankedLaw]:
    return [
        RankedLaw(
            law,
            estimate,
            inversion.bic(estimate.delta_chi2, law.n_parameters, largest_delta_chi2),
            largest_N=largest_N,
        )
        for law, estimate in estimated
    ]


def _detected_then_bic(law: RankedLaw) -> tuple[bool, float]:
    """Order of laws: those that are detected first, then by BIC."""
    return not law.is_detected, law.bic


def _largest_N(motions: Sequence[FittedMotion]) -> float:
    """The largest force that is reported: MAX_DRIVE_RATIO times drive, weight and inertia at their largest."""
    sizes = []
    for motion in motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.acceleration))
        sizes.append(float(np.max(drive_N + body_N)))
    return MAX_DRIVE_RATIO * max(sizes)


def _best_of_kinds(laws: Sequence[RankedLaw]) -> list[RankedLaw]:
    best: dict[str, RankedLaw] = {}
    for law in laws:
        before = best.get(law.law.name)
        if before is None or _detected_then_bic(law) < _detected_then_bic(before):
            best[law.law.name] = law
    return list(best.values())
