"""Whatever a user does on the page, its errors are those that `compare`, `add` and the report give the same model.

The trials have measured pressures, so that a release shifts the pressure under a vine; they lack the effect added.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from explorer_campaign import DEMO, SETTINGS, SMALL, make_experiment, make_results, run
from page_browser import Browser

from vinetrack.diagnosis.ladder import compare
from vinetrack.inference.fit_result import Fit
from vinetrack.pages.campaign import BackgroundFit
from vinetrack.pages.explorer_server import open_campaign

EFFECT = "tail_friction"
SIZE = f"size_{EFFECT}.mu_w"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("traced")
    nature = yaml.safe_load(DEMO.read_text(encoding="utf-8"))
    nature |= {"effects": [*nature["effects"], EFFECT], "trace_sigma_kPa": 0.1}
    (folder / "nature.yaml").write_text(yaml.safe_dump(nature), encoding="utf-8")
    experiment = make_experiment(folder / "vines", SMALL, SETTINGS, folder / "nature.yaml")
    return make_results(experiment, folder / "results" / "vines")


@pytest.fixture(scope="module")
def browser(results: Path) -> Iterator[Browser]:
    background = BackgroundFit(open_campaign(results)).begin()
    background.wait(240)
    opened = Browser(background)
    yield opened
    opened.page.close()


def errors_mm(browser: Browser) -> dict[str, float]:
    bars = browser.model("error_bars").data
    return dict(zip(bars["condition"], map(float, bars["now"]), strict=True))


def floors_mm(browser: Browser) -> dict[str, float]:
    bars = browser.model("error_bars").data
    return dict(zip(bars["condition"], map(float, bars["floor"]), strict=True))


def compared_mm(table: pd.DataFrame, column: str) -> dict[str, float]:
    return dict(zip(table["condition"].astype(str), 1e3 * table[column].astype(float), strict=True))


def assert_shows(browser: Browser, table: pd.DataFrame, rel: float) -> None:
    """The bars, the headline and the residuals drawn."""
    expected = compared_mm(table, "rms_position_m")
    assert errors_mm(browser) == pytest.approx(expected, rel=rel)
    assert floors_mm(browser) == pytest.approx(compared_mm(table, "replicate_floor_m"), rel=rel)
    overall = float(np.sqrt(np.mean(np.square(list(expected.values())))))
    assert f"off by {overall:.3g} mm" in browser.text("headline")
    shown = browser.page.shown
    assert shown is not None
    for trial, drawn in zip(shown.trials, browser.model("residual_curves").data["ys"], strict=True):
        assert np.nanmax(np.abs(drawn)) <= 1e3 * np.abs(trial.residual_m).max() + 1e-9


def settled(browser: Browser) -> None:
    browser.turn()
    browser.until(lambda: browser.model("refit").label == "Refit", 240)
    browser.turn()
    browser.turn()


def of_fit(browser: Browser) -> pd.DataFrame:
    assert browser.page.last is not None
    fitted: Fit = browser.page.last.fit
    return compare(fitted, browser.page.campaign.pairs).table


def test_every_step_of_a_user_shows_the_errors_of_a_comparison(browser: Browser, results: Path) -> None:
    opened = pd.read_csv(results / "comparison.csv")
    assert_shows(browser, opened, 1e-6)

    browser.model(f"tick_{EFFECT}").active = True
    settled(browser)
    with_effect = of_fit(browser)
    assert_shows(browser, with_effect, 1e-9)

    fitted = browser.model(SIZE).value
    browser.model(SIZE).value = 0.0
    browser.turn()
    browser.turn()
    assert max(abs(errors_mm(browser)[c] - e) for c, e in compared_mm(with_effect, "rms_position_m").items()) > 0.3
    browser.model(SIZE).value = fitted
    browser.turn()
    browser.turn()
    assert_shows(browser, with_effect, 1e-6)

    browser.click("refit")
    settled(browser)
    assert_shows(browser, of_fit(browser), 1e-9)

    browser.model(f"tick_{EFFECT}").active = False
    settled(browser)
    assert_shows(browser, of_fit(browser), 1e-9)
    assert errors_mm(browser) == pytest.approx(compared_mm(opened, "rms_position_m"), rel=0.02)


def test_add_finds_what_the_page_finds_and_until_the_next_run_the_page_says_which_model_it_shows(
    browser: Browser, results: Path
) -> None:
    browser.model(f"tick_{EFFECT}").active = True
    settled(browser)
    on_page = errors_mm(browser)
    run("add", EFFECT, results, "--save")
    ladder = pd.read_csv(results / "ladder.csv").set_index("added")
    overall_m = 1e-3 * float(np.sqrt(np.mean(np.square(list(on_page.values())))))
    assert ladder.loc[EFFECT, "rms_in_sample_m"] == pytest.approx(overall_m, rel=5e-3)

    campaign = open_campaign(results)
    assert campaign.in_use == tuple(json.loads((results / "fit.json").read_text())["model"])
    assert campaign.saved == (*campaign.in_use, EFFECT)
    background = BackgroundFit(campaign).begin()
    background.wait(240)
    again = Browser(background)
    again.turn()
    assert not again.model(f"tick_{EFFECT}").active
    assert_shows(again, pd.read_csv(results / "comparison.csv"), 1e-6)
    assert "vinetrack run" in again.text("headline")
    assert "vinetrack run" not in browser.text("headline")
    again.page.close()
