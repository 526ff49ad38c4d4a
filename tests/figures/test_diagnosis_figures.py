"""Figures of a diagnosis and of the paper's numbers, from tables written by hand."""

import math
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hand_diagnosis import ladder
from matplotlib.colors import to_hex
from test_figures import assert_nothing_is_cut_off

from vinetrack.figures import damping_figures as paper_figures
from vinetrack.figures import diagnosis_figures as figures
from vinetrack.figures.style import BLUE, MUTED, ORANGE, VERMILLION

NOTHING = dict.fromkeys(("lead_position_m", "tail_velocity_m_s", "time_s", "pressure_Pa"), math.nan)
OFF_M = {"before": 8e-3, "after": 1e-3}


def test_the_ladder_falls_in_millimetres_on_a_logarithmic_axis():
    (ax,) = figures.draw_ladder(ladder("", "reservoir_depletion")).axes
    assert ax.get_yscale() == "log"
    assert "(mm)" in ax.get_ylabel()
    curves = [line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 2 and line.get_marker() != "None"]
    assert np.array(curves) == pytest.approx(np.array([[9, 1.8], [10, 2], [11, 2.2]]))
    assert [label.get_text() for label in ax.get_xticklabels()] == ["refuted\ninitial model", "+ reservoir\ndepletion"]


def test_a_condition_is_drawn_before_and_after_with_its_errors():
    time_s = np.arange(-10, 100) * 1e-3
    moved_m = np.maximum(time_s, 0)
    table = pd.DataFrame({"time_s": time_s, "lead_position_m": moved_m})
    table = table.assign(**{f"model_{name}_m": moved_m - off * (time_s >= 0) for name, off in OFF_M.items()})
    table = pd.concat([table.assign(trial=name) for name in "ab"])
    growth, left = figures.draw_before_after("24 kPa", table, "air drag").axes
    shown = [text.get_text() for text in growth.get_legend().get_texts()]
    assert shown == ["measured, N = 2", "model in use: 8.0 mm rms", "with air drag: 1.0 mm rms"]
    assert {to_hex(line.get_color()) for line in left.lines} >= {figures.BEFORE.lower(), figures.AFTER.lower()}
    assert left.lines[0].get_ydata()[-1] == pytest.approx(8.0)


def test_candidates_are_bars_of_the_root_of_their_gain_the_answer_in_colour():
    columns = {
        "effect": ["air_drag", "leak", "time_base", "payload_drag"], "sigma": [20.0, 10.0, 5.0, math.nan],
        "kind": ["physical", "physical", "measurement", "physical"], "delta_chi2": [400.0, 100.0, 25.0, math.nan],
        "status": ["refitted", "refitted", "screened", "not testable here"], "in_answer_set": [True] + [False] * 3,
    }  # fmt: skip
    table = pd.DataFrame(columns)
    (ax,) = figures.draw_candidates([("What is missing?", table.assign(plausible=True, size="k = 1.0 ± 0.1"))]).axes
    assert [bar.get_width() for bar in ax.patches] == pytest.approx([20, 10, 5])
    assert [to_hex(bar.get_edgecolor()) for bar in ax.patches] == [BLUE.lower(), MUTED, ORANGE.lower()]
    assert ax.patches[2].get_facecolor()[3] == 0
    assert [label.get_text() for label in ax.get_yticklabels()] == ["air drag", "leak", "time base"]
    assert "k = 1.0 ± 0.1" in ax.texts[0].get_text()


