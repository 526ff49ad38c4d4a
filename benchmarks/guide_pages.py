"""The commands of the guide run again: what stands below each on its page, and the guide's pictures.

    make guide
    python benchmarks/guide_pages.py [--results results/demo] [--pages tutorial own_effect] [--no-pictures]

Needs a finished demonstration (`make demo`, which `make guide` runs first), and a Chromium for the pictures of the
report and of the explorer, whose caption follows what the page says. Everything runs in a scratch folder, on copies of
the demonstration and its results. With the effect of docs/own_effect.md trials of two vines are grown in the virtual
laboratory. Pages are rewritten in place; folders are shown
relative, long lines wrapped.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

import pandas as pd
from commanded import INDENT, Shown, pieces, printed
from grown import grown, sheet
from own_effect import block

from vinetrack.core.tables import write_csv, write_json

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = ("tutorial", "own_effect")
WIDTH = 116
LARGEST_BYTES, LARGEST_WITH_A_RECORDING_BYTES = 150_000, 200_000
EXPLORER_PX = (1400, 1330)
CAPTION = (
    "*The demonstration. The base model is off by {before}, and by {after} with reservoir depletion ticked and "
    "refitted.*"
)
FIGURES = {"tutorial_strip": "strip_d24_30kPa_1", "tutorial_before_after": "before_after", "verdict_ladder": "ladder"}
SEED, STIFFNESS_N_M = 41, 0.4
GALLERY = (("null:white", 52001), ("inlet_loss", 40000), ("payload_mass", 40000), ("outsider:growing_friction", 40000))


def rewritten(text: str, command: Callable[[Shown], str]) -> str:
    """The page with every command's output as it is now."""
    lines = []
    for piece in pieces(text):
        if isinstance(piece, str):
            lines.append(piece)
            continue
        body = [f"{INDENT}{line}".rstrip() for line in command(piece).splitlines()]
        lines += [*piece.lines, *body, ""]
    return "\n".join(lines) + "\n"


def stage_demonstration(results: Path, scratch: Path) -> None:
    """Copies that commands may change: `data/demo` and `results/demo`; and `slips`, a folder with three of them."""
    provenance = json.loads((results / "provenance.json").read_text(encoding="utf-8"))
    experiment = scratch / "data" / "demo"
    shutil.copytree(provenance["experiment"], experiment)
    shutil.copytree(results, scratch / "results" / "demo")
    write_json(scratch / "results" / "demo" / "provenance.json", {**provenance, "experiment": str(experiment)})
    slips = scratch / "slips"
    shutil.copytree(experiment / "calibration", slips / "calibration")
    sheet_lines = (experiment / "trials.csv").read_text(encoding="utf-8").splitlines()[:4]
    sheet_lines[1] = sheet_lines[1].replace(",24,0", ",24000,0")
    sheet_lines[2] = sheet_lines[2].replace(",12,100,", ",12,0.1,")
    (slips / "trials.csv").write_text("\n".join(sheet_lines) + "\n", encoding="utf-8")
    (slips / "videos").symlink_to(experiment / "videos")
    settings = (experiment / "experiment.yaml").read_text(encoding="utf-8")
    (slips / "experiment.yaml").write_text(settings.replace("exposure_us", "exposre_us"), encoding="utf-8")


def stage_own_effect(folder: Path) -> None:
    """The experiment of docs/own_effect.md: trials grown with its effect, which the model in use does not have."""
    folder.mkdir()
    effect = folder / "spring_line.py"
    effect.write_text(block("python"), encoding="utf-8")
    (folder / "experiment.yaml").write_text("effects: [spring_line.py]\n", encoding="utf-8")
    rows = []
    for one in grown(sheet(), SEED, values={"spring_line.k": STIFFNESS_N_M}, own=[effect]):
        trial, track = one.stated, one.track
        points = pd.DataFrame({"time_s": track.time_s, "position_m": track.lead_position_m})
        write_csv(folder / f"{trial.name}.csv", points[track.usable])
        rows.append(
            {
                "trial": trial.name,
                "track": f"{trial.name}.csv",
                "diameter_mm": 1e3 * trial.diameter_m,
                "thickness_um": 1e6 * trial.thickness_m,
                "length_mm": 1e3 * trial.length_m,
                "pressure_kPa": trial.pressure_Pa / 1e3,
                "yield_pressure_kPa": trial.yield_pressure_Pa / 1e3,
                "chamber_l": 1e3 * trial.chamber_m3,
            }
        )
    write_csv(folder / "trials.csv", pd.DataFrame(rows))


