"""The report, from tables written by hand: one file, every part where it belongs, no external requests."""

import base64
import io
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from chrome import Chrome, find_chrome
from hand_diagnosis import VERDICTS, candidate, diagnosis, ladder, number
from PIL import Image

from vinetrack.diagnosis.result import PROBABILITIES, Candidate, Diagnosis, EffectPower, Power
from vinetrack.figures.model_figures import draw_before_after, draw_ladder
from vinetrack.figures.registry import SECTIONS, figures_of
from vinetrack.figures.style import render
from vinetrack.inference.fit_result import FitSummary
from vinetrack.paper.rows import SIMULATED
from vinetrack.report import build
from vinetrack.report.build import write_clip

EVIL = "<script>alert('x')</script>&\"'"
SVG = '<?xml version="1.0"?>\n<!-- c --><svg width="504pt" height="360pt" viewBox="0 0 504 360" xmlns="http://www.w3.org/2000/svg"><metadata>m</metadata><defs><style type="text/css">*{a:b}</style><clipPath id="p1"><rect x="0" y="0" width="9" height="9"/></clipPath></defs><g id="g1"><path d="M 0 0 L 5 5" clip-path="url(#p1)" style="fill: #20242a; stroke: #0072b2"/></g></svg>'  # noqa: E501


CLIP = {"trial": "a", "caption": "caption", "mp4": b"film", "poster": b"frame"}


def damping(*vines: str, refused: str | None = None) -> dict:
    law = {"B": 2.0, "B_95": [1.9, 2.1], "B_95_total": [1.8, 2.2], "R2": 0.98, "n_trials": 4}
    law |= {"diameter_mm": 12.0, "thickness_um": 100.0}
    fit = {"n": 0.3712, "n_95": [0.3612, 0.3812], "n_95_total": [0.35, 0.39], "vines": dict.fromkeys(vines, law)}
    if refused:
        fit = {"n": None, "n_95": [None, None], "n_95_total": [None, None], "vines": {}}
    fit |= {"refused": refused, "left_out": {}}
    return {"log_log": fit, "both_axes": fit}


def trials(*names: str, status: str = "ok", reason: str = "") -> pd.DataFrame:
    columns = "x_ss_m_s x_ss_sigma_m_s x_ss_paper_m_s force_N final_lead_velocity_m_s efficiency"
    numbers = dict.fromkeys([*columns.split(), "steady_from_s", "steady_to_s"], 0.5)
    rows = [{"trial": n, "vine": "v", "condition": "c", "status": status, "reason": reason, **numbers} for n in names]
    return pd.DataFrame(rows)


PROVENANCE = {
    "vinetrack": "1.2.3", "python": "3.11", "platform": "Linux", "model": ["gravity"], "libraries": {"numpy": "2"},
    "inputs": {"trials.csv": "abc"}, "settings": {"damping": {"resamples": 777, "seed": 1}},
}  # fmt: skip


def page(**changes: object) -> str:
    content = dict.fromkeys(("clip", "fit", "comparison", "check", "diagnosis"))
    content |= {key: {} for key in ("pictures", "calibrations", "effects")}
    content |= {"name": "vines", "trials": trials("a"), "damping": damping("v")}
    content |= {"provenance": PROVENANCE, "figures": [], "sections": [], "notes": []}
    return build.build_report({**content, **changes})


