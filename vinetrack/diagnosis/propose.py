"""From a missing force to an effect: laws fitted in the equation of motion, the best written as a file.

The missing force is compared with simple laws along the fitted motions (`missing_force`). The laws that explain most of
it become effects with their amplitudes and shapes as parameters. Each is fitted with the model like any effect that is
added by hand; they are compared by likelihood ratio, as hypotheses are in the diagnosis, and by their error on left-out
conditions.
"""

from __future__ import annotations

import math
import tempfile
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Track
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.diagnosis.candidate_fits import (
    SubsetFitter,
    best_subset_fit,
    full_fit,
    start_values,
)
from vinetrack.diagnosis.force_laws import FORMS
from vinetrack.diagnosis.ladder import candidates_of, initial_fit, left_out, with_host
from vinetrack.diagnosis.learned_force import LEAST_CHI2_PER_POINT, VARIABLES, Domain, LearnedForce
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    OUT_OF_REACH,
    LikelihoodRatio,
    answer_set,
    likelihood_ratio,
)
from vinetrack.diagnosis.missing_force import LEAST_MISFIT_REDUCTION, RankedLaw, learn_missing_force, missing_force
from vinetrack.diagnosis.score_test import shapes_of
from vinetrack.dynamics.model import Model, check_needs, make_model
from vinetrack.effects import Effect, EffectError, find_effect, load_effect, remember
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment


# ------------------------------------------------------------------------------
# One effect added to the model by hand: both models are fitted, and compared on conditions that were left out.


def add(
    experiment: Experiment, tracks: Mapping[str, Track], name: str, report: Callable[[str], None]
) -> tuple[Fit, Fit, pd.DataFrame]:
    """Fit the model in use without and with an effect, and work out the ladder of both. Returns before, after, table
    (the ladder of errors, one row for each model).
    """
    from vinetrack.diagnosis.ladder import ladder
    from vinetrack.effects import own_effects

    user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    model = make_model(experiment.settings.model, user_effects)
    if name.endswith(".py"):
        user_effects = {**own_effects([name]), **user_effects}
    effect = find_effect(Path(name).stem, user_effects)
    if effect.name in model:
        raise EffectError(f"{effect.name} is in the model already: {' + '.join(model.names)}.")
    check_needs(model + effect, *(trial for trial in experiment.trials if trial.name in tracks))
    report("fitting the model as it is")
    candidates = candidates_of(model, experiment.settings.candidates, user_effects)
    if effect not in candidates:
        candidates = (*candidates, effect)
    before = initial_fit(model, pairs_of(experiment, tracks)[0], candidates, profile=False)
    after = fit_with(before, effect, report)
    report("errors before and after")
    return before, after, ladder((before, after), ("", effect.name))


def fit_with(before: Fit, effect: Effect, report: Callable[[str], None]) -> Fit:
    """Fit a model with an effect added, from several starts."""
    report(f"fitting it with {effect.name}")
    fitter = SubsetFitter(before)
    starts = [((effect,), start_values(shape, shape.step * 10)) for shape in shapes_of(effect)]
    subset_fit = best_subset_fit(fitter, starts, float("inf"))
    after = full_fit(before, subset_fit) if subset_fit is not None else None
    if after is None:
        raise FitError(f"The model with {effect.name} cannot be simulated from any start.")
    if after.log_likelihood < before.log_likelihood:
        from_before = refit(before, before.model + effect)
        after = max((after, from_before), key=lambda fit: fit.log_likelihood)
    return after


# ------------------------------------------------------------------------------
# A learned force as an effect file: a table of spline coefficients over one variable or two, in place of a formula.
#
# Where no formula reproduces the learned force, the force itself can enter the equation of motion. The file holds the
# coefficients of its splines, N, at even steps of each normalised variable (`force_inversion.Domain`), and a function
# that sums the four splines that are nonzero:
#
#     T(u) = Σ c_k β(u + 1 − k),   β(d) = (max(0, 2 − |d|)³ − 4 max(0, 1 − |d|)³)/6,
#
# β the cubic B-spline of unit step (de Boor 2001, ch. IX). Its single parameter scales the table; 1 is the force as
# learned.


_STATE = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}


def table_name(learned: LearnedForce) -> str:
    """Name of the effect that holds a learned force, such as `learned_growth_speed`."""
    return "_".join(["learned", *learned.domain.variables])


