"""A tip that is lit differently from the tube behind it, tracked where film looks like background."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.scene import preset
from vinetrack.video.frames import read_frames
from vinetrack.video.track import track_frames

FPS = 1069.0


def test_an_edge_is_followed_across_the_place_where_film_and_background_are_alike(tmp_path: Path) -> None:
    """Seed 341, which tuned nothing; without shading of the tip the edge is lost in some frames there."""
    time = np.linspace(0, 0.08, 800)
    motion = time, np.clip(6.0 * (time - 0.015), 0, 0.2)
    path = tmp_path / "reversal.mp4"
    truth = render_recording(preset("contrast_reversal"), motion, n_frames=70, capture_fps=FPS, out_path=path, seed=341)
    trial = Trial(name="t", video=path, capture_fps=FPS, exposure_s=truth.exposure_s, m_per_px=1.0)
    tracking = track_frames(read_frames(path), trial, FPS)
    track = tracking.track
    moving = (np.diff(truth.lead_px, append=truth.lead_px[-1]) > 0.05) & truth.in_frame
    moving &= truth.lead_px > truth.lead_px[0] + 60.0  # where the mouth hides nothing
    assert moving.sum() > 20
    assert track.usable[moving].all()
    error = track.edge_px[moving] - truth.lead_px[moving]
    assert error.std() < 0.5
    assert np.abs(error - np.median(error)).max() < 1.5
    assert track.lead_position_systematic_m is not None
    stated = np.hypot(track.lead_position_sigma_m, track.lead_position_systematic_m)[moving]
    assert error.std() < 2.0 * np.sqrt(np.mean(stated**2))
