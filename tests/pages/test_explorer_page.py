"""The explorer's page without a browser: what a user does, the numbers shown, and the effect proposed."""

import json
import re
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import yaml
from bokeh.document import Document
from bokeh.events import ButtonClick
from chrome import until
from explorer_campaign import DEMO, SETTINGS, SMALL, make_experiment, make_results, run, write_diagnosis
from own_effect import write_effect

from vinetrack.diagnosis.ladder import compare
from vinetrack.effects import remember
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.inference.fit_data import FitError
from vinetrack.pages import controls
from vinetrack.pages.campaign import BackgroundFit, Campaign
from vinetrack.pages.page import Page, open_campaign
from vinetrack.pages.plots import RecordingView
from vinetrack.pipeline.effects_stage import WrittenProposal
from vinetrack.results.folder_layout import ResultsError
from vinetrack.video.axis import Axis

GAMMA = "size_reservoir_depletion.gamma"


class Browser:
    """In place of a browser: a document whose callbacks are run by hand."""

    def __init__(self, background: BackgroundFit, reopen: Callable[[BackgroundFit], None] | None = None) -> None:
        self.document = Document()
        self.page = Page(background, self.document, reopen)
        self.turn()

    def model(self, name: str) -> Any:
        found = self.document.get_model_by_name(name)
        assert found is not None, name
        return found

    def text(self, name: str) -> str:
        return str(self.model(name).text)

    def turn(self) -> None:
        """Run all pending callbacks once."""
        for callback in list(self.document.session_callbacks):
            if type(callback).__name__ != "PeriodicCallback":
                self.document.callbacks.remove_session_callback(callback)
                callback.callback()

    def until(self, asked: Callable[[], bool], seconds: float = 240) -> None:
        until(lambda: asked() or self.turn(), "the page", seconds)

    def click(self, name: str) -> None:
        self.model(name)._trigger_event(ButtonClick(self.model(name)))


def fitted(campaign: Campaign) -> BackgroundFit:
    grown = BackgroundFit(campaign).begin()
    grown.wait(240)
    assert grown.failure == ""
    return grown


@pytest.fixture(scope="module")
def background(campaign):
    return fitted(campaign)


@pytest.fixture
def browser(background):
    opened = Browser(background)
    yield opened
    opened.page.close()


def test_a_slider_adds_its_effect_and_moves_the_curves(browser):
    assert browser.model("tick_gravity").disabled
    assert browser.model("tick_inlet_loss").disabled  # the sheet states no inlet
    before = [list(part) for part in browser.model("model_curves").data["ys"]]
    assert len(before) == 3
    browser.model(GAMMA).value = 1.2
    browser.turn()
    assert browser.model("tick_reservoir_depletion").active
    assert [list(part) for part in browser.model("model_curves").data["ys"]] != before
    browser.turn()  # words follow in a turn of their own
    assert "reservoir depletion" in browser.text("headline")
    assert browser.text("commands") == ""


def test_conditions_and_trials_can_be_chosen(browser):
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


def test_a_refit_brings_the_error_down_and_says_what_it_found(browser):
    before, said = list(browser.model("error_bars").data["now"]), browser.text("headline")
    browser.model("tick_reservoir_depletion").active = True
    browser.turn()
    assert browser.text("headline") == said
    assert browser.model("refit").label == "Stop"
    browser.until(lambda: browser.model("refit").label == "Refit")
    browser.turn()
    assert all(now < was for now, was in zip(browser.model("error_bars").data["now"], before, strict=True))
    found = browser.text("found_reservoir_depletion.gamma")
    gamma, *sigma = re.findall(r"[\d.]+", found)[:2]
    # 1.4 is what the trials were grown with, and the largest that a gas can have.
    assert (gamma, "at its bound" in found) == ("1.4", True) or abs(float(gamma) - 1.4) < 2 * float(sigma[0]) < 0.03
    assert "vinetrack add reservoir_depletion" in browser.text("commands")
    assert re.search(r"−2 ln L fell by [\d,.]+ for 1 parameter more", browser.text("numbers"))
    browser.click("hold")
    browser.model(GAMMA).value = 1.2
    browser.turn()
    browser.turn()
    assert browser.model("hold").label == "Release"
    browser.click("as_fitted")
    browser.turn()
    assert browser.model("tick_reservoir_depletion").active
    browser.click("hold")


def test_a_diagnosis_appears_by_itself(campaign, background, tmp_path):
    folder = tmp_path / "vines"
    shutil.copytree(campaign.folder, folder)
    own = BackgroundFit(open_campaign(folder, campaign.experiment.folder))
    own.prediction, own.fitted = background.prediction, background.fitted
    page = Browser(own)
    write_diagnosis(folder)
    page.page._check_for_diagnosis()
    assert "+0.97" in page.text("tied")
    assert "a chamber of 4 litres" in page.text("next")
    page.page.close()
    again = Browser(own)
    assert again.page.panel.root.children[0].children[0].label == "Suspected by the diagnosis"
    again.page.close()
    (folder / "diagnosis.json").write_text("[]", encoding="utf-8")
    Browser(own).page.close()  # opens with a diagnosis that is torn


