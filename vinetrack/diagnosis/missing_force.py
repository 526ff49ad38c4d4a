"""The force that a model lacks: a smooth function of what it most likely depends on, and the simple law it resembles.

The force is a Gaussian process over growth, speed, time since release or pressure, or over two of them together
(`vinetrack.diagnosis.force_inversion`). Its coefficients are fitted to positions, through the response of the
trajectory to a force, with B, n, yield pressures and the release, origin, pressure and B of every trial free, each
under its own prior; positions are never differentiated. Choices of variables are compared by their marginal likelihood,
averaged over amplitude, length scales and what the force may be where growth begins. Misfit that no force explains is
treated as further noise. All choices are compared about the same motions: those on the tracks, then those under the
force that leaves least, or those of the model where these leave less. There, too, simple laws are held against what the
model lacks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from vinetrack.core.problems import Remark, remark
from vinetrack.core.process import in_one_blas_thread
from vinetrack.core.records import Floats
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.force_inversion import FittedMotion, ForceEquations, ForceEstimate, ForcePoint, ForceProblem
from vinetrack.diagnosis.hypotheses import ANSWER_SET_DELTA_CHI2
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.gaussian_processes import (
    LENGTH_SCALES,
    Posterior,
    posterior,
    product_of_modes,
    root_of_covariance,
    splines,
    standard_error,
)

# What a force may depend on, and the attribute of a motion that holds it
VARIABLES = {"growth": "lead_position_m", "speed": "tail_velocity_m_s", "time": "time_s", "pressure": "pressure_Pa"}

# What a force may be where growth begins. A force that is free there competes with B, n and P_y, and has to be worth a
# Δχ² of the answer set: those are believed first.
Start = Literal["nothing", "a constant", "anything"]
LOG_ODDS: dict[Start, float] = {"nothing": 0.0, "a constant": 0.0, "anything": -0.5 * ANSWER_SET_DELTA_CHI2}


# Splines along a variable, when it is alone and when it is one of two (chosen)
SPLINES = {"growth": (24, 20), "speed": (16, 8), "time": (16, 8), "pressure": (7, 5)}


@dataclass(frozen=True)
class Axis:
    """A variable of a force, the range that was visited, SI, and the number of splines along it. Where `log_ratio` is
    not 0, it is its logarithm, from 1 to 1 + that: forces change over fractions of speeds that span decades.
    """

    name: str
    low: float
    high: float
    count: int
    log_ratio: float = 0.0

    def part(self, at: Floats) -> Floats:
        """The variable scaled to 0 to 1 over the visited range. Shapes: at (n,) → (n,)."""
        part = (at - self.low) / (self.high - self.low)
        if self.log_ratio:
            part = np.log1p(self.log_ratio * np.maximum(part, 0.0)) / math.log1p(self.log_ratio)
        return np.asarray(part)


@dataclass(frozen=True)
class Domain:
    """The variables of a force, one or two."""

    axes: tuple[Axis, ...]

    @property
    def name(self) -> str:
        """The variables joined by +: `growth`, `growth+speed`."""
        return "+".join(self.variables)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables."""
        return tuple(axis.name for axis in self.axes)

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of splines along the variables."""
        return tuple(axis.count for axis in self.axes)

    @property
    def start_axis(self) -> int:
        """Index of the variable that marks the start of growth: growth, else time since release; else −1."""
        return next((self.variables.index(name) for name in ("growth", "time") if name in self.variables), -1)

    def values_along(self, motion: FittedMotion) -> list[Floats]:
        """The variables along a motion, SI, each of shape (n_times,)."""
        return [np.asarray(getattr(motion, VARIABLES[name])) for name in self.variables]

    def basis(self, values: Sequence[Floats]) -> Floats:
        """Design matrix: all splines, or products of splines, at these values. Shapes: values (n,) → (n, n_splines)."""
        first, *others = [splines(axis.part(at), axis.count) for axis, at in zip(self.axes, values, strict=True)]
        for other in others:
            first = (first[:, :, None] * other[:, None, :]).reshape(len(first), -1)
        return first

    def unit_push(self, motion: FittedMotion) -> Floats:
        """The splines along a motion, shape (n_times, n_splines)."""
        return self.basis(self.values_along(motion))

    @property
    def hypotheses(self) -> list[tuple[Start, tuple[float, ...]]]:
        """What the force may be where growth begins, with every combination of length scales."""
        starts: list[Start] = list(LOG_ODDS) if len(self.axes) == 2 else ["nothing", "a constant"]
        if self.start_axis < 0:
            starts = ["anything"]
        return list(itertools.product(starts, itertools.product(LENGTH_SCALES, repeat=len(self.axes))))

    def modes(self, at_start: Start, lengths: Sequence[float]) -> Floats:
        """Square root of the covariance of the coefficients at unit amplitude, shape (n_splines, n_modes)."""
        start = self.start_axis
        roots = [root_of_covariance(*each, k == start) for k, each in enumerate(zip(self.counts, lengths, strict=True))]
        modes = [product_of_modes(roots)]
        if at_start == "a constant":
            modes.append(np.ones((math.prod(self.counts), 1)))
        if at_start == "anything" and start >= 0:
            # 3.0: prior amplitude of the force where growth begins, as a multiple of that of the rest (chosen)
            roots[start] = np.full((self.counts[start], 1), 3.0)
            modes.append(product_of_modes(roots))
        return np.hstack(modes)


def candidate_domains(motions: Sequence[FittedMotion]) -> list[Domain]:
    """Every variable alone, then every pair, over the ranges that the motions visit."""
    ranges: dict[str, tuple[float, float, float]] = {}
    for name in VARIABLES:
        by_trial = [np.asarray(getattr(motion, VARIABLES[name]))[motion.is_visited] for motion in motions]
        # 0.98: quantile of a trial's speeds that counts as its highest (chosen)
        high = max(float(np.quantile(values, 0.98 if name == "speed" else 1.0)) for values in by_trial)
        low = min(float(values.min()) for values in by_trial) if name == "pressure" else 0.0
        # 0.02: part of the highest pressure by which pressures must differ for pressure to be a variable (chosen)
        if high - low > 0.02 * abs(high):
            # 0.03: part by which the range of pressures is extended at both ends (chosen)
            low, high = (0.97 * low, 1.03 * high) if name == "pressure" else (low, high)
            # ("speed", "time"): variables on a logarithmic scale above their median (chosen)
            typical = float(np.median([np.median(values) for values in by_trial]))
            ranges[name] = low, high, (high - low) / (typical or high) if name in ("speed", "time") else 0.0
    choices = [*((name,) for name in ranges), *itertools.combinations(ranges, 2)]
    domains = []
    for names in choices:
        limits = ((name, SPLINES[name][len(names) - 1], *ranges[name]) for name in names)
        domains.append(Domain(tuple(Axis(name, low, high, count, ratio) for name, count, low, high, ratio in limits)))
    return domains


# ------------------------------------------------------------------------------
# The choice of variables. Where speeds are steady, growth, speed and time are hardly three separate variables: a
# surface over two of them can be written over another two, and weights compare only how smooth the surfaces are, which
# depends on the prior. A choice is therefore excluded by the misfit that it leaves, not by its weight alone.

# Part of χ² that is the unit of differences of ln Z where that is more than 1: so much depends on the prior (chosen)
LEAST_DIFFERENCE = 5e-4

LEAST_CHI2_PER_POINT = 2.0  # χ² per point of the fit from which a force is estimated (chosen)


@dataclass(frozen=True)
class Choice:
    """A force over some variables: the posterior of its coefficients, N, their equations, and their least squares
    whether smooth or not.
    """

    domain: Domain
    found: Posterior
    equations: ForceEquations
    best: ForceEstimate

    @property
    def least_chi2(self) -> float:
        """χ² of the best coefficients."""
        return self.equations.chi2 - self.best.delta_chi2


def choices_seen_from(problem: ForceProblem, point: ForcePoint) -> list[Choice]:
    """All choices of variables about the motions of a point."""
    domains = candidate_domains(point.motions)
    equations = [ForceEquations(problem, point, domain.unit_push) for domain in domains]
    best = [each.estimate() for each in equations]
    inflation = problem.inflation(min(e.chi2 - b.delta_chi2 for e, b in zip(equations, best, strict=True)))
    return [
        Choice(domain, coefficients_of(domain, each, inflation), each, estimate)
        for domain, each, estimate in zip(domains, equations, best, strict=True)
    ]


def _least_chi2(choices: Sequence[Choice]) -> float:
    return min(choice.least_chi2 for choice in choices)


def coefficients_of(domain: Domain, equations: ForceEquations, inflation: float) -> Posterior:
    """The posterior of the coefficients over a domain, their noise variance inflated."""
    drives_N = (np.nan_to_num(motion.pressure_Pa) * motion.trial.area_m2 / 2 for motion in equations.point.motions)
    amplitudes_N = max(float(np.max(drive_N)) for drive_N in drives_N) * np.geomspace(0.003, 0.3, 9)  # (chosen)
    return posterior(
        equations.information / inflation,
        (equations.score + equations.information @ equations.coefficients) / inflation,
        [domain.modes(*each) for each in domain.hypotheses],
        amplitudes_N,
        [LOG_ODDS[at_start] for at_start, _ in domain.hypotheses],
    )


def variable_weights(log_evidence: Mapping[str, float], unit: float = 1.0) -> dict[str, float]:
    """Posterior probabilities of choices of variables, with equal prior odds for one variable and for two; differences
    of ln Z count in this unit. By name, highest first.
    """
    pairs, highest = sum("+" in name for name in log_evidence), max(log_evidence.values())
    raw = {
        name: math.exp((value - highest) / unit) / (pairs if "+" in name else len(log_evidence) - pairs)
        for name, value in log_evidence.items()
    }
    return {name: value / sum(raw.values()) for name, value in sorted(raw.items(), key=lambda part: -part[1])}


@dataclass(frozen=True)
class LearnedForce:
    """The missing force over the variables that it most likely depends on: the posterior of its coefficients, N, and
    the motions of the trials under it.
    """

    domain: Domain
    found: Posterior
    motions: Sequence[FittedMotion]
    weights: Mapping[str, float]
    not_excluded: tuple[str, ...]
    explained: float
    is_repeated: bool

    def force(self, values: Sequence[Floats]) -> tuple[Floats, Floats]:
        """The force at values of the variables and its standard error, N. Shapes: values (n,) → (n,), (n,)."""
        basis = self.domain.basis(values)
        return basis @ self.found.mean, standard_error(basis, self.found.covariance)

    @cached_property
    def table(self) -> pd.DataFrame:
        """The force on a grid of its variables (condition blank), with the number of trials that visited each point,
        and along the first trial of each condition. Columns `VARIABLES`, force_N, sigma_N, trials, condition.
        """
        plot_points, visited_distance = (60, 30), 0.06  # Points of a curve, and along each side of a map (chosen)
        axes, names = self.domain.axes, [VARIABLES[name] for name in self.domain.variables]
        ends = [np.linspace(axis.low, axis.high, plot_points[len(axes) - 1]) for axis in axes]
        grid = [values.ravel() for values in np.meshgrid(*ends, indexing="ij")]
        trials = np.zeros(grid[0].size, dtype=int)
        parts = {"": dict(zip(names, grid, strict=True))}
        for motion in self.motions:
            near = np.ones((grid[0].size, motion.time_s.size), dtype=bool) & motion.is_visited
            for axis, at, course in zip(axes, grid, self.domain.values_along(motion), strict=True):
                near &= np.abs(axis.part(at)[:, None] - axis.part(course)) < visited_distance
            trials += near.any(axis=1)
            points = np.linspace(0, np.count_nonzero(motion.is_visited) - 1, plot_points[0]).astype(int)
            along = {name: np.asarray(getattr(motion, name))[points] for name in VARIABLES.values()}
            parts.setdefault(motion.trial.condition, along)
        tables = []
        for condition, values in parts.items():
            force_N, sigma_N = self.force([values[name] for name in names])
            columns: dict[str, Any] = dict.fromkeys(VARIABLES.values(), math.nan) | values
            columns |= {"force_N": force_N, "sigma_N": sigma_N, "trials": 1 if condition else trials}
            tables.append(pd.DataFrame(columns | {"condition": condition}))
        return pd.concat(tables, ignore_index=True)

    @property
    def visited(self) -> pd.DataFrame:
        """The points of the grid that trials visited."""
        return self.table[(self.table["condition"] == "") & (self.table["trials"] > 0)]

    @cached_property
    def sentence(self) -> Remark:
        """What it depends on and how certain that is."""
        force_N = self.visited["force_N"]
        return remark(
            "learned_force",
            name=self.domain.name,
            weights=self.weights,
            alternatives=self.not_excluded,
            begins=self.domain.hypotheses[self.found.hypothesis][0] if self.domain.start_axis >= 0 else "",
            range_N=(float(force_N.min()), float(force_N.max())),
            sigma_N=float(self.visited["sigma_N"].median()),
            explained=self.explained,
            is_repeated=self.is_repeated,
            has_pressures=any("pressure" in name for name in self.weights),
        )

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "variables": list(self.domain.variables),
            "weights": dict(self.weights),
            "not_excluded": list(self.not_excluded),
            "explained": self.explained,
            "sentence": str(self.sentence),
        }


def learned_force(problem: ForceProblem, first: Sequence[Choice], choices: Sequence[Choice]) -> LearnedForce | None:
    """The missing force over the variables of the highest marginal likelihood, where it explains the misfit: χ² beyond
    the number of points, as the evidence against no force, as first seen from the tracks.
    """
    misfit = first[0].equations.chi2 - problem.n_points
    if misfit < (LEAST_CHI2_PER_POINT - 1) * problem.n_points:
        return None
    inflation = problem.inflation(_least_chi2(choices))
    unit = max(LEAST_DIFFERENCE * _least_chi2(choices) / inflation, 1.0)
    weights = variable_weights({choice.domain.name: choice.found.log_evidence for choice in choices}, unit)
    best = max(choices, key=lambda choice: weights[choice.domain.name])
    domain, equations = best.domain, best.equations
    change = best.found.mean - equations.coefficients
    # With these coefficients, all other unknowns estimated anew
    chi2 = equations.chi2 - 2 * float(equations.score @ change) + float(change @ equations.information @ change)
    explained = (misfit + problem.n_points - chi2) / misfit
    # 0.95: part of the misfit that the force must take away to be reported (chosen)
    if explained < 0.95:
        return None
    # Besides the best, those with enough weight, and those of no more variables whose χ² is hardly larger, without
    # regard to how smooth they are. 0.05: weight from which a choice is reported with the best (chosen)
    threshold = best.least_chi2 + inflation * unit * ANSWER_SET_DELTA_CHI2
    as_good = {choice.domain.name for choice in choices if choice.least_chi2 < threshold}
    as_good -= {name for name in as_good if "+" in name and len(domain.axes) == 1}
    others = [name for name in weights if name != domain.name and (weights[name] >= 0.05 or name in as_good)]
    return LearnedForce(
        domain=domain,
        found=best.found,
        motions=equations.point.motions,
        weights=weights,
        not_excluded=tuple(others),
        explained=min(explained, 1.0),
        is_repeated=bool(problem.scatter.dof),
    )


def _under_best(problem: ForceProblem, choices: Sequence[Choice]) -> ForcePoint:
    """The motions under the most probable force of the likeliest variable or two, whichever leave less: far from the
    solution, two often look likelier for errors of the linear equations. Motions respond in full, by steps.
    """
    inflation, found = problem.inflation(_least_chi2(choices)), [(math.inf, choices[0].equations.point)]
    by_evidence = sorted(choices, key=lambda choice: -choice.found.log_evidence)
    for choice in {len(choice.domain.axes): choice for choice in reversed(by_evidence)}.values():
        equations, cost = choice.equations, math.inf
        # A step may lead where nothing can be computed: the point before it stands.
        with suppress(FloatingPointError, np.linalg.LinAlgError):
            # 8, 1e-3: most steps, and relative fall of χ² below which the search ends (chosen)
            for _ in range(8):
                coefficients = coefficients_of(choice.domain, equations, inflation).mean
                point = equations.moved(coefficients)
                equations = ForceEquations(problem, point, choice.domain.unit_push, coefficients)
                if not equations.cost < (1 - 1e-3) * cost:
                    break
                cost = equations.cost
                found.append((cost, point))
    return min(found, key=lambda each: each[0])[1]


# ------------------------------------------------------------------------------
# Simple laws that a missing force may follow: products of powers of what moves. Whatever has a shape of its own, such
# as a rough patch or a friction that falls with speed, is told by the learned force.


class Quantity(NamedTuple):
    """What a law may depend on: attribute of a motion, name in an effect file, symbol, and unit."""

    name: str
    attribute: str
    state: str
    symbol: str
    unit: str


QUANTITIES = (
    Quantity("position", "tail_position_m", "tail_position", "x", "m"),
    Quantity("speed", "tail_velocity_m_s", "tail_velocity", "ẋ", "(m/s)"),
    Quantity("pressure", "pressure_Pa", "pressure", "P", "Pa"),
    Quantity("time", "time_s", "time", "t", "s"),
)

# The laws, by their powers of each quantity (chosen)
LAWS = (
    (0, 0, 0, 0), (1, 0, 0, 0), (2, 0, 0, 0), (0, 1, 0, 0), (0, 2, 0, 0), (0, 3, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1),
    (1, 1, 0, 0), (2, 1, 0, 0), (1, 2, 0, 0), (1, 0, 1, 0), (2, 0, 1, 0), (0, 1, 1, 0), (0, 2, 1, 0),
)  # fmt: skip


@dataclass(frozen=True)
class Law:
    """A force in proportion to powers of the quantities, `peak` at its largest per unit of its coefficient."""

    powers: tuple[int, int, int, int]
    peak: float = 1.0

    @property
    def factors(self) -> list[tuple[Quantity, int]]:
        """The quantities that it depends on, with their powers."""
        return [(quantity, power) for quantity, power in zip(QUANTITIES, self.powers, strict=True) if power]

    @property
    def name(self) -> str:
        """Name of the law: `speed2_pressure`."""
        return "_".join(f"{of.name}{power if power > 1 else ''}" for of, power in self.factors) or "constant"

    @property
    def symbols(self) -> str:
        """What it is in proportion to: `ẋ² P`; blank for a constant."""
        return " ".join(f"{of.symbol}{('', '²', '³')[power - 1]}" for of, power in self.factors)

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of unit amplitude along a motion, shape (n_times, 1)."""
        of_each = [getattr(motion, of.attribute) ** power for of, power in self.factors]
        return np.asarray(math.prod(of_each, start=np.ones_like(motion.time_s)) / self.peak)[:, None]


