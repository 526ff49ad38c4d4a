"""The section of the report on the diagnosis: candidates, upper limits, tied candidates, the next trial, drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vinetrack.core.units import display_unit, interval, number, with_error
from vinetrack.diagnosis.result import ADEQUATE, NOT_TESTABLE, REFITTED, VERDICTS, Candidate, Diagnosis, Round
from vinetrack.experiment.schema import LIMITED
from vinetrack.figures.diagnosis_figures import TIED_COSINE
from vinetrack.inference.fit_result import Number
from vinetrack.narrative.diagnosis_text import PREFERRED
from vinetrack.narrative.power_text import POWER_COLUMNS, could_have_seen, false_alarm_sentence, power_rows
from vinetrack.narrative.verdict_text import (
    estimates_text,
    is_finite,
    listed_names,
    quantity_text,
    spaced_name,
    summary_facts,
    verdict_meaning,
    verdict_sentence,
)
from vinetrack.report.section import ReportTable

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.power import Power


ABOUT_SIGMA = (
    "● in the answer set. Δχ² is relative to the noise of the tracks alone; σ also accounts for disagreement between "
    "trials: for a fitted candidate it is √Δχ² or less."
)


ABOUT_POWER = (
    "By linear theory, with the noise and scatter of the fit, given all effects of the last model. Power there: at the "
    "largest plausible size. Mistaken for: the other candidates with the highest score, at the size of 90 % power."
)


@dataclass(frozen=True)
class DiagnosisResult:
    """The diagnosis, with the errors, parameters and damping laws of its models; None for parts that do not exist.
    `summaries` describes each effect in a sentence; `units` has symbol and unit by `effect.parameter`.
    """

    diagnosis: Diagnosis
    ladder: pd.DataFrame | None = None
    moved: pd.DataFrame | None = None
    laws: pd.DataFrame | None = None
    summaries: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def diagnosis_section(result: DiagnosisResult | None) -> dict[str, Any] | None:
    """Return the section on the diagnosis as text for the template; None if there is no diagnosis."""
    if result is None:
        return None
    diagnosis = result.diagnosis
    drifting = [str(row["sentence"]) for row in diagnosis.drift if row.get("sentence") and row.get("significant", True)]
    return {
        "badge": diagnosis.verdict if diagnosis.verdict in VERDICTS else "not diagnosed",
        "kind": diagnosis.verdict if diagnosis.verdict in VERDICTS else "none",
        "sentence": verdict_sentence(diagnosis),
        "meaning": verdict_meaning(diagnosis),
        "summaries": [
            result.summaries[name] for name in diagnosis.effects or diagnosis.answer_set if name in result.summaries
        ],
        "facts": summary_facts(diagnosis, result.ladder),
        "explanation": diagnosis.explanation,
        "ladder": ladder_table(result.ladder),
        "where": [line for line in diagnosis.where if line not in drifting],
        "force": missing_force(diagnosis.missing_force),
        "rounds": [
            {"table": ranking_table(entry), "blind": _not_testable(entry.ranking), "of": entry}
            for entry in diagnosis.rounds
        ],
        # Upper limits are valid only if no effect is missing.
        "hidden": upper_limit_table(
            diagnosis.rounds[-1].ranking if diagnosis.final_verdict == ADEQUATE else (), result.units
        ),
        "power": power_entry(diagnosis.power),
        "tied": tied_pairs(diagnosis.rounds[0]) if diagnosis.rounds else [],
        "next": next_experiment(diagnosis.next_experiment),
        "drift": drifting,
        "moved": moved_table(result.moved),
        "laws": law_table(result.laws),
        "notes": list(diagnosis.notes),
    }


def ladder_table(ladder: pd.DataFrame | None) -> ReportTable:
    """Return the errors of every model of `ladder.csv`, mm."""
    keys = ("rms_in_sample_m", "rms_left_out_m", "rms_highest_pressure_m", "floor_m", "excess_left_out_m")
    head = (
        "Model",
        "in sample (mm)",
        "conditions left out (mm)",
        "highest pressure left out (mm)",
        "replicates (mm)",
        "excess on left out (mm)",
    )
    rows = [
        (_step(str(row["added"] or ""), row.get("partial")), *(number(1e3 * float(row[key])) for key in keys))
        for row in ([] if ladder is None else ladder.to_dict("records"))
    ]
    note = (
        "Root mean square error of position. Left out: every condition is predicted by the model fitted to all others; "
        "every vine's highest pressure by the model fitted to all lower ones. Excess: √(rms² − replicates²). Partial: "
        "a step that explains part of a misfit that nothing explains in full; it is not claimed to be missing."
    )
    return ReportTable("The numbers of the ladder", head, rows, frozenset(range(1, len(head))), note)


def _step(added: str, partial: object = False) -> str:
    mark = " (partial)" if partial in (True, "True") else ""
    return f"+ {listed_names(added.split('+'))}{mark}" if added else "initial model"


def ranking_table(entry: Round) -> ReportTable:
    """Return the candidates of a round that could be tested."""
    head = ("Candidate", "kind", "Δχ²", "σ", "size", "status", "")
    rows = [
        (
            ("● " if row.in_answer_set else "") + spaced_name(row.effect),
            row.kind,
            number(row.delta_chi2),
            number(row.sigma, 2),
            estimates_text(row) or "–",
            "fitted" if row.status == REFITTED else "predicted",
            "; ".join(part for part in ("" if row.plausible else "not plausible", str(row.reason)) if part),
        )
        for row in entry.ranking
        if row.status != NOT_TESTABLE
    ]
    return ReportTable("", head, rows, frozenset({2, 3}), ABOUT_SIGMA)


def upper_limit_table(ranking: Sequence[Candidate], units: Mapping[str, tuple[str, str]]) -> ReportTable:
    """Return one-sided 95 % upper limits on the size of every candidate of a ranking; `units` as in the result."""
    rows = []
    for row in ranking:
        of = {entry.key.split(".")[-1]: (entry.symbol, entry.unit) for entry in row.numbers}
        for name, largest in row.largest.items():
            if not is_finite(largest):
                continue
            short = name.split(".")[-1]
            symbol, unit = of.get(short) or units.get(f"{row.effect}.{short}") or (short, "SI")
            shown, factor = display_unit(unit)
            rows.append((spaced_name(row.effect), symbol, f"{number(factor * largest)} {shown}".strip()))
    note = (
        "Larger sizes contradict these trials (95 %, one-sided; of the sign with the larger limit). Sizes that would "
        "have been detected are larger; they are given with the verdict."
    )
    return ReportTable(
        "Upper limits on undetected effects", ("Candidate", "number", "limit"), rows, frozenset({2}), note
    )


def power_entry(power: Power | None) -> dict[str, Any] | None:
    """Return what the trials could have detected, for the template: sentences and a table of sizes; None if unknown."""
    if power is None:
        return None
    order = [] if power.wary else sorted(power.effects, key=lambda entry: -entry.probability_at(entry.largest))
    head = ("Effect", "number", *POWER_COLUMNS[2:])
    table = ReportTable("", head, power_rows(order), frozenset({2, 3, 4, 5}), ABOUT_POWER)
    return {"sentences": [false_alarm_sentence(power), *could_have_seen(power)], "table": table}


def _not_testable(ranking: Sequence[Candidate]) -> list[str]:
    """Candidates without an observable effect under these conditions, each with the reason."""
    return [
        f"{spaced_name(row.effect)}: {row.reason or 'no reason given'}" for row in ranking if row.status == NOT_TESTABLE
    ]


def tied_pairs(entry: Round) -> list[str]:
    """Return the pairs of candidates with nearly proportional effects on the trajectories, largest cosine first."""
    names, matrix = entry.cosine_names, entry.cosines
    pairs = [
        (abs(matrix[i][j]), names[i], names[j], matrix[i][j])
        for i in range(len(matrix))
        for j in range(i)
        if is_finite(matrix[i][j]) and abs(matrix[i][j]) >= TIED_COSINE
    ]
    return [
        f"{spaced_name(b)} and {spaced_name(a)} (cosine {number(value)})"
        for _, a, b, value in sorted(pairs, reverse=True)
    ]


def next_experiment(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the next experiment for the template: text, trials, and the expected significances; None for none."""
    if not content:
        return None
    trials = [dict(trial) for trial in content.get("trials") or []]
    keys = ("replicates", *LIMITED["range"], *(name for name in LIMITED["choice"] if name != "growth_angle_deg"))
    shown = [key for key in keys if any(is_finite(trial.get(key)) for trial in trials)]
    head = [{"replicates": "trials"}.get(key, key.rpartition("_")[0] + f" ({key.rpartition('_')[2]})") for key in shown]
    rows = [
        [number(trial.get(key)) if key != "replicates" else str(trial.get(key)) for key in shown] for trial in trials
    ]
    simulated = content.get("simulated_sigma") or {}
    separations = [
        (
            " from ".join(spaced_name(part.strip()) for part in str(pair).split("|")),
            number(sigma, 2),
            _simulated(simulated.get(pair) or {}),
        )
        for pair, sigma in (content.get("separation_sigma") or {}).items()
    ]
    return {
        "text": str(content.get("text") or ""),
        "trials": ReportTable("", head, rows if head else (), frozenset(range(len(head)))),
        "separations": ReportTable(
            "", ("They separate", "by (σ)", "in simulation (σ)"), separations, frozenset({1, 2})
        ),
        "calibration": str(content.get("calibration") or ""),
    }


