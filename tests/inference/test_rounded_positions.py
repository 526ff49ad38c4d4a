"""Rounded positions: a rest of twenty equal values carries the information of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from lsoda_vine import N_TRUE, small_campaign

import vinetrack as vt
from vinetrack.inference.fit_data import prepare
from vinetrack.pipeline.run_stage import check_folder

STEP_M = 2e-3


def rounded(seed: int, step_m: float = STEP_M):
    pairs, truth = small_campaign(seed)
    return [
        (trial, replace(track, lead_position_m=np.round(track.lead_position_m / step_m) * step_m))
        for trial, track in pairs
    ], truth


def with_stop(pairs, frames: int):
    """The same, filmed on after the vine has stopped."""
    longer = []
    for trial, track in pairs:
        step_s = float(np.median(np.diff(track.time_s)))
        more_s = track.time_s[-1] + step_s * np.arange(1, frames + 1)
        arrays = {
            name: np.concatenate([getattr(track, name), np.full(frames, getattr(track, name)[-1])])
            for name in ("lead_position_m", "lead_position_sigma_m", "flag", "tracked_px")
            if getattr(track, name, None) is not None
        }
        longer.append((trial, replace(track, time_s=np.concatenate([track.time_s, more_s]), **arrays)))
    return longer


def test_a_rest_without_visible_noise_counts_as_one_point():
    data, _ = prepare(rounded(1)[0])
    assert len(data) > 12
    for each in data:
        assert each.n_rest == 0
        assert each.imprecise_rest.sigma_m == pytest.approx(STEP_M / np.sqrt(12))
        assert each.noise_m >= 0.999 * STEP_M / np.sqrt(12)


def test_a_rest_with_visible_noise_is_kept_despite_rounding():
    assert all(each.n_rest > 5 and each.imprecise_rest is None for each in prepare(rounded(1, 1e-5)[0])[0])


def test_origins_of_rounded_tracks_have_the_stated_errors():
    """Taken for independent values, twenty equal ones at rest gave origins that were off by five standard errors."""
    errors = []
    for seed in (2, 3):
        pairs, truth = rounded(seed)
        fit = vt.fit(vt.base_model(), pairs, profile=False)
        known = {trial.name: each for (trial, _), each in zip(pairs, truth, strict=True)}
        errors += [(t.origin_m - known[t.name]["origin_m"]) / t.origin_sigma_m for t in fit.trials]
        (n,) = [number for number in fit.numbers if number.symbol == "n"]
        assert abs(n.value - N_TRUE) < 3 * n.sigma
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_standstill_at_the_end_counts_as_one_point_too():
    pairs, _ = rounded(4)
    short, long = prepare(pairs)[0], prepare(with_stop(pairs, 200))[0]
    for before, after in zip(short, long, strict=True):
        more_s = after.time_s[after.time_s > before.time_s[-1]]
        assert more_s.size <= 1 + np.count_nonzero(np.diff(before.lead_position_m[-20:]) == 0)


def test_positions_clicked_in_millimetres_are_recognised_and_the_model_is_adequate(tmp_path):
    """One frame in four, on a grid of a millimetre: called dropped frames, and a tail that stretches."""
    write_experiment(campaign("clicked", 20736, (8, 12), weighed=False), tmp_path / "e")
    said = vt.diagnose(vt.read_experiment(tmp_path / "e"), ladder=False, advice=False)
    assert said.verdict == "adequate"
    assert any("rounded to 1 mm" in note for note in check_folder(tmp_path / "e").notes)
