"""The lock, the file for hosted machines and Snakemake's profiles name what is here."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from vinetrack.pipeline.workflow import STAGES

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def test_everything_the_project_asks_for_is_locked_with_hashes_and_no_index_and_no_path():
    def locked(lock: str) -> set[str]:
        return set(re.findall(r"^([a-z0-9][a-z0-9._-]*)==", lock, flags=re.MULTILINE))

    lock, docs = ((ROOT / f"requirements{which}.lock").read_text(encoding="utf-8") for which in ("", "-docs"))
    wanted = [*PROJECT["dependencies"], *(name for extra in EXTRAS.values() for name in extra)]
    names = {re.split(r"[<>=!~\[; ]", requirement)[0].lower().replace("_", "-") for requirement in wanted}
    assert names - locked(lock) - locked(docs) == set()
    entries = re.split(r"^(?=[a-z0-9])", lock, flags=re.MULTILINE)[1:]
    assert len(entries) == len(locked(lock)) > 80
    assert all("--hash=sha256:" in entry for entry in entries)
    assert not re.search(r"https?://|file:|^--|^-[a-z]|/", lock + docs, flags=re.MULTILINE)


@pytest.mark.parametrize("profile", ["default", "slurm"])
def test_profiles_hold_options_that_snakemake_knows_and_rules_that_are_there(profile):
    from snakemake.cli import get_argument_parser

    if profile == "slurm":
        pytest.importorskip("snakemake_executor_plugin_slurm")
    known = {word.lstrip("-") for action in get_argument_parser()._actions for word in action.option_strings}
    settings = yaml.safe_load((ROOT / "profiles" / profile / "config.yaml").read_text(encoding="utf-8"))
    assert set(settings) <= known
    assert set(settings.get("set-resources", ())) <= set(STAGES)
