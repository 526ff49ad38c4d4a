"""Setting up from a bare clone, as far as it can be tried without the network: the make targets and the lock."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")
DOCS_LOCK = (ROOT / "requirements-docs.lock").read_text(encoding="utf-8")
MAKE = shutil.which("make")

needs_make = pytest.mark.skipif(MAKE is None, reason="needs make")


def make(folder: Path, *arguments: str, path: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": path if path is not None else "/usr/bin:/bin"}
    return subprocess.run(
        [str(MAKE), *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@needs_make
@pytest.mark.parametrize("arguments", [(), ("help",)])
def test_help_is_the_default_and_lists_every_target(arguments: tuple[str, ...]) -> None:
    done = make(ROOT, *arguments)
    assert done.returncode == 0
    targets = {"help", "venv", "demo", "guide", "test", "test-all", "lint", "docs"}
    assert {line.split()[1] for line in done.stdout.splitlines()} == targets


@needs_make
def test_without_a_python_make_says_what_to_install(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "requirements.lock").touch()
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "bin").mkdir()
    done = make(tmp_path, "demo", path=str(tmp_path / "bin"))
    assert done.returncode != 0
    assert "needs Python 3.11 or newer" in done.stderr
    assert "make PYTHON=" in done.stderr
    assert not (tmp_path / ".venv").exists()


@needs_make
def test_an_old_python_is_passed_over(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "requirements.lock").touch()
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "bin").mkdir()
    old = tmp_path / "bin" / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    assert "found none" in make(tmp_path, "venv", path=str(tmp_path / "bin")).stderr


@needs_make
def test_an_installation_that_is_up_to_date_is_left_alone(tmp_path: Path) -> None:
    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "installed").touch()
    assert make(tmp_path, "--question", "venv").returncode == 0
    (tmp_path / "requirements.lock").write_text(LOCK)
    later = (tmp_path / ".venv" / "installed").stat().st_mtime + 10
    import os

    os.utime(tmp_path / "requirements.lock", (later, later))
    assert make(tmp_path, "--question", "venv").returncode == 1


def locked(lock: str = LOCK) -> dict[str, str]:
    return dict(re.findall(r"^([a-z0-9][a-z0-9._-]*)==([^ ;\\]+)", lock, flags=re.MULTILINE))


def test_everything_the_project_asks_for_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    names = {re.split(r"[<>=!~\[; ]", requirement)[0].lower().replace("_", "-") for requirement in wanted}
    assert names - set(locked()) - set(locked(DOCS_LOCK)) == set()


def test_the_site_is_built_with_the_versions_that_the_package_has() -> None:
    site = locked(DOCS_LOCK)
    assert {name: version for name, version in locked().items() if name in site and site[name] != version} == {}


def test_every_locked_version_has_hashes() -> None:
    entries = re.split(r"^(?=[a-z0-9])", LOCK, flags=re.MULTILINE)[1:]
    assert len(entries) == len(locked()) > 80
    assert all("--hash=sha256:" in entry for entry in entries)


def test_the_lock_names_no_index_and_no_path() -> None:
    assert not re.search(r"https?://|file:|^--|^-[a-z]|/", LOCK, flags=re.MULTILINE)


def test_continuous_integration_is_a_sound_script() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    subprocess.run(["bash", "-n", str(script)], check=True)
