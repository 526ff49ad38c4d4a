"""Building blocks of the page: figures with their data, tables, and sections of both."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from vinetrack.figures.style import TOKENS

# ------------------------------------------------------------------------------
# Compact matplotlib's SVG for a page: a tenth of the size, with the same appearance, and text as text.
#
# Three things make such files large and slow: an element for every marker, tick and grid line; coordinates to a
# millionth
# of a point; and images as PNG. Here neighbouring paths of equal style are merged, round markers become the round caps
# of
# lines of zero length, coordinates are relative and rounded, and images are WebP.

Command = tuple[str, tuple[float, ...]]  # A command of a path and its numbers

_THEME_COLOURS = {colour: "currentColor" if token == "--ink" else f"var({token})" for colour, token in TOKENS.items()}

_WEBP_QUALITY = 45  # WebP quality, 0 to 100

_MAX_MARKER_COMMANDS = 8  # Commands up to which a filled shape counts as a marker, which may be merged

_MAX_PATH_COMMANDS = 20_000  # Commands of a merged path

_COUNTS = {"M": 2, "L": 2, "Q": 4, "C": 6, "Z": 0}
_TOKEN = re.compile(r"[MLHVCQZz]|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_NUMBERS = re.compile(r"[-\d.eE+]+|[a-z]+\([-\d.eE+ ,]+\)( [a-z]+\([-\d.eE+ ,]+\))*")
_KEPT = {
    "g": ("clip-path", "transform", "opacity"),
    "path": ("clip-path",),
    "text": ("x", "y", "transform"),
    "image": ("x", "y", "width", "height", "transform", "clip-path"),
}


@dataclass
class _Element:
    """One element of the compact picture; `commands` are the `d` of a path."""

    tag: str
    style: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)
    children: list[_Element] = field(default_factory=list)
    text: str = ""


def inline_svg(svg: str, prefix: str, description: str) -> str:
    """Return an SVG file as an element for inline use in a page. Neutral colours become those of the page, so that it
    follows a dark scheme. The style sheet of the page sets the size by `--wide`, at which text in the picture is as
    large as that of the page.
    """
    body, width_pt, height_pt = compact_svg(svg, prefix, _THEME_COLOURS)
    label, box = escape(description, quote=True), f"0 0 {width_pt:g} {height_pt:g}"
    return f'<svg viewBox="{box}" role="img" aria-label="{label}" style="--wide:{1.33 * width_pt:.0f}px">{body}</svg>'


def compact_svg(svg: str, prefix: str, colours: Mapping[str, str]) -> tuple[str, float, float]:
    """Return the content of the root element, and the picture's width and height, pt. Returns body, width, height."""
    try:
        root = ElementTree.fromstring(svg)
    except ElementTree.ParseError as error:
        raise ValueError(f"not an SVG file: {error}") from error
    left, top, width, height = (float(part) for part in root.attrib["viewBox"].split())
    if (left, top) != (0.0, 0.0):
        raise ValueError("the view box of the picture does not begin at 0, 0")
    markers = {node.attrib["id"]: node for node in root.iter() if _tag(node) == "path" and "id" in node.attrib}
    elements = _merged([element for node in root for element in _converted(node, markers)])
    used = set(re.findall(r"#([\w.-]+)", " ".join(_clips(elements))))
    return "".join(_written(element, prefix, used, colours) for element in elements), width, height


def _tag(node: ElementTree.Element) -> str:
    return node.tag.rsplit("}", 1)[-1]


def _attributes(node: ElementTree.Element) -> dict[str, str]:
    return {key.rsplit("}", 1)[-1]: value for key, value in node.attrib.items()}


def _style(node: ElementTree.Element) -> dict[str, str]:
    pairs = (part.split(":", 1) for part in node.attrib.get("style", "").split(";") if ":" in part)
    return {key.strip(): value.strip() for key, value in pairs if key.strip() != "font-family"}


