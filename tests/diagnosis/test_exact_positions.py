"""Positions without noise, as a simulation gives them: they are no more exact than the model's own integrator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hidden import shots
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt
from vinetrack.diagnosis.misfit_tests import noise_in_motion_p
from vinetrack.inference.optimiser import variance_floor


@pytest.fixture
def without_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, float]:
    """Twelve trials of another simulator with nothing hidden, filmed by a camera that never errs; their exponent."""
    camera = shots.Camera

    def exact(_noise_m: float, **how: Any) -> shots.Camera:
        return camera(0.0, **how)

    monkeypatch.setattr(shots, "Camera", exact)
    shot = campaign("clean", 20600, (12, 12), weighed=False)
    write_experiment(shot, tmp_path / "simulated")
    return tmp_path / "simulated", float(shot.truth["truths"]["eversion_damping.n"])  # type: ignore[index]


def test_nothing_is_missing_from_a_simulation_of_the_model_itself(without_noise: tuple[Path, float]) -> None:
    """What the integrator errs by, 1 µm in a metre, had passed for motion that is noisier than rest."""
    folder, n = without_noise
    said = vt.diagnose(folder, ladder=False, advice=False)
    assert said.verdict == "adequate"
    fit = said.fits[0]
    assert all(trial_data.noise_m**2 < variance_floor([trial_data])[0] for trial_data in fit.predictor.data)
    assert np.isfinite(fit.chi2_per_dof)
    assert noise_in_motion_p(fit) == 1.0
    assert fit["n"].value == pytest.approx(n, abs=3 * fit["n"].sigma)