class Tags(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br", "link", "img", "hr"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)


def test_whatever_a_user_wrote_and_whatever_stands_in_the_file_is_escaped():
    fit, unfitted = damping(EVIL), damping(EVIL, refused=EVIL)
    for one in (fit, unfitted):
        one["both_axes"] |= {"left_out": {EVIL: EVIL}}
    written = {"vinetrack": EVIL, "model": [EVIL], "settings": {EVIL: EVIL}, "inputs": {EVIL: "abc"}}
    table = build.ReportTable(EVIL, (EVIL,), [(EVIL,)])
    content = diagnosis("ambiguous", where=[EVIL], notes=[EVIL], answer_set=[EVIL], effects=[EVIL], explanation=EVIL)
    content["drift"][0]["sentence"] = content["next_experiment"]["text"] = EVIL
    content["next_experiment"]["calibration"] = content["rounds"][0]["explanation"] = EVIL
    content["rounds"][0]["ranking"][0] |= {"reason": EVIL, "effect": EVIL}
    section = {"key": "paper", "title": EVIL, "paragraphs": [EVIL], "tables": [table], "figures": []}
    figure = build.ReportFigure("f", EVIL, EVIL, SVG, EVIL, EVIL)
    given = {"name": EVIL, "damping": fit, "provenance": PROVENANCE | written, "figures": [figure]}
    given |= {"pictures": {"a": {"clip": "overlays/a.mp4"}}, "clip": CLIP | {"caption": EVIL}}
    given |= result(messages=[EVIL], warnings=[EVIL]) | {"sections": [section]}
    for html in (page(trials=trials(EVIL, reason=EVIL)), page(damping=unfitted), page(**given), shown(content)):
        assert EVIL not in html
        assert not [tag for tag, _ in Tags(html).tags if tag == "script"]
        assert "&lt;script&gt;" in html


def test_the_page_is_one_file_with_the_numbers_of_its_figures_that_asks_for_nothing_from_elsewhere():
    html = page(
        figures=[build.ReportFigure("law", "Law", "caption", SVG, "points.csv", "µ,b\n1,2\n")],
        trials=trials("a", "b", status="failed", reason="fewer than 5 points"),
    )
    tags = Tags(html)
    assert not tags.wrong
    for _, attributes in tags.tags:
        for name in ("src", "href", "xlink:href"):
            target = attributes.get(name) or ""
            assert target.startswith(("#", "data:")) or not target
    assert "@import" not in html
    assert "url(http" not in html
    (link,) = [attributes["href"] for _, attributes in tags.tags if attributes.get("download") == "points.csv"]
    head, _, data = str(link).partition(",")
    assert (base64.b64decode(data).decode() if head.endswith("base64") else unquote(data)) == "µ,b\n1,2\n"
    assert html.count('class="status status-failed"') == 2
    assert html.count("fewer than 5 points") == 2


def png() -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (300, 20), (200, 10, 10)).save(file, "PNG", dpi=(150, 150))
    return file.getvalue()


def test_an_inlined_picture_follows_the_page_and_keeps_its_proportions():
    svg = build.inline_picture(SVG, "law", 'a "law"')
    assert svg.startswith("<svg")
    for kept in ("currentColor", "var(--blue)", 'viewBox="0 0 504 360"', 'id="law-0"', "url(#law-0)"):
        assert kept in svg
    assert 'aria-label="a &quot;law&quot;"' in svg
    for gone in ("<?xml", "<!--", "<metadata", "<style", 'height="360pt"'):
        assert gone not in svg


def test_a_figure_that_is_only_a_png_is_on_the_page_as_large_as_it_was_drawn():
    html = page(figures=[build.ReportFigure("law", "Law", "caption", png())])
    images = [attributes for tag, attributes in Tags(html).tags if tag == "img"]
    assert [image["style"] for image in images] == ["--wide:192px"]  # 2 in of 96 px
    assert all(str(image["src"]).startswith("data:image/png;base64,") for image in images)


# The section on the diagnosis, for every verdict, for a refused diagnosis, and without one.
def read(content: dict) -> Diagnosis:
    return Diagnosis.from_json(content)


def heading(html: str) -> str:
    found = re.search(r"<h1>(.*?)</h1>", html, re.DOTALL)
    assert found is not None
    return re.sub(r"<[^>]+>", "", found[1]).strip()


def shown(content: dict, **changes: object) -> str:
    added = ["", *content.get("effects", [])]
    return page(diagnosis=replace(read(content), ladder=ladder(*added)), **changes)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_page_begins_with_the_verdict_and_every_link_leads_somewhere(verdict):
    html = shown(diagnosis(verdict))
    assert heading(html).startswith(f"{verdict} ")
    assert f'class="badge badge-{verdict}"' in html
    doubted = page(diagnosis=replace(read(diagnosis(verdict)), contradicted_columns=("pressure_kPa",)))
    assert '<span class="badge badge-none">check the sheet</span>' in doubted
    tags = Tags(html)
    assert (tags.wrong, tags.open) == ([], [])
    attributes = [attributes for _, attributes in tags.tags]
    ids = [one["id"] for one in attributes if one.get("id")]
    assert len(ids) == len(set(ids))
    inner = {one["href"][1:] for one in attributes if (one.get("href") or "").startswith("#")}
    assert inner <= set(ids)
    bare = {"verdict": verdict, "effects": [], "answer_set": [], "rounds": []}
    assert heading(page(diagnosis=read(bare))).startswith(verdict)


def test_next_trials_have_their_pressure_in_the_unit_of_the_sheet():
    trials = [{"replicates": 2, "pressure_kPa": 34.474, "pressure_unit": unit} for unit in ("psi", "kPa")]
    shown = build.next_experiment({"trials": trials})["trials"]
    assert (shown.head, shown.rows) == (["trials", "pressure"], [["2", "5 psi (34.5 kPa)"], ["2", "34.5 kPa"]])


