"""Own effects are programs: named with file and hash before they run the first time, remembered by their content."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest

from vinetrack.effects import EffectError, air_drag, load_effect


@pytest.fixture
def effect_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return Path(shutil.copy(air_drag.path, tmp_path / "wake.py"))


def test_it_is_named_with_its_hash_before_it_runs(effect_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    effect_file.write_text("raise SystemError")
    with pytest.raises(EffectError):
        load_effect(effect_file)
    digest = hashlib.sha256(effect_file.read_bytes()).hexdigest()
    assert capsys.readouterr().err.startswith(f"{effect_file} (sha256 {digest}) runs for the first time")


def test_it_is_remembered_until_it_changes(effect_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load_effect(effect_file)
    capsys.readouterr()
    load_effect(effect_file)
    assert capsys.readouterr().err == ""
    effect_file.write_text(effect_file.read_text() + "\n# changed\n")
    load_effect(effect_file)
    assert "runs for the first time" in capsys.readouterr().err


def test_where_only_known_ones_may_run_a_new_one_is_not_run(effect_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VINETRACK_OWN_EFFECTS", "known")
    effect_file.write_text("from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n")
    with pytest.raises(EffectError, match=r"wake\.py: has never run here \(sha256 [0-9a-f]{64}\)"):
        load_effect(effect_file)
    assert not effect_file.with_suffix(".ran").exists()


@pytest.mark.usefixtures("effect_file")
def test_the_catalogue_is_not_named(capsys: pytest.CaptureFixture[str]) -> None:
    load_effect(air_drag.path)
    assert capsys.readouterr().err == ""


def test_a_home_that_cannot_be_written_stops_nothing(effect_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    assert load_effect(effect_file).name == "wake"
