"""Compact SVG: the same coordinates to a tenth of a point, fewer elements, text as text, smaller images."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from vinetrack.figures.style import BLUE, INK, PAPER, look, render
from vinetrack.report.section import circle_diameter, compact_svg, moved, parse_path, recoded_image, write_path


def drawn(draw) -> str:  # type: ignore[no-untyped-def]
    with look():
        fig = Figure(figsize=(4, 3))
        draw(fig.add_subplot())
    return render(fig, ["svg"])["svg"].decode()


def points_of(d: str) -> list[tuple[float, float]]:
    """End points of a path of lines, relative commands followed."""
    x = y = 0.0
    points = []
    for letter, numbers in re.findall(r"([Mlhvz])([^Mlhvz]*)", d):
        values = [float(value) for value in re.findall(r"-?(?:\d*\.\d+|\d+)", numbers)]
        if letter in "Ml":
            for dx, dy in zip(values[::2], values[1::2], strict=True):
                x, y = (dx, dy) if letter == "M" else (x + dx, y + dy)
                points.append((x, y))
        for value in values if letter in "hv" else ():
            x, y = (x + value, y) if letter == "h" else (x, y + value)
            points.append((x, y))
    return points


def test_rounding_does_not_add_up_along_a_path() -> None:
    x = np.linspace(0.5, 3.33, 500).cumsum() + 0.0371
    absolute = " ".join(f"{'M' if i == 0 else 'L'} {a:.6f} {100 + a / 7:.6f}" for i, a in enumerate(x))
    points = points_of(write_path(parse_path(absolute)))
    assert np.max(np.abs(np.array(points) - np.column_stack([x, 100 + x / 7]))) <= 0.05 + 1e-9


def test_a_step_of_no_length_is_left_out_but_a_dot_is_kept() -> None:
    assert write_path(parse_path("M 1 1 L 1.01 1.01 L 2 1")) == "M1 1h1"
    assert write_path(parse_path("M 1 1 L 2 1 L 2.01 1")) == "M1 1h1"
    assert write_path(parse_path("M 1 1 L 1 1")) == "M1 1h0"
    assert write_path(parse_path("M 1 1 L 1 1 M 5 5 L 5 5")) == "M1 1h0M5 5h0"


def test_curves_and_closed_paths_are_written_too() -> None:
    assert write_path(parse_path("M 0 0 C 1 1 2 2 3 3 Q 4 4 5 3 z")) == "M0 0c1 1 2 2 3 3q1 1 2 0z"


def test_a_command_that_is_not_known_is_refused() -> None:
    with pytest.raises(ValueError, match="not known"):
        parse_path("M 0 0 H 3")


def test_a_path_is_moved_in_both_directions() -> None:
    assert moved(parse_path("M 0 0 L 1 2"), 10, 20) == [("M", (10.0, 20.0)), ("L", (11.0, 22.0))]


def test_dots_become_one_path_of_round_ends_where_they_were() -> None:
    x = np.arange(10.0)
    body, width, height = compact_svg(drawn(lambda ax: ax.plot(x, x, ".", color=BLUE, ms=4, mew=0)), "p", {})
    (dots,) = re.findall(r'<path style="([^"]*round[^"]*)" d="([^"]*)"', body)
    assert (width, height) == (288.0, 216.0)
    assert "stroke:#0072b2" in dots[0]
    assert len(re.findall("h0", dots[1])) == 10
    first, last = re.findall(r"M([\d.]+) ([\d.]+)h0", dots[1])[0], re.findall(r"M([\d.]+) ([\d.]+)h0", dots[1])[-1]
    # Axes of the default layout, 0.125 to 0.9 of the width, with margins of 5 % beyond the data.
    left, right = (288 * (0.125 + 0.775 * part) for part in (0.05 / 1.1, 1.05 / 1.1))
    assert float(first[0]) == pytest.approx(left, abs=0.06)
    assert float(last[0]) == pytest.approx(right, abs=0.06)


def test_hollow_markers_keep_their_filling_and_their_edge() -> None:
    body, _, _ = compact_svg(drawn(lambda ax: ax.plot([1, 2], [1, 2], "o", mfc=PAPER, mec=BLUE)), "p", {})
    assert re.search(rf'style="[^"]*fill:{PAPER}[^"]*stroke:{BLUE.lower()}|fill:{PAPER}', body, re.IGNORECASE)


def test_ticks_and_grid_lines_of_an_axis_are_one_path_each() -> None:
    body, _, _ = compact_svg(drawn(lambda ax: ax.set_xticks(np.linspace(0, 1, 11))), "p", {})
    assert body.count("<path") <= 6


def test_a_picture_is_a_fraction_of_the_file_it_came_from() -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(0, 1, 400)

    def draw(ax) -> None:  # type: ignore[no-untyped-def]
        ax.plot(x, x + rng.normal(0, 0.05, x.size), ".", ms=4)

    svg = drawn(draw)
    body, _, _ = compact_svg(svg, "p", {})
    assert len(body) < len(svg) / 5
    assert body.count("<") < 60


def test_text_stays_text_in_the_pages_own_type_and_is_escaped() -> None:
    svg = drawn(lambda ax: ax.set(title="a < b & c", ylabel="F (N)"))
    body, _, _ = compact_svg(svg, "p", {INK.lower(): "currentColor"})
    assert "a &lt; b &amp; c</text>" in body
    assert re.search(r'transform="rotate\(-90[^"]*\)">F \(N\)</text>', body)
    assert "font-family" not in body
    assert "fill:currentColor" in body


def test_clips_get_the_prefix_where_they_are_defined_and_where_they_are_used() -> None:
    body, _, _ = compact_svg(drawn(lambda ax: ax.plot([0, 1])), "law", {})
    ids = set(re.findall(r'id="([^"]+)"', body))
    assert ids
    assert set(re.findall(r"url\(#([^)]+)\)", body)) == ids
    assert all(name.startswith("law-") for name in ids)


def test_images_are_recoded_and_stay_what_they_show() -> None:
    shade = np.tile(np.linspace(0, 255, 300), (200, 1)).astype(np.uint8)
    noisy = np.clip(shade + np.random.default_rng(3).normal(0, 12, shade.shape), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(noisy).convert("RGBA").save(file, "PNG")
    href = "data:image/png;base64,\n" + base64.b64encode(file.getvalue()).decode()
    small = recoded_image(href)
    assert small.startswith("data:image/webp;base64,")
    assert len(small) < len(href) / 5
    back = np.asarray(Image.open(io.BytesIO(base64.b64decode(small.split(",")[1]))).convert("L"), dtype=float)
    assert np.mean(np.abs(back - shade)) < 12


def test_a_file_that_is_not_svg_is_refused() -> None:
    with pytest.raises(ValueError, match="not an SVG"):
        compact_svg("<svg", "p", {})


def test_only_a_round_path_is_a_circle() -> None:
    square = parse_path("M -1 -1 L 1 -1 L 1 1 L -1 1 z")
    assert circle_diameter(square) is None
