"""Wall stretch: pressure widens the tube beyond the cross-section that was measured.

Matters at high pressure, for soft and thin film: at 60 kPa, D/t = 120 and E = 20 MPa the area grows by a third.

    A → A (1 + κP)², in drive, yield, drag and swept volume, not in λ

κ ≈ (1 − ν/4) D/(2Et), from the hoop stress PD/2t of a tube whose stress along its axis is the pulley's share of it.
For E between 10 and 50 MPa and the paper's vines κ is 1 to 5 millionths per pascal.

Easily taken for a pressure gauge that reads too low (`pressure_gain`), or at one pressure for `area_scale`. A wide
range of pressure tells them apart: only this one grows with it.

Reduce it with thicker or fibre-bound film; measure it with a picture of the inflated vine.

Source: thin-walled pressure vessels, Timoshenko & Goodier (1970), Theory of Elasticity.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("thickness_um",)
PARAMETERS = (
    Parameter(
        "kappa",
        "κ",
        "1/Pa",
        2e-6,
        bounds=(0.0, 1e-4),
        plausible=(3e-7, 1e-5),
        meaning="relative widening of D with pressure",
    ),
)


def area(s, rig, kappa):
    widening = 1.0 + kappa * s.pressure
    return s.area * widening * widening


WORKED = (
    Worked(
        "area",
        5.0448e-4,
        "4.5239e-4 × (1 + 2e-6 × 28000)² = 4.5239e-4 × 1.115136",
        state={"area": 4.5239e-4, "pressure": 28e3},
    ),
)
