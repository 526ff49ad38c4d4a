"""The registry of figures: every entry has all that pages and workflow need."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vinetrack.figures import registry
from vinetrack.figures.registry import CAMPAIGN_FIGURES, DIAGNOSIS_FIGURES, FIGURES, PAPER_FIGURES


@pytest.mark.parametrize("name", [name for name in FIGURES if name != "overlay"])
def test_every_figure_has_a_function_that_draws_it(name: str) -> None:
    assert callable(registry._drawing(name))


def test_a_figure_that_is_not_registered_is_an_error() -> None:
    with pytest.raises(KeyError, match="pie"):
        registry.draw("pie")


def test_a_figure_is_of_the_campaign_of_the_paper_or_of_one_trial() -> None:
    assert set(CAMPAIGN_FIGURES) | set(PAPER_FIGURES) | {"power", "trial_motion", "strip", "overlay"} == set(FIGURES)
    assert set(DIAGNOSIS_FIGURES) < set(CAMPAIGN_FIGURES)


def test_the_registry_loads_no_drawing_library() -> None:
    code = "import sys, vinetrack.figures.registry; print(*{'matplotlib', 'numpy', 'pandas'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