def _converted(node: ElementTree.Element, markers: Mapping[str, ElementTree.Element]) -> list[_Element]:
    """Convert one node of the file: to nothing, to an element, or to its children if it only groups them."""
    tag, style, attributes = _tag(node), _style(node), _attributes(node)
    kept = {key: _rounded(attributes[key]) for key in _KEPT.get(tag, ()) if key in attributes}
    if tag in ("metadata", "style", "title"):
        return []
    if tag == "defs":
        clips = [_copied(child) for child in node if _tag(child) not in ("path", "style")]
        return [_Element("defs", children=clips)] if clips else []
    if tag == "g":
        inside = [element for child in node for element in _converted(child, markers)]
        children = _merged(inside, axis="axis" in attributes.get("id", ""))
        return [_Element("g", style, kept, children=children)] * bool(children) if kept or style else children
    if tag == "path":
        invisible = style.get("fill") == "none" and style.get("stroke", "none") == "none"
        commands = [] if invisible else parse_path(attributes.get("d", ""))
        return [_Element("path", style, kept, commands)] * bool(commands)
    if tag == "use":
        return [_marker(markers[attributes["href"].lstrip("#")], style, attributes)]
    if tag == "image":
        return [
            _Element("image", {}, kept | {"href": recoded_image(attributes["href"]), "preserveAspectRatio": "none"})
        ]
    if tag == "text":
        kept = {key: value for key, value in kept.items() if not re.fullmatch(r"rotate\(-?0 .*\)", value)}
        style = {key: value for key, value in style.items() if (key, value) != ("text-anchor", "start")}
        return [_Element("text", style, kept, children=[_copied(child) for child in node], text=node.text or "")]
    return [_copied(node)]


def _copied(node: ElementTree.Element) -> _Element:
    """A copy of a node with its numbers rounded."""
    attributes = {key: _rounded(value) for key, value in _attributes(node).items() if key != "style"}
    commands = parse_path(attributes.pop("d")) if _tag(node) == "path" else []
    children = [_copied(child) for child in node]
    return _Element(_tag(node), _style(node), attributes, commands, children, (node.text or "").strip())


def _rounded(value: str) -> str:
    """A number, or the numbers of a transform, to two decimals; names are unchanged."""
    if not _NUMBERS.fullmatch(value):
        return value
    # A matrix or scale multiplies hundreds of pixels: an error of 0.005 over 300 px would be 1.5 px.
    decimals = 5 if "matrix" in value or "scale" in value else 2
    return re.sub(r"[-+]?\d+\.\d+(?:[eE][-+]?\d+)?", lambda match: _short(float(match[0]), decimals), value)


def _short(value: float, decimals: int = 2) -> str:
    return f"{value:.{decimals}f}".rstrip("0").rstrip(".")


def _marker(shape: ElementTree.Element, style: dict[str, str], place: Mapping[str, str]) -> _Element:
    """One marker as a path; a round one without an edge as the round cap of a line of zero length."""
    commands, style = parse_path(shape.attrib.get("d", "")), {**_style(shape), **style}
    x, y = float(place.get("x", 0)), float(place.get("y", 0))
    diameter, fill, edge = circle_diameter(commands), style.get("fill", "#000000"), style.get("stroke", "none")
    if diameter is None or fill == "none" or edge not in ("none", fill):
        return _Element("path", style, commands=moved(commands, x, y))
    width = diameter + (float(style.get("stroke-width", 1)) if edge != "none" else 0.0)
    dot = {"fill": "none", "stroke": fill, "stroke-width": f"{width:.2f}", "stroke-linecap": "round"}
    dot |= {key: value for key, value in style.items() if key == "opacity"}
    dot |= {"stroke-opacity": style["fill-opacity"]} if "fill-opacity" in style else {}
    return _Element("path", dot, commands=[("M", (x, y)), ("L", (x, y))])


