"""What `vinetrack power` promises, held against campaigns of a simulator that shares no code with the package.

    python benchmarks/power_promises.py [--design six|twenty_four|two_vines] [--effects NAME,…] [--each 4]
                                        [--campaigns 10] [--first-seed 21000] [--answers FILE] [--minutes 10]
                                        [--probability 0.9]

For every seed a careful laboratory (`benchmarks/hidden/`) films a campaign in which nothing is missing: six trials, 18
to 26 of one vine, or 40 to 48 of two. Every second seed is of fast vines, and of the larger designs every second pair
of seeds carries payloads. From it `power` promises a size for each effect. The same laboratory then films the campaign
again, with new scatter, noise and order, and with the effect at the promised size, and the experiment goes to
`vinetrack.diagnose` as a folder. `--each` effects are tried a seed, those first that were tried least, of those whose
promised size is plausible. The table holds how often the effect was in the answer set or added, beside the probability
promised, with the exact binomial interval of 95 %; and how often the campaigns without an effect raised an alarm. An
effect counts as found, too, where a simpler law is named that it holds as a limit and that fits as well.
`--each 0` asks the campaigns without an effect alone, and for the promised rate of alarms the first one only.
`--answers` keeps every answer as it comes; after `--minutes` no seed is begun.

Seeds 21000–21999 tune, 31500–31999 score: nothing may be tuned on those.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from hidden.designs import Setting, Wants
from hidden.laboratory_folder import write_experiment
from hidden.shots import Campaign, Laboratory, Shot, careful, film, plan
from scipy.stats import binomtest

import vinetrack as vt
from vinetrack.diagnosis.result import EffectPower

FIRST_TUNING_SEED, FIRST_SCORING_SEED = 21_000, 31_500
DESIGNS = {"six": (1, (6, 6)), "twenty_four": (1, (18, 26)), "two_vines": (2, (40, 48))}
"""Vines, and the fewest and the most trials."""
PHYSICS = {
    "air_drag": {"C_D": "C_D"},
    "capstan_friction": {"C": "capstan_C", "mu_c": "capstan_mu", "k": "capstan_k"},
    "end_stop": {"k": "stop_k", "y_0": "stop_y"},
    "falling_friction": {"F_s": "stribeck_F", "v_s": "stribeck_speed", "k": "stribeck_power"},
    "fold_inertia": {"eta": "eta"},
    "gas_inertia": {"factor": "gas"},
    "inlet_loss": {"K": "K"},
    "latch_release": {"F": "latch_F", "reach": "latch_reach"},
    "leak": {"rate": "leak_rate"},
    "linear_damping": {"b": "b"},
    "payload_drag": {"drag_area": "drag_area"},
    "payload_friction": {"mu_p": "mu_p"},
    "pressure_damping": {"beta": "beta"},
    "quadratic_length_friction": {"q": "square_q"},
    "reel_inertia": {"M": "reel_kg"},
    "reservoir_depletion": {"gamma": "gamma"},
    "supply_pulsation": {"a": "ringing", "f": "ringing_hz", "phi": "ringing_phase"},
    "supply_refill": {"tau": "refill_s", "gamma": "gamma"},
    "tail_friction": {"mu_w": "mu_w"},
    "tail_stretch": {"compliance": "compliance"},
    "wall_stretch": {"kappa": "kappa"},
}
"""What the hidden simulator calls the parameters of each effect."""
CAMERA = {
    "length_scale": ("scale",),
    "time_base": ("clock",),
    "perspective": ("bow_per_m",),
    "lens": ("lens_k3", "lens_centre_m"),
    "rolling_shutter": ("row_delay_s_m",),
}
"""The same of what a camera does."""
OF_TUBE = ("pressure_gain", "pressure_gauge", "area_scale", "growth_angle", "supply_rise")
"""Effects on what is true of the tube, or of its valve."""
KNOWN = (*PHYSICS, *CAMERA, *OF_TUBE)
COLUMNS = (
    "seed",
    "design",
    "effect",
    "n_trials",
    "promised",
    "size",
    "largest",
    "verdict",
    "answer",
    "found",
    "alarm",
    "status",
    "seconds",
)

Line = dict[str, object]


def laboratory_of(seed: int, design: str) -> Laboratory:
    """The laboratory of a seed, before it films anything."""
    draw = np.random.default_rng([seed, 1])
    vines, trials = DESIGNS[design]
    wants = Wants(
        payload=design != "six" and seed // 2 % 2 == 1, chamber=True, inlet=True, fast=seed % 2 == 1, trials=trials
    )  # fmt: skip

    def of_so_many(settings: list[Setting]) -> bool:
        return len({one.vine for one in settings}) == vines

    return careful(plan(draw, wants, of_so_many), draw)


def with_effect(laboratory: Laboratory, effect: str, values: tuple[float, ...], seed: int) -> Laboratory:
    """The same trials with new scatter of pressure and B, and the effect with these parameters."""
    draw = np.random.default_rng([seed, 2, *effect.encode()])
    known = laboratory.truths
    shots = []
    for shot in laboratory.shots:
        set_Pa = 1e3 * shot.setting.pressure_kPa * (1 + known["pressure_scatter"] * draw.standard_normal())
        B = shot.setting.vine.B * (1 + known["B_scatter"] * float(np.clip(draw.standard_normal(), -3, 3)))
        changed = replace(shot, tube=shot.tube._replace(pressure=set_Pa), physics=shot.physics._replace(B=B))
        if effect in PHYSICS:
            acting = dict(zip(PHYSICS[effect].values(), values, strict=True))
            changed = replace(changed, physics=changed.physics._replace(**acting))
        elif effect in OF_TUBE:
            changed = _changed(changed, effect, values)
        shots.append(changed)
    camera = laboratory.camera
    if effect in CAMERA:
        camera = replace(camera, **dict(zip(CAMERA[effect], values, strict=True)))
    return replace(laboratory, shots=tuple(shots), camera=camera)


def _changed(shot: Shot, effect: str, values: tuple[float, ...]) -> Shot:
    """A trial whose tube or valve is not what the sheet says."""
    tube, size = shot.tube, values[0]
    if effect == "pressure_gain":
        tube = tube._replace(pressure=tube.pressure * (1 + size), yield_pressure=tube.yield_pressure * (1 + size))
    elif effect == "pressure_gauge":
        tube = tube._replace(pressure=tube.pressure + size)
    elif effect == "area_scale":
        tube = tube._replace(diameter=tube.diameter * (1 + size))
    elif effect == "growth_angle":
        sine = math.sqrt(max(1 - tube.cosine**2, 0.0))
        tube = tube._replace(cosine=tube.cosine + size * (sine - tube.cosine))
    else:
        return replace(shot, valve_s=size, valve_power=values[1])
    return replace(shot, tube=tube)


def write(laboratory: Laboratory, seed: int, effect: str, folder: Path) -> int:
    """Film a campaign and write its experiment; how many trials it has, 0 where too few of them move."""
    recordings = film(laboratory, np.random.default_rng([seed, 3, *effect.encode()]))
    if recordings is None:
        return 0
    write_experiment(Campaign(recordings, {"ambient_pressure_kPa": 101.325}, {}), folder)
    return len(recordings)


def diagnosed(folder: Path, effect: str, line: Line) -> Line:
    """What the diagnosis says of an experiment."""
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = vt.diagnose(folder, ladder=False, advice=False)
    alarm = said.verdict != "adequate"
    held = next((candidate for candidate in said.ranking if candidate.effect == effect), None)
    # A simpler law that it holds as a limit, and that fits as well, is named in its place.
    why = held.reason if held is not None and held.reason.code in ("contains", "contains_and_fits_no_better") else None
    simpler = why is not None and why.facts["name"] in said.answer_set
    return line | {
        "verdict": said.verdict,
        "answer": "|".join(said.answer_set),
        "found": alarm and (simpler or effect in (*said.answer_set, *said.effects)),
        "alarm": alarm,
        "status": f"{held.status} {held.sigma:.1f} sigma {held.reason}" if held else "",
        "seconds": round(time.perf_counter() - begun, 1),
    }


def is_scored(entry: EffectPower, probability: float) -> bool:
    """Whether the promised size is plausible, and one that the hidden simulator can make."""
    away = abs(entry.size_at(probability) - entry.zero)
    return entry.effect in KNOWN and abs(entry.least - entry.zero) <= away <= abs(entry.largest - entry.zero)


def campaign(
    seed: int, design: str, effects: list[str], each: int, probability: float, lines: list[Line]
) -> Iterator[Line]:
    """All answers of one seed: the campaign without an effect, and some effects at their promised sizes."""
    tried = Counter(str(line["effect"]) for line in lines)
    with tempfile.TemporaryDirectory() as holder:
        null = Path(holder) / "null"
        laboratory = laboratory_of(seed, design)
        count = write(laboratory, seed, "", null)
        if not count:
            return
        about: Line = {"seed": seed, "design": design, "n_trials": count}
        alarms = [line["promised"] for line in lines if line["design"] == design and not line["effect"]]
        if not each and alarms:
            yield diagnosed(null, "", {**about, "effect": "", "promised": alarms[0]})
            return
        begun = time.perf_counter()
        power = vt.power(null, *effects)
        print(f"# {seed} {design}: power {time.perf_counter() - begun:.1f} s, {len(power.effects)} effects", flush=True)
        yield diagnosed(null, "", {**about, "effect": "", "promised": power.false_alarm_rate})
        order = np.random.default_rng([seed, 4]).permutation(len(power.effects))
        entries = [power.effects[k] for k in order if is_scored(power.effects[k], probability)]
        done = 0
        for entry in sorted(entries, key=lambda entry: tried[entry.effect]):
            size, folder = entry.size_at(probability), Path(holder) / entry.effect
            if done == each:
                break
            if not write(
                with_effect(laboratory, entry.effect, (size, *entry.other_values), seed), seed, entry.effect, folder
            ):
                continue
            line = {**about, "effect": entry.effect, "promised": probability, "size": size, "largest": entry.largest}
            yield diagnosed(folder, entry.effect, line)
            done += 1


def kept(path: Path | None) -> list[Line]:
    """What an earlier run has written."""
    if path is None or not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return [dict(row) for row in csv.DictReader(stream)]


def keep(path: Path, line: Line) -> None:
    """Append an answer."""
    fresh = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS, restval="")
        if fresh:
            writer.writeheader()
        writer.writerow(line)


def report(lines: list[Line]) -> None:
    """A row a design and effect, and one for all effects: found of campaigns, exact interval, what was named."""
    print(f"{'design':12s} {'effect':26s}{'promised':>9s}{'found':>8s}{'95 %':>14s}  named")
    for design in dict.fromkeys(str(line["design"]) for line in lines):
        here = [line for line in lines if line["design"] == design]
        with_one = [line for line in here if line["effect"]]
        for effect in sorted({str(line["effect"]) for line in here}):
            row(design, effect or "nothing (alarms)", [line for line in here if line["effect"] == effect])
        row(design, "all effects", with_one)
        for kind, names in (("physical", (*PHYSICS, "supply_rise")), ("measurement", (*CAMERA, *OF_TUBE[:-1]))):
            row(design, f"all {kind}", [line for line in with_one if line["effect"] in names])


def row(design: str, name: str, lines: list[Line]) -> None:
    """Print a row."""
    if not lines:
        return
    hits = [str(line["found" if line["effect"] else "alarm"]) == "True" for line in lines]
    ends = binomtest(sum(hits), len(hits)).proportion_ci(0.95, method="exact")
    promised = np.mean([float(str(line["promised"])) for line in lines])
    named = Counter(f"{line['verdict']}: {line['answer']}".removesuffix(": ") for line in lines)
    said = "; ".join(f"{words} {count}" for words, count in named.most_common(5))
    interval, found = f"{100 * ends.low:.0f}–{100 * ends.high:.0f} %", f"{sum(hits)}/{len(hits)}"
    print(f"{design:12s} {name:26s}{100 * promised:8.1f}%{found:>8s}{interval:>14s}  {said}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--design", choices=DESIGNS, default="twenty_four")
    parser.add_argument("--effects", default="", help="names, comma-separated; all if not given")
    parser.add_argument("--each", type=int, default=4, help="effects tried a seed")
    parser.add_argument("--campaigns", type=int, default=10, help="seeds")
    parser.add_argument("--first-seed", type=int, default=FIRST_TUNING_SEED)
    parser.add_argument("--probability", type=float, default=0.9, help="with which the size is promised to be found")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no seed is begun")
    parser.add_argument("--answers", type=Path, help="CSV that keeps every answer")
    given = parser.parse_args()
    effects = [name for name in given.effects.split(",") if name]
    lines, begun = kept(given.answers), time.monotonic()
    done = {(int(str(line["seed"])), line["design"]) for line in lines}
    for seed in range(given.first_seed, given.first_seed + given.campaigns):
        if (seed, given.design) in done:
            continue
        if time.monotonic() - begun > 60 * given.minutes:
            break
        for line in campaign(seed, given.design, effects, given.each, given.probability, lines):
            lines.append(line)
            print(json.dumps(line, default=str), flush=True)
            if given.answers is not None:
                keep(given.answers, line)
    report(lines)


if __name__ == "__main__":
    main()
