"""The next experiment in words: which trials to make, what they will tell, and what to measure instead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vinetrack.effects import Effect
from vinetrack.effects._words import remedy, told_apart
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.inference.fit_result import Fit
from vinetrack.planning.feasible_trials import NEW_VINE, Condition

MUCH_MORE = 1.5

WITH_TRACE = (
    "Record the pressure at the vine during growth and give it with the track: what the chamber does is then measured,"
    " and only the other is left to explain what remains."
)


def effects_between(one: Fit, other: Fit) -> tuple[list[Effect], list[Effect]]:
    """What the first has in its model and the second has not, and the other way round."""
    mine, yours = one.model, other.model
    return [e for e in mine if e.name not in yours], [e for e in yours if e.name not in mine]


def only_measurement(tied: Sequence[Fit]) -> bool:
    """Whether all that the hypotheses differ by is how things were measured."""
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    differ = [effect for fit in tied for effect in fit.model if effect.name not in common]
    return bool(differ) and all(effect.kind == "measurement" for effect in differ)


def calibration_for(pairs: Sequence[tuple[Fit, Fit]]) -> str:
    """What to measure so that one of each pair can be ruled out, in the words of the effects themselves.

    Where an error of measurement is among them it is what can be settled for certain, and the rest is not spoken of.
    """
    sentences: list[str] = []
    effects: dict[str, Effect] = {}
    for one, other in pairs:
        mine, yours = effects_between(one, other)
        if any(e.in_trace for e in mine) != any(e.in_trace for e in yours) and WITH_TRACE not in sentences:
            sentences.append(WITH_TRACE)
        effects.update({effect.name: effect for effect in [*mine, *yours]})
    measured = [effect for effect in effects.values() if effect.kind == "measurement"]
    for effect in measured or effects.values():
        words = " ".join(filter(None, ("" if measured else told_apart(effect), remedy(effect))))
        if words:
            sentences.append(f"{effect.name}: {words[0].lower()}{words[1:]}")
    return " ".join(sentences)


def _trials_in_words(trials: Sequence[Mapping[str, Any]]) -> str:
    """The trials to make, as a list in one sentence."""
    return "; ".join(_trial_in_words(trial) for trial in trials)


def _trial_in_words(trial: Mapping[str, Any]) -> str:
    count = trial["replicates"]
    words = f"{count} {'trial' if count == 1 else 'trials'} at {trial['pressure_kPa']:.3g} kPa"
    if trial["payload_g"]:
        words += f" with {trial['payload_g']:.3g} g"
    size = f"{trial['diameter_mm']:.3g} mm × {trial['thickness_um']:.3g} µm × {trial['length_mm']:.3g} mm"
    words += f" with {'a new' if trial['new_vine'] else 'the'} vine of {size}"
    changed = [COLUMNS[key].in_words(trial[key]) for key in LIMITED["choice"] if key in trial["changed"]]
    return f"{words}, {' and '.join(changed)}" if changed else words


def outlook(
    if_true: Mapping[str, Mapping[str, float]], simulated: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """What the trials are expected to tell, pair by pair; what it is if the other is true only where that is more."""
    parts = []
    for pair, ways in if_true.items():
        least, most = sorted(ways, key=ways.__getitem__)
        notes = [f"{ways[most]:.2g} σ if {most} is true"] if ways[most] > MUCH_MORE * max(ways[least], 1.0) else []
        mean, sd = (simulated or {}).get(pair, (math.nan, math.nan))
        if math.isfinite(mean):
            notes.append(f"simulated: {mean:.2g}" + (f" ± {max(sd, 0.1):.1g} σ" if math.isfinite(sd) else " σ"))
        behind = f" ({'; '.join(notes)})" if notes else ""
        parts.append(f"{pair.replace(' | ', ' from ')} by {ways[least]:.2g} σ{behind}")
    return ", ".join(parts)


def listed(names: Sequence[str]) -> str:
    """Names as a sentence lists them."""
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def entries(every: Sequence[Condition], design: Sequence[int]) -> tuple[dict[str, Any], ...]:
    """The trials of a design as entries, one a condition."""
    return tuple(
        _entry(every[place], int(count))
        for place, count in zip(*np.unique(np.array(design), return_counts=True), strict=True)
    )


def _entry(condition: Condition, replicates: int) -> dict[str, Any]:
    trial = condition.trial
    settings = {name: COLUMNS[name].of_trial(trial) for name in (*LIMITED["range"], *LIMITED["choice"])}
    return {
        **{name: float(f"{value:.6g}") for name, value in settings.items()},
        "replicates": replicates,
        "vine": trial.vine,
        "new_vine": condition.effort == NEW_VINE,
        "changed": list(condition.changed),
    }


def in_words(
    trials: Sequence[Mapping[str, Any]],
    promise: str,
    left: Sequence[str],
    advice: str,
    *,
    worth_it: bool,
    least: float,
) -> str:
    """The advice in plain sentences."""
    if not worth_it:
        return (
            f"No trials within the limits separate what is tied by {least:g} σ; the best would separate"
            f" {promise}. {advice}".rstrip()
        )
    text = f"Make {_trials_in_words(trials)}. Together with the trials so far they separate {promise}."
    if any(trial["new_vine"] for trial in trials):
        text += " B of the new vine is a guess here and is fitted; its yield pressure has to be measured."
    if left:
        pairs = listed([pair.replace(" | ", " from ") for pair in left])
        text += f" They will not tell {pairs}. {advice}"
    elif advice:
        text += f" A measurement would do as well: {advice}"
    return text.rstrip()
