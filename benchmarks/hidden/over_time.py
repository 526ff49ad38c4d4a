"""Faults that follow the calendar: a supply that empties, a regulator, a gauge and a camera that are set anew."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from hidden.shots import Draw, Fault, Laboratory, Shot


def supply_falls(part: float) -> Fault:
    """The pressure falls by this part of it over the campaign, evenly from trial to trial."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        rate = part / len(laboratory.shots)
        shots = (_at(shot, shot.tube.pressure * (1 - rate * k)) for k, shot in enumerate(laboratory.shots))
        return replace(laboratory, shots=tuple(shots)).known(**{"order_drift.P": -rate})

    return apply


def regulator_reset(part: float) -> Fault:
    """From a trial in the middle of the campaign on the pressure is lower by this part of it."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        first = int(draw.uniform(0.3, 0.7) * len(laboratory.shots))
        shots = (
            _at(shot, shot.tube.pressure * (1 - part)) if k >= first else shot
            for k, shot in enumerate(laboratory.shots)
        )
        return replace(laboratory, shots=tuple(shots)).known(**{"order_drift.step": math.log1p(-part)})

    return apply


def gain_by_day(sigma: float) -> Fault:
    """The regulator is set anew each of three to five days, to a few per cent of what the sheet says."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        gains = sigma * draw.standard_normal(int(draw.integers(3, 6)))
        shots = (
            replace(_at(shot, shot.tube.pressure * math.exp(gains[day])), day=str(day + 1))
            for day, shot in _by_day(laboratory, gains.size)
        )
        return replace(laboratory, shots=tuple(shots))

    return apply


def zero_by_day(sigma_kPa: float) -> Fault:
    """The gauge has another zero each of three to five days: the tube gets the pressure read plus that."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        zeros_Pa = 1e3 * sigma_kPa * draw.standard_normal(int(draw.integers(3, 6)))
        shots = (
            replace(_at(shot, shot.tube.pressure + float(zeros_Pa[day])), day=str(day + 1))
            for day, shot in _by_day(laboratory, zeros_Pa.size)
        )
        return replace(laboratory, shots=tuple(shots)).known(
            **{f"zero_kPa.day{d + 1}": float(z) / 1e3 for d, z in enumerate(zeros_Pa)}
        )

    return apply


def camera_of_a_day(low: float, high: float, *, clock: bool) -> Fault:
    """On the second of two days the frame rate, or the scale, is off by so much, either way."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        error = float(draw.choice([-1.0, 1.0])) * float(draw.uniform(low, high))
        off = {"clock" if clock else "scale": error}
        shots = (replace(shot, day=str(day + 1), **(off if day else {})) for day, shot in _by_day(laboratory, 2))
        return replace(laboratory, shots=tuple(shots))

    return apply


def _at(shot: Shot, pressure_Pa: float) -> Shot:
    return replace(shot, tube=shot.tube._replace(pressure=pressure_Pa))


def _by_day(laboratory: Laboratory, days: int) -> Iterator[tuple[int, Shot]]:
    """Every trial with the day that it was made on, from 0: as many trials each day, in their order."""
    count = len(laboratory.shots)
    return ((k * days // count, shot) for k, shot in enumerate(laboratory.shots))
