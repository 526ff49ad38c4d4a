"""Trials recommended for a campaign that goes on, in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vinetrack.narrative.plan_text import trials_in_words
from vinetrack.narrative.power_text import size_text
from vinetrack.narrative.verdict_summary import joined, spaced_name

if TYPE_CHECKING:
    from vinetrack.diagnosis.informative_trials import InformativeTrials
    from vinetrack.diagnosis.power import EffectPower


MOST_SIZES = 3  # Effects whose detectable sizes are stated beside recommended trials, at most (chosen)

LEAST_STATED_GAIN = 1.1  # Factor by which a detectable size must fall to be stated (chosen)


def informative_text(plan: InformativeTrials, named: str = "", rival: str = "") -> str:
    """Return recommended trials in words, and the detectable sizes that they lower most."""
    purpose = "These trials are expected to reveal most of what could be missing"
    if named:
        purpose = f"These trials tell most about {spaced_name(named)}"
        purpose += f" apart from {spaced_name(rival)}" if rival else ""
    before = {entry.effect: entry for entry in plan.now.effects}
    gains = [
        (before[entry.effect], entry, _gain(before[entry.effect], entry))
        for entry in plan.then.effects
        if entry.effect in before and (entry.effect == named or not named) and _is_plausible(entry)
    ]
    gains = [gain for gain in sorted(gains, key=lambda gain: -gain[2]) if gain[2] > LEAST_STATED_GAIN][:MOST_SIZES]
    lower = [
        f"{spaced_name(then.effect)} from {then.symbol or 'size'} = {size_text(now, now.size_at(0.9))} to "
        f"{size_text(then, then.size_at(0.9))}"
        for now, then, _ in gains
    ]
    sizes = f" They lower the size that is detected with 90 % power: {joined(lower)}." if lower else ""
    return f"Make {trials_in_words(plan.trials)}. {purpose}.{sizes}"


def _gain(now: EffectPower, then: EffectPower) -> float:
    """Factor by which the size detected with 90 % power falls; 0 where either is unknown."""
    sizes = [abs(entry.size_at(0.9) - entry.zero) for entry in (now, then)]
    return sizes[0] / sizes[1] if math.isfinite(sizes[0]) and sizes[1] > 0 else 0.0


def _is_plausible(entry: EffectPower) -> bool:
    """Whether the size detected with 90 % power is no larger than the largest plausible one."""
    return abs(entry.size_at(0.9) - entry.zero) <= abs(entry.largest - entry.zero)
