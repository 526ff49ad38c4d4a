"""Tail stretch: tension lengthens tail and wall, so that the leading edge is ahead of half the tail travel.

Matters for soft, thin film under a strong drive: 2 to 4 mm on 0.3 m at 28 to 60 kPa. The part of the tail is present
at release and decreases as the speed grows and the tension falls; the part of the wall grows with the everted length.

    y → x/2 + ½L(ε − ε₀) + ½y(ε_w − ε), by ½ = 1/r
    ε = T₁/(EπDt) of the tail, ε_w = (PA − T₁)/(EπDt) of the wall, ε₀ that of the tail before release

T₁ is the tension of the tail that balances the forces at the tip; the wall carries the pressure force on the tip minus
that tension. ε₀ is not below, since every reported position is taken from that at rest. The parameter is the compliance
1/E: the stretch is proportional to it and vanishes at 0, where a score test can start, and its error is symmetric; in E
no stretch would lie at infinity, where the gradient vanishes. 10 to 50 MPa are 100 to 20 billionths per pascal.

Easily taken for an error of `length_scale`, or of the release time: the part of the wall is nearly proportional to y.

Reduce it with stiffer or thicker film, or mark the tail and film the mark. Measure E by hanging a weight from a strip
of the film.

Source: Hooke's law.
"""

import math

from vinetrack.effects import Parameter, Worked

NEEDS = ("thickness_um", "length_mm")
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


def observed_position(s, rig, compliance):
    per_newton = compliance / (math.pi * rig.diameter * rig.thickness)
    tail = s.tail_tension * per_newton
    wall = (s.pressure * s.area - s.tail_tension) * per_newton
    return s.observed + (tail * rig.length + (wall - tail) * s.lead_position) / rig.travel_ratio


WORKED = (
    Worked(
        "observed_position",
        0.10228,
        "ε = 5.655 × 4e-8/(π × 24 mm × 200 µm) = 2.262e-7/1.50796e-5 = 0.015; PA = 12.667 N, "
        "ε_w = 7.012 × 4e-8/1.50796e-5 = 0.0186; 0.1 + ½ × 0.015 × 0.28 + ½ × 0.1 × 0.0036 = 0.1 + 0.0021 + 0.00018",
        rel=1e-5,
        state={"observed": 0.1, "lead_position": 0.1, "tail_tension": 5.655, "pressure": 28e3, "area": 4.5239e-4},
        rig={"diameter": 24e-3, "thickness": 200e-6, "length": 0.28, "travel_ratio": 2.0},
    ),
)