# The section on the model in use, from tables written by hand.
NUMBERS = [("eversion_damping.B", "B", 6.44, 0.12, "N·(s/m)ⁿ", "v"), ("yield_pressure.P_y", "P_y", 3000.0, None, "Pa")]
FIT = {"model": ["gravity", "eversion_damping"], "refused": None, "numbers": [number(*one) for one in NUMBERS]}
FIT["spreads"] = {"B": {"value": 0.03, "estimated": True}, "pressure": {"value": 0.01, "estimated": False}}
FIT |= {"messages": ["a message"], "warnings": ["a warning"], "left_out": {"b": "its leading edge never moves"}}


def result(**changes: object) -> dict[str, object]:
    at = dict.fromkeys(("expected_m", "expected_low_m", "expected_high_m", "replicate_floor_m"), 1e-3)
    at |= {"rms_final_velocity_m_s": 0.25, "worst_at_s": 0.07, "worst_at_m": 0.123}
    compared = pd.DataFrame({"condition": ["c0", "c1"], "rms_position_m": [3e-3, 4e-3], "n_trials": [3, 1], **at})
    check = {"vine": ["v"], "n_steady": 0.37, "n_trajectory": 0.49, "B_steady": 6.44, "B_trajectory": 6.1, "z": 5.1}
    return {"fit": FitSummary.from_json({**FIT, **changes}), "comparison": compared, "check": pd.DataFrame(check)}


# The words of whole pages, stored: numbers and units, what stands where, and which file a link leads to.
def recordings(*names: str) -> dict:
    """Calibrations of recordings, and the files of their pictures."""
    board = {"kind": "charuco", "image": "calibration/board.png", "mm_per_px": 0.2407, "scale_rel_sigma": 9e-5}
    board |= {"reprojection_px": 0.031, "n_corners": 52, "n_pictures": 1}
    board |= {"notes": ["the target spans only 40 % of the picture"]}
    files = {"strip": "figures/strip_a b.svg", "motion": "figures/trial_a.png", "clip": "overlays/a.mp4"}
    return {"calibrations": dict.fromkeys(names, board), "pictures": dict.fromkeys(names, files)}


def paper() -> dict:
    """A number of the paper beside ours."""
    row = {"row": "position_rms_7kPa", "where": "Fig. 4", "quantity": "rms", "mark": SIMULATED, "published": 1.9}
    row |= {"as_printed": "1.9", "ours": 0.32, "unit": "cm", "setting": "", "how": "", "beside": ""}
    return build.paper_section(pd.DataFrame([row]).assign(ours_low_95=np.nan, ours_high_95=np.nan), [])


def power(wary: str = "") -> Power:
    sizes = tuple(1 + 0.1 * (probability - 0.9) for probability in PROBABILITIES)
    drag = EffectPower("air_drag", "physical", "air_drag.k", "k", "1", 0.0, 0.0, 3.0, sizes, {"inlet_loss": 0.26})
    leak = replace(drag, effect="leak", symbol="1/τ", unit="1/s", largest=0.5)
    return Power(24, 0.003, (leak, drag), {"static_yield": "no trace"}, wary=wary)


def words(html: str) -> str:
    """A line for each block of a page, with its anchor, and where its links lead."""
    html = re.sub(r"<(style|script|svg)\b.*?</\1>", " ", html, flags=re.DOTALL)
    html = re.sub(r'<a\b[^>]*href="(?!data:|#)([^"]+)"[^>]*>(.*?)</a>', r"\2 (→ \1)", html, flags=re.DOTALL)
    html = re.sub(r'<(\w+)\b[^>]*\bid="([^"]+)"[^>]*>', r"\n[\2] ", re.sub(r"</(?:td|th|dt|dd)>", " | ", html))
    lines = re.sub("<[^>]+>", "", re.sub(r"</?(?:p|h\d|tr|li|div|section|figure|table|summary)\b[^>]*>", "\n", html))
    return "\n".join(filter(None, (" ".join(unescape(line).split()) for line in lines.splitlines()))) + "\n"


def test_the_words_of_whole_pages_are_the_stored_ones():
    figures = [build.ReportFigure(k, k, "c", SVG, f"{k}.csv", "a\n1\n") for k in figures_of(*SECTIONS[2:-1])]
    whole = replace(read(diagnosis("missing")), ladder=ladder("", "reservoir_depletion"), power=power())
    more = {"sections": [paper()]} | recordings("a") | result()
    adequate = read(diagnosis("adequate"))
    limited = Candidate.from_json(candidate("air_drag", 1.0, largest={"k": 2500.0, "tau": np.nan}))
    (last,) = adequate.rounds
    seen = replace(adequate, power=power(), rounds=(replace(last, ranking=(*last.ranking, limited)),))
    pages = [page(diagnosis=whole, figures=figures, clip=CLIP, **more), page(diagnosis=seen)]
    pages += [page(diagnosis=replace(adequate, power=power("the model is far off")), damping=damping(refused="few"))]
    assert pages[0].count("data:image/webp;base64,ZnJhbWU=") == 2  # the frame in front of the clip that plays
    stored = Path(__file__).with_name("pages.txt")
    said = "\n----\n".join(map(words, pages))
    assert said == stored.read_text(encoding="utf-8"), f"if it is meant to be so, store it in {stored.name}"