def table_text(learned: LearnedForce, origin: str = "") -> str:
    """Source of an effect file that holds a learned force: docstring, table, parameter, function and a
    worked example.
    """
    domain = learned.domain
    table = learned.found.mean.reshape(domain.counts)
    state, worked = _worked_example(learned)
    axes = [line for k in range(len(domain.variables)) for line in _axis_code(domain, k)]
    parts = [
        f'"""{remark("learned_file", learned=learned, origin=origin)}"""\n',
        "import numpy as np\n",
        "from vinetrack.effects import Parameter, Worked\n",
        *_table_lines(table),
        "",
        'PARAMETERS = (Parameter("a", "a", "1", 1.0, bounds=(-10.0, 10.0), plausible=(0.0, 2.0), '
        'meaning="size of the table"),)',
        "\n",
        "def tail_force(s, rig, a):",
        *(f"    {line}" for line in axes),
        *_sum_code(table.ndim),
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
    return "\n".join(parts) + "\n"


def _sum_code(axes: int) -> list[str]:
    """Lines of code that sum the nonzero splines along one axis, or along two."""
    if axes == 1:
        return ["    return a * (f0 * TABLE[i] + f1 * TABLE[i + 1] + f2 * TABLE[i + 2] + f3 * TABLE[i + 3])"]
    rows = [
        f"    r{k} = " + " + ".join(f"g{m} * TABLE[i + {k}, j + {m}]" for m in range(4)).replace(" + 0", "")
        for k in range(4)
    ]
    return [*rows, "    return a * (f0 * r0 + f1 * r1 + f2 * r2 + f3 * r3)"]


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
    table_digits = 6  # Significant digits of a coefficient in the file (chosen)
    if table.ndim == 1:
        numbers = ", ".join(f"{value:.{table_digits}g}" for value in table.tolist())
        return [
            "TABLE = np.array((  # N",
            *textwrap.wrap(numbers, 110, initial_indent="    ", subsequent_indent="    "),
            "))",
        ]
    rows = [f"    ({', '.join(f'{value:.{table_digits}g}' for value in row)})," for row in table.tolist()]
    return ["TABLE = np.array((  # N", *rows, "))"]


def _worked_example(learned: LearnedForce) -> tuple[dict[str, float], float]:
    """The visited state at which the force is largest, as arguments of an effect, and the force there, N."""
    visited = learned.visited
    largest = int(np.argmax(np.abs(visited["force_N"].to_numpy(float))))
    at = {name: float(f"{visited[VARIABLES[name]].to_numpy(float)[largest]:.5g}") for name in learned.domain.variables}
    force_N, _ = learned.force([np.array([value]) for value in at.values()])
    return {_STATE[name]: value for name, value in at.items()}, float(force_N[0])


# ------------------------------------------------------------------------------
# The learned force fitted as an effect, where no formula reproduces it.

LEAST_SIGMAS = 6.0  # Standard deviations by which a law must improve the fit to be proposed


@dataclass(frozen=True)
class ProposedTable:
    """A learned force that was fitted as an effect; `rms_left_out_m` is with the table learned from all trials."""

    learned: LearnedForce
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float


def proposed_table(
    model: Model, before: Fit, laws: Sequence[Fit], report: Callable[[str], None]
) -> ProposedTable | None:
    """Estimate the missing force as a smooth function and fit it as a table."""
    misfit = before.chi2_per_dof - 1
    remaining = min((fit.chi2_per_dof for fit in laws), default=before.chi2_per_dof) - 1
    # 0.9: part of the misfit that a law must take away for the learned force not to be tried as a table (chosen)
    if misfit < LEAST_CHI2_PER_POINT - 1 or remaining < (1 - 0.9) * misfit:
        return None
    report("estimating the missing force as a table")
    learned = learn_missing_force(before)
    if learned is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{table_name(learned)}.py"
        path.write_text(table_text(learned), encoding="utf-8")
        remember(path)
        effect = load_effect(path)
        try:
            start = with_host(before, Model((*model, effect)))
            after = fit_with(start, effect, report)
        except FitError:
            return None
        ratio = likelihood_ratio(start, (effect,), after)
        better = all(2 * (after.log_likelihood - fit.log_likelihood) > ANSWER_SET_DELTA_CHI2 for fit in laws)
        explains = start.chi2_per_dof - after.chi2_per_dof > LEAST_MISFIT_REDUCTION * misfit
        if not (better and explains and ratio.sigma > LEAST_SIGMAS):
            return None
        report("errors with the table")
        return ProposedTable(learned, effect, ratio, left_out(after).rms_m)


# State of the worked example; a convention of this file
_WORKED_STATE = {"lead_position": 0.1, "tail_position": 0.2, "tail_velocity": 2.0, "pressure": 20e3, "time": 0.05}


@dataclass(frozen=True)
class ProposedLaw:
    """A law that was fitted as an effect. `rms_left_out_m` is its error on left-out conditions, m; NaN where the
    likelihood of others is far higher.
    """

    law: RankedLaw
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float


@dataclass(frozen=True)
class Proposal:
    """Fitted laws, best first, and the error on left-out conditions of the model without them, m. `tied` are those that
    the data do not exclude; empty where no law is proposed, for the `reason` given. `table` is the learned force, where
    it explains what no law does.
    """

    before: Fit
    rms_left_out_m: float
    laws: tuple[ProposedLaw, ...]
    tied: tuple[ProposedLaw, ...]
    reason: Remark = field(default_factory=Remark)
    table: ProposedTable | None = None


@in_one_blas_thread
def propose(model: Model, pairs: Pairs, report: Callable[[str], None]) -> Proposal:
    """Find laws of force that explain the misfit of a model, and fit each in the equation of motion."""
    candidates = candidates_of(model, None, {})
    report("fitting the model")
    before = initial_fit(model, pairs, candidates, profile=False)
    report("estimating the missing force")
    detected = missing_force(before, learn=False).detected
    # 0.2: laws that explain less than the best by more than this part are not fitted (chosen)
    best = [law for law in detected if law.explained > detected[0].explained - 0.2]
    # 4: most laws that are fitted in the equation of motion (chosen)
    proposal = _fitted_laws(model, before, best[:4], report)
    fits = [law.ratio.fit for law in proposal.tied]
    return replace(proposal, table=proposed_table(model, proposal.before, fits, report))


def _fitted_laws(model: Model, before: Fit, detected: Sequence[RankedLaw], report: Callable[[str], None]) -> Proposal:
    """Fit the laws in the equation of motion, and find those that the data do not exclude."""
    if not detected:
        reason = remark("no_law_detected")
        return Proposal(before, left_out(before).rms_m, (), (), reason)
    with tempfile.TemporaryDirectory() as folder:
        effects = [_loaded(law, Path(folder)) for law in detected]
        # Compiled without the catalogue, which is not needed here.
        before = with_host(before, Model((*model, *effects)))
        fitted = []
        for law, effect in zip(detected, effects, strict=True):
            try:
                after = fit_with(before, effect, report)
            except FitError:
                continue
            fitted.append((law, effect, likelihood_ratio(before, (effect,), after)))
        report("errors on left-out conditions")
        highest = max((ratio.fit.log_likelihood for _, _, ratio in fitted), default=-math.inf)

        def near_best(ratio: LikelihoodRatio) -> bool:
            return 2 * (highest - ratio.fit.log_likelihood) < OUT_OF_REACH

        laws = [
            ProposedLaw(law, effect, ratio, left_out(ratio.fit).rms_m if near_best(ratio) else math.nan)
            for law, effect, ratio in fitted
        ]
    return _proposal(before, laws)


def _proposal(before: Fit, laws: Sequence[ProposedLaw]) -> Proposal:
    """The laws in order of their likelihood, with the significant ones that cannot be excluded."""
    error_m = left_out(before).rms_m
    laws = tuple(sorted(laws, key=lambda law: -law.ratio.fit.log_likelihood))
    misfit = max(before.chi2_per_dof - 1, 0.0)
    significant = [
        law
        for law in laws
        if law.ratio.sigma > LEAST_SIGMAS
        and law.rms_left_out_m < error_m
        and (misfit < 1 or before.chi2_per_dof - law.ratio.fit.chi2_per_dof > LEAST_MISFIT_REDUCTION * misfit)
    ]
    if not significant:
        reason = remark("no_law_predicts_better")
        return Proposal(before, error_m, laws, (), reason)
    not_excluded, _ = answer_set([law.ratio for law in significant])
    tied = tuple(law for ratio in not_excluded for law in significant if law.ratio is ratio)
    return Proposal(before, error_m, laws, tied)


def _loaded(law: RankedLaw, folder: Path) -> Effect:
    """A law as an effect, written to a file in this folder and loaded from it."""
    path = folder / f"proposed_{law.law.name}.py"
    path.write_text(effect_text(law), encoding="utf-8")
    remember(path)
    return load_effect(path)


def effect_text(detected: RankedLaw, origin: str = "") -> str:
    """Source of an effect file that holds a law: docstring, parameters with units and bounds, function,
    worked example.
    """
    law, expression = detected.law, FORMS[detected.law.kind]
    # What a law may be multiplied by: code, symbol, and the change of the unit of the size
    factors = {
        "position": ("s.tail_position", "x", (0, -1, 0, 0)),
        "speed": ("s.tail_velocity", "ẋ", (0, -1, 1, 0)),
        "pressure": ("s.pressure", "P", (0, 0, 0, -1)),
    }
    factor_code, factor_symbol, factor_unit = factors.get(law.factor, ("", "", (0, 0, 0, 0)))
    unit = _unit([a + b for a, b in zip(expression.size[2], factor_unit, strict=True)])
    size, shapes = _values(detected)
    names = [expression.size[0], *(name for name, _, _ in expression.shapes)]
    area = " * (s.area / AREA)" if law.reference_area_m2 else ""
    state = _WORKED_STATE | ({"area": law.reference_area_m2} if law.reference_area_m2 else {})
    worked = _force_N(detected)
    times = f" * {factor_code}" if factor_code else ""
    symbols = f" {factor_symbol}" if factor_symbol else ""
    formula = f"tail force {expression.formula}{symbols}" + (
        " A/A₀, A₀ the mean cross-section of these vines" if area else ""
    )
    parts = [
        f'"""{remark("law_file", law=detected.words, formula=formula, origin=origin)}"""\n',
        "import numpy as np\n",
        "from vinetrack.effects import Parameter, Worked\n",
        f"AREA = {law.reference_area_m2:.6g}  # m²\n" if area else None,
        "PARAMETERS = (",
        f"    {_size_parameter(expression.size[0], expression.size[1], unit, size)},",
        *(f"    {_shape_parameter(*number)}," for number in zip(expression.shapes, shapes, strict=True)),
        ")\n\n",
        f"def tail_force(s, rig, {', '.join(names)}):",
        f"    return {names[0]} * ({expression.code}){times}{area}\n\n",
        "WORKED = (",
        "    Worked(",
        '        "tail_force",',
        f"        {worked:.8g},",
        f'        "the fitted law at this state: {size:.6g} × {worked / size:.6g}",',
        f"        state={state!r},",
        f"        parameters={dict(zip(names, (size, *shapes), strict=True))!r},",
        "    ),",
        ")",
    ]
    return "\n".join(part for part in parts if part is not None) + "\n"


def _values(detected: RankedLaw) -> tuple[float, tuple[float, ...]]:
    """Size and shape parameters of a law as its effect holds them, SI, rounded to what is printed."""
    law, amplitude = detected.law, detected.estimate.amplitude

    def rounded(*values: float) -> tuple[float, ...]:
        return tuple(float(f"{value:.6g}") for value in values)

    if law.kind == "periodic":
        return rounded(math.hypot(*amplitude))[0], rounded(law.scale, math.atan2(amplitude[1], amplitude[0]))
    if law.kind == "patch":
        return rounded(amplitude[0] / law.peak)[0], rounded(law.low, law.high - law.low)
    if law.kind == "inverse_speed":
        return rounded(amplitude[0] / law.peak / law.scale)[0], rounded(law.scale)
    return rounded(amplitude[0] / law.peak)[0], rounded(law.scale) if FORMS[law.kind].shapes else ()


def _force_N(detected: RankedLaw) -> float:
    """The force of a law in the state of the worked example, from the law itself: it checks the formula of the file."""
    suffix = {"lead_position": "_m", "tail_position": "_m", "tail_velocity": "_m_s", "pressure": "_Pa", "time": "_s"}
    state = {f"{name}{suffix[name]}": np.array([value]) for name, value in _WORKED_STATE.items()}
    motion = SimpleNamespace(**state, trial=SimpleNamespace(area_m2=detected.law.reference_area_m2))
    return float((detected.law.unit_force(motion) @ detected.estimate.amplitude)[0])  # type: ignore[arg-type]


def _unit(powers: Sequence[int]) -> str:
    """A unit by its exponents of N, m, s and Pa."""

    def product(sign: int) -> list[str]:
        raised = {2: "²", 3: "³", 4: "⁴"}
        return [
            name + raised.get(sign * power, "")
            for name, power in zip(("N", "m", "s", "Pa"), powers, strict=True)
            if sign * power > 0
        ]

    denominator = "·".join(product(-1))
    return "·".join(product(1)) + (
        f"/({denominator})" if "·" in denominator else f"/{denominator}" if denominator else ""
    )


def _size_parameter(name: str, symbol: str, unit: str, value: float) -> str:
    low, high = sorted((0.0, 10 * value))
    limit = 100 * abs(value)
    return (
        f'Parameter("{name}", "{symbol}", "{unit}", {value!r}, bounds=({-limit:.6g}, {limit:.6g}), '
        f'plausible=({low:.6g}, {high:.6g}), meaning="size of the law")'
    )


def _shape_parameter(names: tuple[str, str, str], value: float) -> str:
    name, symbol, unit = names
    if name in ("phi", "y_1"):
        half_range = math.pi if name == "phi" else max(abs(value), 0.01)
        bounds, plausible = (value - 2 * half_range, value + 2 * half_range), (value - half_range, value + half_range)
    else:
        bounds, plausible = (value / 10, value * 10), (value / 3, value * 3)
    return (
        f'Parameter("{name}", "{symbol}", "{unit}", {value!r}, zero={value!r}, bounds=({bounds[0]:.6g}, '
        f"{bounds[1]:.6g}), plausible=({plausible[0]:.6g}, {plausible[1]:.6g}), tried=({value!r},), "
        'meaning="its shape")'
    )
