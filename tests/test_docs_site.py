"""The site of the documentation leaves no page out, and the reference names only what exists."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]


def pages(entry: object) -> list[str]:
    """Files that an entry of the site's navigation names, nested ones included."""
    if isinstance(entry, str):
        return [entry]
    parts = entry.values() if isinstance(entry, dict) else entry
    return [page for part in parts for page in pages(part)]  # type: ignore[attr-defined]


def test_every_page_is_in_the_navigation_once() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert sorted(pages(site["nav"])) == sorted(path.name for path in (ROOT / "docs").glob("*.md"))


def test_the_reference_names_what_exists() -> None:
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)
    assert len(names) > 10
    for name in names:
        home, _, leaf = name.rpartition(".")
        assert hasattr(importlib.import_module(home), leaf) or importlib.import_module(name)


def test_the_reference_holds_all_that_the_package_offers() -> None:
    import vinetrack

    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    offered = set(vinetrack.__all__) - {"__version__", "effects", "FitError"}
    assert not {name for name in offered if f".{name}\n" not in text}
