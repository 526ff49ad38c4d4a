"""Ways in which a number that is believed may vary: from draws in which it does not, draws in which it does."""

from __future__ import annotations

import numpy as np

from vinetrack.design import guess
from vinetrack.design.beliefs import Draws, Move, Size

FARTHEST_SCATTER = 20.0
"""Standard deviations at which a draw of Student's t is cut: a factor ten of B, beyond all vines."""


def scaled(name: str, log_sigma: float) -> Move:
    """Multiplied by a log-normal factor with this standard deviation of its logarithm."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * np.exp(log_sigma * draw.standard_normal(draws[name].size))}

    return move


def heavy(name: str, log_sigma: float) -> Move:
    """Multiplied by a factor whose logarithm follows Student's t on this scale."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        t = np.clip(draw.standard_t(guess.SCATTER_DOF, draws[name].size), -FARTHEST_SCATTER, FARTHEST_SCATTER)
        return {**draws, name: draws[name] * np.exp(log_sigma * t)}

    return move


def shifted(name: str, sigma: float) -> Move:
    """Moved by a normal deviate, SI."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] + sigma * draw.standard_normal(draws[name].size)}

    return move


def relative(name: str, sigma: float) -> Move:
    """Multiplied by one plus a normal deviate."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * (1 + sigma * draw.standard_normal(draws[name].size))}

    return move


def even(name: str, size: Size) -> Move:
    """Drawn evenly from a range."""

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draw.uniform(size.low, size.high, draws[name].size)}

    return move