@dataclass(frozen=True)
class RankedLaw:
    """A law with its estimate, its BIC, and the largest force that these motions make plausible, N."""

    law: Law
    estimate: ForceEstimate
    bic: float
    explained: float = 0.0
    largest_N: float = math.inf

    @property
    def amplitude_N(self) -> float:
        """The force at its largest, N."""
        return float(self.estimate.amplitude[0])

    @property
    def is_detected(self) -> bool:
        """Whether its amplitude differs significantly from zero, and is plausible for these motions."""
        # 5.0: standard errors that the amplitude of a law must differ from zero to be detected
        return 5.0 * self.estimate.sigma < abs(self.amplitude_N) < self.largest_N

    @property
    def words(self) -> str:
        """Description of the law with its amplitude."""
        return str(remark("law", symbols=self.law.symbols, size=(self.amplitude_N, self.estimate.sigma)))


def ranked_laws(problem: ForceProblem, point: ForcePoint, chi2: float, smooth_delta_chi2: float) -> list[RankedLaw]:
    """All laws: detected ones first, then by their Bayesian information criterion (Schwarz, Annals of Statistics 6,
    461, 1978). Misfit that not even the best force explains is counted as further noise: it inflates the variance of
    every independent residual. `chi2` is that without a force, `smooth_delta_chi2` its fall with a smooth force.
    """
    largest_N, laws = 0.0, [Law(powers) for powers in LAWS]
    peaks = np.max([[law.unit_force(motion)[motion.is_visited].max() for law in laws] for motion in point.motions], 0)
    laws = [replace(law, peak=float(peak) or 1.0) for law, peak in zip(laws, peaks, strict=True)]
    for motion in point.motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.acceleration))
        # 10.0: largest force that is reported, in parts of drive, weight and inertia at their largest (chosen)
        largest_N = max(largest_N, 10.0 * float(np.max(drive_N + body_N)))
    equations = ForceEquations(problem, point, lambda motion: np.hstack([law.unit_force(motion) for law in laws]))
    estimates = [equations.estimate(slice(k, k + 1)) for k in range(len(laws))]
    largest = max(smooth_delta_chi2, *(estimate.delta_chi2 for estimate in estimates))
    noise, ranked = problem.inflation(chi2 - largest), list[RankedLaw]()
    for law, estimate in zip(laws, estimates, strict=True):
        # A factor counts as a parameter, because it was chosen among several.
        n_parameters = max(sum(power > 0 for power in law.powers), 1)
        bic = (largest - estimate.delta_chi2) / noise + n_parameters * math.log(problem.n_independent)
        ranked.append(RankedLaw(law, estimate, bic, largest_N=largest_N))
    return sorted(ranked, key=lambda law: (not law.is_detected, law.bic))


