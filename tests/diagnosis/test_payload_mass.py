"""Payloads that weigh other than stated: one for each vine, of which one may be mistyped."""

from __future__ import annotations

import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt


def test_one_mistyped_payload_of_several_is_named_with_its_vine(tmp_path):
    """The payload of one of two vines weighs 15 % more than stated."""
    write_experiment(campaign("payload_mistyped", 912, (24, 40)), tmp_path / "e")
    said = vt.diagnose(vt.read_experiment(tmp_path / "e"), ladder=False, advice=False)
    assert (said.verdict, said.answer_set) == ("artefact", ("payload_mass",))
    numbers = next(row for row in said.rounds[0].ranking if row.effect == "payload_mass").numbers
    off = [number for number in numbers if abs(number.value) > 4 * number.sigma]
    assert len(off) == 1
    loaded_kg = {trial.trial.payload_kg for trial in said.fits[0].trials if trial.trial.vine == off[0].vine} - {0.0}
    assert off[0].value == pytest.approx(0.15 * max(loaded_kg), abs=3 * off[0].sigma)
