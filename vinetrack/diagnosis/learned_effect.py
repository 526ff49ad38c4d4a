"""A learned force as an effect file: a table of spline coefficients over one variable or two, in place of a formula.

Where no formula reproduces the learned force, the force itself can enter the equation of motion. The file holds the
coefficients of its splines, N, at even steps of each normalised variable (`force_surface.Domain`), and a function that
sums the four splines that are nonzero:

    T(u) = Σ c_k β(u + 1 − k),   β(d) = (max(0, 2 − |d|)³ − 4 max(0, 1 − |d|)³)/6,

β the cubic B-spline of unit step (de Boor 2001, ch. IX). Its single parameter scales the table; 1 is the force as
learned.
"""

from __future__ import annotations

import math
import textwrap

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.cubic_splines import uniform_splines
from vinetrack.diagnosis.force_surface import VARIABLES, Domain
from vinetrack.diagnosis.learned_force import LearnedForce
from vinetrack.diagnosis.learned_variables import variables_in_words
from vinetrack.narrative.verdict_summary import joined

CHECKS_PER_SPLINE = 4  # Positions per spline at which the two sets of splines are matched by least squares (chosen)

TABLE_DIGITS = 6  # Significant digits of a coefficient in the file (chosen)

_STATE = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}
_SYMBOL = {"growth": "y", "speed": "ẋ", "time": "t", "pressure": "P"}
_UNIT = {"growth": ("mm", 1e3), "speed": ("m/s", 1.0), "time": ("ms", 1e3), "pressure": ("kPa", 1e-3)}


def table_name(learned: LearnedForce) -> str:
    """Name of the effect that holds a learned force, such as `learned_growth_speed`."""
    return "_".join(["learned", *learned.domain.variables])


def table_text(learned: LearnedForce, remark: str = "") -> str:
    """Source of an effect file that holds a learned force: docstring, table, parameter, function and a
    worked example.
    """
    domain = learned.domain
    table = uniform_table(domain, learned.best.mean)
    variables = variables_in_words(domain.name)
    symbols = ", ".join(_SYMBOL[name] for name in domain.variables)
    units = [_UNIT[name] for name in domain.variables]
    ranges = joined(
        [
            f"{variables_in_words(name)} from {low * factor:.3g} to {high * factor:.3g} {unit}"
            for name, low, high, (unit, factor) in zip(domain.variables, domain.low, domain.high, units, strict=True)
        ]
    )
    state, worked = _worked_example(learned)
    axes = [line for k in range(len(domain.variables)) for line in _axis_code(domain, k)]
    counts = " × ".join(str(count) for count in domain.counts)
    parts = [
        f'"""Learned force: a table over {variables}, no law.\n',
        *textwrap.wrap(remark, 118),
        "" if remark else None,
        *textwrap.wrap(learned.sentence, 118),
        "",
        *textwrap.wrap(
            f"It is valid for {ranges}, the range that trials visited; outside, it keeps its value at the edge, which"
            " has no meaning. Forces are positive along the growth, so that a friction is negative. The table"
            " reproduces these trials but explains nothing: look at its figure, and find the formula.",
            118,
        ),
        "",
        f"    tail force a T({symbols}), T the sum of {counts} cubic splines on even steps",
        "",
        "Make trials that differ in the variables it depends on, and compare new trials with its prediction.",
        '"""\n',
        "import numpy as np\n",
        "from vinetrack.effects import Parameter, Worked\n",
        *_table_lines(table),
        "",
        'PARAMETERS = (Parameter("a", "a", "1", 1.0, bounds=(-10.0, 10.0), plausible=(0.0, 2.0), '
        'meaning="size of the table"),)',
        "\n",
        "def tail_force(s, rig, a):",
        *(f"    {line}" for line in axes),
        *(_SUM_OF_ONE if table.ndim == 1 else _SUM_OF_TWO),
        "\n",
        "WORKED = (",
        "    Worked(",
        '        "tail_force",',
        f"        {worked:.8g},",
        '        "the learned force at this state",',
        f"        state={state!r},",
        '        parameters={"a": 1.0},',
        "    ),",
        ")",
    ]
    return "\n".join(part for part in parts if part is not None) + "\n"


