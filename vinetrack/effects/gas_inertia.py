"""Gas inertia: the gas that fills the vine has to be accelerated, and new gas with it.

Matters early, when everything accelerates, and in wide vines of thin film: the gas of a grown vine weighs 4 to
10 % of its film. The force ½ẏ² of new gas remains at constant speed.

    tip force −f ρ_gas A (½ẏ² + y ÿ), on the tail −½f ρ_gas A (½ẏ² + y ÿ), by ½ = 1/r
    y ÿ becomes added mass of the tail: f ¼ρ_gas A y, by ¼ = 1/r²

ρ_gas = (P + P_atm)/(287 T). f = 1 is a plug of gas as wide as the vine, moving with the leading edge; the core occupied
by the tail and the flow profile change it by some tenths. The lower limit of the moving mass without payload already
includes this gas: it is not counted twice.

Easily taken for `air_drag` or `inlet_loss`, by its ½ẏ². The start of growth, where they are nothing, tells them apart.

Reduce it with a narrower vine, or slower growth.

Source: the balance of momentum of a lengthening column of gas, the unsteady Bernoulli equation of textbooks such as
White, Fluid Mechanics.
"""

from vinetrack.core.units import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter(
        "factor",
        "f",
        "1",
        1.0,
        bounds=(0.0, 10.0),
        plausible=(0.8, 1.2),
        meaning="fraction of the gas that moves along",
    ),
)


def tip_force(s, rig, factor):
    gas_density = (s.pressure + rig.ambient_pressure) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    return -factor * 0.5 * gas_density * s.area * s.lead_velocity * s.lead_velocity


def added_mass(s, rig, factor):
    gas_density = (s.pressure + rig.ambient_pressure) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    return factor * gas_density * s.area * s.lead_position / (rig.travel_ratio * rig.travel_ratio)


WORKED = (
    Worked(
        "tip_force",
        -2.7683e-3,
        "ρ = 129325/(287 × 293) = 1.53792; ½ × 1.53792 × 4e-4 × 9",
        state={"pressure": 28e3, "lead_velocity": 3.0, "lead_position": 0.2, "area": 4e-4},
        rig={"ambient_pressure": 101_325.0, "travel_ratio": 2.0},
    ),
    Worked(
        "added_mass",
        3.0758e-5,
        "¼ × 1.53792 × 4e-4 × 0.2",
        state={"pressure": 28e3, "lead_velocity": 3.0, "lead_position": 0.2, "area": 4e-4},
        rig={"ambient_pressure": 101_325.0, "travel_ratio": 2.0},
    ),
)
