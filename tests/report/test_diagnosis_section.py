"""The section on the diagnosis, for every verdict, for a refused diagnosis, and without one."""

from __future__ import annotations

import re
from dataclasses import replace

import pandas as pd
import pytest
from hand_diagnosis import VERDICTS, candidate, diagnosis, ladder, laws, moved, next_experiment, number, refused
from test_report import EVIL, SVG, Tags, page

from vinetrack.diagnosis.power import PROBABILITIES, EffectPower, Power
from vinetrack.diagnosis.result import Candidate, Diagnosis, Round
from vinetrack.figures.registry import diagnosis_figures
from vinetrack.inference.fit_result import Number
from vinetrack.narrative import verdict_text
from vinetrack.narrative.verdict_text import Fact, listed_names
from vinetrack.report.build import ReportFigure
from vinetrack.report.diagnosis_section import (
    DiagnosisResult,
    diagnosis_section,
    law_table,
    moved_table,
    tied_pairs,
    upper_limit_table,
)
from vinetrack.report.diagnosis_section import next_experiment as next_entry


def read(content: dict) -> Diagnosis:
    return Diagnosis.from_json(content)


def facts(content: dict, table: pd.DataFrame | None) -> list[Fact]:
    return verdict_text.summary_facts(read(content), table)


def sentence(content: dict) -> str:
    return verdict_text.verdict_sentence(read(content))


def meaning(content: dict) -> str:
    return verdict_text.verdict_meaning(read(content))


def heading(html: str) -> str:
    found = re.search(r"<h1>(.*?)</h1>", html, re.DOTALL)
    assert found is not None
    return re.sub(r"<[^>]+>", "", found[1]).strip()


def shown(content: dict, **changes: object) -> str:
    added = ["", *content.get("effects", [])]
    return page(diagnosis=DiagnosisResult(read(content), ladder(*added), **changes))  # type: ignore[arg-type]


SENTENCES = {
    "missing": "Missing from the model: reservoir depletion.",
    "ambiguous": "Missing from the model: air drag or inlet loss. These trials cannot tell which.",
    "artefact": "A fault of the measurement, not missing physics: length scale.",
    "adequate": "No missing effect can be detected.",
    "unexplained": "The model fails, and no effect of the catalogue explains it.",
}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_page_begins_with_the_verdict_in_one_sentence(verdict: str) -> None:
    html = shown(diagnosis(verdict))
    assert heading(html) == f"{verdict} {SENTENCES[verdict]}"
    assert f'class="badge badge-{verdict}"' in html
    assert meaning(diagnosis(verdict)) in html
    tags = Tags(html)
    assert (tags.wrong, tags.open) == ([], [])


@pytest.mark.parametrize("verdict", VERDICTS)
def test_identifiers_are_unique_and_every_link_of_the_page_leads_somewhere(verdict: str) -> None:
    html = shown(diagnosis(verdict), moved=moved())
    attributes = [attributes for _, attributes in Tags(html).tags]
    ids = [one["id"] for one in attributes if one.get("id")]
    assert len(ids) == len(set(ids))
    inner = {one["href"][1:] for one in attributes if (one.get("href") or "").startswith("#")}
    assert inner <= set(ids)


def test_a_missing_effect_has_its_certainty_its_size_and_the_error_before_and_after() -> None:
    found = {fact.question: fact for fact in facts(diagnosis(), ladder("", "reservoir_depletion"))}
    assert found["Significance"].answer == "20 σ"
    assert found["Significance"].note == "next best: leak, worse by Δχ² = 50.0, not plausible"
    assert found["Size of reservoir depletion"].answer == "γ = 1.1700 ± 0.0040"
    assert found["Size of reservoir depletion"].note == "95 %: 1.162 to 1.178"
    assert found["Error on conditions left out"].answer == "10.0 → 2.00 mm"
    assert found["Error on conditions left out"].note == "replicate scatter 1.50 mm"
    assert found["Damping exponent"].answer == "n = 0.3700 ± 0.0040"


