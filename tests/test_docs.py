"""Pages, docstrings, lock and profiles: links lead somewhere, commands exist and print what is shown, examples run."""

import doctest
import importlib
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer.main
import yaml
from commanded import Shown, pieces, printed, run, succeed
from hand_sheet import one_vine
from own_effect import PAGE as OWN_EFFECT
from own_effect import block, write_effect
from PIL import Image

import vinetrack
from vinetrack.cli.main import app
from vinetrack.pipeline.workflow import STAGES

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def links(page: Path) -> list[str]:
    found = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    return [link.split("#")[0] for link in found if not link.startswith(("http:", "https:", "#"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere_pictures_are_small_and_nothing_names_the_machine(page):
    assert [link for link in links(page) if not (page.parent / link).exists()] == []
    assert re.findall(r"(?<![\w.])/(?:tmp|home|root|work|Users)\b", page.read_text(encoding="utf-8")) == []
    for path in (page.parent / name for name in links(page) if name.endswith((".png", ".webp"))):
        assert path.stat().st_size < 200_000, path
        with Image.open(path) as image:
            assert min(image.size) > 200, path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_on_the_page_exist_with_their_options(page):
    text = page.read_text(encoding="utf-8")
    lines = [line.strip().removeprefix("$ ") for line in text.splitlines() if line.startswith("    ")]
    for line in lines:
        words = line.removeprefix(".venv/bin/")
        if not words.startswith("vinetrack ") or words.endswith("\\"):
            continue
        arguments = shlex.split(words.split("|")[0])[1:]
        command = COMMANDS.get(arguments[0])
        if command is None:
            assert arguments[0].startswith(("--", "0", "1")), line
            continue
        command = getattr(command, "commands", {}).get(arguments[1], command) if len(arguments) > 1 else command
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        asked = {word.split("=")[0] for word in arguments if re.match(r"--\w", word)}
        assert asked - {"--help"} <= known, line


def test_every_page_of_the_docs_is_reached_from_the_readme_and_is_in_the_navigation_once():
    names = [page.name for page in PAGES[1:]]
    assert set(names) <= {Path(link).name for link in links(PAGES[0])}
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    assert sorted(re.findall(r"[\w-]+\.md\b", navigation)) == sorted(names)


def test_the_readme_is_short_and_shows_a_result_and_every_command_a_person_gives():
    text = PAGES[0].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    assert "![" in text.split("\n## ")[0]
    for name, command in COMMANDS.items():
        if command.rich_help_panel is None or "Stages" not in str(command.rich_help_panel):
            assert f"`{name}" in text, name


def test_the_citation_and_the_changelog_name_the_version_of_the_package():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    released = re.findall(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [vinetrack.__version__]
    assert released[:1] == [vinetrack.__version__]


def test_the_reference_holds_all_that_the_package_offers():
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    offered = set(vinetrack.__all__) - {"__version__", "effects", "FitError"}
    assert not {name for name in offered if f".{name}\n" not in text}


# docs/design.md: its commands print what stands below them, its pictures are made by them, its Python runs.
DESIGN = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
QUICK = [
    piece for piece in pieces(DESIGN) if isinstance(piece, Shown) and not {"campaign", "vine"} & {*piece.arguments}
]


@pytest.mark.parametrize("shown", QUICK, ids=lambda shown: " ".join(shown.arguments[:4]))
def test_a_command_prints_what_stands_below_it(shown, tmp_path, monkeypatch):
    """To 2 %: another processor may round a draw to the other side."""
    monkeypatch.chdir(tmp_path)
    now = printed(shown)
    assert NUMBER.sub("#", " ".join(now.split())) == NUMBER.sub("#", " ".join(shown.output.split()))
    expected = [float(number) for number in NUMBER.findall(shown.output)]
    assert [float(number) for number in NUMBER.findall(now)] == pytest.approx(expected, rel=0.02, abs=2e-4)


def test_the_python_on_the_page_runs():
    code = re.search(r"```python\n(.*?)```", DESIGN, re.DOTALL)
    assert code is not None
    known: dict[str, object] = {}
    exec(code[1].replace("vt.predictive_inputs(trial))  ", "vt.predictive_inputs(trial), samples=50)  "), known)
    assert known["prediction"].table["unit"].tolist()[0] == "m/s"  # type: ignore[attr-defined]


# docs/own_effect.md: its effect and settings work as they stand there.
@pytest.fixture
def with_own_effect(tmp_path):
    write_effect(one_vine(tmp_path / "mine"))
    (tmp_path / "mine" / "experiment.yaml").write_text(block("yaml"), encoding="utf-8")
    return tmp_path / "mine"


def test_its_effect_is_printed_as_shown(with_own_effect):
    shown = next(piece for piece in pieces(OWN_EFFECT.read_text(encoding="utf-8")) if isinstance(piece, Shown))
    assert shown.arguments == ("effects", "spring_line", "--experiment", "my_experiment")
    said = run("effects", "spring_line", "--experiment", with_own_effect).stdout
    assert said.strip().replace(str(with_own_effect), "my_experiment") == shown.output


@pytest.mark.slow
def test_its_effect_goes_through_every_stage_into_the_provenance(with_own_effect, tmp_path):
    results = tmp_path / "results"
    for stage in STAGES:
        succeed(stage, with_own_effect, results, "--settings", '{"figures": {"dpi": 50}}')
    assert "spring_line" in json.loads((results / "fit.json").read_text())["model"]
    assert "spring_line.py" in json.loads((results / "provenance.json").read_text())["inputs"]


# Examples in docstrings say what happens; tests/test_architecture.py sees to it that there are some.
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "vinetrack").rglob("*.py")
    if path.name != "__init__.py" and ">>> " in path.read_text(encoding="utf-8")
)
FITTED = ("vinetrack.interface", "vinetrack.inference.fit", "vinetrack.inference.errors")


@pytest.mark.parametrize("name", [pytest.param(m, marks=[pytest.mark.slow] * (m in FITTED)) for m in MODULES])
def test_the_examples_of_a_module_say_what_happens(name):
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for test in doctest.DocTestFinder().find(importlib.import_module(name), name):
        runner.run(test, out=said.append)
    assert not said, "".join(said)


# The lock, the file for hosted machines and the profiles of Snakemake name what is here.
def test_everything_the_project_asks_for_is_locked_with_hashes_and_no_index_and_no_path():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

    def locked(lock: str) -> set[str]:
        return set(re.findall(r"^([a-z0-9][a-z0-9._-]*)==", lock, flags=re.MULTILINE))

    lock, docs = ((ROOT / f"requirements{which}.lock").read_text(encoding="utf-8") for which in ("", "-docs"))
    wanted = [one for part in (project["dependencies"], *project["optional-dependencies"].values()) for one in part]
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
