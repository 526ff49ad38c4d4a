"""Air drag: the outer air resists the blunt head.

Matters above some ten metres a second: with C_D = 1 it is 3.5 % of the drive at 60 m/s and 62 kPa, less than a
thousandth at 5 m/s and 20 kPa. The paper leaves it out below about 5 % of the drive.

    tip force −½ρ_air A C_D ẏ², on the tail −¼ρ_air A C_D ẏ², by ¼ = 1/(2r)

The air meets the head at the speed of the *leading edge*, ẏ, and the pulley halves it. C_D is 0.2–0.4 for a round head
and 0.8–1.2 for a blunt one.

Easily taken for `inlet_loss`, and the opposite of `fold_inertia`: on vines of one t/D the two are one curve at every
pressure and payload. A vine of another t/D tells those apart, another connector the inlet.

Reduce it with slower growth or a narrower vine.

Source: drag of blunt bodies, Hoerner (1965), Fluid-Dynamic Drag, chapter 3. The paper's term ½ρAC_D ẋ² has the tail's
speed and no pulley.
"""

from vinetrack.core.units import AIR_DENSITY_KG_M3
from vinetrack.effects import Parameter, Worked

PARAMETERS = (Parameter("C_D", "C_D", "1", 1.0, bounds=(0.0, 200.0), plausible=(0.0, 3.0), meaning="drag coefficient"),)


def tip_force(s, rig, C_D):
    return -0.5 * AIR_DENSITY_KG_M3 * s.area * C_D * s.lead_velocity * s.lead_velocity


WORKED = (
    Worked(
        "tip_force",
        -1.0603,
        "½ × 1.2 × π(25 mm)²/4 × 1 × 60² = 0.6 × 4.9087e-4 × 3600",
        state={"lead_velocity": 60.0, "area": 4.9087e-4},
    ),
)