def recoded_image(href: str) -> str:
    """Return a PNG in a data URI as WebP; unchanged if that is not smaller, or if it is not a PNG."""
    from PIL import Image

    head, _, data = href.partition("base64,")
    if not head.startswith("data:image/png"):
        return href
    raw = base64.b64decode("".join(data.split()))
    picture = Image.open(io.BytesIO(raw))
    alpha = picture.mode == "RGBA" and picture.getchannel("A").getextrema() != (255, 255)
    file = io.BytesIO()
    picture.convert("RGBA" if alpha else "RGB").save(file, "WEBP", quality=_WEBP_QUALITY, method=4)
    kind, small = ("webp", file.getvalue()) if file.tell() < len(raw) else ("png", raw)
    return f"data:image/{kind};base64,{base64.b64encode(small).decode('ascii')}"


def _merged(elements: Sequence[_Element], axis: bool = False) -> list[_Element]:
    """Merge neighbouring paths of equal style; in an axis, where nothing overlaps, all paths of equal style."""
    merged: list[_Element] = []
    for element in sorted(elements, key=lambda element: element.tag == "text") if axis else elements:
        candidates = merged if axis else merged[-1:]
        same = next((earlier for earlier in candidates if _mergeable(earlier, element)), None)
        if same is None:
            merged.append(element)
        else:
            same.commands = same.commands + element.commands
    return merged


def _mergeable(first: _Element, second: _Element) -> bool:
    return (
        first.tag == second.tag == "path"
        and first.style == second.style
        and first.attributes == second.attributes
        and len(first.commands) + len(second.commands) < _MAX_PATH_COMMANDS
        and (first.style.get("fill") == "none" or len(second.commands) <= _MAX_MARKER_COMMANDS)
    )


def _clips(elements: Iterable[_Element]) -> Iterable[str]:
    for element in elements:
        yield element.attributes.get("clip-path", "")
        yield from _clips(element.children)


def _written(element: _Element, prefix: str, used: set[str], colours: Mapping[str, str]) -> str:
    attributes = dict(element.attributes)
    name = attributes.pop("id", "")
    inside = "".join(_written(child, prefix, used, colours) for child in element.children)
    if (element.tag == "clipPath" and name not in used) or (element.tag == "defs" and not inside):
        return ""
    pairs = {"id": f"{prefix}-{name}"} if name in used else {}
    pairs |= {"style": _short_style(element.style, colours)} if element.style else {}
    pairs |= {"d": write_path(element.commands)} if element.commands else {}
    pairs |= {key: value.replace("url(#", f"url(#{prefix}-") for key, value in attributes.items()}
    head = " ".join([element.tag, *(f'{key}="{escape(value, quote=True)}"' for key, value in pairs.items())])
    inside = escape(element.text, quote=False) + inside
    return f"<{head}>{inside}</{element.tag}>" if inside else f"<{head}/>"


def _short_style(style: Mapping[str, str], colours: Mapping[str, str]) -> str:
    values = {key: colours.get(value.lower(), value) for key, value in style.items()}
    short = re.compile(r"\d*\.\d+(?=(px)?$)")
    return ";".join(f"{key}:{short.sub(lambda m: _short(float(m[0])), value)}" for key, value in values.items())


def parse_path(d: str) -> list[Command]:
    """Return the commands of a path in absolute coordinates, as matplotlib writes them: M, L, Q, C and Z."""
    commands: list[Command] = []
    letter, numbers = "", [0.0][:0]
    for token in _TOKEN.findall(d):
        if token.isalpha():
            letter = token.upper()
            commands += [("Z", ())] if letter == "Z" else []
            continue
        numbers.append(float(token))
        if letter not in _COUNTS:
            raise ValueError(f"the path command {letter!r} is not known here")
        if len(numbers) == _COUNTS[letter]:
            commands.append((letter, tuple(numbers)))
            letter, numbers = "L" if letter == "M" else letter, []
    return commands


