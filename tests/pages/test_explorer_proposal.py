"""The button that proposes an effect if no known one explains the trials; the search itself is tested elsewhere."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from explorer_campaign import SETTINGS, write_diagnosis
from own_effect import write_effect
from page_browser import Browser

from vinetrack.effects import EffectError, remember
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.pages import controls
from vinetrack.pages.campaign import BackgroundFit, Campaign
from vinetrack.pages.explorer_server import open_campaign
from vinetrack.pipeline.effects_stage import WrittenProposal
from vinetrack.results.folder_layout import ResultsError


@pytest.fixture
def unexplained(campaign: Campaign, tmp_path: Path) -> Campaign:
    """A copy of the experiment and its results, diagnosed as `unexplained`."""
    experiment, folder = tmp_path / "vines", tmp_path / "results"
    shutil.copytree(campaign.experiment.folder, experiment)
    shutil.copytree(campaign.folder, folder)
    path = write_diagnosis(folder)
    rounds = [{"model": [], "verdict": "unexplained", "ranking": []}]
    known = {**json.loads(path.read_text()), "verdict": "unexplained", "answer_set": [], "rounds": rounds}
    path.write_text(json.dumps(known), encoding="utf-8")
    return open_campaign(folder, experiment)


@pytest.fixture
def opened(unexplained: Campaign) -> Iterator[tuple[Browser, list[BackgroundFit]]]:
    """A page of it, and the pages opened in its place."""
    reopened: list[BackgroundFit] = []
    background = BackgroundFit(unexplained).begin()
    background.wait(240)
    browser = Browser(background, reopened.append)
    yield browser, reopened
    browser.page.close()


def searching(monkeypatch: pytest.MonkeyPatch, search: Callable[..., WrittenProposal]) -> None:
    monkeypatch.setattr(controls, "propose_effect", search)


def test_the_proposed_effect_is_opened_fitted_and_saved_with_its_file(
    opened: tuple[Browser, list[BackgroundFit]], unexplained: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser, reopened = opened
    folder, going_on = unexplained.experiment.folder, threading.Event()

    def search(experiment: Any, results: Path, to: Path | None, told: Callable[[str], None]) -> WrittenProposal:
        assert (experiment.folder, results, to) == (folder, unexplained.folder, None)
        told("learning the missing force as a table")
        assert going_on.wait(60)
        path = write_effect(folder)
        remember(path)
        return WrittenProposal(("A law of the travel does.", f"Written to {path}."), (path,))

    searching(monkeypatch, search)
    assert browser.model("propose_panel").visible
    assert f"vinetrack propose {unexplained.folder.as_posix()}" in browser.text("proposal")
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
    assert f"vinetrack add {(folder / 'spring_line.py').as_posix()}" in _fitted_commands(page)
    page.click("save")
    assert "Saved." in page.text("saved")
    page.page.close()
    settings = read_experiment_settings(folder / "experiment.yaml")
    assert (settings.model[-1], settings.effects) == ("spring_line", ("spring_line.py",))
    assert SETTINGS.splitlines()[0] in (folder / "experiment.yaml").read_text(encoding="utf-8")
    assert "spring_line" in open_campaign(unexplained.folder, folder).saved


def _fitted_commands(page: Browser) -> str:
    """Commands of the page once the effect that is ticked was fitted."""
    page.click("refit")
    page.until(lambda: page.model("refit").label == "Refit" and page.page.is_fitted(), 240)
    page.page._update_text()
    return page.text("commands")


def test_a_stopped_or_failed_search_is_reported_and_can_be_restarted(
    opened: tuple[Browser, list[BackgroundFit]], monkeypatch: pytest.MonkeyPatch
) -> None:
    browser, _ = opened
    begun, ended = threading.Event(), threading.Event()

    def endless(*given: Any) -> WrittenProposal:
        begun.set()
        try:
            while not ended.wait(0.01):
                given[-1]("still searching")
        finally:
            ended.set()
        raise AssertionError

    searching(monkeypatch, endless)
    browser.click("propose")
    assert begun.wait(60)
    browser.click("propose")
    assert "was stopped" in browser.text("proposal")
    assert ended.wait(60)

    def refused(*_: Any) -> WrittenProposal:
        raise ResultsError("proposed_time.py exists already: move it away, or give another file with --to.")

    searching(monkeypatch, refused)
    browser.click("propose")
    browser.until(lambda: "exists already" in browser.text("proposal"))
    assert browser.model("propose").label == controls.PROPOSE
    assert not browser.model("open_proposed").visible

    searching(monkeypatch, lambda *_: WrittenProposal(("No law does better than chance.",), ()))
    browser.click("propose")
    browser.until(lambda: "better than chance" in browser.text("proposal"))
    assert not browser.model("open_proposed").visible


def test_it_is_not_offered_if_a_known_effect_may_explain_the_trials(campaign: Campaign) -> None:
    browser = Browser(BackgroundFit(campaign))
    assert not browser.model("propose_panel").visible
    browser.page.close()


def test_an_invalid_effect_file_is_reported(unexplained: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    path = unexplained.experiment.folder / "torn.py"
    path.write_text("def tail_force(", encoding="utf-8")
    searching(monkeypatch, lambda *_: WrittenProposal((), (path,)))
    with pytest.raises(EffectError, match="cannot be read"):
        controls.propose_and_read(unexplained, lambda _: None)
