"""Figures, clips and strips from tables and arrays written by hand: values drawn, edges in place, nothing cut off."""

import math
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hand_diagnosis import ladder
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from vinetrack.core.records import Track
from vinetrack.figures import damping_figures, motion_figures
from vinetrack.figures import model_figures as figures
from vinetrack.figures.damping_figures import draw_damping_law, draw_scaling
from vinetrack.figures.motion_figures import TRACKED, ClipView, draw_strip
from vinetrack.figures.style import BLUE, MUTED, ORANGE, SKY, VERMILLION, look, render
from vinetrack.video.axis import Axis
from vinetrack.video.track import Tracking

N, COUNT = 0.4, 40
Y, V = np.linspace(0, 0.25, 26), np.linspace(0, 8, 20)
NOTHING = dict.fromkeys(("lead_position_m", "tail_velocity_m_s", "time_s", "pressure_Pa"), math.nan)
OFF_M = {"before": 8e-3, "after": 1e-3}
NAMES = ("depletion_slow", "depletion_fast", "slack", "depletion_slow_slack", "depletion_fast_slack")
REFUSED = {m: {"n": None, "n_95": [None, None], "vines": {}, "refused": "too few"} for m in ("log_log", "both_axes")}
EDGES = [
    motion_figures.Edge("tracked edge", TRACKED, np.array([math.nan, 200.0])),
    motion_figures.Edge("initial model", VERMILLION, np.array([0.0, 300.0]), np.array([0.0, 25.0]), 2.0),
    motion_figures.Edge("with air drag", SKY, np.array([0.0, 210.0]), np.array([0.0, math.nan]), 1.4),
]


def fit(*B: float) -> dict:
    sizes = [{"diameter_mm": 6.0 * k, "thickness_um": 48.0 * k, "n_trials": 5} for k in range(1, len(B) + 1)]
    bounds = [{"B": b, "B_95": [0.95 * b, 1.05 * b], "B_95_total": [0.9 * b, 1.1 * b], "R2": 0.98} for b in B]
    vines = {f"vine{i}": bound | size for i, (bound, size) in enumerate(zip(bounds, sizes, strict=True))}
    names = ["n", *(f"ln B {vine}" for vine in vines)]
    covariance = {"parameters": names, "matrix": (1e-4 * np.eye(len(names))).tolist()}
    found = {"n": N, "n_95": [0.39, 0.41], "n_95_total": [0.38, 0.42], "covariance": covariance}
    return found | {"vines": vines, "refused": None}


def damping(n_vines: int = 2) -> dict:
    return dict.fromkeys(("log_log", "both_axes"), fit(*range(1, n_vines + 1)))


def points(n_vines: int = 2) -> pd.DataFrame:
    columns = ["trial", "vine", "x_ss_m_s", "force_N", "used"]
    rows = [
        (f"v{i}_{k}", f"vine{i}", 2.0**k, (1.0 + i) * 2.0 ** (N * k), k < 4) for i in range(n_vines) for k in range(5)
    ]
    table = pd.DataFrame(rows, columns=columns)
    return table.assign(x_ss_sigma_m_s=0.02 * table["x_ss_m_s"], force_sigma_N=0.01)


def test_both_fits_are_lines_of_slope_n_in_the_band_of_the_covariance():
    ax = draw_damping_law(points(1), damping(1)).axes[0]
    curves = [line for line in ax.lines if line.get_marker() == "None" and len(line.get_xdata()) == 60]
    assert len(curves) == 2
    for line in curves:
        assert np.polyfit(*np.log(line.get_data()), 1)[0] == pytest.approx(N, abs=1e-9)
    x_ss_m_s = np.array([0.5, 1.0, 4.0])
    # Var(ln F) = Var(ln B) + ln²x·Var(n), the two being independent here.
    expected = np.sqrt(1e-4 + np.log(x_ss_m_s) ** 2 * 1e-4)
    assert damping_figures.log_force_sigma(fit(1.0), "vine0", x_ss_m_s) == pytest.approx(expected)


@pytest.mark.slow
def test_nothing_of_the_law_its_exponents_and_sizes_is_cut_off():
    sizes = [6.0, 12.0, 18.0, 24.0]
    B = [math.exp(-3.0) * size**1.8 for size in sizes]
    power = {"slope": 1.8, "slope_95": [1.2, 2.4], "intercept": -3.0, "intercept_95": [-4.0, -2.0], "R2": 0.98}
    power["p"] = 0.01
    family = {"along": "diameter_mm", "vines": [f"vine{i}" for i in range(4)], "sizes": sizes, "B": B}
    family |= {"B_95_total": [[0.9 * b, 1.1 * b] for b in B], "power": power, "line": power | {"slope": 0.3}}
    family |= {"refused": None}
    scaling = {"method": "both_axes", "isometric": [family], "thickness": [], "reason": None}
    for n_vines in (4, 20):
        assert_nothing_is_cut_off(draw_damping_law(points(n_vines), damping(n_vines)))
    assert_nothing_is_cut_off(draw_scaling(scaling))


