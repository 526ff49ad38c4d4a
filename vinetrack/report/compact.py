"""Matplotlib's SVG made small and fit for a page: a tenth of its weight, the same picture, and its text is text.

Three things make such files heavy and slow to open: an element for every marker, every tick and every grid line;
coordinates to a millionth of a point; and pictures as PNG. Here equal neighbours become one path, round markers become
the round ends of lines without length, coordinates are rounded, and pictures are WebP.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from xml.etree import ElementTree

from vinetrack.report.svg_path import Command, circle_diameter, moved, parse_path, write_path

PICTURE_QUALITY = 45
"""Of WebP: strips are noise with one edge in it, and the edge survives what the noise does not."""

Style = Mapping[str, str]

_SHORT_MARKER = 8
"""Filled shapes of so few commands are markers: as one path they look as they did apart."""
_FONT_KEYS = ("font-family",)


@dataclass
class Element:
    """One element of the compact picture; `commands` stands for the `d` of a path."""

    tag: str
    style: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)
    children: list[Element] = field(default_factory=list)
    text: str = ""


@dataclass(frozen=True)
class _Marker:
    commands: list[Command]
    style: dict[str, str]


def compact_svg(svg: str, prefix: str, colours: Mapping[str, str]) -> tuple[str, float, float]:
    """Return what stands inside the root element, and the picture's width and height, pt.

    Parameters
    ----------
    svg : a file as matplotlib writes it.
    prefix : put before every identifier, since several pictures share one page.
    colours : what to write in place of a colour, by its hexadecimal code in lower case.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    try:
        root = ElementTree.fromstring(svg)
    except ElementTree.ParseError as error:
        raise ValueError(f"not an SVG file: {error}") from error
    left, top, width, height = (float(part) for part in root.attrib["viewBox"].split())
    if (left, top) != (0.0, 0.0):
        raise ValueError("the view box of the picture does not begin at 0, 0")
    markers = {
        node.attrib["id"]: _Marker(parse_path(node.attrib.get("d", "")), _style(node))
        for defs in root.iter()
        if _tag(defs) == "defs"
        for node in defs
        if _tag(node) == "path" and "id" in node.attrib
    }
    elements = _merged([made for node in root for made in _made(node, markers)])
    used = set(re.findall(r"#([\w.-]+)", " ".join(_references(elements))))
    return "".join(_written(one, prefix, used, colours) for one in elements), width, height


def _tag(node: ElementTree.Element) -> str:
    return node.tag.rsplit("}", 1)[-1]


def _style(node: ElementTree.Element) -> dict[str, str]:
    pairs = (part.split(":", 1) for part in node.attrib.get("style", "").split(";") if ":" in part)
    return {key.strip(): value.strip() for key, value in pairs if key.strip() not in _FONT_KEYS}


def _href(node: ElementTree.Element) -> str:
    return next((value for key, value in node.attrib.items() if key.rsplit("}", 1)[-1] == "href"), "")


def _made(node: ElementTree.Element, markers: Mapping[str, _Marker]) -> list[Element]:
    """What one node of the file becomes: nothing, itself, or its children where it is a mere bracket."""
    tag = _tag(node)
    if tag in ("metadata", "style", "title"):
        return []
    if tag == "defs":
        clips = [_plain(child) for child in node if _tag(child) != "path" and _tag(child) != "style"]
        return [Element("defs", children=clips)] if clips else []
    if tag == "g":
        children = _merged([made for child in node for made in _made(child, markers)], axis="axis" in _identity(node))
        kept = {key: value for key, value in node.attrib.items() if key in ("clip-path", "transform", "opacity")}
        style = _style(node)
        return children if not kept and not style else [Element("g", style, kept, children=children)] * bool(children)
    if tag == "path":
        return _path(node)
    if tag == "use":
        return _marked(node, markers)
    if tag == "image":
        return [_image(node)]
    return [_text(node) if tag == "text" else _plain(node)]


def _identity(node: ElementTree.Element) -> str:
    return node.attrib.get("id", "")


def _plain(node: ElementTree.Element) -> Element:
    """A node as it is, rounded."""
    attributes = {key.rsplit("}", 1)[-1]: _rounded(value) for key, value in node.attrib.items() if key != "style"}
    commands = parse_path(attributes.pop("d")) if _tag(node) == "path" else []
    return Element(
        _tag(node), _style(node), attributes, commands, [_plain(child) for child in node], (node.text or "").strip()
    )


def _rounded(value: str) -> str:
    """A number, or the numbers in a transform, to two decimals, of a matrix to five; names are left alone."""
    if not re.fullmatch(r"[-\d.eE+]+|[a-z]+\([-\d.eE+ ,]+\)( [a-z]+\([-\d.eE+ ,]+\))*", value):
        return value
    # A matrix stretches hundreds of pixels: two decimals would be off by some of them.
    decimals = 5 if "matrix" in value or "scale" in value else 2
    return re.sub(r"[-+]?\d+\.\d+(?:[eE][-+]?\d+)?", lambda match: _shorter(float(match[0]), decimals), value)


def _shorter(value: float, decimals: int = 2) -> str:
    return f"{value:.{decimals}f}".rstrip("0").rstrip(".")


def _path(node: ElementTree.Element) -> list[Element]:
    style = _style(node)
    invisible = style.get("fill") == "none" and style.get("stroke", "none") == "none"
    if invisible or not node.attrib.get("d", "").strip():
        return []
    clip = {key: node.attrib[key] for key in ("clip-path",) if key in node.attrib}
    return [Element("path", style, clip, parse_path(node.attrib["d"]))]


