"""A user's own effect: read, tried out, listed, explained and simulated; and every way in which it can be none."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from by_hand import LOADED, followed
from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import base_model, make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import Effect, EffectError, catalogue, load_effect
from vinetrack.effects._catalogue import _is_independent_of_path
from vinetrack.effects._own import UNCHANGED, behaviour_faults, own_effects

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


def written(folder: Path, text: str = BRUSH, name: str = "brush.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder: Path, text: str, name: str = "brush.py") -> str:
    with pytest.raises(EffectError) as caught:
        own_effects([written(folder, text, name)])
    message = str(caught.value)
    assert message.startswith(str(folder / name))
    assert "\n" not in message
    return message


def test_it_is_simulated_like_any_other(tmp_path: Path) -> None:
    brush = own_effects([written(tmp_path)])
    model = make_model([*base_model().names, "brush"], brush).with_values({"eversion_damping.B": LOADED.B})
    travel = followed(lambda _t, x, v: (LOADED.base(x, v) - 0.8 * max(x, 0.0) ** 0.5) / LOADED.m(x), 1.8 * LOADED.L)
    times = np.linspace(0, travel.end, 41)  # type: ignore[attr-defined]
    got = simulate(model, LOADED.trial(), times).lead_position_m
    np.testing.assert_allclose(got, travel(times) / 2, rtol=0, atol=1e-5 * LOADED.L)


def copies(folder: Path, text: str) -> list[Effect]:
    """The effect of this text at two places."""
    for name in "ab":
        (folder / name).mkdir()
    return [own_effects([written(folder / name, text)])["brush"] for name in "ab"]


def test_one_text_at_two_places_is_compiled_once_and_each_is_traced_to_its_file(tmp_path: Path) -> None:
    one, other = copies(tmp_path, BRUSH)
    assert kernel((base_model() + one).effects) is kernel((base_model() + other).effects)
    for effect, name in ((one, "a"), (other, "b")):
        assert effect.path == tmp_path / name / "brush.py"
        assert effect.functions["tail_force"].__code__.co_filename == str(effect.path)


@pytest.mark.parametrize(
    "line", ["from pathlib import Path", "import brushes", "from .brushes import q", "PLACE = __file__"]
)
def test_what_may_depend_on_its_place_is_compiled_at_each(tmp_path: Path, line: str) -> None:
    """A table or a module beside a file may be another beside its copy."""
    assert _is_independent_of_path(BRUSH.encode())
    assert not _is_independent_of_path(f"{BRUSH}\n{line}\n".encode())
    if "brushes" not in line:
        one, other = copies(tmp_path, f"{BRUSH}\n{line}\n")
        assert kernel((base_model() + one).effects) is not kernel((base_model() + other).effects)


def test_an_edit_of_a_module_that_it_imports_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The numbers of a module are constants of the compiled form: an old form would go on with the old ones."""
    monkeypatch.syspath_prepend(tmp_path)
    grips, table = tmp_path / "brush_grips.py", tmp_path / "brush_table.py"
    path = written(tmp_path, BRUSH.replace("import numpy as np\n", "import brush_grips\nimport numpy as np\n", 1))

    def digest(grip: str, number: str) -> str:
        grips.write_text(grip, encoding="utf-8")
        table.write_text(number, encoding="utf-8")
        for name in ("brush_grips", "brush_table"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        kernel.cache_clear()
        importlib.import_module("brush_grips")
        return kernel((load_effect(path),)).__name__

    by_table = "from brush_table import SHARE\nGRIP = SHARE"
    digests = [
        digest("GRIP = 1.0", ""),
        digest("GRIP = 2.0", ""),
        digest(by_table, "SHARE = 3"),
        digest(by_table, "SHARE = 4"),
    ]
    assert len(set(digests)) == 4
    assert digest(by_table, "SHARE = 4") == digests[-1]


def test_effect_files_are_read_as_utf_8_whatever_the_system_writes() -> None:
    code = "from vinetrack.dynamics.kernel import kernel; from vinetrack.dynamics.model import base_model\n"
    code += "kernel(base_model().effects)"
    plain = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **plain}, check=True)


def test_a_missed_worked_number_is_told_with_its_arithmetic(tmp_path: Path) -> None:
    message = refusal(tmp_path, BRUSH.replace("-0.4,", "-0.3,"))
    assert "tail_force gives -0.4 where worked out by hand it is -0.3 (0.8 × √0.25)" in message


def test_a_size_that_is_none_but_does_something_is_told(tmp_path: Path) -> None:
    message = refusal(tmp_path, BRUSH.replace("-q * np", "-(q + 0.1) * np").replace("-0.4,", "-0.45,"))
    assert "at q = 0, where nothing should change" in message


def test_what_cannot_be_compiled_is_told(tmp_path: Path) -> None:
    text = BRUSH.replace("return -q", 'open("x") if q < 0 else None\n    return -q')
    assert "tail_force cannot be compiled" in refusal(tmp_path, text)


