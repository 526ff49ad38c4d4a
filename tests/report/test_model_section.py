"""The section on the model in use, from tables written by hand."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from test_report import EVIL, SVG, Tags, page

from vinetrack.inference.fit_summary import FitSummary
from vinetrack.report.build import ModelResult, ReportFigure, model_section, verdict

FIT = {
    "model": ["gravity", "eversion_damping"],
    "refused": None,
    "numbers": [
        {
            "parameter": "eversion_damping.B",
            "vine": "v",
            "symbol": "B",
            "unit": "N·(s/m)ⁿ",
            "value": 6.44,
            "sigma": 0.12,
            "low_95": 6.2,
            "high_95": 6.68,
        },
        {
            "parameter": "yield_pressure.P_y",
            "vine": "",
            "symbol": "P_y",
            "unit": "Pa",
            "value": 3000.0,
            "sigma": None,
            "low_95": None,
            "high_95": None,
        },
    ],
    "spreads": {"B": {"value": 0.03, "estimated": True}, "pressure": {"value": 0.01, "estimated": False}},
    "messages": ["P_y: the trajectories do not constrain it beyond the value in the sheet"],
    "warnings": ["Trial a: the model predicts compression in the tail."],
    "left_out": {"b": "its leading edge never moves"},
}


def comparison(*rms_mm: float, floor_mm: float = 1.0) -> pd.DataFrame:
    rms_m = 1e-3 * np.array(rms_mm, dtype=float)
    return pd.DataFrame(
        {
            "condition": [f"c{i}" for i in range(len(rms_mm))],
            "rms_position_m": rms_m,
            "rms_final_velocity_m_s": 0.25,
            "replicate_floor_m": 1e-3 * floor_mm,
            "ratio": rms_m / (1e-3 * floor_mm),
            "worst_at_s": 0.07,
            "worst_at_m": 0.123,
        }
    )


CHECK = pd.DataFrame(
    {"vine": ["v"], "n_steady": 0.37, "n_trajectory": 0.49, "B_steady": 6.44, "B_trajectory": 6.1, "z": 5.1}
)


def result(**changes: object) -> ModelResult:
    return ModelResult(FitSummary.from_json({**FIT, **changes}), comparison(3.0, 4.0), CHECK)


def words(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub("<[^>]+>", " ", html[html.index('id="model"') :]))


def test_the_verdict_is_the_root_mean_square_over_conditions_and_names_the_worst() -> None:
    assert verdict(comparison(3.0, 4.0)) == (
        "Over 2 conditions the model is off by 3.54 mm, and replicates scatter by 1.00 mm (root mean square). "
        "Worst is c1, by 4.00 mm, with the maximum after 123 mm of growth."
    )


def test_without_replicates_no_floor_is_claimed() -> None:
    assert "replicates" not in verdict(comparison(3.0, floor_mm=np.nan))


def test_the_page_shows_comparison_numbers_check_and_warnings() -> None:
    text = words(page(model=result()))
    assert "c1 4.00 1.00 4.0 0.250 70.0 123" in text
    assert "B v 6.44 ± 0.12 6.200 to 6.680 N·(s/m)ⁿ" in text
    assert "P_y all 3.00 open kPa" in text
    assert "B 3.0 %; pressure 1.0 % (fixed)" in text
    assert "v 0.370 0.490 6.44 6.10 5.1" in text
    assert "Not in this fit: b: its leading edge never moves." in text
    assert "1 rule for neglecting terms is violated" in text
    assert "Trial a: the model predicts compression in the tail." in text


def test_figures_of_the_model_stand_in_its_section() -> None:
    html = page(model=result(), figures=[ReportFigure("model_comparison", "T", "C", SVG)])
    assert html.count('id="figure-model_comparison"') == 1
    assert html.index('id="model"') < html.index('id="figure-model_comparison"') < html.index('id="trials"')


def test_a_refused_fit_says_why_and_shows_no_table() -> None:
    refused = ModelResult(FitSummary(("gravity",), refused="No trial can be fitted."), comparison(), CHECK.iloc[:0])
    text = words(page(model=refused))
    assert "The model in use, gravity, was not fitted: No trial can be fitted." in text
    assert "What the fit found" not in text


def test_without_a_model_the_page_has_no_such_section() -> None:
    assert 'id="model"' not in page()
    assert model_section(None) is None


@pytest.mark.parametrize("where", ["messages", "warnings"])
def test_what_stands_in_the_fit_is_escaped_and_the_page_well_formed(where: str) -> None:
    html = page(model=result(**{where: [EVIL]}))
    assert EVIL not in html
    tags = Tags(html)
    assert not tags.wrong
    assert not tags.open