LEAST_EXPLAINED_TO_NAME = 0.7  # Part of what is missing that a law must explain to be named (chosen)

# Part of the misfit that a smooth force in every condition must take away for the misfit to count as a force (chosen)
LEAST_MISFIT_REDUCTION = 0.5


@dataclass(frozen=True)
class MissingForce:
    """What is missing, as a force on the tail: the simple laws, best first, and what was learned."""

    laws: Sequence[RankedLaw]
    sentence: Remark
    learned: LearnedForce | None = None

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "sentence": str(self.sentence),
            "laws": [
                {"law": one.law.name, "words": one.words, "explained": one.explained}
                | {"amplitude_N": one.amplitude_N, "sigma_N": one.estimate.sigma}
                for one in self.laws[:6]
            ],
            "learned": None if self.learned is None else self.learned.to_json(),
        }


@in_one_blas_thread
def missing_force(fit: Fit) -> MissingForce:
    """Estimate the force that a fit lacks as a smooth function, and compare it with simple laws."""
    problem = ForceProblem(fit)
    first = choices = choices_seen_from(problem, problem.start)
    learned = None
    with suppress(FloatingPointError, np.linalg.LinAlgError), np.errstate(all="raise", under="ignore"):
        choices = choices_seen_from(problem, _under_best(problem, first))
        learned = learned_force(problem, first, choices)
    choices = min(first, choices, key=_least_chi2)
    point, chi2 = choices[0].equations.point, choices[0].equations.chi2
    laws = ranked_laws(problem, point, chi2, chi2 - _least_chi2(choices))
    in_laws = [law.estimate.delta_chi2_beyond_chance for law in laws]
    explicable = max(1e-300, *in_laws, *(choice.best.delta_chi2_beyond_chance for choice in choices))
    laws = [replace(law, explained=part / explicable) for law, part in zip(laws, in_laws, strict=True)]
    beyond_noise = chi2 - problem.n_points
    # NaN where the misfit hardly exceeds the noise
    reduction = min(explicable / beyond_noise, 1.0) if beyond_noise > problem.n_points else math.nan
    return MissingForce(laws, _remark(laws, reduction), learned)


def _remark(laws: Sequence[RankedLaw], misfit_reduction: float) -> Remark:
    """What the missing force looks like."""
    best = laws[0]
    if misfit_reduction < LEAST_MISFIT_REDUCTION:
        return remark("no_smooth_force", reduction=max(misfit_reduction, 0.0))
    if not best.is_detected:
        return remark("no_law_agreed_on" if math.isfinite(misfit_reduction) else "no_further_force")
    told = {"law": best.words, "explained": best.explained}
    if best.explained < LEAST_EXPLAINED_TO_NAME:
        return remark("like_no_law", **told)
    # Misfit that not even a free force takes away limits how well laws can be told apart.
    # 0.05: difference of the explained parts within which other laws are named with the best (chosen)
    margin = 0.05 + float(np.nan_to_num(1 - misfit_reduction))
    others = [law.words for law in laws[1:] if law.is_detected and law.explained > best.explained - margin]
    return remark("like_a_law", **told, others=others[:2])
