"""Figures of designs: complete, and labelled with units."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from vinetrack.figures.prediction_figures import FilmChoice, GasLawLoss, draw_choice, draw_reservoir


def words(fig: Figure) -> str:
    found = [text.get_text() for ax in fig.axes for text in (ax.xaxis.label, ax.yaxis.label, *ax.texts)]
    found += [ax.get_title(loc="left") for ax in fig.axes]
    legends = [legend for ax in fig.axes if (legend := ax.get_legend())] + list(fig.legends)
    found += [text.get_text() for legend in legends for text in legend.get_texts()]
    return " | ".join([*found, *(text.get_text() for text in fig.texts)])


def film(thickness_um: float, odds: float) -> FilmChoice:
    return FilmChoice(
        thickness_um, np.array([5.0, 10.0, 25.0]), np.array([1.0, 20.0, 45.0]), (25.0, 45.0), (29.0, 55.0), odds
    )


def test_the_choice_of_a_film() -> None:
    fig = draw_choice([film(100, 0.57), film(50, 0.43)], "speed of the leading edge", 0.95)
    said = words(fig)
    for expected in ("diameter (mm)", "at y/L = 0.95 (m/s)", "100 µm", "50 µm", "57%", "43%", "film (µm)"):
        assert expected in said
    assert fig.axes[0].get_ylim()[1] > 55.0


def test_a_payloads_speed_has_no_place_before_the_end() -> None:
    said = words(draw_choice([film(100, 1.0)], "ejection speed of the payload", 1.0))
    assert "y/L" not in said


@pytest.mark.parametrize(("swept_m3", "unit"), [(1.96e-4, "L"), (6.1e-8, "mL")])
def test_a_reservoir_in_the_unit_of_its_size(swept_m3: float, unit: str) -> None:
    volumes = swept_m3 * np.geomspace(3, 300, 20)
    laws = [GasLawLoss("slow", swept_m3 / volumes), GasLawLoss("fast", 1.4 * swept_m3 / volumes)]
    said = words(draw_reservoir(volumes, laws, 0.05, swept_m3, 20 * swept_m3))
    assert f"volume of the chamber ({unit})" in said
    assert "allowed: 5 %" in said
    assert f"chosen: {20 * swept_m3 * (1e3 if unit == 'L' else 1e6):.3g} {unit}" in said


def test_a_reservoir_far_off_is_not_drawn() -> None:
    volumes = 1e-4 * np.geomspace(3, 300, 20)
    laws = [GasLawLoss("slow", 1e-4 / volumes), GasLawLoss("fast", 1.4e-4 / volumes)]
    assert "chosen" not in words(draw_reservoir(volumes, laws, 0.05, 1e-4, 10.0))
