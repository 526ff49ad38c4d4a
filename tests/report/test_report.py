"""The report, from tables written by hand: its first screen, a single file, and no external requests."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

from vinetrack.report.build import (
    MAX_DATA_ROWS,
    ReportContent,
    ReportFigure,
    ReportSection,
    ReportTable,
    build_report,
    speed_sparkline,
)
from vinetrack.report.section import data_uri, inline_picture

EVIL = "<script>alert('x')</script>&\"'"
SVG = '<?xml version="1.0"?>\n<!-- c --><svg width="504pt" height="360pt" viewBox="0 0 504 360" xmlns="http://www.w3.org/2000/svg"><metadata>m</metadata><defs><style type="text/css">*{a:b}</style><clipPath id="p1"><rect x="0" y="0" width="9" height="9"/></clipPath></defs><g id="g1"><path d="M 0 0 L 5 5" clip-path="url(#p1)" style="fill: #20242a; stroke: #0072b2"/></g></svg>'  # noqa: E501


def law(n_trials: int = 4, B: float = 2.0) -> dict:
    size = {"diameter_mm": 12.0, "thickness_um": 100.0}
    return {"B": B, "B_95": [1.9, 2.1], "B_95_total": [1.8, 2.2], "R2": 0.98, "n_trials": n_trials, **size}


def damping(*vines: str, refused: str | None = None) -> dict:
    fit = {
        "n": None if refused else 0.3712,
        "n_95": [None, None] if refused else [0.3612, 0.3812],
        "n_95_total": [None, None] if refused else [0.35, 0.39],
        "vines": {} if refused else {vine: law() for vine in vines},
        "refused": refused,
        "left_out": {},
    }
    return {"log_log": fit, "both_axes": fit}


def trials(*names: str, status: str = "ok", reason: str = "") -> pd.DataFrame:
    columns = "x_ss_m_s x_ss_sigma_m_s x_ss_paper_m_s force_N final_lead_velocity_m_s efficiency"
    numbers = dict.fromkeys([*columns.split(), "steady_from_s", "steady_to_s"], 0.5)
    rows = [{"trial": n, "vine": "v", "condition": "c", "status": status, "reason": reason, **numbers} for n in names]
    return pd.DataFrame(rows)


def windows(*names: str) -> pd.DataFrame:
    row = {"rule": "gated", "accepted": True, "from_s": 0.1, "to_s": 0.2, "points": 50.0, "x_ss_m_s": 2.0}
    row |= {"x_ss_sigma_m_s": 0.1, "drift": 0.01, "cv": 0.02, "reason": "steady enough"}
    return pd.DataFrame([{"trial": name, **row} for name in names], columns=["trial", *row])


def curves(*names: str, n: int = 300) -> dict[str, pd.DataFrame]:
    time_s = np.linspace(0, 0.3, n)
    return {name: pd.DataFrame({"time_s": time_s, "lead_velocity_m_s": 1 - np.exp(-time_s / 0.02)}) for name in names}


def page(**changes: object) -> str:
    content = {
        "name": "vines",
        "trials": trials("a"),
        "windows": windows("a"),
        "damping": damping("v"),
        "provenance": {
            "vinetrack": "1.2.3",
            "python": "3.11",
            "platform": "Linux",
            "model": ["gravity"],
            "libraries": {"numpy": "2"},
            "inputs": {"trials.csv": "abc"},
            "settings": {"damping": {"resamples": 777, "seed": 1}},
        },
        "kinematics": curves("a"),
    }
    return build_report(ReportContent(**{**content, **changes}))  # type: ignore[arg-type]


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


def downloaded(href: str | None) -> str:
    """The file in a data URI."""
    head, _, data = (href or "").partition(",")
    assert head.startswith("data:")
    return base64.b64decode(data).decode() if head.endswith("base64") else unquote(data)


def test_every_trial_stands_with_status_and_reason() -> None:
    html = page(trials=trials("a", "b", status="failed", reason="fewer than 5 points"), windows=windows())
    # Each in the table of numbers, and in the list that opens.
    assert html.count('class="status status-failed"') == 4
    assert html.count("fewer than 5 points") == 2


def test_settings_provenance_and_methods_are_on_the_page() -> None:
    html = page()
    for said in ("damping.resamples", "777 resamplings", "vinetrack", "1.2.3", "numpy 2", "abc", "Savitzky"):
        assert said in html


@pytest.mark.parametrize("place", ["name", "trial", "reason", "vine", "refused", "left_out", "rule", "input", "figure"])
def test_whatever_a_user_wrote_is_escaped(place: str) -> None:
    fit = damping(EVIL if place == "vine" else "v", refused=EVIL if place == "refused" else None)
    if place == "left_out":
        fit["both_axes"] = {**fit["both_axes"], "left_out": {EVIL: EVIL}}
    table = trials(EVIL if place == "trial" else "a", reason=EVIL if place == "reason" else "")
    rules = windows("a").assign(rule=EVIL, reason=EVIL) if place == "rule" else windows("a")
    provenance = {
        "vinetrack": EVIL,
        "python": "",
        "platform": "",
        "model": [EVIL],
        "libraries": {},
        "settings": {EVIL: EVIL},
    }
    provenance["inputs"] = {EVIL if place == "input" else "trials.csv": "abc"}
    figures = [ReportFigure("f", EVIL, EVIL, SVG, EVIL, EVIL)] if place == "figure" else []
    html = page(
        name=EVIL if place == "name" else "vines",
        damping=fit,
        trials=table,
        windows=rules,
        provenance=provenance,
        figures=figures,
    )
    assert "<script" not in html
    assert not [tag for tag, _ in Tags(html).tags if tag == "script"]


def test_the_page_is_one_file_that_asks_for_nothing_from_elsewhere() -> None:
    html = page(figures=[ReportFigure("law", "Law", "caption", SVG, "p.csv", "a,b\n1,2\n")])
    for _, attributes in Tags(html).tags:
        for name in ("src", "href", "xlink:href"):
            target = attributes.get(name) or ""
            assert target.startswith(("#", "data:")) or not target
    assert "@import" not in html
    assert "url(http" not in html


def test_tags_are_closed_in_order() -> None:
    html = page(
        trials=trials("a", "b"),
        windows=windows("a"),
        figures=[ReportFigure("law", "Law", "caption", SVG)],
        trial_figures={"b": SVG},
    )
    tags = Tags(html)
    assert tags.wrong == []
    assert tags.open == []


def test_identifiers_are_unique_though_pictures_share_them() -> None:
    figures = [ReportFigure(key, "t", "c", SVG) for key in ("one", "two")]
    ids = [attributes["id"] for _, attributes in Tags(page(figures=figures)).tags if attributes.get("id")]
    assert len(ids) == len(set(ids))


def test_the_numbers_of_a_figure_are_one_click_away() -> None:
    html = page(figures=[ReportFigure("law", "Law", "c", SVG, "points.csv", "µ,b\n1,2\n")])
    link = next(a for tag, a in Tags(html).tags if tag == "a" and a.get("download") == "points.csv")
    assert downloaded(link["href"]) == "µ,b\n1,2\n"


def test_a_large_table_is_written_the_shorter_way() -> None:
    numbers = "time_s,force_N\n" + "0.001,2.5\n" * 500
    assert data_uri("a.csv", numbers).startswith("data:text/csv;charset=utf-8,")
    assert downloaded(data_uri("a.csv", numbers)) == numbers
    words = '{"name": "µ–⁷"}' * 99
    assert ";base64," in data_uri("a.json", words)
    assert downloaded(data_uri("a.json", words)) == words


def test_the_motion_of_a_trial_is_one_click_away_thinned_to_what_is_shown() -> None:
    html = page(trials=trials("a"), kinematics=curves("a", n=3000))
    link = next(a for tag, a in Tags(html).tags if tag == "a" and a.get("download") == "a.csv")
    lines = downloaded(link["href"]).splitlines()
    assert lines[0] == "time_s,lead_velocity_m_s"
    assert 100 < len(lines) <= 1 + MAX_DATA_ROWS


def test_a_further_section_comes_before_the_trials() -> None:
    table = ReportTable("Numbers", ("what", "value"), [("n", "0.37"), (EVIL, "1")], frozenset({1}), "by hand")
    figure = ReportFigure("own", "Own", "caption", SVG, "o.csv", "a\n1\n")
    html = page(sections=[ReportSection("paper", "The paper", [EVIL], [table], [figure])])
    assert html.index('<h2 id="paper">The paper</h2>') < html.index('<h2 id="trials">')
    assert '<td class="number">0.37</td>' in html
    assert 'href="#paper"' in html
    assert 'id="figure-own"' in html
    assert EVIL not in html
    assert not Tags(html).wrong


def test_an_inlined_picture_follows_the_page_and_keeps_its_proportions() -> None:
    svg = inline_picture(SVG, "law", 'a "law"')
    assert svg.startswith("<svg")
    assert "currentColor" in svg
    assert "var(--blue)" in svg
    assert 'viewBox="0 0 504 360"' in svg
    assert 'id="law-p1"' in svg
    assert "url(#law-p1)" in svg
    assert 'aria-label="a &quot;law&quot;"' in svg
    for gone in ("<?xml", "<!--", "<metadata", "<style", 'height="360pt"'):
        assert gone not in svg


def test_a_sparkline_marks_the_steady_window() -> None:
    time_s = np.linspace(0, 1, 50)
    svg = speed_sparkline(time_s, np.ones(50), (0.5, 1.0))
    steady = re.search(r'class="steady" points="([^"]+)"', svg)
    assert steady is not None
    x = [float(pair.split(",")[0]) for pair in steady[1].split()]
    # Half of the 130 px between the margins.
    assert min(x) == pytest.approx(1 + 130 / 2, abs=3)
    assert max(x) == pytest.approx(131, abs=0.1)


@pytest.mark.parametrize("speed", [np.full(50, np.nan), np.array([1.0])])
def test_a_sparkline_without_data_is_blank(speed: np.ndarray) -> None:
    assert speed_sparkline(np.linspace(0, 1, speed.size), speed, (np.nan, np.nan)) == ""


def test_500_trials_stay_below_two_megabytes() -> None:
    names = [f"trial_{i}" for i in range(500)]
    html = page(trials=trials(*names), windows=windows(*names), kinematics=curves(*names))
    assert html.count('class="spark"') == 500
    assert len(html.encode()) < 2e6


def png(width_px: int = 300, shade: tuple[int, ...] = (200, 10, 10)) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (width_px, 20), shade).save(file, "PNG", dpi=(150, 150))
    return file.getvalue()


def test_a_figure_that_is_only_a_png_is_on_the_page_as_large_as_it_was_drawn() -> None:
    html = page(figures=[ReportFigure("law", "Law", "caption", png())], trial_figures={"a": png()})
    images = [attributes for tag, attributes in Tags(html).tags if tag == "img"]
    assert [image["style"] for image in images] == ["--wide:192px"] * 2  # 2 in of 96 px
    assert all(str(image["src"]).startswith("data:image/webp;base64,") for image in images)


def test_coordinates_are_shortened_and_images_keep_the_decimals_that_place_them() -> None:
    data = base64.b64encode(png()).decode()
    placed = f'<image xlink:href="data:image/png;base64,{data}" transform="matrix(0.123456 0 0 1 0 0)"/></svg>'
    svg = inline_picture(SVG.replace("M 0 0 L 5 5", "M 0.123456 0 L 5 5").replace("</svg>", placed), "s", "s")
    assert "M 0.12 0 L 5 5" in svg
    assert "matrix(0.123456 0" in svg
    assert "data:image/webp" in svg
    assert data not in svg
