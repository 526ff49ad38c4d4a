"""Diagnoses written by hand, in the shape of `diagnosis.json`: one of every verdict, and one that was refused."""

import math

import pandas as pd

BASE = ["pressure_drive", "gravity", "eversion_damping", "yield_pressure"]
VERDICTS = ("missing", "ambiguous", "artefact", "adequate", "unexplained")


def number(parameter: str, symbol: str, value: float, sigma: float | None, unit: str = "1", vine: str = "") -> dict:
    low, high = (None, None) if sigma is None else (value - 2 * sigma, value + 2 * sigma)
    found = {"value": value, "sigma": sigma, "low_95": low, "high_95": high, "interval": "linear", "bound": None}
    return {"parameter": parameter, "vine": vine, "symbol": symbol, "unit": unit, **found}


def candidate(effect: str, delta_chi2: float | None, **changes) -> dict:
    """A row of a ranking; physical, refitted, plausible and not in the answer unless said otherwise."""
    row = {"effect": effect, "kind": "physical", "status": "refitted", "plausible": True, "in_answer_set": False}
    gain = {"delta_chi2": delta_chi2, "sigma": None if delta_chi2 is None else math.sqrt(delta_chi2)}
    found = {"numbers": [number(f"{effect}.k", "k", 2.0, 0.1, "Pa")], "reason": "", "largest": {}}
    return row | gain | found | changes


IMPLAUSIBLE = {"code": "implausible_size", "symbol": "1/τ", "value": 9.0, "unit": "1/s", "low": 0.0, "high": 3.0}


def ranking(*answers: str, kind: str = "physical") -> list[dict]:
    blank = {"code": "column_blank", "column": "payload_g"}
    return [
        *(candidate(name, 400.0 - i, in_answer_set=True, kind=kind) for i, name in enumerate(answers)),
        candidate("leak", 350.0, plausible=False, reason_code=IMPLAUSIBLE),
        candidate("time_base", 25.0, kind="measurement", status="screened", numbers=[], largest={"tau": 3e-3}),
        candidate("payload_drag", None, status="not testable here", numbers=[], reason_code=blank),
    ]


def one_round(verdict: str, *answers: str, model: list[str] | None = None, kind: str = "physical") -> dict:
    effects = [*answers, "leak", "time_base"]
    n = len(effects)
    matrix = [[1.0 if i == j else 0.97 if {i, j} == {0, 1} else 0.2 for j in range(n)] for i in range(n)]
    told = {"answer_set": list(answers), "explanation": f"In the words of the diagnosis: {verdict}."}
    found = {"ranking": ranking(*answers, kind=kind), "cosines": {"effects": effects, "matrix": matrix}}
    return {"model": model or BASE, "verdict": verdict, **told, **found}


ANSWERS = {"missing": ["reservoir_depletion"], "ambiguous": ["air_drag", "inlet_loss"], "artefact": ["length_scale"]}


def diagnosis(verdict: str = "missing", **changes) -> dict:
    """A whole diagnosis; `missing` has reservoir depletion added and nothing left."""
    named = ANSWERS.get(verdict, [])
    rounds = [one_round(verdict, *named, kind="measurement" if verdict == "artefact" else "physical")]
    added = named if verdict == "missing" else []
    parameters = [number("eversion_damping.n", "n", 0.37, 0.004)]
    if added:
        rounds.append(one_round("adequate", model=[*BASE, *added]))
        parameters.append(number("reservoir_depletion.gamma", "γ", 1.17, 0.004))
    if "final_verdict" in changes:
        rounds[-1]["verdict"] = changes["final_verdict"]
    content = {"verdict": verdict, "effects": added, "answer_set": named, "rounds": rounds, "parameters": parameters}
    content |= {name: rounds[0][name] for name in ("explanation", "cosines")} | {"notes": [], "refused": None}
    drift = {"parameter": "eversion_damping.B", "sentence": "B rises by 39 ± 3 % from 60 kPa to 24 kPa."}
    content |= {"final_verdict": rounds[-1]["verdict"], "where": ["The model fails most at 24 kPa."], "drift": [drift]}
    content["next_experiment"] = next_experiment() if verdict == "ambiguous" else None
    content["missing_force"] = missing_force() if verdict == "unexplained" else None
    return content | changes


def refused(reason: str = "fewer than two trials move") -> dict:
    empty: dict = {"effects": [], "answer_set": [], "rounds": [], "parameters": [], "model": BASE}
    said = {"refused": reason, "explanation": f"No diagnosis could be made: {reason}"}
    return empty | said | {"verdict": None, "final_verdict": None}


def missing_force() -> dict:
    law = {"law": "constant", "words": "the same everywhere", "explained": 0.93, "amplitude_N": 0.4, "sigma_N": 0.02}
    return {"sentence": "It looks like a constant.", "laws": [law]}


def next_experiment() -> dict:
    trial = {"replicates": 4, "pressure_kPa": 30.0, "payload_g": 0.0, "diameter_mm": 24.0, "thickness_um": 100.0}
    trial |= {"length_mm": 200.0, "chamber_l": 2.0, "inlet_mm": None, "growth_angle_deg": 0.0, "new_vine": True}
    pair = "air_drag | inlet_loss"
    found = {"text": "Make four trials on a tube of half the wall.", "trials": [trial]}
    return found | {"separation_sigma": {pair: 21.0}, "calibration": "film a ruler and a strobe"}


def ladder(*added: str) -> pd.DataFrame:
    """Errors that fall to a fifth with every step."""
    sizes_m = {"rms_in_sample_m": 9e-3, "rms_left_out_m": 10e-3, "rms_highest_pressure_m": 11e-3, "floor_m": 1.5e-3}
    sizes_m |= {"expected_m": 1.6e-3, "expected_low_m": 1.2e-3, "expected_high_m": 2.2e-3, "excess_left_out_m": 5e-3}
    table = pd.DataFrame({"model": "+".join(BASE), "added": list(added), **sizes_m, "partial": False})
    falling = [name for name in table if str(name).startswith(("rms", "excess"))]
    return table.assign(**table[falling].div(5.0**table.index, axis=0))
