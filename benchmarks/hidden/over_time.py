"""Faults that follow the calendar: a supply that empties, a regulator, a gauge and a camera that are set anew."""

from __future__ import annotations

import math
from dataclasses import replace

from hidden.shots import Draw, Fault, Laboratory


def supply_falls(part: float) -> Fault:
    """The pressure falls by this part of it over the campaign, evenly from trial to trial."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        rate = part / len(laboratory.shots)
        shots = (
            replace(shot, tube=shot.tube._replace(pressure=shot.tube.pressure * (1 - rate * k)))
            for k, shot in enumerate(laboratory.shots)
        )
        return replace(laboratory, shots=tuple(shots)).known(**{"order_drift.P": -rate})

    return apply


def regulator_reset(part: float) -> Fault:
    """From a trial in the middle of the campaign on the pressure is lower by this part of it."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        first = int(draw.uniform(0.3, 0.7) * len(laboratory.shots))
        shots = (
            replace(shot, tube=shot.tube._replace(pressure=shot.tube.pressure * (1 - part))) if k >= first else shot
            for k, shot in enumerate(laboratory.shots)
        )
        return replace(laboratory, shots=tuple(shots)).known(**{"order_drift.step": math.log1p(-part)})

    return apply


def gain_by_day(sigma: float) -> Fault:
    """The regulator is set anew each of three to five days, to a few per cent of what the sheet says."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        days = int(draw.integers(3, 6))
        gains = sigma * draw.standard_normal(days)
        count = len(laboratory.shots)
        shots = []
        for k, shot in enumerate(laboratory.shots):
            day = k * days // count
            tube = shot.tube._replace(pressure=shot.tube.pressure * math.exp(gains[day]))
            shots.append(replace(shot, tube=tube, day=str(day + 1)))
        return replace(laboratory, shots=tuple(shots))

    return apply


def camera_of_a_day(low: float, high: float, *, clock: bool) -> Fault:
    """On the second of two days the frame rate, or the scale, is off by so much, either way."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        error = float(draw.choice([-1.0, 1.0])) * float(draw.uniform(low, high))
        count = len(laboratory.shots)
        shots = []
        for k, shot in enumerate(laboratory.shots):
            second = 2 * k >= count
            off = error if second else 0.0
            shots.append(
                replace(shot, day="2" if second else "1", scale=0.0 if clock else off, clock=off if clock else 0.0)
            )
        return replace(laboratory, shots=tuple(shots))

    return apply


def zero_by_day(sigma_kPa: float) -> Fault:
    """The gauge has another zero each of three to five days: the tube gets the pressure read plus that."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        days = int(draw.integers(3, 6))
        zeros_Pa = 1e3 * sigma_kPa * draw.standard_normal(days)
        count = len(laboratory.shots)
        shots = []
        for k, shot in enumerate(laboratory.shots):
            day = k * days // count
            tube = shot.tube._replace(pressure=shot.tube.pressure + float(zeros_Pa[day]))
            shots.append(replace(shot, tube=tube, day=str(day + 1)))
        return replace(laboratory, shots=tuple(shots)).known(
            **{f"zero_kPa.day{d + 1}": float(z) / 1e3 for d, z in enumerate(zeros_Pa)}
        )

    return apply
