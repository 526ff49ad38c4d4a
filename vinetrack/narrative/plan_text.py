"""The next experiment in sentences: trials to make, hypotheses that they separate, and what to measure instead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vinetrack.effects import Effect, remedy, told_apart
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.inference.fit_result import Fit
from vinetrack.narrative.verdict_summary import joined
from vinetrack.planning.feasible_trials import NEW_VINE, Condition

_MUCH_MORE = 1.5  # Ratio from which the larger of two expected significances is stated beside the smaller (chosen)

_WITH_TRACE = (
    "Record the pressure at the vine during growth and give it with the track: the pressure in the chamber is then"
    " measured, and only the other hypothesis can explain a remaining misfit."
)


def effects_between(first: Fit, second: Fit) -> tuple[list[Effect], list[Effect]]:
    """Return the effects that only the first model has, and those that only the second has. Returns only_first,
    only_second : list of Effect.
    """
    return (
        [effect for effect in first.model if effect.name not in second.model],
        [effect for effect in second.model if effect.name not in first.model],
    )


def only_measurement(tied: Sequence[Fit]) -> bool:
    """Return whether the hypotheses differ only in faults of the measurement."""
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    differ = [effect for fit in tied for effect in fit.model if effect.name not in common]
    return bool(differ) and all(effect.kind == "measurement" for effect in differ)


def calibration_advice(pairs: Sequence[tuple[Fit, Fit]]) -> str:
    """Return what to measure in order to exclude one of each pair of hypotheses, as the files of their effects state.
    Where a fault of the measurement is among them, a calibration decides, and only the calibration is returned.
    """
    sentences: list[str] = []
    effects: dict[str, Effect] = {}
    for pair in pairs:
        only_first, only_second = effects_between(*pair)
        if any(e.in_trace for e in only_first) != any(e.in_trace for e in only_second) and _WITH_TRACE not in sentences:
            sentences.append(_WITH_TRACE)
        effects.update({effect.name: effect for effect in [*only_first, *only_second]})
    measured = [effect for effect in effects.values() if effect.kind == "measurement"]
    for effect in measured or effects.values():
        words = " ".join(filter(None, ("" if measured else told_apart(effect), remedy(effect))))
        if words:
            sentences.append(f"{effect.name}: {words[0].lower()}{words[1:]}")
    return " ".join(sentences)


def trials_in_words(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return the trials to make, as a list within a sentence."""
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


def separation_text(
    if_true: Mapping[str, Mapping[str, float]], simulated: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """Return the expected significance with which the trials separate each pair of hypotheses."""
    parts = []
    for pair, by_truth in if_true.items():
        least, most = sorted(by_truth, key=by_truth.__getitem__)
        is_much_larger = by_truth[most] > _MUCH_MORE * max(by_truth[least], 1.0)
        notes = [f"{by_truth[most]:.2g} σ if {most} is true"] if is_much_larger else []
        mean, sd = (simulated or {}).get(pair, (math.nan, math.nan))
        if math.isfinite(mean):
            notes.append(f"simulated: {mean:.2g}" + (f" ± {max(sd, 0.1):.1g} σ" if math.isfinite(sd) else " σ"))
        remark = f" ({'; '.join(notes)})" if notes else ""
        parts.append(f"{pair.replace(' | ', ' from ')} by {by_truth[least]:.2g} σ{remark}")
    return ", ".join(parts)


def trial_entries(every: Sequence[Condition], design: Sequence[int]) -> tuple[dict[str, Any], ...]:
    """Return the trials of a design as entries of `next_experiment`, one for each condition."""
    return tuple(
        _entry(every[index], int(count))
        for index, count in zip(*np.unique(np.array(design), return_counts=True), strict=True)
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


def advice_text(
    trials: Sequence[Mapping[str, Any]],
    promise: str,
    left: Sequence[str],
    advice: str,
    *,
    worth_it: bool,
    least: float,
) -> str:
    """Return the advice: the trials to make, the hypotheses that they separate, and what to measure instead."""
    if not worth_it:
        return (
            f"No trials within `limits` separate the tied hypotheses by {least:g} σ; the best would separate"
            f" {promise}. {advice}".rstrip()
        )
    text = f"Make {trials_in_words(trials)}. Together with the trials so far, they are expected to separate {promise}."
    if any(trial["new_vine"] for trial in trials):
        text += " B of the new vine is predicted here by scaling and will be fitted; measure its yield pressure."
    if left:
        pairs = joined([pair.replace(" | ", " from ") for pair in left])
        text += f" They will not separate {pairs}. {advice}"
    elif advice:
        text += f" A measurement would decide as well: {advice}"
    return text.rstrip()