def test_a_failed_simulation_is_reported_and_curves_stay(browser, monkeypatch):
    before = list(browser.model("error_bars").data["now"])
    monkeypatch.setattr("vinetrack.pages.page.predict_choice", Mock(side_effect=FitError("Trial a: too hard.")))
    browser.model(GAMMA).value = 1.1
    browser.turn()
    assert "too hard" in browser.text("status")
    assert list(browser.model("error_bars").data["now"]) == before


def test_a_torn_recording_is_named(browser, monkeypatch, tmp_path):
    """Also once the text of the page was updated."""
    (tmp_path / "torn.mp4").write_bytes(b"not a film")
    no = np.zeros(0)
    view = RecordingView(tmp_path / "torn.mp4", Axis((0.0, 0.0), (50.0, 0.0)), 5.0, no, no, no, no, no > 0)
    monkeypatch.setattr("vinetrack.pages.plots.recording_view", lambda *_: view)
    browser.page.film.show_trial(browser.page.campaign.trials[0].name)
    browser.until(lambda: "tracked" in browser.text("film_caption"), 30)
    browser.page._update_text()
    assert "torn.mp4" in browser.text("film_caption")


EFFECT = "tail_friction"
SIZE = f"size_{EFFECT}.mu_w"


def bars_mm(numbers: Browser, column: str) -> dict[str, float]:
    bars = numbers.model("error_bars").data
    return dict(zip(bars["condition"], map(float, bars[column]), strict=True))


def compared_mm(table: pd.DataFrame, column: str) -> dict[str, float]:
    return dict(zip(table["condition"].astype(str), 1e3 * table[column].astype(float), strict=True))


def assert_shows(numbers: Browser, table: pd.DataFrame, rel: float) -> None:
    """The bars, the headline and the residuals drawn."""
    expected = compared_mm(table, "rms_position_m")
    assert bars_mm(numbers, "now") == pytest.approx(expected, rel=rel)
    assert bars_mm(numbers, "floor") == pytest.approx(compared_mm(table, "replicate_floor_m"), rel=rel)
    overall = float(np.sqrt(np.mean(np.square(list(expected.values())))))
    assert f"off by {overall:.3g} mm" in numbers.text("headline")
    for trial, drawn in zip(numbers.page.shown.trials, numbers.model("residual_curves").data["ys"], strict=True):
        assert np.nanmax(np.abs(drawn)) <= 1e3 * np.abs(trial.residual_m).max() + 1e-9


def settled(numbers: Browser) -> pd.DataFrame:
    """Wait for the fit; what a comparison says of it."""
    numbers.turn()
    numbers.until(lambda: numbers.model("refit").label == "Refit", 240)
    numbers.turn()
    numbers.turn()
    return compare(numbers.page.last.fit, numbers.page.campaign.pairs).table


def slide(numbers: Browser, size: float) -> None:
    numbers.model(SIZE).value = size
    numbers.turn()
    numbers.turn()


@pytest.mark.slow
def test_every_step_of_a_user_shows_the_errors_of_a_comparison_and_what_add_finds(tmp_path):
    """Trials with measured pressures and an effect that is not in the model."""
    nature = yaml.safe_load(DEMO.read_text(encoding="utf-8"))
    nature |= {"effects": [*nature["effects"], EFFECT], "trace_sigma_kPa": 0.1}
    (tmp_path / "nature.yaml").write_text(yaml.safe_dump(nature), encoding="utf-8")
    experiment = make_experiment(tmp_path / "vines", SMALL, SETTINGS, tmp_path / "nature.yaml")
    results = make_results(experiment, tmp_path / "results" / "vines")
    numbers = Browser(fitted(open_campaign(results)))
    opened = pd.read_csv(results / "comparison.csv")
    assert_shows(numbers, opened, 1e-6)

    numbers.model(f"tick_{EFFECT}").active = True
    with_effect = settled(numbers)
    assert_shows(numbers, with_effect, 1e-9)

    size = numbers.model(SIZE).value
    slide(numbers, 0.0)
    expected_mm = compared_mm(with_effect, "rms_position_m")
    assert max(abs(bars_mm(numbers, "now")[name] - error_mm) for name, error_mm in expected_mm.items()) > 0.3
    slide(numbers, size)
    assert_shows(numbers, with_effect, 1e-6)

    numbers.click("refit")
    assert_shows(numbers, settled(numbers), 1e-9)

    numbers.model(f"tick_{EFFECT}").active = False
    assert_shows(numbers, settled(numbers), 1e-9)
    assert bars_mm(numbers, "now") == pytest.approx(compared_mm(opened, "rms_position_m"), rel=0.02)

    numbers.model(f"tick_{EFFECT}").active = True
    settled(numbers)
    on_page = bars_mm(numbers, "now")
    run("add", EFFECT, results, "--save")
    ladder = pd.read_csv(results / "ladder.csv").set_index("added")
    overall_m = 1e-3 * float(np.sqrt(np.mean(np.square(list(on_page.values())))))
    assert ladder.loc[EFFECT, "rms_in_sample_m"] == pytest.approx(overall_m, rel=5e-3)

    campaign = open_campaign(results)
    assert campaign.in_use == tuple(json.loads((results / "fit.json").read_text())["model"])
    assert tuple(campaign.experiment.settings.model) == (*campaign.in_use, EFFECT)
    again = Browser(fitted(campaign))
    again.turn()
    assert not again.model(f"tick_{EFFECT}").active
    assert_shows(again, pd.read_csv(results / "comparison.csv"), 1e-6)
    assert "vinetrack run" in again.text("headline")
    assert "vinetrack run" not in numbers.text("headline")
    for page in (numbers, again):
        page.page.close()


