"""How verdicts move when a threshold of the diagnosis is halved and doubled.

    python benchmarks/verdict_thresholds.py [--kinds KIND,…] [--first-seed 700] [--campaigns 1] [--trials 18]
                                            [--only NAME,…] [--rows rows.csv]

The same campaigns of `benchmarks/hidden/`, whose simulator shares no code with the package, are asked with every number
of THRESHOLDS as it is, at half and at twice. By default they are four in which nothing is missing, and effects, faults
of measurement and a force in no list that are drawn small as often as large. Printed for each change: false alarms,
hidden effects that are in the answer, wrong names alone, faults of measurement called physics, and how many answers
differ from those of the numbers as they are; those are listed. Probabilities are halved
and doubled like other numbers.

`--rows` keeps every answer as it comes, and what is there is not asked again. Seeds 700–799 are this benchmark's alone:
no number was tuned on them.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import multiprocessing
import pkgutil
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from types import ModuleType

import pandas as pd
from hidden import make, tables
from rich.progress import track

import vinetrack.diagnosis

THRESHOLDS = (
    *("FALSE_ALARM_LEVEL_FIRST_ROUND", "FALSE_ALARM_LEVEL_LATER_ROUNDS", "PROBE_LEVEL", "POOR_FIT"),
    *("MISSED_FRACTION", "SEARCH_CHI2_PER_DOF", "SEARCH_SIGMAS", "ANSWER_SET_DELTA_CHI2"),
    *("CAREFUL_PRESSURE_SCATTER", "CAREFUL_DAMPING_SCATTER", "OUT_OF_REACH", "CREDIBLE_RANGE_FACTOR"),
    *("MIN_LINEAR_GAIN", "FALSE_ALARM_LEVEL"),
)
"""Numbers of `vinetrack.diagnosis` that decide between one verdict and another. Those that only bound the time of a
search, or the words of a sentence, are not among them."""

KINDS = (
    *("null:anything", "null:correlated", "null:large_B_scatter", "null:trace"),
    *("reservoir_depletion", "inlet_loss", "tail_friction", "leak", "payload_friction", "air_drag"),
    *("length_scale", "perspective", "pressure_gauge", "outsider:rough_patch"),
)
FACTORS = (0.5, 2.0)
AS_IT_IS = ("as it is", 1.0)
COLUMNS = (
    *("threshold", "factor", "kind", "seed", "hidden"),
    *("verdict", "effects", "answer", "final", "final_answer", "failed"),
)

Change = tuple[str, float]
Task = tuple[Change, str, int, int]


def holders(name: str) -> list[ModuleType]:
    """The modules that have a threshold, of those of the diagnosis and what they import."""
    for known in pkgutil.iter_modules(vinetrack.diagnosis.__path__, "vinetrack.diagnosis."):
        importlib.import_module(known.name)
    loaded = [module for key, module in sys.modules.items() if key.startswith("vinetrack.")]
    found = [module for module in loaded if name in vars(module)]
    if not found:
        raise SystemExit(f"the diagnosis has no threshold {name!r}")
    return found


def ask(task: Task) -> dict[str, object]:
    """The verdict on one campaign with one number changed; in a process of its own."""
    (name, factor), kind, seed, trials = task
    import vinetrack as vt

    if name != AS_IT_IS[0]:
        for module in holders(name):
            setattr(module, name, getattr(module, name) * factor)
    campaign = make(kind, seed, trials=trials)
    truth = campaign.truth
    row: dict[str, object] = {"threshold": name, "factor": factor, "kind": kind, "seed": seed}
    row["hidden"] = "+".join(truth.effects) or truth.outsider
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = vt.diagnose(list(campaign.pairs), ladder=False, advice=False)
    except Exception as error:
        return row | {"failed": f"{type(error).__name__}: {error}"[:300]}
    row |= {"verdict": answer.verdict, "effects": "+".join(answer.effects), "answer": "|".join(answer.answer_set)}
    return row | {"final": answer.final_verdict, "final_answer": "|".join(answer.rounds[-1].answer_set)}


def gather(tasks: list[Task], path: Path | None) -> pd.DataFrame:
    """All answers, those kept first; a process for each, since numbers are changed in it."""
    rows: list[dict[str, object]] = []
    if path is not None and path.is_file():
        rows = pd.read_csv(path, keep_default_na=False).to_dict("records")
    elif path is not None:
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    done = {(row["threshold"], float(str(row["factor"])), row["kind"], int(str(row["seed"]))) for row in rows}
    todo = [task for task in tasks if (*task[0], task[1], task[2]) not in done]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context, max_tasks_per_child=1) as pool:
        futures = [pool.submit(ask, task) for task in todo]
        for future in track(as_completed(futures), total=len(futures)):
            rows.append(future.result())
            if path is not None:
                with path.open("a", newline="", encoding="utf-8") as stream:
                    csv.DictWriter(stream, COLUMNS).writerow(rows[-1])
    return pd.DataFrame(rows, columns=list(COLUMNS), dtype=object).fillna("")


def differs(answers: pd.DataFrame) -> pd.Series:
    """Whether an answer is another than that of the numbers as they are."""
    parts = ["verdict", "effects", "answer", "final_answer"]
    as_it_is = answers[answers["threshold"] == AS_IT_IS[0]].set_index(["kind", "seed"])[parts]
    before = as_it_is.reindex(pd.MultiIndex.from_frame(answers[["kind", "seed"]]))
    return pd.Series((answers[parts].to_numpy() != before.to_numpy()).any(axis=1), index=answers.index)


def summary(answers: pd.DataFrame) -> pd.DataFrame:
    """A line for every change: error rates, and answers that differ from those of the numbers as they are."""
    judged = tables.judged(answers).assign(differs=differs(answers))
    lines = []
    for (name, factor), group in judged.groupby(["threshold", "factor"], sort=False):
        nulls, inside = group[group["null"]], group[group["hidden"].isin(tables.EFFECTS)]
        lines.append(
            {
                "threshold": name,
                "times": factor,
                "false alarms": f"{int(nulls['called'].sum())}/{len(nulls)}",
                "in the answer": f"{int(inside['right'].sum())}/{len(inside)}",
                "wrong names": int(group["wrong_name"].sum()),
                "faults as physics": int(group["fault_as_physics"].sum()),
                "failed": int((group["failed"] != "").sum()),
                "other answers": f"{int(group['differs'].sum())}/{len(group)}",
            }
        )
    return pd.DataFrame(lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--campaigns", type=int, default=1, help="seeds of each kind")
    parser.add_argument("--trials", type=int, default=18, help="of each campaign, at least its conditions once")
    parser.add_argument("--only", default="", help="comma-separated thresholds")
    parser.add_argument("--rows", type=Path, help="CSV that keeps every answer")
    given = parser.parse_args()
    names = given.only.split(",") if given.only else list(THRESHOLDS)
    list(map(holders, names))  # a name that is none is told before the first campaign
    changes: list[Change] = [AS_IT_IS, *((name, factor) for name in names for factor in FACTORS)]
    seeds = range(given.first_seed, given.first_seed + given.campaigns)
    kinds = given.kinds.split(",")
    tasks = [(change, kind, seed, given.trials) for change in changes for seed in seeds for kind in kinds]
    answers = gather(tasks, given.rows)
    print(summary(answers).to_string(index=False))
    for row in answers[differs(answers)].itertuples():
        answer = f"{row.verdict} {row.answer}, at the end {row.final} {row.final_answer} {row.failed}".rstrip()
        print(f"{row.threshold} times {row.factor}: {row.kind} {row.seed}: {answer}")


if __name__ == "__main__":
    main()
