"""Building blocks of the page: pictures, figures with their data, tables, and sections of both."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

from markupsafe import Markup

from vinetrack.figures.style import TOKENS

_DROPPED = re.compile(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", re.DOTALL)
_DRAWING_TAG = re.compile(r"<(?!image)[^>]*>")  # Images are placed by matrices, which need all their decimals
_IDENTIFIER = re.compile(r'\bid="|url\(#|href="#')
_IMAGE = re.compile(r'data:image/png;base64,([^"]+)')
_COLOURS = {colour: "currentColor" if token == "--ink" else f"var({token})" for colour, token in TOKENS.items()}
_COLOUR = re.compile("|".join(_COLOURS))


def inline_picture(picture: str | bytes, prefix: str, description: str) -> Markup:
    """Return an SVG file or a PNG file as an element of the page, as wide as `--wide` where there is room: then its
    text is as large as that of the page. Blank for an empty file.
    """
    if not picture:
        return Markup()
    if isinstance(picture, str):
        return Markup(_inline_svg(picture, prefix, description))
    from PIL import Image

    image = Image.open(io.BytesIO(picture))
    wide = 96 * image.width / image.info.get("dpi", (150, 150))[0]
    source = _as_webp(picture, 85)  # The same of a whole figure, whose letters must stay sharp (chosen)
    return Markup(f'<img alt="{escape(description, quote=True)}" style="--wide:{wide:.0f}px" src="{source}">')


def _inline_svg(svg: str, prefix: str, description: str) -> str:
    """An SVG of matplotlib with its colours from the page, so that it follows a dark scheme, its identifiers unique,
    coordinates to a hundredth of a point, and its images as WebP.
    """
    found = re.search(r'<svg[^>]* viewBox="0 0 ([\d.]+) ([\d.]+)"[^>]*>(.*)</svg>', svg, re.DOTALL)
    if found is None:
        raise ValueError("not an SVG file of a figure")
    width, height = float(found[1]), float(found[2])

    def short(tag: re.Match[str]) -> str:
        return _COLOUR.sub(lambda match: _COLOURS[match[0]], re.sub(r"(\.\d\d)\d+", r"\1", tag[0]))

    body = _DRAWING_TAG.sub(short, _DROPPED.sub("", found[3]))
    body = _IDENTIFIER.sub(lambda match: f"{match[0]}{escape(prefix, quote=True)}-", body)
    # WebP quality of the images in a strip, 0 to 100
    body = _IMAGE.sub(lambda match: _as_webp(base64.b64decode(match[1]), 45), body)
    body = re.sub(r"\s*\n\s*", " ", body)
    label = escape(description, quote=True)
    head = f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}" style="--wide:{1.33 * width:.0f}px"'
    return f"<svg {head}>{body}</svg>"


def _as_webp(png: bytes, quality: int) -> str:
    """Return a PNG as a data URI of a WebP."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png))
    is_opaque = picture.mode != "RGBA" or picture.getchannel("A").getextrema() == (255, 255)
    file = io.BytesIO()
    picture.convert("RGB" if is_opaque else "RGBA").save(file, "WEBP", quality=quality, method=4)
    return base64_uri("image/webp", file.getvalue())


def base64_uri(kind: str, content: bytes) -> str:
    """Return a file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report: its SVG or PNG, its caption, and its data as a file to download."""

    key: str
    title: str
    caption: str
    picture: str | bytes
    data_name: str = ""
    data: str = ""

    @property
    def element(self) -> Markup:
        """The picture as an element of the page."""
        return inline_picture(self.picture, self.key, self.title)

    @property
    def data_uri(self) -> str:
        """The data as a file to download."""
        return data_uri(self.data_name, self.data)


@dataclass(frozen=True)
class ReportTable:
    """A table of the report, as text in rows, false if it has none; `numbers` are the right-aligned columns."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    note: str = ""

    def __bool__(self) -> bool:
        return bool(self.rows)


@dataclass(frozen=True)
class ReportSection:
    """A part of the page under one heading: paragraphs, then tables, then figures."""

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def data_uri(name: str, text: str) -> str:
    """Return a file as a data URI, in the shorter of two encodings."""
    unescaped = ",;:!*'()/ -._~+@=$?"  # Characters that need no escaping in a quoted URL
    kind = "application/json" if name.endswith(".json") else "text/csv"
    escaped = f"data:{kind};charset=utf-8,{quote(text, safe=unescaped)}"
    encoded = base64_uri(f"{kind};charset=utf-8", text.encode("utf-8"))
    return min(encoded, escaped, key=len)
