"""The scoreboard: one table of everything that must not get worse.

    python benchmarks/scoreboard.py [--quick] [--only PATTERN] [--seeds work|final] [--rows FILE] [--against [FILE]]

Each row of the table has its number, a 95 % interval (Wilson for shares, bootstrap over units for medians), the number
of answers behind it and the processor seconds that they took. What is asked is in `scoreboard_units.py`. With `--rows`
every unit is kept as it comes, a line of JSON each; begun again, what is there is not asked again unless it broke, so a
file belongs to one state of the code. `--against` compares unit by unit with stored rows: which answers differ by more
than 1e-6, and which scores moved beyond chance (McNemar's exact test for shares, Wilcoxon's signed ranks for the rest,
p < 0.01). Seconds are compared in parts of a fixed piece of work that is timed beside each unit. `--repeat` asks every
unit with further seeds.

Seeds from 40000 are for working; from 41000 on for the final word, and nothing may be tuned on those. Recordings made
by others are read from the folder that VINETRACK_REAL_DATA names; without it their rows are skipped.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import numpy as np
from rich.progress import track
from scipy import stats
from scoreboard_units import GROUPS, REAL, Row, processor_s, yardstick_s

FIRST_SEED = {"work": 40_000, "final": 41_000}
STORED = Path(__file__).with_name("scoreboard_work.json")
CLEAR = 8.0  # standard deviations above which a hidden effect has to be found
SAME = 1e-6  # relative difference of numbers up to which two answers are the same
BEYOND_CHANCE = 0.01  # chosen: of some fifty rows, half of one moves by chance
Task = tuple[str, str, int]


@dataclass(frozen=True)
class Score:
    """A row of the table: what it takes of each answer (None leaves the answer out) and how it is summed up."""

    title: str
    groups: str
    of: Callable[[Row], object]
    how: str = "share"


def number(name: str) -> Callable[[Row], object]:
    """The entry of that name; None where there is none."""
    return lambda row: row.get(name)


def clear(judged: Callable[[Row], object], visible: str = "sigma") -> Callable[[Row], object]:
    """The same of what is visible enough to be found, None of the rest."""
    return lambda row: judged(row) if (row.get(visible) or 0.0) >= CLEAR else None


def either(row: Row) -> bool:
    """Both effects of a pair named, or said that there is more than one, or that none explains it."""
    return bool(row["all"]) or row["verdict"] == "unexplained" or row["final"] in ("unexplained", "ambiguous")


def holds(name: str) -> Callable[[Row], object]:
    """For each number of that name whether its interval holds the truth."""
    return lambda row: [bool(row[key]) for key in row if key[:3] in ("in|", "in ") and key[3:].split()[0] == name]


def sizes(row: Row) -> object:
    """For each hidden size whether its interval holds it, where the truth was visible and stood in the answer set."""
    return list(row["sizes"].values()) if row["right"] and (row["sigma"] or 0.0) >= CLEAR else None


def within(row: Row) -> object:
    """Whether the stated error of a track is right within a factor 1.5."""
    return None if math.isnan(row["sd"]) else 1 / 1.5 <= row["pull"] <= 1.5


def tracked(title: str, names: str) -> list[Score]:
    """The five rows of one set of recordings."""
    groups = f"tracking/{names}"
    return [
        Score(f"{title}: median SD, px", groups, number("sd"), "median"),
        Score(f"{title}: worst SD, px", groups, number("sd"), "worst"),
        Score(f"{title}: moving frames lost", groups, number("lost"), "sum"),
        Score(f"{title}: true over stated error, median", groups, number("pull"), "median"),
        Score(f"{title}: stated error right within a factor 1.5", groups, within),
    ]


SEVERAL = "pair/*|triple/*|outsider/*"
HIDDEN = "null/*|effect/*|pair/*|triple/*|outsider/*|other/*"
SIZE = ("package lines", "package files", "package constants", "package lines of other text", "test lines",
        "test files", "words of documentation")  # fmt: skip
SCORES: tuple[Score, ...] = (
    Score("nothing hidden: something is said to be missing", "null/*", number("called")),
    Score("one effect above 8 σ: detected", "effect/*", clear(number("called"))),
    Score("one effect above 8 σ: it stands in the answer set", "effect/*", clear(number("right"))),
    Score("one effect above 8 σ: size of the answer set, mean", "effect/*", clear(number("set_size")), "mean"),
    Score("any campaign: a wrong single name", HIDDEN, number("wrong_name")),
    Score("faults of the measurement taken for physics", "effect/*", number("fault_as_physics")),
    Score("pairs, lesser one above 8 σ: both found", "pair/*", clear(number("all"), "sigma_second")),
    Score("… or said to be more than one, or unexplained", "pair/*", clear(either, "sigma_second")),
    Score("triples, least one above 8 σ: all found", "triple/*", clear(number("all"), "sigma_second")),
    Score("triples: nothing named that is not there", "triple/*", number("none_invented")),
    Score("outsiders above 8 σ: unexplained", "outsider/*", clear(lambda row: row["verdict"] == "unexplained")),
    Score("pressure measured, bends, dropped frames: right or adequate where it should be", "other/*",
          lambda row: row["right"] or (not row["called"] and not row["hidden"])),
    Score("learned law: its variables not excluded", "learned/*", lambda row: bool(row.get("in_set"))),
    Score("learned force: points within 10 % but for B, n and P_y, median", "learned/*", number("within_beside"),
          "median"),
    Score("learned force: points in the 95 % band, median", "learned/*", number("covered"), "median"),
    Score("laboratories: right", "laboratory/*", number("right")),
    Score("laboratories: a wrong name alone", "laboratory/*", number("wrong_name")),
    Score("95 % intervals, laboratories: hold B, n and sizes", "laboratory/*", number("held"), "share of all"),
    Score("95 % intervals, hidden effects: hold the size", HIDDEN, sizes, "share of all"),
    *(Score(f"95 % intervals, two vines with chamber: hold {name}", "coverage/*", holds(name), "share of all")
      for name in ("n", "B", "P_y", "gamma")),
    *(Score(f"95 % intervals, 2 to 7 trials or drops: hold {name}", "few/*", holds(name), "share of all")
      for name in ("n", "B", "P_y", "C_D")),
    Score("demonstration: error of the lens, µm, median", "tracking/demonstration", number("lens_um"), "median"),
    Score("demonstration: error of places, µm, median", "tracking/demonstration", number("places_um"), "median"),
    *tracked("like the demonstration", "demo-like"), *tracked("hard presets", "hard *"),
    *tracked("another renderer", "other renderer"), *tracked("bent paths", "bent"),
    Score("long doors: axis off", "tracking/long door", number("askew")),
    Score("long doors: a sure point wrong", "tracking/long door", number("wrong")),
    Score("long doors: refused", "tracking/long door", number("refused")),
    Score("real ball: g, m/s²", "real/ball", number("value"), "value"),
    Score("real cups: C_D", "real/cups", number("value"), "value"),
    Score("real cups: the drag is named", "real/cups", lambda row: "air_drag" in row["named"]),
    Score("real growing vine: px a frame", "real/vine", number("value"), "value"),
    Score("real tubes: error of Eq. (2), mm", "real/tubes", number("value"), "value"),
    Score("real tubes: error of the trial left out, mm", "real/tubes", number("left_out_mm"), "value"),
    *(Score(f"one diagnosis, {title}: processor s, {how}", groups, number("diagnosis_s"), how)
      for title, groups in (("null", "null/*"), ("one effect", "effect/*"), ("outsider or several", SEVERAL))
      for how in ("median", "nine in ten")),
    Score("demonstration, filming: processor s", "whole run/demonstration", number("film_s"), "value"),
    Score("demonstration, 24 recordings to a report: processor s", "whole run/demonstration", number("run_s"), "value"),
    Score("100 tracks to a report: processor s", "whole run/many tracks", number("all_s"), "value"),
    Score("100 tracks to a report: peak memory, MB", "whole run/many tracks", number("peak_mb"), "value"),
    Score("mutations: caught", "mutations/*", number("caught")),
    *(Score(name, "size/*", number(name), "value") for name in SIZE),
)  # fmt: skip


def key_of(task: Task) -> str:
    """`group/name/seed`."""
    return "/".join(map(str, task))


def tasks_of(quick: bool, pattern: str, first_seed: int, repeat: int) -> list[Task]:
    """What to ask, the most important first; with `repeat` the same again with further seeds."""
    tasks: list[Task] = []
    for group, units in GROUPS.items():
        count = Counter()
        for name in units.names[: units.quick if quick else units.whole] * repeat:
            tasks.append((group, name, first_seed + count[name]))
            count[name] += 1
    return [task for task in tasks if any(fnmatchcase("/".join(task[:2]), f"*{one}*") for one in pattern.split(","))]


def rounded(value: object) -> object:
    """The same with plain numbers of nine digits."""
    if isinstance(value, Mapping):
        return {str(key): rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(one) for one in value]
    if isinstance(value, bool | np.bool_ | None):
        return None if value is None else bool(value)
    if isinstance(value, int | float | np.number):
        return float(f"{value:.9g}") if not isinstance(value, int | np.integer) else int(value)
    return str(value)


def asked(task: Task, known: tuple[float, float] | None) -> Row:
    """One unit of work with its cost; one that breaks says so."""
    group, name, seed = task
    unit: Row = {"unit": key_of(task), "yardstick_s": yardstick_s()}
    begun = processor_s()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            unit["answers"] = GROUPS[group].ask(name, seed, Path(folder), known)
        except (Exception, SystemExit) as error:
            unit |= {"answers": [], "failed": f"{type(error).__name__}: {error}"[:300]}
    unit["yardstick_s"] = (unit["yardstick_s"] + yardstick_s()) / 2
    return rounded(unit | {"processor_s": processor_s() - begun})


def gathered(tasks: list[Task], visible: Mapping[str, tuple[float, float]], processes: int) -> Iterator[Row]:
    """All units as they come. Where a process dies, those it takes along are asked once more, each by itself."""
    context, left = multiprocessing.get_context("spawn"), []
    if any(group in ("tracking", "whole run") for group, *_ in tasks):
        # A renderer that is compiled in this process rounds otherwise than one that was compiled and kept before.
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            pool.submit(asked, ("tracking", "hard door", 1), None).result()
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        futures = {pool.submit(asked, task, visible.get(key_of(task))): task for task in tasks}
        for future in track(as_completed(futures), total=len(futures)):
            try:
                yield future.result()
            except BrokenProcessPool:
                left.append(futures[future])
    for task in left:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            try:
                yield pool.submit(asked, task, visible.get(key_of(task))).result()
            except BrokenProcessPool:
                yield {"unit": key_of(task), "answers": [], "failed": "the process died", "processor_s": 0.0}


def read_rows(path: Path | None) -> dict[str, Row]:
    """Stored units by key: lines of JSON, or one JSON list."""
    if path is None or not path.is_file():
        return {}
    text = path.read_text(encoding="utf-8")
    units = json.loads(text) if text.startswith("[") else [json.loads(line) for line in text.splitlines()]
    return {unit["unit"]: unit for unit in units}


def visibilities(units: Mapping[str, Row]) -> dict[str, tuple[float, float]]:
    """How visible the truth of each campaign was, which is a property of the campaign."""
    answers = {key: unit["answers"][0] for key, unit in units.items() if unit["answers"]}
    return {key: (row["sigma"], row["sigma_second"]) for key, row in answers.items() if row.get("sigma") is not None}


def taken(score: Score, units: Mapping[str, Row]) -> dict[str, list[float]]:
    """What a score takes of each unit's answers."""
    found: dict[str, list[float]] = {}
    for key, unit in units.items():
        if not any(fnmatchcase(key.rpartition("/")[0], pattern) for pattern in score.groups.split("|")):
            continue
        values = [score.of(row) for row in unit["answers"]]
        flat = [one for value in values for one in (value if isinstance(value, list) else [value])]
        found[key] = [float(one) for one in flat if one is not None and not math.isnan(one)]
    return {key: values for key, values in found.items() if values}


