"""Rows of answers → the tables that a person reads."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pandas as pd

from hidden.kinds import EFFECTS, INTERRUPTED, MEASUREMENT

FAULTS = {*MEASUREMENT, "dropped_frames"}
SIGMA_BINS = (0, 3, 5, 8, 15, 40, math.inf)
CLEAR = 8.0


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with what every answer was worth.

    `called` something is said to be missing; `right` the truth, or the first of two, stands in the answer set;
    `wrong_name` one single effect is named, and it is not there; `fault_as_physics` a fault of the measurement is
    hidden and the answer is physics only.
    """
    words = ["hidden", "effects", "answer", "final", "final_answer"]
    out = rows.assign(**{name: rows[name].astype(object).where(rows[name].notna(), "") for name in words})
    truth = [set(filter(None, text.split("+"))) for text in out["hidden"]]
    answer = [set(filter(None, text.split("|"))) for text in out["answer"]]
    out["null"] = out["hidden"] == ""
    out["pair"] = [len(one) == 2 for one in truth]
    out["triple"] = [len(one) > 2 for one in truth]
    out["called"] = out["verdict"] != "adequate"
    out["set_size"] = [len(one) for one in answer]
    out["right"] = [bool(one & all_) for one, all_ in zip(truth, answer, strict=True)]
    out["wrong_name"] = [
        len(all_) == 1 and not all_ <= one and verdict in ("missing", "artefact")
        for one, all_, verdict in zip(truth, answer, out["verdict"], strict=True)
    ]
    out["fault_as_physics"] = [
        bool(one) and one <= FAULTS and verdict in ("missing", "ambiguous") and not all_ & FAULTS
        for one, all_, verdict in zip(truth, answer, out["verdict"], strict=True)
    ]
    out["physics_as_fault"] = [
        bool(one) and not one & FAULTS and verdict == "artefact"
        for one, verdict in zip(truth, out["verdict"], strict=True)
    ]
    return out


def visible(rows: pd.DataFrame) -> pd.DataFrame:
    """How visible each campaign's truth is, from the package's rows, beside the rows of every method."""
    known = rows[rows["method"] == "vinetrack"].set_index(["kind", "seed"])
    known = known[~known.index.duplicated()]
    keys = pd.MultiIndex.from_frame(rows[["kind", "seed"]])
    return rows.assign(**{name: known[name].reindex(keys).to_numpy() for name in ("sigma", "sigma_second")})


def tied_sizes(rows: pd.DataFrame) -> pd.Series:
    """How many hypotheses the data leave tied, from exhaustive refits (the rows of `bic`), by kind and seed."""
    known = rows[(rows["method"] == "bic") & (rows["tied"].notna() & (rows["tied"] != ""))]
    return known.set_index(["kind", "seed"])["tied"].astype(str).str.split("|").str.len()


def surplus(rows: pd.DataFrame) -> float:
    """By how many names answer sets are larger, in the mean, than what the data leave tied; NaN where not known."""
    tied = tied_sizes(rows)
    own = singles(rows[(rows["method"] == "vinetrack") & (rows["set_size"] > 0)])
    own = own[own["sigma"] >= CLEAR].set_index(["kind", "seed"])["set_size"]
    return float((own - tied).dropna().mean())


def left_out(rows: pd.DataFrame) -> pd.DataFrame:
    """Errors on left-out conditions in parts of the true model's, before and after, where effects were added."""
    known = rows[(rows["method"] == "left_out") & rows["left_out_after"].notna() & (rows["sigma"] >= CLEAR)]
    names = {"left_out_before": "base model", "left_out_after": "effects added"}
    return pd.DataFrame(
        [
            {"model": names[name], "n": len(known), "median": known[name].median(), "90 %": known[name].quantile(0.9)}
            for name in names
        ]
    )


def share(values: pd.Series) -> str:
    """Share with its count."""
    return f"{100 * values.mean():.0f} % of {len(values)}" if len(values) else "–"


