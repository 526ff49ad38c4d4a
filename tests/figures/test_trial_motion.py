"""The figure of one trial, from tables written by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from vinetrack.figures.motion_figures import draw_trial_motion
from vinetrack.figures.style import RULE_COLOURS, look

TIME_S = np.arange(200) / 1000
LONG = "still accelerating: the speed rises by 24 % (20 to 28 %) across the window; choose a later start " * 3


def tables(n: int = 200) -> tuple[pd.DataFrame, pd.DataFrame]:
    time_s = np.arange(n) / 1000
    flag = np.full(n, "", dtype=object)
    flag[7] = "rejected"
    track = pd.DataFrame({"time_s": time_s, "lead_position_m": time_s, "flag": flag})
    kinematics = pd.DataFrame(
        {
            "time_s": time_s,
            "lead_position_m": time_s,
            "lead_velocity_m_s": np.ones(n),
            "lead_velocity_sigma_m_s": np.full(n, 0.02),
        }
    )
    return track, kinematics


def window(rule: str, accepted: bool, reason: str = "because", x_ss_m_s: float = 2.0) -> dict:
    span = {"from_s": 0.05, "to_s": 0.15} if np.isfinite(x_ss_m_s) else {"from_s": np.nan, "to_s": np.nan}
    return {"rule": rule, "accepted": accepted, "reason": reason, "x_ss_m_s": x_ss_m_s, "x_ss_sigma_m_s": 0.01, **span}


def figure(*windows: dict, travel_ratio: float = 2.0) -> Figure:
    columns = list(window("gated", True))
    return draw_trial_motion("a · 12 mm", *tables(), pd.DataFrame(windows, columns=columns), travel_ratio)


def words(drawn: Figure) -> str:
    return "\n".join(text.get_text() for text in drawn.findobj(Text))


def test_every_rule_has_its_verdict_and_reason_in_words() -> None:
    said = words(figure(window("gated", True, "steady"), window("paper", True), window("user", False, "too early")))
    assert "gated rule: accepted, x_ss 2.000 ± 0.010" in said
    assert "paper's rule: accepted" in said
    assert "chosen by hand: rejected" in said
    assert "too early" in said


def test_an_accepted_window_is_filled_and_a_rejected_one_hollow() -> None:
    strip = figure(window("gated", True), window("paper", False)).axes[0]
    filled, hollow = strip.patches
    assert to_hex(filled.get_facecolor()) == RULE_COLOURS["gated"].lower()
    assert hollow.get_facecolor()[3] == 0


def test_x_ss_is_drawn_at_the_speed_of_the_leading_edge() -> None:
    speed = figure(window("gated", True, x_ss_m_s=2.0)).axes[1]
    level = next(line for line in speed.lines if to_hex(line.get_color()) == RULE_COLOURS["gated"].lower())
    assert list(level.get_ydata()) == [1.0, 1.0]


def test_a_body_that_moves_as_a_whole_has_no_second_axis() -> None:
    assert "tail (m/s)" in words(figure(window("gated", True)))
    assert "tail (m/s)" not in "".join(
        ax.get_ylabel() for ax in figure(window("gated", True), travel_ratio=1.0).findobj(type(Figure().add_subplot()))
    )


def test_points_left_out_are_crossed_and_counted() -> None:
    drawn = figure(window("gated", True))
    assert "1 left out" in words(drawn)
    crosses = next(line for line in drawn.axes[2].lines if line.get_marker() == "x")
    assert len(crosses.get_xdata()) == 1


def test_a_trial_without_a_window_is_drawn_with_the_reason() -> None:
    assert "never steady" in words(figure(window("gated", False, "never steady", np.nan)))


def test_a_trial_without_positions_has_no_figure() -> None:
    track, kinematics = tables()
    rules = pd.DataFrame([window("gated", False)])
    assert draw_trial_motion("a", track.iloc[:0], kinematics.iloc[:0], rules) is None


def test_a_long_track_is_thinned() -> None:
    track, kinematics = tables(20_000)
    drawn = draw_trial_motion("a", track, kinematics, pd.DataFrame([window("gated", True)]))
    dots = next(line for line in drawn.axes[2].lines if line.get_marker() == ".")
    assert len(dots.get_xdata()) <= 610


def test_long_reasons_and_titles_stay_inside_the_figure() -> None:
    rows = pd.DataFrame([window(rule, False, LONG) for rule in RULE_COLOURS])
    drawn = draw_trial_motion("W" * 60 + " · 24 mm × 200 µm × 280 mm · 28 kPa · 35.6 g", *tables(), rows)
    with look():
        drawn.draw_without_rendering()
        inside, edge = drawn.get_tightbbox(), drawn.bbox_inches.padded(0.01)
    assert edge.x0 <= inside.x0
    assert inside.x1 <= edge.x1
    assert edge.y0 <= inside.y0
    assert inside.y1 <= edge.y1
