"""Verdicts on campaigns of another simulator, with nuisances that the fit does not assume.

The short form of `benchmarks/hidden_effects.py`. The seeds were taken from those kept for tests (900–999, neither tuned
on nor scored) by the size of their campaigns: of each kind the smallest whose truth lies above 20 σ; for the wrong
scale the smallest that sees the end of growth, where a scale shows. Where the verdict takes longest, each condition is
made once, and sizes are those of these campaigns (rough patch 754 positions, wrong scale 1666, lost frames 848).
"""

from __future__ import annotations

from functools import lru_cache

import pytest
from hidden import Hidden, make

import vinetrack as vt
from vinetrack.diagnosis.result import DROPPED_FRAMES, Diagnosis

pytestmark = pytest.mark.slow


@lru_cache
def asked(kind: str, seed: int, *, once: bool = False) -> tuple[Hidden, Diagnosis]:
    """A campaign, each of its conditions once if so said, and the verdict."""
    campaign = make(kind, seed, trials=int(once))
    return campaign, vt.diagnose(list(campaign.pairs), ladder=False, advice=False)


@pytest.mark.parametrize(("regime", "seed"), [("mixed_noise", 908), ("large_B_scatter", 913)])
def test_nothing_is_missed_where_nothing_is_missing(regime, seed):
    _, said = asked(f"null:{regime}", seed)
    assert said.verdict == "adequate"
    assert said.effects == ()
    assert said.answer_set == ()


@pytest.mark.parametrize(("effect", "seed"), [("tail_friction", 918), ("reservoir_depletion", 905)])
def test_a_hidden_effect_is_in_the_answer_with_its_size(effect, seed):
    campaign, said = asked(effect, seed, once=True)
    assert said.verdict in ("missing", "ambiguous")
    assert effect in said.answer_set
    assert len(said.answer_set) <= 2
    numbers = {n.key: n for c in said.rounds[0].ranking if c.effect == effect for n in c.numbers}
    for key, size in campaign.truth.values.items():
        assert abs(numbers[key].value - size) < 4 * numbers[key].sigma


def test_a_wrong_scale_is_an_artefact():
    _, said = asked("length_scale", 962, once=True)
    assert said.verdict == "artefact"
    assert "length_scale" in said.answer_set
    assert said.effects == ()


def test_frames_that_nobody_mentioned_are_said_first():
    campaign, said = asked("frames:dropped", 974, once=True)
    assert campaign.truth.dropped_frames
    assert said.verdict == "artefact"
    assert said.answer_set == (DROPPED_FRAMES,)


def test_a_rough_patch_is_in_no_catalogue():
    _, said = asked("outsider:rough_patch", 962, once=True)
    assert said.verdict == "unexplained"
    assert said.effects == ()


def test_two_hidden_effects_are_found_one_after_the_other():
    campaign, said = asked("tail_friction+length_scale", 930, once=True)
    named = {*said.effects, *said.rounds[-1].answer_set}
    assert set(campaign.truth.effects) <= named
    assert said.verdict in ("missing", "ambiguous")