def false_alarms(rows: pd.DataFrame) -> pd.DataFrame:
    """By regime of null campaigns: how often something was said to be missing, and what."""
    nulls = rows[rows["null"]]
    lines = []
    for kind, group in [*nulls.groupby("kind"), ("all", nulls)]:
        alarms = group[group["called"]]
        said = alarms["verdict"] + ":" + alarms["answer"]
        lines.append(
            {"regime": kind, "campaigns": len(group), "alarms": len(alarms), "said": ", ".join(sorted(said)[:6])}
        )
    return pd.DataFrame(lines)


def singles(rows: pd.DataFrame) -> pd.DataFrame:
    """One hidden effect of the catalogue."""
    return rows[rows["hidden"].isin({*EFFECTS, *INTERRUPTED, "dropped_frames"})]


def by_effect(rows: pd.DataFrame) -> pd.DataFrame:
    """Detection by effect and by how visible it was; above 8 σ whether the truth stands in the answer set."""
    lines = []
    alone = singles(rows)
    for name, group in [*alone.groupby("hidden"), ("all", alone)]:
        line: dict[str, object] = {"effect": name}
        for low, high in itertools.pairwise(SIGMA_BINS):
            inside = group[(group["sigma"] >= low) & (group["sigma"] < high)]
            label = f"{low}–{high:g} σ" if math.isfinite(high) else f"> {low} σ"
            line[label] = f"{inside['called'].sum()}/{len(inside)}" if len(inside) else ""
        clear = group[group["sigma"] >= CLEAR]
        line |= {
            "in set > 8 σ": f"{clear['right'].sum()}/{len(clear)}",
            "mean set": f"{clear.loc[clear['set_size'] > 0, 'set_size'].mean():.2f}",
            "wrong names": int(group["wrong_name"].sum()),
        }
        lines.append(line)
    return pd.DataFrame(lines)


def headline(rows: pd.DataFrame) -> pd.DataFrame:
    """The bar, a line each, a column a method."""
    lines = {}
    for method, group in rows.groupby("method", sort=False):
        alone, nulls = singles(group), group[group["null"]]
        clear = alone[alone["sigma"] >= CLEAR]
        pairs = group[group["pair"] & (group["sigma_second"] >= CLEAR)]
        triples = group[group["triple"]]
        clear_triples = triples[triples["sigma_second"] >= CLEAR]
        outside = group[group["is_outsider"].astype(bool) & (group["sigma"] >= CLEAR)]
        faults = group[group["hidden"].map(lambda text: bool(text) and set(text.split("+")) <= FAULTS)]
        lines[method] = {
            "false alarms on null campaigns": share(nulls["called"]),
            "detected, above 8 σ": share(clear["called"]),
            "truth in the answer set, above 8 σ": share(clear["right"]),
            "mean size of the set, above 8 σ": f"{clear.loc[clear['set_size'] > 0, 'set_size'].mean():.2f}",
            "wrong single name, all campaigns": share(group["wrong_name"]),
            "faults of the measurement taken for physics": share(faults["fault_as_physics"]),
            "physics taken for a fault, above 8 σ": share(clear[~clear["hidden"].isin(FAULTS)]["physics_as_fault"]),
            "pairs, lesser one above 8 σ: both found, in order": share(_both(pairs)),
            "… or said to be more than one, or unexplained": share(_more(pairs)),
            "three effects, the least above 8 σ: all in the set": share(_both(clear_triples)),
            "three effects: nothing named that is not there": share(_none_invented(triples)),
            "outsiders above 8 σ called unexplained": share(outside["verdict"] == "unexplained"),
            "… of those with 8 σ left after the best answer": share(_left(outside)["verdict"] == "unexplained"),
            "seconds, median and 90 %": _seconds(group["seconds"]),
            "… of processor time": _seconds(group["processor_s"]),
        }
    return pd.DataFrame(lines)


def _left(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["sigma_left"] >= CLEAR] if "sigma_left" in rows else rows


def _seconds(values: pd.Series) -> str:
    return f"{values.median():.1f}, {values.quantile(0.9):.1f}"


