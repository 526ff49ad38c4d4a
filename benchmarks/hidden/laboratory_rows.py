"""Campaigns of kinds of laboratory, `hidden.laboratory_kinds`, and their truth.

A row with `_unknown` at its end holds the same data as the one without, but its sheet says neither specimen, day nor
order: its rows then stand in the order of the trials.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hidden import laboratories as faults
from hidden.balls import drops
from hidden.laboratory_kinds import TRIALS, Row, every_row
from hidden.shots import Camera, Campaign, Draw, Laboratory, careful, film, plan
from hidden.visibility import visible_sigma

ROWS: Mapping[str, Row] = {row.name: row for row in every_row()}


def campaign(name: str, seed: int, trials: tuple[int, int] = TRIALS, *, weighed: bool = True) -> Campaign:
    """The campaign of this row and seed, with as many trials; the same ones give the same numbers.

    Unless it is `weighed`, the fault may be one that does not show.

    Raises
    ------
    KeyError
        If there is no such row; see `ROWS`.
    """
    row = ROWS[name]
    for attempt in range(50):
        draw = np.random.default_rng([zlib.crc32(row.family.encode()), seed, attempt])
        found = _falling(row, seed, draw) if row.model else _growing(row, seed, draw, trials, weighed)
        if found is not None:
            return found
    raise RuntimeError(f"No campaign of row {name} moves with seed {seed}.")


def _growing(row: Row, seed: int, draw: Draw, trials: tuple[int, int], weighed: bool) -> Campaign | None:
    laboratory = careful(plan(draw, replace(row.wants, trials=trials), row.accept), draw, row.quiet)
    laboratory = faults.together(*row.faults)(laboratory, draw)
    laboratory = replace(laboratory, columns=row.columns)
    recordings = film(laboratory, draw)
    if recordings is None:
        return None
    if weighed and row.least_sigma is not None:
        laboratory = laboratory.known(visible_sigma=visible_sigma(laboratory))
        if laboratory.truths["visible_sigma"] < row.least_sigma:
            return None
    return Campaign(recordings, {"ambient_pressure_kPa": 101.325}, _truth(row, seed, laboratory, len(recordings)))


def _truth(row: Row, seed: int, laboratory: Laboratory, count: int) -> dict[str, object]:
    vines = dict.fromkeys(shot.setting.vine for shot in laboratory.shots)
    settings = [shot.setting for shot in laboratory.shots]
    truths = dict(laboratory.truths)
    exponents = {shot.physics.n for shot in laboratory.shots}
    if len(exponents) == 1:
        truths["eversion_damping.n"] = exponents.pop()
    if len(vines) == 1 and not {"wear", "specimen_sigma", "specimen_B"} & set(truths):
        truths["eversion_damping.B"] = settings[0].vine.B
    camera: Camera = laboratory.camera
    return {
        "row": row.name,
        "seed": seed,
        "should": row.should.to_json(),
        "truths": truths,
        "vines": [{**vars(vine), "B": vine.B, "n": vine.n} for vine in vines],
        "n_trials": count,
        "pressures_kPa": sorted({one.pressure_kPa for one in settings}),
        "camera": {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in vars(camera).items()},
        "trials": [
            {
                "order": k + 1,
                "specimen": shot.specimen,
                "day": shot.day,
                "B": shot.physics.B,
                "n": shot.physics.n,
                "pressure_Pa": shot.tube.pressure,
                "yield_pressure_Pa": shot.tube.yield_pressure,
            }
            for k, shot in enumerate(laboratory.shots)
        ],
    }


def _falling(row: Row, seed: int, draw: Draw) -> Campaign:
    recordings = drops(draw, (8, 12), C_D=0.5, noise_m=2e-3)
    truth = {
        "row": row.name,
        "seed": seed,
        "should": row.should.to_json(),
        "truths": {"air_drag.C_D": 0.5, "noise_m": 2e-3},
        "n_trials": len(recordings),
    }
    return Campaign(recordings, {"ambient_pressure_kPa": 101.325, "model": list(row.model)}, truth)
