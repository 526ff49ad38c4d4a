"""Film mass: the film of a vine weighs more or less than its thickness and density give.

Matters for all that accelerates: film is sold to within 10 % of its thickness, and its density is 1200 kg/m³ unless the
settings say otherwise, where polyethylene has 920. Without payload the mass of film determines how
a vine starts, and how it slows as the film runs out.

    λ → (1 + ε) λ for each vine, true from computed with thickness, diameter and density

Easily taken for `time_base` and `area_scale`, which change the mass beside the forces; for `pressure_gain`, which
changes the forces beside the mass; where several vines differ, for `n_by_vine` and `wall_stretch`. An error
of ε/2 in the frame rate or of −ε in the scale of one vine's recordings is equivalent for horizontal growth without a
payload, and nearly so elsewhere.

Reduce it by weighing a piece of each vine: its mass over its length is λ. Where it differs between vines, check the
frame rate, the scale and the gauge of each vine's recordings too.

Source: Eq. (2) of Alvarez et al. (2025); ASTM D6988 on the thickness of film.
"""

from vinetrack.effects import Parameter, Worked

KIND = "measurement"
NEEDS = ("thickness_um",)
PARAMETERS = (
    Parameter(
        "eps",
        "ε",
        "1",
        0.05,
        bounds=(-0.6, 1.5),
        shared="vine",
        plausible=(-0.2, 0.2),
        meaning="relative error of the film's mass per metre",
        slips=(
            (-0.2333, "the film is polyethylene, of 920 kg/m³, and 1200 kg/m³ was taken"),
            (-0.5, "the film was measured folded, two layers for one"),
            (1.0, "half the thickness was stated"),
        ),
    ),
)


def film_gain(s, rig, eps):
    return 1.0 + eps


WORKED = (Worked("film_gain", 1.05, "1 + 0.05"),)
