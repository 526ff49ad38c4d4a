"""The contract of an effect's file, in the catalogue or a user's own: read, tried out, listed, simulated, refused."""

import hashlib
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from by_hand import LOADED, followed
from commanded import run

import vinetrack as vt
import vinetrack.effects as effects
from vinetrack.dynamics.simulate import kernel
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, air_drag, catalogue, find_effect, load_effect
from vinetrack.effects._catalogue import behaviour_faults, own_effects

BRUSH = '''"""Brush: bristles at the mouth hold the tail back, the more the further it has run.

    tail force −q √x

Reduce it by taking the brush away.
"""

import numpy as np

from vinetrack.effects import Parameter, Worked

PARAMETERS = (Parameter("q", "q", "N/√m", 0.8, bounds=(0.0, 10.0), meaning="grip of the bristles"),)


def tail_force(s, rig, q):
    return -q * np.sqrt(s.tail_position)


WORKED = (Worked("tail_force", -0.4, "0.8 × √0.25", state={"tail_position": 0.25}, parameters={"q": 0.8}),)
'''
FOLDER = Path(effects.__file__).parent
each_effect = pytest.mark.parametrize("effect", catalogue().values(), ids=catalogue())


def written(folder: Path, text: str = BRUSH, name: str = "brush.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_it_is_simulated_like_any_other(tmp_path):
    brush = own_effects([written(tmp_path)])
    model = vt.make_model([*vt.base_model().names, "brush"], brush).with_values({"eversion_damping.B": LOADED.B})
    travel = followed(lambda _t, x, v: (LOADED.base(x, v) - 0.8 * max(x, 0.0) ** 0.5) / LOADED.m(x), 1.8 * LOADED.L)
    times = np.linspace(0, travel.end, 41)  # type: ignore[attr-defined]
    got = vt.simulate(model, LOADED.trial(), times).lead_position_m
    np.testing.assert_allclose(got, travel(times) / 2, rtol=0, atol=1e-5 * LOADED.L)


def copies(folder: Path, text: str) -> list[Effect]:
    for name in "ab":
        (folder / name).mkdir()
    return [own_effects([written(folder / name, text)])["brush"] for name in "ab"]


def test_one_text_at_two_places_is_compiled_once(tmp_path):
    one, other = copies(tmp_path, BRUSH)
    assert kernel((vt.base_model() + one).effects) is kernel((vt.base_model() + other).effects)
    assert [effect.path for effect in (one, other)] == [tmp_path / name / "brush.py" for name in "ab"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("-0.4,", "-0.3,"),  # not what was worked out by hand
        ('parameters={"q": 0.8}', 'parameters={"Q": 0.8}'),
        ("-q * np.sqrt(s.tail_position)", "-(q + 0.1) * np.sqrt(s.tail_position) + 0.05"),  # acts at no size
        ("return -q", 'open("x") if q < 0 else None\n    return -q'),
        ("return -q", 'open("x")\n    return -q'),
        ("s.tail_position)", "s.tail_position / q)"),  # cannot be evaluated where it vanishes
        ("s.tail_position)", "s.tail_place)"),
        ("def tail_force", "def pull"),
        ("import numpy as np\n", "import numpy as np\ndef :\n"),
        ("(s, rig, q)", "(s, rig)"),
        ("    tail force −q √x\n", ""),
        ("import numpy as np\n", "import numpy as np\n1/0\n"),
        # A table or a module beside a file may be another beside its copy.
        ("import numpy as np\n", "import numpy as np\nimport brushes\n"),
        ("import numpy as np\n", "import numpy as np\nfrom .brushes import q\n"),
        ("import numpy as np\n", "import numpy as np\nfrom pathlib import Path\n"),
        ("import numpy as np\n", "import numpy as np\nPLACE = __file__\n"),
        ("import numpy as np\n", "import numpy as np\nKIND = 'guess'\n"),
        ('"N/√m", 0.8', '"N/√m", 80.0'),
        ("bounds=(0.0, 10.0)", "bounds=(0.0, 10.0), zero=(0.0, 1.0)"),
        ("def tail_force", "def breakpoints(rig, q):\n    return (rig.lenght,)\n\n\ndef tail_force"),
        ("bounds=(0.0, 10.0)", "plausible=10.0"),
        ("import numpy as np\n", "import numpy as np\nORDER = 'first'\n"),
        ("import numpy as np\n", "import numpy as np\nNEEDS = ('tube_mm',)\n"),
        ('Parameter("q", "q", "N/√m", 0.8, bounds=(0.0, 10.0), meaning="grip of the bristles"),', "3,"),
    ],
)
def test_a_file_that_is_no_effect_is_refused_in_one_line_that_names_it(tmp_path, old, new):
    assert old in BRUSH
    path = written(tmp_path, BRUSH.replace(old, new))
    with pytest.raises(EffectError) as caught:
        own_effects([path])
    assert str(caught.value).startswith(str(path))


