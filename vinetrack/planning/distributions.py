"""Ways in which a number that is believed may vary: from draws in which it does not, draws in which it does."""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.planning.predictive_inputs import Draws, Move, Size

FARTHEST = 20.0
"""At which a deviate of Student's t is cut: a factor ten of a guessed B, beyond all vines."""


def deviates(draw: np.random.Generator, count: int, dof: float = math.inf) -> Floats:
    """Normal deviates, or Student's with so many degrees of freedom, shape (count,)."""
    if math.isinf(dof):
        return draw.standard_normal(count)
    return np.clip(draw.standard_t(dof, count), -FARTHEST, FARTHEST)


def scaled(name: str, log_sigma: float, dof: float = math.inf) -> Move:
    """Multiplied by a factor whose logarithm has this standard deviation, or scale of Student's t."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * np.exp(log_sigma * deviates(draw, draws[name].size, dof))}

    return move


def shifted(name: str, sigma: float) -> Move:
    """Moved by a normal deviate, SI."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] + sigma * draw.standard_normal(draws[name].size)}

    return move


def relative(name: str, sigma: float, dof: float = math.inf) -> Move:
    """Multiplied by one plus a deviate of this standard deviation, or scale of Student's t."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * (1 + sigma * deviates(draw, draws[name].size, dof))}

    return move


def even(name: str, size: Size) -> Move:
    """Drawn evenly from a range."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draw.uniform(size.low, size.high, draws[name].size)}

    return move
