"""The effect of docs/own_effect.md. Every test with an effect of a user's own beside the whole catalogue uses this one:
each further one would be compiled with all the others."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "own_effect.md"
NAME = "spring_line"


def block(language: str) -> str:
    """The one block of the page in this language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return str(found)


def write_effect(folder: Path) -> Path:
    """Write the effect as the page has it; its file."""
    path = folder / f"{NAME}.py"
    path.write_text(block("python"), encoding="utf-8")
    return path