def test_a_drifting_parameter_is_drawn_against_the_condition():
    """B of one vine against pressure, before and after; γ, that only the larger model has, against the vine."""
    row = {"parameter": "eversion_damping.B", "vine": "v", "symbol": "B", "against": "pressure_Pa", "n_trials": 2}
    rows = [
        row | {"model": model, "level": 1e3 * kPa, "ratio": 1 + slope * (kPa - 40) / 40, "ratio_sigma": 0.02}
        for (model, slope), kPa in product((("before", -0.3), ("after", 0.0)), (24, 36, 60))
    ]
    gamma = {"parameter": "reservoir_depletion.gamma", "symbol": "γ", "against": "vine", "level": math.nan}
    (ax,) = figures.draw_drift(pd.DataFrame([*rows, rows[-1] | gamma]), "air drag").axes
    assert ax.get_xlabel() == "pressure (kPa)"
    assert ax.get_title(loc="left") == "B against pressure, N = 6"
    before, after = (container.lines[0] for container in ax.containers)
    assert before.get_xdata() == pytest.approx([24, 36, 60])
    assert before.get_ydata() == pytest.approx([1.12, 1.03, 0.85])
    assert after.get_ydata() == pytest.approx([1, 1, 1])


def test_the_misfit_is_coloured_by_sign_and_numbered_where_it_exceeds_scatter():
    cells = [
        {"condition_label": f"12 mm, {k} kPa", "n_trials": 2, "growth_from": g / 4, "growth_to": (g + 1) / 4}
        | {"misfit_m": sign * 1e-3 * (g + 1), "scatter_m": 0.6e-3}
        for (k, sign), g in product(((24, 1), (60, -1)), range(4))
    ]
    (ax,) = figures.draw_where(pd.DataFrame(cells)).axes
    sides = [to_hex(patch.get_facecolor()) for patch in ax.patches]
    assert sides == [BLUE.lower()] * 4 + [VERMILLION.lower()] * 4
    depths = [patch.get_alpha() for patch in ax.patches[:4]]
    assert depths == sorted(depths)
    assert [text.get_text() for text in ax.texts] == ["+2.0", "+3.0", "+4.0", "−2.0", "−3.0", "−4.0"]


# The learned force as a curve or a map, with units, and blank outside the range of the trials.
Y, V = np.linspace(0, 0.25, 26), np.linspace(0, 8, 20)


def test_a_force_of_one_variable_is_a_curve_with_its_band_where_trials_have_been():
    curve = pd.DataFrame({**NOTHING, "lead_position_m": Y, "force_N": -Y, "sigma_N": 0.02, "trials": Y < 0.2})
    (ax,) = figures.draw_learned_force(pd.concat([curve.assign(condition=name) for name in ("", "a", "b")])).axes
    assert ax.get_xlabel() == "growth y (mm)"
    line = next(line for line in ax.lines if line.get_label() == "learned force")
    assert line.get_xdata().max() == pytest.approx(190.0)
    band = ax.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(1.96 * 0.02)


def test_a_force_of_two_variables_is_a_map_beside_its_error():
    y, v = (grid.ravel() for grid in np.meshgrid(Y, V, indexing="ij"))
    places = {**NOTHING, "lead_position_m": y, "tail_velocity_m_s": v, "sigma_N": 0.02}
    surface = pd.DataFrame({**places, "force_N": -y * v, "trials": v < 6, "condition": ""})
    along = surface[v == V[10]].assign(condition="a")
    force, error, *bars = figures.draw_learned_force(pd.concat([surface, along])).axes
    assert (force.get_xlabel(), force.get_ylabel()) == ("growth y (mm)", "tail speed ẋ (m/s)")
    assert [bar.get_ylabel() for bar in bars] == ["missing force (N)", "its standard error (N)"]
    # The one condition's motion, over either map.
    assert [len(ax.lines) for ax in (force, error)] == [1, 1]


# Figures for comparison with the paper, from tables written by hand: content, and nothing cut off.
NAMES = ("depletion_slow", "depletion_fast", "slack", "depletion_slow_slack", "depletion_fast_slack")


