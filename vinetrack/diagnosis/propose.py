"""From a missing force to an effect: laws fitted in the equation of motion, the best written as a file.

The missing force is compared with simple laws along the fitted motions (`missing_force`). The laws that explain most of
it become effects with their amplitudes and shapes as parameters. Each is fitted with the model like any effect that is
added by hand; they are compared by likelihood ratio, as hypotheses are in the diagnosis, and by their error on left-out
conditions.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd

from vinetrack.core.problems import Remark, remark
from vinetrack.core.process import in_one_blas_thread
from vinetrack.core.records import Track
from vinetrack.diagnosis.hypotheses import (
    ANSWER_SET_DELTA_CHI2,
    OUT_OF_REACH,
    LikelihoodRatio,
    answer_set,
    likelihood_ratio,
)
from vinetrack.diagnosis.ladder import candidates_of, initial_fit, ladder, left_out_error, with_host
from vinetrack.diagnosis.misfit_tests import SEARCH_SIGMAS, level_of, misfit_tests
from vinetrack.diagnosis.missing_force import (
    LEAST_MISFIT_REDUCTION,
    QUANTITIES,
    VARIABLES,
    Domain,
    LearnedForce,
    RankedLaw,
    missing_force,
)
from vinetrack.diagnosis.selection import Search
from vinetrack.dynamics.model import Model, check_needs, make_model, probe
from vinetrack.effects import Effect, EffectError, find_effect, load_effect, own_effects, remember
from vinetrack.experiment.folder import Experiment
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit

# ------------------------------------------------------------------------------
# One effect added to the model by hand: both models are fitted, and compared on conditions that were left out.


def add(
    experiment: Experiment, tracks: Mapping[str, Track], names: Sequence[str], report: Callable[[str], None]
) -> tuple[Fit, Fit, pd.DataFrame]:
    """Fit the model in use without and with some effects, and work out the ladder of both. Returns before, after, table
    (the ladder of errors, one row for each model).
    """
    user_effects = experiment.user_effects
    model = make_model(experiment.settings.model, user_effects)
    user_effects = {**own_effects([name for name in names if name.endswith(".py")]), **user_effects}
    effects = [find_effect(Path(name).stem, user_effects) for name in names]
    larger = model
    for effect in effects:
        if effect.name in larger:
            raise EffectError(f"{effect.name} is in the model already: {' + '.join(larger.names)}.")
        larger += effect
    check_needs(larger, *(trial for trial in experiment.trials if trial.name in tracks))
    report("fitting the model as it is")
    candidates = candidates_of(model, experiment.settings.candidates, user_effects)
    candidates += tuple(effect for effect in effects if effect not in candidates)
    before = after = initial_fit(model, pairs_of(experiment, tracks)[0], candidates)
    for effect in effects:
        after = fit_with(after, effect, report)
    report("errors before and after")
    return before, after, ladder((before, after), ("", "+".join(effect.name for effect in effects)))


def fit_with(before: Fit, effect: Effect, report: Callable[[str], None]) -> Fit:
    """Fit a model with an effect added, as a diagnosis does; from the effect's own values where that gains nothing."""
    tests = misfit_tests(before, (effect,), level_of(before.model))
    fits = [ratio.fit for ratio in Search(tests, report).extend(every=True)]
    if not fits or fits[0].log_likelihood < before.log_likelihood:
        fits.append(refit(before, before.model + effect))
    return max(fits, key=lambda fit: fit.log_likelihood)


# ------------------------------------------------------------------------------
# A learned force as an effect file: where no formula reproduces it, the coefficients of its splines, N, at even steps
# of each normalised variable (`missing_force.Domain`), and a function that sums them:
#
#     T(u) = Σ c_k β(u + 1 − k),   β(d) = (max(0, 2 − |d|)³ − 4 max(0, 1 − |d|)³)/6,
#
# β the cubic B-spline of unit step (de Boor 2001, ch. IX). Its single parameter scales the table.


_STATE = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}


def table_text(learned: LearnedForce, origin: str = "") -> str:
    """Source of an effect file that holds a learned force."""
    domain, visited = learned.domain, learned.visited
    largest = int(np.argmax(np.abs(visited["force_N"].to_numpy(float))))
    at = {name: float(f"{visited[VARIABLES[name]].to_numpy(float)[largest]:.5g}") for name in domain.variables}
    worked_N = float(learned.force([np.array([value]) for value in at.values()])[0][0])
    table, digits = learned.found.mean.reshape(domain.counts), {"float_kind": "{:.6g}".format}
    numbers = np.array2string(table, 110, separator=", ", threshold=table.size, formatter=digits)  # type: ignore[arg-type]
    return _source(
        str(remark("learned_file", learned=learned, origin=origin)),
        constants=f"TABLE = np.array({numbers})  # N\n\n",
        parameters=[_parameter(("a", "a", "1"), "1.0", (-10, 10), (0, 2), 'meaning="size of the table"')],
        arguments={"a": 1.0},
        body=_table_code(domain),
        worked_N=worked_N,
        how="the learned force at this state",
        state={_STATE[name]: value for name, value in at.items()},
    )


