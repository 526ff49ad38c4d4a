"""What the thresholds of a verdict are worth for one design, in a table and in sentences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vinetrack.narrative.power_text import percent
from vinetrack.narrative.verdict_summary import listed

if TYPE_CHECKING:
    from vinetrack.diagnosis.null_calibration import CalibratedTest, NullCalibration


def calibration_lines(calibration: NullCalibration) -> list[str]:
    """Return what the thresholds of a verdict are worth for this very design, a row a test, and what that changes.

    Parameters
    ----------
    calibration : of the tests of a first model.

    Returns
    -------
    list of str
    """
    from vinetrack.core.terminal import table

    count = calibration.campaigns
    rows = []
    for test in calibration.tests:
        low, high = test.exceeding.interval
        least, most = test.by_tail[1:]
        tail = "–" if math.isnan(least) else f"{_chance(least)} to {_chance(most)}"
        rows.append(
            (
                test.name, _chance(test.level), _chance(test.observed), f"{test.exceeding.count} of {count}",
                _chance(test.monte_carlo), f"{_chance(low)} to {_chance(high)}", tail, _said(test),
            )
        )  # fmt: skip
    head = ("test", "level", "p", "as extreme", "Monte-Carlo p", "95 %", "by the tail", "called")
    low, high = calibration.alarms.interval
    lines = [
        f"{count} campaigns of this design, {' + '.join(calibration.model)} their truth, fitted and tested alike:",
        *(f"  {line}" for line in table(rows, head, align="<>>>>>><")),
        f"At the levels as they stand, {calibration.alarms.count} of them raise an alarm ({percent(low)} to "
        f"{percent(high)} with 95 % confidence).",
    ]
    short = [test for test in calibration.tests if not test.resolves and math.isnan(test.by_tail[0])]
    lines.append(_verdict_of(calibration))
    if short:
        needed = math.ceil(1 / min(test.level for test in short)) - 1
        names = listed([test.name for test in short])
        lines.append(f"Too few campaigns to resolve the level of {names}: that takes {needed}.")
    if calibration.failed:
        lines.append(f"{calibration.failed} campaigns could not be fitted and do not count.")
    return lines


def _verdict_of(calibration: NullCalibration) -> str:
    """What changes with respect to the nominal levels."""
    now = calibration.still_called
    if calibration.was_called:
        if now is None:
            return "Something was called missing or at fault; these campaigns are too few to confirm or to withdraw it."
        if now:
            return "Something was called missing or at fault; by the null distribution of this design it still is."
        return (
            "Something was called missing or at fault; by the null distribution of this design it no longer would be."
        )
    if now:
        return "Nothing was called missing; by the null distribution of this design something would be."
    return "Nothing was called missing, and by the null distribution of this design nothing would be."


def _said(test: CalibratedTest) -> str:
    """Whether a test was called at its level, and whether it would be by the null distribution."""
    words = {True: "yes", False: "no", None: "not known"}
    return f"{words[test.is_called]}, calibrated {words[test.still_called]}"


def _chance(chance: float) -> str:
    """A probability in per cent, two digits; far ones as a power of ten."""
    if math.isnan(chance):
        return "–"
    return percent(chance) if chance >= 1e-5 or chance == 0 else f"{chance:.0e}"
