"""The explorer below its page: predictions of a choice, background fits, recordings, its local server."""

import contextlib
import json
import math
import shutil
import socket
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pandas as pd
import pytest
from commanded import run
from explorer_campaign import DEMO, SMALL, make_experiment, make_results, write_bars
from served import Served
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from vinetrack.effects import Parameter
from vinetrack.laboratory.tracks import grow, read_ground_truth
from vinetrack.pages.campaign import choice_in_use, commands, predict_choice, slider_range
from vinetrack.pages.page import address as where
from vinetrack.pages.page import open_campaign, start_server
from vinetrack.pages.plots import RecordingView, decode, recording_view
from vinetrack.results.folder_layout import Results, ResultsError
from vinetrack.video.axis import Axis


@pytest.mark.slow
def test_the_origin_behind_a_door_is_that_of_the_comparison(tmp_path):
    """No point of a doubtful rest is fitted, but it still determines the origin."""
    experiment = make_experiment(tmp_path / "vines", SMALL[:4])
    for path in (experiment / "tracks").iterdir():
        table = pd.read_csv(path)
        table.assign(sigma_m=np.where(table["time_s"] < 0.015, 2e-3, 1e-4)).to_csv(path, index=False)
    door = open_campaign(make_results(experiment, tmp_path / "results"))
    table = pd.read_csv(door.folder / "comparison.csv").set_index("condition")
    prediction = predict_choice(door, choice_in_use(door))
    for seen, predicted in zip(door.trials, prediction.trials, strict=True):
        assert seen.data.imprecise_rest is not None
        assert predicted.origin_m == pytest.approx(seen.origin_m, abs=1e-12)
    assert prediction.errors_m == pytest.approx(table["rms_position_m"].to_dict(), rel=1e-6)


def test_a_refused_fit_still_shows_the_trials_a_folder_without_any_is_refused(campaign, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    (folder / "fit.json").write_text(json.dumps({"model": [], "refused": "no reason"}))
    bare = open_campaign(folder)
    assert (bare.refused, bare.floors_m) == ("no reason", {})
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
    assert slider_range("air_drag.C_D", drag, 17.0) == (0.0, 21.25)
    assert slider_range("air_drag.C_D", drag, 200.0)[1] == 200.0
    gauge = Parameter("delta", "δ", "Pa", 500.0, bounds=(-2e4, 2e4), plausible=(-2e3, 2e3))
    assert slider_range("pressure_gauge.delta", gauge, -3e3) == (-3e3, 2e3)
    damping = Parameter("B", "B", "N·(s/m)ⁿ", 3.0, bounds=(0.0, math.inf), shared="vine")
    assert slider_range("eversion_damping.B", damping, 6.0) == (0.0, 12.0)


def test_the_page_shows_the_command_that_reproduces_it(campaign):
    start = choice_in_use(campaign)
    folder = campaign.folder.as_posix()
    assert commands(campaign, start, fitted=True) == [f"vinetrack compare {folder}"]
    more = start.with_effect("reservoir_depletion").with_effect("leak")
    added = [f"vinetrack add {name} {folder} --save" for name in ("reservoir_depletion", "leak")]
    assert commands(campaign, more, fitted=True, save=True) == added
    assert commands(campaign, more, fitted=False) == []
    assert commands(replace(campaign, in_use=(*campaign.in_use, "leak")), start, fitted=True) == []


def test_frames_come_back_as_they_were_filmed(tmp_path):
    """A bar whose right end moves by 8 px per frame."""
    told: list[tuple[int, float]] = []
    film = decode(write_bars(tmp_path / "a.mp4", 20 + 8.0 * np.arange(30), 320, 96), told.append)
    assert (len(film.frames), film.scale) == (30, 1.0)
    assert told == [(1, 1 / 30), (11, 11 / 30), (21, 21 / 30)]
    assert film.picture(10).shape == (96, 320)
    assert abs(int(np.argmax(film.picture(10)[48] < 120)) - 100) <= 1


def test_edges_stand_across_the_axis_where_the_track_and_the_shake_put_them():
    frames = np.arange(20.0)
    edge_px = np.where(frames < 15, 10 + 5 * frames, np.nan)
    one = RecordingView(
        Path("a.mp4"), Axis((100.0, 50.0), (400.0, 50.0)), 10.0, frames / 1000, edge_px, 1e-3 * (edge_px - 10),
        shake_px=np.where(frames == 3, 2.0, 0.0), by_hand=frames == 4,
    )  # fmt: skip
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

    def along(**axis: Any) -> RecordingView | str:
        results.analysed(trial.name).write_text(json.dumps({"axis": axis}))
        return recording_view(results, trial)

    assert "run snakemake again" in str(along())
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
        return server.io_loop.run_sync(lambda: AsyncHTTPClient().fetch(request, raise_error=False)).code

    server = start_server(None, 0)
    port = server.port
    for route in ("", "ws", "autoload.js?bokeh-autoload-element=a", "static/js/bokeh.min.js", "metadata"):
        for name in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"localhost.evil.example:{port}"):
            assert status(where(server) + route, name) == 403
        assert status(f"http://127.0.0.1:{port}/{route}", f"127.0.0.1:{port}") == 404
    server.stop()