def test_the_size_on_the_first_screen_has_the_interval_with_confounders_left_free() -> None:
    content = diagnosis()
    (row,) = [row for row in content["rounds"][0]["ranking"] if row["effect"] == "reservoir_depletion"]
    row["numbers"] = [number("reservoir_depletion.gamma", "γ", 1.17, 0.004)]
    row["confounded_by"] = [
        {"parameter": "reservoir_depletion.gamma", "vine": "", "effect": name, "symbol": "k", "unit": "N/m",
         "limit_95": 1.0, "value_at_limit": 1.1, "low_95": low, "high_95": 1.19}
        for name, low in (("end_stop", 1.02), ("leak", 1.08))
    ]  # fmt: skip
    found = {fact.question: fact for fact in facts(content, None)}
    assert found["Size of reservoir depletion"].note == (
        "95 %: 1.162 to 1.178; allowing for end stop and leak: 1.020 to 1.190"
    )


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        (("reservoir_depletion",), "of 3 candidates tested"),
        (("air_drag", "inlet_loss"), "2 of 4 candidates fit equally well"),
    ],
)
def test_without_a_fitted_rival_the_number_of_candidates_is_stated(answers: tuple[str, ...], words: str) -> None:
    content = diagnosis("missing" if len(answers) == 1 else "ambiguous")
    rows = [candidate(name, 400.0, in_answer_set=True) for name in answers]
    rows += [candidate(name, None, status="screened") for name in ("leak", "gas_inertia")]
    rows.append(candidate("payload_drag", None, status="not testable here"))
    content["rounds"][0]["ranking"] = rows
    assert facts(content, None)[0].note == words


def test_two_effects_are_named_in_order_each_with_its_size() -> None:
    content = diagnosis(effects=["reservoir_depletion", "tail_friction"])
    content["parameters"].append(number("tail_friction.f", "f", 3.0, 0.2, "N/m"))
    assert sentence(content) == "Missing from the model: reservoir depletion and tail friction."
    assert meaning(content).endswith("With them, no further effect can be detected.")
    questions = [fact.question for fact in facts(content, None)]
    assert questions[1:3] == ["Size of reservoir depletion", "Size of tail friction"]


@pytest.mark.parametrize(
    ("final", "words"), [("unexplained", "With it, the model still fails"), ("missing", "still missing")]
)
def test_what_is_left_after_the_last_effect_is_said(final: str, words: str) -> None:
    assert words in meaning(diagnosis(final_verdict=final))


def test_tied_candidates_have_their_sizes_and_the_next_trial() -> None:
    content = diagnosis("ambiguous")
    questions = [fact.question for fact in facts(content, None)]
    assert questions == ["Significance", "If air drag", "If inlet loss", "Damping exponent"]
    html = shown(content)
    assert "Make four trials on a tube of half the wall." in html
    assert "air drag from inlet loss" in html
    assert "20 ± 1" in html
    assert "inlet loss" in html
    assert "film a ruler and a strobe" in html


def test_adequate_lists_upper_limits_on_undetected_effects() -> None:
    html = shown(diagnosis("adequate"))
    assert "Upper limits on undetected effects" in html
    assert "<details open>" in html
    assert facts(diagnosis("adequate"), None)[0].question == "Most significant candidate"


def test_the_most_significant_candidate_is_chosen_by_score_not_by_a_gain_with_the_wrong_sign() -> None:
    content = diagnosis("adequate")
    wrong = candidate("fold_inertia", 900.0, status="screened", sigma=0.0)
    right = candidate("air_drag", 2.0, status="screened", sigma=1.4)
    content["rounds"][0]["ranking"] = [wrong, right]
    fact = facts(content, None)[0]
    assert (fact.answer, fact.note) == ("1.4 σ", "largest of 2 candidates: air drag")


def test_unexplained_names_the_nearest_candidate_and_why_it_is_not_the_answer() -> None:
    fact = facts(diagnosis("unexplained"), None)[0]
    assert (fact.question, fact.answer) == ("Nearest candidate", "leak")
    assert fact.note == "19 σ better, but it would need 1/τ = 9 1/s, and 0 to 3 is plausible"


def test_upper_limits_are_in_the_displayed_unit() -> None:
    row = candidate("leak", 1.0, largest={"k": 2500.0, "tau": float("nan")})
    table = upper_limit_table([Candidate.from_json(row)])
    assert table is not None
    assert table.rows == [("leak", "k", "2.50 kPa")]
    unfitted = candidate("leak", 1.0, numbers=[], largest={"leak.k": 2500.0, "leak.j": 1.0})
    table = upper_limit_table([Candidate.from_json(unfitted)], {"leak.k": ("κ", "Pa")})
    assert table is not None
    assert table.rows == [("leak", "κ", "2.50 kPa"), ("leak", "j", "1.00 SI")]
    assert upper_limit_table([Candidate.from_json(candidate("leak", 1.0))]) is None


def test_candidates_that_cannot_be_tested_here_are_listed_with_the_reason() -> None:
    html = shown(diagnosis())
    assert "Not testable here: 1 effect" in html
    assert "payload drag: it needs `payload_g`, which is blank" in html


