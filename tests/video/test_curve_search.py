"""The curve along which a vine grew, found from its motion; straight vines keep their straight axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bent_scene import BENDS, BentPlan, BentScene, bent_scene
from plain_scene import HARDER, Plan, plain_scene, write_images

from vinetrack.core.records import PictureAxis, Trial
from vinetrack.experiment.settings import ExperimentSettings, MmPerPx
from vinetrack.video.axis import find_axis
from vinetrack.video.curved_axis import CurvedAxis, find_curve, find_growth_axis, front_share_of_picture
from vinetrack.video.frames import Frames, Recording
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.survey import measure_recording, proposed_axis
from vinetrack.video.track import Tracking, track_frames


@pytest.fixture(scope="module", params=["quarter", "gentle"])
def bent(request: pytest.FixtureRequest) -> BentScene:
    return bent_scene(BentPlan(seed=4, speed=22.0, **BENDS[request.param]))


def followed(frames: np.ndarray, exposure: float) -> Tracking:
    n, height, width = frames.shape
    recording = Recording(Path("bent.mp4"), "container", width, height, 8, n)
    decoded = Frames(recording, recording.whole, frames, np.arange(n), np.zeros(n, dtype=bool))
    trial = Trial(name="bent", capture_fps=1000.0, exposure_s=exposure / 1000, m_per_px=1e-3)
    return track_frames(decoded, trial, 1000.0)


def test_a_bent_vine_is_followed_along_the_curve_that_is_found(bent: BentScene) -> None:
    tracking = followed(bent.frames, bent.plan.exposure)
    assert isinstance(tracking.axis, CurvedAxis)
    track = tracking.track
    used = bent.moving & track.usable
    assert used.sum() == bent.moving.sum()
    error = track.edge_px[used] - bent.edge_px[used]
    assert error.std() < 0.4
    away = np.hypot(*(tracking.axis.points(track.edge_px[used]) - bent.places(bent.edge_px[used])).T)
    assert away.max() < 2.5
    assert not any("bends or sweeps" in note for note in track.notes)
    assert any("along a curve that was found" in note for note in track.notes)


def test_a_calibrated_recording_says_that_its_curve_was_found_and_not_where_it_was_drawn(tmp_path: Path) -> None:
    scene = bent_scene(BentPlan(seed=4, speed=22.0, **BENDS["quarter"]))
    video = write_images(tmp_path / "bent", scene.frames)
    trial = Trial(name="bent", video=video, capture_fps=1000.0, exposure_s=scene.plan.exposure / 1000)
    settings = ExperimentSettings(calibration=MmPerPx(kind="mm_per_px", mm_per_px=1.0))
    drawn = [(float(x), float(y)) for x, y in scene.places(np.linspace(8.0, scene.arc_px[-1] - 8.0, 6))]
    given = PictureAxis(drawn[0], drawn[-1], via_px=tuple(drawn[1:-1]))
    for axis, count in ((None, 1), (given, 0)):
        tracking = measure_recording(replace(trial, axis=axis), settings, tmp_path).tracking
        assert isinstance(tracking.axis, CurvedAxis)
        assert sum("along a curve that was found" in note for note in tracking.track.notes) == count


def test_its_curve_explains_nearly_all_that_changes_and_points_along_the_growth(bent: BentScene) -> None:
    small = SmallPictures(bent.frames)
    curve = find_curve(small)
    assert curve is not None
    assert front_share_of_picture(small, curve) > 0.95
    along, across = curve.along_and_across(bent.places(np.array([100.0, 300.0, 500.0])))
    assert (np.diff(along) > 150).all()
    assert np.abs(across).max() < 8
    assert isinstance(proposed_axis(bent.frames), CurvedAxis)


@pytest.mark.parametrize("name", ["door", "shake", "reversal", "oblique", "payload"])
def test_a_straight_vine_keeps_the_straight_axis_it_had(name: str) -> None:
    plan = Plan(**({"seed": 5, "width": 640, "end_px": 540.0} | HARDER[name]))
    small = SmallPictures(plain_scene(plan).frames)
    assert find_growth_axis(small, small.frames) == find_axis(small)


@pytest.mark.parametrize(("length_px", "width_px"), [(21, 2), (3, 10), (9, 3), (14, 1), (40, 40)])
def test_a_band_hardly_longer_than_wide_has_no_curve(length_px: int, width_px: int) -> None:
    rng = np.random.default_rng(2211)
    for _ in range(10):
        frames = rng.normal(60, 2, (20, 99, 134))
        x, y = rng.integers(0, 90), rng.integers(0, 55)
        for t in range(20):
            frames[t, y : y + width_px, x : x + length_px * t // 20 + 1] += 100
        small = SmallPictures(np.clip(frames, 0, 255).astype(np.uint8))
        curve = find_curve(small)
        assert curve is None or curve.length_px > 2 * curve.width_px