_SUM_OF_ONE = ("    return a * (f0 * TABLE[i] + f1 * TABLE[i + 1] + f2 * TABLE[i + 2] + f3 * TABLE[i + 3])",)
_SUM_OF_TWO = (
    "    r0 = g0 * TABLE[i, j] + g1 * TABLE[i, j + 1] + g2 * TABLE[i, j + 2] + g3 * TABLE[i, j + 3]",
    "    r1 = g0 * TABLE[i + 1, j] + g1 * TABLE[i + 1, j + 1] + g2 * TABLE[i + 1, j + 2] + g3 * TABLE[i + 1, j + 3]",
    "    r2 = g0 * TABLE[i + 2, j] + g1 * TABLE[i + 2, j + 1] + g2 * TABLE[i + 2, j + 2] + g3 * TABLE[i + 2, j + 3]",
    "    r3 = g0 * TABLE[i + 3, j] + g1 * TABLE[i + 3, j + 1] + g2 * TABLE[i + 3, j + 2] + g3 * TABLE[i + 3, j + 3]",
    "    return a * (f0 * r0 + f1 * r1 + f2 * r2 + f3 * r3)",
)


def uniform_table(domain: Domain, coefficients: Floats) -> Floats:
    """Convert the coefficients of a domain's splines to those of identical splines at even steps, N. The splines of a
    domain have repeated knots at its ends; those of the file are all alike. Both span the same functions. Shapes:
    coefficients (n_splines,) → (n_first,).
    """
    table = coefficients.reshape(domain.counts)
    for axis, count in enumerate(domain.counts):
        at = np.linspace(0.0, 1.0, CHECKS_PER_SPLINE * count)
        conversion = np.linalg.lstsq(_even_splines(at, count), uniform_splines(at, count), rcond=None)[0]
        table = np.moveaxis(np.tensordot(conversion, table, axes=(1, axis)), 0, axis)
    return np.asarray(table)


def _even_splines(at: Floats, count: int) -> Floats:
    d = np.abs((count - 3) * at[:, None] + 1.0 - np.arange(count))
    return np.asarray((np.maximum(2.0 - d, 0.0) ** 3 - 4.0 * np.maximum(1.0 - d, 0.0) ** 3) / 6.0)


def _axis_code(domain: Domain, k: int) -> list[str]:
    """Lines of code that find the interval of the table in which a state lies, and the four nonzero splines there."""
    low, high, log_scale, steps = domain.low[k], domain.high[k], domain.log_scale[k], domain.counts[k] - 3
    at, step, weight = "uv"[k], "ij"[k], "fg"[k]
    state = f"s.{_STATE[domain.variables[k]]}"
    from_low = f"({state} - {_code_number(low)})" if low else state
    position = f"np.minimum(np.maximum({from_low} / {_code_number(high - low)}, 0.0), 1.0)"
    if math.isfinite(log_scale):
        ratio = (high - low) / log_scale
        position = f"np.log1p({_code_number(ratio)} * {position}) / {_code_number(math.log1p(ratio))}"
    return [
        f"{at} = {steps}.0 * {position}",
        f"{step} = np.maximum(np.minimum(np.int64({at}), {steps - 1}), 0)",
        f"{at} = {at} - {step}",
        f"{weight}0, {weight}3 = (1.0 - {at}) ** 3 / 6.0, {at}**3 / 6.0",
        f"{weight}1 = (3.0 * {at}**3 - 6.0 * {at}**2 + 4.0) / 6.0",
        f"{weight}2 = 1.0 - {weight}0 - {weight}1 - {weight}3",
    ]


def _code_number(value: float) -> str:
    return repr(float(f"{value:.12g}"))


def _table_lines(table: Floats) -> list[str]:
    """The table as lines of code: a tuple of numbers, or a tuple of rows."""
    if table.ndim == 1:
        numbers = ", ".join(f"{value:.{TABLE_DIGITS}g}" for value in table.tolist())
        return [
            "TABLE = np.array((  # N",
            *textwrap.wrap(numbers, 110, initial_indent="    ", subsequent_indent="    "),
            "))",
        ]
    rows = [f"    ({', '.join(f'{value:.{TABLE_DIGITS}g}' for value in row)})," for row in table.tolist()]
    return ["TABLE = np.array((  # N", *rows, "))"]


def _worked_example(learned: LearnedForce) -> tuple[dict[str, float], float]:
    """The visited state at which the force is largest, as arguments of an effect, and the force there, N."""
    visited = learned.table[(learned.table["condition"] == "") & (learned.table["trials"] > 0)]
    largest = int(np.argmax(np.abs(visited["force_N"].to_numpy(float))))
    at = {name: float(f"{visited[VARIABLES[name]].to_numpy(float)[largest]:.5g}") for name in learned.domain.variables}
    force_N, _ = learned.best.force([np.array([value]) for value in at.values()])
    return {_STATE[name]: value for name, value in at.items()}, float(force_N[0])