def _source(
    docstring: str,
    constants: str,
    parameters: Sequence[str],
    arguments: Mapping[str, float],
    body: Sequence[str],
    worked_N: float,
    how: str,
    state: Mapping[str, float],
) -> str:
    """Source of an effect file with a tail force: the lines of its parts, and a worked example."""
    lines = {name: "\n    ".join(part) for name, part in (("parameters", parameters), ("body", body))}
    return f'''"""{docstring}"""

import numpy as np

from vinetrack.effects import Parameter, Worked

{constants}PARAMETERS = (
    {lines["parameters"]}
)


def tail_force(s, rig, {", ".join(arguments)}):
    {lines["body"]}


WORKED = (
    Worked(
        "tail_force",
        {worked_N:.8g},
        "{how}",
        state={state!r},
        parameters={arguments!r},
    ),
)
'''


def _parameter(names: Sequence[str], value: str, bounds: Sequence[float], plausible: Sequence[float], more: str) -> str:
    """The line of a parameter of an effect file, of this name, symbol and unit."""
    quoted = ", ".join(f'"{name}"' for name in names)
    limits = ("({:.6g}, {:.6g})".format(*sorted(pair)) for pair in (bounds, plausible))
    return "Parameter({}, {}, bounds={}, plausible={}, {}),".format(quoted, value, *limits, more)


def _table_code(domain: Domain) -> list[str]:
    """Lines of code that sum the splines of the table at a state."""
    places, loops = list[str](), list[str]()
    for depth, (axis, at, k) in enumerate(zip(domain.axes, "uv", "km", strict=False)):
        low, width = (repr(float(f"{value:.12g}")) for value in (axis.low, axis.high - axis.low))
        part = f"np.minimum(np.maximum((s.{_STATE[axis.name]} - {low}) / {width}, 0.0), 1.0)"
        if axis.log_ratio:
            part = f"np.log1p({axis.log_ratio!r} * {part}) / np.log1p({axis.log_ratio!r})"
        places.append(f"{at} = 1.0 + {axis.count - 3}.0 * {part}")
        loop = [
            f"for {k} in range({axis.count}):",
            f"    d = np.abs({at} - {k})",
            f"    of_{at} = (np.maximum(2.0 - d, 0.0) ** 3 - 4.0 * np.maximum(1.0 - d, 0.0) ** 3) / 6.0",
        ]
        loops += [f"{'    ' * depth}{line}" for line in loop]
    terms = "TABLE[k] * of_u" if len(domain.axes) == 1 else "TABLE[k, m] * of_u * of_v"
    return [*places, "total = 0.0", *loops, f"{'    ' * len(domain.axes)}total = total + {terms}", "return a * total"]


# ------------------------------------------------------------------------------
# Laws, and where no formula reproduces it the learned force, fitted as effects.


@dataclass(frozen=True)
class Proposed:
    """A law, or the learned force as a table, fitted as an effect. `text` is the source of its file, by where it comes
    from; `rms_left_out_m` its error on left-out conditions, NaN where the likelihood of others is far higher.
    """

    words: str
    text: Callable[[str], str]
    effect: Effect
    ratio: LikelihoodRatio
    rms_left_out_m: float = math.nan


@dataclass(frozen=True)
class Proposal:
    """Fitted laws, best first, and the error on left-out conditions of the model without them, m. `tied` are those that
    the data do not exclude; empty where no law is proposed, for the `reason` given. `table` is the learned force, where
    it explains what no law does.
    """

    before: Fit
    rms_left_out_m: float
    laws: tuple[Proposed, ...]
    tied: tuple[Proposed, ...]
    reason: Remark
    table: Proposed | None