def test_the_ranking_has_every_candidate_with_its_numbers() -> None:
    section = diagnosis_section(DiagnosisResult(read(diagnosis())))
    assert section is not None
    first = section["rounds"][0]["table"].rows
    assert [row[0] for row in first] == ["● reservoir depletion", "leak", "time base"]
    assert first[1][4:] == (
        "k = 0.00200 ± 0.00010 kPa",
        "fitted",
        "not plausible; it would need 1/τ = 9 1/s, and 0 to 3 is plausible",
    )
    assert first[2][5] == "predicted"
    assert len(section["rounds"]) == 2


def test_ties_are_named_most_alike_first() -> None:
    cosines = {"effects": ["a", "b_c", "d"], "matrix": [[1, 0.96, None], [0.96, 1, -0.99], [None, -0.99, 1]]}
    entry = Round.from_json({"verdict": "missing", "cosines": cosines})
    assert tied_pairs(entry) == [
        "b c and d (cosine -0.990)",
        "a and b c (cosine 0.960)",
    ]
    assert tied_pairs(Round.from_json({"verdict": ""})) == []


def test_the_parameters_of_all_models_are_in_one_table() -> None:
    table = moved_table(moved())
    assert table is not None
    assert list(table.head) == ["Parameter", "initial model", "+ reservoir depletion"]
    assert [list(row) for row in table.rows] == [
        ["n", "0.5000 ± 0.0090", "0.3700 ± 0.0040"],
        ["γ", "–", "1.1700 ± 0.0040"],
    ]


def test_the_law_under_every_model_is_by_the_method_that_heads_the_report() -> None:
    table = law_table(laws())
    assert table is not None
    rows = [tuple(row) for row in table.rows]
    assert rows == [
        ("initial model", "v", "0.4000", "0.35 to 0.45", "1.800", "1.70 to 1.90", "5"),
        ("+ reservoir depletion", "v", "0.3700", "0.35 to 0.45", "1.800", "1.70 to 1.90", "5"),
    ]
    assert law_table(None) is None
    assert "The damping law with the pressure of every model" in shown(diagnosis(), laws=laws())


def test_the_ladder_is_a_table_of_numbers_too() -> None:
    html = shown(diagnosis())
    assert "The numbers of the ladder" in html
    assert '<td class="number">10.0</td>' in html


def test_an_effect_is_described_with_its_name() -> None:
    html = shown(
        diagnosis(), summaries={"reservoir_depletion": "The pressure falls while it grows.", "leak": "A hole."}
    )
    assert "The pressure falls while it grows." in html
    assert "A hole." not in html


def test_drifting_parameters_are_listed_once_and_others_are_not() -> None:
    content = diagnosis()
    content["where"].append(content["drift"][0]["sentence"])
    content["drift"].append({"sentence": "n rises by 1 %.", "significant": False})
    html = shown(content)
    assert html.count("B rises by 39 ± 3 %") == 1
    assert "n rises by 1 %." not in html


def test_a_missing_force_is_drawn_with_what_it_looks_like() -> None:
    figures = [ReportFigure("missing_force", "The missing force", "c", SVG)]
    html = page(diagnosis=DiagnosisResult(read(diagnosis("unexplained"))), figures=figures)
    assert html.index("It looks like a constant.") < html.index('id="figure-missing_force"')
    for words in ("the same everywhere", "93 %", "0.400 ± 0.020"):
        assert words in html


def test_a_learned_force_is_drawn_with_what_it_depends_on_and_how_sure_that_is() -> None:
    content = diagnosis("unexplained")
    weights = {"growth+time": 0.74, "growth+speed": 0.26}
    content["missing_force"]["learned"] = {"sentence": "It depends on two of them.", "weights": weights}
    figures = [ReportFigure("learned_force", "The learned force", "c", SVG)]
    html = page(diagnosis=DiagnosisResult(read(content)), figures=figures)
    assert html.index("It depends on two of them.") < html.index('id="figure-learned_force"')
    for words in ("growth and time", "74.0 %", "growth and speed", "26.0 %"):
        assert words in html


def test_a_refusal_is_said_with_its_reason_and_the_law_still_stands() -> None:
    html = shown(refused())
    assert heading(html) == "not diagnosed No diagnosis could be made."
    assert "fewer than two trials move" in html
    assert '<h2 id="law">' in html


