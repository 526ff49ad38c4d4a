"""`vinetrack track`: one recording to a table, a strip and a clip; every obvious mistake is one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pytest
from click.testing import Result
from plain_scene import Plan, Scene, plain_scene, write_images, write_video
from typer.testing import CliRunner

from vinetrack.cli.main import app


@pytest.fixture(scope="module")
def scene() -> Scene:
    return plain_scene(Plan(seed=20940, width=640, height=160, from_px=(30.0, 80.0), end_px=560.0, radius=22.0))


@pytest.fixture(scope="module")
def clip(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("films") / "vine.mp4", scene.frames, options={"crf": "12"})


def track(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["track", *map(str, arguments)], catch_exceptions=False)


def refused(*arguments: object) -> str:
    """What is said on the terminal of a recording that is refused: one sentence, and nothing is written."""
    done = track(*arguments)
    assert done.exit_code == 1
    (sentence,) = done.stderr.strip().splitlines()
    return sentence


def test_the_edge_of_a_film_comes_out_in_pixels_of_the_picture(scene: Scene, clip: Path, tmp_path: Path) -> None:
    done = track(clip, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert f"{len(scene.frames)} frames of 640 × 160 px, 8 bit" in done.stdout
    assert "Capture rate unknown; it plays at 60 per second" in done.stdout
    table = pd.read_csv(tmp_path / "out" / "track.csv")
    assert list(table) == [
        "frame", "time_s", "edge_px", "edge_sigma_px", "edge_systematic_px", "x_px", "y_px", "flag",
    ]  # fmt: skip
    assert len(table) == len(scene.frames)
    assert table["time_s"].isna().all()
    off = (table["x_px"] - (scene.edge_px + 30.0))[scene.moving]
    assert float(off.abs().median()) < 0.5
    assert table["y_px"].sub(80.0).abs().max() < 1.5
    assert (tmp_path / "out" / "strip.png").stat().st_size > 10_000
    with av.open(str(tmp_path / "out" / "overlay.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) > 20


def test_rate_and_scale_give_seconds_and_metres(scene: Scene, clip: Path, tmp_path: Path) -> None:
    done = track(
        clip, "--capture-fps", 2000, "--exposure-us", 100, "--mm-per-px", 0.25, "--out", tmp_path, "--json", "-"
    )
    content = json.loads(done.stdout)
    assert content["duration_s"] == pytest.approx(len(scene.frames) / 2000)
    assert content["mm_per_px"] == 0.25
    assert content["fastest_m_s"] == pytest.approx(20 * 0.25e-3 * 2000, rel=0.05)
    table = pd.read_csv(content["written"]["table"])
    assert np.allclose(np.diff(table["time_s"]), 1 / 2000)
    assert table["time_s"][0] == pytest.approx(50e-6)
    assert np.allclose(table["position_m"], 0.25e-3 * table["edge_px"])
    assert np.allclose(table["sigma_m"], 0.25e-3 * table["edge_sigma_px"])
    assert np.allclose(table["systematic_m"], 0.25e-3 * table["edge_systematic_px"])


def test_scale_is_that_of_the_settings_of_an_experiment(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "experiment.yaml").write_text(
        "calibration: {kind: two_points, from_px: [10, 20], to_px: [410, 20], length_mm: 200}\n"
    )
    done = track(clip, "--calibration", tmp_path, "--out", tmp_path / "out", "--json", "-")
    assert json.loads(done.stdout)["mm_per_px"] == pytest.approx(0.5)


def test_a_folder_of_pictures_is_one_recording(scene: Scene, tmp_path: Path) -> None:
    folder = write_images(tmp_path / "shots", scene.frames)
    done = track(folder, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert "Capture rate unknown: without --capture-fps there are no times" in done.stdout


def test_a_wrong_path_is_told_with_the_nearest_name(clip: Path) -> None:
    assert f"did you mean {clip}?" in refused(clip.with_name("vin.mp4"))
    assert "there is no such file or folder" in refused(clip.parent / "nowhere" / "vine.mp4")


def test_a_folder_of_films_is_told_to_name_one(clip: Path) -> None:
    assert refused(clip.parent).endswith(f"a folder in which a film is; name one file, such as {clip}")


def test_an_empty_folder_is_told(tmp_path: Path) -> None:
    assert "holds no files" in refused(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("notes.txt", b"the vine grew well today\n" * 400, "a text, not a recording"),
        ("noise.mp4", bytes(range(256)) * 40, "not a video"),
        ("sheet.pdf", b"%PDF-1.7\n" + bytes(range(256)) * 40, "not a video"),
        ("empty.mp4", b"", "the file is empty"),
    ],
)
def test_what_is_no_film_is_told(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    assert words in refused(tmp_path / name)


def test_a_film_without_motion_is_told(scene: Scene, tmp_path: Path) -> None:
    still = write_video(tmp_path / "still.mp4", np.repeat(scene.frames[:1], 40, axis=0))
    assert refused(still, "--out", tmp_path / "out") == "still.mp4: nothing moves in the picture"
    assert not (tmp_path / "out").exists()


def test_two_scales_are_one_too_many(clip: Path, tmp_path: Path) -> None:
    assert "give one" in refused(clip, "--mm-per-px", 0.5, "--calibration", tmp_path)


def test_an_axis_that_is_none_is_a_fault_of_the_command(clip: Path) -> None:
    done = track(clip, "--axis", "10,20")
    assert done.exit_code == 2
    assert "--axis" in done.stderr
