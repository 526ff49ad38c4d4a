"""The explorer: predictions, background fits, recordings, its server, and what a user does on its page and is shown."""

import contextlib
import json
import math
import re
import shutil
import socket
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import urlsplit

import numpy as np
import pandas as pd
import pytest
from bokeh.document import Document
from bokeh.events import ButtonClick
from chrome import until
from commanded import run
from explorer_campaign import DEMO, SETTINGS, write_bars, write_diagnosis
from own_effect import write_effect
from served import Served
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from vinetrack.diagnosis.ladder import compare
from vinetrack.effects import Parameter, remember
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.inference.fit_data import FitError
from vinetrack.laboratory.campaigns import grow, read_ground_truth
from vinetrack.pages.campaign import BackgroundFit, Campaign, Job, choice_in_use, slider_range
from vinetrack.pages.page import Page, open_campaign, start_server, suspects
from vinetrack.pages.plots import RecordingView, recording_view
from vinetrack.results import Results, ResultsError
from vinetrack.video.axis import Axis

GAMMA = "size_reservoir_depletion.gamma"


class Browser:
    """In place of a browser: a document whose callbacks are run by hand."""

    def __init__(self, background: BackgroundFit) -> None:
        self.document = Document()
        self.page = Page(background, self.document)
        self.turn()

    def model(self, name: str):
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
    grown.wait()
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


def test_conditions_can_be_chosen(browser):
    browser.model("conditions").active = [0]
    assert browser.model("residual_curves").data["condition"] == ["24 mm, 24 kPa"] * 2
    assert browser.model("error_bars").data["alpha"][2] > browser.model("error_bars").data["alpha"][0]
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
    bars = browser.model("error_bars").data
    assert all(now < was for now, was in zip(bars["now"], before, strict=True))
    # The effect that is missing brings every condition to what an adequate model would show.
    assert all(now < highest for now, highest in zip(bars["now"], bars["highest"], strict=True))
    table = compare(browser.page.last.fit, browser.page.campaign.pairs).table.set_index("condition")
    expected_mm = 1e3 * table.loc[list(bars["condition"]), "rms_position_m"].to_numpy(float)
    assert list(bars["now"]) == pytest.approx(expected_mm, rel=1e-9)
    assert f"off by {np.sqrt(np.mean(expected_mm**2)):#.3g} mm" in browser.text("headline")
    found = browser.text("found_reservoir_depletion.gamma")
    gamma, *sigma = re.findall(r"[\d.]+", found)[:2]
    # 1.4 is what the trials were grown with, and the largest that a gas can have.
    assert (gamma, "at its bound" in found) == ("1.4", True) or abs(float(gamma) - 1.4) < 2 * float(sigma[0]) < 0.03
    assert re.search(r"Δχ² = [\d,.]+ for \+1 parameters", browser.text("numbers"))
    browser.click("hold")
    browser.model(GAMMA).value = 1.2
    browser.turn()
    browser.turn()
    assert browser.model("hold").label == "Release"
    browser.click("as_fitted")
    browser.turn()
    assert browser.model("tick_reservoir_depletion").active
    browser.click("hold")


def test_a_diagnosis_appears_when_the_page_is_opened_again(campaign, background, tmp_path):
    folder = tmp_path / "vines"
    shutil.copytree(campaign.folder, folder)
    own = BackgroundFit(open_campaign(folder, campaign.experiment.folder))
    own.prediction, own.fitted = background.prediction, background.fitted
    page = Browser(own)
    assert f"vinetrack diagnose {folder}" in page.text("verdict")
    page.page.close()
    write_diagnosis(folder)
    again = Browser(own)
    assert f"<b>{again.page.diagnosis.verdict}</b>" in again.text("verdict")
    assert "chamber (l)" in again.text("next")
    assert "refutes" in again.text("headline")
    assert again.page.panel.root.children[0].children[0].label == "Suspected by the diagnosis"
    known = again.page.diagnosis
    assert suspects(replace(known, rounds=(replace(known.rounds[0], verdict="adequate"),))) == ()
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
    (tmp_path / "torn.mp4").write_bytes(b"not a film")
    view = RecordingView(tmp_path / "torn.mp4", Axis((0.0, 0.0), (50.0, 0.0)), 5.0, pd.DataFrame(), np.zeros(0))
    monkeypatch.setattr("vinetrack.pages.plots.recording_view", lambda *_: view)
    browser.page.film.show_trial(browser.page.campaign.trials[0].name)
    browser.until(lambda: "decoding" not in browser.text("film_caption"), 30)
    browser.page._update_text()
    assert "torn.mp4" in browser.text("film_caption")


