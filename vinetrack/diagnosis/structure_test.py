"""Omnibus score test of probe forces: would any smooth force improve the fit, whether or not it is in the catalogue.

Probes are bumps of force along the growth, over speed and over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape
from vinetrack.diagnosis.effect_sensitivities import effect_sensitivities
from vinetrack.diagnosis.score_test import Scores, scores_of
from vinetrack.diagnosis.shape_products import products_of
from vinetrack.dynamics.host import probe
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.robust_covariance import cluster_variance
from vinetrack.inference.systematics import Systematics

BUMPS_ALONG, BUMPS_SPEED, BUMPS_TIME = 8, 4, 4  # Number of probe bumps along growth, speed and time (chosen)

# Smallest eigenvalue of the probes' information, relative to the largest, that counts as a degree of freedom (chosen)
MIN_INFORMATION_SHARE = 1e-4


def _probe_shapes(fit: Fit) -> list[CandidateShape]:
    """Bumps of force along the growth, over speed and over time, with and without a factor P."""
    longest_s = max(float(trial.time_s[-1] - trial.release_s) for trial in fit.trials)
    fastest = max(
        trial.trial.travel_ratio * float(np.quantile(trial.predicted_velocity_m_s, 0.98)) for trial in fit.trials
    )
    lengths = [trial.trial.length_m for trial in fit.trials]
    reaches = [float(np.max(trial.lead_position_m) - trial.origin_m) for trial in fit.trials]
    reach = max(
        grown / length if math.isfinite(length) and length > 0 else grown
        for grown, length in zip(reaches, lengths, strict=True)
    )
    varied = len({round(trial.trial.pressure_Pa, 1) for trial in fit.trials}) > 1
    shapes = []
    for kind, count, top in ((0, BUMPS_ALONG, reach), (1, BUMPS_SPEED, fastest), (2, BUMPS_TIME, longest_s)):
        centres = (np.arange(count) + 0.5) / count * top
        for centre in centres:
            for offset in (0, 3) if varied and kind == 0 else (0,):
                shapes.append(CandidateShape(probe(), (float(kind + offset), float(centre), 0.6 * top / count), 1e-3))
    return shapes


@dataclass(frozen=True)
class Structure:
    """Result of the probes: χ² of their scores for `degrees` of freedom, its p-value `p`, and the same as a `z`.
    `smallest_probe_p` is the smallest p-value of single probes, Bonferroni-corrected: a narrow feature shows in one
    probe and is diluted in the sum over all.
    """

    chi2: float
    degrees: int
    p: float
    z: float
    smallest_probe_p: float = 1.0


def structure_of(fit: Fit, columns: Sequence[Floats], systematics: Systematics) -> Structure:
    """Test a fit for misfit that a smooth force could explain. The scores of all probes are tested together, with both
    kinds of error, in the directions that the fitted parameters leave to them.
    """
    answers = effect_sensitivities(fit, _probe_shapes(fit))
    if not answers.shapes:
        return Structure(0.0, 0, 1.0, 0.0)
    return structure_from_scores(scores_of(fit, products_of(fit, columns, answers, systematics)))


def structure_from_scores(scores: Scores) -> Structure:
    """Test statistics from the scores of probes: all together, and the most significant alone; see `structure_of`."""
    from scipy.stats import f as fisher
    from scipy.stats import norm, t

    root = np.sqrt(np.maximum(np.diag(scores.information), 1e-300))
    informative = np.diag(scores.information) > 0
    information = (scores.information / root[:, None] / root)[np.ix_(informative, informative)]
    score = (scores.score / root)[informative]
    values, vectors = np.linalg.eigh(information)
    keep = values > MIN_INFORMATION_SHARE * values.max(initial=0.0)
    # In the principal directions the scores are uncorrelated and have variance 1 by the noise model.
    z = (vectors[:, keep].T @ score) / np.sqrt(values[keep])
    directions = (vectors / root[informative][:, None])[:, keep] / np.sqrt(values[keep])
    trial_z = scores.trial_scores[:, informative] @ directions
    trial_informations = scores.trial_informations[:, informative][:, :, informative]
    explained = np.einsum("jk,njl,lk->nk", directions, trial_informations, directions) * z
    robust = cluster_variance(trial_z - explained, scores.degrees)
    chi2 = float(np.sum(z**2 / np.maximum(1.0, robust)))
    degrees = int(np.count_nonzero(keep))
    p = float(fisher.sf(chi2 / max(degrees, 1), degrees, max(scores.degrees, 1.0))) if degrees else 1.0
    # A probe to which few trials respond has as few degrees of freedom (effective number of trials).
    by_trial = np.einsum("njj->nj", scores.trial_informations)[:, informative]
    n_effective = by_trial.sum(axis=0) ** 2 / np.maximum(np.sum(by_trial**2, axis=0), 1e-300)
    p_values = 2 * t.sf(np.abs(scores.z[informative]), np.clip(n_effective - 1, 1.0, max(scores.degrees, 3.0)))
    smallest_probe_p = min(degrees * float(np.min(p_values, initial=1.0)), 1.0)
    return Structure(chi2, degrees, p, float(norm.isf(max(p, 1e-300))), smallest_probe_p)
