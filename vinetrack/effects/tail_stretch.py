"""Tail stretch: the tail's own tension lengthens it, so that the leading edge is ahead of where the tail says.

Matters for soft, thin film under a strong drive: 2 to 4 mm on 0.3 m at 28 to 60 kPa. It is there at once on release and
fades as the speed grows and the tension falls.

    y → x/2 + ½εL, ε = T₁/(EπDt), by ½ = 1/r

T₁ is what the forces at the tip leave for the tail. The parameter is the compliance 1/E: the stretch is in proportion
to it and nothing at 0, so that a screen can start from nothing, and its error is even-sided; in E nothing would lie at
infinity, where no slope is left. 10 to 50 MPa are 100 to 20 billionths a pascal.

Easily taken for an error of `length_scale`, or of the release time. The stretch at rest hides in the origin of the
position; its fading is what is seen.

Reduce it with stiffer or thicker film, or mark the tail and film the mark. Measure E by hanging a weight from a strip
of the film.

Source: Hooke's law.
"""

import math

from vinetrack.effects import Parameter, Worked

KIND = "physical"
NEEDS = ("thickness_um", "length_mm")
EASILY_TAKEN_FOR = ("length_scale",)
PARAMETERS = (
    Parameter(
        "compliance",
        "1/E",
        "1/Pa",
        4e-8,
        bounds=(0.0, 1e-5),
        plausible=(2e-8, 1e-7),
        meaning="1/E of the film, E 10 to 50 MPa",
    ),
)


def observed_position(s, rig, compliance):  # noqa: D103
    strain = s.tail_tension * compliance / (math.pi * rig.diameter * rig.thickness)
    return s.observed + strain * rig.length / rig.travel_ratio


WORKED = (
    Worked(
        "observed_position",
        0.1021,
        "ε = 5.655 × 4e-8/(π × 24 mm × 200 µm) = 2.262e-7/1.50796e-5 = 0.015; 0.1 + ½ × 0.015 × 0.28 = 0.1021",
        rel=1e-5,
        state={"observed": 0.1, "tail_tension": 5.655},
        rig={"diameter": 24e-3, "thickness": 200e-6, "length": 0.28, "travel_ratio": 2.0},
        parameters={"compliance": 4e-8},
    ),
    Worked(
        "observed_position",
        0.1,
        "of no size: E without bound",
        state={"observed": 0.1, "tail_tension": 5.655},
        rig={"diameter": 24e-3, "thickness": 200e-6, "length": 0.28, "travel_ratio": 2.0},
        parameters={"compliance": 0.0},
    ),
)
