"""The report in a real browser: no errors, no requests, adapts to the colour scheme, and prints."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hand_diagnosis import diagnosis, ladder, moved
from test_report import curves, page, trials, windows

from vinetrack.diagnosis.result import Diagnosis
from vinetrack.figures.diagnosis_figures import draw_before_after, draw_ladder
from vinetrack.figures.style import render
from vinetrack.report.build import Clip, ReportFigure, TrackedRecording
from vinetrack.video.write import write_clip

pytest.importorskip("tornado", reason="the browser is driven through bokeh's server, which is not installed")
from chrome import Chrome, find_chrome

pytestmark = pytest.mark.skipif(find_chrome() is None, reason="there is no Chromium on this machine")

WIDTHS = (1400, 768, 390)


def svg_of(figure) -> str:  # type: ignore[no-untyped-def]
    return render(figure, ["svg"])["svg"].decode()


def motion() -> pd.DataFrame:
    time_s = np.arange(-10, 100) * 1e-3
    moved_m = np.maximum(time_s, 0)
    table = pd.DataFrame({"trial": "a", "time_s": time_s, "lead_position_m": moved_m})
    return table.assign(model_before_m=0.9 * moved_m, model_after_m=moved_m)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page with all optional parts."""
    folder = tmp_path_factory.mktemp("page")
    steps = ladder("", "reservoir_depletion")
    pictures = {"ladder": svg_of(draw_ladder(steps)), "before_after": svg_of(draw_before_after("24 kPa", motion(), ""))}
    write_clip(folder / "a.mp4", [np.full((64, 96, 3), 20 * i, np.uint8) for i in range(12)], 12)
    names = [f"trial_with_a_rather_long_name_{i}" for i in range(24)]
    html = page(
        trials=trials(*names, reason="a reason that is long enough to need a line of its own on any screen"),
        windows=windows(*names),
        kinematics=curves(*names),
        figures=[ReportFigure(key, key, "caption", svg, f"{key}.csv", "a\n1\n") for key, svg in pictures.items()],
        trial_figures=dict.fromkeys(names, pictures["before_after"]),
        recordings={name: TrackedRecording(pictures["ladder"], ["", "doubtful"]) for name in names},
        clip=Clip(names[0], (folder / "a.mp4").read_bytes(), "caption"),
        diagnosis=replace(Diagnosis.from_json(diagnosis("ambiguous")), ladder=steps),
        moved=moved(),
    )
    path = folder / "report.html"
    path.write_text(html, encoding="utf-8")
    return path.as_uri()


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    with Chrome(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


def test_the_browser_logs_no_errors_and_makes_no_requests(chrome: Chrome, address: str) -> None:
    chrome.open(address)
    assert chrome.complaints == []
    asked = {request.split(":", 1)[0] for request in chrome.requests if not request.startswith("about:")}
    assert asked <= {"file", "data"}
    assert [request for request in chrome.requests if request.startswith("file:")] == [address]


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_reaches_beyond_the_screen(chrome: Chrome, address: str, width: int) -> None:
    chrome.size(width, 900)
    chrome.open(address)
    assert chrome.run("document.documentElement.scrollWidth") <= width
    pictures = "[...document.querySelectorAll('header .frame svg')]"
    assert chrome.run(f"{pictures}.filter(one => one.getBoundingClientRect().right > innerWidth).length") == 0


def test_the_verdict_and_how_sure_are_on_a_phones_first_screen(chrome: Chrome, address: str) -> None:
    chrome.size(390, 844)
    chrome.open(address)
    for what in ("h1", ".facts > div"):
        assert chrome.run(f"document.querySelector('{what}').getBoundingClientRect().bottom") < 844


def test_page_and_pictures_follow_a_dark_screen(chrome: Chrome, address: str) -> None:
    colours = {}
    for scheme in ("light", "dark"):
        chrome.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        chrome.open(address)
        of = {"page": "getComputedStyle(document.body).backgroundColor"}
        of["text"] = "getComputedStyle(document.querySelector('#figure-ladder text')).fill"
        of["grid"] = "getComputedStyle(document.querySelector('#figure-ladder path[style*=\"--grid\"]')).stroke"
        colours[scheme] = {name: chrome.run(script) for name, script in of.items()}
    chrome.send("Emulation.setEmulatedMedia", features=[])
    brightness = {
        scheme: {name: sum(map(int, colour[4:-1].split(","))) for name, colour in found.items()}
        for scheme, found in colours.items()
    }
    assert brightness["light"]["page"] > 700 > 300 > brightness["light"]["text"]
    assert brightness["dark"]["page"] < 120 < 600 < brightness["dark"]["text"]
    assert brightness["dark"]["page"] < brightness["dark"]["grid"] < brightness["dark"]["text"]


def test_the_clip_can_be_played(chrome: Chrome, address: str) -> None:
    chrome.open(address)
    chrome.wait("document.querySelector('video').readyState >= 1", "the clip's header")
    assert chrome.run("document.querySelector('video').videoWidth") == 96
    assert chrome.run("document.querySelector('video').duration") == pytest.approx(1.0, abs=0.05)


def test_it_prints_in_dark_on_light_whatever_the_screen(chrome: Chrome, address: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    chrome.send("Emulation.setEmulatedMedia", media="print", features=features)
    chrome.open(address)
    assert chrome.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert chrome.run("getComputedStyle(document.querySelector('#figure-ladder text')).fill") == "rgb(0, 0, 0)"
    pdf = base64.b64decode(chrome.send("Page.printToPDF", preferCSSPageSize=True)["data"])
    chrome.send("Emulation.setEmulatedMedia", media="", features=[])
    assert pdf.startswith(b"%PDF")
    assert 2 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page/") <= 12
