"""From a missing force to an effect: laws that it looks like, each fitted in the equation of motion, the best a file.

The force that a model lacks is held against simple laws along the fitted motions (`missing_force`). Here the laws that
explain most of it become effects with their numbers as parameters. Each is fitted with the model, like any effect that
is added by hand; they are compared as the diagnosis compares hypotheses, and by their error on conditions left out.
"""

from __future__ import annotations

import math
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from vinetrack.diagnosis.add import both_fits
from vinetrack.diagnosis.force_laws import EDGE
from vinetrack.diagnosis.initial_fit import candidates_of, initial_fit, with_host
from vinetrack.diagnosis.ladder import left_out
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    MAX_INFLATION,
    LikelihoodRatio,
    answer_set,
    likelihood_ratio,
)
from vinetrack.diagnosis.misfit_tests import FAR_OFF_CHI2_PER_DOF
from vinetrack.diagnosis.missing_force import MENDS, SeenLaw, missing_force
from vinetrack.diagnosis.multi_start import restart_exponents
from vinetrack.diagnosis.proposed_table import WORTH, ProposedTable, proposed_table
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, load_effect, remember
from vinetrack.inference.fit_data import FitError, Pairs
from vinetrack.inference.fit_result import Fit
from vinetrack.narrative.verdict_summary import joined

MOST_PROPOSED = 4
"""Laws that are fitted in the equation of motion at most. Chosen for time: a fit each, 5 to 20 s."""

BEHIND = 0.2
"""Laws that explain less than the best by more than this part are not fitted. Chosen: twice what single trials make of
it; at half a right law whose linear fit errs is dropped, at twice laws are fitted that no likelihood comes back to."""


@dataclass(frozen=True)
class _Expression:
    """How a law is written: its size, the shape in code and in symbols, and the numbers that shape it.

    The size has a name, a symbol and a unit, by its exponents of N, m, s and Pa.
    """

    size: tuple[str, str, tuple[int, int, int, int]]
    code: str
    formula: str
    shapes: tuple[tuple[str, str, str], ...] = ()


_SPEED, _TIME, _LENGTH = ("v_0", "v₀", "m/s"), ("t_0", "t₀", "s"), ("reach", "ℓ", "m")
_THRESHOLD = ("v_1", "v₁", "m/s")
_FORCE = ("F", "F", (1, 0, 0, 0))
_EXPRESSIONS = {
    "constant": _Expression(_FORCE, "1.0", "F"),
    "position": _Expression(("k", "k", (1, -1, 0, 0)), "s.tail_position", "k x"),
    "speed": _Expression(("b", "b", (1, -1, 1, 0)), "s.tail_velocity", "b ẋ"),
    "speed_squared": _Expression(("c", "c", (1, -2, 2, 0)), "s.tail_velocity * s.tail_velocity", "c ẋ²"),
    "position_squared": _Expression(("q", "q", (1, -2, 0, 0)), "s.tail_position * s.tail_position", "q x²"),
    "beyond_a_place": _Expression(
        ("k", "k", (1, -1, 0, 0)),
        "np.maximum(s.lead_position - y_0, 0.0)",
        "k max(0, y − y₀)",
        (("y_0", "y₀", "m"),),
    ),
    "speed_cubed": _Expression(
        ("c", "c", (1, -3, 3, 0)), "s.tail_velocity * s.tail_velocity * s.tail_velocity", "c ẋ³"
    ),
    "beyond_a_speed": _Expression(
        ("b", "b", (1, -1, 1, 0)), "np.maximum(s.tail_velocity - v_1, 0.0)", "b max(0, ẋ − v₁)", (_THRESHOLD,)
    ),
    "squared_beyond_a_speed": _Expression(
        ("c", "c", (1, -2, 2, 0)), "np.maximum(s.tail_velocity - v_1, 0.0) ** 2", "c max(0, ẋ − v₁)²", (_THRESHOLD,)
    ),
    "pressure": _Expression(("a", "a", (1, 0, 0, -1)), "s.pressure", "a P"),
    "time": _Expression(("r", "r", (1, 0, -1, 0)), "s.time", "r t"),
    "inverse_speed": _Expression(_FORCE, "v_0 / np.maximum(s.tail_velocity, v_0)", "F v₀/max(ẋ, v₀)", (_SPEED,)),
    "falling_with_speed": _Expression(_FORCE, "np.exp(-s.tail_velocity / v_0)", "F exp(−ẋ/v₀)", (_SPEED,)),
    "fading_in_time": _Expression(_FORCE, "np.exp(-s.time / t_0)", "F exp(−t/t₀)", (_TIME,)),
    "fading_along": _Expression(_FORCE, "np.exp(-s.lead_position / reach)", "F exp(−y/ℓ)", (_LENGTH,)),
    "patch": _Expression(
        _FORCE,
        f"0.5 * (np.tanh((s.lead_position - y_1) / ({EDGE} * width))"
        f" - np.tanh((s.lead_position - y_1 - width) / ({EDGE} * width)))",
        f"½F (tanh((y − y₁)/{EDGE}w) − tanh((y − y₁ − w)/{EDGE}w))",
        (("y_1", "y₁", "m"), ("width", "w", "m")),
    ),
    "periodic": _Expression(
        _FORCE,
        "np.sin(2.0 * np.pi * s.lead_position / period + phi)",
        "F sin(2π y/Λ + φ)",
        (("period", "Λ", "m"), ("phi", "φ", "rad")),
    ),
}