def test_without_content_there_is_no_figure():
    assert draw_damping_law(points().iloc[:0], REFUSED) is None
    assert draw_scaling({"isometric": [], "thickness": []}) is None
    assert motion_figures.draw_model_comparison(comparison(1)[0].iloc[:0], {}) is None
    assert motion_figures.draw_model_residuals(comparison(1)[0].iloc[:0], {}) is None


# Figures of speed, efficiency and payload, from tables written by hand: content, text, and no overlaps.
def test_line_and_power_law_are_drawn_as_fitted():
    line = {"slope": 0.1, "slope_95": [0.02, 0.18], "intercept": 0.5, "intercept_95": [0, 1], "R2": 0.935, "p": 0.033}
    power = {**line, "slope": 0.7, "slope_95": [0.1, 1.3], "intercept": math.log(0.3), "p": 0.04}
    lines = {"power": power, "line": line, "refused": None}
    family = {
        "pressure_kPa": 24.0, "sizes": [6.0, 12.0, 24.0], "x_ss_m_s": [1.05, 1.71, 2.78],
        "x_ss_sigma_m_s": [0.05] * 3, "x_ss_over_diameter_1_s": [175.0, 142.0, 116.0],
        "x_ss_over_diameter_sigma_1_s": [None, 3.0, 3.0], "n_steady": [3, 4, 4], "over_diameter": lines,
    }  # fmt: skip
    ax = damping_figures.draw_speed_scaling({"steady_speed": [family | lines]}, "psi").axes[0]
    assert any(text.get_text().startswith("3.481 psi (24 kPa), N = 3") for text in ax.get_legend().get_texts())
    power, line = (curve for curve in ax.lines if len(curve.get_xdata()) == 100)
    assert line.get_ydata() == pytest.approx(0.5 + 0.1 * line.get_xdata())
    assert power.get_ydata() == pytest.approx(0.3 * power.get_xdata() ** 0.7)


def test_x_ss_is_drawn_at_the_speed_of_the_leading_edge():
    """All rules refuse but one, which finds 2 m/s of the tail."""
    time_s = np.arange(200) / 1000
    kinematics = pd.DataFrame({"time_s": time_s, "lead_position_m": time_s})
    track = kinematics.assign(flag=np.where(time_s == 0.007, "rejected", ""))
    kinematics = kinematics.assign(lead_velocity_m_s=1.0, lead_velocity_sigma_m_s=0.02)
    found = {"x_ss_m_s": 2.0, "x_ss_sigma_m_s": 0.01, "from_s": 0.05, "to_s": 0.15}
    windows = [{"rule": of, "accepted": of == "gated", **found} for of in ("gated", "quasi_steady", "paper", "user")]
    title = "W" * 60 + " · 24 mm × 200 µm × 280 mm · 28 kPa · 35.6 g"
    figure = motion_figures.draw_trial_motion(title, track, kinematics, pd.DataFrame(windows))
    level = next(line for line in figure.axes[0].lines if to_hex(line.get_color()) == BLUE.lower())
    assert list(level.get_ydata()) == [1.0, 1.0]
    assert_nothing_is_cut_off(figure)


# Figures of model and measurement: one condition, forty, and none.
def comparison(n_conditions: int, n_trials: int = 2) -> tuple[pd.DataFrame, dict[str, pd.DataFrame]]:
    """Every trial 5 mm ahead of the model once it moves, five times the scatter of replicates."""
    time_s = np.arange(-20, 100) * 1e-3
    model_m = 2 * np.maximum(time_s, 0)
    ahead_m = model_m + 5e-3 * (time_s > 0)
    motion = pd.DataFrame({"time_s": time_s, "lead_position_m": ahead_m, "model_position_m": model_m})
    motion = motion.assign(replicates_mean_m=ahead_m, replicates_sigma_m=1e-3)
    trajectories = pd.concat([motion.assign(trial=f"t{i}") for i in range(n_trials)], ignore_index=True)
    names = [f"c{i}" for i in range(n_conditions)]
    labels = [f"12 mm, {i} kPa, 35.6 g" for i in range(n_conditions)]
    table = pd.DataFrame({"condition": names, "condition_label": labels, "rms_position_m": 5e-3, "ratio": 5.0})
    return table.assign(model="gravity+yield_pressure", vine="v"), dict.fromkeys(names, trajectories)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [motion_figures.draw_model_comparison, motion_figures.draw_model_residuals])