def test_after_unexplained_the_command_is_named_and_an_effect_of_ones_own_is_saved(campaign, tmp_path):
    folder, results = tmp_path / "vines", tmp_path / "results"
    shutil.copytree(campaign.experiment.folder, folder)
    shutil.copytree(campaign.folder, results)
    path = write_diagnosis(results)
    rounds = [{"model": [], "verdict": "unexplained", "ranking": []}]
    known = {**json.loads(path.read_text()), "verdict": "unexplained", "answer_set": [], "rounds": rounds}
    path.write_text(json.dumps(known), encoding="utf-8")
    remember(write_effect(folder))
    with (folder / "experiment.yaml").open("a", encoding="utf-8") as settings:
        settings.write("effects: [spring_line.py]\n")
    page = Browser(fitted(open_campaign(results, folder)))
    assert "vinetrack propose" in page.text("verdict")
    page.page.choice = page.page.choice.with_effect("spring_line")
    page.click("save")
    assert "Saved." in page.text("saved")
    page.page.close()
    again = Browser(fitted(open_campaign(results, folder)))
    again.turn()
    assert "spring line" in again.text("headline")  # which the model in use has not yet
    again.page.close()
    settings = read_experiment_settings(folder / "experiment.yaml")
    assert (settings.model[-1], settings.effects) == ("spring_line", ("spring_line.py",))
    assert SETTINGS.splitlines()[0] in (folder / "experiment.yaml").read_text(encoding="utf-8")


