"""Response time of the explorer's page: to a slider move, and to the start of a refit.

Run as `python benchmarks/explorer_speed.py [RESULTS] [MOVES]` on a results folder, by default `results/demo`, with 60
moves of the size of `reservoir_depletion`, each waited for; needs a Chromium. Prints the time from a move to the
painted frame (fastest, quartile, median, slowest), the part of it in which the curves are computed, and the time from
a click on *Refit* to the first sign of progress, ms. The bounds are 150 and 500 ms.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from chrome import Chrome
from served import Served, Visitor

from vinetrack.pages.campaign import choice_in_use, predict_choice
from vinetrack.pages.page import open_campaign

SIZE = "size_reservoir_depletion.gamma"


def redraws_ms(visitor: Visitor, moves: int) -> list[float]:
    """Time from each move of the slider to the frame that shows it: from its first change to the frame painted."""
    visitor.chrome.run(
        f"""(() => {{
          window.redraws_ms = [];
          let moved = 0;
          {visitor.model(SIZE)}.properties.value.change.connect(() => {{ moved ||= performance.now(); }});
          {visitor.model("model_curves")}.properties.data.change.connect(() => {{
            const begun = moved;
            moved = 0;
            if (begun) requestAnimationFrame(() => setTimeout(() => redraws_ms.push(performance.now() - begun)));
          }});
        }})()"""
    )

    def one_redraw() -> None:
        """Wait, within the page, until one more redraw was recorded; for two seconds at most."""
        visitor.chrome.run(
            """(async () => {
              const count = window.redraws_seen ?? 0;
              const end = performance.now() + 2000;
              while (redraws_ms.length <= count && performance.now() < end) await new Promise((r) => setTimeout(r, 2));
              window.redraws_seen = redraws_ms.length;
            })()"""
        )

    visitor.drag(SIZE, [-0.6 * (0.5 - 0.5 * np.cos(0.4 * k)) for k in range(1, moves + 1)], one_redraw)
    return list(visitor.chrome.run("redraws_ms"))


def computed_ms(results: Path) -> tuple[int, float]:
    """Number of trials, and the median time to compute all curves and errors."""
    campaign = open_campaign(results)
    start = choice_in_use(campaign).with_effect("reservoir_depletion")
    spent = []
    for k in range(22):
        started = time.perf_counter()
        predict_choice(campaign, start.with_sizes({SIZE[5:]: 1.1 + 0.01 * k}))
        spent.append(1e3 * (time.perf_counter() - started))
    return len(campaign.trials), statistics.median(spent[2:])


def progress_ms(visitor: Visitor) -> float:
    """Time from the click on *Refit* to the progress bar, measured within the page."""
    visitor.place("refit", "button")
    return float(
        visitor.chrome.run(
            f"""(async () => {{
              const begun = performance.now();
              Bokeh.index.find_one({visitor.model("refit")}).shadow_el.querySelector("button").click();
              while (!{visitor.model("status")}.text.includes("refitting")) await new Promise((r) => setTimeout(r, 2));
              return performance.now() - begun;
            }})()"""
        )
    )


def main(arguments: list[str]) -> None:
    """Print the table."""
    results = Path(arguments[0] if arguments else "results/demo")
    moves = int(arguments[1]) if len(arguments) > 1 else 60
    trials, computing = computed_ms(results)
    with (
        tempfile.TemporaryDirectory() as folder,
        Served(results, "--port", "0") as served,
        Chrome(Path(folder)) as chrome,
    ):
        visitor = Visitor(chrome, served.address)
        visitor.until("$numbers.text.includes('<table>')", "the fit of the model in use", 300)
        redraws = redraws_ms(visitor, moves)
        progress = progress_ms(visitor)
    shown = (min(redraws), float(np.quantile(redraws, 0.25)), statistics.median(redraws), max(redraws))
    head = ("trials", "moves", "fastest", "quartile", "median", "slowest", "computed", "progress ms")
    print("".join(f"{name:>12}" for name in head))
    print(f"{trials:>12d}{len(redraws):>12d}" + "".join(f"{value:>12.0f}" for value in (*shown, computing, progress)))


if __name__ == "__main__":
    main(sys.argv[1:])
