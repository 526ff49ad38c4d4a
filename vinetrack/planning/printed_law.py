"""Published numbers: Alvarez et al., IEEE Robotics and Automation Letters, 2025.

Table I and the damping law, the basis of the priors for other vines; all others stand in `vinetrack.paper.published`.
"""

from __future__ import annotations

SOURCE = "Alvarez et al. (2025)"
DAMPING_B = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}  # Damping coefficient by scale R, N·(s/m)ⁿ
DAMPING_R2 = {1: 0.964, 2: 0.981, 3: 0.896, 4: 0.971}  # R² of the power law at the steady points of each scale
EXPONENT = 0.37  # Damping exponent n, one for all scales (published)
THICKNESS_UM = {1: 50.0, 2: 100.0, 3: 150.0, 4: 200.0}
DIAMETER_MM = {1: 6.0, 2: 12.0, 3: 18.0, 4: 24.0}  # The four isometric vines of Table I
YIELD_PRESSURE_KPA = 3.0  # Yield pressure of the 24 mm × 200 µm vine, R = 4 (published)
