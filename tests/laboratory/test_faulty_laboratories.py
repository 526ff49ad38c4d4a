"""Campaigns of laboratories with faults are what they say; an answer about one is judged by what is right to say.

They live in `benchmarks/hidden`, share no code with the package's own laboratory, and are scored by
`benchmarks/laboratories.py`. Seeds from 20900 on are these tests'.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from by_hand import LOADED, N, followed
from hidden import laboratories as faults
from hidden.balls import fallen
from hidden.laboratory_kinds import BARE
from hidden.motion import AIR, G, Tube, follow
from hidden.shots import Laboratory, careful, plan, seen
from hidden.slack import follow_slack
from hidden.verdicts import Answer, Should, judge
from hidden.visibility import visible_sigma

from vinetrack.dynamics.model import base_model
from vinetrack.dynamics.simulate import simulate

SEED = 20_900
FEW = (18, 24)


def drawn() -> tuple[Laboratory, np.random.Generator]:
    draw = np.random.default_rng(SEED)
    return careful(plan(draw, replace(BARE, trials=FEW), lambda _: True), draw), draw


def test_wear_follows_the_order_of_each_vine():
    laboratory, draw = drawn()
    before = faults.in_rising_order(laboratory, draw)
    after = faults.worn(0.02, 0.02)(before, draw)
    for vine in {shot.setting.vine for shot in before.shots}:
        pairs = [(a, b) for a, b in zip(before.shots, after.shots, strict=True) if a.setting.vine == vine]
        assert [b.physics.B / a.physics.B for a, b in pairs] == pytest.approx([1 + 0.02 * k for k in range(len(pairs))])
        pressures = [a.setting.pressure_kPa for a, _ in pairs]
        assert pressures == sorted(pressures)


def test_a_row_that_is_read_late_shows_what_was_there_then():
    laboratory, draw = drawn()
    shot = laboratory.shots[0]
    camera = faults.rolling(laboratory, draw).camera
    since = np.arange(-5, 60) / shot.setting.capture_hz
    y, _, _ = seen(shot, camera, since)
    moment = since + camera.row_delay_s_m * (y - camera.lens_centre_m)
    order = np.argsort(moment)
    out, _ = follow(moment[order], shot.tube, shot.physics, np.empty((0, 3)))
    assert y[order] == pytest.approx(out[:, 0], abs=2e-6)


@pytest.mark.parametrize("P", [7e3, 14e3, 28e3])
def test_a_tail_that_cannot_push_moves_as_in_the_package(P):
    trial = LOADED.trial(pressure_Pa=P, tail_slack="free")
    tube = Tube(P, LOADED.P_y, LOADED.D, LOADED.t, LOADED.L, payload=LOADED.payload, cosine=1.0)
    times = np.linspace(0, 0.2, 400)
    found = follow_slack(times, tube, LOADED.B, N)
    model = base_model().with_values({"eversion_damping.B": LOADED.B, "eversion_damping.n": N})
    assert found[-1, 2] > 1e-6
    assert found[:, 0] == pytest.approx(simulate(model, trial, times).lead_position_m, abs=2e-5)


def test_a_ball_falls_as_the_equation_of_motion_has_it():
    mass, diameter, C_D = 2.7e-3, 0.04, 0.5
    drag = 0.5 * AIR * math.pi * diameter**2 / 4 * C_D
    times = np.linspace(0, 0.8, 50)
    found = followed(lambda _t, _x, v: G - drag * v**2 / mass, 3.0)
    assert fallen(times, mass, diameter, C_D) == pytest.approx(found(times), abs=1e-8)
    assert np.all(fallen(np.array([-1.0, 0.0]), mass, diameter, C_D) == 0)


LENS = Should(("artefact", "ambiguous", "adequate"), any_of=("lens",), true=("lens",))
WORN = Should(("artefact",), any_of=("*order*",), only=("*order*",), true=("*order*",))
BOTH = Should(("missing", "ambiguous"), ("drag",), all_of=("drag", "inlet"), true=("drag", "inlet"), holds=("drag.C",))


def answer(verdict: str, *names: str, size: tuple[float, float] | None = None) -> Answer:
    sizes = {"drag.C": {"value": sum(size) / 2, "low_95": size[0], "high_95": size[1]}} if size else {}
    return Answer(verdict, names, names[:1] if verdict == "missing" else (), numbers=sizes)


@pytest.mark.parametrize(
    ("said", "should", "right", "wrong_name"),
    [
        (answer("adequate"), LENS, True, False),
        (answer("ambiguous", "lens", "latch_release"), LENS, True, False),
        (answer("ambiguous", "latch_release", "leak"), LENS, False, False),
        (answer("missing", "latch_release"), LENS, False, True),
        (answer("artefact", "length_scale"), LENS, False, True),
        (answer("unexplained"), LENS, False, False),
        (answer("adequate"), WORN, False, False),
        (answer("artefact", "drift_with_order"), WORN, True, False),
        (answer("artefact", "drift_with_order", "pressure_gain"), WORN, False, False),
        (answer("ambiguous", "drag", "inlet"), BOTH, True, False),
        (answer("ambiguous", "drag", "leak"), BOTH, False, False),
        (answer("missing", "drag", size=(0.9, 1.1)), BOTH, True, False),
        (answer("missing", "drag", size=(1.1, 1.2)), BOTH, False, False),
    ],
)
def test_an_answer_is_judged_by_what_is_right_to_say(said, should, right, wrong_name):
    judged = judge(said, should, {"drag.C": 1.0})
    assert (judged.right, judged.wrong_name, bool(judged.why)) == (right, wrong_name, not right)


def test_a_fault_that_hardly_shows_need_not_be_named():
    should = Should(("artefact",), any_of=("lens",), true=("lens",))
    assert [judge(answer("adequate"), should, {"visible_sigma": size}).right for size in (3.0, 30.0)] == [True, False]


@pytest.mark.slow
def test_a_fault_is_as_visible_as_the_noise_lets_it_be():
    laboratory, draw = drawn()
    strong = faults.lens(2, 2)(laboratory, draw)
    # Errors of B and pressure can hide some of it, and noise rules how much of the rest shows.
    louder = replace(strong, camera=replace(strong.camera, noise_m=4 * strong.camera.noise_m))
    assert visible_sigma(strong) > 20
    assert 2 < visible_sigma(strong) / visible_sigma(louder) < 4.4
