"""Responses of the server, without a browser: frames, axis, track, save; and refusal of foreign requests."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page_state import sent

from vinetrack.pages.setup_server import SetupServer, start_server

OURS = {"X-Vinetrack": "setup"}


@pytest.fixture
def server(clips: Path) -> Iterator[SetupServer]:
    made = start_server(clips, 0)
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    yield made
    made.shutdown()
    made.server_close()
    thread.join(10)


def ask(
    server: SetupServer, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, bytes, str]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=120)
    data = None if body is None else json.dumps(body)
    connection.request(
        "GET" if body is None else "POST", server.secret + path, data, headers or (OURS if body is not None else {})
    )
    answer = connection.getresponse()
    made = answer.status, answer.read(), answer.getheader("Content-Type") or ""
    connection.close()
    return made


def test_the_page_its_style_and_its_scripts_are_served(server: SetupServer) -> None:
    assert b"<title>vinetrack set-up</title>" in ask(server, "/")[1]
    assert b"--ink" in ask(server, "/setup.css")[1]
    assert ask(server, "/table.js")[2].startswith("text/javascript")
    assert ask(server, "/setup_server.py")[0] == 404


def test_frames_are_pictures_and_the_axis_lies_along_the_tube(server: SetupServer) -> None:
    status, data, kind = ask(server, "/api/frame?recording=d15%2024kPa%201.mp4&frame=3")
    assert (status, kind, data[:2]) == (200, "image/jpeg", b"\xff\xd8")
    clip = json.loads(ask(server, "/api/clip?recording=d15%2024kPa%201.mp4")[1])
    (x0, y0), (x1, y1) = clip["axis"]["from_px"], clip["axis"]["to_px"]
    assert x1 - x0 > 300
    assert abs(y0 - 80) < 1.5
    assert abs(y1 - 80) < 1.5


def test_one_row_is_tracked_before_the_sheet_is_filled_in(server: SetupServer, clips: Path) -> None:
    made = json.loads(ask(server, "/api/track", sent(clips, row=0))[1])
    assert not made["timed"]
    assert not made["scaled"]
    edge = np.array([np.nan if value is None else value for value in made["edge_px"]])
    assert np.nanmax(edge) - np.nanmin(edge) == pytest.approx(360, abs=5)
    assert made["strip"].startswith("data:image/jpeg;base64,")
    assert not (clips / "trials.csv").exists()


def test_a_pressure_trace_comes_with_the_motion(server: SetupServer, clips: Path) -> None:
    (clips / "p.csv").write_text("time_s,pressure_kPa\n0,24\n0.05,22\n")
    content = sent(clips, row=0)
    content["sheet"]["columns"].append("pressure_trace")
    content["sheet"]["rows"][0]["pressure_trace"] = "p.csv"
    content["shared"] = {"capture_fps": "1000"}
    made = json.loads(ask(server, "/api/track", content)[1])
    assert made["timed"]
    assert made["pressure"] == {"time_s": [0.0, 0.05], "pressure_kPa": [24.0, 22.0]}


def test_saving_writes_two_files_and_the_next_stamp(server: SetupServer, clips: Path) -> None:
    before = {path.name for path in clips.iterdir()}
    made = json.loads(ask(server, "/api/save", sent(clips))[1])
    assert made["written"] == ["trials.csv", "experiment.yaml"]
    assert {path.name for path in clips.iterdir()} - before == {"trials.csv", "experiment.yaml"}
    assert made["stamp"] == json.loads(ask(server, "/api/state")[1])["stamp"]


def test_a_file_that_changed_meanwhile_is_not_overwritten(server: SetupServer, clips: Path) -> None:
    content = sent(clips)
    (clips / "experiment.yaml").write_text("chamber_l: 2\n")
    status, data, _ = ask(server, "/api/save", content)
    assert status == 422
    assert "has changed since" in json.loads(data)["words"]
    assert (clips / "experiment.yaml").read_text() == "chamber_l: 2\n"


@pytest.mark.parametrize("headers", [{"Host": "elsewhere.example"}, {**OURS, "Origin": "http://elsewhere.example"}])
def test_requests_from_other_pages_are_refused(server: SetupServer, clips: Path, headers: dict[str, str]) -> None:
    assert ask(server, "/api/save", sent(clips), headers)[0] == 403
    assert not (clips / "trials.csv").exists()


@pytest.mark.parametrize("path", ["/", "/setup.js", "/api/state", "/api/frame?recording=a.mp4&frame=0"])
def test_no_route_is_served_under_another_name(server: SetupServer, path: str) -> None:
    assert ask(server, path, headers={"Host": f"evil.example:{server.server_port}"})[0] == 403


def test_nothing_is_served_without_the_secret_of_the_address(server: SetupServer) -> None:
    assert len(server.secret) > 20
    assert ask(server, "/api/state")[0] == 200
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.request("GET", "/api/state")
    assert connection.getresponse().status == 403
    connection.close()


def test_a_request_without_the_header_changes_nothing(server: SetupServer, clips: Path) -> None:
    assert ask(server, "/api/save", sent(clips), {"Content-Type": "text/plain"})[0] == 403


def test_a_path_out_of_the_folder_is_refused_with_a_reason(server: SetupServer) -> None:
    status, data, _ = ask(server, "/api/thumbnail?recording=../other.mp4")
    assert status == 422
    assert "leads out of the experiment folder" in json.loads(data)["words"]
