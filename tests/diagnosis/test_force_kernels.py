"""The compiled variational equations against the same method in arrays, and against a closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import SDIRK_GAMMA, _responses, integrate_responses

TRIALS, STEPS, COLUMNS = 3, 400, 4


def courses(seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Times, stiffness, friction and added accelerations of any size, for trials that differ."""
    draw = np.random.default_rng(seed)
    shape = (TRIALS, STEPS + 1)
    time_s = 0.3 * np.sort(draw.uniform(size=shape))
    return time_s, -4e3 * draw.uniform(size=shape), -900 * draw.uniform(size=shape), draw.normal(size=(*shape, COLUMNS))


def stepped(x: Floats, v: Floats, h: Floats, k: Floats, c: Floats, push: Floats) -> tuple[Floats, Floats, Floats]:
    """The implicit step: (x, v) = before + h·rates with the rates at its end, and the acceleration there."""
    rate = (k * (x + h * v) + c * v + push) / (1 - h * c - h * h * k)
    return x + h * (v + h * rate), v + h * rate, rate


def test_compiled_integration_equals_that_in_arrays() -> None:
    time_s, k, c, push = courses(3)
    x, v = np.zeros((2, TRIALS, COLUMNS))
    moved, sped = integrate_responses(time_s, k, c, push, SDIRK_GAMMA)
    for i in range(STEPS):
        h = (time_s[:, i + 1] - time_s[:, i])[:, None]
        inside = [
            (1 - SDIRK_GAMMA) * each[:, i] + SDIRK_GAMMA * each[:, i + 1]
            for each in (k[:, :, None], c[:, :, None], push)
        ]
        _, speed, rate = stepped(x, v, SDIRK_GAMMA * h, *inside)
        x, v = x + (1 - SDIRK_GAMMA) * h * speed, v + (1 - SDIRK_GAMMA) * h * rate
        x, v, _ = stepped(x, v, SDIRK_GAMMA * h, k[:, i + 1, None], c[:, i + 1, None], push[:, i + 1])
        np.testing.assert_allclose(moved[:, i + 1], x, rtol=1e-12)
        np.testing.assert_allclose(sped[:, i + 1], v, rtol=1e-12)


def test_a_spring_under_a_constant_force_oscillates_about_its_new_equilibrium() -> None:
    """ẍ = 1 − ω²x from rest: x = (1 − cos ωt)/ω²."""
    omega, time_s = 20.0, np.linspace(0, 0.3, STEPS + 1)[None]
    moved, sped = integrate_responses(
        time_s, np.full_like(time_s, -(omega**2)), 0 * time_s, np.ones((*time_s.shape, 1)), SDIRK_GAMMA
    )
    assert moved[0, :, 0] == pytest.approx((1 - np.cos(omega * time_s[0])) / omega**2, abs=1e-4 / omega**2)
    assert sped[0, :, 0] == pytest.approx(np.sin(omega * time_s[0]) / omega, abs=1e-4 / omega)


def test_overflow_raises_where_numpy_is_set_to_raise() -> None:
    time_s, k, c, push = courses(4)
    motions = [SimpleNamespace(time_s=t, stiffness=s, friction=f) for t, s, f in zip(time_s, -1e5 * k, c, strict=True)]
    with np.errstate(all="ignore"):
        assert not np.isfinite(_responses(motions, 1e300 * push)[0]).all()  # type: ignore[arg-type]
    with np.errstate(all="raise", under="ignore"), pytest.raises(FloatingPointError):
        _responses(motions, 1e300 * push)  # type: ignore[arg-type]