class Runner:
    """Runs commands of pages in a scratch folder, each once; `| head -n N` is understood."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self.known: dict[tuple[str, ...], str] = {}

    def __call__(self, shown: Shown) -> str:
        """What a command prints, as the page shows it."""
        arguments, pipe = shown.arguments, len(shown.arguments)
        if "|" in arguments:
            pipe = arguments.index("|")
        command, rest = arguments[:pipe], arguments[pipe:]
        if command not in self.known:
            print(f"vinetrack {' '.join(command)}", file=sys.stderr)
            self.known[command] = printed(Shown(shown.lines, command, ""), exits=(0, 1) if "check" in command else (0,))
        lines = self.known[command].replace(f"{self.scratch}/", "").splitlines()
        kept = lines[: int(rest[-1])] if rest else lines
        return "\n".join(part for line in kept for part in wrapped(line)).strip("\n")


def wrapped(line: str) -> list[str]:
    """A long line of prose in several; one of a table stays."""
    if len(line) <= WIDTH or "  " in line.strip():
        return [line]
    return textwrap.wrap(line, WIDTH, break_long_words=False, break_on_hyphens=False)


def save_picture(png: bytes, name: str, width_px: int = 1200, largest_bytes: int = LARGEST_BYTES) -> None:
    """A picture for the docs: no wider than a page, few colours, small enough to be stored."""
    from PIL import Image

    image = Image.open(BytesIO(png)).convert("RGB")
    image.thumbnail((width_px, 1600), Image.Resampling.LANCZOS)
    for colours in (256, 128, 64):
        out = BytesIO()
        image.quantize(colours, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
        if out.tell() <= largest_bytes:
            break
    (DOCS / f"{name}.png").write_bytes(out.getvalue())


def save_pictures(results: Path, scratch: Path) -> None:
    """The figures of the guide, and the first screen of the report."""
    from chrome import Chrome

    for name, figure in FIGURES.items():
        save_picture((results / "figures" / f"{figure}.png").read_bytes(), name)
    with Chrome(scratch, 1200, 900) as browser:
        browser.open((results / "report.html").resolve().as_uri())
        browser.picture(scratch / "report.png")
    save_picture((scratch / "report.png").read_bytes(), "report")


def save_gallery(results: Path, scratch: Path) -> None:
    """The head of the demonstration's report, and of one for each other verdict, of campaigns of `hidden`."""
    from chrome import Chrome
    from commanded import succeed
    from hidden import make, write_folder
    from PIL import Image

    folders, heads = [results], []
    for kind, seed in GALLERY:
        name = kind.replace(":", "_")
        write_folder(make(kind, seed), scratch / name)
        succeed("run", scratch / name, "--results", scratch / "gallery")
        folders.append(scratch / "gallery" / name)
    with Chrome(scratch / "heads", 1200, 620) as browser:
        for k, folder in enumerate(folders):
            browser.open((folder / "report.html").resolve().as_uri())
            browser.picture(scratch / f"head_{k}.png")
            heads.append(Image.open(scratch / f"head_{k}.png").convert("RGB"))
    whole = Image.new("RGB", (1200, sum(head.height for head in heads)))
    for k, head in enumerate(heads):
        whole.paste(head, (0, sum(one.height for one in heads[:k])))
    whole.resize((800, whole.height * 800 // 1200)).save(DOCS / "verdict_gallery.webp", quality=40, method=6)


def save_explorer(results: Path, scratch: Path) -> None:
    """The explorer once reservoir depletion was ticked and refitted, and the numbers of its caption."""
    from chrome import Chrome
    from served import Served, Visitor

    with Served(results, "--port", "0") as served, Chrome(scratch / "explorer", *EXPLORER_PX) as browser:
        page = Visitor(browser, served.address)
        page.until("$numbers.text.includes('<table>')", "the fit of the model in use", 300)
        before = off_by(page.text("headline"))
        page.click("tick_reservoir_depletion", "input")
        page.until("$headline.text.includes('reservoir depletion')", "the effect to be in")
        page.click("refit")
        page.until("$refit.label === 'Refit' && $numbers.text.includes('+1 parameters')", "the refit", 300)
        page.until("$film_figure.visible && $film_edges.data.xs.length === 3", "the recording", 120)
        after = off_by(page.text("headline"))
        browser.run("scrollTo(0, 0)")
        time.sleep(1)
        browser.picture(scratch / "explorer.png")
    save_picture((scratch / "explorer.png").read_bytes(), "explorer", 1120, LARGEST_WITH_A_RECORDING_BYTES)
    page_file = DOCS / "explorer.md"
    caption = "\n".join(textwrap.wrap(CAPTION.format(before=before, after=after), 120))
    text = page_file.read_text(encoding="utf-8")
    page_file.write_text(re.sub(r"^\*The demonstration\..*?\*$", caption, text, flags=re.M | re.S), encoding="utf-8")


def off_by(headline: str) -> str:
    """What a headline of the explorer says the model is off by."""
    found = re.search(r"off by ([\d.]+ mm)", headline)
    assert found is not None, headline
    return found[1]


def main() -> None:
    """Rewrite the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "demo")
    parser.add_argument("--pages", nargs="*", choices=PAGES, default=list(PAGES))
    parser.add_argument("--no-pictures", action="store_true")
    asked = parser.parse_args()
    results = asked.results.resolve()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder).resolve()
        if "tutorial" in asked.pages or not asked.no_pictures:
            stage_demonstration(results, scratch)
        if "own_effect" in asked.pages:
            stage_own_effect(scratch / "my_experiment")
        if not asked.no_pictures:
            save_pictures(results, scratch)
            save_gallery(results, scratch)
        os.chdir(scratch)
        if not asked.no_pictures:
            save_explorer(Path("results/demo"), scratch)
        run = Runner(scratch)
        # The tutorial saves an effect to the model: what others print comes first.
        for name in sorted(asked.pages, key=lambda page: page == "tutorial"):
            page = DOCS / f"{name}.md"
            page.write_text(rewritten(page.read_text(encoding="utf-8"), run), encoding="utf-8")
        os.chdir(ROOT)


if __name__ == "__main__":
    main()