SUMMARIES: dict[str, Callable[[np.ndarray], float]] = {
    "mean": np.mean,
    "median": np.median,
    "nine in ten": lambda values: np.quantile(values, 0.9),
    "worst": np.max,
    "sum": np.sum,
    "value": np.mean,
}


def share_of(score: Score) -> bool:
    """Whether a row counts yes and no."""
    return score.how.startswith("share")


def summed_up(score: Score, values: np.ndarray) -> tuple[str, str]:
    """The number of a row and its 95 % interval, in words."""
    if share_of(score):
        result = stats.binomtest(int(values.sum()), values.size).proportion_ci(0.95, "wilson")
        return f"{values.sum():.0f}/{values.size}", f"{100 * result.low:.1f}–{100 * result.high:.1f} %"
    summary = SUMMARIES[score.how]
    said = f"{float(summary(values)):.5g}"
    if score.how not in ("mean", "median", "nine in ten") or values.size < 3:
        return said, ""
    draws = np.random.default_rng(1).integers(values.size, size=(2000, values.size))
    low, high = np.quantile([summary(values[draw]) for draw in draws], (0.025, 0.975))
    return said, f"{low:.4g}–{high:.4g}"


def table_lines(units: Mapping[str, Row]) -> Iterator[str]:
    """The table, as Markdown."""
    yield "| | | 95 % interval | answers | seeds | processor s |\n|---|---|---|---|---|---|"
    for score in SCORES:
        found = taken(score, units)
        if not found:
            continue
        values = np.concatenate(list(found.values()))
        said, interval = summed_up(score, values)
        if score.how == "value" and (own := units[next(iter(found))]["answers"][0]).get("low") is not None:
            interval = f"{own['low']:.5g}–{own['high']:.5g}"
        seeds = sorted({int(key.rpartition("/")[2]) for key in found})
        spent = sum(units[key]["processor_s"] for key in found)
        span = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]}–{seeds[-1]}"
        yield f"| {score.title} | {said} | {interval} | {values.size} | {span} | {spent:.0f} |"