Opened = tuple[Browser, list[BackgroundFit]]


@pytest.fixture
def opened(campaign, tmp_path):
    """A page of a copy of experiment and results, diagnosed as `unexplained`, and the pages opened in its place."""
    experiment, folder = tmp_path / "vines", tmp_path / "results"
    shutil.copytree(campaign.experiment.folder, experiment)
    shutil.copytree(campaign.folder, folder)
    path = write_diagnosis(folder)
    rounds = [{"model": [], "verdict": "unexplained", "ranking": []}]
    known = {**json.loads(path.read_text()), "verdict": "unexplained", "answer_set": [], "rounds": rounds}
    path.write_text(json.dumps(known), encoding="utf-8")
    reopened: list[BackgroundFit] = []
    browser = Browser(fitted(open_campaign(folder, experiment)), reopened.append)
    yield browser, reopened
    browser.page.close()


@pytest.mark.slow
def test_the_proposed_effect_is_opened_fitted_and_saved(opened, tmp_path, monkeypatch):
    browser, reopened = opened
    folder, going_on = tmp_path / "vines", threading.Event()

    def search(experiment: Any, results: Path, to: Path | None, told: Callable[[str], None]) -> WrittenProposal:
        assert (experiment.folder, results, to) == (folder, tmp_path / "results", None)
        told("learning the missing force as a table")
        assert going_on.wait(60)
        path = write_effect(folder)
        remember(path)
        return WrittenProposal(("A law of the travel does.", f"Written to {path}."), (path,))

    monkeypatch.setattr(controls, "propose_effect", search)
    assert browser.model("propose_panel").visible
    assert f"vinetrack propose {(tmp_path / 'results').as_posix()}" in browser.text("proposal")
    browser.click("propose")
    browser.until(lambda: (browser.page._update_status(), "learning the missing force" in browser.text("proposal"))[1])
    assert browser.model("propose").label == "Stop"
    going_on.set()
    browser.until(lambda: "Written to" in browser.text("proposal"))
    assert not browser.model("propose").visible

    browser.click("open_proposed")
    assert browser.page.proposal._reload.data == {"times": [1]}
    (background,) = reopened
    background.wait(240)
    page = Browser(background)
    page.until(lambda: "N·(s/m)ⁿ" in page.text("numbers"))
    assert page.model("tick_spring_line").active
    page.click("refit")
    page.until(lambda: page.model("refit").label == "Refit" and not page.page._sizes_changed, 240)
    page.page._update_text()
    assert f"vinetrack add {(folder / 'spring_line.py').as_posix()}" in page.text("commands")
    page.click("save")
    assert "Saved." in page.text("saved")
    page.page.close()
    settings = read_experiment_settings(folder / "experiment.yaml")
    assert (settings.model[-1], settings.effects) == ("spring_line", ("spring_line.py",))
    assert SETTINGS.splitlines()[0] in (folder / "experiment.yaml").read_text(encoding="utf-8")


def test_a_stopped_or_failed_search_can_be_restarted(opened, monkeypatch):
    browser, _ = opened
    begun, ended = threading.Event(), threading.Event()

    def endless(*given: Any) -> None:
        begun.set()
        try:
            while True:
                given[-1]("still searching")
        finally:
            ended.set()

    monkeypatch.setattr(controls, "propose_effect", endless)
    browser.click("propose")
    assert begun.wait(60)
    browser.click("propose")
    assert ended.wait(60)

    torn = browser.page.campaign.experiment.folder / "no law.py"
    torn.write_text("def tail_force(", encoding="utf-8")
    failures: list[Callable[..., Any]] = [Mock(side_effect=ResultsError("no law"))]
    for search in (*failures, lambda *_: WrittenProposal(("no law",), ()), lambda *_: WrittenProposal((), (torn,))):
        monkeypatch.setattr(controls, "propose_effect", search)
        browser.click("propose")
        browser.until(lambda: "no law" in browser.text("proposal"))
        assert browser.model("propose").label == controls.PROPOSE
        assert not browser.model("open_proposed").visible
