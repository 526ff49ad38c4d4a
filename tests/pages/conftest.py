"""One small results folder for the explorer, and a folder of rendered clips for the set-up page."""

import pytest
from explorer_campaign import SMALL, make_experiment, make_results
from plain_scene import Plan, plain_scene, write_video

from vinetrack.pages.page import open_campaign

CLIPS = ("d15 24kPa 1.mp4", "d15 30kPa 1.mp4")


@pytest.fixture(scope="session")
def small_results(tmp_path_factory):
    """Six trials of one vine, three conditions, two replicates each."""
    folder = tmp_path_factory.mktemp("explorer")
    return make_results(make_experiment(folder / "vines", SMALL), folder / "results" / "vines")


@pytest.fixture(scope="session")
def campaign(small_results):
    """The same, opened."""
    return open_campaign(small_results)


@pytest.fixture(scope="session")
def rendered(tmp_path_factory):
    """Two clips of a straight tube, 480 × 160 px, and nothing else."""
    folder = tmp_path_factory.mktemp("rendered")
    for seed, name in enumerate(CLIPS):
        plan = Plan(
            seed=seed, width=480, height=160, from_px=(20, 80), start_px=40, end_px=400, speed=14 + 4 * seed, radius=20
        )
        write_video(folder / name, plain_scene(plan).frames)
    return folder


@pytest.fixture
def clips(rendered, tmp_path):
    """The same, to write in."""
    folder = tmp_path / "campaign"
    folder.mkdir()
    for name in CLIPS:
        (folder / name).write_bytes((rendered / name).read_bytes())
    return folder
