"""Reel inertia: the tail comes off a reel that has to be spun up, and goes on pulling nothing while it runs down.

Matters where a vine stops and starts: the pressure then falls below what growth takes before the tip slows down, and
the pressure at which it stops is no threshold.

    M = J/r² moves along with the tail

Easily taken for a threshold to stop below the one to start.

Reduce it with a lighter reel. Measure it with a known weight on a thread around the reel, and a watch.

Source: balance of torques on a reel of moment of inertia J and radius r.
"""

from vinetrack.effects import Parameter, Worked

KIND = "physical"
EASILY_TAKEN_FOR = ("static_yield",)
PARAMETERS = (
    Parameter("M", "M", "kg", 0.1, bounds=(0.0, 100.0), plausible=(0.0, 5.0), meaning="inertia of the reel over r²"),
)


def added_mass(s, rig, M):  # noqa: ARG001
    return M


WORKED = (Worked("added_mass", 4.2925, "5.1e-4 kg·m² / (10.9 mm)²", parameters={"M": 4.2925}),)
