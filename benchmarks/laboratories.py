"""What becomes of a verdict in laboratories as they are: with worn tubes, wild points, lenses, valves, clocks.

    python benchmarks/laboratories.py [--rows all|NAME,…] [--campaigns 5] [--first-seed 20000] [--jobs 1]
    python benchmarks/laboratories.py --folder DIR …      only writes the experiments, and their truth beside them
    python benchmarks/laboratories.py --written DIR …     diagnoses those written there

Every campaign comes from a simulator that shares no code with the package (`benchmarks/hidden/`), is written as an
experiment folder, and goes to `vinetrack.diagnose` as that folder. A row is one kind of laboratory
(`benchmarks/hidden/laboratory_kinds.py`), with the answers that are right about it. `--answers` keeps every answer as
it comes; begun again, what is there is not asked again. `--trials` are the fewest and the most trials of a campaign.

Seeds 20000–20999 tune, 30000–39999 score: nothing may be tuned on those.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
from hidden.laboratory_folder import write_experiment, write_truth
from hidden.laboratory_kinds import TRIALS
from hidden.laboratory_rows import ROWS, campaign
from hidden.verdicts import Answer, judge
from rich.progress import track

Task = tuple[str, int, tuple[int, int], Path | None]
Line = dict[str, object]
FIRST_TUNING_SEED, FIRST_SCORING_SEED = 20_000, 30_000
COLUMNS = (
    *("row", "seed", "n_trials", "verdict", "answer", "effects", "final", "final_answer", "right", "wrong_name"),
    *("why", "covered", "intervals", "seconds", "processor_s", "failed"),
)


def ask(task: Task) -> Line:
    """Write one campaign, have it diagnosed, judge the answer; one that breaks is an answer too."""
    name, seed, trials, written = task
    line: Line = {"row": name, "seed": seed}
    with tempfile.TemporaryDirectory() as holder:
        place = written or Path(holder)
        if written is None:
            write_both(place, name, seed, trials)
        folder = place / f"{name}_{seed}"
        truth = json.loads(truth_of(place, name, seed).read_text(encoding="utf-8"))
        line["n_trials"] = truth["n_trials"]
        begun, work = time.perf_counter(), time.process_time()
        try:
            said = diagnosed(folder)
        except Exception as error:
            return line | {"right": False, "wrong_name": False, "failed": f"{type(error).__name__}: {error}"[:300]}
        line |= {"seconds": time.perf_counter() - begun, "processor_s": time.process_time() - work}
    answer = Answer.of(said)
    truths = truth["truths"]
    judgement = judge(answer, ROWS[name].should, truths)
    held = held_intervals(answer, truths)
    return line | {
        "verdict": answer.verdict,
        "answer": "|".join(answer.answer_set),
        "effects": "+".join(answer.effects),
        "final": answer.final_verdict,
        "final_answer": "|".join(answer.final_answer),
        "right": judgement.right,
        "wrong_name": judgement.wrong_name,
        "why": judgement.why,
        "covered": sum(held),
        "intervals": len(held),
    }


def truth_of(place: Path, name: str, seed: int) -> Path:
    """Where the truth of a campaign is written: not in its folder."""
    return place / "truth" / f"{name}_{seed}.json"


def write_both(place: Path, name: str, seed: int, trials: tuple[int, int]) -> int:
    """Make one campaign and write its experiment and its truth; how many trials it has."""
    made = campaign(name, seed, trials)
    write_experiment(made, place / f"{name}_{seed}")
    write_truth(made, truth_of(place, name, seed))
    return len(made.recordings)


def diagnosed(folder: Path) -> dict[str, object]:
    """What `vinetrack diagnose FOLDER --json` writes."""
    import vinetrack as vt

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return json.loads(json.dumps(vt.diagnose(folder).to_json(), default=float))


def held_intervals(answer: Answer, truths: dict[str, float]) -> list[bool]:
    """For every fitted number whose truth is known, whether its 95 % interval holds it."""
    held = []
    for number in answer.parameters:
        key = str(number["parameter"])
        low, high = number["low_95"], number["high_95"]
        if key in truths and low is not None and high is not None:
            held.append(low <= truths[key] <= high)
    return held


def kept(path: Path | None) -> list[Line]:
    """What an earlier run has written."""
    if path is None or not path.is_file():
        return []
    return pd.read_csv(path, keep_default_na=False).to_dict("records")


def gather(tasks: list[Task], path: Path | None, jobs: int) -> list[Line]:
    """All answers, those kept first."""
    wanted = {task[:2] for task in tasks}
    lines = [line for line in kept(path) if (line["row"], int(str(line["seed"]))) in wanted]
    done = {(line["row"], int(str(line["seed"]))) for line in lines}
    todo = [task for task in tasks if task[:2] not in done]
    if path is not None and not path.is_file():
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(ask, task) for task in todo]
        for future in track(as_completed(futures), total=len(futures)):
            lines.append(future.result())
            if path is not None:
                with path.open("a", newline="", encoding="utf-8") as stream:
                    csv.DictWriter(stream, COLUMNS).writerow(lines[-1])
    return lines


def summary(lines: list[Line]) -> pd.DataFrame:
    """A line a row: how often right, how often a wrong name alone, what was said, how long it took."""
    table = pd.DataFrame(lines, columns=list(COLUMNS), dtype=object).fillna("")
    for name in ("right", "wrong_name"):
        table[name] = table[name].astype(str) == "True"
    for name in ("seconds", "covered", "intervals"):
        table[name] = pd.to_numeric(table[name], errors="coerce")
    out = []
    known = [name for name in ROWS if name in set(table["row"])]
    for name, group in [*((name, table[table["row"] == name]) for name in known), ("all", table)]:
        said = (group["verdict"] + ": " + group["answer"]).str.removesuffix(": ").where(group["failed"] == "", "failed")
        counts = said.value_counts()
        out.append(
            {
                "row": name,
                "right": f"{group['right'].sum()}/{len(group)}",
                "wrong name": int(group["wrong_name"].sum()),
                "unexplained": int((group["verdict"] == "unexplained").sum()),
                "in 95 %": f"{group['covered'].sum():.0f}/{group['intervals'].sum():.0f}",
                "s": f"{group['seconds'].median():.1f}",
                "said": "" if name == "all" else "; ".join(f"{said} {count}" for said, count in counts.items()),
            }
        )
    return pd.DataFrame(out)


def report(lines: list[Line]) -> None:
    """Print the table, and every answer that is not right."""
    with pd.option_context("display.max_colwidth", 110, "display.width", 250):
        print(summary(lines).to_string(index=False))
    print("\nnot right")
    for line in sorted(lines, key=lambda one: (str(one["row"]), int(str(one["seed"])))):
        if str(line["right"]) != "True":
            mark = "!" if str(line["wrong_name"]) == "True" else " "
            said = line.get("failed") or f"{line['verdict']} {line['answer']} ({line['why']})"
            print(f"{mark} {line['row']} {line['seed']}: {said}")


def chosen(rows: str) -> list[str]:
    """Rows by name, comma-separated, or all; a name with * stands for all that fit."""
    from fnmatch import fnmatchcase

    if rows == "all":
        return list(ROWS)
    names: list[str] = []
    for pattern in rows.split(","):
        found = [name for name in ROWS if fnmatchcase(name, pattern)]
        if not found:
            raise SystemExit(f"There is no row {pattern!r}; there are {', '.join(ROWS)}.")
        names += [name for name in found if name not in names]
    return names


def main() -> None:
    """Write or run, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="all", help="names, comma-separated; * as in names of files")
    parser.add_argument("--campaigns", type=int, default=5, help="seeds a row")
    parser.add_argument("--first-seed", type=int, default=FIRST_TUNING_SEED)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--trials", default=":".join(map(str, TRIALS)), help="fewest and most trials, as 24:48")
    parser.add_argument("--folder", type=Path, help="only write the experiments here")
    parser.add_argument("--written", type=Path, help="take the experiments that were written here")
    parser.add_argument("--answers", type=Path, help="CSV that keeps every answer")
    given = parser.parse_args()
    low, high = (int(part) for part in given.trials.split(":"))
    seeds = range(given.first_seed, given.first_seed + given.campaigns)
    tasks: list[Task] = [(name, seed, (low, high), given.written) for seed in seeds for name in chosen(given.rows)]
    if given.folder is None:
        report(gather(tasks, given.answers, given.jobs))
        return
    for name, seed, trials, _ in tasks:
        print(f"{name}_{seed}: {write_both(given.folder, name, seed, trials)} trials", flush=True)


if __name__ == "__main__":
    main()
