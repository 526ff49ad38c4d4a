"""What `vinetrack power` promises, held against campaigns of a simulator that shares no code with the package.

    python benchmarks/power_promises.py [--effects NAME,…] [--campaigns 10] [--first-seed 21000] [--answers FILE]
                                        [--trials 18:26] [--probability 0.9]

For every seed a careful laboratory (`benchmarks/hidden/`) films a campaign in which nothing is missing. From it `power`
promises a size for each effect. The same laboratory then films the campaign again, with new scatter, noise and order,
and with the effect at the promised size, and the experiment goes to `vinetrack.diagnose` as a folder. The table holds
how often the effect was in the answer set or added, beside the probability promised, with the exact binomial interval
of 95 %; and how often the campaigns without an effect raised an alarm. `--answers` keeps every answer as it comes.

Seeds 21000–21999 tune, 31500–31999 score: nothing may be tuned on those.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from hidden.designs import Setting, Wants
from hidden.laboratory_folder import write_experiment
from hidden.shots import Campaign, Laboratory, careful, film, plan
from scipy.stats import binomtest

import vinetrack as vt

FIRST_TUNING_SEED, FIRST_SCORING_SEED = 21_000, 31_500
PHYSICS = {
    "air_drag": "C_D",
    "fold_inertia": "eta",
    "inlet_loss": "K",
    "leak": "leak_rate",
    "linear_damping": "b",
    "pressure_damping": "beta",
    "reservoir_depletion": "gamma",
    "tail_friction": "mu_w",
    "wall_stretch": "kappa",
}
"""What the hidden simulator calls the size of each effect."""
COLUMNS = (
    "seed",
    "effect",
    "n_trials",
    "promised",
    "size",
    "largest",
    "verdict",
    "answer",
    "found",
    "alarm",
    "seconds",
)

Line = dict[str, object]


def one_vine(settings: list[Setting]) -> bool:
    """Whether all trials are of one vine."""
    return len({one.vine for one in settings}) == 1


def laboratory_of(seed: int, trials: tuple[int, int]) -> Laboratory:
    """The laboratory of a seed, before it films anything."""
    draw = np.random.default_rng([seed, 1])
    wants = Wants(payload=False, chamber=True, inlet=True, trials=trials)
    return careful(plan(draw, wants, one_vine), draw)


def with_effect(laboratory: Laboratory, effect: str, size: float, seed: int) -> Laboratory:
    """The same trials with new scatter of pressure and B, and the effect at this size; none where blank."""
    draw = np.random.default_rng([seed, 2, *effect.encode()])
    known = laboratory.truths
    shots = []
    for shot in laboratory.shots:
        set_Pa = 1e3 * shot.setting.pressure_kPa * (1 + known["pressure_scatter"] * draw.standard_normal())
        B = shot.setting.vine.B * (1 + known["B_scatter"] * float(np.clip(draw.standard_normal(), -3, 3)))
        physics = shot.physics._replace(B=B, **({PHYSICS[effect]: size} if effect else {}))
        shots.append(replace(shot, tube=shot.tube._replace(pressure=set_Pa), physics=physics))
    return replace(laboratory, shots=tuple(shots))


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
    return line | {
        "verdict": said.verdict,
        "answer": "|".join(said.answer_set),
        "found": alarm and effect in (*said.answer_set, *said.effects),
        "alarm": alarm,
        "seconds": round(time.perf_counter() - begun, 1),
    }


def campaign(seed: int, effects: list[str], trials: tuple[int, int], probability: float) -> list[Line]:
    """All answers of one seed: the campaign without an effect, and one for each effect at its promised size."""
    lines = []
    with tempfile.TemporaryDirectory() as holder:
        null = Path(holder) / "null"
        laboratory = laboratory_of(seed, trials)
        count = write(laboratory, seed, "", null)
        if not count:
            return []
        power = vt.power(null, *effects)
        line: Line = {"seed": seed, "effect": "", "n_trials": count, "promised": power.false_alarm_rate}
        lines.append(diagnosed(null, "", line))
        for entry in power.effects:
            size, folder = entry.size_at(probability), Path(holder) / entry.effect
            changed = with_effect(laboratory, entry.effect, size, seed)
            if not np.isfinite(size) or not write(changed, seed, entry.effect, folder):
                continue
            line = {"seed": seed, "effect": entry.effect, "n_trials": count, "promised": probability}
            lines.append(diagnosed(folder, entry.effect, line | {"size": size, "largest": entry.largest}))
    return lines


def kept(path: Path | None) -> list[Line]:
    """What an earlier run has written."""
    if path is None or not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return [dict(row) for row in csv.DictReader(stream)]


def report(lines: list[Line]) -> None:
    """A row an effect: found of campaigns, exact interval, what was named."""
    print(f"{'effect':22s}{'promised':>9s}{'found':>8s}{'95 %':>14s}{'beyond plausible':>18s}  named")
    for effect in dict.fromkeys(str(line["effect"]) for line in lines):
        rows = [line for line in lines if line["effect"] == effect]
        hits = [str(line["found" if effect else "alarm"]) == "True" for line in rows]
        ends = binomtest(sum(hits), len(hits)).proportion_ci(0.95, method="exact")
        named = Counter(f"{line['verdict']}: {line['answer']}".removesuffix(": ") for line in rows)
        beyond = sum(abs(float(str(line["size"]))) > abs(float(str(line["largest"]))) for line in rows) if effect else 0
        promised = np.mean([float(str(line["promised"])) for line in rows])
        said = "; ".join(f"{words} {count}" for words, count in named.most_common(5))
        interval = f"{100 * ends.low:.0f}–{100 * ends.high:.0f} %"
        found = f"{sum(hits)}/{len(hits)}"
        print(f"{effect or 'nothing (alarms)':22s}{100 * promised:8.1f}%{found:>8s}{interval:>14s}{beyond:18d}  {said}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", default="tail_friction,leak,fold_inertia", help="names, comma-separated")
    parser.add_argument("--campaigns", type=int, default=10, help="seeds")
    parser.add_argument("--first-seed", type=int, default=FIRST_TUNING_SEED)
    parser.add_argument("--trials", default="18:26", help="fewest and most trials")
    parser.add_argument("--probability", type=float, default=0.9, help="with which the size is promised to be found")
    parser.add_argument("--answers", type=Path, help="CSV that keeps every answer")
    given = parser.parse_args()
    low, high = (int(part) for part in given.trials.split(":"))
    effects = given.effects.split(",")
    lines = kept(given.answers)
    done = {int(str(line["seed"])) for line in lines}
    for seed in range(given.first_seed, given.first_seed + given.campaigns):
        if seed in done:
            continue
        new = campaign(seed, effects, (low, high), given.probability)
        lines += new
        print(json.dumps(new, default=str), flush=True)
        if given.answers is not None:
            fresh = not given.answers.is_file()
            with given.answers.open("a", newline="", encoding="utf-8") as stream:
                writer = csv.DictWriter(stream, COLUMNS, restval="")
                if fresh:
                    writer.writeheader()
                writer.writerows(new)
    report(lines)


if __name__ == "__main__":
    main()
