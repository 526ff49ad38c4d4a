"""Figures of speed, efficiency and payload, from tables written by hand: content, text, and no overlaps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Text

from vinetrack.figures.damping_figures import draw_efficiency, draw_payload_speed, draw_speed_scaling
from vinetrack.figures.style import look

LINE = {"slope": 0.1, "slope_95": [0.02, 0.18], "intercept": 0.5, "intercept_95": [0, 1], "R2": 0.935, "p": 0.033}
POWER = {**LINE, "slope": 0.7, "slope_95": [0.1, 1.3], "intercept": math.log(0.3), "p": 0.04}
NO_LINES = {"power": None, "line": None, "refused": "2 sizes; at least 3"}


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def speed_family(sizes: list[float], pressure_kPa: float = 24.0) -> dict:
    speeds = [0.3 * size**0.7 for size in sizes]
    lines = {"power": POWER, "line": LINE, "refused": None} if len(sizes) > 2 else NO_LINES
    return {
        "pressure_kPa": pressure_kPa,
        "sizes": sizes,
        "x_ss_m_s": speeds,
        "x_ss_sigma_m_s": [0.05] * len(sizes),
        "x_ss_over_diameter_1_s": [1e3 * v / size for v, size in zip(speeds, sizes, strict=True)],
        "x_ss_over_diameter_sigma_1_s": [None, *([3.0] * (len(sizes) - 1))],
        "n_steady": [3, *([4] * (len(sizes) - 1))],
        **lines,
        "over_diameter": lines,
    }


def efficiency_family(n_diameters: int = 2) -> dict:
    sizes = [(D, t) for D in (12.0, 18.0)[:n_diameters] for t in (50.0, 100.0, 200.0)]
    values = [0.5 * (t / 100) ** -0.6 for _, t in sizes]
    power = {"power": -0.6, "power_95": [-0.9, -0.3], "p": 0.01}
    trend = {"thickness_um": power, "diameter_mm": {**power, "power": 0.1, "p": 0.7}, "n": 6, "refused": None}
    family: dict = {"pressure_kPa": 34.0, "payload_g": 35.6, "length_mm": 200.0, "efficiency_at_mm": 150.0}
    for key, factor in (("efficiency", 1.0), ("efficiency_payload", 0.9), ("efficiency_with_weight", 0.8)):
        family |= {key: [factor * v for v in values], f"{key}_sigma": [0.01] * len(values)}
    return family | {
        "diameter_mm": [D for D, _ in sizes],
        "thickness_um": [t for _, t in sizes],
        "n_efficiency": [4] * len(sizes),
        "conditions": [""] * len(sizes),
        "trend": dict.fromkeys(("efficiency", "efficiency_payload", "efficiency_with_weight"), trend),
    }


def conditions(vines: int = 1) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "vine": f"vine{i}",
            "pressure_kPa": pressure,
            "payload_g": payload,
            "n_final": 4,
            "final_at_mm": 120.0,
            "final_lead_velocity_m_s": pressure / (10 + payload),
            "final_lead_velocity_sigma_m_s": 0.1,
        }
        for i in range(vines)
        for pressure in (14.0, 28.0)
        for payload in (10.0, 20.0, 40.0)
    )


def points(figure: Figure, axis: int = 0) -> list[np.ndarray]:
    bars = [one for one in figure.axes[axis].containers if isinstance(one, ErrorbarContainer)]
    return [np.column_stack(bar.lines[0].get_data()) for bar in bars]


def test_speed_and_speed_over_diameter_stand_side_by_side() -> None:
    figure = draw_speed_scaling({"steady_speed": [speed_family([6.0, 12.0, 18.0, 24.0])]})
    left, right = figure.axes
    assert ("m/s" in left.get_ylabel(), "1/s" in right.get_ylabel()) == (True, True)
    assert points(figure)[0][:, 0].tolist() == [6.0, 12.0, 18.0, 24.0]
    assert points(figure, 1)[0][3, 1] == pytest.approx(1e3 * 0.3 * 24**-0.3)
    assert "N = 4 vines of 3–4 trials" in words(figure)
    assert "power (dashed) 0.70 (0.1 to 1.3), p = 0.040\nline (full): R² 0.935, p = 0.033" in words(figure)


def test_line_and_power_law_are_drawn_as_fitted() -> None:
    ax = draw_speed_scaling({"steady_speed": [speed_family([6.0, 12.0, 24.0])]}).axes[0]
    line, power = (curve for curve in ax.lines if len(curve.get_xdata()) == 100)
    assert line.get_ydata() == pytest.approx(0.5 + 0.1 * line.get_xdata())
    assert power.get_ydata() == pytest.approx(0.3 * power.get_xdata() ** 0.7)


def test_two_vines_have_no_line_and_further_pressures_are_said() -> None:
    figure = draw_speed_scaling({"steady_speed": [speed_family([6.0, 12.0], 20.0 + i) for i in range(7)]})
    assert not [curve for curve in figure.axes[0].lines if len(curve.get_xdata()) == 100]
    assert "2 more pressures in scaling.json" in words(figure)


def test_two_points_of_nearly_one_value_stand_inside_the_axes() -> None:
    """128.5 and 127.4: a margin of a twentieth of what they differ by would cut the marker of the higher in half."""
    family = {**speed_family([14.0, 20.0]), "x_ss_over_diameter_1_s": [128.5, 127.4], "n_steady": [1, 1]}
    figure = draw_speed_scaling({"steady_speed": [family]})
    left, right = figure.axes
    assert right.get_ylim()[1] > 1.05 * 131.5  # the second has an error of 3
    assert left.get_xlim()[1] > 1.05 * 20
    assert "N = 2 vines of 1 trial\n" in words(figure)
    assert "no trend: 2 sizes; at least 3" in words(figure)
    assert "does not include replicate scatter" in words(figure).replace("\n", " ")


def test_single_trials_have_no_standard_error() -> None:
    family = {**efficiency_family(), "n_efficiency": [1] * 6}
    refused = {"refused": "6 conditions; a power of wall with an error takes 7", "n": 6}
    family["trend"] = dict.fromkeys(family["trend"], refused)
    said = words(draw_efficiency({"efficiency": [family]})).replace("\n", " ")
    assert "N = 1 trial per point" in said
    assert "standard error" not in said
    assert "no trend: 6 conditions" in said


def test_three_ways_to_count_efficiency() -> None:
    figure = draw_efficiency({"efficiency": [efficiency_family(), efficiency_family()]})
    assert len(figure.axes) == 6
    assert points(figure, 0)[0][:, 1] == pytest.approx([100 * 0.5 * (t / 100) ** -0.6 for t in (50, 100, 200)])
    assert points(figure, 2)[0][1, 1] == pytest.approx(40.0)
    assert "34 kPa with 35.6 g, after 150 mm of growth; N = 4 trials per point" in words(figure)
    assert "1 more family in" in words(figure)
    assert "power of the diameter 0.10" in words(figure)


def test_one_diameter_is_drawn_against_the_wall_alone() -> None:
    figure = draw_efficiency({"efficiency": [efficiency_family(1)]})
    assert [ax.get_xlabel() for ax in figure.axes] == ["wall thickness (µm)"] * 3


def test_final_speeds_stand_beside_the_model() -> None:
    measured = conditions()
    figure = draw_payload_speed(measured, measured.drop(columns="n_final"), line="the law")
    assert [len(part) for part in points(figure)] == [3, 3]
    (ax,) = figure.axes
    curves = [curve for curve in ax.lines if curve.get_linewidth() == 1.5 and len(curve.get_xdata()) == 3]
    assert [curve.get_ydata()[0] for curve in curves] == pytest.approx([0.7, 1.4])
    assert words(figure).count("the law") == 1
    assert "vine0, after 120 mm\nN = 4 trials per point" in words(figure)


def test_vines_with_one_payload_at_each_pressure_are_not_drawn() -> None:
    lonely = conditions().assign(pressure_kPa=range(6))
    assert "No vine was grown with more than one payload" in words(draw_payload_speed(lonely, lonely.iloc[:0]))


def test_without_families_the_figures_say_why() -> None:
    assert "scaled copies" in words(draw_speed_scaling({"steady_speed": []}))
    assert "the same length" in words(draw_efficiency({}))


FAMILIES = [speed_family([6.0, 12.0, 18.0, 24.0]), speed_family([6.0, 12.0], 30.0)]
NOTE = "Alvarez et al. (2025): a sentence that is set below"
EVERY_FIGURE: dict[str, Callable[[], Figure]] = {
    "speed": lambda: draw_speed_scaling({"steady_speed": FAMILIES}, NOTE),
    "efficiency": lambda: draw_efficiency({"efficiency": [efficiency_family()]}, NOTE),
    "efficiency of one diameter": lambda: draw_efficiency({"efficiency": [efficiency_family(1)]}),
    "payload": lambda: draw_payload_speed(conditions(), conditions(), NOTE),
    "payload of five vines": lambda: draw_payload_speed(conditions(5), conditions(5)),
}


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_nothing_is_cut_off_and_no_legend_covers_the_axes(name: str) -> None:
    figure = EVERY_FIGURE[name]()
    with look():
        figure.draw_without_rendering()
        drawn, edge = figure.get_tightbbox(), figure.bbox_inches.padded(0.02)
        assert edge.x0 <= drawn.x0, name
        assert drawn.x1 <= edge.x1, name
        assert edge.y0 <= drawn.y0, name
        assert drawn.y1 <= edge.y1, name
        for legend in [ax.get_legend() for ax in figure.axes if ax.get_legend()]:
            for ax in figure.axes:
                assert not legend.get_window_extent().padded(-1).overlaps(ax.get_window_extent().padded(-1)), name
