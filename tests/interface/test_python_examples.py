"""Every name that a user calls from Python shows an example in its docstring, and it does what it shows."""

from __future__ import annotations

import doctest
from collections.abc import Callable
from typing import Any

import pytest

import vinetrack as vt
from vinetrack.interface.loaded import figure_of

FUNCTIONS: dict[str, Callable[..., Any]] = {
    name: getattr(vt, name) for name in vt.__all__ if callable(getattr(vt, name))
} | {
    f"effects.{name}": getattr(vt.effects, name) for name in ("catalogue", "find_effect", "load_effect", "own_effects")
}
FUNCTIONS["plot"] = figure_of
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def test_there_are_twenty_of_them() -> None:
    assert len(FUNCTIONS) >= 20


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_the_example_does_what_it_shows(name: str) -> None:
    function = FUNCTIONS[name]
    examples = doctest.DocTestParser().get_examples(getattr(function, "__doc__", "") or "")
    assert examples, f"{name} has no example"
    globs = {**vars(__import__(function.__module__, fromlist=["_"]))}
    test = doctest.DocTest(examples, globs, name, None, None, None)
    said: list[str] = []
    failed, _ = doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    assert failed == 0, "".join(said)
