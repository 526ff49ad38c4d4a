"""The catalogue in words: a list of all effects, and one explained."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from vinetrack.core.terminal import table
from vinetrack.effects._base import KINDS, Effect, Parameter

_HEAD = ("name", "kind", "parameters")


def listing(effects: Iterable[Effect], user_effects: Mapping[str, Effect] | None = None) -> list[str]:
    """Lines: name, kind, parameters with units, aligned, and below each its formula; base effects first.

    Parameters
    ----------
    effects : those to be listed.
    user_effects : by name; those among `effects` are marked as own.

    Returns
    -------
    lines for the terminal.
    """
    mine = set((user_effects or {}).values())
    effects = sorted(effects, key=lambda effect: KINDS.index(effect.kind))
    entries = []
    for effect in effects:
        parameters = ", ".join(f"{p.symbol} ({p.unit})" for p in effect.parameters) or "–"
        entries.append(
            (effect.name, f"{effect.kind}, own" if effect in mine else effect.kind, parameters, effect.formula)
        )
    head, *lines = table([entry[:3] for entry in entries], _HEAD)
    below = [f"    {entry[3]}" for entry in entries]
    return [head, *(line for pair in zip(lines, below, strict=True) for line in pair)]


def explanation(effect: Effect) -> list[str]:
    """Lines: what one effect is, in the words of its file, then its parameters and how it stands to others.

    Parameters
    ----------
    effect : of the catalogue, or a user's own.

    Returns
    -------
    lines for the terminal.
    """
    lines = [f"{effect.name} ({effect.kind})", "", *effect.text.splitlines(), ""]
    if effect.parameters:
        lines += ["Parameters, in files by the name in brackets:", *_parameter_table(effect), ""]
    facts = [
        ("Needs of the trial sheet", ", ".join(effect.needs)),
        ("Easily taken for", ", ".join(effect.easily_taken_for)),
        ("Replaces, while in the model", ", ".join(effect.replaces)),
        ("A pressure measured during growth", "already holds it" if effect.in_trace else ""),
        ("File", str(effect.path)),
    ]
    return [*lines, *(f"{what}: {words}" for what, words in facts if words)]


def remedy(effect: Effect) -> str:
    """How to reduce an effect or to measure it, as its file says, in one line; blank where it does not.

    Parameters
    ----------
    effect : of the catalogue, or a user's own.

    Returns
    -------
    one line, or blank.
    """
    return _paragraph(effect, ("Reduce it", "It cannot be reduced", "Measure it"))


def told_apart(effect: Effect) -> str:
    """What it is easily taken for and what tells them apart, as its file says, in one line; blank where it does not.

    Parameters
    ----------
    effect : of the catalogue, or a user's own.

    Returns
    -------
    one line, or blank.
    """
    return _paragraph(effect, ("Easily taken for",))


def _paragraph(effect: Effect, begins: tuple[str, ...]) -> str:
    for paragraph in effect.text.split("\n\n"):
        if paragraph.startswith(begins):
            return " ".join(paragraph.split()).replace("`", "")
    return ""


def _parameter_table(effect: Effect) -> list[str]:
    head = ("symbol", "unit", "default", "bounds", "plausible", "no size at", "one for", "meaning")
    rows = [_cells(effect, parameter) for parameter in effect.parameters]
    return table(rows, head, indent="  ", align="<" * len(head))


def _cells(effect: Effect, p: Parameter) -> tuple[str, ...]:
    plausible = f"{p.plausible[0]:g} to {p.plausible[1]:g}" if p.plausible else "–"
    # A shape, such as an exponent or a length, does not make an effect vanish: its `zero` is its default.
    zero = "–" if p.zero == p.default else f"{p.zero:g}"
    bounds = f"{p.bounds[0]:g} to {p.bounds[1]:g}"
    shared = "each vine" if p.shared == "vine" else "all"
    meaning = f"{p.meaning} [{effect.name}.{p.name}]{', known beforehand' if p.held else ''}"
    return p.symbol, p.unit, f"{p.default:g}", bounds, plausible, zero, shared, meaning
