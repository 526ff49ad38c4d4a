"""How do the paper's published numbers stand beside ours? Prints `paper.csv` of a results folder as Markdown.

    python benchmarks/paper_table.py [results/paper]

The table of docs/paper.md is its output on `data/paper`, whose seed is in `vinetrack/laboratory/paper.yaml`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from vinetrack.figures.style import rows
from vinetrack.report.paper_section import every_row, table_one, table_two
from vinetrack.report.section import ReportTable
from vinetrack.results.folder_layout import read_result


def main(folder: Path) -> None:
    """Print Tables I and II and every row, each with its marks."""
    table, departures = read_result(folder / "paper.csv"), read_result(folder / "paper_departures.csv")
    for one in (table_one(table), *table_two(table, departures), *every_row(table)):
        print(f"### {one.title}\n")
        print(markdown(one), end="\n\n")
        if one.note:
            print(one.note, end="\n\n")
    counts = {str(row.mark) for row in rows(table)}
    print(f"{len(table)} rows of {len(counts)} kinds.")


def markdown(table: ReportTable) -> str:
    """A table as Markdown; columns of numbers stand to the right."""
    rule = ["---:" if i in table.numbers else "---" for i in range(len(table.head))]
    body = [[cell.replace("|", "\\|") for cell in row] for row in (table.head, rule, *table.rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in body)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/paper"))
