"""A learned force as an effect file: a table of splines over one variable or two, and no law.

Where no formula does what the learned force does, the force itself can stand in the equation of motion. The file holds
the coefficients of its splines, N, on even steps of each variable as the learning saw it (`force_surface.Domain`), and
a function that adds up the four that are not nothing:

    T(u) = Σ c_k β(u + 1 − k),   β(d) = (max(0, 2 − |d|)³ − 4 max(0, 1 − |d|)³)/6,

β the cubic B-spline of unit step (de Boor 2001, ch. IX). Its single parameter is the size of the table, 1 as learned.
"""

from __future__ import annotations

import math
import textwrap

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_surface import VARIABLES, Domain, curves
from vinetrack.diagnosis.learned_force import LearnedForce
from vinetrack.diagnosis.learned_variables import named
from vinetrack.narrative.verdict_summary import joined

STEP = 4
"""Places by step of a table at which both kinds of splines are held against each other. Chosen: more than each has
coefficients; a change of splines is exact at any number."""

DIGITS = 6
"""Significant digits of a number in the file. Chosen: a thousandth of what positions tell of a force; at half of it
1e-3 of the force is lost, at twice the table is harder to read."""

_STATE = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}
_SYMBOL = {"growth": "y", "speed": "ẋ", "time": "t", "pressure": "P"}
_RANGE = {"growth": ("mm", 1e3), "speed": ("m/s", 1.0), "time": ("ms", 1e3), "pressure": ("kPa", 1e-3)}


def table_name(learned: LearnedForce) -> str:
    """Name of the effect that holds a learned force: `learned_growth_speed`.

    Parameters
    ----------
    learned : the force.

    Returns
    -------
    str
    """
    return "_".join(["learned", *learned.domain.variables])


def table_text(learned: LearnedForce, remark: str = "") -> str:
    """An effect file that holds a learned force: docstring, table, its size, the function, a worked number.

    Parameters
    ----------
    learned : the force.
    remark : sentences about the data that it comes from, for the docstring.

    Returns
    -------
    str
    """
    domain = learned.domain
    table = even_coefficients(domain, learned.best.mean)
    over = named(domain.name)
    symbols = ", ".join(_SYMBOL[name] for name in domain.variables)
    ranges = joined(
        [
            f"{named(name)} from {low * _RANGE[name][1]:.3g} to {high * _RANGE[name][1]:.3g} {_RANGE[name][0]}"
            for name, low, high in zip(domain.variables, domain.low, domain.high, strict=True)
        ]
    )
    state, worked = _worked(learned)
    axes = [line for k in range(len(domain.variables)) for line in _axis(domain, k)]
    counts = " × ".join(str(count) for count in domain.counts)
    parts = [
        f'"""Learned force: a table over {over}, and no law.\n',
        *textwrap.wrap(remark, 118),
        "" if remark else None,
        *textwrap.wrap(learned.sentence, 118),
        "",
        *textwrap.wrap(
            f"It holds for {ranges}, where trials have been; beyond, it stays as at the edge and says nothing."
            " Forces count along the growth, so that a friction is"
            " negative. It reproduces these trials and explains nothing: look at its picture, and find the formula.",
            118,
        ),
        "",
        f"    tail force a T({symbols}), T the sum of {counts} cubic splines on even steps",
        "",
        "Measure it in trials that differ in what it hangs on, and hold the next ones against its prediction.",
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
        '        "the force that was learned, at this state",',
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


def even_coefficients(domain: Domain, coefficients: Floats) -> Floats:
    """Coefficients of splines of even steps that make the same function as those of a domain, N.

    The splines of a domain end at its ends; those of the file are all alike. Both span the same functions.

    Parameters
    ----------
    domain : the variables and their splines.
    coefficients : array, shape (n_splines,), N

    Returns
    -------
    array, shape (n_first,) or (n_first, n_second), N
    """
    table = coefficients.reshape(domain.counts)
    for axis, count in enumerate(domain.counts):
        at = np.linspace(0.0, 1.0, STEP * count)
        change = np.linalg.lstsq(_even_splines(at, count), curves(at, count), rcond=None)[0]
        table = np.moveaxis(np.tensordot(change, table, axes=(1, axis)), 0, axis)
    return np.asarray(table)


def _even_splines(at: Floats, count: int) -> Floats:
    d = np.abs((count - 3) * at[:, None] + 1.0 - np.arange(count))
    return np.asarray((np.maximum(2.0 - d, 0.0) ** 3 - 4.0 * np.maximum(1.0 - d, 0.0) ** 3) / 6.0)


def _axis(domain: Domain, k: int) -> list[str]:
    """Lines of code that say between which steps of the table a state is, and the weights of the four splines there."""
    low, high, usual, steps = domain.low[k], domain.high[k], domain.usual[k], domain.counts[k] - 3
    at, step, weight = "uv"[k], "ij"[k], "fg"[k]
    state = f"s.{_STATE[domain.variables[k]]}"
    from_low = f"({state} - {_number(low)})" if low else state
    inside = f"np.minimum(np.maximum({from_low} / {_number(high - low)}, 0.0), 1.0)"
    if math.isfinite(usual):
        ratio = (high - low) / usual
        inside = f"np.log1p({_number(ratio)} * {inside}) / {_number(math.log1p(ratio))}"
    return [
        f"{at} = {steps}.0 * {inside}",
        f"{step} = np.maximum(np.minimum(np.int64({at}), {steps - 1}), 0)",
        f"{at} = {at} - {step}",
        f"{weight}0, {weight}3 = (1.0 - {at}) ** 3 / 6.0, {at}**3 / 6.0",
        f"{weight}1 = (3.0 * {at}**3 - 6.0 * {at}**2 + 4.0) / 6.0",
        f"{weight}2 = 1.0 - {weight}0 - {weight}1 - {weight}3",
    ]


def _number(value: float) -> str:
    return repr(float(f"{value:.12g}"))


def _table_lines(table: Floats) -> list[str]:
    """The table as a tuple, or as a tuple of rows, in lines that are not too long."""
    if table.ndim == 1:
        numbers = ", ".join(f"{value:.{DIGITS}g}" for value in table.tolist())
        return [
            "TABLE = np.array((  # N",
            *textwrap.wrap(numbers, 110, initial_indent="    ", subsequent_indent="    "),
            "))",
        ]
    rows = [f"    ({', '.join(f'{value:.{DIGITS}g}' for value in row)})," for row in table.tolist()]
    return ["TABLE = np.array((  # N", *rows, "))"]


def _worked(learned: LearnedForce) -> tuple[dict[str, float], float]:
    """The state of the worked number, where the force is largest among places that trials came to, and the force."""
    seen = learned.table[(learned.table["condition"] == "") & (learned.table["trials"] > 0)]
    largest = int(np.argmax(np.abs(seen["force_N"].to_numpy(float))))
    at = {name: float(f"{seen[VARIABLES[name]].to_numpy(float)[largest]:.5g}") for name in learned.domain.variables}
    force_N, _ = learned.best.force([np.array([value]) for value in at.values()])
    return {_STATE[name]: value for name, value in at.items()}, float(force_N[0])
