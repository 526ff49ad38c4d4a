"""The command: refusals, and a local server that Ctrl-C ends."""

from __future__ import annotations

import importlib.util
import json
import shutil
import socket
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from served import Served
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.pages.campaign import Campaign
from vinetrack.pages.explorer_server import address as where
from vinetrack.pages.explorer_server import open_campaign, start_server


def refused(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    return done.output


def test_an_experiment_that_has_moved_is_named_by_its_option(campaign: Campaign, tmp_path: Path) -> None:
    shutil.copytree(campaign.folder, tmp_path / "results")
    (tmp_path / "results" / "provenance.json").write_text(json.dumps({"experiment": str(tmp_path / "vines")}))
    refused("explore", tmp_path / "nowhere")
    assert "--experiment" in refused("explore", tmp_path / "results")
    assert open_campaign(tmp_path / "results", campaign.experiment.folder).conditions == campaign.conditions


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