def moved(commands: Sequence[Command], x: float, y: float) -> list[Command]:
    """Return the commands with every point moved by (x, y), pt."""
    return [(letter, tuple(v + (x, y)[i % 2] for i, v in enumerate(numbers))) for letter, numbers in commands]


def write_path(commands: Sequence[Command]) -> str:
    """Return the `d` of a path: relative steps on a grid of 0.1 pt (0.13 pixels of a screen, 35 µm on paper). Every
    step begins at the rounded end of the previous one, so that rounding errors do not accumulate. Steps of zero length
    are left out, except those that make a dot.
    """
    parts: list[str] = []
    here, start, last = (0, 0), (0, 0), ""
    for (letter, numbers), (following, _) in zip(commands, (*commands[1:], ("", ())), strict=True):
        if letter == "Z":
            parts.append("z")
            here, last = start, "z"
            continue
        grid = [round(10 * value) for value in numbers]
        there = (grid[-2], grid[-1])
        if letter == "L" and there == here and not (last == "M" and following != "L"):
            continue
        if letter == "M":
            name, steps, start = "M", grid, there
        else:
            name, steps = letter.lower(), [value - here[i % 2] for i, value in enumerate(grid)]
        if name == "l" and 0 in steps:
            name, steps = ("h", steps[:1]) if steps[1] == 0 else ("v", steps[1:])
        text = " ".join(f"{step / 10:g}" for step in steps).replace(" -", "-")
        repeated = name == last != "M"
        parts.append(text if repeated and text.startswith("-") else (" " if repeated else name) + text)
        here, last = there, name
    return re.sub(r"(?<!\d)0\.", ".", "".join(parts))


def circle_diameter(commands: Sequence[Command]) -> float | None:
    """Return the diameter of a circle about the origin as matplotlib draws its round markers, pt; None for others."""
    ends = [numbers[-2:] for letter, numbers in commands if letter == "C"]
    if len(ends) != 8 or any(letter not in "MCZ" for letter, _ in commands):
        return None
    radii = [(x * x + y * y) ** 0.5 for x, y in ends]
    return 2 * max(radii) if max(radii) - min(radii) < 0.02 * max(radii) else None


_UNESCAPED = ",;:!*'()/ -._~+@=$?"  # Characters that need no escaping in a quoted URL


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report: its SVG, its caption, and its data as a file to download."""

    key: str
    title: str
    caption: str
    svg: str
    data_name: str = ""
    data: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table of the report, as text in rows; `numbers` are the right-aligned columns."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class ReportSection:
    """A part of the page under one heading: paragraphs, then tables, then figures."""

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def figure_entry(figure: ReportFigure) -> dict[str, Any]:
    """Return a figure for the template."""
    from markupsafe import Markup

    return {
        "key": figure.key,
        "title": figure.title,
        "caption": figure.caption,
        "svg": Markup(inline_svg(figure.svg, figure.key, figure.title)),
        "data_name": figure.data_name,
        "data_uri": data_uri(figure.data_name, figure.data) if figure.data else "",
    }


def section_entry(section: ReportSection, largest_svg_bytes: int) -> dict[str, Any]:
    """Return a section for the template, without figures that are too large for a page."""
    return {
        "key": section.key,
        "title": section.title,
        "paragraphs": list(section.paragraphs),
        "tables": list(section.tables),
        "figures": [figure_entry(figure) for figure in section.figures if len(figure.svg) <= largest_svg_bytes],
    }


def data_uri(name: str, text: str) -> str:
    """Return a file as a data URI, in the shorter of two encodings."""
    kind = "application/json" if name.endswith(".json") else "text/csv"
    escaped = quote(text, safe=_UNESCAPED)
    encoded = "base64," + base64.b64encode(text.encode("utf-8")).decode("ascii")
    head = f"data:{kind};charset=utf-8"
    return f"{head};{encoded}" if len(encoded) <= len(escaped) else f"{head},{escaped}"