def test_what_fails_wherever_it_is_asked_is_told_in_a_sentence(tmp_path: Path) -> None:
    assert "tail_force cannot be compiled" in refusal(tmp_path, BRUSH.replace("return -q", 'open("x")\n    return -q'))
    assert "tail_force cannot be compiled" in refusal(tmp_path, BRUSH.replace("s.tail_position)", "s.tail_place)"))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("def tail_force", "def pull", "defines none of the functions"),
        ("import numpy as np\n", "import numpy as np\ndef :\n", "cannot be read (SyntaxError"),
        ("(s, rig, q)", "(s, rig)", "must be tail_force(s, rig, q)"),
        ("    tail force −q √x\n", "", "show the formula on an indented line"),
        ("import numpy as np\n", "import numpy as np\n1/0\n", "ZeroDivisionError"),
        ("import numpy as np\n", "import numpy as np\nKIND = 'guess'\n", "KIND is 'guess'"),
        ('"N/√m", 0.8', '"N/√m", 80.0', "the default of q lies outside its bounds"),
        ("bounds=(0.0, 10.0)", "bounds=(0.0, 10.0), zero=(0.0, 1.0)", "default and zero of q must be numbers"),
        ("bounds=(0.0, 10.0)", "bounds=10.0", "its bounds two"),
        ("bounds=(0.0, 10.0)", "plausible=10.0", "plausible of q must be two numbers"),
        ("import numpy as np\n", "import numpy as np\nORDER = 'first'\n", "cannot be read (ValueError"),
        ("import numpy as np\n", "import numpy as np\nNEEDS = 3\n", "cannot be read (TypeError"),
        ('Parameter("q", "q", "N/√m", 0.8, bounds=(0.0, 10.0), meaning="grip of the bristles"),', "3,", "PARAMETERS"),
    ],
)
def test_a_file_that_is_no_effect_is_told_what_it_lacks(tmp_path: Path, old: str, new: str, told: str) -> None:
    assert old in BRUSH
    assert told in refusal(tmp_path, BRUSH.replace(old, new))


def test_a_name_in_capitals_is_refused(tmp_path: Path) -> None:
    assert "lower_case" in refusal(tmp_path, BRUSH, "Brush.py")


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(EffectError, match=r"brush\.py: there is no such effect file"):
        own_effects([tmp_path / "brush.py"])


def test_two_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with pytest.raises(EffectError, match="another effect named 'brush'"):
        own_effects([written(tmp_path / "a"), written(tmp_path / "b")])


@pytest.mark.parametrize("name", catalogue())
def test_the_catalogue_passes_what_is_asked_of_a_users_own(name: str) -> None:
    assert list(behaviour_faults(catalogue()[name])) == []


def test_every_hook_has_a_value_that_leaves_all_as_it_was() -> None:
    from vinetrack.effects import HOOKS

    assert set(UNCHANGED) == set(HOOKS)


# ---- the command ----


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["effects", *map(str, arguments)], catch_exceptions=False)


def experiment(folder: Path, effects: str) -> Path:
    (folder / "experiment.yaml").write_text(f"effects: {effects}\n", encoding="utf-8")
    return folder


def test_the_list_is_aligned_and_has_the_users_own(tmp_path: Path) -> None:
    written(tmp_path)
    done = run("--experiment", experiment(tmp_path, "[brush.py]"))
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    column = lines[0].index("kind")
    named = [line for line in lines[1:] if not line.startswith("    ")]
    assert len(named) == len(catalogue()) + 1
    assert all(line[column - 2 : column] == "  " and line[column].islower() for line in named)
    assert any(line.startswith("brush ") and "physical, own" in line and "q (N/√m)" in line for line in named)


def test_one_is_explained_in_words(tmp_path: Path) -> None:
    done = run("leak")
    assert done.exit_code == 0
    for words in (
        "Matters where",
        "P → P e^(−t/τ)",
        "Easily taken for",
        "Reduce it",
        "Source:",
        "[leak.rate]",
        "0 to 5",
    ):
        assert words in done.output
    written(tmp_path)
    assert "bristles" in run("brush", "--experiment", experiment(tmp_path, "[brush.py]")).output


def test_a_name_misspelt_is_suggested() -> None:
    done = run("air_drg")
    assert done.exit_code == 1
    assert "Did you mean 'air_drag'?" in done.output


def test_a_broken_effect_of_an_experiment_is_one_sentence(tmp_path: Path) -> None:
    written(tmp_path, BRUSH.replace("-0.4,", "-0.3,"))
    done = run("--experiment", experiment(tmp_path, "[brush.py]"))
    assert done.exit_code == 1
    named, refused = done.stderr.strip().splitlines()
    assert "runs for the first time" in named
    assert "worked out by hand" in refused


def test_an_effect_outside_the_experiment_is_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    written(tmp_path)
    done = run("--experiment", experiment(tmp_path / "in", "[../brush.py]"))
    assert done.exit_code == 1
    assert "effects" in done.output


def test_the_picture_is_written_where_it_is_wanted(tmp_path: Path) -> None:
    done = run("air_drag", "--figure", tmp_path / "drag.png")
    assert done.exit_code == 0
    assert (tmp_path / "drag.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("arguments", [("air_drag", "--figure", "drag.doc"), ("--figure", "all.png")])
def test_a_picture_that_cannot_be_is_refused(arguments: tuple[str, ...], tmp_path: Path) -> None:
    done = run(*(tmp_path / a if "." in a else a for a in arguments))
    assert done.exit_code == 1
    assert not list(tmp_path.iterdir())


def test_effects_of_one_name_are_read_again_when_their_file_changes(tmp_path: Path) -> None:
    first = load_effect(written(tmp_path))
    second = load_effect(written(tmp_path, BRUSH.replace("0.8, bounds", "0.9, bounds")))
    assert (first.parameters[0].default, second.parameters[0].default) == (0.8, 0.9)