@pytest.mark.parametrize("n_conditions", [1, 40])
def test_every_condition_has_a_panel_with_its_numbers(draw, n_conditions: int) -> None:  # type: ignore[no-untyped-def]
    fig = draw(*comparison(n_conditions))
    shown = [ax for ax in fig.axes if ax.get_visible()]
    assert [ax.get_title(loc="left") for ax in shown] == [f"12 mm, {i} kPa, 35.6 g" for i in range(n_conditions)]
    assert {ax.texts[0].get_text() for ax in shown} == {"rms 5 mm\nN = 2"}
    assert len(render(fig, ["svg"])["svg"]) < 1_500_000
    if draw is motion_figures.draw_model_residuals:
        assert shown[0].lines[-1].get_ydata()[-1] == pytest.approx(5.0)


def assert_nothing_is_cut_off(figure: Figure) -> None:
    with look():
        figure.draw_without_rendering()
        drawn, edge = figure.get_tightbbox(), figure.bbox_inches.padded(0.02)
        assert edge.x0 <= drawn.x0 <= drawn.x1 <= edge.x1
        assert edge.y0 <= drawn.y0 <= drawn.y1 <= edge.y1
        for legend in [*figure.legends, *(ax.get_legend() for ax in figure.axes if ax.get_legend())]:
            for ax in figure.axes:
                assert not legend.get_window_extent().padded(-1).overlaps(ax.get_window_extent().padded(-1))


def rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


@pytest.mark.parametrize(
    ("axis", "size", "width_px"),
    [
        (Axis((20.0, 100.0), (620.0, 100.0)), (640, 200), 640),
        (Axis((20.0, 100.0), (620.0, 100.0)), (640, 200), 960),
        (Axis((100.0, 20.0), (100.0, 620.0)), (200, 640), 200),
    ],
    ids=["along", "larger", "down"],
)
def test_each_edge_stands_where_it_is_along_the_axis_with_a_scale_bar_of_the_length_it_names(axis, size, width_px):
    view, grey = ClipView("a", axis, EDGES, 40.0, size, 0.25, 30.0, width_px), np.full(size[::-1], 90, np.uint8)
    zoom = width_px / size[0]
    unseen, picture = (motion_figures.compose(view, grey, frame, 12.0)[-round(zoom * size[1]) :] for frame in (0, 1))
    assert picture.shape[1] == width_px
    across = 0 if axis.from_px[1] == axis.to_px[1] else 1
    for colour, place in ((TRACKED, 220), (VERMILLION, 320), (SKY, 230)):
        seen = np.flatnonzero((picture == rgb(colour)).all(axis=2).any(axis=across))
        assert np.mean(seen) == pytest.approx((place + 0.5) * zoom - 0.5, abs=1)
    assert not (unseen == rgb(TRACKED)).all(axis=2).any()
    assert (unseen == rgb(VERMILLION)).all(axis=2).any()
    if size[0] == 640:
        # A sixth of 640 px is 26.7 mm; the round length below it is 20 mm, or 80 px.
        assert max(int(row.sum()) for row in (picture == 255).all(axis=2)) == pytest.approx(80 * zoom, abs=2)
    assert motion_figures.levels(np.array([[10, 60, 110, 200]], np.uint16), 10, 110).tolist() == [[0, 128, 255, 255]]


