"""Thresholds of a verdict calibrated for one design by simulated null campaigns: a table and sentences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vinetrack.narrative.power_text import percent
from vinetrack.narrative.verdict_summary import listed_names

if TYPE_CHECKING:
    from vinetrack.diagnosis.null_calibration import CalibratedTest, NullCalibration


def calibration_lines(calibration: NullCalibration) -> list[str]:
    """Return nominal and Monte-Carlo p-values of each test for this design, and whether the calls change."""
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
                _chance(test.monte_carlo), f"{_chance(low)} to {_chance(high)}", tail, _is_called(test),
            )
        )  # fmt: skip
    head = ("test", "level", "p", "as extreme", "Monte-Carlo p", "95 %", "fitted tail", "called")
    low, high = calibration.alarms.interval
    lines = [
        f"{count} campaigns of this design, simulated with {' + '.join(calibration.model)}, fitted and tested alike:",
        *(f"  {line}" for line in table(rows, head, align="<>>>>>><")),
        f"At the nominal levels, {calibration.alarms.count} of them raise a false alarm (95 % interval {percent(low)} "
        "to "
        f"{percent(high)}).",
    ]
    unresolved = [test for test in calibration.tests if not test.resolves and math.isnan(test.by_tail[0])]
    lines.append(_verdict_of(calibration))
    if unresolved:
        needed = math.ceil(1 / min(test.level for test in unresolved)) - 1
        names = listed_names([test.name for test in unresolved])
        lines.append(f"Too few campaigns to resolve the level of {names}: that takes {needed}.")
    if calibration.failed:
        lines.append(f"{calibration.failed} campaigns could not be fitted and are not counted.")
    return lines


def _verdict_of(calibration: NullCalibration) -> str:
    """Whether calibration changes what the nominal levels call missing."""
    now = calibration.still_called
    if calibration.was_called:
        if now is None:
            return "Something was called missing or at fault; these campaigns are too few to confirm or to revoke it."
        if now:
            return "Something was called missing or at fault; by the null distribution of this design it still is."
        return (
            "Something was called missing or at fault; by the null distribution of this design it no longer would be."
        )
    if now:
        return "Nothing was called missing; by the null distribution of this design something would be."
    return "Nothing was called missing, and by the null distribution of this design nothing would be."


def _is_called(test: CalibratedTest) -> str:
    """Whether a test is significant at its nominal level, and whether it is by the null distribution."""
    words = {True: "yes", False: "no", None: "not known"}
    return f"{words[test.is_called]}, calibrated {words[test.still_called]}"


def _chance(chance: float) -> str:
    """A probability in per cent, two digits; small ones as a power of ten."""
    if math.isnan(chance):
        return "–"
    return percent(chance) if chance >= 1e-5 or chance == 0 else f"{chance:.0e}"
