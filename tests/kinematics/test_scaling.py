"""B against size: the published coefficients and what they are known to give."""

from __future__ import annotations

import pytest

from vinetrack.core.published import DAMPING_B, DIAMETER_MM, THICKNESS_UM
from vinetrack.kinematics.damping import fit_scaling


def law(B: float, diameter_mm: float, thickness_um: float) -> dict:
    return {"B": B, "B_95": [0.9 * B, 1.1 * B], "diameter_mm": diameter_mm, "thickness_um": thickness_um}


def damping(vines: dict[str, dict]) -> dict:
    return {"both_axes": {"vines": vines}}


def test_the_published_coefficients() -> None:
    """On log axes slope 1.80; the straight line has R² 0.983 and an intercept of −1.7."""
    vines = {f"R{r}": law(B, DIAMETER_MM[r], THICKNESS_UM[r]) for r, B in DAMPING_B.items()}
    found = fit_scaling(damping(vines))
    (family,) = found["isometric"]
    assert family["sizes"] == [6.0, 12.0, 18.0, 24.0]
    assert family["power"]["slope"] == pytest.approx(1.80, abs=0.005)
    assert family["line"]["R2"] == pytest.approx(0.983, abs=5e-4)
    assert family["line"]["intercept"] == pytest.approx(-1.7, abs=0.05)
    assert found["thickness"] == []


def test_walls_of_one_diameter_make_a_line() -> None:
    vines = {f"t{t:g}": law(0.02 * t, 12.0, t) for t in (50.0, 100.0, 200.0)}
    (family,) = fit_scaling(damping(vines))["thickness"]
    assert (family["along"], family["sizes"]) == ("thickness_um", [50.0, 100.0, 200.0])
    assert family["power"]["slope"] == pytest.approx(1.0)
    assert family["line"]["slope"] == pytest.approx(0.02)
    assert family["line"]["intercept"] == pytest.approx(0.0, abs=1e-9)


def test_two_vines_are_shown_but_carry_no_line() -> None:
    (family,) = fit_scaling(damping({"a": law(1.0, 6.0, 50.0), "b": law(3.0, 12.0, 100.0)}))["isometric"]
    assert family["power"] is None
    assert "2 vines" in family["refused"]


def test_vines_that_share_nothing_are_no_family() -> None:
    found = fit_scaling(damping({"a": law(1.0, 6.0, 50.0), "b": law(3.0, 12.0, 50.0)}))
    assert found["isometric"] == found["thickness"] == []
    assert "of 2 vines" in found["reason"]


def test_one_vine_or_none_is_said_so() -> None:
    assert fit_scaling(damping({}))["reason"] == "no vine has a damping coefficient"
    assert "only one vine" in fit_scaling(damping({"a": law(1.0, 6.0, 50.0)}))["reason"]
