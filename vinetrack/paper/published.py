"""Published numbers: those of Table I and the damping law, and what else the paper prints; those with one use stand
where they are used.
"""

from __future__ import annotations

from vinetrack.planning.predictive_inputs import (  # noqa: F401
    DAMPING_B,
    DAMPING_R2,
    DIAMETER_MM,
    SOURCE,
    THICKNESS_UM,
    YIELD_PRESSURE_KPA,
)
from vinetrack.planning.predictive_inputs import PRINTED_EXPONENT as EXPONENT  # noqa: F401

CAPTURE_FPS = 1069.0  # Frames a second of the recordings (published)
CHAMBER_L = 3.7  # Volume of the chamber, litres (published)
LONGEST_VINE_MM = 280.0  # Length of the largest vine, 24 mm in diameter (published)
CHAMBER_CHANGE, CHAMBER_ALLOWED = 0.035, 0.05  # Relative change of its volume by the largest vine (published)
PAYLOAD_G = 35.6  # Payload of Figs. 4 and 9 (published)
# RMS position error of the model by pressure in kPa, for the 24 mm × 200 µm vine with payload (Fig. 4, Table II)
POSITION_RMS_CM = {7: 1.90, 14: 0.29, 28: 0.31}
# RMS error of the final speed by pressure in kPa, for 24 mm × 150 µm vines with several payloads (Fig. 5, Table II)
FINAL_SPEED_RMS_M_S = {14: 0.27, 28: 0.56, 41: 1.35}
FINAL_SPEED_AT_MM = 120.0  # Travel at which the final speed of Fig. 5 is evaluated (published)
FINAL_SPEED_THICKNESS_UM = 150.0  # Wall of the vines of Fig. 5 (published)
STEADY_SPEED_KPA, STEADY_SPEED_R2 = 24.0, 0.935  # Steady speed against scale (published)
EFFICIENCY_KPA = 34.0  # Pressure of the energy efficiency with payload, Fig. 9 (published)
# The fastest vine, without payload, at a pressure just below its burst pressure
FAST_VINE = {"thickness_um": 100.0, "diameter_mm": 25.0, "length_mm": 400.0, "pressure_kPa": 62.0}


def scale_of(diameter_mm: float, thickness_um: float) -> int | None:
    """Return the scale R of the vine of Table I with this size, to within 1 %; None for any other."""
    off = {R: (abs(diameter_mm / DIAMETER_MM[R] - 1), abs(thickness_um / THICKNESS_UM[R] - 1)) for R in DIAMETER_MM}
    return next((scale for scale, parts in off.items() if all(part < 0.01 for part in parts)), None)
