"""Every trial as the report shows it: its numbers, its status and why, its strip, its motion, its data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number, with_error
from vinetrack.figures.style import RULE_NAMES, rows
from vinetrack.report.recordings import LARGEST_SVG_BYTES, count_frames
from vinetrack.report.section import data_uri
from vinetrack.report.svg import inline_svg, speed_sparkline

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.report.build import ReportContent

PICTURES_BYTES = 10_000_000
"""What the pictures of single trials may weigh together; the rest of 200 trials stays below 5 MB."""

MOST_ROWS, MOST_ROWS_IN_ALL = 240, 24_000
"""Of motion as data to download, of one trial and of all: what figures show; the whole is in the results folder."""


def trial_entries(content: ReportContent) -> tuple[list[dict[str, Any]], int]:
    """All trials for the template, and of how many the pictures were too much for one page."""
    entries, left_out, weight = [], 0, 0
    for row in rows(content.trials):
        entry = _numbers(row, content)
        strip, motion = _pictures(row, content)
        if weight + len(strip) + len(motion) > PICTURES_BYTES:
            left_out += bool(strip or motion)
            strip = motion = ""
        weight += len(strip) + len(motion)
        entries.append(entry | _marked(strip=strip, motion=motion))
    return entries, left_out


def _marked(**pictures: str) -> dict[str, Any]:
    from markupsafe import Markup

    return {name: Markup(svg) for name, svg in pictures.items()}


def _pictures(row: Any, content: ReportContent) -> tuple[str, str]:
    """Strip and motion of one trial, ready for the page; blank where there is none."""
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
    return 0 < len(svg) <= LARGEST_SVG_BYTES


def _numbers(row: Any, content: ReportContent) -> dict[str, Any]:
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
    """A trial's motion as CSV, with five digits, which is finer than any of them is known."""
    most = max(min(MOST_ROWS_IN_ALL // n_trials, MOST_ROWS), 2)
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
