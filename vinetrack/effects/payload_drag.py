"""Payload drag: the gas inside the vine resists the payload that overtakes it.

Matters at high speed with a payload that fills much of the core: the gas moves with the leading edge, the payload
twice as fast, and has to push past it.

    tail force −½ρ_gas (C A_pay) ẏ², as the payload, at ẋ = 2ẏ, moves at ẏ through the gas; at (r−1)ẏ in general

ρ_gas = (P + P_atm)/(287 T). C·A_pay is drag coefficient times frontal area; in a narrow core C rises far above that of
free air, since the gas has to squeeze past. Without a payload there is no such force.

Easily taken for `air_drag`. Trials with and without payload tell them apart.

Reduce it with a slender payload, or one with holes.

Source: drag of blunt bodies and of bodies in tubes, Hoerner (1965), Fluid-Dynamic Drag; Idelchik (1986), Handbook of
Hydraulic Resistance.
"""

from vinetrack.core.units import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.effects import Parameter, Worked

NEEDS = ("payload_g", "length_mm")
PARAMETERS = (
    Parameter(
        "drag_area",
        "C·A_pay",
        "m²",
        5e-4,
        bounds=(0.0, 1.0),
        plausible=(1e-5, 2e-3),
        meaning="drag coefficient × frontal area of the payload",
    ),
)


def tail_force(s, rig, drag_area):
    if rig.payload_mass <= 0.0:
        return 0.0 * s.pressure
    gas_density = (s.pressure + rig.ambient_pressure) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    through_gas = s.tail_velocity - s.lead_velocity
    return -0.5 * gas_density * drag_area * through_gas * through_gas


WORKED = (
    Worked(
        "tail_force",
        -3.4603e-3,
        "ρ = 129325/(287 × 293) = 1.53792; ½ × 1.53792 × 5e-4 × 3²",
        state={"pressure": 28e3, "lead_velocity": 3.0, "tail_velocity": 6.0},
        rig={"payload_mass": 35.6e-3, "ambient_pressure": 101_325.0},
    ),
)
