"""Inlet loss: the gas loses pressure where it squeezes from the chamber through the connector into the vine.

Matters at high speed behind a narrow connector: at 3 m/s of the leading edge and an inlet of half the vine's diameter
(A/A_in = 4) it is 0.1 kPa for each unit of K; at 20 m/s 5 kPa.

    P → P − K ½ρ_gas ẏ² (A/A_in)², ρ_gas = (P + P_atm)/(287 T)

K is 0.5 for the sharp edge into the connector and 1 for the jet that spreads into the vine, more with bends and valves.

Easily taken for `air_drag`: both grow with ẏ², and on one tube at one pressure they are the same curve. Another
connector, or a vine of another diameter on the same one, tells them apart; another pressure only through ρ_gas.

Reduce it with a wider, rounded connector. Measure it with a second gauge behind the connector: what that reads less
during growth is the loss.

Source: loss coefficients K as in Idelchik (1986), Handbook of Hydraulic Resistance, chapters 3 and 4.
"""

from vinetrack.core.units import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.effects import Parameter, Worked

NEEDS = ("inlet_mm",)
PARAMETERS = (Parameter("K", "K", "1", 1.5, bounds=(0.0, 50.0), plausible=(0.0, 3.0), meaning="loss coefficient"),)


def pressure(s, rig, K):
    gas_density = (s.pressure + rig.ambient_pressure) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    inlet_speed = s.lead_velocity * s.area / rig.inlet_area
    return s.pressure - K * 0.5 * gas_density * inlet_speed * inlet_speed


WORKED = (
    Worked(
        "pressure",
        27833.9,
        "ρ = 129325/(287 × 293) = 1.53792; 28000 − 1.5 × ½ × 1.53792 × (3 × 4)² = 28000 − 166.1",
        state={"pressure": 28e3, "lead_velocity": 3.0, "area": 4e-4},
        rig={"inlet_area": 1e-4, "ambient_pressure": 101_325.0},
        rel=1e-5,
    ),
)
