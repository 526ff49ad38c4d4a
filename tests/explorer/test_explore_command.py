"""The command: functions without the page, refusals, and a local server that Ctrl-C ends."""

from __future__ import annotations

import importlib.util
import json
import shutil
import socket
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from explorer_campaign import SETTINGS, run
from served import Served
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.server import address as where
from vinetrack.explorer.server import start_server


def refused(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    return done.output


@pytest.fixture
def copied(campaign: Campaign, tmp_path: Path) -> tuple[Path, Path]:
    """Experiment and results that a test may write to."""
    shutil.copytree(campaign.experiment.folder, tmp_path / "vines")
    shutil.copytree(campaign.folder, tmp_path / "results")
    (tmp_path / "results" / "provenance.json").write_text(json.dumps({"experiment": str(tmp_path / "vines")}))
    return tmp_path / "vines", tmp_path / "results"


def test_sizes_are_tried_and_written_without_a_page(copied: tuple[Path, Path], tmp_path: Path) -> None:
    files = [tmp_path / f"curves.{form}" for form in ("csv", "svg", "png")]
    exports = [word for path in files for word in ("--export", path)]
    said = run("explore", copied[1], "--set", "reservoir_depletion.gamma=1.4", *exports)
    lines = said.splitlines()
    assert lines[0] == "base model + reservoir depletion"
    assert lines[1].split() == ["condition", "model", "in", "use", "now", "replicates"]
    assert lines[2].split() == ["mm", "mm", "mm"]
    assert lines[6].startswith("all ")
    assert all(path.stat().st_size > 1000 for path in files)
    assert read_experiment_settings(copied[0] / "experiment.yaml").model[-1] == "yield_pressure"


def test_a_refit_prints_what_it_found_and_save_writes_the_model(copied: tuple[Path, Path]) -> None:
    said = run("explore", copied[1], "--add", "reservoir_depletion", "--refit", "--save")
    assert "reservoir_depletion, fitted to 6 trials" in said
    assert "−2 ln L fell by" in said
    settings = copied[0] / "experiment.yaml"
    assert f"Saved: {settings}" in said
    assert settings.read_text(encoding="utf-8").startswith(SETTINGS)
    assert read_experiment_settings(settings).model[-1] == "reservoir_depletion"
    run("explore", copied[1], "--drop", "reservoir_depletion", "--save")
    assert read_experiment_settings(settings).model[-1] == "yield_pressure"


def test_an_impossible_request_is_refused_in_one_sentence(copied: tuple[Path, Path], tmp_path: Path) -> None:
    experiment, results = copied
    assert "is not a folder" in refused("explore", tmp_path / "nowhere")
    assert "did you mean air_drag?" in refused("explore", results, "--add", "air_drg", "--save")
    assert "is one of the base effects" in refused("explore", results, "--drop", "gravity", "--save")
    assert "is no export format" in refused("explore", results, "--export", tmp_path / "a.doc")
    experiment.rename(tmp_path / "moved")
    assert "does not exist any more: give its new path with --experiment" in refused("explore", results, "--save")
    assert "Saved" in run("explore", results, "--experiment", tmp_path / "moved", "--save")


def test_a_port_in_use_is_reported(campaign: Campaign) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"Port {port} is in use" in refused("explore", campaign.folder, "--no-browser", "--port", port)


def test_without_bokeh_the_page_says_what_to_install(campaign: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "bokeh" else found(name))
    assert "pip install 'vinetrack[explorer]'" in refused("explore", campaign.folder)


async def _origin_of_elsewhere(address: str) -> str:
    request = HTTPRequest(address.replace("http", "ws") + "ws", headers={"Origin": "http://example.org"})
    try:
        (await websocket_connect(request)).close()
    except HTTPClientError as error:
        return str(error.code)
    return "let in"


def test_the_server_is_for_this_machine_only_and_ends_with_ctrl_c(campaign: Campaign) -> None:
    with Served(campaign.folder, "--port", "0") as served:
        address = served.address
        with urllib.request.urlopen(address, timeout=60) as answer:
            page = answer.read().decode("utf-8")
        assert "vinetrack explorer" in page
        assert "cdn.bokeh.org" not in page
        port = urlsplit(address).port
        with pytest.raises(OSError, match="refused"), socket.create_connection((_own_address(), port), timeout=5):
            pass
        assert IOLoop(make_current=False).run_sync(lambda: _origin_of_elsewhere(address)) == "403"
        assert served.interrupt() == 0
    assert served.lines[-1] == "Explorer ended."
    assert not [line for line in served.lines if "Traceback" in line or "WARNING" in line]


async def _answers(address: str, host: str) -> int:
    client = AsyncHTTPClient()
    return (await client.fetch(HTTPRequest(address, headers={"Host": host}), raise_error=False)).code


async def _answers_socket(address: str, host: str) -> int:
    request = HTTPRequest(address.replace("http", "ws") + "ws", headers={"Host": host, "Origin": f"http://{host}"})
    try:
        (await websocket_connect(request)).close()
    except HTTPClientError as error:
        return error.code
    return 101


@pytest.fixture
def bare_server():
    """A server without an open page."""
    server = start_server(None, 0)
    yield server
    server.stop()


@pytest.mark.parametrize("route", ["", "autoload.js?bokeh-autoload-element=a", "static/js/bokeh.min.js", "metadata"])
@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "localhost.evil.example:{port}"])
def test_no_route_answers_under_another_name(bare_server, route: str, host: str) -> None:
    name = host.format(port=bare_server.port)
    assert bare_server.io_loop.run_sync(lambda: _answers(where(bare_server) + route, name)) == 403


def test_no_socket_answers_under_another_name(bare_server) -> None:
    name = f"evil.example:{bare_server.port}"
    assert bare_server.io_loop.run_sync(lambda: _answers_socket(where(bare_server), name)) == 403


@pytest.mark.parametrize("route", ["/", "/autoload.js?bokeh-autoload-element=a", "/ws", "/static/js/bokeh.min.js"])
def test_nothing_answers_without_the_secret_of_the_address(bare_server, route: str) -> None:
    own = f"127.0.0.1:{bare_server.port}"
    assert bare_server.io_loop.run_sync(lambda: _answers(f"http://{own}{route}", own)) == 404


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1"])
def test_the_two_names_of_this_machine_are_answered(bare_server, name: str) -> None:
    host = f"{name}:{bare_server.port}"
    route = "static/js/bokeh.min.js"
    assert bare_server.io_loop.run_sync(lambda: _answers(where(bare_server) + route, host)) == 200


def _own_address() -> str:
    """An address of this machine other than the loopback address, or else one without a listener."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return "127.0.0.2"
        return str(probe.getsockname()[0])