def _found(row: pd.Series) -> set[str]:
    """Every effect that an answer names: those added, and an only one that the last round is left with."""
    last = set(str(row["final_answer"]).split("|")) if row.get("final_answer") else set()
    return set(filter(None, str(row["effects"]).split("+"))) | last


def _both(pairs: pd.DataFrame) -> pd.Series:
    return pairs.apply(lambda row: set(row["hidden"].split("+")) <= _found(row), axis=1).astype(bool)


def _none_invented(rows: pd.DataFrame) -> pd.Series:
    """Whether every effect that is named alone is there: those added, and the answer of the last round if it is one."""

    def true(row: pd.Series) -> bool:
        last = list(filter(None, str(row["final_answer"]).split("|")))
        named = {*filter(None, str(row["effects"]).split("+")), *(last if len(last) == 1 else [])}
        return named <= set(row["hidden"].split("+"))

    return rows.apply(true, axis=1).astype(bool)


def _more(pairs: pd.DataFrame) -> pd.Series:
    def more(row: pd.Series) -> bool:
        named = set(row["hidden"].split("+")) <= _found(row)
        return named or row["verdict"] == "unexplained" or row.get("final", "") in ("unexplained", "ambiguous")

    return pairs.apply(more, axis=1).astype(bool)


def coverage(rows: pd.DataFrame) -> pd.DataFrame:
    """How often 95 % intervals of sizes hold the truth, where the truth was in the answer set and above 8 σ."""
    sizes = []
    for row in rows[(rows["method"] == "vinetrack") & rows["right"] & (rows["sigma"] >= CLEAR)].itertuples():
        sizes += [(*one, row.pair or row.triple) for one in json.loads(row.sizes)]
    table = pd.DataFrame(sizes, columns=["parameter", "truth", "value", "low", "high", "interval", "pair"])
    if table.empty:
        return table
    table["in"] = (table["low"] <= table["truth"]) & (table["truth"] <= table["high"])
    table["z"] = (table["value"] - table["truth"]) / ((table["high"] - table["low"]) / 3.92)
    lines = []
    for name, group in [*table.groupby("parameter"), ("all", table)]:
        lines.append(
            {
                "parameter": name,
                "n": len(group),
                "covered": f"{100 * group['in'].mean():.0f} %",
                "median z": f"{group['z'].median():+.2f}",
                "robust sd of z": f"{1.4826 * np.median(np.abs(group['z'] - group['z'].median())):.2f}",
            }
        )
    return pd.DataFrame(lines)


def confusion(rows: pd.DataFrame) -> pd.DataFrame:
    """What was hidden against what was said, above 8 σ (all null campaigns)."""
    some = rows[rows["null"] | (rows["sigma"] >= CLEAR) | (rows["hidden"] == "dropped_frames")].copy()
    hidden = some["hidden"].where(~some["is_outsider"].astype(bool), "outsider: " + some["hidden"])
    some["truth"] = hidden.where(some["hidden"] != "", "nothing")
    some["said"] = some.apply(_said, axis=1)
    return some.groupby(["truth", "said"]).size().rename("n").reset_index()


def _said(row: pd.Series) -> str:
    if row["verdict"] in ("adequate", "unexplained"):
        return str(row["verdict"])
    names = str(row["answer"]).split("|")
    truth = set(str(row["hidden"]).split("+"))
    if len(names) > 1:
        return ("set with it" if truth & set(names) else "set without it") + f" of {len(names)}"
    then = _found(row) - set(names)
    return names[0] + (f", then {'+'.join(sorted(then))}" if then else "")


def confusion_lines(table: pd.DataFrame) -> list[str]:
    """A line for each truth, the commonest answer first."""
    lines = []
    for truth, group in table.groupby("truth"):
        said = group.sort_values("n", ascending=False)
        answers = [f"{row.said} {row.n}" for row in said.itertuples()]
        lines.append(f"{truth:36s} {group['n'].sum():4d}  " + "; ".join(answers))
    return lines
