"""Examples in docstrings say what happens; those of names of `vinetrack` itself run in `interface`."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import vinetrack

ROOT = Path(vinetrack.__file__).parent
ELSEWHERE = {f"{home}.{name}" for name, home in vinetrack._HOMES.items()}
MODULES = sorted(
    ".".join(("vinetrack", *path.relative_to(ROOT).with_suffix("").parts))
    for path in ROOT.rglob("*.py")
    if path.name != "__init__.py" and ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_say_what_happens(name):
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for test in doctest.DocTestFinder().find(importlib.import_module(name), name):
        if test.name not in ELSEWHERE:
            runner.run(test, out=said.append)
    assert not said, "".join(said)
