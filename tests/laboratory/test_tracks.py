"""The virtual laboratory as tracks: repeatable, with the statistics it states, its truth out of the analysis' sight."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.folder import check_experiment, read_experiment
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory import __main__ as command
from vinetrack.laboratory.tracks import (
    GroundTruth,
    VirtualTrial,
    grow,
    read_ground_truth,
    write_experiment,
    write_tracks,
    write_truth,
)
from vinetrack.laboratory.vine_campaigns import (
    PAPER_B,
    campaign,
    damping_pressures_kPa,
    damping_values,
    isometric_vine,
    paper_damping,
    paper_payload,
)
from vinetrack.tracks.importers import load_track

ROOT = Path(__file__).parents[2]


def few() -> list[Trial]:
    return list(with_names(campaign(isometric_vine(4), (14, 20, 28), 2, prefix="R4_")))


def nature(**changes: object) -> GroundTruth:
    return GroundTruth(values=damping_values(few()), **changes)  # type: ignore[arg-type]


EXACT = {"damping_scatter": 0.0, "pressure_scatter": 0.0, "noise_m": 0.0}


def same(one: VirtualTrial, other: VirtualTrial) -> bool:
    return np.array_equal(one.track.lead_position_m, other.track.lead_position_m) and one.release_s == other.release_s


# ---- campaigns ----


def test_the_damping_protocol_is_that_of_the_paper() -> None:
    trials = paper_damping()
    assert len(trials) == 4 * 10 * 4
    assert len({trial.name for trial in trials}) == 160
    assert len({trial.vine for trial in trials}) == 4
    assert len({trial.condition for trial in trials}) == 40
    assert {trial.payload_kg for trial in trials} == {0.0}
    largest = [trial for trial in trials if trial.diameter_m == pytest.approx(0.024)]
    assert {trial.thickness_m for trial in largest} == {200e-6}
    assert {round(trial.length_m, 9) for trial in largest} == {0.28}


@pytest.mark.parametrize("scale", PAPER_B)
def test_pressures_span_a_quarter_metre_a_second_to_where_plateaus_end(scale: int) -> None:
    pressures_kPa = damping_pressures_kPa(scale)
    assert pressures_kPa.shape == (10,)
    assert (np.diff(pressures_kPa) > 0).all()
    force = (pressures_kPa - 3.0) * 1e3 * math.pi * (6e-3 * scale) ** 2 / 4
    speed = (force / PAPER_B[scale]) ** (1 / 0.37)
    assert speed[0] == pytest.approx(0.25, rel=0.05)
    assert 3 < speed[-1] < 20


def test_the_payload_protocol_has_both_figures() -> None:
    trials = paper_payload()
    by_thickness = {t: {trial.payload_kg for trial in trials if trial.thickness_m == t} for t in (150e-6, 200e-6)}
    assert by_thickness[200e-6] == {0.0356}
    assert len(by_thickness[150e-6]) == 4
    assert len(trials) == 4 * (3 + 12)


# ---- seeds ----


def test_the_same_seed_gives_the_same_numbers_and_another_others() -> None:
    trials = few()
    one, again, other = grow(trials, nature(seed=3)), grow(trials, nature(seed=3)), grow(trials, nature(seed=4))
    assert all(same(a, b) for a, b in zip(one, again, strict=True))
    assert not any(same(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("missing", [0, 3, 5])
def test_leaving_a_trial_out_changes_no_other(missing: int) -> None:
    trials = few()
    rest = [trial for i, trial in enumerate(trials) if i != missing]
    whole = {grown.stated.name: grown for grown in grow(trials, nature(seed=5, yield_error_kPa=0.2))}
    for grown in grow(rest, nature(seed=5, yield_error_kPa=0.2)):
        assert same(grown, whole[grown.stated.name])
        assert grown.true == whole[grown.stated.name].true


def test_leaving_a_vine_out_changes_no_other() -> None:
    thick, thin = few(), list(with_names(campaign(isometric_vine(2), (20, 30), 1, prefix="R2_")))
    truth = GroundTruth(values=damping_values([*thick, *thin]), seed=2, yield_error_kPa=0.3)
    both = {grown.stated.name: grown for grown in grow([*thick, *thin], truth)}
    for grown in grow(thin, truth):
        assert grown.true.yield_pressure_Pa == both[grown.stated.name].true.yield_pressure_Pa != 3e3
        assert same(grown, both[grown.stated.name])


# ---- what nature does ----


def test_without_scatter_and_noise_a_track_is_the_model_seen_from_an_unknown_origin() -> None:
    hidden = nature(seed=1, **EXACT)
    for grown in grow(few(), hidden):
        truth = simulate(hidden.model(), grown.stated, grown.track.time_s - grown.release_s)
        np.testing.assert_allclose(grown.track.lead_position_m - grown.origin_m, truth.lead_position_m, atol=1e-12)
        assert grown.true == grown.stated
        assert -0.05 <= grown.origin_m <= 0.05
        assert grown.track.time_s[14] <= grown.release_s <= grown.track.time_s[40]
        frames = np.diff(grown.track.time_s)
        np.testing.assert_allclose(frames, 1 / 1069, rtol=1e-9)


def test_a_track_ends_a_few_frames_after_growth() -> None:
    for grown in grow(few(), nature(seed=1, frames_after_end=6)):
        full = grown.true_lead_position_m == grown.stated.length_m
        assert full.sum() == 6


def test_scatter_of_damping_and_pressure_is_as_stated() -> None:
    """Standard deviations of 600 draws are good to 3 % (one sigma); the two do not go together."""
    trials = list(with_names(campaign(isometric_vine(4), (28,), 600)))
    hidden = nature(seed=7, longest_frames=50, release_frames=(15, 40))
    values = damping_values(trials)
    grown = grow(trials, replace(hidden, values=values))
    B = np.array([one.damping for one in grown]) / 6.44 - 1
    P = np.array([one.true.pressure_Pa for one in grown]) / 28e3 - 1
    assert B.std() == pytest.approx(0.03, rel=0.1)
    assert P.std() == pytest.approx(0.01, rel=0.1)
    assert abs(B.mean()) < 4 * 0.03 / math.sqrt(600)
    assert abs(P.mean()) < 4 * 0.01 / math.sqrt(600)
    assert abs(np.corrcoef(B, P)[0, 1]) < 4 / math.sqrt(600)
    release = np.array([one.release_s for one in grown]) * 1069
    assert release.min() >= 14
    assert release.max() <= 40
    assert np.std(release % 1) == pytest.approx(math.sqrt(1 / 12), rel=0.1)


def test_the_yield_pressure_is_wrong_by_the_same_for_all_trials_of_a_vine() -> None:
    grown = grow(few(), nature(seed=7, yield_error_kPa=0.2))
    errors = {one.true.yield_pressure_Pa - one.stated.yield_pressure_Pa for one in grown}
    assert len(errors) == 1
    assert 0 < abs(errors.pop()) < 1e3


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_noise_has_the_stated_deviation_and_correlation(correlation: float) -> None:
    """Rest frames alone, 4000 of them: errors of 2 % for the deviation (or more), 0.016 for the latter."""
    hidden = nature(
        seed=11,
        noise_m=2e-4,
        noise_correlation=correlation,
        release_frames=(4000, 4000),
        longest_frames=4000,
    )
    noise = grow(few()[:1], hidden)[0]
    assert (noise.true_lead_position_m == 0).all()
    residual = noise.track.lead_position_m - noise.origin_m
    assert residual.std() == pytest.approx(2e-4, rel=0.08)
    assert abs(residual.mean()) < 2e-5
    centred = residual - residual.mean()
    assert centred[1:] @ centred[:-1] / (centred @ centred) == pytest.approx(correlation, abs=0.06)
    assert centred[2:] @ centred[:-2] / (centred @ centred) == pytest.approx(correlation**2, abs=0.08)


def test_dropped_frames_are_gone_and_nobody_is_told() -> None:
    trials = few()
    clean, torn = grow(trials, nature(seed=9, **EXACT)), grow(trials, nature(seed=9, dropped=0.05, **EXACT))
    assert sum(len(one.dropped) for one in torn) > 10
    for whole, holed in zip(clean, torn, strict=True):
        kept = np.delete(np.arange(whole.track.time_s.size), holed.dropped)
        np.testing.assert_array_equal(holed.track.lead_position_m, whole.track.lead_position_m[kept])
        np.testing.assert_array_equal(holed.track.time_s, whole.track.time_s[: kept.size])
        assert (whole.true_lead_velocity_m_s[list(holed.dropped)] > 0).all()
        assert not holed.track.flag.any()


def test_repeated_frames_show_the_one_before_to_the_last_digit() -> None:
    trials = few()
    torn = grow(trials, nature(seed=9, repeated=0.3))
    assert sum(len(one.repeated) for one in torn) > 30
    following = 0
    for one in torn:
        rows = np.array(one.repeated)
        following += int((np.diff(rows) == 1).sum())
        np.testing.assert_array_equal(one.track.lead_position_m[rows], one.track.lead_position_m[rows - 1])
        np.testing.assert_array_equal(one.true_lead_position_m[rows], one.true_lead_position_m[rows - 1])
        others = np.setdiff1d(np.arange(1, one.track.time_s.size), rows)
        assert (np.diff(one.track.lead_position_m)[others - 1] != 0).all()
    assert following > 3


def test_a_recorded_pressure_is_what_drove_it_and_noise() -> None:
    trials = [replace(trial, chamber_m3=1e-3) for trial in few()]
    effects = (*GroundTruth().effects, "reservoir_depletion")
    values = {**damping_values(trials), "reservoir_depletion.gamma": 1.0}
    quiet = GroundTruth(effects=effects, values=values, trace_sigma_kPa=0.0, seed=1)
    for grown in grow(trials, quiet):
        gauge, y = grown.track.pressure_Pa, grown.true_lead_position_m
        assert gauge is not None
        volume = 1e-3 + math.pi * 0.012**2 * y
        truth = (grown.true.pressure_Pa + 101_325) * 1e-3 / volume - 101_325
        np.testing.assert_allclose(gauge, truth, rtol=1e-9)
        assert gauge[0] - gauge[-1] > 1e3
    loud = grow(trials[:1], replace(quiet, trace_sigma_kPa=0.1))[0]
    assert loud.track.pressure_Pa is not None
    assert np.std(loud.track.pressure_Pa - loud.true_pressure_Pa) == pytest.approx(100, rel=0.3)


def test_a_hidden_measurement_effect_shows_in_the_track_and_not_in_the_truth() -> None:
    values = {**damping_values(few()), "length_scale.eps": 0.05}
    wrong = GroundTruth(effects=(*GroundTruth().effects, "length_scale"), values=values, seed=1, **EXACT)  # type: ignore[arg-type]
    for grown in grow(few()[:1], wrong):
        seen = grown.track.lead_position_m - grown.origin_m
        np.testing.assert_allclose(seen, 1.05 * grown.true_lead_position_m, atol=1e-12)


# ---- files ----


def test_what_is_written_reads_back_without_a_word(tmp_path: Path) -> None:
    grown = grow(few(), nature(seed=1, trace_sigma_kPa=0.05, stated_sigma=True))
    write_experiment(grown, tmp_path / "e", "chamber_l: 3.7\n")
    assert check_experiment(tmp_path / "e") == []
    experiment = read_experiment(tmp_path / "e", strict=True)
    assert [trial.name for trial in experiment.trials] == [one.stated.name for one in grown]
    for trial, one in zip(experiment.trials, grown, strict=True):
        assert (trial.vine, trial.condition) == (one.stated.vine, one.stated.condition)
        assert trial.pressure_Pa == pytest.approx(one.stated.pressure_Pa, rel=1e-12)
        track = load_track(trial)
        np.testing.assert_allclose(track.lead_position_m, one.track.lead_position_m, atol=1e-8)
        np.testing.assert_allclose(np.diff(track.time_s), np.diff(one.track.time_s), atol=2e-9)
        np.testing.assert_allclose(track.lead_position_sigma_m, 1e-4)
        assert track.pressure_Pa is not None


def test_no_truth_is_among_the_files_of_an_experiment(tmp_path: Path) -> None:
    grown = grow(few(), nature(seed=1))
    write_experiment(grown, tmp_path / "e")
    names = {str(path.relative_to(tmp_path / "e")) for path in (tmp_path / "e").rglob("*") if path.is_file()}
    assert names == {"trials.csv", *(f"tracks/{one.stated.name}.csv" for one in grown)}
    text = "".join((tmp_path / "e" / name).read_text() for name in names)
    assert not any(repr(one.true.pressure_Pa)[:8] in text or repr(one.damping)[:8] in text for one in grown)


@pytest.mark.parametrize("place", ["truth.json", "hidden/truth.json", "tracks/deep/truth.json"])
def test_the_truth_is_never_written_inside_an_experiment(place: str, tmp_path: Path) -> None:
    grown = grow(few()[:1], nature(seed=1))
    write_experiment(grown, tmp_path / "e")
    with pytest.raises(ValueError, match="must not lie inside the experiment"):
        write_truth(grown, nature(seed=1), tmp_path / "e" / place)
    assert not (tmp_path / "e" / place).exists()


def test_the_truth_holds_what_was_hidden(tmp_path: Path) -> None:
    grown = grow(few(), nature(seed=1))
    write_truth(grown, nature(seed=1), tmp_path / "truth.json")
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["nature"]["seed"] == 1
    for one in grown:
        assert truth["trials"][one.stated.name]["B"] == one.damping
        assert truth["trials"][one.stated.name]["release_s"] == one.release_s


def test_the_demonstration_can_be_grown(tmp_path: Path) -> None:
    """Every trial of the shipped sheet, filmed or tracked, moves as the demonstration's nature says."""
    demo = read_experiment(ROOT / "data" / "demo")
    hidden = read_ground_truth(command.DEMO)
    grown = grow(demo.trials, hidden)
    assert len(grown) == len(demo.trials) > 5
    for one in grown:
        assert one.track.time_s.size > 30
        assert one.true_lead_position_m[-1] > 0.9 * one.stated.length_m
    write_tracks(grown, tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {trial.name for trial in demo.trials}


def test_the_command_grows_a_sheet_and_puts_the_truth_where_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_experiment(grow(few(), nature(seed=1)), tmp_path / "e")
    hidden = tmp_path / "nature.yaml"
    hidden.write_text("values: {eversion_damping.B: 6.44}\nrelease_frames: [20, 21]\nseed: 4\n", encoding="utf-8")
    before = (tmp_path / "e" / "tracks" / "R4_14kPa_1.csv").read_bytes()
    command.main([str(tmp_path / "e"), "--nature", str(hidden), "--truth", str(tmp_path / "out" / "truth.json")])
    assert "6 trials" in capsys.readouterr().out
    assert (tmp_path / "e" / "tracks" / "R4_14kPa_1.csv").read_bytes() != before
    assert json.loads((tmp_path / "out" / "truth.json").read_text())["nature"]["release_frames"] == [20, 21]


# ---- the analysis never looks ----

SPY = """
import json, os, sys

seen = []

def watch(event, arguments):
    looks = event in ("open", "os.listdir", "os.scandir")
    if looks and isinstance(arguments[0], (str, bytes, os.PathLike)):
        seen.append(os.path.realpath(os.fsdecode(arguments[0])))

sys.addaudithook(watch)
experiment, results, truth = sys.argv[1:]

from typer.testing import CliRunner
from vinetrack.cli.main import app

def run(*arguments):
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code == 0, done.output

stages = {command.name or command.callback.__name__ for command in app.registered_commands}
run("check", experiment)
run("tracks", experiment, results)
if "gather" in stages:
    run("gather", experiment, results)
run("damping", results)
run("model", experiment, results)
run("figures", experiment, results, "--of", "campaign")

from vinetrack.experiment.folder import read_experiment
from vinetrack.dynamics.model import base_model
from vinetrack.kinematics.summary import summarise_trial
from vinetrack.experiment.settings import RunSettings
from vinetrack.tracks.importers import load_track

trial = read_experiment(experiment).trials[0]
summarise_trial(trial, load_track(trial), RunSettings(), base_model())

def told():
    return {"seen": list(seen), "modules": [name for name in sys.modules if "laboratory" in name]}

blind = told()
import vinetrack.laboratory.tracks
open(truth).close()
print(json.dumps([blind, told()]))
"""


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:
    """Its folder, and what a whole analysis in a process of its own had opened and loaded: before a peek, and after."""
    root = tmp_path_factory.mktemp("watched").resolve()
    trials = list(with_names(campaign(isometric_vine(4), (11, 14, 17), 2, prefix="R4_")))
    hidden = nature(seed=1, noise_m=3e-5)
    grown = grow(trials, replace(hidden, values=damping_values(trials)))
    write_experiment(grown, root / "e")
    write_truth(grown, hidden, root / "truth.json")
    command_line = [sys.executable, "-c", SPY, *(str(root / name) for name in ("e", "results", "truth.json"))]
    done = subprocess.run(command_line, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stderr
    return root, json.loads(done.stdout.splitlines()[-1])


def truths(seen: list[str]) -> set[Path]:
    paths = {Path(path) for path in seen}
    return {path for path in paths if "truth" in path.name or path.name == "demo.yaml" or "laboratory" in path.parts}


def test_the_analysis_never_opens_the_truth_nor_loads_the_laboratory(watched: tuple[Path, list[dict]]) -> None:
    root, (blind, _) = watched
    seen = {Path(path) for path in blind["seen"]}
    assert root / "e" / "trials.csv" in seen
    assert root / "e" / "tracks" / "R4_11kPa_1.csv" in seen
    assert (root / "results" / "damping.json").is_file()
    assert truths(blind["seen"]) == set()
    assert blind["modules"] == []
    real = {path for path in seen if root in path.parents and (root / path.relative_to(root).parts[0]).exists()}
    assert {path.relative_to(root).parts[0] for path in real} == {"e", "results"}


def test_the_watch_would_see_a_peek(watched: tuple[Path, list[dict]]) -> None:
    root, (_, peeked) = watched
    assert root / "truth.json" in truths(peeked["seen"])
    assert "vinetrack.laboratory.tracks" in peeked["modules"]
