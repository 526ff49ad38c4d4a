"""Which file of a figure the page shows, for every choice of `figures.formats`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from vinetrack.pipeline import report_stage
from vinetrack.results.folder_layout import Results


@pytest.mark.parametrize(
    ("formats", "shown"), [(("png", "svg"), "<svg/>"), (("svg",), "<svg/>"), (("png",), b"png"), (("pdf",), b"")]
)
def test_a_figure_is_shown_from_the_files_there_are(tmp_path: Path, formats: tuple[str, ...], shown: object) -> None:
    path = partial(Results(tmp_path).figure, "ladder")
    path(".svg").parent.mkdir()
    for form in formats:
        path(f".{form}").write_text({"svg": "<svg/>"}.get(form, form))
    assert report_stage._picture(path) == shown


def test_a_large_svg_gives_way_to_its_png(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = partial(Results(tmp_path).figure, "ladder")
    path(".svg").parent.mkdir()
    path(".svg").write_text("<svg/>")
    path(".png").write_bytes(b"png")
    monkeypatch.setattr(report_stage, "MAX_SVG_BYTES", 5)
    assert report_stage._picture(path) == b"png"
