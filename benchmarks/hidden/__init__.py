"""Campaigns with a hidden effect, made by a simulator that shares no code with the package's model.

    from hidden import make
    campaign = make("air_drag", seed=3)
    vt.diagnose(vt.fit(vt.base_model(), campaign.pairs))
    campaign.truth.effects

Every campaign follows from its kind and its seed alone. Seeds 0–899 are for tuning, 900–999 for
the tests; seeds from 10000 on score, and nothing may be tuned on those.
"""

from hidden.campaigns import Hidden, Truth, make
from hidden.folder import write_folder
from hidden.kinds import EFFECTS, KINDS, NULLS, OUTSIDERS, PAIRS, kinds

FIRST_SCORING_SEED = 10_000

__all__ = [
    "EFFECTS",
    "FIRST_SCORING_SEED",
    "KINDS",
    "NULLS",
    "OUTSIDERS",
    "PAIRS",
    "Hidden",
    "Truth",
    "kinds",
    "make",
    "write_folder",
]
