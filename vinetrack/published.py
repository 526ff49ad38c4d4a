"""Numbers of the paper that started this: Alvarez et al., IEEE Robotics and Automation Letters, 2025.

Only what is printed there stands here; what we conclude from it for vines that nobody has built is in
`vinetrack.design.guess`.
"""

from __future__ import annotations

SOURCE = "Alvarez et al. (2025)"

DAMPING_B = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}
"""Damping coefficient by scale R, N·(s/m)ⁿ."""

DAMPING_R2 = {1: 0.964, 2: 0.981, 3: 0.896, 4: 0.971}
"""How well the power law describes the steady points of each scale."""

EXPONENT = 0.37
"""Damping exponent n, one for all scales."""

THICKNESS_UM = {1: 50.0, 2: 100.0, 3: 150.0, 4: 200.0}
DIAMETER_MM = {1: 6.0, 2: 12.0, 3: 18.0, 4: 24.0}
"""The four isometric vines of Table I."""

CONDITIONS = (8, 11)
"""Pressures per scale in the damping fit, fewest and most."""

YIELD_PRESSURE_KPA = 3.0
"""Of the 24 mm × 200 µm vine; no other is printed."""

CAPTURE_FPS = 1069.0
CHAMBER_L = 3.7

FAST_VINE = {"thickness_um": 100.0, "diameter_mm": 25.0, "length_mm": 400.0, "pressure_kPa": 62.0}
"""The fastest vine, at a pressure just under that at which it bursts, without payload."""

FAST_VINE_MEASURED_M_S, FAST_VINE_PREDICTED_M_S = 60.0, 56.0
"""Speed of its leading edge, measured and as the authors predicted it."""

INJECTOR = {"thickness_um": 50.0, "diameter_mm": 2.5, "length_mm": 12.5, "pressure_kPa": 48.0}
"""One vine of the dye injector."""

INJECTOR_CHAMBER_MM = (20.0, 15.0)
"""Length and diameter of its chamber."""
