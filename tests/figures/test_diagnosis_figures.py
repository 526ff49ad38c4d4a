"""Figures of a diagnosis, from tables written by hand: positions, colours and text."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from figure_frames import assert_nothing_is_cut_off
from matplotlib.colors import to_hex

from vinetrack.figures.diagnosis_figures import (
    AFTER,
    BEFORE,
    MAX_CANDIDATES,
    MAX_EFFECTS,
    draw_before_after,
    draw_candidates,
    draw_cosines,
    draw_drift,
    draw_ladder,
    draw_learned_force,
    draw_missing_force,
    draw_where,
    rms_m,
)
from vinetrack.figures.style import BLUE, MUTED, ORANGE, VERMILLION


def steps(*added: str, floor_m: float = 1e-3) -> pd.DataFrame:
    n = len(added)
    return pd.DataFrame(
        {
            "model": "m",
            "added": added,
            "rms_in_sample_m": 9e-3 / 4.0 ** np.arange(n),
            "rms_left_out_m": 10e-3 / 4.0 ** np.arange(n),
            "rms_highest_pressure_m": 11e-3 / 4.0 ** np.arange(n),
            "floor_m": floor_m,
            "excess_left_out_m": 0.0,
        }
    )


def test_the_ladder_falls_in_millimetres_on_a_logarithmic_axis() -> None:
    (ax,) = draw_ladder(steps("", "reservoir_depletion")).axes
    assert ax.get_yscale() == "log"
    assert "(mm)" in ax.get_ylabel()
    curves = [line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 2 and line.get_marker() != "None"]
    assert np.array(curves) == pytest.approx(np.array([[9, 2.25], [10, 2.5], [11, 2.75]]))
    assert [label.get_text() for label in ax.get_xticklabels()] == [
        "initial\nmodel",
        "+ reservoir\ndepletion",
    ]


@pytest.mark.parametrize("added", [("",), ("", "a"), ("", "a", "length_scale"), ("", "a", "b+c", "d" * 30)])
def test_nothing_of_a_ladder_is_cut_off(added: tuple[str, ...]) -> None:
    assert_nothing_is_cut_off(draw_ladder(steps(*added)))


def prediction(name: str, before_m: float, after_m: float) -> pd.DataFrame:
    time_s = np.arange(-10, 100) * 1e-3
    moved_m = np.maximum(time_s, 0)
    return pd.DataFrame(
        {
            "trial": name,
            "time_s": time_s,
            "lead_position_m": moved_m,
            "model_before_m": moved_m - before_m * (time_s >= 0),
            "model_after_m": moved_m - after_m * (time_s >= 0),
        }
    )


def test_a_condition_is_drawn_before_and_after_with_its_errors() -> None:
    table = pd.concat([prediction("a", 8e-3, 1e-3), prediction("b", 8e-3, 1e-3)])
    growth, left = draw_before_after("24 kPa", table, "air drag").axes
    assert [text.get_text() for text in growth.get_legend().get_texts()] == [
        "measured, N = 2",
        "initial model: 8.0 mm rms",
        "with air drag: 1.0 mm rms",
    ]
    assert {to_hex(line.get_color()) for line in left.lines} >= {BEFORE.lower(), AFTER.lower()}
    assert left.lines[0].get_ydata()[-1] == pytest.approx(8.0)


def ranking(*rows: tuple[str, str, str, float, bool]) -> pd.DataFrame:
    columns = ["effect", "kind", "status", "delta_chi2", "in_answer_set"]
    table = pd.DataFrame(rows, columns=columns).assign(plausible=True, size="k = 1.0 ± 0.1")
    return table.assign(sigma=np.sqrt(np.maximum(table["delta_chi2"].astype(float), 0)))


def test_candidates_are_bars_of_the_root_of_their_gain_the_answer_in_colour() -> None:
    table = ranking(
        ("air_drag", "physical", "refitted", 400.0, True),
        ("leak", "physical", "refitted", 100.0, False),
        ("time_base", "measurement", "screened", 25.0, False),
        ("payload_drag", "physical", "not testable here", math.nan, False),
    )
    (ax,) = draw_candidates([("What is missing?", table)]).axes
    assert [bar.get_width() for bar in ax.patches] == pytest.approx([20, 10, 5])
    assert [to_hex(bar.get_edgecolor()) for bar in ax.patches] == [BLUE.lower(), MUTED, ORANGE.lower()]
    assert ax.patches[2].get_facecolor()[3] == 0
    assert [label.get_text() for label in ax.get_yticklabels()] == ["air drag", "leak", "time base"]
    assert "k = 1.0 ± 0.1" in ax.texts[0].get_text()


def test_the_bar_of_an_unfitted_candidate_is_its_score_and_that_of_a_worse_fit_has_no_length() -> None:
    table = ranking(
        ("leak", "physical", "refitted", -67.0, False), ("air_drag", "physical", "screened", math.nan, False)
    ).assign(sigma=[-4.1, -7.0])
    (ax,) = draw_candidates([("q", table)]).axes
    assert [bar.get_width() for bar in ax.patches] == [7.0, 0.0]
    wrong_sign = ranking(("fold_inertia", "physical", "screened", 900.0, False)).assign(sigma=0.0)
    assert draw_candidates([("q", wrong_sign)]).axes[0].patches[0].get_width() == 0


def test_the_longest_of_lists_is_cut_and_rounds_stand_below_each_other() -> None:
    many = ranking(*((f"effect_{i}", "physical", "screened", 100.0 - i, False) for i in range(30)))
    fig = draw_candidates([("one", many), ("two", many.head(2)), ("three", many.head(0))])
    assert [len(ax.patches) for ax in fig.axes] == [MAX_CANDIDATES, 2]
    assert_nothing_is_cut_off(fig)


def groups() -> pd.DataFrame:
    """B of one vine against pressure, before and after, and γ that only the larger model has."""
    row = {"parameter": "eversion_damping.B", "vine": "v", "symbol": "B", "against": "pressure_Pa", "n_trials": 2}
    rows = [
        row | {"model": model, "level": 1e3 * kPa, "ratio": 1 + slope * (kPa - 40) / 40, "ratio_sigma": 0.02}
        for model, slope in (("before", -0.3), ("after", 0.0))
        for kPa in (24, 36, 60)
    ]
    gamma = {"parameter": "reservoir_depletion.gamma", "symbol": "γ", "against": "vine", "level": math.nan}
    return pd.DataFrame([*rows, rows[-1] | gamma])


def test_a_drifting_parameter_is_drawn_against_the_condition() -> None:
    (ax,) = draw_drift(groups(), "air drag").axes
    assert ax.get_xlabel() == "pressure (kPa)"
    assert ax.get_title(loc="left") == "B against pressure, N = 6"
    before, after = (container.lines[0] for container in ax.containers)
    assert before.get_xdata() == pytest.approx([24, 36, 60])
    assert before.get_ydata() == pytest.approx([1.12, 1.03, 0.85])
    assert after.get_ydata() == pytest.approx([1, 1, 1])


def test_the_missing_force_is_drawn_against_each_variable() -> None:
    point = {"value": 0.1, "force_N": 0.4, "sigma_N": 0.05, "condition": ""}
    against = ("lead_position_m", "tail_velocity_m_s", "time_s", "pressure_Pa")
    rows = [point | {"against": name, "condition": c} for name in against for c in ("", "a", "b")]
    fig = draw_missing_force(pd.DataFrame(rows))
    labels = ["growth y (mm)", "tail speed ẋ (m/s)", "time since release (ms)", "pressure (kPa)"]
    assert [ax.get_xlabel() for ax in fig.axes] == labels
    assert fig.axes[0].containers[0].lines[0].get_xdata() == pytest.approx([100.0])
    assert_nothing_is_cut_off(fig)


def cells(after: float = 0.1e-3) -> pd.DataFrame:
    rows = [
        {"condition_label": f"12 mm, {k} kPa", "n_trials": 2, "growth_from": g / 4, "growth_to": (g + 1) / 4}
        | {"misfit_before_m": sign * 1e-3 * (g + 1), "misfit_after_m": after, "scatter_m": 0.6e-3}
        for k, sign in ((24, 1), (60, -1))
        for g in range(4)
    ]
    return pd.DataFrame(rows)


def test_the_misfit_is_coloured_by_sign_and_numbered_where_it_exceeds_scatter() -> None:
    before, after = draw_where(cells(), "air drag").axes
    sides = [to_hex(patch.get_facecolor()) for patch in before.patches]
    assert sides == [BLUE.lower()] * 4 + [VERMILLION.lower()] * 4
    depths = [patch.get_alpha() for patch in before.patches[:4]]
    assert depths == sorted(depths)
    assert [text.get_text() for text in before.texts] == ["+2.0", "+3.0", "+4.0", "−2.0", "−3.0", "−4.0"]
    assert not after.texts
    assert after.get_title(loc="left") == "after: with air drag"


def test_of_many_conditions_those_with_the_largest_misfit_are_shown() -> None:
    one = cells().iloc[:4]
    parts = [one.assign(condition_label=f"{k} kPa", misfit_before_m=1e-4 * k) for k in range(60)]
    fig = draw_where(pd.concat(parts, ignore_index=True), "")
    names = [label.get_text().split(",")[0] for label in fig.axes[0].get_yticklabels()]
    assert names == [f"{k} kPa" for k in range(12, 60)]
    assert "the 48 of 60 conditions" in " ".join(text.get_text() for text in fig.legends[0].texts)


def pairs(names: list[str], values: list[float]) -> pd.DataFrame:
    at = [(names[i], names[j]) for i in range(len(names)) for j in range(i)]
    rows = [(*pair, value) for pair, value in zip(at, values, strict=True)]
    return pd.DataFrame(rows, columns=["effect", "other", "cosine"])


def test_cosines_stand_below_the_diagonal_and_ties_are_framed() -> None:
    (ax,) = draw_cosines(pairs(["a", "b", "c"], [0.97, -0.5, 0.0])).axes
    assert [text.get_text() for text in ax.texts] == [".97", "−.50", ".00"]
    framed = [patch for patch in ax.patches if patch.get_linewidth() > 0]
    assert len(framed) == 1
    assert [label.get_text() for label in ax.get_xticklabels()] == ["a", "b"]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["b", "c"]


def test_a_large_matrix_is_cut() -> None:
    n = MAX_EFFECTS + 10
    fig = draw_cosines(pairs([f"an_effect_with_a_long_name_{i}" for i in range(n)], [0.5] * (n * (n - 1) // 2)))
    assert len(fig.axes[0].get_yticklabels()) == MAX_EFFECTS - 1
    assert_nothing_is_cut_off(fig)


def test_without_content_there_is_no_figure() -> None:
    nothing = pd.DataFrame()
    assert draw_ladder(nothing) is draw_candidates([("one", ranking())]) is draw_cosines(nothing) is None
    assert draw_before_after("", nothing, "") is draw_where(nothing, "") is draw_drift(nothing, "") is None
    assert draw_missing_force(nothing) is draw_learned_force(nothing) is None
    assert math.isnan(rms_m(prediction("a", 8e-3, math.nan), "model_after_m"))
