"""Figures for comparison with the paper, from tables written by hand: content, and nothing cut off."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from figure_frames import assert_nothing_is_cut_off, words

from vinetrack.figures.paper_figures import (
    draw_paper_damping,
    draw_paper_position,
    draw_paper_reservoir,
    draw_paper_rms,
    draw_paper_speeds,
)

NAMES = ("depletion_slow", "depletion_fast", "slack", "depletion_slow_slack", "depletion_fast_slack")
PRINTED_CM = {7: 1.90, 14: 0.29, 28: 0.31}


def motions() -> pd.DataFrame:
    parts = []
    for pressure_kPa in PRINTED_CM:
        for k, name in enumerate(("eq2", *NAMES)):
            time_s = np.linspace(0, (1 + 0.3 * k) / pressure_kPa, 30)
            position_m = 0.28 * time_s / time_s[-1] * (1 - 0.05 * k)
            columns = {"pressure_kPa": float(pressure_kPa), "departure": name}
            parts.append(pd.DataFrame({"time_s": time_s, "lead_position_m": position_m} | columns))
    return pd.concat(parts, ignore_index=True)


def means() -> pd.DataFrame:
    time_s = np.linspace(0, 1 / 7, 100)
    columns = {"pressure_kPa": 7.0, "lead_position_sigma_m": 0.002, "n_trials": 4}
    return pd.DataFrame({"time_s": time_s, "lead_position_m": 0.28 * 7 * time_s} | columns)


ERRORS = pd.DataFrame({"pressure_kPa": [7.0], "rms_mean_m": [0.0032]})


def test_every_pressure_has_a_panel_with_its_errors() -> None:
    figure = draw_paper_position(motions(), means(), ERRORS)
    assert len(figure.axes) == 3
    assert "7 kPa\nrms: printed 1.90 cm, ours 0.32 cm" in words(figure)
    assert "28 kPa\nrms: printed 0.31 cm, not among the trials" in words(figure)


def test_eq2_is_drawn_as_it_moves_and_the_mean_as_points() -> None:
    ax = draw_paper_position(motions(), means(), ERRORS).axes[0]
    (eq2,) = (line for line in ax.lines if line.get_label().startswith("Eq. (2)"))
    assert eq2.get_ydata()[-1] == pytest.approx(28.0)
    (mean,) = (line for line in ax.lines if line.get_marker() == "o")
    assert np.allclose(mean.get_ydata(), 28 * 7 * np.asarray(mean.get_xdata()))


def points() -> pd.DataFrame:
    rows = []
    for scale, B in ((1, 0.57), (4, 6.44)):
        for speed in (0.5, 1.0, 2.0, 4.0):
            force = B * speed**0.37
            rows.append(
                (f"v{scale}", 6.0 * scale, 50.0 * scale, speed, force, 1.1 * speed, 0.99 * force, True, speed > 0.6)
            )
    rows.append(("other", 30.0, 50.0, 1.0, 1.0, 1.0, 1.0, True, True))
    columns = ["vine", "diameter_mm", "thickness_um", "x_ss_m_s", "force_N", "x_ss_paper_m_s", "force_paper_N"]
    return pd.DataFrame(rows, columns=[*columns, "eligible", "used"])


def damping() -> dict:
    law = {"n": 0.372, "n_95": [0.36, 0.384], "vines": {"v1": {"B": 0.575}, "v4": {"B": 6.4}}}
    return {"paper": law | {"n": 0.38}, "both_axes": law}


def test_both_rules_have_a_panel_with_their_own_points() -> None:
    figure = draw_paper_damping(points(), damping())
    counts = [[len(line.get_xdata()) for line in ax.lines if line.get_marker() in ("o", "D")] for ax in figure.axes]
    assert counts == [[4, 4], [3, 3]]
    assert "n = 0.380 (95 %: 0.360 to 0.384), printed 0.37" in words(figure)
    assert "R = 4: B 6.40, printed 6.44; N = 3" in words(figure)


def test_printed_lines_have_the_printed_slope() -> None:
    ax = draw_paper_damping(points(), damping()).axes[0]
    dashed = [line for line in ax.lines if line.get_linestyle() == "--"]
    assert len(dashed) == 2
    x, y = (np.log(values) for values in dashed[0].get_data())
    assert np.polyfit(x, y, 1) == pytest.approx([0.37, np.log(0.57)])


def pressures() -> pd.DataFrame:
    y = np.linspace(0, 0.28, 5)
    parts = []
    for pressure_kPa in (7.0, 28.0):
        for name, loss in (("depletion_slow", 0.15), ("depletion_fast", 0.21)):
            columns = {"pressure_kPa": pressure_kPa, "departure": name}
            parts.append(pd.DataFrame({"lead_position_m": y, "gauge_left": 1 - loss * y / 0.28} | columns))
    return pd.concat(parts, ignore_index=True)


def test_the_fall_of_pressure_is_said_with_its_range() -> None:
    figure = draw_paper_reservoir(pressures())
    assert "28 kPa: −15 to −21 %" in words(figure)
    assert "3.4 %" in words(figure)


def departures() -> pd.DataFrame:
    rows = [
        (figure, float(kPa), name, 0.01 * (k + 1), 0.1 * (k + 1))
        for figure, pressures_kPa in (("Fig. 4", (7, 14, 28)), ("Fig. 5", (14, 28, 41)))
        for kPa in pressures_kPa
        for k, name in enumerate(NAMES)
    ]
    columns = ["figure", "pressure_kPa", "departure", "rms_position_m", "rms_final_lead_velocity_m_s"]
    return pd.DataFrame(rows, columns=columns)


def paper() -> pd.DataFrame:
    return pd.DataFrame({"row": ["position_rms_7kPa", "final_speed_rms_41kPa"], "ours": [0.32, 0.07]})


def test_published_errors_stand_beside_ours() -> None:
    left, right = draw_paper_rms(paper(), departures()).axes
    published, ours = (line.get_ydata() for line in left.lines[:2])
    assert list(published) == [1.90, 0.29, 0.31]
    assert ours[0] == 0.32
    assert np.isnan(ours[1])
    assert "m/s" in right.get_ylabel()


def speeds() -> pd.DataFrame:
    row = {"vine": "v", "final_at_mm": 120.0, "n_final": 4, "final_lead_velocity_sigma_m_s": 0.02}
    rows = [
        row | {"pressure_kPa": kPa, "payload_g": g, "final_lead_velocity_m_s": kPa / 20 - g / 100}
        for kPa in (14.0, 28.0)
        for g in (0.0, 20.0, 35.6)
    ]
    return pd.DataFrame(rows)


def test_final_speeds_stand_beside_eq2_where_payloads_differ() -> None:
    (ax,) = draw_paper_speeds(speeds(), speeds().assign(final_lead_velocity_m_s=1.0)).axes
    assert [len(container.lines[0].get_xdata()) for container in ax.containers] == [3, 3]
    assert len([line for line in ax.lines if list(line.get_ydata()) == [1.0] * 3]) == 2
    assert draw_paper_speeds(speeds().assign(pressure_kPa=range(6)), speeds()) is None


def test_without_trials_of_a_printed_size_there_is_no_fig_6() -> None:
    assert draw_paper_damping(points().iloc[-1:], damping()) is None
    assert draw_paper_damping(points().assign(used=False, eligible=False), damping()) is None


def test_nothing_is_cut_off() -> None:
    assert_nothing_is_cut_off(draw_paper_position(motions(), means(), ERRORS))
    assert_nothing_is_cut_off(draw_paper_damping(points(), damping()))
    assert_nothing_is_cut_off(draw_paper_reservoir(pressures()))
    assert_nothing_is_cut_off(draw_paper_rms(paper(), departures()))
    assert_nothing_is_cut_off(draw_paper_speeds(speeds(), speeds()))
