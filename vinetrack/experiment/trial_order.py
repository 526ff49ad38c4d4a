"""The order in which trials were run, and whether it is confounded with pressure.

A drift (wear of the tube, warming, a moving zero of the gauge) follows the order of the trials. If the pressure rises
with the order, the data cannot distinguish such a drift from an effect of pressure.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from vinetrack.core.problems import Problem
from vinetrack.core.records import Floats, Trial

CONFOUNDING_CORRELATION = 0.7  # Rank correlation above which order and pressure count as confounded (derived)

FEWEST_TRIALS = 8  # Fewest trials for which the correlation is computed (derived)

REMEDY = "run the trials in random order, or repeat six of them in random order, and number them under order"


def trial_order(trials: Sequence[Trial]) -> tuple[Floats, bool]:
    """Return the rank of every trial in the order in which they were run, and whether the sheet states that order.
    Returns ranks, stated: Ranks from 0, shape (n_trials,).
    """
    order = np.array([trial.order for trial in trials], dtype=float)
    stated = bool(order.size and np.isfinite(order).all() and np.unique(order).size == order.size)
    ranks = np.argsort(np.argsort(order)) if stated else np.arange(order.size)
    return ranks.astype(float), stated


def order_pressure_correlation(trials: Sequence[Trial]) -> float:
    """Return Spearman's rank correlation of order and set pressure within vines, pooled over all vines. Returns −1 to
    1; NaN if there are fewer than `FEWEST_TRIALS` trials, or each vine has only one pressure.
    """
    from scipy.stats import rankdata

    ranks, _ = trial_order(trials)
    pairs: list[Floats] = []
    for vine in dict.fromkeys(trial.vine for trial in trials):
        members = [i for i, trial in enumerate(trials) if trial.vine == vine and math.isfinite(trial.pressure_Pa)]
        pressures = np.array([trials[i].pressure_Pa for i in members])
        if len(members) > 1 and np.ptp(pressures) > 0:
            both = np.array([rankdata(ranks[members]), rankdata(pressures)])
            pairs.append((both - both.mean(axis=1, keepdims=True)) / len(members))
    if sum(pair.shape[1] for pair in pairs) < FEWEST_TRIALS:
        return math.nan
    order, pressure = np.hstack(pairs)
    return float(order @ pressure / math.sqrt(float(order @ order) * float(pressure @ pressure)))


def order_problems(trials: Sequence[Trial], file: str) -> Iterator[Problem]:
    """Warn of confounding: order with pressure, and specimen or day with condition."""
    correlation = order_pressure_correlation(trials)
    _, stated = trial_order(trials)
    if abs(correlation) >= CONFOUNDING_CORRELATION and stated:
        message = (
            f"follows the pressure (rank correlation {correlation:.2f}): a drift would look like a physical effect"
        )
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    elif abs(correlation) >= CONFOUNDING_CORRELATION:
        message = (
            f"is blank and the rows are sorted by pressure (rank correlation {correlation:.2f}): if the trials were "
            "run in this order, a drift would look like a physical effect"
        )
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    for column in ("specimen", "day"):
        if _confounded_with_condition(trials, column):
            message = f"differs for every condition: a difference between {column}s would look like a physical effect"
            remedy = f"spread every condition over two {column}s"
            yield Problem(message=message, file=file, column=column, severity="warning", remedy=remedy)


def _confounded_with_condition(trials: Sequence[Trial], column: str) -> bool:
    """Whether every condition has a single value of `specimen` or `day`, while values differ within a vine."""
    values = {(trial.vine, trial.condition, getattr(trial, column)) for trial in trials}
    if not values or any(not value for _, _, value in values):
        return False
    in_condition = Counter(condition for _, condition, _ in values)
    in_vine = Counter(vine for vine, _ in {(vine, value) for vine, _, value in values})
    return max(in_condition.values()) == 1 and max(in_vine.values()) > 1