def test_eq2_is_drawn_as_it_moves_and_the_mean_as_points():
    way, time_s = np.linspace(0, 1, 30), np.linspace(0, 1 / 7, 100)
    parts = []
    for kPa, (k, name) in product((7, 14, 28), enumerate(("eq2", *NAMES))):
        moved = {"time_s": way * (1 + 0.3 * k) / kPa, "lead_position_m": 0.28 * way * (1 - 0.05 * k)}
        parts.append(pd.DataFrame(moved).assign(pressure_kPa=float(kPa), departure=name))
    mean = pd.DataFrame({"time_s": time_s, "lead_position_m": 0.28 * 7 * time_s, "pressure_kPa": 7.0})
    mean = mean.assign(lead_position_sigma_m=0.002, n_trials=4)
    errors = pd.DataFrame({"pressure_kPa": [7.0], "rms_mean_m": [0.0032]})
    fig = paper_figures.draw_paper_position(pd.concat(parts, ignore_index=True), mean, errors)
    (eq2,) = (line for line in fig.axes[0].lines if line.get_label().startswith("Eq. (2)"))
    assert eq2.get_ydata()[-1] == pytest.approx(28.0)
    (points,) = (line for line in fig.axes[0].lines if line.get_marker() == "o")
    assert np.allclose(points.get_ydata(), 28 * 7 * np.asarray(points.get_xdata()))
    assert_nothing_is_cut_off(fig)


def test_printed_lines_have_the_printed_slope():
    laws = product(((1, 0.57), (4, 6.44)), (0.5, 1.0, 2.0, 4.0))
    rows = [(f"v{scale}", 6.0 * scale, 50.0 * scale, speed, B * speed**0.37) for (scale, B), speed in laws]
    columns = ["vine", "diameter_mm", "thickness_um", "x_ss_m_s", "force_N"]
    table = pd.DataFrame([*rows, ("other", 30.0, 50.0, 1.0, 1.0)], columns=columns)
    paper = {"x_ss_paper_m_s": 1.1 * table["x_ss_m_s"], "force_paper_N": 0.99 * table["force_N"]}
    table = table.assign(**paper, eligible=True, used=table["x_ss_m_s"] > 0.6)
    law = {"n": 0.372, "n_95": [0.36, 0.384], "vines": {"v1": {"B": 0.575}, "v4": {"B": 6.4}}}
    fig = paper_figures.draw_paper_damping(table, {"paper": law | {"n": 0.38}, "both_axes": law})
    dashed = [line for line in fig.axes[0].lines if line.get_linestyle() == "--"]
    assert len(dashed) == 2
    assert np.polyfit(*np.log(dashed[0].get_data()), 1) == pytest.approx([0.37, np.log(0.57)])
    assert_nothing_is_cut_off(fig)


def test_final_speeds_stand_beside_eq2_where_payloads_differ():
    row = {"vine": "v", "final_at_mm": 120.0, "n_final": 4, "final_lead_velocity_sigma_m_s": 0.02}
    at = product((14.0, 28.0), (0.0, 20.0, 35.6))
    speeds = pd.DataFrame([row | {"pressure_kPa": kPa, "payload_g": g} for kPa, g in at])
    speeds = speeds.assign(final_lead_velocity_m_s=speeds["pressure_kPa"] / 20 - speeds["payload_g"] / 100)
    fig = paper_figures.draw_paper_speeds(speeds, speeds.assign(final_lead_velocity_m_s=1.0))
    (ax,) = fig.axes
    assert [len(container.lines[0].get_xdata()) for container in ax.containers] == [3, 3]
    assert len([line for line in ax.lines if list(line.get_ydata()) == [1.0] * 3]) == 2
    assert paper_figures.draw_paper_speeds(speeds.assign(pressure_kPa=range(6)), speeds) is None
    assert_nothing_is_cut_off(fig)


def test_nothing_of_the_reservoir_is_cut_off():
    y = np.linspace(0, 0.28, 5)
    left = [pd.DataFrame({"lead_position_m": y, "gauge_left": 1 - y / 2, "pressure_kPa": kPa}) for kPa in (7.0, 28.0)]
    pressures = [one.assign(departure=name) for one in left for name in NAMES[:2]]
    assert_nothing_is_cut_off(paper_figures.draw_paper_reservoir(pd.concat(pressures, ignore_index=True)))
