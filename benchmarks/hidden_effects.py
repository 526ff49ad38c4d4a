"""Whether a hidden effect is found: many campaigns of another simulator, beside a plain BIC choice.

    python benchmarks/hidden_effects.py [--kinds all] [--campaigns 5] [--first-seed 10000] [--rows rows.csv]
    python benchmarks/hidden_effects.py --verify

The campaigns (`benchmarks/hidden/`) share no code with the package's model: another equation of motion, another
integrator, and nuisances that the fit does not assume (scatter of B and P of any shape, correlated noise of several
kinds, heavy tails, wild points, unequal noise, wrong payloads, rounded pressures, trials cut short, no frames at rest).
Force laws and plausible sizes are shared, they are physics. `--campaigns` is per kind; kinds are `null:<regime>`, the
effects of the catalogue, pairs `a+b`, triples `a+b+c`, `outsider:<name>`, `frames:dropped`, `trace:<effect>`; groups of
kinds: nulls, effects, physical, faults, pairs, triples, outsiders, other, all.

How visible a truth was is measured by the package's own fit with the truth in the model, started at the true sizes:
σ = √(2 Δ ln L). Detection is listed by it; the bar asks for what lies above 8 σ.

Baselines on the same campaigns (`--methods`): `bic`, every candidate fitted alone, lowest BIC wins, with scatter and
correlation estimated; `bic_plain`, the same without either. `left_out` is the package again, with the errors on
left-out conditions once what it found is added, in parts of what the true model gets.

With `--rows` every answer is kept as it comes; begun again, what is there is not asked again. Seeds 0–899 tune,
900–999 are the tests', seeds from 10000 score: nothing may be tuned on those. `--verify` holds the two simulators
against each other, noise-free.
"""

from __future__ import annotations

import argparse
import csv
import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
from hidden import FIRST_SCORING_SEED, kinds, tables
from hidden.questions import METHODS, Row
from hidden.verify import differences
from rich.progress import track

Task = tuple[str, str, int]
COLUMNS = (
    *("method", "kind", "seed", "hidden", "is_outsider", "n_trials", "n_vines", "noise", "B_scatter", "P_scatter"),
    *("seconds", "processor_s", "verdict", "effects", "answer", "final", "final_answer", "rounds"),
    *("sigma", "sigma_second", "sigma_left", "sizes", "tied", "left_out_before", "left_out_after", "failed"),
)


def ask(task: Task) -> Row:
    """One answer; a question that breaks is an answer too."""
    method, kind, seed = task
    try:
        return METHODS[method](kind, seed)
    except Exception as error:
        return {"method": method, "kind": kind, "seed": seed, "failed": f"{type(error).__name__}: {error}"[:300]}


def kept_rows(path: Path | None) -> list[Row]:
    """What an earlier run has written."""
    if path is None or not path.is_file():
        return []
    with path.open(encoding="utf-8") as stream:
        if stream.readline().strip().split(",") != list(COLUMNS):
            raise SystemExit(f"{path} was written with other columns: give another name, or remove it.")
    return pd.read_csv(path, keep_default_na=False, na_values={"sigma": [""], "sigma_second": [""]}).to_dict("records")


def gather(tasks: list[Task], path: Path | None, processes: int) -> list[Row]:
    """All answers, those kept first."""
    rows = kept_rows(path)
    done = {(row["method"], row["kind"], int(str(row["seed"]))) for row in rows}
    wanted = set(tasks)
    rows = [row for row in rows if (row["method"], row["kind"], int(str(row["seed"]))) in wanted]
    todo = [task for task in tasks if task not in done]
    if path is not None and not path.is_file():
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        futures = [pool.submit(ask, task) for task in todo]
        for future in track(as_completed(futures), total=len(futures)):
            row = future.result()
            rows.append(row)
            if path is not None:
                with path.open("a", newline="", encoding="utf-8") as stream:
                    csv.DictWriter(stream, COLUMNS, extrasaction="ignore").writerow(row)
    return rows


def report(rows: list[Row]) -> None:
    """Print every table."""
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    said = table["failed"].astype(object)
    failed = said.notna() & (said != "")
    broken = table[failed]
    for row in broken.itertuples():
        print(f"! {row.method} {row.kind} {row.seed}: {row.failed}")
    table = table[~failed]
    for name in ("seconds", "processor_s", "sigma", "sigma_second", "sigma_left", "left_out_before", "left_out_after"):
        table[name] = pd.to_numeric(table[name], errors="coerce")
    table = tables.judged(tables.visible(table))
    print(f"\n{len(table)} answers about {len(table.drop_duplicates(['kind', 'seed']))} campaigns\n")
    answers = table[table["method"] != "left_out"]
    print(tables.headline(answers).to_string(), "\n")
    surplus = tables.surplus(table)
    if math.isfinite(surplus):
        print(f"answer sets above 8 σ hold {surplus:+.2f} names more than exhaustive refits leave tied")
    if "left_out" in set(table["method"]):
        show("errors on left-out conditions, in those of the true model", tables.left_out(table))
    for method, group in answers.groupby("method", sort=False):
        show(f"{method}: false alarms by regime", tables.false_alarms(group))
        show(f"{method}: said to be missing / campaigns, by visibility", tables.by_effect(group))
        print(f"\n== {method}: what was hidden, and what was said of it")
        print("\n".join(tables.confusion_lines(tables.confusion(group))))
    show("95 % intervals of the hidden sizes", tables.coverage(table))


def show(title: str, table: pd.DataFrame) -> None:
    """A table with its title."""
    print(f"\n== {title}\n{table.to_string(index=False)}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="all", help="groups or kinds, comma-separated")
    parser.add_argument("--campaigns", type=int, default=5, help="seeds per kind")
    parser.add_argument("--first-seed", type=int, default=FIRST_SCORING_SEED)
    parser.add_argument("--methods", default="vinetrack", help=f"of {', '.join(METHODS)}, comma-separated")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--rows", type=Path, help="CSV that keeps every answer")
    parser.add_argument("--verify", action="store_true", help="hold the two simulators against each other")
    given = parser.parse_args()
    if given.verify:
        print(differences().to_string(index=False))
        return
    methods = given.methods.split(",")
    seeds = range(given.first_seed, given.first_seed + given.campaigns)
    tasks = [(method, kind, seed) for seed in seeds for kind in kinds(given.kinds) for method in methods]
    report(gather(tasks, given.rows, given.processes))


if __name__ == "__main__":
    main()
