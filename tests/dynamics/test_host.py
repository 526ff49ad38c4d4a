"""One compiled form for all effects of the catalogue: who uses it, and that it is the smaller model to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from by_hand import BARE, LOADED, N
from own_effect import NAME, write_effect

from vinetrack.dynamics import kernel as batch
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import Model, base_model, host_for, make_model, probe, shared_host
from vinetrack.dynamics.simulate import prepare, simulate_many
from vinetrack.effects import Effect, catalogue, load_effect, own_effects


def test_every_model_of_the_catalogue_has_the_same_host() -> None:
    hosts = {shared_host((base_model() + name).effects).names for name in ("air_drag", "wall_stretch")}  # type: ignore[union-attr]
    assert hosts == {(*catalogue(), probe().name)}


def test_base_models_and_those_with_an_own_effect_are_compiled_by_themselves(tmp_path: Path) -> None:
    own = own_effects([write_effect(tmp_path)])
    assert shared_host(base_model().effects) is None
    assert shared_host(make_model(["gravity"]).effects) is None
    assert shared_host((base_model() + "air_drag" + own[NAME]).effects) is None


def test_an_own_effect_under_a_name_of_the_catalogue_is_not_that_of_the_catalogue(tmp_path: Path) -> None:
    own = load_effect(write_effect(tmp_path).rename(tmp_path / "air_drag.py"))
    assert own.name in catalogue()
    assert shared_host((*base_model().effects, own)) is None


def test_a_tail_that_may_go_slack_is_not_compiled_with_the_whole_catalogue(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, bool]] = []

    def noted(effects: tuple[Effect, ...], tail_free: bool) -> ModuleType:
        asked.append((len(effects), tail_free))
        return kernel(base_model().effects)

    monkeypatch.setattr(batch, "kernel", noted)
    model = base_model().with_values({"eversion_damping.B": BARE.B}) + "air_drag"
    for slack in ("taut", "free"):
        prepare(model, [replace(BARE.trial(), tail_slack=slack)], [np.linspace(0.0, 0.1, 5)])
    assert asked == [(len(catalogue()) + 1, False), (len(model.effects), True)]


def test_by_the_host_it_is_the_same_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"eversion_damping.B": 6.44, "eversion_damping.n": N, "reservoir_depletion.gamma": 1.3, "air_drag.C_D": 1.1}
    model: Model = (base_model() + "reservoir_depletion" + "air_drag").with_values(sizes)
    trials = [LOADED.trial(chamber_m3=3.7e-3), BARE.trial(chamber_m3=3.7e-3, growth_angle_rad=1.0)]
    times = [np.linspace(0.0, 0.3, 200)] * 2
    by_host = simulate_many(model, trials, times)
    monkeypatch.setattr(batch, "shared_host", lambda _: None)
    alone = simulate_many(model, trials, times)
    stated = simulate_many(model, trials, times, host=host_for(model))
    for one, other, third in zip(by_host, alone, stated, strict=True):
        assert one.status == other.status
        for name in ("lead_position_m", "tail_velocity_m_s", "observed_position_m"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            np.testing.assert_array_equal(getattr(one, name), getattr(third, name))
