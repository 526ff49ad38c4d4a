"""The page without a browser: user input to its models, and the resulting state of the page."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from explorer_campaign import SETTINGS, write_diagnosis
from page_browser import Browser

from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.pages.campaign import BackgroundFit, Campaign
from vinetrack.pages.explorer_server import open_campaign

GAMMA = "size_reservoir_depletion.gamma"


@pytest.fixture(scope="module")
def background(campaign: Campaign) -> BackgroundFit:
    grown = BackgroundFit(campaign).begin()
    grown.wait(240)
    assert grown.failure == ""
    return grown


@pytest.fixture
def browser(background: BackgroundFit) -> Iterator[Browser]:
    opened = Browser(background)
    yield opened
    opened.page.close()


def error_of(browser: Browser) -> list[float]:
    return list(browser.model("error_bars").data["now"])


def test_it_opens_with_the_model_in_use(browser: Browser) -> None:
    assert browser.text("headline").startswith("<h1>Base model: ")
    assert "off by" in browser.text("headline")
    assert len(browser.model("model_curves").data["xs"]) == 3
    assert len(browser.model("residual_curves").data["xs"]) == 6
    assert "vinetrack compare" in browser.text("commands")
    assert "no diagnosis yet" in browser.text("tied").lower()
    assert browser.model("tick_gravity").disabled
    assert browser.model("tick_inlet_loss").disabled
    assert "N·(s/m)ⁿ" in browser.text("numbers")


def test_a_slider_adds_its_effect_and_moves_the_curves(browser: Browser) -> None:
    before = [list(part) for part in browser.model("model_curves").data["ys"]]
    browser.model(GAMMA).value = 1.2
    browser.turn()
    assert browser.model("tick_reservoir_depletion").active
    assert [list(part) for part in browser.model("model_curves").data["ys"]] != before
    # Words follow in a turn of their own: see TEXT_DELAY_MS.
    browser.turn()
    assert "reservoir depletion" in browser.text("headline")
    assert browser.text("commands") == ""


def test_many_moves_of_a_slider_are_drawn_as_one(browser: Browser) -> None:
    drawn = []
    browser.model("model_curves").on_change("data", lambda _attr, _old, _new: drawn.append(1))
    for value in (1.1, 1.2, 1.3):
        browser.model(GAMMA).value = value
    browser.turn()
    assert len(drawn) == 1


def test_conditions_and_trials_can_be_chosen(browser: Browser) -> None:
    browser.model("conditions").active = [0]
    assert browser.model("residual_curves").data["condition"] == ["24 kPa", "24 kPa"]
    assert browser.model("error_bars").data["alpha"][2] > browser.model("error_bars").data["alpha"][0]
    browser.model("trials").active = [0]
    assert len(browser.model("residual_curves").data["xs"]) == 1
    browser.click("choose_none")
    assert browser.model("model_curves").data["xs"] == []
    browser.click("choose_all")
    assert len(browser.model("residual_curves").data["xs"]) == 6
    browser.model("error_bars").selected.indices = [2]
    assert browser.model("conditions").active == [0]
    browser.model("error_bars").selected.indices = [2]
    assert browser.model("conditions").active == [0, 1, 2]


def test_a_refit_brings_the_error_down_and_says_what_it_found(browser: Browser) -> None:
    before, said = error_of(browser), browser.text("headline")
    browser.model("tick_reservoir_depletion").active = True
    browser.turn()
    assert "refitting" in browser.text("status")
    assert browser.text("headline") == said
    assert browser.model("refit").label == "Stop"
    browser.until(lambda: browser.model("refit").label == "Refit")
    browser.turn()
    assert all(now < was for now, was in zip(error_of(browser), before, strict=True))
    found = browser.text("found_reservoir_depletion.gamma")
    gamma, *sigma = re.findall(r"[\d.]+", found)[:2]
    # 1.4 is what the trials were grown with, and the largest that a gas can have.
    assert (gamma, "at its bound" in found) == ("1.4", True) or abs(float(gamma) - 1.4) < 2 * float(sigma[0]) < 0.03
    assert "for 1 parameter more" in browser.text("numbers")
    assert "vinetrack add reservoir_depletion" in browser.text("commands")
    assert browser.text("status") == ""
    browser.click("hold")
    browser.model(GAMMA).value = 1.2
    browser.turn()
    browser.turn()
    assert "Sizes were changed since" in browser.text("numbers")
    assert "held" in browser.text("numbers")
    assert browser.model("hold").label == "Release"
    browser.click("as_fitted")
    browser.turn()
    assert browser.model("tick_reservoir_depletion").active
    browser.click("hold")
    assert "held" not in browser.text("numbers")


def test_a_fit_can_be_stopped(browser: Browser) -> None:
    browser.model("tick_supply_refill").active = True
    browser.click("refit")
    assert browser.model("refit").label == "Refit"
    assert "stopped" in browser.text("status")
    browser.click("as_fitted")


def test_moving_a_size_cancels_a_running_fit(browser: Browser) -> None:
    browser.model("tick_supply_refill").active = True
    browser.model("size_air_drag.C_D").value = 2.0
    assert browser.model("refit").label == "Refit"
    assert "cancelled" in browser.text("status")


def test_for_a_track_the_page_says_so_and_shows_the_position_of_the_edge(browser: Browser) -> None:
    assert "there is no recording to show" in browser.text("film_caption")
    assert "tracked" in browser.text("film_caption")
    browser.model("film_frame").value = 40
    said = browser.text("film_caption")
    browser.model("film_frame").value = 80
    assert browser.text("film_caption") != said
    assert browser.page.plots.instant.visible
    browser.model("film_trial").value = "d24_36kPa_1"
    assert "d24_36kPa_1 came as a track" in browser.text("film_caption")
    browser.click("film_play")
    assert "pause" in browser.model("film_play").label
    browser.click("film_play")
    assert "play" in browser.model("film_play").label


def test_the_model_is_saved_with_the_comments_around_it(campaign: Campaign, tmp_path: Path) -> None:
    experiment = tmp_path / "vines"
    shutil.copytree(campaign.experiment.folder, experiment)
    page = Browser(BackgroundFit(open_campaign(campaign.folder, experiment)).begin())
    page.page.background.wait(240)
    page.until(lambda: "N·(s/m)ⁿ" in page.text("numbers"))
    page.model("tick_reservoir_depletion").active = True
    page.click("save")
    assert "Saved." in page.text("saved")
    text = (experiment / "experiment.yaml").read_text(encoding="utf-8")
    assert text.startswith(SETTINGS)
    assert read_experiment_settings(experiment / "experiment.yaml").model[-1] == "reservoir_depletion"
    (experiment / "experiment.yaml").write_text("model: [\n", encoding="utf-8")
    page.click("save")
    assert "is not YAML" in page.text("saved")
    page.page.close()


def test_a_diagnosis_appears_by_itself(campaign: Campaign, background: BackgroundFit, tmp_path: Path) -> None:
    folder = tmp_path / "vines"
    shutil.copytree(campaign.folder, folder)
    own = BackgroundFit(open_campaign(folder, campaign.experiment.folder))
    own.prediction, own.fitted = background.prediction, background.fitted
    page = Browser(own)
    write_diagnosis(folder)
    page.page._check_for_diagnosis()
    assert "Cannot be told apart: <b>reservoir depletion, leak</b>" in page.text("tied")
    assert "+0.97" in page.text("tied")
    assert "chamber of 4 L" in page.text("next")
    assert "a chamber of 4 litres" in page.text("next")
    assert "reservoir depletion from leak" in page.text("next")
    page.page.close()
    again = Browser(own)
    groups = [group.children[0].label for group in again.page.panel.root.children]
    assert groups[0] == "Suspected by the diagnosis"
    again.page.close()
    (folder / "diagnosis.json").write_text("[]", encoding="utf-8")
    torn = Browser(own)
    assert "No diagnosis yet" in torn.text("tied")
    torn.page.close()


def test_a_failed_simulation_is_reported_and_the_curves_are_kept(
    browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vinetrack.inference.fit_data import FitError

    def refuse(*_: object) -> None:
        raise FitError("Trial a: too hard.")

    before = error_of(browser)
    monkeypatch.setattr("vinetrack.pages.page.predict_choice", refuse)
    browser.model(GAMMA).value = 1.1
    browser.turn()
    assert "too hard" in browser.text("status")
    assert error_of(browser) == before


def test_a_page_opened_with_a_choice_shows_it(campaign: Campaign) -> None:
    from vinetrack.pages.campaign import choice_in_use

    choice = choice_in_use(campaign).with_effect("leak").with_size("leak.rate", 0.2)
    background = BackgroundFit(campaign, choice).begin()
    background.wait(240)
    page = Browser(background)
    page.turn()
    assert page.model("tick_leak").active
    assert page.model("size_leak.rate").value == pytest.approx(0.2)
    page.page.close()


def test_a_page_opened_as_the_command_does_shows_the_fit_and_no_size_that_was_moved(campaign: Campaign) -> None:
    from vinetrack.pages.campaign import choice_in_use

    grown = BackgroundFit(campaign, choice_in_use(campaign)).begin()
    grown.wait(240)
    page = Browser(grown)
    page.until(lambda: "N·(s/m)ⁿ" in page.text("numbers"))
    assert page.page.is_fitted()
    assert "Sizes were moved" not in page.text("numbers")
    page.page.close()
