"""Campaigns with a hidden effect, made by a simulator that shares no code with the package's model.

    from hidden import make
    campaign = make("air_drag", seed=3)
    vt.diagnose(vt.fit(vt.base_model(), campaign.pairs))
    campaign.truth.effects

Every campaign follows from its kind and its seed alone. Seeds 0–899 are for tuning, 900–999 for
the tests; seeds from 10000 on score, and nothing may be tuned on those.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hidden.kinds import EFFECTS, KINDS, NULLS, OUTSIDERS, PAIRS, kinds

if TYPE_CHECKING:
    from hidden.campaigns import Hidden, Truth, make
    from hidden.folder import write_folder

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

_LATER = {"Hidden": "campaigns", "Truth": "campaigns", "make": "campaigns", "write_folder": "folder"}


def __getattr__(name: str) -> object:
    """What needs the package's records is imported when asked for: laboratories are made without them."""
    if name in _LATER:
        return getattr(import_module(f"hidden.{_LATER[name]}"), name)
    raise AttributeError(name)