# The strip of a recording, from arrays written by hand: position of the edge, and marks of flagged frames.
def test_the_edge_and_flagged_frames_are_counted_apart_and_frames_show_the_edge_where_it_was():
    """An edge at 7 px a frame from frame 10 on; frame 20 is lost, 25 moved by hand, 26 retimed, 30 doubtful."""
    flag = np.array(["before_release"] * 10 + [""] * 30, dtype="<U64")
    flag[20], flag[25], flag[26], flag[30] = "lost", "corrected", "gap;retimed", "doubtful;gap"
    edge = np.maximum(np.arange(COUNT) - 10, 0) * 7.0 + 20
    edge[20] = np.nan
    kymograph = np.where(np.arange(300)[None] < np.nan_to_num(edge)[:, None], 40, 180).astype(np.float32)
    picture = np.full((60, 300), 128, np.uint8)
    track = Track(np.arange(COUNT) / 1000, edge * 1e-3, np.full(COUNT, 1e-5), flag, edge)
    pictures = ((10, picture), (25, picture), (39, picture))
    axis, rows = Axis((0.0, 30.0), (299.0, 30.0), 20.0), np.arange(COUNT)
    tracking = Tracking(track, axis, kymograph, rows, pictures, 0.1, np.zeros(COUNT))
    (sheet,) = draw_strip("a", tracking, 1e-3).axes
    shown = {line.get_label(): line for line in sheet.lines if not line.get_label().startswith("_")}
    assert list(shown) == ["leading edge, N = 36", "flagged, N = 3", "corrected by hand, N = 1"]
    marks = (("flagged, N = 3", [math.nan, 132, 160], [20, 26, 30]), ("corrected by hand, N = 1", [125], [25]))
    for label, px, ms in marks:
        assert shown[label].get_xdata().tolist() == pytest.approx(px, nan_ok=True)
        assert shown[label].get_ydata() == pytest.approx(ms)
    titles = [text.get_text() for text in sheet.texts if text.get_text().startswith("frame ")]
    assert titles == ["frame 10, 10.0 ms", "frame 25, 25.0 ms", "frame 39, 39.0 ms"]
    for line, at in zip((line for line in sheet.lines if line.get_linewidth() == 1.8), (20, 125, 223), strict=True):
        assert line.get_xdata() == pytest.approx([at, at])
        assert sorted(line.get_ydata()) == pytest.approx([15, 45])


# Figures of a diagnosis and of the paper's numbers, from tables written by hand.
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
    assert {to_hex(line.get_color()) for line in left.lines} >= {VERMILLION.lower(), BLUE.lower()}
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
def test_eq2_is_drawn_as_it_moves_and_the_mean_as_points():
    way, time_s = np.linspace(0, 1, 30), np.linspace(0, 1 / 7, 100)
    parts = []
    for kPa, (k, name) in product((7, 14, 28), enumerate(("eq2", *NAMES))):
        moved = {"time_s": way * (1 + 0.3 * k) / kPa, "lead_position_m": 0.28 * way * (1 - 0.05 * k)}
        parts.append(pd.DataFrame(moved).assign(pressure_kPa=float(kPa), departure=name))
    mean = pd.DataFrame({"time_s": time_s, "lead_position_m": 0.28 * 7 * time_s, "pressure_kPa": 7.0})
    mean = mean.assign(lead_position_sigma_m=0.002, n_trials=4)
    errors = pd.DataFrame({"pressure_kPa": [7.0], "rms_mean_m": [0.0032]})
    fig = damping_figures.draw_paper_position(pd.concat(parts, ignore_index=True), mean, errors)
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
    fig = damping_figures.draw_paper_damping(table, {"paper": law | {"n": 0.38}, "both_axes": law})
    dashed = [line for line in fig.axes[0].lines if line.get_linestyle() == "--"]
    assert len(dashed) == 2
    assert np.polyfit(*np.log(dashed[0].get_data()), 1) == pytest.approx([0.37, np.log(0.57)])
    assert_nothing_is_cut_off(fig)


def test_final_speeds_stand_beside_eq2_where_payloads_differ():
    row = {"vine": "v", "final_at_mm": 120.0, "n_final": 4, "final_lead_velocity_sigma_m_s": 0.02}
    at = product((14.0, 28.0), (0.0, 20.0, 35.6))
    speeds = pd.DataFrame([row | {"pressure_kPa": kPa, "payload_g": g} for kPa, g in at])
    speeds = speeds.assign(final_lead_velocity_m_s=speeds["pressure_kPa"] / 20 - speeds["payload_g"] / 100)
    fig = damping_figures.draw_paper_speeds(speeds, speeds.assign(final_lead_velocity_m_s=1.0))
    (ax,) = fig.axes
    assert [len(container.lines[0].get_xdata()) for container in ax.containers] == [3, 3]
    assert len([line for line in ax.lines if list(line.get_ydata()) == [1.0] * 3]) == 2
    assert damping_figures.draw_paper_speeds(speeds.assign(pressure_kPa=range(6)), speeds) is None
    assert_nothing_is_cut_off(fig)


def test_nothing_of_the_reservoir_is_cut_off():
    y = np.linspace(0, 0.28, 5)
    left = [pd.DataFrame({"lead_position_m": y, "gauge_left": 1 - y / 2, "pressure_kPa": kPa}) for kPa in (7.0, 28.0)]
    pressures = [one.assign(departure=name) for one in left for name in NAMES[:2]]
    assert_nothing_is_cut_off(damping_figures.draw_paper_reservoir(pd.concat(pressures, ignore_index=True)))