# The page in a real browser: no errors, no requests, adapts to the colour scheme, and prints.
@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """A page with all optional parts."""
    folder = tmp_path_factory.mktemp("page")
    steps, time_s = ladder("", "reservoir_depletion"), np.arange(-10, 100) * 1e-3
    moved_m = np.maximum(time_s, 0)
    motion = pd.DataFrame({"trial": "a", "time_s": time_s, "lead_position_m": moved_m})
    motion = motion.assign(model_before_m=0.9 * moved_m, model_after_m=moved_m)
    drawn = {"ladder": draw_ladder(steps), "before_after": draw_before_after("24 kPa", motion, "")}
    pictures = {name: render(figure, ["svg"])["svg"].decode() for name, figure in drawn.items()}
    write_clip(folder / "a.mp4", [np.full((64, 96, 3), 20 * i, np.uint8) for i in range(12)], 12)
    names = [f"trial_with_a_rather_long_name_{i}" for i in range(24)]
    html = page(
        trials=trials(*names, reason="a reason that is long enough to need a line of its own on any screen"),
        figures=[build.ReportFigure(key, key, "caption", svg, f"{key}.csv", "a\n1\n") for key, svg in pictures.items()],
        pictures={name: {"strip": "figures/strip.svg", "motion": "figures/trial.svg"} for name in names},
        clip={"trial": names[0], "caption": "caption", "mp4": (folder / "a.mp4").read_bytes(), "poster": b""},
        diagnosis=replace(Diagnosis.from_json(diagnosis("ambiguous")), ladder=steps),
    )
    (folder / "report.html").write_text(html, encoding="utf-8")
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def chrome(tmp_path_factory):
    if find_chrome() is None:
        pytest.skip("there is no Chromium on this machine")
    with Chrome(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.mark.slow
def test_the_browser_logs_no_errors_makes_no_requests_and_plays_the_clip(chrome, address):
    chrome.open(address)
    assert chrome.complaints == []
    asked = {request.split(":", 1)[0] for request in chrome.requests if not request.startswith("about:")}
    assert asked <= {"file", "data"}
    assert [request for request in chrome.requests if request.startswith("file:")] == [address]
    chrome.wait("document.querySelector('video').readyState >= 1", "the clip's header")
    assert chrome.run("document.querySelector('video').videoWidth") == 96
    assert chrome.run("document.querySelector('video').duration") == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_nothing_reaches_beyond_the_screen_and_a_phones_first_shows_the_verdict(chrome, address):
    for width, height in ((1400, 900), (768, 900), (390, 844)):
        chrome.size(width, height)
        chrome.open(address)
        assert chrome.run("document.documentElement.scrollWidth") <= width
        pictures = "[...document.querySelectorAll('header .frame svg')]"
        assert chrome.run(f"{pictures}.filter(one => one.getBoundingClientRect().right > innerWidth).length") == 0
    for what in ("h1", ".facts > div"):
        assert chrome.run(f"document.querySelector('{what}').getBoundingClientRect().bottom") < 844


@pytest.mark.slow
def test_page_and_pictures_follow_a_dark_screen(chrome, address):
    ask = {
        "page": "getComputedStyle(document.body).backgroundColor",
        "text": "getComputedStyle(document.querySelector('#figure-ladder text')).fill",
        "grid": "getComputedStyle(document.querySelector('#figure-ladder [style*=\"--grid\"]')).stroke",
    }
    brightness = {}
    for scheme in ("light", "dark"):
        chrome.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        chrome.open(address)
        brightness[scheme] = {name: sum(map(int, chrome.run(script)[4:-1].split(","))) for name, script in ask.items()}
    chrome.send("Emulation.setEmulatedMedia", features=[])
    light, dark = brightness["light"], brightness["dark"]
    assert light["page"] > 700 > 300 > light["text"]
    assert dark["page"] < 120 < 600 < dark["text"]
    assert dark["page"] < dark["grid"] < dark["text"]


@pytest.mark.slow
def test_it_prints_in_dark_on_light_whatever_the_screen(chrome, address):
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    chrome.send("Emulation.setEmulatedMedia", media="print", features=features)
    chrome.open(address)
    assert chrome.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert chrome.run("getComputedStyle(document.querySelector('#figure-ladder text')).fill") == "rgb(0, 0, 0)"
    pdf = base64.b64decode(chrome.send("Page.printToPDF", preferCSSPageSize=True)["data"])
    chrome.send("Emulation.setEmulatedMedia", media="", features=[])
    assert pdf.startswith(b"%PDF")
    assert 2 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page/") <= 12