def differences(before: object, after: object, place: str = "") -> Iterator[str]:
    """Where two answers differ, by more than 1e-6 where they are numbers; seconds and memory are not compared."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for name in sorted({*before, *after}):
            if not name.endswith(("_s", "seconds", "_mb")) and name not in ("sigma", "sigma_second"):
                yield from differences(before.get(name), after.get(name), f"{place} {name}".strip())
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for k, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(one, other, f"{place}[{k}]")
    elif isinstance(before, float) and isinstance(after, float | int) and not isinstance(after, bool):
        if not (math.isclose(before, after, rel_tol=SAME, abs_tol=1e-12) or (math.isnan(before) and math.isnan(after))):
            yield f"{place} {before:.7g} → {after:.7g}"
    elif before != after:
        yield f"{place} {before} → {after}"


def compared(before: Mapping[str, Row], after: Mapping[str, Row]) -> Iterator[str]:
    """Every unit whose answers differ, then the scores that moved, on the units that both have."""
    both = [key for key in before if key in after]
    gaps = {key: list(differences(before[key]["answers"], after[key]["answers"])) for key in both}
    different = [key for key in both if gaps[key] and not key.startswith("size/")]
    same = "identical" if not different else f"{len(both) - len(different)} identical"
    yield f"{len(both)} units in both: {same} (numbers to {SAME:g})"
    for key in different:
        failed = after[key].get("failed") or before[key].get("failed")
        shown = "; ".join(gaps[key][:4]) + (f"; {len(gaps[key]) - 4} more" if len(gaps[key]) > 4 else "")
        yield f"- {key}: {failed or shown}"
    yield "\n| | before | after | p | |\n|---|---|---|---|---|"
    for score in SCORES:
        old, new = (taken(score, {key: units[key] for key in both}) for units in (before, after))
        paired = [key for key in old if key in new and len(old[key]) == len(new[key])]
        if not paired:
            continue
        timed = "processor s" in score.title
        first, second = (
            np.concatenate([np.array(one[key]) / (units[key]["yardstick_s"] if timed else 1) for key in paired])
            for one, units in ((old, before), (new, after))
        )
        p = chance(score, first, second)
        moved = "" if np.allclose(first, second, rtol=SAME, atol=0) else "moved" if p < BEYOND_CHANCE else "by chance"
        said = (summed_up(score, values)[0] + (" yardsticks" if timed else "") for values in (first, second))
        shown = f"{p:.2g}" if math.isfinite(p) else ""
        yield f"| {score.title} | {' | '.join(said)} | {shown} | {'differs' if moved and not shown else moved} |"


def chance(score: Score, before: np.ndarray, after: np.ndarray) -> float:
    """Probability of so large a change of paired answers by chance; NaN where one pair cannot tell."""
    if share_of(score):
        lost, won = int(((before == 1) & (after == 0)).sum()), int(((before == 0) & (after == 1)).sum())
        return float(stats.binomtest(lost, lost + won).pvalue) if lost + won else 1.0
    if before.size < 2 or score.how == "value":
        return math.nan
    return float(stats.wilcoxon(after - before).pvalue) if (before != after).any() else 1.0


def stored(units: Iterable[Row]) -> str:
    """Units as one JSON list, a unit a line."""
    lines = [json.dumps(unit, ensure_ascii=False, separators=(",", ":")) for unit in units]
    return "[\n" + ",\n".join(lines) + "\n]\n"


def main() -> None:
    """Ask what is not yet there, print the table and what has moved."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten minutes on two cores, for every day")
    parser.add_argument("--seeds", choices=list(FIRST_SEED), default="work")
    parser.add_argument("--only", default="*", help="of group/name, comma-separated; * as in names of files")
    parser.add_argument("--repeat", type=int, default=1, help="so many seeds in place of each")
    parser.add_argument("--rows", type=Path, help="file that keeps every unit as it comes")
    parser.add_argument("--store", type=Path, help="write all units there, as one JSON list")
    parser.add_argument("--against", type=Path, nargs="?", const=STORED, help=f"rows to compare with ({STORED.name})")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    tasks = tasks_of(given.quick, given.only, FIRST_SEED[given.seeds], given.repeat)
    before, kept = read_rows(given.against), read_rows(given.rows)
    kept = {key: unit for key, unit in kept.items() if not unit.get("failed")}
    visible = visibilities(read_rows(STORED)) | visibilities(before)
    begun = time.perf_counter()
    for unit in gathered([task for task in tasks if key_of(task) not in kept], visible, given.processes):
        kept[unit["unit"]] = unit
        if given.rows:
            with given.rows.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(unit, ensure_ascii=False) + "\n")
    units = {key: kept[key] for key in map(key_of, tasks) if key in kept}
    print("\n".join(table_lines(units)))
    spent = sum(unit["processor_s"] for unit in units.values())
    yardstick = np.median([unit["yardstick_s"] for unit in units.values() if "yardstick_s" in unit])
    print(f"\n{len(units)} units, {spent:.0f} processor seconds, {time.perf_counter() - begun:.0f} s now; ", end="")
    print(f"one yardstick is {1e3 * yardstick:.1f} ms")
    if not REAL:
        print("Skipped, since VINETRACK_REAL_DATA is not set: recordings made by others")
    for unit in units.values():
        if unit.get("failed"):
            print(f"! {unit['unit']}: {unit['failed']}")
    if given.store:
        given.store.write_text(stored(units.values()), encoding="utf-8")
    if given.against:
        print("\n" + "\n".join(compared(before, units)))


if __name__ == "__main__":
    main()