def test_without_a_diagnosis_the_law_is_the_headline() -> None:
    assert heading(page()).startswith("From steady speeds: damping exponent n =")
    assert diagnosis_section(None) is None


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_diagnosis_with_nothing_but_a_verdict_makes_a_page(verdict: str) -> None:
    bare = {"verdict": verdict, "effects": [], "answer_set": [], "rounds": []}
    assert heading(page(diagnosis=DiagnosisResult(read(bare)))).startswith(verdict)


def test_pictures_stand_in_the_parts_they_belong_to() -> None:
    figures = [ReportFigure(key, key, "c", SVG, f"{key}.csv", "a\n1\n") for key in diagnosis_figures()]
    html = page(diagnosis=DiagnosisResult(read(diagnosis()), ladder("", "a")), figures=figures)
    order = ["figure-ladder", "figure-before_after", 'id="law"', 'id="where"', "figure-where", "figure-missing_force"]
    order += ['id="candidates"', "figure-candidates", 'id="tied"', "figure-cosines", 'id="drift"', "figure-drift"]
    places = [html.index(f'id="{one}"' if one.startswith("figure") else f"<h2 {one}") for one in order]
    assert places == sorted(places)
    for key in diagnosis_figures():
        assert f'download="{key}.csv"' in html


@pytest.mark.parametrize("place", ["effects", "answer_set", "explanation", "where", "notes", "reason", "next", "drift"])
def test_whatever_stands_in_the_file_is_escaped(place: str) -> None:
    content = diagnosis("ambiguous")
    if place in ("effects", "answer_set", "where", "notes"):
        content[place] = [EVIL]
    if place == "explanation":
        content["explanation"] = content["rounds"][0]["explanation"] = EVIL
    if place == "reason":
        content["rounds"][0]["ranking"][0] |= {"reason": EVIL, "effect": EVIL}
    if place == "next":
        content["next_experiment"] = next_experiment() | {"text": EVIL, "calibration": EVIL}
    if place == "drift":
        content["drift"] = [{"sentence": EVIL}]
    html = shown(content)
    assert EVIL not in html
    assert not [tag for tag, _ in Tags(html).tags if tag == "script"]


def test_numbers_are_said_in_units_that_read_well() -> None:
    shown = [Number.from_json(number("a.k", "k", 2500.0, sigma, "Pa", "v")) for sigma in (100.0, None)]
    assert [verdict_text.estimate_text(one) for one in shown] == ["k (v) = 2.50 ± 0.10 kPa", "k (v) = 2.50 kPa"]


def test_names_are_listed_with_and_before_the_last() -> None:
    assert listed_names(["air_drag"]) == "air drag"
    assert listed_names(["air_drag", "leak", "gravity"], "or") == "air drag, leak or gravity"
    assert listed_names([]) == ""


def test_the_next_experiment_may_be_a_sentence_alone() -> None:
    entry = next_entry({"text": "Film a ruler."})
    assert entry is not None
    assert (entry["trials"], entry["separations"]) == (None, None)
    assert next_entry(None) is None


def test_the_page_says_what_the_trials_could_have_seen() -> None:
    sizes = tuple(1 + 0.1 * (probability - 0.9) for probability in PROBABILITIES)
    drag = EffectPower("air_drag", "physical", "air_drag.C_D", "C_D", "1", 0.0, 0.0, 3.0, sizes, {"inlet_loss": 0.26})
    leak = replace(drag, effect="leak", symbol="1/τ", unit="1/s", largest=0.5)
    power = Power(24, 3.6, {"scores of all candidates": 0.003}, (leak, drag), {"static_yield": "no trace"})
    told = replace(read(diagnosis("adequate")), power=power)
    html = page(diagnosis=DiagnosisResult(told))
    part = html.partition('<h2 id="power">')[2].partition("<h2")[0]
    assert "raise a false alarm in at most 0.30 % of campaigns" in part
    assert "Detectable with 90 % power: air drag from C_D = 1.0." in part
    assert "Not detectable: leak and static yield." in part
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", part)]
    assert [row[0] for row in rows if row] == ["air drag", "leak"]
    assert rows[1][3:] == ["1.0", "3.0", "100 %", "inlet loss 26 %"]
    assert '<a href="#power">' in html
    assert 'id="power"' not in page(diagnosis=DiagnosisResult(read(diagnosis("adequate"))))
    wary = diagnosis_section(DiagnosisResult(replace(told, power=replace(power, wary="the model is far off"))))
    assert wary is not None
    assert wary["power"]["table"] is None
    assert "the model is far off" in wary["power"]["sentences"][1]
