"""In which order trials were made, and whether it follows the pressure.

What changes from trial to trial, wear of a tube, warming, a gauge whose zero moves, follows the order. Where pressures
were filmed in rising order it follows the pressure too, and nothing in the data tells it from physics.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from vinetrack.core.problems import Problem
from vinetrack.core.records import Floats, Trial

CONFOUNDING_CORRELATION = 0.7
"""Rank correlation from which the order counts as following the pressure. Derived: a drift fitted beside an effect of
pressure has its variance multiplied by 1/(1 − r²), and 1/(1 − 0.7²) = 2: half of the information is gone."""

FEWEST_TRIALS = 8
"""Trials from which the correlation is asked. Derived: in random order |r| of 8 passes 0.7 by chance in 5 %."""

REMEDY = "make trials in random order, or repeat six of them in random order, and number them in the column order"


def trial_order(trials: Sequence[Trial]) -> tuple[Floats, bool]:
    """Rank of every trial in the order in which they were made, and whether the sheet states it.

    Parameters
    ----------
    trials : in the order of the sheet.

    Returns
    -------
    ranks, stated
        From 0, shape (n_trials,). Where `order` is blank for any trial, or two share it, the order of rows is taken.
    """
    order = np.array([trial.order for trial in trials], dtype=float)
    stated = bool(order.size and np.isfinite(order).all() and np.unique(order).size == order.size)
    ranks = np.argsort(np.argsort(order)) if stated else np.arange(order.size)
    return ranks.astype(float), stated


def order_pressure_correlation(trials: Sequence[Trial]) -> float:
    """Spearman's rank correlation of order and set pressure among the trials of a vine, all vines together.

    Parameters
    ----------
    trials : in the order of the sheet.

    Returns
    -------
    float
        −1 to 1; NaN where there are fewer than `FEWEST_TRIALS` trials or each vine has one pressure.
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
    """Warnings about what a sheet cannot keep apart: order and pressure, and a specimen or day for each condition.

    Parameters
    ----------
    trials : in the order of the sheet.
    file : name of the sheet.

    Yields
    ------
    warnings.
    """
    correlation = order_pressure_correlation(trials)
    _, stated = trial_order(trials)
    if abs(correlation) >= CONFOUNDING_CORRELATION and stated:
        message = f"follows the pressure (rank correlation {correlation:.2f}): any drift looks like physics"
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    elif abs(correlation) >= CONFOUNDING_CORRELATION:
        message = (
            f"is blank and the rows are sorted by pressure (rank correlation {correlation:.2f}): if they were made "
            "in this order, any drift looks like physics"
        )
        yield Problem(message=message, file=file, column="order", severity="warning", remedy=REMEDY)
    for column in ("specimen", "day"):
        if _confounded_with_condition(trials, column):
            message = f"is another for each condition: what differs between {column}s looks like physics"
            remedy = f"spread every condition over two {column}s"
            yield Problem(message=message, file=file, column=column, severity="warning", remedy=remedy)


def _confounded_with_condition(trials: Sequence[Trial], column: str) -> bool:
    """Whether no condition has two of the column's values, though conditions of one vine have different ones.

    Parameters
    ----------
    trials : trials with their conditions named.
    column : `specimen` or `day`.
    """
    values = {(trial.vine, trial.condition, getattr(trial, column)) for trial in trials}
    if not values or any(not value for _, _, value in values):
        return False
    in_condition = Counter(condition for _, condition, _ in values)
    in_vine = Counter(vine for vine, _ in {(vine, value) for vine, _, value in values})
    return max(in_condition.values()) == 1 and max(in_vine.values()) > 1