def _marked(node: ElementTree.Element, markers: Mapping[str, _Marker]) -> list[Element]:
    """One place of a marker, as a path of its own; a round one without an edge as the round end of a line."""
    marker = markers[_href(node).lstrip("#")]
    x, y = float(node.attrib.get("x", 0)), float(node.attrib.get("y", 0))
    style = {**marker.style, **_style(node)}
    diameter = circle_diameter(marker.commands)
    fill, edge = style.get("fill", "#000000"), style.get("stroke", "none")
    if diameter is not None and fill != "none" and edge in ("none", fill):
        width = diameter + (float(style.get("stroke-width", 1)) if edge != "none" else 0.0)
        dot = {"fill": "none", "stroke": fill, "stroke-width": f"{width:.2f}", "stroke-linecap": "round"}
        dot |= {key: value for key, value in style.items() if key == "opacity"}
        if "fill-opacity" in style:
            dot["stroke-opacity"] = style["fill-opacity"]
        return [Element("path", dot, commands=[("M", (x, y)), ("L", (x, y))])]
    return [Element("path", style, commands=moved(marker.commands, x, y))]


def _text(node: ElementTree.Element) -> Element:
    attributes = {key: _rounded(value) for key, value in node.attrib.items() if key in ("x", "y", "transform")}
    turned = re.fullmatch(r"rotate\(-?0 .*\)", attributes.get("transform", ""))
    if turned:
        del attributes["transform"]
    style = _style(node)
    if style.get("text-anchor") == "start":
        del style["text-anchor"]
    children = [_plain(child) for child in node]
    return Element("text", style, attributes, children=children, text=node.text or "")


def _image(node: ElementTree.Element) -> Element:
    attributes = {key.rsplit("}", 1)[-1]: value for key, value in node.attrib.items()}
    kept = {
        key: _rounded(attributes[key])
        for key in ("x", "y", "width", "height", "transform", "clip-path")
        if key in attributes
    }
    return Element("image", {}, kept | {"href": recoded(attributes["href"]), "preserveAspectRatio": "none"})


def recoded(href: str) -> str:
    """A PNG in a data address as WebP, grey where it is grey; unchanged where that is no smaller."""
    from PIL import Image

    head, _, data = href.partition("base64,")
    raw = base64.b64decode("".join(data.split()))
    if not head.startswith("data:image/png"):
        return href
    picture = Image.open(io.BytesIO(raw))
    alpha = picture.mode == "RGBA" and picture.getchannel("A").getextrema() != (255, 255)
    file = io.BytesIO()
    picture.convert("RGBA" if alpha else "RGB").save(file, "WEBP", quality=PICTURE_QUALITY, method=4)
    kind, small = ("webp", file.getvalue()) if file.tell() < len(raw) else ("png", raw)
    return f"data:image/{kind};base64,{base64.b64encode(small).decode('ascii')}"


def _merged(elements: Sequence[Element], axis: bool = False) -> list[Element]:
    """Neighbouring paths of one look as one; in an axis, where nothing hides anything, all of one look."""
    if axis:
        elements = sorted(elements, key=lambda one: one.tag == "text")
    merged: list[Element] = []
    for one in elements:
        candidates = merged if axis else merged[-1:]
        same = next((other for other in candidates if _alike(other, one)), None)
        if same is None:
            merged.append(one)
        else:
            same.commands = same.commands + one.commands
    return merged


def _alike(one: Element, other: Element) -> bool:
    return (
        one.tag == other.tag == "path"
        and one.style == other.style
        and one.attributes == other.attributes
        and len(one.commands) + len(other.commands) < 20_000
        and (one.style.get("fill") == "none" or len(other.commands) <= _SHORT_MARKER)
    )


def _references(elements: Iterable[Element]) -> Iterable[str]:
    for one in elements:
        yield from (value for key, value in one.attributes.items() if key == "clip-path")
        yield from _references(one.children)


def _written(one: Element, prefix: str, used: set[str], colours: Mapping[str, str]) -> str:
    attributes = dict(one.attributes)
    name = attributes.pop("id", "")
    if one.tag == "clipPath" and name not in used:
        return ""
    parts = [f'id="{prefix}-{name}"'] if name in used else []
    if one.style:
        parts.append(f'style="{_short_style(one.style, colours)}"')
    if one.commands:
        parts.append(f'd="{write_path(one.commands)}"')
    for key, value in attributes.items():
        parts.append(f'{key}="{escape(value.replace("url(#", f"url(#{prefix}-"), quote=True)}"')
    inside = escape(one.text, quote=False) + "".join(_written(child, prefix, used, colours) for child in one.children)
    if one.tag == "defs" and not inside:
        return ""
    head = " ".join([one.tag, *parts])
    return f"<{head}>{inside}</{one.tag}>" if inside else f"<{head}/>"


def _short_style(style: Style, colours: Mapping[str, str]) -> str:
    pairs = []
    for key, value in style.items():
        known = colours.get(value.lower(), value)
        number = re.fullmatch(r"(\d*\.\d+)(px)?", known)
        if number:
            known = _shorter(float(number[1])) + (number[2] or "")
        pairs.append(f"{key}:{known}")
    return escape(";".join(pairs), quote=True)
