"""README and docs: links and pictures lead somewhere, commands exist, nothing names the machine it was written on."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer.main
from doc_commands import Shown, pieces

from vinetrack.cli.main import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LARGEST_PICTURE_BYTES = 200_000
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def links(page: Path) -> list[str]:
    found = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    return [link.split("#")[0] for link in found if not link.startswith(("http:", "https:", "#"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    assert [link for link in links(page) if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pictures_are_small_and_open(page: Path) -> None:
    from PIL import Image

    for name in links(page):
        if name.endswith((".png", ".webp")):
            path = page.parent / name
            assert path.stat().st_size < LARGEST_PICTURE_BYTES, name
            with Image.open(path) as image:
                assert min(image.size) > 200, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_on_the_page_exist_with_their_options(page: Path) -> None:
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


def test_every_page_of_the_docs_is_reached_from_the_readme() -> None:
    assert {page.name for page in PAGES[1:]} <= {Path(link).name for link in links(PAGES[0])}


def test_the_readme_is_short_and_shows_a_result_and_every_command_a_person_gives() -> None:
    text = PAGES[0].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    assert "![" in text.split("\n## ")[0]
    for name, command in COMMANDS.items():
        if command.rich_help_panel is None or "Stages" not in str(command.rich_help_panel):
            assert f"`{name}" in text, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_page_names_a_folder_of_the_machine_it_was_written_on(page: Path) -> None:
    assert re.findall(r"(?<![\w.])/(?:tmp|home|root|work|Users)\b", page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("name", ["tutorial", "own_effect", "design"])
def test_every_command_that_a_page_runs_shows_what_it_prints(name: str) -> None:
    shown = [piece for piece in pieces((ROOT / "docs" / f"{name}.md").read_text("utf-8")) if isinstance(piece, Shown)]
    assert shown
    assert [one.lines[0] for one in shown if not one.output] == []


def test_the_citation_and_the_changelog_name_the_version_of_the_package() -> None:
    import vinetrack

    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    released = re.findall(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [vinetrack.__version__]
    assert released[:1] == [vinetrack.__version__]
