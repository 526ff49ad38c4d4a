"""Figures of a whole experiment, from tables written by hand: content, text, and no overlaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from figure_frames import assert_nothing_is_cut_off, words
from matplotlib.figure import Figure

from vinetrack.figures.damping_figures import draw_damping_law, draw_exponents, draw_scaling, log_force_sigma
from vinetrack.figures.motion_figures import MAX_CONDITION_PANELS, draw_overview
from vinetrack.figures.style import look, render, vine_styles

N = 0.4


def law(B: float, diameter_mm: float, n_trials: int = 5) -> dict:
    total = [0.9 * B, 1.1 * B]
    size = {"diameter_mm": diameter_mm, "thickness_um": 8 * diameter_mm}
    return {"B": B, "B_95": [0.95 * B, 1.05 * B], "B_95_total": total, "R2": 0.98, "n_trials": n_trials, **size}


def fit(vines: dict[str, dict]) -> dict:
    names = ["n", *(f"ln B {vine}" for vine in vines)]
    return {
        "n": N,
        "n_95": [0.39, 0.41],
        "n_95_total": [0.38, 0.42],
        "vines": vines,
        "covariance": {"parameters": names, "matrix": (1e-4 * np.eye(len(names))).tolist()},
        "refused": None,
    }


def damping(n_vines: int = 2) -> dict:
    vines = {f"vine{i}": law(1.0 + i, 6.0 * (i + 1)) for i in range(n_vines)}
    return {"log_log": fit(vines), "both_axes": fit(vines)}


REFUSED = {m: {"n": None, "n_95": [None, None], "vines": {}, "refused": "too few"} for m in ("log_log", "both_axes")}


def points(n_vines: int = 2) -> pd.DataFrame:
    rows = [
        {
            "trial": f"v{i}_{k}",
            "vine": f"vine{i}",
            "x_ss_m_s": 2.0**k,
            "x_ss_sigma_m_s": 0.02 * 2.0**k,
            "force_N": (1.0 + i) * 2.0 ** (N * k),
            "force_sigma_N": 0.01,
            "used": k < 4,
        }
        for i in range(n_vines)
        for k in range(5)
    ]
    return pd.DataFrame(rows)


def test_trials_outside_the_fit_are_hollow_and_counted() -> None:
    figure = draw_damping_law(points(), damping())
    markers = [line for line in figure.axes[0].lines if line.get_marker() in ("o", "s")]
    hollow = [line for line in markers if line.get_markerfacecolor() != line.get_markeredgecolor()]
    assert sorted(len(line.get_xdata()) for line in hollow) == [1, 1]
    assert "not in the fit, N = 2" in words(figure)


def test_both_fits_are_lines_of_slope_n() -> None:
    lines = [line for line in draw_damping_law(points(1), damping(1)).axes[0].lines if line.get_marker() == "None"]
    curves = [line for line in lines if len(line.get_xdata()) == 60]
    assert len(curves) == 2
    for line in curves:
        x, force_N = np.log(line.get_xdata()), np.log(line.get_ydata())
        assert np.polyfit(x, force_N, 1)[0] == pytest.approx(N, abs=1e-9)


def test_the_band_is_that_of_the_covariance() -> None:
    x_ss_m_s = np.array([0.5, 1.0, 4.0])
    # Var(ln F) = Var(ln B) + ln²x·Var(n), the two being independent here.
    expected = np.sqrt(1e-4 + np.log(x_ss_m_s) ** 2 * 1e-4)
    assert log_force_sigma(fit({"v": law(1.0, 6.0)}), "v", x_ss_m_s) == pytest.approx(expected)


def test_n_and_b_are_shown_with_both_methods_and_both_intervals() -> None:
    figure = draw_exponents(damping())
    left, right = figure.axes
    widths = [line.get_linewidth() for line in left.lines if len(line.get_xdata()) == 2]
    assert len(widths) == 4
    assert len(set(widths)) == 2
    assert len([line for line in right.lines if len(line.get_xdata()) == 2]) == 8
    assert "N = 5" in words(figure)


def family(along: str, sizes: list[float], B: list[float], **changes: object) -> dict:
    bounds = [[0.9 * b, 1.1 * b] for b in B]
    statistics = {"slope": 1.8, "slope_95": [1.2, 2.4], "intercept": -3.0, "intercept_95": [-4.0, -2.0], "R2": 0.98}
    found = {"along": along, "vines": [f"vine{i}" for i in range(len(B))], "sizes": sizes, "B": B, "B_95": bounds}
    return {**found, "power": statistics, "line": statistics | {"slope": 0.3}, "refused": None, **changes}


def scaling(n_vines: int = 4) -> dict:
    sizes = [6.0 * (i + 1) for i in range(n_vines)]
    isometric = family("diameter_mm", sizes, [float(np.exp(-3.0) * size**1.8) for size in sizes])
    return {"method": "both_axes", "isometric": [isometric], "thickness": [], "reason": None}


def test_the_power_law_and_the_straight_line_are_drawn_as_fitted() -> None:
    ax = draw_scaling(scaling()).axes[0]
    power, line = (
        next(line for line in ax.lines if line.get_label().startswith(name)) for name in ("power", "straight")
    )
    x, B = power.get_data()
    assert pytest.approx(np.exp(-3.0) * np.asarray(x) ** 1.8) == B
    x, B = line.get_data()
    assert pytest.approx(-3.0 + 0.3 * np.asarray(x)) == B
    assert "slope 1.80 (1.2 to 2.4)" in power.get_label()


def campaign(n_conditions: int, replicates: int) -> tuple[pd.DataFrame, dict[str, pd.DataFrame]]:
    rows, curves = [], {}
    time_s = np.linspace(0, 0.1, 40)
    for i in range(n_conditions):
        for k in range(replicates):
            name = f"c{i}_{k}"
            speed_m_s = (1 + i) * (1 - np.exp(-time_s / 0.01))
            position_m = (1 + i) * time_s
            curves[name] = pd.DataFrame(
                {"time_s": time_s, "lead_position_m": position_m, "lead_velocity_m_s": speed_m_s}
            )
            row = {"trial": name, "vine": "v", "condition": f"c{i}", "condition_label": f"12 mm, {i} kPa"}
            rows.append({**row, "pressure_kPa": i, "status": "ok", "steady_from_s": 0.05, "steady_to_s": 0.08})
    return pd.DataFrame(rows), curves


@pytest.mark.parametrize(("n_conditions", "replicates", "n_panels"), [(1, 1, 1), (12, 2, 12), (40, 4, 40), (500, 1, 1)])
def test_all_trials_have_a_panel_for_each_condition_or_for_each_vine(
    n_conditions: int, replicates: int, n_panels: int
) -> None:
    figure = draw_overview(*campaign(n_conditions, replicates))
    panels = [ax for ax in figure.axes if ax.get_visible() and ax.get_title(loc="left")]
    assert len(panels) == n_panels
    thin = [line for ax in panels for line in ax.lines if line.get_linewidth() < 1]
    assert len(thin) == n_conditions * replicates
    if n_conditions > MAX_CONDITION_PANELS:
        assert "pressure (kPa)" in words(figure)


def test_a_steady_stretch_is_thick() -> None:
    figure = draw_overview(*campaign(1, 1))
    thick = [line for line in figure.axes[0].lines if line.get_linewidth() > 2]
    assert len(thick) == 1
    # 0.05 to 0.08 s at 1 m/s.
    assert min(thick[0].get_xdata()) == pytest.approx(50, abs=3)
    assert max(thick[0].get_xdata()) == pytest.approx(80, abs=3)


def test_a_failed_trial_is_counted_in_its_panel() -> None:
    trials, curves = campaign(2, 2)
    trials.loc[1, "status"] = "failed"
    del curves["c0_1"]
    assert "1 failed" in words(draw_overview(trials, curves))


EVERY_FIGURE: dict[str, Callable[[], Figure]] = {
    "law": lambda: draw_damping_law(points(4), damping(4)),
    "law of 20 vines": lambda: draw_damping_law(points(20), damping(20)),
    "exponents": lambda: draw_exponents(damping(4)),
    "scaling": lambda: draw_scaling(scaling(), {"B": {"vine0": 1.0}, "source": "Alvarez et al. 2025"}),
    "overview": lambda: draw_overview(*campaign(40, 1)),
}


def test_the_same_figure_gives_the_same_bytes() -> None:
    first, second = (render(draw_damping_law(points(), damping())) for _ in range(2))
    assert first == second


def test_a_figure_laid_out_once_for_all_formats_is_the_one_saved_by_itself() -> None:
    from io import BytesIO

    drawn, saved, file = draw_damping_law(points(), damping()), draw_damping_law(points(), damping()), BytesIO()
    with look():
        saved.savefig(file, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    engine = drawn.get_layout_engine()
    assert render(drawn, ("png",))["png"] == file.getvalue()
    assert drawn.get_layout_engine() is engine


def test_42_vines_all_look_different() -> None:
    styles = vine_styles(f"v{i}" for i in range(42))
    assert len({(style.colour, style.marker) for style in styles.values()}) == 42


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_nothing_is_cut_off(name: str) -> None:
    assert_nothing_is_cut_off(EVERY_FIGURE[name]())


def test_without_content_there_is_no_figure() -> None:
    assert draw_damping_law(points().iloc[:0], REFUSED) is None
    assert draw_exponents(REFUSED) is None
    assert draw_scaling({"isometric": [], "thickness": []}) is None
    assert draw_overview(campaign(1, 1)[0], {}) is None
