"""Figures of speed, efficiency and payload, from tables written by hand: content, text, and no overlaps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from figure_frames import assert_nothing_is_cut_off, words
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from vinetrack.figures.damping_figures import draw_efficiency, draw_speed_scaling

LINE = {"slope": 0.1, "slope_95": [0.02, 0.18], "intercept": 0.5, "intercept_95": [0, 1], "R2": 0.935, "p": 0.033}
POWER = {**LINE, "slope": 0.7, "slope_95": [0.1, 1.3], "intercept": math.log(0.3), "p": 0.04}
NO_LINES = {"power": None, "line": None, "refused": "2 sizes; at least 3"}


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


FAMILIES = [speed_family([6.0, 12.0, 18.0, 24.0]), speed_family([6.0, 12.0], 30.0)]
NOTE = "Alvarez et al. (2025): a sentence that is set below"
EVERY_FIGURE: dict[str, Callable[[], Figure]] = {
    "speed": lambda: draw_speed_scaling({"steady_speed": FAMILIES}, NOTE),
    "efficiency": lambda: draw_efficiency({"efficiency": [efficiency_family()]}, NOTE),
    "efficiency of one diameter": lambda: draw_efficiency({"efficiency": [efficiency_family(1)]}),
}


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_nothing_is_cut_off(name: str) -> None:
    assert_nothing_is_cut_off(EVERY_FIGURE[name]())


def test_without_content_there_is_no_figure() -> None:
    assert draw_speed_scaling({"steady_speed": []}) is None
    assert draw_efficiency({}) is None