def test_a_refused_fit_still_shows_the_trials_a_folder_without_any_is_refused(campaign, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    (folder / "fit.json").write_text(json.dumps({"model": [], "refused": "no reason"}))
    bare = open_campaign(folder)
    assert (bare.stored.refused, bare.highest_m) == ("no reason", {})
    assert choice_in_use(bare).numbers["eversion_damping.n"] == 0.37
    true = {one.stated.name: one for one in grow(bare.experiment.trials, read_ground_truth(DEMO))}
    assert len(bare.trials) == 6
    for seen in bare.trials:
        # The last frame at rest, where 0.1 mm of noise hides the first two milliseconds of the motion.
        assert seen.release_s == pytest.approx(true[seen.name].release_s, abs=2.5e-3)
        assert seen.origin_m == pytest.approx(true[seen.name].origin_m, abs=1e-4)
    for path in (folder / "tracks").iterdir():
        path.write_text(path.read_text().splitlines()[0] + "\n")
    with pytest.raises(ResultsError):
        open_campaign(folder)


def test_slider_ranges_include_zero_the_plausible_range_and_the_fitted_value():
    drag = Parameter("C_D", "C_D", "1", 1.0, bounds=(0.0, 200.0), plausible=(0.0, 3.0))
    assert slider_range("air_drag.C_D", drag, 1.0) == (0.0, 3.0)
    assert slider_range("air_drag.C_D", drag, 200.0)[1] == 200.0
    gauge = Parameter("delta", "δ", "Pa", 500.0, bounds=(-2e4, 2e4), plausible=(-2e3, 2e3))
    assert slider_range("pressure_gauge.delta", gauge, -3e3) == (-3e3, 2e3)
    damping = Parameter("B", "B", "N·(s/m)ⁿ", 3.0, bounds=(0.0, math.inf), shared="vine")
    assert slider_range("eversion_damping.B", damping, 6.0) == (0.0, 12.0)


def test_edges_stand_across_the_axis_where_the_track_and_the_shake_put_them():
    frames = np.arange(20.0)
    edge_px = np.where(frames < 15, 10 + 5 * frames, np.nan)
    track = pd.DataFrame({"edge_px": edge_px, "lead_position_m": 1e-3 * (edge_px - 10)})
    shake_px = np.where(frames == 3, 2.0, 0.0)
    one = RecordingView(Path("a.mp4"), Axis((100.0, 50.0), (400.0, 50.0)), 10.0, track, shake_px)
    along = one.along_px(np.array([0.0, 0.0125, 0.1, -0.01]))
    np.testing.assert_allclose(along, [10.0, 22.5, 110.0, 0.0], atol=1e-9)
    assert one.across(20.0, 4) == ((120.0, 120.0), (60.0, 40.0))
    assert one.across(20.0, 3) == one.across(22.0, 4)
    upright = replace(one, axis=Axis((100.0, 50.0), (100.0, 350.0)))
    np.testing.assert_allclose(upright.across(20.0, 4), ((90.0, 110.0), (70.0, 70.0)))


def test_a_recording_is_shown_with_the_axis_it_was_tracked_along(campaign, tmp_path):
    seen = campaign.trials[0]
    results = Results(tmp_path)
    trial = replace(seen.data.trial, video=tmp_path / "gone.mp4", track=None)
    assert "no longer exists" in str(recording_view(results, trial))
    trial = replace(trial, video=write_bars(tmp_path / "a.mp4", np.full(2, 20)))
    assert "does not exist" in str(recording_view(results, trial))
    for path in (results.track(trial.name), results.analysed(trial.name)):
        path.parent.mkdir()
    head = "frame,time_s,edge_px,lead_position_m,lead_position_sigma_m,flag"
    results.track(trial.name).write_text(f"{head}\n0,0,5,0,0,\n")

    def along(**axis) -> RecordingView | str:
        results.analysed(trial.name).write_text(json.dumps({"axis": axis}))
        return recording_view(results, trial)

    assert "run `vinetrack run` again" in str(along())
    found = along(from_px=[0, 10], to_px=[300, 10], width_px=None)
    assert isinstance(found, RecordingView)
    assert found.half_width_px == pytest.approx(15.0)
    assert (found.axis.from_px, found.axis.to_px) == ((0.0, 10.0), (300.0, 10.0))
    found = along(from_px=[0, 10], via_px=[[100, 40]], to_px=[300, 10], width_px=20)
    assert isinstance(found, RecordingView)
    (x0, x1), (y0, y1) = found.across(0.5 * found.axis.length_px, 0)
    middle, direction = found.axis.points(0.5 * found.axis.length_px), np.array([y0 - y1, x1 - x0]) / 30
    assert np.allclose([(x0 + x1) / 2, (y0 + y1) / 2], middle)
    assert np.allclose(direction, found.axis.direction_at(0.5 * found.axis.length_px), atol=1e-9)


def test_an_experiment_that_has_moved_is_named_by_its_option(campaign, tmp_path):
    shutil.copytree(campaign.folder, tmp_path / "results")
    (tmp_path / "results" / "provenance.json").write_text(json.dumps({"experiment": str(tmp_path / "vines")}))
    for folder, said in (("nowhere", ""), ("results", "--experiment")):
        done = run("explore", tmp_path / folder)
        assert done.exit_code == 1
        assert said in done.output
    assert open_campaign(tmp_path / "results", campaign.experiment.folder).conditions == campaign.conditions


@pytest.mark.slow
def test_the_server_is_for_this_machine_only_and_ends_with_ctrl_c(campaign):
    async def from_elsewhere() -> None:
        request = HTTPRequest(address.replace("http", "ws") + "ws", headers={"Origin": "http://example.org"})
        with pytest.raises(HTTPClientError, match="403"):
            await websocket_connect(request)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        own = "127.0.0.2"  # without a listener, where this machine has no other address
        with contextlib.suppress(OSError):
            probe.connect(("192.0.2.1", 9))
            own = str(probe.getsockname()[0])
    with Served(campaign.folder, "--port", "0") as served:
        address = served.address
        with urllib.request.urlopen(address, timeout=60) as answer:
            assert "vinetrack explorer" in answer.read().decode("utf-8")
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((own, urlsplit(address).port), timeout=5)
        IOLoop(make_current=False).run_sync(from_elsewhere)
        assert served.interrupt() == 0
        assert served.lines[-1] == "Explorer ended."
        assert not [line for line in served.lines if "Traceback" in line or "WARNING" in line]


def test_no_route_answers_under_another_name_or_without_the_secret():
    def status(address: str, host: str) -> int:
        request = HTTPRequest(address, headers={"Host": host})
        return server.loop.run_sync(lambda: AsyncHTTPClient().fetch(request, raise_error=False)).code

    server = start_server(None, 0)
    port = server.port
    for route in ("", "ws", "autoload.js?bokeh-autoload-element=a", "static/js/bokeh.min.js", "metadata"):
        for name in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"localhost.evil.example:{port}"):
            assert status(server.address + route, name) == 403
        assert status(f"http://127.0.0.1:{port}/{route}", f"127.0.0.1:{port}") == 404
    server.stop()


def test_what_a_stopped_job_has_yet_to_tell_is_not_told():
    queued, told = [], []
    job = Job(lambda _: "an old fit", print, lambda *outcome: told.append(outcome), queued.append)
    job.wait()
    job.cancel()
    for call in queued:
        call()
    assert len(queued) == 1
    assert told == []
