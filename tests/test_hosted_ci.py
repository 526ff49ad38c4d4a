"""The file for hosted machines and the profiles of Snakemake name what is here: versions, files, targets, options."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
JOBS = yaml.safe_load(TEXT)["jobs"]


def commands() -> str:
    """Every line that a job runs."""
    return "\n".join(step["run"] for job in JOBS.values() for step in job["steps"] if "run" in step)


def test_versions_of_python_begin_with_the_oldest_that_is_supported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["requires-python"] == f">={JOBS['tests']['strategy']['matrix']['python'][0]}"


def test_jobs_run_on_linux_macos_and_windows_on_two_kinds_of_processor() -> None:
    matrix = JOBS["tests"]["strategy"]["matrix"]
    systems = {*matrix["system"], *(more["system"] for more in matrix["include"])}
    assert {"ubuntu-24.04", "ubuntu-24.04-arm", "macos-14", "windows-2022"} <= systems


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
    workflow = (ROOT / "vinetrack" / "pipeline" / "Snakefile").read_text(encoding="utf-8")
    rules = set(re.findall(r"^ *rule (\w+):", workflow, re.MULTILINE))
    grouped = dict(entry.split("=") for entry in settings["groups"])
    assert {*settings["set-resources"], *grouped} <= rules
    assert {entry.split("=")[0] for entry in settings["group-components"]} == set(grouped.values())
