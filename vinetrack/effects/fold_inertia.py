"""Fold inertia: the fold returns part of the kinetic energy of the film that it stops to the tail.

Matters for every fast vine: the film arrives at the fold at the tail's speed and leaves it at rest. Without this term
the fold dissipates all of that energy; η = 1 is equivalent to a drag coefficient of −133 on every vine of the paper's
Table I.

    tail force +η ¼λẋ², with ¼ = (r−1)/(2r)

Film passes the tip at (r−1)ẏ, so the tail loses c = λ(r−1)/r for each metre it travels. With a lossless fold
½m(x)ẋ² changes only by the work of the other forces: m ẍ = F + ½c ẋ². A real fold lies between η = 0 (all lost) and
η = 1 (all returned). d(mẋ)/dt = F would add twice as much and create energy.

Easily taken for a smaller n, and it cancels `air_drag`: the two are one curve on vines of one t/D.

It cannot be reduced except by thinner film or slower growth; a payload heavier than the film makes it negligible.

Source: the balance of energy at a moving fold, as for the falling folded chain: Wong & Yasui (2006), American Journal
of Physics 74, 490–496.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("thickness_um",)
PARAMETERS = (
    Parameter("eta", "η", "1", 0.5, bounds=(0.0, 1.0), plausible=(0.0, 1.0), meaning="fraction of the energy returned"),
)


def tail_force(s, rig, eta):
    mass_loss = s.linear_density * (rig.travel_ratio - 1.0) / rig.travel_ratio
    return eta * 0.5 * mass_loss * s.tail_velocity * s.tail_velocity


WORKED = (
    Worked(
        "tail_force",
        0.22620,
        "½ × ¼ × 1200 × π × 24 mm × 200 µm × 10² = 0.125 × 0.0180956 × 100",
        state={"linear_density": 0.0180956, "tail_velocity": 10.0},
        rig={"travel_ratio": 2.0},
    ),
)
