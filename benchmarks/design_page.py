"""The worked examples of docs/design.md run again: every command on the page, its output and its pictures.

    python benchmarks/design_page.py

Rewrites the page in place. The seeds are those the commands have by default; a test holds the page to the commands.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from doc_commands import rewritten

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", default="docs/design.md")
    page = ROOT / parser.parse_args().page
    os.chdir(ROOT)
    page.write_text(rewritten(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