_TIMES = {
    "position": ("s.tail_position", "x", (0, -1, 0, 0)),
    "speed": ("s.tail_velocity", "ẋ", (0, -1, 1, 0)),
    "pressure": ("s.pressure", "P", (0, 0, 0, -1)),
}
"""What a law may be multiplied by: code, symbol, and what it does to the unit of the size."""

_AT = {"lead_position": 0.1, "tail_position": 0.2, "tail_velocity": 2.0, "pressure": 20e3, "time": 0.05}
"""State of the worked number; a convention of this file."""

_UNITS = {"lead_position": "_m", "tail_position": "_m", "tail_velocity": "_m_s", "pressure": "_Pa", "time": "_s"}
"""What the names in a state end with in a `FittedMotion`."""


@dataclass(frozen=True)
class ProposedLaw:
    """A law as an effect that was fitted.

    `rms_left_out_m` is its error on conditions left out, m; NaN where others fit far better.
    """

    seen: SeenLaw
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float

    @property
    def words(self) -> str:
        """What it looks like, with its size."""
        return self.seen.words


@dataclass(frozen=True)
class Proposal:
    """Laws that mend a model, best first, and what the model without them errs by, m.

    `tied` are those that the data do not exclude; none where no law is worth proposing, and `reason` says why.
    `table` is the learned force where it takes away what no law does.
    """

    before: Fit
    rms_left_out_m: float
    laws: tuple[ProposedLaw, ...]
    tied: tuple[ProposedLaw, ...]
    reason: str = ""
    table: ProposedTable | None = None

    def sentences(self) -> list[str]:
        """What was tried and what came of it, a line a sentence."""
        return [*self._of_laws(), *([] if self.table is None else self.table.sentences(self.before))]

    def _of_laws(self) -> list[str]:
        if not self.tied:
            return [self.reason if self.table else f"{self.reason.removesuffix('.')}; nothing is proposed."]
        best = self.tied[0]
        lines = [
            f"{law.words}: Δχ² = {law.ratio.delta_chi2:.0f} ({law.ratio.sigma:.1f} σ)"
            + (
                f", error on left-out conditions {1e3 * self.rms_left_out_m:.2f} → {1e3 * law.rms_left_out_m:.2f} mm"
                if math.isfinite(law.rms_left_out_m)
                else ""
            )
            + (" (not excluded)" if law in self.tied and law is not best else "")
            for law in self.laws
        ]
        lines.append(f"Proposed: {best.words}.")
        if len(self.tied) > 1:
            lines.append(f"These data would nearly as well have {joined([law.words for law in self.tied[1:]])}.")
        return lines


def propose(model: Model, pairs: Pairs, report: Callable[[str], None]) -> Proposal:
    """The laws of force that mend a model, each fitted in the equation of motion.

    Parameters
    ----------
    model : the model that lacks something.
    pairs : trials with their tracks.
    report : called with a sentence at each step.

    Returns
    -------
    Proposal
        With the learned force as a table where no law takes away what that does.

    Raises
    ------
    FitError
        If the model cannot be followed.
    """
    questioned = candidates_of(model, None, {})
    report("fitting the model")
    before = initial_fit(model, pairs, questioned, profile=False)
    if before.chi2_per_dof > FAR_OFF_CHI2_PER_DOF:
        before = restart_exponents(before)
    report("drawing the missing force")
    seen = missing_force(before, learn=False).seen
    near = [law for law in seen if law.explained > seen[0].explained - BEHIND][:MOST_PROPOSED]
    proposal = _of_laws(model, before, near, report)
    fits = [law.ratio.fit for law in proposal.tied]
    return replace(proposal, table=proposed_table(model, proposal.before, fits, report))


