"""How many trials a campaign takes until one right name is left: next trials as advised, on a grid, or at random.

    python benchmarks/closed_loop.py [--campaigns 3] [--first-seed 22000] [--effects inlet_loss,leak] [--answers FILE]
                                     [--risk 0.03] [--most 30] [--ways advised,asked,grid,random] [--minutes 30]

A careful laboratory of a simulator that shares no code with the package (`benchmarks/hidden/`) begins with six trials
of one vine at two pressures, with one effect or with nothing missing. The size of the effect is drawn, evenly in its
logarithm, between half of and three times what such six trials find every other time, within what is plausible: larger
ones are named from the first six trials, however the next are chosen. After each look
(`vinetrack.diagnosis.stopping`) four trials are added: as `vinetrack campaign` says (advised), those that tell apart
what is tied, that confirm the one effect named, or that reveal most where nothing is found; the same, but while nothing
is found those that `vinetrack power --reach 0.9` says for the effect that is there, at the smallest size it may have
here, as one would who is after it (asked; after inlet loss where nothing is missing); of pressures in equal ratios and
all connectors and chambers in turn (grid); or of any of them at random (random). All ways have the same rig: 10 to 40
kPa, connectors of 5.5, 8 and 11 mm, chambers of 3.7 and 8 l, and begin with the same six trials, which are looked at
once. A campaign ends when one name is left at the stated risk, or with
`--most` trials. The first table holds the trials until one right name (those that did not get there count with
`--most`), the second the ratio of the mean number of trials to those of the grid and at random, of the same campaigns,
of all and of those that the first six trials do not decide; then the wrong stops, with the exact binomial interval of
95 %.

Nine candidates are asked about, so that a campaign takes minutes. Seeds 22000–22999 tune, 32500–32999 score. Answers
are kept as they come (`--answers`); after `--minutes` no campaign is begun.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import tempfile
import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from hidden.designs import Setting, Vine
from hidden.laboratory_folder import write_experiment
from hidden.motion import Physics, Tube
from hidden.shots import Camera, Campaign, Laboratory, Recording, Shot, film
from scipy.stats import binomtest

import vinetrack as vt
from vinetrack.diagnosis.campaign_power import design_of_fit, fit_power
from vinetrack.diagnosis.diagnose import with_next_experiment
from vinetrack.diagnosis.further_trials import confirming_trials, exploratory_trials, further_trials
from vinetrack.diagnosis.power import sheet_cells
from vinetrack.diagnosis.stopping import STOP, CampaignLook, look_at, trials_to_go
from vinetrack.experiment.settings import Limits

FIRST_TUNING_SEED, FIRST_SCORING_SEED = 22_000, 32_500
EFFECTS = {
    "": ("", 0.0, 0.0),
    "inlet_loss": ("K", 0.75, 3.0),
    "leak": ("leak_rate", 0.0004, 0.0023),
    "fold_inertia": ("eta", 0.4, 1.0),
    "tail_friction": ("mu_w", 0.028, 0.17),
    "linear_damping": ("b", 0.09, 0.54),
}
"""What the hidden simulator calls the size of each effect, and between which it is drawn, evenly in its logarithm.
Derived: `vinetrack power` of the six trials that a campaign begins with, with these candidates and a scatter of B of
2 % and of pressure of 0.5 %, finds K 1.5, 0.00075/s, η 0.81 and 0.18 N·s/m every other time if positions have no
systematic error, and tail friction of 0.057 N/m with one of 0.1 mm: less moves no position farther."""

CANDIDATES = [*(name for name in EFFECTS if name), "reservoir_depletion", "air_drag", "pressure_gain", "area_scale"]
LOW_KPA, HIGH_KPA, INLETS_MM, CHAMBERS_L = 10.0, 40.0, (5.5, 8.0, 11.0), (3.7, 8.0)
LIMITS = Limits.model_validate({
    "pressure_kPa": [LOW_KPA, HIGH_KPA], "inlet_mm": list(INLETS_MM), "chamber_l": list(CHAMBERS_L),
    "new_vines": False, "payload_g": [0, 0], "trials": 4,
})  # fmt: skip
COLUMNS = ("seed", "effect", "way", "size", "trials", "stopped", "right", "named", "looks", "seconds")
Line = dict[str, object]


@dataclass
class Sequence:
    """A campaign that goes on: its truth, and the trials made so far."""

    seed: int
    effect: str
    vine: Vine
    physics: dict[str, float]
    scatter: tuple[float, float]
    camera: Camera
    recordings: list[Recording] = field(default_factory=list)
    settings: list[Setting] = field(default_factory=list)

    def make(self, pressure_kPa: float, chamber_l: float, inlet_mm: float, payload_g: float = 0.0) -> bool:
        """Film one trial; whether it moved."""
        count = len(self.settings)
        draw = np.random.default_rng([self.seed, 5, count])
        setting = Setting(
            self.vine, round(pressure_kPa, 1), payload_g, count, 1000.0, 0.0, chamber_l, inlet_mm
        )  # fmt: skip
        self.settings.append(setting)
        tube = Tube(
            pressure=1e3 * setting.pressure_kPa * (1 + self.scatter[1] * draw.standard_normal()),
            yield_pressure=1e3 * self.vine.yield_kPa,
            diameter=self.vine.diameter_mm / 1e3, thickness=self.vine.thickness_um / 1e6,
            length=self.vine.length_mm / 1e3, payload=payload_g / 1e3, cosine=1.0, chamber=chamber_l / 1e3,
            inlet_area=math.pi * (inlet_mm / 1e3) ** 2 / 4,
        )  # fmt: skip
        B = self.vine.B * (1 + self.scatter[0] * float(np.clip(draw.standard_normal(), -3, 3)))
        shot = Shot(setting, tube, Physics(B=B, n=self.vine.n, **self.physics))
        filmed = film(Laboratory((shot,), self.camera), draw)
        if filmed is None:
            return False
        name = f"t{count + 1:02d}"
        cells = {**filmed[0].cells, "trial": name, "track": f"tracks/{name}.csv"}
        self.recordings.append(replace(filmed[0], cells=cells))
        return True

    def diagnosed(self) -> vt.Diagnosis:
        """What the diagnosis says of the trials so far."""
        settings = {"ambient_pressure_kPa": 101.325, "candidates": CANDIDATES}
        with tempfile.TemporaryDirectory() as holder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write_experiment(Campaign(tuple(self.recordings), settings, {}), Path(holder))
            return vt.diagnose(Path(holder), ladder=False, advice=False)


def begun(seed: int, effect: str) -> Sequence:
    """A laboratory with six trials at two pressures."""
    draw = np.random.default_rng([seed, 1, *effect.encode()])
    vine = Vine(24.0, 200.0, 280.0, 3.0, 6.44 * math.exp(0.15 * draw.standard_normal()), float(draw.uniform(0.3, 0.45)))
    key, low, high = EFFECTS[effect]
    physics = {key: math.exp(draw.uniform(math.log(low), math.log(high)))} if key else {}
    camera = Camera(float(np.exp(draw.uniform(math.log(4e-5), math.log(2e-4)))))
    made = Sequence(
        seed, effect, vine, physics, (float(draw.uniform(0.005, 0.03)), float(draw.uniform(0.002, 0.008))), camera
    )
    for pressure in (14.0, 28.0):
        for _ in range(3):
            made.make(pressure, 3.7, 8.0)
    return made


def four_more(made: Sequence, way: str, said: vt.Diagnosis, look: CampaignLook, draw: np.random.Generator) -> None:
    """Add four trials; those advised are what `vinetrack campaign` says next."""
    wanted: list[tuple[float, float, float]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if way in ("advised", "asked"):
            trials = (with_next_experiment(said, LIMITS).next_experiment or {}).get("trials") or ()
            wanted = [
                (entry["pressure_kPa"], entry["chamber_l"], entry["inlet_mm"])
                for entry in trials
                for _ in range(entry["replicates"])
            ]
        if said.verdict == "adequate" and way == "asked":
            wanted = asked_for(made, said)
        if way == "advised" and not wanted and (said.verdict == "adequate" or len(look.names) == 1):
            wanted = informative(said, look)
    for k in range(4 - len(wanted)):
        count = len(made.settings) + k
        if way in ("advised", "asked") and trials_to_go(look):
            like = made.settings[-1 - k % len(made.settings)]
            wanted.append((like.pressure_kPa, like.chamber_l, like.inlet_mm))
        elif way != "random":
            pressure = LOW_KPA * (HIGH_KPA / LOW_KPA) ** ((count % 5) / 4)
            wanted.append((pressure, CHAMBERS_L[count % 2], INLETS_MM[count % 3]))
        else:
            pressure = math.exp(draw.uniform(math.log(LOW_KPA), math.log(HIGH_KPA)))
            wanted.append((pressure, float(draw.choice(CHAMBERS_L)), float(draw.choice(INLETS_MM))))
    for pressure, chamber, inlet in wanted:
        made.make(pressure, chamber, inlet)


def asked_for(made: Sequence, said: vt.Diagnosis) -> list[tuple[float, float, float]]:
    """Pressure, chamber and inlet of the trials that would show the effect one is after."""
    name = made.effect or "inlet_loss"
    fit, value = said.fits[0], EFFECTS[name][1]
    now = {entry.effect: entry for entry in fit_power(fit, CANDIDATES).effects}.get(name)
    if now is None:
        return []
    plan = further_trials(design_of_fit(fit, CANDIDATES), now, value, 0.9, LIMITS)
    cells = [sheet_cells(added.trial) for added in plan.trials]
    return [(cell["pressure_kPa"], cell["chamber_l"], cell["inlet_mm"]) for cell in cells]


def informative(said: vt.Diagnosis, look: CampaignLook) -> list[tuple[float, float, float]]:
    """Pressure, chamber and inlet of the trials that reveal most, or confirm the effect that is named."""
    power, design = fit_power(said.fits[0], CANDIDATES), design_of_fit(said.fits[0], CANDIDATES)
    if said.verdict == "adequate":
        plan = exploratory_trials(design, power, LIMITS)
    else:
        plan = confirming_trials(design, power, look.names[0], look.rival, LIMITS)
    return [
        (entry["pressure_kPa"], entry["chamber_l"], entry["inlet_mm"])
        for entry in (plan.trials if plan is not None else ())
        for _ in range(entry["replicates"])
    ]


def sequence(made: Sequence, way: str, said: vt.Diagnosis, risk: float, most: int) -> Line:
    """One campaign from its first look, which `said` holds, to its end."""
    begin, draw, looks = time.perf_counter(), np.random.default_rng([made.seed, 9]), []
    made = replace(made, recordings=list(made.recordings), settings=list(made.settings))
    while True:
        look = look_at(said, len(made.recordings), risk)
        looks.append(f"{look.trials}:{look.verdict}:{'|'.join(look.names)}:{look.log_ratio:.1f}")
        if look.decision == STOP or len(made.recordings) >= most:
            break
        four_more(made, way, said, look, draw)
        said = made.diagnosed()
    stopped = look.decision == STOP
    return {
        "seed": made.seed, "effect": made.effect, "way": way, "size": next(iter(made.physics.values()), ""),
        "trials": len(made.recordings), "stopped": stopped, "right": stopped and look.names == (made.effect,),
        "named": "|".join(look.names), "looks": "; ".join(looks), "seconds": round(time.perf_counter() - begin),
    }  # fmt: skip


def kept(path: Path | None) -> list[Line]:
    """What an earlier run has written."""
    if path is None or not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return [dict(row) for row in csv.DictReader(stream)]


def report(lines: list[Line], most: int) -> None:
    """A row an effect and a way; what the advice saves; wrong stops of all."""
    print(f"{'effect':22s}{'way':10s}{'campaigns':>10s}{'right':>7s}{'wrong':>7s}{'trials, mean':>14s}{'median':>8s}")
    for effect in dict.fromkeys(str(line["effect"]) for line in lines):
        for way in dict.fromkeys(str(line["way"]) for line in lines):
            rows = [line for line in lines if (line["effect"], line["way"]) == (effect, way)]
            if rows:
                trials = [trials_of(line, most) for line in rows]
                print(
                    f"{effect or 'nothing':22s}{way:10s}{len(rows):10d}{sum(is_right(line) for line in rows):7d}"
                    f"{sum(is_wrong(line) for line in rows):7d}{np.mean(trials):14.1f}{np.median(trials):8.0f}"
                )
    for way in ("advised", "asked"):
        for other in ("grid", "random"):
            ratio_row(lines, way, other, most)
    for way in (*dict.fromkeys(str(line["way"]) for line in lines), ""):
        rows = [line for line in lines if way in ("", line["way"])]
        wrong = sum(is_wrong(line) for line in rows)
        if rows:
            ends = binomtest(wrong, len(rows)).proportion_ci(0.95, method="exact")
            interval = f"{100 * ends.low:.1f}–{100 * ends.high:.1f} %"
            print(f"wrong stops, {way or 'all'}: {wrong} of {len(rows)} ({interval})")


def keep(path: Path, line: Line) -> None:
    """Append an answer."""
    fresh = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        if fresh:
            writer.writeheader()
        writer.writerow(line)


def is_right(line: Line) -> bool:
    """Whether a campaign stopped with the right name alone."""
    return str(line["right"]) == "True"


def is_wrong(line: Line) -> bool:
    """Whether a campaign stopped with anything else."""
    return str(line["stopped"]) == "True" and not is_right(line)


def trials_of(line: Line, most: int) -> int:
    """Trials until the right name, `most` where it was not reached."""
    return int(str(line["trials"])) if is_right(line) else most


def ratio_row(lines: list[Line], chosen: str, other: str, most: int) -> None:
    """Print trials of one way over those of another, of campaigns with an effect that were made both ways."""
    by_way = {
        way: {(str(line["seed"]), line["effect"]): trials_of(line, most) for line in lines
              if line["way"] == way and line["effect"]}
        for way in (chosen, other)
    }  # fmt: skip
    both = [(by_way[chosen][key], by_way[other][key]) for key in by_way[chosen] if key in by_way[other]]
    for name, pairs in (("all", both), ("undecided by the first six", [pair for pair in both if max(pair) > 6])):
        if pairs:
            advised, others = np.mean(pairs, axis=0)
            further = (advised - 6) / (others - 6) if others > 6 else math.nan
            print(
                f"{chosen} over {other}, {name}: {len(pairs)} campaigns, trials {advised:.1f} to {others:.1f}, ratio "
                f"{advised / others:.2f}; beyond the first six {further:.2f}"
            )


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=3, help="seeds")
    parser.add_argument("--first-seed", type=int, default=FIRST_TUNING_SEED)
    parser.add_argument(
        "--effects",
        default=",".join(name for name in EFFECTS if name),
        help="names, comma-separated; blank for nothing",
    )
    parser.add_argument("--ways", default="advised,asked,grid,random")
    parser.add_argument("--risk", type=float, default=0.03)
    parser.add_argument("--most", type=int, default=30)
    parser.add_argument("--answers", type=Path, help="CSV that keeps every answer")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no campaign is begun")
    given = parser.parse_args()
    lines, begin = kept(given.answers), time.monotonic()
    done = {(int(str(line["seed"])), line["effect"], line["way"]) for line in lines}
    for seed in range(given.first_seed, given.first_seed + given.campaigns):
        for effect in given.effects.split(","):
            ways = [way for way in given.ways.split(",") if (seed, effect, way) not in done]
            if not ways or time.monotonic() - begin > 60 * given.minutes:
                continue
            made = begun(seed, effect)
            said = made.diagnosed()
            for way in ways:
                line = sequence(made, way, said, given.risk, given.most)
                lines.append(line)
                print(json.dumps(line), flush=True)
                if given.answers is not None:
                    keep(given.answers, line)
    report(lines, given.most)


if __name__ == "__main__":
    main()
