"""Whether the next trial of a rig lies within its 95 % band: hidden campaigns and real repeats.

    python benchmarks/prediction_band.py [--campaigns 20] [--first-seed 20000] [--trials 5] [--left-out 3]
    VINETRACK_REAL_DATA=FOLDER python benchmarks/prediction_band.py --real

Campaigns come from the simulator that shares no code with the package (`benchmarks/hidden`), with its noise regimes and
nuisances. Three trials (`--left-out`) are left out at random, the model is fitted to the others, or to so many of them
as `--trials` says, and predicts these (`vinetrack.predict`). A position is within its band where measured minus
predicted is no larger than `band_m` at that time. Counted are the mean share of positions within, every trial alike,
and the trials of which at least nine positions in ten are. `true` is the model with the hidden effect, `Eq. (2)` that
without it: what is missed then has to widen the band.

`--real`: every one of the eight stacks of cups predicted from the other seven, every one of six recordings of three
everting tubes from the other five under Eq. (2), and under Eq. (2) from the one other recording of its tube alone.

Seeds 20000–20999 are for tuning, from 30000 on for scoring.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from hidden import make
from rich.progress import track
from tube.folder import write_folder
from tube.recordings import read_recordings

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.inference.fit_data import pairs_of
from vinetrack.inference.fit_result import TrialFit

Pairs = Sequence[tuple[Trial, Track]]
KINDS = ("null:anything", "null:few_trials", "reservoir_depletion", "air_drag", "tail_friction", "pressure_gain")
MOSTLY = 0.9


def row(trial: TrialFit) -> dict[str, object]:
    """One predicted trial against its band."""
    assert trial.band_m is not None
    return {
        "trial": trial.name,
        "rms_mm": 1e3 * trial.rms_m,
        "band_mm": 1e3 * float(np.median(trial.band_m)),
        "within": trial.within_band,
        "held": trial.within_band >= MOSTLY,
    }


def measure(kind: str, seed: int, trials: int | None, count: int) -> Iterator[dict[str, object]]:
    """The left-out trials of one campaign, predicted by the true model and by Eq. (2)."""
    campaign, draw = make(kind, seed), np.random.default_rng([seed, 81])
    order = draw.permutation(len(campaign.pairs)).tolist()
    left = [campaign.pairs[i] for i in order[:count]]
    vines = {trial.vine for trial, _ in left}
    rest = [campaign.pairs[i] for i in order[count:] if trials is None or campaign.pairs[i][0].vine in vines]
    known = {trial.vine for trial, _ in rest[:trials]}
    models = {"Eq. (2)": vt.base_model()}
    effects = campaign.truth.effects
    if effects:
        models["true"] = vt.make_model([*vt.base_model().names, *effects])
    for name, model in models.items():
        try:
            fit = vt.fit(model, rest[:trials])
            predicted = vt.predict(fit, [pair for pair in left if pair[0].vine in known])
        except (vt.FitError, vt.EffectError) as error:
            print(f"{kind} {seed}, {name}: {error}")
            continue
        yield from ({"kind": kind, "model": name, "seed": seed, **row(trial)} for trial in predicted)


def real(folder: Path) -> Iterator[dict[str, object]]:
    """Cups and tubes, each predicted from its repeats."""
    cups, _ = pairs_of(vt.read_experiment(folder / "falling_cups"))
    drag = vt.make_model(["gravity", "air_drag"])
    recordings = read_recordings(folder / "everting_tube") + read_recordings(folder / "everting_tube_repeats")
    tube_of = {one.name: one.tube for one in recordings}
    with tempfile.TemporaryDirectory() as scratch:
        tubes, _ = pairs_of(vt.read_experiment(write_folder(recordings, Path(scratch) / "tubes")))
    for kind, model, pairs in (("cups", drag, cups), ("tubes", vt.base_model(), tubes)):
        for k, pair in enumerate(pairs):
            fit = vt.fit(model, [*pairs[:k], *pairs[k + 1 :]])
            yield {"kind": kind, "model": "all others", **row(vt.predict(fit, [pair])[0])}
    for pair in tubes:
        own = [one for one in tubes if tube_of[one[0].name] == tube_of[pair[0].name] and one is not pair]
        yield {"kind": "tubes", "model": "one other", **row(vt.predict(vt.fit(vt.base_model(), own), [pair])[0])}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=20, help="of each kind")
    parser.add_argument("--first-seed", type=int, default=20000)
    parser.add_argument("--trials", type=int, help="fit so many trials only")
    parser.add_argument("--left-out", type=int, default=3, help="trials left out of each campaign")
    parser.add_argument("--kinds", nargs="+", default=KINDS)
    parser.add_argument("--real", action="store_true")
    given = parser.parse_args()
    if given.real:
        table = pd.DataFrame(real(Path(os.environ["VINETRACK_REAL_DATA"])))
        print(table.round(2).to_string(index=False))
    else:
        seeds = range(given.first_seed, given.first_seed + given.campaigns)
        jobs = track([(kind, seed) for kind in given.kinds for seed in seeds])
        table = pd.DataFrame([one for kind, seed in jobs for one in measure(kind, seed, given.trials, given.left_out)])
    found = table.groupby(["kind", "model"]).agg(
        trials=("held", "size"), held=("held", "mean"), within=("within", "mean"),
        rms_mm=("rms_mm", "median"), band_mm=("band_mm", "median"),
    )  # fmt: skip
    print(found.round(3).to_string())
    print(f"all: {table['held'].mean():.3f} of {len(table)} trials held, {table['within'].mean():.3f} of positions")


if __name__ == "__main__":
    main()