def _of_laws(model: Model, before: Fit, near: Sequence[SeenLaw], report: Callable[[str], None]) -> Proposal:
    """The laws fitted in the equation of motion, with those that the data do not exclude."""
    if not near:
        reason = "No simple law of force is seen in what the model leaves."
        return Proposal(before, left_out(before).rms_m, (), (), reason)
    with tempfile.TemporaryDirectory() as folder:
        effects = [_written(law, Path(folder)) for law in near]
        # Compiled without the catalogue, which nothing here asks for.
        before = with_host(before, Model((*model, *effects)))
        fitted = []
        for law, effect in zip(near, effects, strict=True):
            try:
                start, after = both_fits(before, effect, report)
            except FitError:
                continue
            before = max((before, start), key=lambda fit: fit.log_likelihood)
            fitted.append((law, effect, likelihood_ratio(before, (effect,), after)))
        report("errors on left-out conditions")
        most = max((ratio.fit.log_likelihood for _, _, ratio in fitted), default=-math.inf)
        laws = [
            ProposedLaw(law, effect, ratio, left_out(ratio.fit).rms_m if _may_tie(ratio, most) else math.nan)
            for law, effect, ratio in fitted
        ]
    return _judged(before, laws)


def _may_tie(ratio: LikelihoodRatio, most: float) -> bool:
    """Whether a law can be in the answer set, however much single trials disagree; of others nothing more is asked."""
    return 2 * (most - ratio.fit.log_likelihood) < ANSWER_SET_DELTA_CHI2 * MAX_INFLATION


def _judged(before: Fit, laws: Sequence[ProposedLaw]) -> Proposal:
    """The laws in the order of their likelihood, with those that cannot be excluded."""
    error_m = left_out(before).rms_m
    laws = tuple(sorted(laws, key=lambda law: -law.ratio.fit.log_likelihood))
    misfit = max(before.chi2_per_dof - 1, 0.0)
    worth = [
        law
        for law in laws
        if law.ratio.sigma > WORTH
        and law.rms_left_out_m < error_m
        and (misfit < 1 or before.chi2_per_dof - law.ratio.fit.chi2_per_dof > MENDS * misfit)
    ]
    if not worth:
        reason = "No simple law of force mends the model and predicts left-out conditions better."
        return Proposal(before, error_m, laws, (), reason)
    kept, _ = answer_set([law.ratio for law in worth])
    tied = tuple(law for ratio in kept for law in worth if law.ratio is ratio)
    return Proposal(before, error_m, laws, tied)


def _written(law: SeenLaw, folder: Path) -> Effect:
    """A law as an effect, its file in this folder."""
    path = folder / f"proposed_{law.law.name}.py"
    path.write_text(effect_text(law), encoding="utf-8")
    remember(path)
    return load_effect(path)