def _simulated(entry: Mapping[str, Any]) -> str:
    if not is_finite(entry.get("mean")):
        return "–"
    return f"{number(entry['mean'], 2)} ± {number(entry.get('sd'), 1)}"


def missing_force(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the missing force for the template: sentences, weights and simple laws; None for none."""
    if not content:
        return None
    rows = [
        (
            str(law.get("words") or law.get("law") or ""),
            f"{100 * float(law['explained']):.0f} %" if is_finite(law.get("explained")) else "–",
            with_error(law.get("amplitude_N"), law.get("sigma_N")),
        )
        for law in content.get("laws") or []
    ]
    head = ("Simple law", "explains of the missing force", "size (N)")
    learned = content.get("learned") or {}
    weights = [
        (" and ".join(name.split("+")), f"{100 * float(weight):.1f} %")
        for name, weight in (learned.get("weights") or {}).items()
    ]
    return {
        "sentence": str(content.get("sentence") or content.get("text") or ""),
        "laws": ReportTable("Simple laws that resemble it", head, rows, frozenset({1, 2})),
        "learned": str(learned.get("sentence") or ""),
        "weights": ReportTable(
            "Variables of the learned force", ("Variables", "posterior weight"), weights, frozenset({1})
        ),
    }


def moved_table(moved: pd.DataFrame | None) -> ReportTable:
    """Return the change of the parameters as effects were added, one column per model."""
    entries = [] if moved is None else moved.fillna({"vine": "", "added": ""}).to_dict("records")
    cells: dict[tuple[str, str], dict[str, str]] = {}
    titles: dict[tuple[str, str], str] = {}
    for entry in entries:
        key = (str(entry["parameter"]), str(entry["vine"]))
        fitted = Number.from_json({str(k): v for k, v in entry.items()})
        titles[key] = fitted.title
        cells.setdefault(key, {})[str(entry["added"])] = quantity_text(fitted)
    steps = list(dict.fromkeys(str(entry["added"]) for entry in entries))
    head = ["Parameter", *map(_step, steps)]
    rows = [[titles[key], *(cells[key].get(step, "–") for step in steps)] for key in cells]
    return ReportTable("Parameters of every model", head, rows, frozenset(range(1, len(head))))


def law_table(laws: pd.DataFrame | None) -> ReportTable | None:
    """Return the damping law from steady speeds with the pressure at the vine in each model; None without laws."""
    if laws is None or not len(laws):
        return None
    chosen = laws[laws["method"] == PREFERRED] if (laws["method"] == PREFERRED).any() else laws
    first = set(str(chosen["model"].iloc[0]).split("+"))
    rows = []
    for entry in chosen.to_dict("records"):
        added = [name for name in str(entry["model"]).split("+") if name not in first]
        bounds = {key: [entry[f"{key}_low_95"], entry[f"{key}_high_95"]] for key in ("n", "B")}
        row = (_step("+".join(added)), str(entry["vine"]), number(entry["n"], 4), interval(bounds["n"]))
        rows.append((*row, number(entry["B"], 4), interval(bounds["B"]), f"{entry['n_trials']:.0f}"))
    head = ("Model", "Vine", "n", "95 %", "B, N·(s/m)ⁿ", "95 %", "Trials")
    note = "From steady speeds, as in the section on the damping law, with the pressure at the vine in each model."
    return ReportTable(
        "The damping law with the pressure of every model", head, rows, frozenset(range(2, len(head))), note
    )
