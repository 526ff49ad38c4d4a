"""Fit of the damping law and of its scaling with the size of the vine."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_json
from vinetrack.results.folder_layout import Results, read_result

if TYPE_CHECKING:
    from vinetrack.experiment.settings import DampingSettings

log = logging.getLogger(__name__)


def fit_law(folder: Path, settings: DampingSettings) -> dict[str, Any]:
    """Fit the damping law to `damping_points.csv`; write `damping.json` and `scaling.json`. Returns `damping.json` as
    written.
    """
    results = Results(folder)
    points = read_result(results.points)

    from vinetrack.kinematics.damping import fit_laws
    from vinetrack.kinematics.scaling import fit_scaling, fit_trends

    damping = fit_laws(points, resamples=settings.resamples, seed=settings.seed)
    write_json(results.scaling, fit_scaling(damping) | fit_trends(read_result(results.conditions)))
    write_json(results.damping, damping)
    for method, fit in damping.items():
        log.info("%s: n = %s, refused: %s", method, fit.get("n"), fit.get("refused"))
    return damping