def effect_text(seen: SeenLaw, remark: str = "") -> str:
    """An effect file that holds a law: docstring, parameters with units and bounds, the function, a worked number.

    Parameters
    ----------
    seen : the law with its size.
    remark : sentences about the data that it comes from, for the docstring.

    Returns
    -------
    str
    """
    law, written = seen.law, _EXPRESSIONS[seen.law.kind]
    by_code, by_symbol, by_unit = _TIMES.get(law.times, ("", "", (0, 0, 0, 0)))
    unit = _unit([a + b for a, b in zip(written.size[2], by_unit, strict=True)])
    size, shapes = _values(seen)
    names = [written.size[0], *(name for name, _, _ in written.shapes)]
    area = " * (s.area / AREA)" if law.by_area else ""
    at = _AT | ({"area": law.by_area} if law.by_area else {})
    worked = _force_N(seen)
    times = f" * {by_code}" if by_code else ""
    symbols = f" {by_symbol}" if by_symbol else ""
    formula = f"tail force {written.formula}{symbols}" + (
        " A/A₀, A₀ the mean cross-section of these vines" if area else ""
    )
    parts = [
        f'"""Proposed law: {seen.words}.\n',
        *textwrap.wrap(remark, 118),
        "" if remark else None,
        "It describes these data and explains nothing: what it stands for is for you to find. Forces count along the",
        "growth, so that a friction is negative.\n",
        f"    {formula}\n",
        "Measure it in trials that differ in what it hangs on, and hold the next ones against its prediction.",
        '"""\n',
        "import numpy as np\n",
        "from vinetrack.effects import Parameter, Worked\n",
        f"AREA = {law.by_area:.6g}  # m²\n" if area else None,
        "PARAMETERS = (",
        f"    {_size_parameter(written.size[0], written.size[1], unit, size)},",
        *(f"    {_shape_parameter(*number)}," for number in zip(written.shapes, shapes, strict=True)),
        ")\n\n",
        f"def tail_force(s, rig, {', '.join(names)}):",
        f"    return {names[0]} * ({written.code}){times}{area}\n\n",
        "WORKED = (",
        "    Worked(",
        '        "tail_force",',
        f"        {worked:.8g},",
        f'        "the law that was fitted, at this state: {size:.6g} × {worked / size:.6g}",',
        f"        state={at!r},",
        f"        parameters={dict(zip(names, (size, *shapes), strict=True))!r},",
        "    ),",
        ")",
    ]
    return "\n".join(part for part in parts if part is not None) + "\n"


def _values(seen: SeenLaw) -> tuple[float, tuple[float, ...]]:
    """Size and shape numbers of a law as its effect holds them, SI, rounded to what is printed."""
    law, amplitude = seen.law, seen.amplitude_N

    def short(*values: float) -> tuple[float, ...]:
        return tuple(float(f"{value:.6g}") for value in values)

    if law.kind == "periodic":
        return short(math.hypot(*amplitude))[0], short(law.scale, math.atan2(amplitude[1], amplitude[0]))
    if law.kind == "patch":
        return short(amplitude[0] / law.largest)[0], short(law.low, law.high - law.low)
    if law.kind == "inverse_speed":
        return short(amplitude[0] / law.largest / law.scale)[0], short(law.scale)
    return short(amplitude[0] / law.largest)[0], short(law.scale) if _EXPRESSIONS[law.kind].shapes else ()


def _force_N(seen: SeenLaw) -> float:
    """The force of a law at the state of the worked number, from the law itself: it tries the formula of the file."""
    at = {f"{name}{unit}": np.array([_AT[name]]) for name, unit in _UNITS.items()}
    motion = SimpleNamespace(**at, trial=SimpleNamespace(area_m2=seen.law.by_area))
    return float((seen.law.along(motion) @ np.array(seen.amplitude_N))[0])  # type: ignore[arg-type]


def _unit(powers: Sequence[int]) -> str:
    """A unit by its exponents of N, m, s and Pa."""

    def joined_up(sign: int) -> list[str]:
        raised = {2: "²", 3: "³", 4: "⁴"}
        return [
            name + raised.get(sign * power, "")
            for name, power in zip(("N", "m", "s", "Pa"), powers, strict=True)
            if sign * power > 0
        ]

    below = "·".join(joined_up(-1))
    return "·".join(joined_up(1)) + (f"/({below})" if "·" in below else f"/{below}" if below else "")


def _size_parameter(name: str, symbol: str, unit: str, value: float) -> str:
    low, high = sorted((0.0, 10 * value))
    most = 100 * abs(value)
    return (
        f'Parameter("{name}", "{symbol}", "{unit}", {value!r}, bounds=({-most:.6g}, {most:.6g}), '
        f'plausible=({low:.6g}, {high:.6g}), meaning="size of the law")'
    )


def _shape_parameter(names: tuple[str, str, str], value: float) -> str:
    name, symbol, unit = names
    if name in ("phi", "y_1"):
        reach = math.pi if name == "phi" else max(abs(value), 0.01)
        bounds, plausible = (value - 2 * reach, value + 2 * reach), (value - reach, value + reach)
    else:
        bounds, plausible = (value / 10, value * 10), (value / 3, value * 3)
    return (
        f'Parameter("{name}", "{symbol}", "{unit}", {value!r}, zero={value!r}, bounds=({bounds[0]:.6g}, '
        f"{bounds[1]:.6g}), plausible=({plausible[0]:.6g}, {plausible[1]:.6g}), tried=({value!r},), "
        'meaning="its shape")'
    )
