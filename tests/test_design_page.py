"""docs/design.md: its commands print what stands below them, its pictures are made by them, its Python runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from doc_commands import Shown, pieces, printed, rewritten

PAGE = Path(__file__).parents[1] / "docs" / "design.md"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
COMMANDS = [piece for piece in pieces(PAGE.read_text(encoding="utf-8")) if isinstance(piece, Shown)]
QUICK = [shown for shown in COMMANDS if "campaign" not in shown.arguments and "vine" not in shown.arguments]


def test_every_kind_of_command_is_on_the_page() -> None:
    kinds = {" ".join(shown.arguments[:2]) if shown.arguments[0] == "design" else "predict" for shown in COMMANDS}
    assert kinds == {"predict", "design vine", "design reservoir"}
    assert len(QUICK) == 2


@pytest.mark.parametrize("shown", QUICK, ids=lambda shown: " ".join(shown.arguments[:4]))
def test_a_command_prints_what_stands_below_it(shown: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To 2 %: another processor may round a draw to the other side."""
    monkeypatch.chdir(tmp_path)
    now = printed(shown)
    assert NUMBER.sub("#", " ".join(now.split())) == NUMBER.sub("#", " ".join(shown.output.split()))
    expected = [float(number) for number in NUMBER.findall(shown.output)]
    assert [float(number) for number in NUMBER.findall(now)] == pytest.approx(expected, rel=0.02, abs=2e-4)


def test_pictures_on_the_page_exist_and_are_made_by_its_commands() -> None:
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", PAGE.read_text(encoding="utf-8"))
    made = [argument.removeprefix("docs/") for shown in COMMANDS for argument in shown.arguments if ".png" in argument]
    assert pictures == made
    assert all((PAGE.parent / name).is_file() for name in pictures)


def test_the_python_on_the_page_runs() -> None:
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    known: dict[str, object] = {}
    exec(code[1].replace("vt.predictive_inputs(trial))  ", "vt.predictive_inputs(trial), samples=50)  "), known)
    assert known["prediction"].table["unit"].tolist()[0] == "m/s"  # type: ignore[attr-defined]


def test_a_page_is_rewritten_with_its_output_and_nothing_else() -> None:
    page = "A page.\n\n    $ vinetrack --version\n    vinetrack 9.9\n\nMore.\n\n    not a command\n"
    again = rewritten(page)
    assert "9.9" not in again
    assert again.startswith("A page.\n\n    $ vinetrack --version\n    vinetrack ")
    assert again.endswith("\n\nMore.\n\n    not a command\n")