def test_capitals_missing_files_and_two_of_one_name_are_refused(tmp_path):
    paths = [effect.path for effect in copies(tmp_path, BRUSH)]
    for refused in ([written(tmp_path, name="Brush.py")], [tmp_path / "brush.py"], paths):
        with pytest.raises(EffectError):
            own_effects(refused)


def test_the_command_lists_it_with_the_effects_of_the_catalogue(tmp_path):
    (tmp_path / "in").mkdir()
    written(tmp_path)
    for folder, path in ((tmp_path, "brush.py"), (tmp_path / "in", "../brush.py")):
        (folder / "experiment.yaml").write_text(f"effects: [{path}]\n", encoding="utf-8")
    done = run("effects", "--experiment", tmp_path)
    named = {line.split()[0] for line in done.stdout.splitlines()[1:] if not line.startswith("    ")}
    assert (done.exit_code, named) == (0, {*catalogue(), "brush"})
    assert all(effect.formula in done.stdout for effect in catalogue().values())
    assert "N·(s/m)ⁿ" in done.stdout
    assert run("effects", "--experiment", tmp_path / "in").exit_code == 1  # it lies outside the experiment


@pytest.fixture
def effect_file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return Path(shutil.copy(air_drag.path, tmp_path / "wake.py"))


def test_it_is_named_with_its_hash_before_it_runs_and_remembered_until_it_changes(effect_file, capsys):
    load_effect(effect_file)
    told = capsys.readouterr().err
    load_effect(effect_file)
    assert capsys.readouterr().err == ""
    assert str(effect_file) in told
    assert hashlib.sha256(effect_file.read_bytes()).hexdigest() in told
    effect_file.write_text("raise SystemError")
    with pytest.raises(EffectError):
        load_effect(effect_file)
    assert str(effect_file) in capsys.readouterr().err


def test_where_only_known_ones_may_run_a_new_one_is_not_run(effect_file, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    assert load_effect(effect_file).name == "wake"  # a home that cannot be written stops nothing
    monkeypatch.setenv("VINETRACK_OWN_EFFECTS", "known")
    effect_file.write_text("from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n")
    with pytest.raises(EffectError):
        load_effect(effect_file)
    assert not effect_file.with_suffix(".ran").exists()


def test_the_folder_is_the_catalogue_with_the_base_first():
    assert set(catalogue()) == {path.stem for path in FOLDER.glob("*.py") if not path.stem.startswith("_")}
    assert tuple(catalogue())[:4] == BASE_EFFECTS


@each_effect
def test_a_file_names_describes_and_works_out_its_effect_and_bounds_its_parameters(effect):
    assert effect.name == effect.path.stem
    assert getattr(effects, effect.name) == effect == find_effect(effect.name)
    assert all((effect.summary, effect.formula, "Source:" in effect.text))
    assert {worked.hook for worked in effect.worked} == set(effect.functions)
    assert all(worked.rel <= 1e-2 for worked in effect.worked)
    assert list(behaviour_faults(effect)) == []  # what is asked of a user's own
    assert set(effect.replaces) <= set(catalogue()) - {effect.name}
    assert (effect.kind == "base") == (effect.name in BASE_EFFECTS)
    if effect.kind == "measurement":
        read_off = {"true_time", "trace_time", "observed_position", "row_delay", "gauge", "yield_gauge", "area"}
        read_off |= {"film_gain", "averaged_over", "trace_pressure"}
        # They turn, and add to, a weight and a mass that are there.
        weight = {"growth_angle": {"tail_force"}, "payload_mass": {"tail_force", "added_mass"}}
        assert set(effect.functions) <= read_off | weight.get(effect.name, set())
    for parameter in effect.parameters:
        assert effect.parameters.count(parameter) == 1
        assert all((parameter.symbol, parameter.unit, parameter.meaning))
        low, high = parameter.bounds
        assert -math.inf < low < high < math.inf
        assert low <= parameter.default <= high
        assert parameter.shared in ("all", "vine", "day")
        assert low <= parameter.plausible[0] < parameter.plausible[1] <= high
