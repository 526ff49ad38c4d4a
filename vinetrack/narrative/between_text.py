"""Differences between trials in words: which trials differ, by how much, and how to confirm it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vinetrack.core.numbers import decimals
from vinetrack.diagnosis.result import BETWEEN_SUMMARIES, BETWEEN_TRIALS, DAY, N_BY_VINE, ORDER_DRIFT, SPECIMEN
from vinetrack.experiment.trial_order import CONFOUNDING_CORRELATION, order_pressure_correlation, trial_order
from vinetrack.inference.fit_result import Number

if TYPE_CHECKING:
    from vinetrack.core.records import Trial
    from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio

# What to do about each difference between trials
REMEDIES = {
    N_BY_VINE: "Give each vine its own n (`shared={'n': 'vine'}`) before testing for missing effects",
    ORDER_DRIFT: "Repeat six trials in random order, number all trials in the column `order`, and read the gauge at "
    "each",
    SPECIMEN: "Film each specimen at several pressures, and name it in the column `specimen`",
    DAY: "Repeat some conditions on another day; before each, zero the gauge and set the regulator anew",
}


def trials_differ(names: Sequence[str]) -> bool:
    """Whether every name of an answer set is a difference between trials."""
    return bool(names) and all(name in BETWEEN_SUMMARIES for name in names)


def difference_headline(names: Sequence[str]) -> str:
    """The differences between trials of an answer set, each in a clause."""
    return " or ".join(BETWEEN_SUMMARIES[name] for name in names)


def difference_in_words(result: LikelihoodRatio) -> str:
    """The size of one difference between trials: `pressure rises by 0.42 ± 0.03 % with each trial`."""
    name = result.names[-1]
    if name == N_BY_VINE:
        return "n differs between the vines: " + ", ".join(
            f"{_value(number.value, number.sigma)} ({number.vine})" for number in result.numbers
        )
    if name == ORDER_DRIFT:
        slope = result.numbers[0]
        if slope.key.endswith(".step"):
            way = "higher" if slope.value > 0 else "lower"
            return f"pressure is {way} by {_value(100 * abs(slope.value), 100 * slope.sigma)} % {slope.vine}"
        way = "rises" if slope.value > 0 else "falls"
        what, each = ("B", "each trial of a tube") if slope.key.endswith(".B") else ("pressure", "each trial")
        return f"{what} {way} by {_value(100 * abs(slope.value), 100 * slope.sigma)} % with {each}"
    parts = []
    in_B = [number for number in result.numbers if number.key.endswith(".B")]
    in_P = [number for number in result.numbers if number.key.endswith(".P")]
    if in_B:
        parts.append(f"in B by {_range(in_B, 100, '%')}")
    if in_P:
        parts.append(f"in pressure (zero of the gauge, or P_y) by {_range(in_P, 1e-3, 'kPa')}")
    if gains := [number for number in result.numbers if number.key.endswith(".gain")]:
        parts.append(f"in pressure (setting of a regulator) by {_range(gains, 100, '%')}")
    return f"{name}s differ {' and '.join(parts)}"


def remedies_in_words(answers: Sequence[LikelihoodRatio], trials: Sequence[Trial]) -> str:
    """What to do about the differences between trials in an answer set; blank where there are none."""
    names = [result.names[-1] for result in answers if result.effects[-1].kind == BETWEEN_TRIALS]
    if not names:
        return ""
    text = "".join(f" {REMEDIES[name]}." for name in names)
    if ORDER_DRIFT not in names and SPECIMEN not in names:
        return text
    _, stated = trial_order(trials)
    if not stated:
        text = f" The trials were assumed to be in the order of the rows.{text}"
    correlation = order_pressure_correlation(trials)
    if math.isfinite(correlation) and abs(correlation) >= CONFOUNDING_CORRELATION:
        text = f" Trials were made in the order of pressure (rank correlation {correlation:.2f}).{text}"
    return text


def _value(value: float, sigma: float) -> str:
    digits = decimals(sigma)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _range(numbers: Sequence[Number], factor: float, unit: str) -> str:
    """One coefficient with its standard error; several as a range."""
    if len(numbers) == 1:
        return f"{_value(factor * numbers[0].value, factor * numbers[0].sigma)} {unit} ({numbers[0].vine})"
    values = [factor * number.value for number in numbers]
    return f"{min(values):+.2g} to {max(values):+.2g} {unit}"
