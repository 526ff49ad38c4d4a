"""How much a report of many trials weighs, how long it takes to make, and how long a browser takes to open it.

Run as `python benchmarks/report_size.py [RESULTS] [TRIALS]` after the demonstration, by default on `results/demo` with
200 trials: its trials are repeated under other names, each with its own strip, motion and data. Prints one row: trials,
trials whose pictures are in the page, MB, seconds to make, and seconds from the click to the page being drawn (where
there is a Chromium; the median of five). The bounds are 15 MB and 2 s.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import pandas as pd

from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import RunSettings
from vinetrack.pipeline.report_stage import report_content
from vinetrack.report.build import ReportContent, build_report
from vinetrack.results.folder_layout import read_json

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

RUNS = 5


def repeated(content: ReportContent, n_trials: int) -> ReportContent:
    """The same report with its trials repeated under other names, in turn, until there are `n_trials`."""
    own = content.trials["trial"].tolist()
    names = {f"{own[i % len(own)]}_{i // len(own)}": own[i % len(own)] for i in range(n_trials)}
    rows = content.trials.set_index("trial").loc[list(names.values())].reset_index()
    windows = [content.windows[content.windows["trial"] == old].assign(trial=new) for new, old in names.items()]
    return replace(
        content,
        trials=rows.assign(trial=list(names)),
        windows=pd.concat(windows, ignore_index=True),
        kinematics={new: content.kinematics[old] for new, old in names.items() if old in content.kinematics},
        trial_figures={new: content.trial_figures[old] for new, old in names.items() if old in content.trial_figures},
        recordings={new: content.recordings[old] for new, old in names.items() if old in content.recordings},
    )


def opens_in_s(path: Path) -> float:
    """Seconds from navigation to the end of loading, the median of `RUNS`; NaN without a browser."""
    try:
        from chrome import Chrome, find_chrome
    except ImportError:
        return float("nan")
    if find_chrome() is None:
        return float("nan")
    taken = []
    script = "(() => { const t = performance.getEntriesByType('navigation')[0]; return t.loadEventEnd / 1000 })()"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Chrome(Path(folder)) as chrome:
        for _ in range(RUNS):
            chrome.open("about:blank")
            chrome.open(path.as_uri())
            taken.append(float(chrome.wait(script, "the end of loading")))
    return statistics.median(taken)


def main() -> None:
    results = Path(sys.argv[1] if len(sys.argv) > 1 else "results/demo")
    n_trials = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    experiment = read_experiment(Path(read_json(results / "provenance.json")["experiment"]))
    settings = RunSettings().model_dump(mode="json", exclude={"experiment", "results"})
    content = repeated(report_content(experiment, results, settings), n_trials)
    begun = time.perf_counter()
    page = build_report(content)
    made_s = time.perf_counter() - begun
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.html"
        path.write_text(page, encoding="utf-8")
        size_mb = path.stat().st_size / 1e6
        opened_s = opens_in_s(path)
    pictured = page.count('class="pair"')
    print(f"{'trials':>7}{'pictured':>10}{'MB':>8}{'made in s':>11}{'opens in s':>12}")
    print(f"{n_trials:>7}{pictured:>10}{size_mb:>8.2f}{made_s:>11.1f}{opened_s:>12.2f}")


if __name__ == "__main__":
    main()