@in_one_blas_thread
def propose(model: Model, pairs: Pairs, report: Callable[[str], None]) -> Proposal:
    """Find laws of force that explain the misfit of a model, and fit each in the equation of motion."""
    report("fitting the model")
    before = initial_fit(model, pairs, candidates_of(model, None, {}))
    report("estimating the missing force")
    force = missing_force(before)
    detected = [law for law in force.laws if law.is_detected]
    # 0.2: laws that explain less than the best by more than this part are not fitted (chosen)
    # 4: most laws that are fitted in the equation of motion (chosen)
    best = [law for law in detected if law.explained > detected[0].explained - 0.2][:4]
    with tempfile.TemporaryDirectory() as folder:
        before, laws = _fitted(before, best, Path(folder), report)
        report("errors on left-out conditions")
        error_m = left_out_error(before)
        laws.sort(key=lambda law: -law.ratio.delta_chi2)
        laws = [
            replace(law, rms_left_out_m=left_out_error(law.ratio.fit))
            if law.ratio.deviance_excess(laws[0].ratio) < OUT_OF_REACH
            else law
            for law in laws
        ]
        significant = [law for law in laws if law.rms_left_out_m < error_m and _explains(before, law.ratio)]
        not_excluded = answer_set([law.ratio for law in significant])[0] if significant else []
        tied = tuple(law for ratio in not_excluded for law in significant if law.ratio is ratio)
        reason = Remark() if tied else remark("no_law_predicts_better" if best else "no_law_detected")
        # The learned force as a table, where it explains what no law does
        remaining = min((law.ratio.fit.chi2_per_dof for law in tied), default=before.chi2_per_dof) - 1
        # 0.9: part of the misfit that a law must take away for the learned force not to be tried as a table (chosen)
        is_open = remaining >= (1 - 0.9) * (before.chi2_per_dof - 1)
        tried = [force.learned] if force.learned is not None and is_open else []
        start, tables = _fitted(before, tried, Path(folder), report)
        tables = [
            told
            for table in tables
            if _explains(start, table.ratio)
            and all(law.ratio.deviance_excess(table.ratio) > ANSWER_SET_DELTA_CHI2 for law in tied)
            and (told := replace(table, rms_left_out_m=left_out_error(table.ratio.fit))).rms_left_out_m < error_m
        ]
    return Proposal(before, error_m, tuple(laws), tied, reason, next(iter(tables), None))


def _fitted(
    before: Fit, forces: Sequence[RankedLaw | LearnedForce], folder: Path, report: Callable[[str], None]
) -> tuple[Fit, list[Proposed]]:
    """Forces fitted as effects, and the fit without them, compiled with these effects but without the catalogue, which
    is not needed here.
    """
    if not forces:
        return before, []
    made: list[tuple[str, Callable[[str], str], Effect]] = []
    for force in forces:
        if isinstance(force, RankedLaw):
            name, words, text = f"proposed_{force.law.name}", force.words, partial(effect_text, force)
        else:
            name = "_".join(["learned", *force.domain.variables])
            words, text = str(force.sentence), partial(table_text, force)
        path = folder / f"{name}.py"
        path.write_text(text(""), encoding="utf-8")
        remember(path)
        made.append((words, text, load_effect(path)))
    before, found = with_host(before, Model((*before.model, probe(), *(effect for *_, effect in made)))), []
    for words, text_of, effect in made:
        with suppress(FitError):
            ratio = likelihood_ratio(before, (effect,), fit_with(before, effect, report))
            found.append(Proposed(words, text_of, effect, ratio))
    return before, found


def _explains(before: Fit, ratio: LikelihoodRatio) -> bool:
    """Whether a force is significant, and takes away a good part of a misfit that exceeds the noise."""
    misfit = before.chi2_per_dof - 1
    reduction = before.chi2_per_dof - ratio.fit.chi2_per_dof
    return ratio.sigma > SEARCH_SIGMAS and (misfit < 1 or reduction > LEAST_MISFIT_REDUCTION * misfit)


# State of the worked example; a convention of this file
_WORKED_STATE = {"tail_position": 0.2, "tail_velocity": 2.0, "pressure": 20e3, "time": 0.05}


def effect_text(detected: RankedLaw, origin: str = "") -> str:
    """Source of an effect file that holds a law."""
    law, size = detected.law, float(f"{detected.amplitude_N / detected.law.peak:.6g}")
    unit = "·".join(f"{of.unit}{('', '²', '³')[power - 1]}" for of, power in law.factors)
    names, limits = ("k", "k", f"N/({unit})" if unit else "N"), ((-100 * abs(size), 100 * abs(size)), (0.0, 10 * size))
    # From the law itself: it checks the formula of the file
    there = SimpleNamespace(**{of.attribute: np.array([_WORKED_STATE[of.state]]) for of in QUANTITIES})
    return _source(
        str(remark("law_file", law=detected.words, formula=f"tail force k {law.symbols}".rstrip(), origin=origin)),
        constants="",
        parameters=[_parameter(names, repr(size), *limits, 'meaning="size of the law"')],
        arguments={"k": size},
        body=[" * ".join(["return k", *(f"s.{of.state}" for of, power in law.factors for _ in range(power))])],
        worked_N=detected.amplitude_N * float(law.unit_force(there)[0, 0]),  # type: ignore[arg-type]
        how="the fitted law at this state",
        state=_WORKED_STATE,
    )
