"""The make targets, the lock, the file for hosted machines and Snakemake's profiles name what is here."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

# Setting up from a bare clone, as far as it can be tried without the network: the make targets and the lock.
from vinetrack.pipeline.stages import STAGES

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


# The file for hosted machines and the profiles of Snakemake name what is here: versions, files, targets, options.


TEXT = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
JOBS = yaml.safe_load(TEXT)["jobs"]


def commands() -> str:
    """Every line that a job runs."""
    return "\n".join(step["run"] for job in JOBS.values() for step in job["steps"] if "run" in step)


def test_versions_of_python_begin_with_the_oldest_that_is_supported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["requires-python"] == f">={JOBS['tests']['strategy']['matrix']['python'][0]}"


def test_files_extras_and_targets_that_jobs_name_exist() -> None:
    run = commands()
    for path in re.findall(r"[\w./-]+\.(?:py|lock)\b", run):
        assert (ROOT / path).is_file(), path
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for line in re.findall(r"^make (.+)$", run, re.MULTILINE):
        assert set(line.split()) <= targets
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for named in re.findall(r'"\.\[(.+?)\]"', run):
        assert set(named.split(",")) <= set(extras)


@pytest.mark.parametrize("profile", ["default", "slurm"])
def test_profiles_hold_options_that_snakemake_knows(profile: str) -> None:
    from snakemake.cli import get_argument_parser

    if profile == "slurm":
        pytest.importorskip("snakemake_executor_plugin_slurm")
    known = {word.lstrip("-") for action in get_argument_parser()._actions for word in action.option_strings}
    settings = yaml.safe_load((ROOT / "profiles" / profile / "config.yaml").read_text(encoding="utf-8"))
    assert set(settings) <= known


def test_the_profile_for_a_cluster_names_rules_that_are_there() -> None:
    settings = yaml.safe_load((ROOT / "profiles" / "slurm" / "config.yaml").read_text(encoding="utf-8"))
    assert set(settings["set-resources"]) <= set(STAGES)
