"""Data of the page's figures, as plain columns in milliseconds and millimetres."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.explorer.campaign import Campaign, ExplorerTrial, condition_labels
from vinetrack.explorer.curves import Curves
from vinetrack.figures.style import vine_styles

MAX_POINTS = 250  # Points of a line on the page; chosen: one per three or four pixels

Columns = dict[str, list[Any]]


def colours(campaign: Campaign) -> dict[str, str]:
    """Return the colour of each condition: that of its vine, as in every figure."""
    styles = vine_styles(campaign.vines)
    return {aligned.condition: styles[aligned.data.trial.vine].colour for aligned in campaign.trials}


def vine_colours(campaign: Campaign) -> list[tuple[str, str]]:
    """Return a distinguishing label and the colour of each vine."""
    styles = vine_styles(campaign.vines)
    first = {aligned.data.trial.vine: aligned.data.trial for aligned in reversed(campaign.trials)}
    bare = {vine: replace(trial, pressure_Pa=math.nan, payload_kg=0.0) for vine, trial in first.items()}
    labels = condition_labels(bare) if len(bare) > 1 else dict.fromkeys(bare, "measured")
    return [(labels[vine], styles[vine].colour) for vine in campaign.vines]


def plotted_rows(count: int, first: int) -> slice:
    """Return the rows of a track to draw: from a little before the motion, at most `MAX_POINTS`."""
    begin = max(first - max((count - first) // 20, 2), 0)
    return slice(begin, None, max(math.ceil((count - begin) / MAX_POINTS), 1))


def measured_lines(campaign: Campaign, shown: Sequence[int]) -> Columns:
    """Return lines of the measured positions: `xs` ms since release, `ys` mm of growth, `colour`, `trial`,
    `condition`.
    """
    trials = [campaign.trials[i] for i in shown]
    return _lines_by_trial(campaign, [(aligned, aligned.time_s, aligned.growth_m) for aligned in trials])


def _lines_by_trial(campaign: Campaign, lines: Iterable[tuple[ExplorerTrial, Floats, Floats]]) -> Columns:
    """One line per trial, from its abscissae and ordinates in SI, scaled by 1000."""
    colour = colours(campaign)
    columns: Columns = {"xs": [], "ys": [], "colour": [], "trial": [], "condition": []}
    for aligned, x, y in lines:
        rows = plotted_rows(aligned.time_s.size, aligned.first_counted_frame(aligned.release_s))
        columns["xs"].append(1e3 * x[rows])
        columns["ys"].append(1e3 * _with_gaps(aligned, rows, y[rows]))
        columns["colour"].append(colour[aligned.condition])
        columns["trial"].append(aligned.name)
        columns["condition"].append(campaign.labels[aligned.condition])
    return columns


def _with_gaps(aligned: ExplorerTrial, rows: slice, values: Floats) -> Floats:
    """Insert NaN after each gap, so that no line is drawn across frames that were left out."""
    stretch = np.cumsum(aligned.data.first)[rows]
    out = values.copy()
    out[np.flatnonzero(np.diff(stretch) > 0) + 1] = math.nan
    return out


def replicate_bands(campaign: Campaign, shown: Sequence[int]) -> Columns:
    """Return outlines of one standard deviation of the replicates around their mean, ms and mm."""
    colour = colours(campaign)
    columns: Columns = {"xs": [], "ys": [], "colour": []}
    for condition in _conditions(campaign, shown):
        band = campaign.bands.get(condition)
        if band is None or band.time_s.size < 2:
            continue
        rows = plotted_rows(band.time_s.size, int(np.searchsorted(band.time_s, 0.0)))
        time_ms, mean_mm, sigma_mm = (1e3 * part[rows] for part in (band.time_s, band.mean_m, band.sigma_m))
        columns["xs"].append(np.concatenate([time_ms, time_ms[::-1]]))
        columns["ys"].append(np.concatenate([mean_mm - sigma_mm, (mean_mm + sigma_mm)[::-1]]))
        columns["colour"].append(colour[condition])
    return columns


def model_lines(campaign: Campaign, curves: Curves, shown: Sequence[int]) -> Columns:
    """Return one line per condition, of its longest trial that is shown: `xs` ms since release, `ys` mm of growth."""
    columns: Columns = {"xs": [], "ys": []}
    for condition in _conditions(campaign, shown):
        members = [i for i in shown if campaign.trials[i].condition == condition]
        longest = max(members, key=lambda i: campaign.trials[i].time_s[-1])
        aligned = campaign.trials[longest]
        rows = plotted_rows(aligned.time_s.size, aligned.first_counted_frame(aligned.release_s))
        columns["xs"].append(1e3 * aligned.time_s[rows])
        columns["ys"].append(1e3 * curves[longest].growth_m[rows])
    return columns


def residual_lines(campaign: Campaign, curves: Curves, shown: Sequence[int]) -> Columns:
    """Return lines of measurement minus model, `ys` mm, against the growth, `xs` mm."""
    trials = [(campaign.trials[i], curves[i]) for i in shown]
    return _lines_by_trial(campaign, [(aligned, aligned.growth_m, motion.residual_m) for aligned, motion in trials])


def error_bars(
    campaign: Campaign,
    now_m: Mapping[str, float],
    before_m: Mapping[str, float],
    floors_m: Mapping[str, float],
    shown: Sequence[str],
) -> Columns:
    """Return one row per condition, the first at the bottom: `label`, `now`, `before`, `floor` (mm),
    `colour`, `alpha`.
    """
    colour = colours(campaign)
    names = list(reversed(campaign.conditions))
    return {
        "condition": names,
        "label": [campaign.labels[name] for name in names],
        "now": [_mm(now_m.get(name)) for name in names],
        "before": [_mm(before_m.get(name)) for name in names],
        "floor": [_mm(floors_m.get(name)) for name in names],
        "colour": [colour[name] for name in names],
        "alpha": [0.95 if name in shown else 0.3 for name in names],
    }


def axis_ranges(columns: Columns, share: float = 0.05) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return ranges that contain all lines with a margin. Returns (left, right), (bottom, top)."""
    if not columns["xs"]:
        return (0.0, 1.0), (0.0, 1.0)
    ranges = []
    for key in ("xs", "ys"):
        low = min(float(np.nanmin(part)) for part in columns[key])
        high = max(float(np.nanmax(part)) for part in columns[key])
        room = share * ((high - low) or 1.0)
        ranges.append((low - room, high + room))
    return ranges[0], ranges[1]


def symmetric_range(columns: Columns, least_mm: float = 0.1) -> tuple[float, float]:
    """Return a symmetric range for residuals, rounded so that it rarely changes while a slider moves. Returns low, high
    : float, mm.
    """
    parts: list[Floats] = columns["ys"]
    largest = max((float(np.nanmax(np.abs(part))) for part in parts), default=least_mm)
    step = 10 ** math.floor(math.log10(max(largest, least_mm)))
    reach = next(step * k for k in (1.2, 2, 3, 5, 7, 10) if step * k >= 1.05 * max(largest, least_mm) or k == 10)
    return -reach, reach


def _conditions(campaign: Campaign, shown: Sequence[int]) -> list[str]:
    present = {campaign.trials[i].condition for i in shown}
    return [name for name in campaign.conditions if name in present]


def _mm(value: float | None) -> float:
    return math.nan if value is None else 1e3 * value
