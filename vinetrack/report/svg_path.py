"""Paths of SVG files written short: relative, on a grid of a tenth of a point, which no screen or printer resolves."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

Command = tuple[str, tuple[float, ...]]

DECIMALS = 1
"""A tenth of a point is 0.13 pixels on a screen, and 35 µm on paper."""

_TOKEN = re.compile(r"[MLHVCQZz]|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_NUMBERS = {"M": 2, "L": 2, "Q": 4, "C": 6, "Z": 0}


def parse_path(d: str) -> list[Command]:
    """Commands of a path in absolute coordinates, as matplotlib writes them: M, L, Q, C and Z.

    >>> parse_path("M 1 2 L 3 4 z")
    [('M', (1.0, 2.0)), ('L', (3.0, 4.0)), ('Z', ())]

    Raises
    ------
    ValueError
        If there is anything else in it.
    """
    commands: list[Command] = []
    letter, numbers = "", [0.0][:0]
    for token in _TOKEN.findall(d):
        if token.isalpha():
            letter = token.upper()
            if letter == "Z":
                commands.append(("Z", ()))
            continue
        numbers.append(float(token))
        if letter not in _NUMBERS:
            raise ValueError(f"the path command {letter!r} is not known here")
        if len(numbers) == _NUMBERS[letter]:
            commands.append((letter, tuple(numbers)))
            letter, numbers = ("L" if letter == "M" else letter), []
    return commands


def moved(commands: Iterable[Command], x: float, y: float) -> list[Command]:
    """The same path with its origin at (x, y)."""
    return [(letter, tuple(value + (x, y)[i % 2] for i, value in enumerate(numbers))) for letter, numbers in commands]


def write_path(commands: Sequence[Command], decimals: int = DECIMALS) -> str:
    """The `d` of a path, as short as it gets: rounded to a grid first, so that rounding never adds up along it.

    A line of no length stays as a dot where it is all there is of a stroke.

    >>> write_path([("M", (10.04, 20.0)), ("L", (10.04, 25.5)), ("L", (12.0, 25.5)), ("Z", ())])
    'M10 20v5.5h2z'
    """
    scale = 10**decimals
    parts: list[str] = []
    here, start, last, is_dot = (0, 0), (0, 0), "", False
    for letter, numbers in (*commands, ("M", ())):
        if letter == "M" and is_dot:
            parts.append("h0")
        is_dot = is_dot and letter == "L"
        if letter == "Z" or not numbers:
            parts += ["z"] if letter == "Z" else []
            here, last = start, "z"
            continue
        grid = [round(scale * value) for value in numbers]
        there = (grid[-2], grid[-1])
        if letter == "M":
            parts.append("M" + _joined(grid, decimals))
            here, start, last, is_dot = there, there, "M", False
            continue
        if letter == "L" and there == here:
            is_dot = is_dot or last == "M"
            continue
        is_dot = False
        name, relative = _step(letter, [value - here[i % 2] for i, value in enumerate(grid)])
        text = _joined(relative, decimals)
        parts.append(text if name == last and text.startswith("-") else (" " if name == last else name) + text)
        here, last = there, name
    return "".join(parts)


def _step(letter: str, relative: list[int]) -> tuple[str, list[int]]:
    """The shortest command for a step."""
    if letter != "L":
        return letter.lower(), relative
    dx, dy = relative
    return ("h", [dx]) if dy == 0 else ("v", [dy]) if dx == 0 else ("l", [dx, dy])


def _joined(grid: Iterable[int], decimals: int) -> str:
    text = ""
    for value in grid:
        number = _short(value, decimals)
        text += number if not text or number.startswith("-") else " " + number
    return text


def _short(value: int, decimals: int) -> str:
    """A number of the grid without anything it can do without: 5, -.5, 12.3."""
    sign = "-" if value < 0 else ""
    whole, part = divmod(abs(value), 10**decimals)
    fraction = f"{part:0{decimals}d}".rstrip("0") if decimals else ""
    if not fraction:
        return f"{sign}{whole}"
    return f"{sign}{whole or ''}.{fraction}"


def circle_diameter(commands: Sequence[Command]) -> float | None:
    """Diameter of a path that is a circle about its origin, as matplotlib draws its round markers; None for others."""
    curves = [numbers for letter, numbers in commands if letter == "C"]
    if len(curves) != 8 or any(letter not in "MCZ" for letter, _ in commands):
        return None
    ends = [numbers[-2:] for numbers in curves]
    radii = [(x * x + y * y) ** 0.5 for x, y in ends]
    return 2 * max(radii) if max(radii) - min(radii) < 0.02 * max(radii) else None
