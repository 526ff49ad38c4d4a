"""What commands print of results and of effects."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import safe_join
from vinetrack.core.terminal import table
from vinetrack.core.units import number
from vinetrack.results.folder_layout import Results, read_fit, read_result

if TYPE_CHECKING:
    from vinetrack.effects import Effect


def comparison_lines(folder: Path) -> list[str]:
    """Return `comparison.csv` as aligned lines for the terminal, or the reason why it is empty."""
    results = Results(folder)
    fit, compared = read_fit(results), read_result(results.comparison)
    if fit.refused:
        return [f"{' + '.join(fit.names)} was not fitted: {fit.refused}"]
    in_mm = ("rms_position_m", "replicate_floor_m", "expected_low_m", "expected_high_m")
    scale = dict.fromkeys(in_mm, 1e3) | {"rms_final_velocity_m_s": 1.0, "worst_at_s": 1e3, "worst_at_m": 1e3}
    shown = (compared[[*scale]] * [*scale.values()]).map(number)
    head = ("condition", "rms position", "replicates", "adequate from", "to", "rms final speed", "worst at", "")
    rows = zip(compared["condition"], *(shown[name] for name in scale), strict=True)
    lines = table(rows, head, ("", "mm", "mm", "mm", "mm", "m/s", "ms", "mm"), align="<>>>>>>>")
    return [" + ".join(fit.names), *lines, *(f"! {message}" for message in fit.messages)]


def effect_lines(name: str | None, experiment: Path | None) -> tuple[list[str], list[dict[str, Any]]]:
    """List all effects with their formulas, base effects first, or explain one; those of an experiment included.
    Returns lines, and the same for a program.
    """
    from vinetrack.effects import KINDS, catalogue, find_effect, own_effects
    from vinetrack.experiment.settings import read_experiment_settings

    listed = () if experiment is None else read_experiment_settings(experiment / "experiment.yaml").effects
    own = own_effects([safe_join(experiment or Path(), path) for path in listed])
    if name is None:
        effects = sorted({**catalogue(), **own}.values(), key=lambda one: KINDS.index(one.kind))
        parameters = [", ".join(f"{p.symbol} ({p.unit})" for p in one.parameters) or "–" for one in effects]
        kinds = [f"{one.kind}, own" if one.name in own else one.kind for one in effects]
        entries = zip((one.name for one in effects), kinds, parameters, strict=True)
        head, *rows = table(entries, ("name", "kind", "parameters"))
        lines = [head, *(part for row, one in zip(rows, effects, strict=True) for part in (row, f"    {one.formula}"))]
    else:
        effects = [find_effect(name, own)]
        lines = _explanation(effects[0])
    facts = [{"name": one.name, "kind": one.kind, "text": one.text, "own": one.name in own} for one in effects]
    return lines, [
        fact | {"parameters": list(map(asdict, one.parameters))} for fact, one in zip(facts, effects, strict=True)
    ]


def _explanation(effect: Effect) -> list[str]:
    """Lines on one effect: the text of its file, its parameters and its relations to other effects."""
    lines = [f"{effect.name} ({effect.kind})", "", *effect.text.splitlines(), ""]
    rows = [
        (
            p.symbol,
            p.unit,
            f"{p.default:g}",
            f"{p.bounds[0]:g} to {p.bounds[1]:g}",
            f"{p.plausible[0]:g} to {p.plausible[1]:g}" if p.plausible else "–",
            # A shape, such as an exponent or a length, does not make an effect vanish: its `zero` is its default.
            "–" if p.zero == p.default else f"{p.zero:g}",
            "all" if p.shared == "all" else f"each {p.shared}",
            f"{p.meaning} [{effect.name}.{p.name}]{', known beforehand' if p.held else ''}",
        )
        for p in effect.parameters
    ]
    if rows:
        head = ("symbol", "unit", "default", "bounds", "plausible", "no size at", "one for", "meaning")
        lines += ["Parameters, in files by the name in brackets:"]
        lines += [*table(rows, head, indent="  ", align="<" * len(head)), ""]
    facts = {
        "Sizes that result from slips in the sheet": "; ".join(
            f"{p.symbol} = {size:.3g}, {done}" for p in effect.parameters for size, done in p.slips
        ),
        "Needs of the trial sheet": ", ".join(effect.needs),
        "Replaces, while in the model": ", ".join(effect.replaces),
        "A pressure measured during growth": "already includes it" if effect.in_trace else "",
        "File": str(effect.path),
    }
    return [*lines, *(f"{what}: {words}" for what, words in facts.items() if words)]
