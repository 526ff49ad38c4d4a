"""Simple laws that a missing force may follow, each a row of `force_laws.csv` beside this file.

A row holds the size (name, symbol and unit), the law as code of an effect file and as a formula, the kinds that it is
also tried multiplied by, and its shape parameters (name, symbol, unit), each with the values that are tried, as parts
of the `largest` growth, speed or time. All of these are chosen. Values beyond 0 are spaced by ratios.

Every law is scaled to a peak of 1 along the fitted motions, so that its amplitude is the largest force, N. A periodic
law has two amplitudes, of a sine and a cosine. Laws with a position or a scale come in a grid of them.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import NamedTuple

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import FittedMotion


@dataclass(frozen=True)
class Law:
    """One form of force along a motion: its kind, by its name in `FORMS`, the values of its shape parameters, SI, and
    the kind that it is multiplied by: "position", "speed", "pressure" or nothing. The phase of a periodic law is free.
    """

    kind: str
    shapes: tuple[float, ...] = ()
    factor: str = ""
    reference_area_m2: float = 0.0
    peak: float = 1.0

    @property
    def name(self) -> str:
        """Name of the law: its kind and factor."""
        return f"{self.kind}_by_{self.factor}" if self.factor else self.kind

    @property
    def n_amplitudes(self) -> int:
        """Number of its amplitudes."""
        return 2 if self.kind == "periodic" else 1

    @property
    def n_shapes(self) -> int:
        """Number of shape parameters that are searched over."""
        return sum(len(shape.parts) > 1 for shape in FORMS[self.kind].shapes)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        # 1e-3: least width of a local force that is reported (chosen)
        return self.kind == "patch" and not sum(self.shapes) - max(self.shapes[0], 0.0) > 1e-3

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion: as it is and, where periodic, a quarter of a period ahead.
        Shape (n_times, n_amplitudes).
        """
        size = (motion.trial.area_m2 / self.reference_area_m2 if self.reference_area_m2 else 1.0) / self.peak
        phases = [self.shapes, (*self.shapes[:1], math.pi / 2)][: self.n_amplitudes]
        force = np.column_stack([FORMS[self.kind].along(motion, shapes) for shapes in phases])
        return size * (force * FORMS[self.factor].along(motion)[:, None] if self.factor else force)


# States of a motion by their names in an effect file
STATE = {
    "lead_position": "lead_position_m", "tail_position": "tail_position_m", "tail_velocity": "tail_velocity_m_s",
    "pressure": "pressure_Pa", "time": "time_s",
}  # fmt: skip


class Shape(NamedTuple):
    """A shape parameter of a law, and the values that are tried."""

    name: str
    symbol: str
    unit: str
    parts: tuple[float, ...]


@dataclass(frozen=True)
class LawForm:
    """A kind of law: a row of `force_laws.csv`."""

    size: tuple[str, str, str]
    code: str
    compiled: CodeType
    formula: str
    times: tuple[str, ...]
    largest: str
    shapes: tuple[Shape, ...]

    def along(self, motion: FittedMotion, shapes: Sequence[float] = ()) -> Floats:
        """The shape along a motion, as its code says, shape (n_times,)."""
        state = SimpleNamespace(**{name: getattr(motion, attribute) for name, attribute in STATE.items()})
        known = dict(zip((shape.name for shape in self.shapes), shapes, strict=True))
        return np.asarray(eval(self.compiled, {"np": np, "s": state, **known}) + 0.0 * motion.time_s)


def _read_forms() -> dict[str, LawForm]:
    forms = {}
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            described = [each.split(":") for each in row["shapes"].split(";") if each]
            shapes = tuple(
                Shape(name, symbol, unit, tuple(map(float, parts.split())))
                for names, parts in described
                for name, symbol, unit in [names.split()]
            )
            size, code = (row["size"], row["symbol"], row["unit"]), compile(row["code"], row["kind"], "eval")
            times = tuple(row["times"].split())
            forms[row["kind"]] = LawForm(size, row["code"], code, row["formula"], times, row["largest"], shapes)
    return forms


FORMS = _read_forms()  # Every kind of law by its name


def laws_on_grid(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, also each in proportion to the cross-section."""
    largest = _largest(motions)
    laws = [
        Law(kind, tuple(part * largest[form.largest] for part in parts), factor)
        for kind, form in FORMS.items()
        for parts in itertools.product(*(shape.parts for shape in form.shapes))
        for factor in ("", *form.times)
    ]
    areas = [motion.trial.area_m2 for motion in motions]
    # 1.02: ratio of cross-sections up to which two vines count as equally wide (chosen)
    if max(areas) > 1.02 * min(areas):
        mean_m2 = float(np.mean(areas))
        laws += [replace(law, reference_area_m2=mean_m2) for law in laws if "pressure" not in (law.kind, law.factor)]
    return _with_unit_peak(laws, motions)


def laws_near(law: Law, motions: Sequence[FittedMotion], part: float) -> list[Law]:
    """Laws near another: each shape that is searched over varied by less than this part of a step of the grid."""
    form, varied = FORMS[law.kind], []
    for value, shape in zip(law.shapes, form.shapes, strict=True):
        first, last, steps = shape.parts[0], shape.parts[-1], len(shape.parts) - 1
        change = part * np.linspace(-0.75, 0.75, 9) / steps if steps else np.zeros(1)
        if first > 0:
            values = value * (last / first) ** change
        else:
            values = value + _largest(motions)[form.largest] * (last - first) * change
        varied.append(values.tolist())
    return _with_unit_peak([replace(law, shapes=shapes) for shapes in itertools.product(*varied)], motions)


def _with_unit_peak(laws: Sequence[Law], motions: Sequence[FittedMotion]) -> list[Law]:
    """The laws scaled to a peak of 1 along the motions, without patches that act only at the start. Those that peak at
    rest, where positions do not determine the speed, are scaled to 1 at the lowest speed observed.
    """
    # 0.05: part of the growth over which a vine accelerates; the size of a law at rest is not observed (chosen)
    started = [(motion.lead_position_m >= 0.05 * motion.lead_position_m.max())[motion.is_visited] for motion in motions]
    scaled = []
    for law in (replace(law, peak=1.0) for law in laws):
        forces = [np.abs(law.unit_force(motion))[motion.is_visited] for motion in motions]
        peak = 1.0 if law.kind == "periodic" else max(float(force.max()) for force in forces)
        peak_after_start = max(
            float(np.max(force[after], initial=0.0)) for force, after in zip(forces, started, strict=True)
        )
        if law.kind in ("inverse_speed", "falling_with_speed"):
            peak = peak_after_start
        if law.kind != "patch" or peak_after_start >= 0.5 * peak:
            scaled.append(replace(law, peak=peak or 1.0))
    return scaled


def _largest(motions: Sequence[FittedMotion]) -> dict[str, float]:
    """The largest growth, m, speed of the tail, m/s, and time, s, among the motions."""
    return {
        "growth": max(float(motion.lead_position_m[motion.is_visited].max()) for motion in motions),
        "speed": max(float(np.quantile(motion.tail_velocity_m_s[motion.is_visited], 0.98)) for motion in motions),
        "time": max(float(motion.time_s[motion.is_visited].max()) for motion in motions),
    }
