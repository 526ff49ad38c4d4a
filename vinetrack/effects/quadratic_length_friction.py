"""Quadratic length friction: a friction on the tail that grows with the square of the growth.

Matters on long vines: where the tail is pressed against the body by a force that itself grows along it, as in a tube
that sags or curves a little everywhere, the friction on every metre grows with the metres before it.

    tail force −q y²

Easily taken for `tail_friction` or `capstan_friction`: all grow with y. Long vines tell them apart: twice the growth
makes four times the force, where tail friction makes two.

Reduce it with a straight, supported path and powder between tail and wall. Measure it with a spring balance: pull the
tail through a vine that is grown to a quarter, a half and the whole of its length.

Source: the capstan equation to second order for a path of even curvature, beside friction by weight.
"""

from vinetrack.effects import Parameter, Worked

NEEDS = ("length_mm",)
PARAMETERS = (
    Parameter(
        "q", "q", "N/m²", 1.0, bounds=(0.0, 1e4), plausible=(0.0, 50.0), meaning="friction per square of the growth"
    ),
)


def tail_force(s, rig, q):
    return -q * s.lead_position * s.lead_position


WORKED = (Worked("tail_force", -0.08, "2 N/m² × (0.2 m)²", state={"lead_position": 0.2}, parameters={"q": 2.0}),)
