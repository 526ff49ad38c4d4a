"""Trials in the report: values, status and reason, strip, motion, data, and calibration."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.numbers import number, with_error
from vinetrack.core.records import split_flags
from vinetrack.figures.style import RULE_NAMES, rows
from vinetrack.report.section import data_uri
from vinetrack.report.svg import inline_svg

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.report.build import ReportContent

MAX_SVG_BYTES = 1_500_000  # Chosen: a tenth of the 15 MB that a report may have

CALIBRATION_NAMES = {
    "charuco": "ChArUco board",
    "checkerboard": "checkerboard",
    "two_points": "two points and their distance",
    "mm_per_px": "millimetres per pixel, as given",
    "sheet": "millimetres per pixel, from the sheet",
}
FLAG_WORDS = {
    "before_release": "before release",
    "lost": "without the edge",
    "corrected": "corrected by hand",
    "after_end": "after the end",
}
SHARED_ERROR = (
    "The error of the scale is stated separately from the random error of single points: it is common to all points of "
    "a recording and to all recordings of one target. It changes every length and speed by the same factor, so that "
    "replicates do not show it and averaging does not reduce it. It is not included in the ± of a speed or in "
    "bootstrap intervals; the wider intervals of B include it (a relative scale error ε changes ln B by n·ε), and n is "
    "independent of it."
)

# Methods for recordings, as (heading, paragraph) pairs
METHODS = (
    (
        "Edge",
        "A strip along the axis of growth is cut from every frame; flicker and shake are estimated from the stationary "
        "scene beside the vine and removed. A pixel that the vine covers changes once: its brightness before and after "
        "and the position of the edge in every frame are estimated alternately, the edge by maximum likelihood from a "
        "step blurred by the optics and by its own motion, at mid-exposure. Time is the frame number divided by the "
        "capture rate.",
    ),
    (
        "Scale",
        "Positions along the axis are converted with the model of a camera with radial distortion looking at a tilted "
        "plane, fitted to the corners of the target; without a target, with a single scale.",
    ),
)


@dataclass(frozen=True)
class TrackedRecording:
    """A recording in the report: its strip as SVG ("" for none), the flags of its frames, and its calibration.
    `calibration` was written by the recording's stage: `kind, image, mm_per_px, scale_rel_sigma, reprojection_px,
    n_corners, n_pictures, notes`; None if there is none.
    """

    strip: str
    flags: Sequence[str]
    calibration: Mapping[str, Any] | None = None


def count_frames(flags: Iterable[str]) -> str:
    """Return the number of frames, and of those with each flag, as text."""
    flags = list(flags)
    counted = Counter(part for flag in flags for part in split_flags(flag))
    parts = [f"{count} {FLAG_WORDS.get(flag, flag)}" for flag, count in counted.items()]
    return f"{len(flags)} frames" + (f": {', '.join(parts)}" if parts else "")


def calibration_table(recordings: Mapping[str, TrackedRecording]) -> list[dict[str, Any]]:
    """Return one row per calibration, with its results and its trials."""
    groups: dict[tuple[Any, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, recording in recordings.items():
        calibration = recording.calibration
        if calibration is not None:
            key = (
                calibration["kind"],
                calibration["image"],
                calibration["n_corners"],
                calibration["reprojection_px"],
                *calibration["notes"],
            )
            if calibration["kind"] == "sheet":
                key = (*key, calibration["mm_per_px"])
            groups.setdefault(key, []).append((name, calibration))
    return [_calibration_row(members) for members in groups.values()]


def _calibration_row(members: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    first = members[0][1]
    scales = [calibration["mm_per_px"] for _, calibration in members]
    spread = f"{number(min(scales), 6)}"
    if max(scales) - min(scales) > 1e-5 * max(scales):
        spread += f" to {number(max(scales), 6)}"
    errors = [
        calibration["scale_rel_sigma"] for _, calibration in members if _is_number(calibration["scale_rel_sigma"])
    ]
    has_target = bool(first["n_corners"]) and _is_number(first["reprojection_px"])
    return {
        "kind": CALIBRATION_NAMES.get(first["kind"], first["kind"]),
        "image": first["image"] or "",
        "mm_per_px": spread,
        "error": f"{number(100 * max(errors), 2)} %" if errors else "unknown",
        "reprojection": f"{number(first['reprojection_px'], 2)} px" if has_target else "–",
        "corners": f"{first['n_corners']} in {first['n_pictures']}" if has_target else "–",
        "notes": list(first["notes"]),
        "trials": f"{len(members)} recordings" if len(members) > 1 else members[0][0],
    }


def _is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


MAX_TRIAL_FIGURES_BYTES = 10_000_000  # Total size of the figures of single trials

MAX_DATA_ROWS, MAX_DATA_ROWS_TOTAL = 240, 24_000  # Maximum rows of motion data in the page, per trial and in total


def trial_entries(content: ReportContent) -> tuple[list[dict[str, Any]], int]:
    """Return all trials for the template, and the number of trials whose figures were left out for size. Returns
    entries, n_left_out.
    """
    entries, left_out, weight = [], 0, 0
    for row in rows(content.trials):
        entry = _trial_numbers(row, content)
        strip, motion = _trial_pictures(row, content)
        if weight + len(strip) + len(motion) > MAX_TRIAL_FIGURES_BYTES:
            left_out += bool(strip or motion)
            strip = motion = ""
        weight += len(strip) + len(motion)
        entries.append(entry | _marked(strip=strip, motion=motion))
    return entries, left_out


def _marked(**pictures: str) -> dict[str, Any]:
    from markupsafe import Markup

    return {name: Markup(svg) for name, svg in pictures.items()}


def _trial_pictures(row: Any, content: ReportContent) -> tuple[str, str]:
    """Strip and motion figure of one trial, ready for the page; blank if there is none."""
    name = row.trial
    recording, motion = content.recordings.get(name), content.trial_figures.get(name, "")
    strip = recording.strip if recording is not None else ""
    if row.status == "failed":
        return "", ""
    return (
        inline_svg(strip, f"s-{name}", f"Strip of {name} with its tracked edge") if _fits(strip) else "",
        inline_svg(motion, f"t-{name}", f"Motion of {name}") if _fits(motion) else "",
    )


def _fits(svg: str) -> bool:
    return 0 < len(svg) <= MAX_SVG_BYTES


def _trial_numbers(row: Any, content: ReportContent) -> dict[str, Any]:
    curve, recording = content.kinematics.get(row.trial), content.recordings.get(row.trial)
    spark, data = "", ""
    if curve is not None and len(curve) > 1:
        time_s, speed_m_s = (curve[name].to_numpy(dtype=float) for name in ("time_s", "lead_velocity_m_s"))
        spark = speed_sparkline(time_s, speed_m_s, (row.steady_from_s, row.steady_to_s))
        data = data_uri(f"{row.trial}.csv", _thinned(curve, len(content.trials)))
    return {
        "trial": row.trial,
        "vine": row.vine,
        "condition": row.condition,
        "status": row.status,
        "reason": row.reason if isinstance(row.reason, str) else "",
        "x_ss": with_error(row.x_ss_m_s, row.x_ss_sigma_m_s),
        "x_ss_paper": number(row.x_ss_paper_m_s),
        "force": number(row.force_N),
        "final": number(row.final_lead_velocity_m_s),
        "efficiency": number(100 * row.efficiency),
        "frames": "" if recording is None or row.status == "failed" else count_frames(recording.flags),
        "clip": content.clips.get(row.trial, ""),
        "data": data,
        "windows": [_window(window) for window in rows(content.windows[content.windows["trial"] == row.trial])],
        **_marked(spark=spark),
    }


def _thinned(curve: pd.DataFrame, n_trials: int) -> str:
    """Motion of a trial as CSV, with five digits, more than the accuracy of any value."""
    most = max(min(MAX_DATA_ROWS_TOTAL // n_trials, MAX_DATA_ROWS), 2)
    shown = curve.iloc[:: -(-len(curve) // most)]
    return str(shown.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _window(window: Any) -> dict[str, str]:
    return {
        "rule": RULE_NAMES.get(window.rule, str(window.rule)),
        "verdict": "accepted" if window.accepted else "rejected",
        "from_to": f"{number(window.from_s, 4)} to {number(window.to_s, 4)} s",
        "points": str(int(window.points)),
        "x_ss": with_error(window.x_ss_m_s, window.x_ss_sigma_m_s),
        "drift": number(100 * window.drift, 2),
        "cv": number(100 * window.cv, 2),
        "reason": window.reason if isinstance(window.reason, str) else "",
    }


def speed_sparkline(
    time_s: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    steady_s: tuple[float, float],
    width_px: int = 132,
    height_px: int = 30,
) -> str:
    """Return speed against time as a small SVG, with the steady window thick; blank if there is nothing to draw.
    Shapes: time_s, speed_m_s (n_points,).
    """
    good = np.isfinite(time_s) & np.isfinite(speed_m_s)
    time_s, speed_m_s = time_s[good], speed_m_s[good]
    if time_s.size < 2 or np.ptp(time_s) <= 0:
        return ""
    step = max(time_s.size // width_px, 1)
    time_s, speed_m_s = time_s[::step], speed_m_s[::step]
    top = max(float(np.percentile(speed_m_s, 99)), 1e-12)
    x = 1 + (width_px - 2) * (time_s - time_s[0]) / np.ptp(time_s)
    y = np.clip(height_px - 2 - (height_px - 5) * speed_m_s / top, 1, height_px - 1)
    steady = (time_s >= steady_s[0]) & (time_s <= steady_s[1])
    thick = f'<polyline class="steady" points="{_polyline(x[steady], y[steady])}"/>' if steady.sum() > 1 else ""
    return (
        f'<svg class="spark" viewBox="0 0 {width_px} {height_px}" width="{width_px}" height="{height_px}" '
        f'aria-hidden="true"><polyline points="{_polyline(x, y)}"/>{thick}</svg>'
    )


def _polyline(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
