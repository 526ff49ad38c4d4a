"""A force drawn freely over one variable or over two together: cubic B-splines with a Gaussian process behind them.

The coefficients of the splines are taken as values of a Gaussian process at the splines' places, of covariance

    a² Π_d (1 + s_d + s_d²/3) exp(−s_d),   s_d = √5 |u_d − u'_d|/ℓ_d

with u the variables as parts of what the trials visited (Matérn's of order 5/2, Rasmussen & Williams 2006, §4.2). Its
forces can be differentiated twice, no more: bands of infinitely smooth ones, exp(−½ s²), are too narrow by far for a
force such as a power of the growth (a third of the points in them for nearly all, in a linear fit to draws). That is
a penalised spline whose penalty has a size a, N, and lengths ℓ_d of its own (Wahba, JASA 73, 364, 1978; Wilson &
Nickisch, ICML 2015). In the coordinates z in which this covariance is a² times the unit matrix many directions are of
no size and are left out: `Surface` holds those that stay.

Part of any force can be taken over by B, n and P_y: with ½ΔB ẋⁿ more of a force that is the same all along the growth,
and ΔB more of B, positions are the same. No data decide between the two, so what is drawn follows a convention: B, n
and P_y are those of the vine where growth begins, and the missing force is what is added to them from there on. The
process is conditioned on being nothing there (§2.2 of the same), at a growth of 0, or without the growth at 0 s since
release. Where the tracks are against it (`force_evidence`) a constant is added, or any function of the other variable,
`WIDER` times as large as the surface (functional ANOVA, Gu 2013, ch. 2).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.cubic_splines import ACTING, acting_splines, splines
from vinetrack.diagnosis.force_sensitivities import FittedMotion

VARIABLES = {
    "growth": "lead_position_m",
    "speed": "tail_velocity_m_s",
    "time": "time_s",
    "pressure": "pressure_Pa",
}
"""What a force may depend on, and the attribute of a motion that holds it."""

ALONE = {"growth": 24, "speed": 16, "time": 16, "pressure": 7}
TOGETHER = {"growth": 20, "speed": 8, "time": 8, "pressure": 5}
"""Splines along a variable, alone and beside another. Chosen: as fine as positions tell, which feel a force through two
integrals; half as many miss waves of a quarter of the growth, twice as many cost four times the time."""

LENGTHS = (0.05, 0.08, 0.14, 0.25, 0.45, 0.8, 1.6)
"""Lengths of the process that are tried, as parts of what was visited. Chosen: from the finest that the splines follow
to one that leaves a curve hardly more than a slope; finer steps move no weight by more than a tenth."""

AMPLITUDES = np.geomspace(0.003, 0.3, 9)
"""Amplitudes that are tried, as parts of the largest drive. Chosen: from what no trial feels to a gross failure;
larger forces that B and n balance lead astray where the model is far off."""

KEPT, FOLLOWED = 1e-6, 1e-4
"""Variances of directions, as parts of the largest, below which they are left out: of what positions are held against,
and of what a search follows. Chosen: forces of a thousandth and of a hundredth of the largest; at a tenth of the second
a search takes half as long again, at a hundred times the first bands miss half of the truth where noise is small."""

NOTHING, CONSTANT, ANY = "nothing", "a constant", "anything"
"""What a force may be where growth begins."""

WIDER = 3.0
"""How much larger than the surface a force where growth begins may be. Chosen: B, n and P_y could hold most of it, so
that the data say little; at half of it and at twice the band there is as much narrower and wider."""

OVER_DECADES = ("speed", "time")
"""Variables that are taken as logarithms beyond their median. Chosen: they differ tenfold between slow and fast trials
where growth and pressures do not."""

FASTEST = 0.98
"""Quantile of a trial's speeds that counts as its highest: the model's peak after release is not seen. Chosen."""

DIFFERENT = 0.02
"""Part of the highest pressure by which pressures must differ to be a variable. Chosen: what single trials err by."""


MARGIN = 0.03
"""Part by which a force of the pressure goes on beyond the lowest and the highest: trials differ from the sheet, and a
force that is constant there has a bend at what was set. Chosen: three times what single trials err by."""


@lru_cache
def _even_knots(count: int) -> tuple[float, ...]:
    return tuple(np.linspace(0.0, 1.0, count - 2).tolist())


def curves(at: Floats, count: int) -> Floats:
    """Cubic B-splines on 0 to 1, shape (n, count), evenly wide.

    Parameters
    ----------
    at : array, shape (n,)
        Places from 0 to 1.
    count : int
        Number of splines.

    Returns
    -------
    array, shape (n, count)
    """
    return splines(at, np.array(_even_knots(count)))


def standard_error(basis: Floats, covariance: Floats) -> Floats:
    """Standard error of what coefficients of this covariance make of a basis, shape (n,).

    Parameters
    ----------
    basis : array, shape (n, n_splines)
    covariance : array, shape (n_splines, n_splines)
        Of the coefficients, N².

    Returns
    -------
    array, shape (n,), N
    """
    return np.asarray(np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis)))


@lru_cache(maxsize=256)
def covariance_root(count: int, length: float, *, from_nothing: bool = False) -> tuple[Floats, Floats]:
    """Directions and variances of a process of unit size and this length, at the places of so many splines.

    Parameters
    ----------
    count : int
        Number of splines.
    length : float
        As part of the whole.
    from_nothing : bool
        Whether it is nothing at the first place: conditioned on that.

    Returns
    -------
    directions : array, shape (count, count)
    variances : array, shape (count,)
    """
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, 1.0, count - 2), [1.0] * 3])
    at = np.array([knots[k + 1 : k + 4].mean() for k in range(count)])
    apart = math.sqrt(5) * np.abs(at[:, None] - at) / length
    covariance = (1 + apart + apart**2 / 3) * np.exp(-apart)
    if from_nothing:
        covariance = covariance - np.outer(covariance[:, 0], covariance[0])
    variances, directions = np.linalg.eigh(covariance)
    variances = np.maximum(variances, 0.0)
    # The same few are asked for thousands of times: kept, and so not to be written to.
    for array in (directions, variances):
        array.flags.writeable = False
    return directions, variances


@dataclass(frozen=True)
class Domain:
    """The variables of a force with what of each the trials visited, SI, and the splines along each."""

    variables: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    counts: tuple[int, ...]
    usual: tuple[float, ...]

    def parts(self, values: Sequence[Floats]) -> list[Floats]:
        """The variables as parts of what was visited: beyond what is `usual` above the lowest as its logarithm.

        Speeds and durations of a campaign span decades, and forces change over parts of them.

        Parameters
        ----------
        values : sequence of arrays, shape (n,), SI
            One a variable.

        Returns
        -------
        list of arrays
        """
        limits = zip(values, self.low, self.high, self.usual, strict=True)
        return [
            np.log1p(np.maximum(at - low, 0.0) / usual) / math.log1p((high - low) / usual)
            if math.isfinite(usual)
            else (at - low) / (high - low)
            for at, low, high, usual in limits
        ]

    @property
    def name(self) -> str:
        """The variables in a word: `growth`, `growth+speed`."""
        return "+".join(self.variables)

    @property
    def size(self) -> int:
        """Splines in all."""
        return math.prod(self.counts)

    def of_motion(self, motion: FittedMotion) -> list[Floats]:
        """The variables along a motion, SI, each of shape (n_times,).

        Parameters
        ----------
        motion : a fitted motion.

        Returns
        -------
        list of arrays
        """
        return [np.asarray(getattr(motion, VARIABLES[name])) for name in self.variables]

    def basis(self, values: Sequence[Floats]) -> Floats:
        """All splines, or products of splines, at these values, shape (n, size).

        Parameters
        ----------
        values : sequence of arrays, shape (n,), SI
            One a variable.

        Returns
        -------
        array, shape (n, size)
        """
        which, weights = self._acting(values)
        whole = np.zeros((len(which), self.size))
        np.put_along_axis(whole, which, weights, axis=1)
        return whole

    def sum(self, values: Sequence[Floats], coefficients: Floats) -> Floats:
        """The splines, each times its coefficient, summed at these values, shape (n,).

        Parameters
        ----------
        values : sequence of arrays, shape (n,), SI
            One a variable.
        coefficients : array, shape (size,)

        Returns
        -------
        array, shape (n,)
        """
        which, weights = self._acting(values)
        return np.asarray(np.einsum("ns,ns->n", weights, coefficients[which]))

    def _acting(self, values: Sequence[Floats]) -> tuple[np.ndarray, Floats]:
        """Which products of splines act at these values, and how much of each, shape (n, 4^n_variables)."""
        which, weights = np.zeros((len(values[0]), 1), dtype=int), np.ones((len(values[0]), 1))
        for part, count in zip(self.parts(values), self.counts, strict=True):
            first, more = acting_splines(part, _even_knots(count))
            here = first[:, None] + np.arange(ACTING)
            which = (which[:, :, None] * count + here[:, None, :]).reshape(len(part), -1)
            weights = (weights[:, :, None] * more[:, None, :]).reshape(len(part), -1)
        return which, weights

    @property
    def course(self) -> int:
        """Which variable says that growth has begun: growth, or else the time since release; −1 where none does."""
        return next((self.variables.index(name) for name in ("growth", "time") if name in self.variables), -1)

    @property
    def beginnings(self) -> tuple[str, ...]:
        """What a force over these variables may be where growth begins."""
        if self.course < 0:
            return (ANY,)
        return (NOTHING, CONSTANT) if len(self.variables) == 1 else (NOTHING, CONSTANT, ANY)

    def mix(self, lengths: Sequence[float], begins: str = ANY, kept: float = KEPT) -> Floats:
        """Coefficients of the splines by unit of each direction that stays, shape (size, n_directions).

        Parameters
        ----------
        lengths : sequence of float
            Of the process, as parts of what was visited.
        begins : str
            What the force is where growth begins.
        kept : float
            Variance of a direction, as part of the largest, below which it is left out.

        Returns
        -------
        array, shape (size, n_directions)
        """
        course = self.course
        roots = [
            covariance_root(count, length, from_nothing=k == course)
            for k, (count, length) in enumerate(zip(self.counts, lengths, strict=True))
        ]
        columns = [_product(roots, kept)]
        if course >= 0 and begins == CONSTANT:
            columns.append(np.ones((self.size, 1)))
        if course >= 0 and begins == ANY:
            same = [(np.ones((count, 1)), np.array([WIDER**2])) if k == course else root
                    for k, (count, root) in enumerate(zip(self.counts, roots, strict=True))]  # fmt: skip
            columns.append(_product(same, kept))
        return np.hstack(columns)


def _product(roots: Sequence[tuple[Floats, Floats]], kept: float) -> Floats:
    """Directions of a product of processes, each by its root, shape (n_splines, n_directions that stay)."""
    variances: Floats = np.ones(1)
    for _, strength in roots:
        variances = np.asarray(np.kron(variances, strength))
    stays = np.flatnonzero(variances > kept * variances.max())
    directions: Floats = np.ones((1, stays.size))
    parts = np.unravel_index(stays, [strength.size for _, strength in roots])
    for (more, _), part in zip(roots, parts, strict=True):
        directions = (directions[:, None, :] * more[None, :, part]).reshape(-1, stays.size)
    return np.asarray(directions * np.sqrt(variances[stays]))


@dataclass(frozen=True)
class Surface:
    """A force over a domain, as `vinetrack.diagnosis.force_refinement` follows it: amplitudes are normal of `sd_N`.

    `mix`, shape (n_splines, n_columns), are the coefficients of the splines by unit of each amplitude. An infinite
    `sd_N` leaves the amplitudes free.
    """

    domain: Domain
    mix: Floats
    sd_N: float = math.inf

    @property
    def precision(self) -> float:
        """Of each amplitude, 1/N²."""
        return self.sd_N**-2

    @property
    def shape_names(self) -> tuple[str, ...]:
        """None: what shapes it are its amplitudes."""
        return ()

    def size_of(self, name: str) -> float:  # pragma: no cover
        """No number shapes it; see `shape_names`.

        Parameters
        ----------
        name : str

        Returns
        -------
        float

        Raises
        ------
        KeyError
            Always.
        """
        raise KeyError(name)

    def shifted(self, name: str, by: float) -> Surface:  # pragma: no cover
        """No number shapes it; see `shape_names`.

        Parameters
        ----------
        name : str
        by : float

        Returns
        -------
        Surface

        Raises
        ------
        KeyError
            Always.
        """
        raise KeyError(name, by)

    def kept_inside(self, growth_m: float) -> Surface:  # noqa: ARG002
        """Itself: beyond what was visited it is constant.

        Parameters
        ----------
        growth_m : float

        Returns
        -------
        Surface
        """
        return self

    def force(self, motion: FittedMotion, amplitude: Floats) -> Floats:
        """The force of these amplitudes along a motion, N, shape (n_times,).

        Parameters
        ----------
        motion : a fitted motion.
        amplitude : array, shape (n_columns,), N

        Returns
        -------
        array, shape (n_times,), N
        """
        return self.domain.sum(self.domain.of_motion(motion), self.mix @ amplitude)

    def along(self, motion: FittedMotion) -> Floats:
        """The force of amplitude 1 along a motion, N, shape (n_times, n_columns).

        Parameters
        ----------
        motion : a fitted motion.

        Returns
        -------
        array, shape (n_times, n_columns), N
        """
        return np.asarray(self.domain.basis(self.domain.of_motion(motion)) @ self.mix)


def domains(motions: Sequence[FittedMotion]) -> list[Domain]:
    """Every variable alone, then every two together, over what these motions visit.

    Parameters
    ----------
    motions : sequence of FittedMotion

    Returns
    -------
    list of Domain
    """
    reach: dict[str, tuple[float, float, float]] = {}
    for name, attribute in VARIABLES.items():
        along = [np.asarray(getattr(motion, attribute))[motion.time_s <= motion.counts_until_s] for motion in motions]
        high = max(float(np.quantile(course, FASTEST) if name == "speed" else course.max()) for course in along)
        low = min(float(course.min()) for course in along) if name == "pressure" else 0.0
        if high - low > DIFFERENT * abs(high):
            if name == "pressure":
                low, high = (1 - MARGIN) * low, (1 + MARGIN) * high
            usual = float(np.median([np.median(course) for course in along])) if name in OVER_DECADES else math.inf
            reach[name] = low, high, usual

    def over(names: tuple[str, ...], counts: dict[str, int]) -> Domain:
        lows, highs, usual = zip(*(reach[name] for name in names), strict=True)
        return Domain(names, lows, highs, tuple(counts[name] for name in names), usual)

    return [over((name,), ALONE) for name in reach] + [
        over(pair, TOGETHER) for pair in itertools.combinations(reach, 2)
    ]
