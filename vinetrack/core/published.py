"""Published numbers: Alvarez et al., IEEE Robotics and Automation Letters, 2025.

Only printed numbers are listed here; the priors for other vines derived from them are in
`vinetrack.planning.scaling_priors`.
"""

from __future__ import annotations

SOURCE = "Alvarez et al. (2025)"

DAMPING_B = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}
"""Damping coefficient by scale R, N·(s/m)ⁿ."""

DAMPING_R2 = {1: 0.964, 2: 0.981, 3: 0.896, 4: 0.971}
"""R² of the power law at the steady points of each scale."""

EXPONENT = 0.37
"""Damping exponent n, one for all scales. Published: Fig. 6."""

THICKNESS_UM = {1: 50.0, 2: 100.0, 3: 150.0, 4: 200.0}
DIAMETER_MM = {1: 6.0, 2: 12.0, 3: 18.0, 4: 24.0}
"""The four isometric vines of Table I."""

PRESS_TEMPERATURE_DEGC = {1: 110.0, 2: 82.0, 3: 96.0, 4: 96.0}
LASER_POWER_PERCENT = {1: 60.0, 2: 76.0, 3: 81.0, 4: 86.0}
"""Fabrication settings of the four vines."""

CONDITIONS = (8, 11)
"""Pressures per scale in the damping fit, fewest and most. Published: section on the test procedure."""

TRIALS = (4, 5)
"""Trials per pressure, fewest and most. Published: section on the test procedure."""

REPLICATES = 4
"""N of Figs. 4, 5, 8 and 9. Published in their captions."""

STEADY_FEWEST_POINTS, STEADY_CV = 3, 0.03
"""Definition of a steady window: fewest consecutive points, and largest coefficient of variation of their velocities.
Published: section on data collection."""

YIELD_PRESSURE_KPA, YIELD_PRESSURE_SCALE = 3.0, 4
"""Yield pressure of the 24 mm × 200 µm vine, R = 4; no other is printed. Published: section on model validation."""

CAPTURE_FPS = 1069.0
"""Frames a second of the recordings. Published: section on the experimental setup."""

CHAMBER_L = 3.7
"""Volume of the chamber, litres. Published: Fig. 3."""

LONGEST_VINE_MM = 280.0
"""Length of the largest vine, 24 mm in diameter. Published: section on the experimental setup."""

CHAMBER_CHANGE, CHAMBER_ALLOWED = 0.035, 0.05
"""Relative change of the chamber's volume caused by the largest vine, and allowed relative change of pressure.
Published: section on the experimental setup."""

PAYLOAD_G = 35.6
"""Payload of Figs. 4 and 9. Published in their captions."""

POSITION_RMS_CM = {7: 1.90, 14: 0.29, 28: 0.31}
"""RMS position error of the model by pressure in kPa, for the 24 mm × 200 µm vine with payload (Fig. 4, Table II)."""

FINAL_SPEED_RMS_M_S = {14: 0.27, 28: 0.56, 41: 1.35}
"""RMS error of the final speed by pressure in kPa, for 24 mm × 150 µm vines with several payloads (Fig. 5, Table
II)."""

FINAL_SPEED_AT_MM = 120.0
"""Travel at which the final speed of Fig. 5 is evaluated. Published in its text."""

FINAL_SPEED_THICKNESS_UM = 150.0
"""Wall of the vines of Fig. 5. Published in its caption."""

STEADY_SPEED_KPA, STEADY_SPEED_R2, STEADY_SPEED_P_VALUE = 24.0, 0.935, 0.32
"""Steady speed against scale (Fig. 8): pressure, R² and p-value of the linear fit. Published in its caption."""

THICKNESS_SERIES_DIAMETER_MM = 12.0
"""Diameter of the vines whose B is plotted against thickness (Fig. 7B). Published in its caption."""

EFFICIENCY_KPA, EFFICIENCY_AT_MM, EFFICIENCY_DIAMETERS_MM = 34.0, 150.0, (12.0, 18.0)
"""Energy efficiency with payload (Fig. 9): pressure, growth and diameters. Published in its caption."""

FAST_VINE = {"thickness_um": 100.0, "diameter_mm": 25.0, "length_mm": 400.0, "pressure_kPa": 62.0}
"""The fastest vine, without payload, at a pressure just below its burst pressure."""

FAST_VINE_MEASURED_M_S, FAST_VINE_PREDICTED_M_S = 60.0, 56.0
"""Speed of its leading edge, measured and predicted by the authors."""

INJECTOR = {"thickness_um": 50.0, "diameter_mm": 2.5, "length_mm": 12.5, "pressure_kPa": 48.0}
"""One vine of the dye injector."""

INJECTOR_CHAMBER_MM = (20.0, 15.0)
"""Length and diameter of its chamber. Published: section on the dye injector."""

INJECTOR_CHANGE = 0.017
"""Printed relative change of its pressure. Published: section on the dye injector."""

DRAG_EXAMPLE = {"thickness_um": 50.0, "diameter_mm": 24.0, "length_mm": 150.0, "pressure_kPa": 56.0}
DRAG_COEFFICIENT, DRAG_SHARE = 0.82, 0.05
"""A vine whose drag is stated to stay below this fraction of the driving force up to its pressure. Published: below
Eq. (2)."""


def scale_of(diameter_mm: float, thickness_um: float) -> int | None:
    """Return the scale R of the vine of Table I with this size, to within 1 %; None for any other.

    Parameters
    ----------
    diameter_mm, thickness_um : size of the vine.

    Returns
    -------
    R, or None.

    >>> scale_of(12.0, 100.0), scale_of(12.0, 50.0)
    (2, None)
    """
    for scale, printed_mm in DIAMETER_MM.items():
        near = abs(diameter_mm / printed_mm - 1) < 0.01
        if near and abs(thickness_um / THICKNESS_UM[scale] - 1) < 0.01:
            return scale
    return None
