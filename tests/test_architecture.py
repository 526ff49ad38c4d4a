"""The package keeps its shape: budgets, imports that flow one way, importing that does nothing, documented names."""

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import vinetrack

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vinetrack"
FILES = sorted(PACKAGE.rglob("*.py"))

ROOMS = (
    "core tracks effects experiment video dynamics kinematics inference planning diagnosis narrative paper laboratory "
    "results figures report pipeline interface|pages cli"
)
FLOORS = {name: level for level, floor in enumerate(ROOMS.split()) for name in floor.split("|")}
"""From the ground up; a room may use its own floor and those below. `experiment` looks into tracks (video)."""

BUDGETS = {
    "cli": (637, 2, 2),
    "core": (952, 6, 23),
    "diagnosis": (5710, 12, 67),
    "dynamics": (2171, 7, 17),
    "effects": (565, 3, 7),
    "experiment": (1600, 4, 15),
    "figures": (2028, 6, 19),
    "inference": (4633, 11, 46),
    "interface": (540, 1, 2),
    "kinematics": (1517, 4, 6),
    "laboratory": (1519, 5, 7),
    "narrative": (1029, 3, 7),
    "pages": (2746, 7, 11),
    "paper": (786, 3, 22),
    "pipeline": (1888, 5, 7),
    "planning": (1532, 4, 13),
    "report": (696, 2, 2),
    "results": (325, 1, 8),
    "tracks": (1459, 4, 19),
    "video": (4779, 10, 63),
}
"""Lines, files and module-level constants that a room may have, lowered with the code; what moves to another room takes
its own along. The files of single effects do not count: a new effect is free."""
TESTS = 15_999  # Lines of Python below tests/, lowered with them
LET_PASS = (30, 0, 2)  # A figure or a format more is let pass: who adds it need not take out what he has not read

HEAVY = {"matplotlib", "cv2", "numba", "scipy", "pandas", "jinja2", "bokeh", "odrpack"}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module", autouse=True)
def _trees_are_let_go():
    """The syntax trees of the whole package take 130 MB."""
    yield
    parsed.cache_clear()


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path, at_import_only: bool = False) -> set[str]:
    """Dotted names a file imports; `at_import_only` leaves out those inside functions and `if TYPE_CHECKING`."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
        if at_import_only and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return
        if at_import_only and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(parsed(path))
    return found


def constants(path: Path) -> int:
    """Module-level names in capitals that a file assigns."""
    count = 0
    for node in parsed(path).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            count += sum(isinstance(name, ast.Name) and name.id.strip("_").isupper() for name in names)
    return count


def test_every_room_and_the_tests_stay_within_their_budgets():
    size = {name: [0, 0, 0] for name in BUDGETS}
    for path in FILES:
        is_effect = path.parent.name == "effects" and not path.stem.startswith("_")
        if room(path) != "__init__" and not is_effect:
            lines = path.read_text(encoding="utf-8").count("\n")
            size[room(path)] = [a + b for a, b in zip(size[room(path)], (lines, 1, constants(path)), strict=True)]
    over = {
        name: found
        for name, found in size.items()
        if any(a > b + more for a, b, more in zip(found, BUDGETS[name], LET_PASS, strict=True))
    }
    assert not over, "rooms over their budget of lines, files, constants: take something out"
    lines = sum(path.read_text(encoding="utf-8").count("\n") for path in (ROOT / "tests").rglob("*.py"))
    assert lines <= TESTS + LET_PASS[0]


def test_a_file_uses_its_own_floor_and_those_below_and_nothing_but_itself_uses_the_laboratory():
    rooms = {p: {n.split(".")[1] for n in imports(p) if n.startswith("vinetrack.")} - {room(p)} for p in FILES}
    top = len(FLOORS)  # where the package's own __init__.py stands
    above = [(path, one) for path, used in rooms.items() for one in used if FLOORS[one] > FLOORS.get(room(path), top)]
    assert not above
    assert not [path for path, used in rooms.items() if "laboratory" in used]


def test_no_modules_import_each_other_in_a_circle():
    """At import; what a function imports when it is called does not count."""
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in FILES}
    users: dict[str, set[str]] = {}
    for name, path in modules.items():
        known = {node for node in imports(path, at_import_only=True) if node in modules}
        users[name] = known - {name}
    while free := [name for name, used in users.items() if not used & users.keys()]:
        for name in free:
            del users[name]
    assert not users


@pytest.mark.parametrize("module", ["vinetrack.cli.main", "vinetrack.pipeline.workflow"])
def test_the_command_line_and_the_workflow_load_no_heavy_library(module):
    code = f"import sys, {module}; print(*sorted(set(sys.modules) & {HEAVY!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_importing_a_file_does_no_work():
    """Loops, reading and writing at the top of a file would run in every process that imports it."""
    forbidden = []
    for path in FILES:
        for node in parsed(path).body:
            if isinstance(node, ast.For | ast.While | ast.With | ast.Try):
                forbidden.append((path.name, ast.unparse(node)[:60]))
            calls = [ast.unparse(call.func) for call in ast.walk(node) if isinstance(call, ast.Call)]
            if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.If):
                reads = ("open", "mkdir", "read_text", "write_text")
                forbidden += [(path.name, call) for call in calls if call.split(".")[-1] in reads]
    assert not forbidden


def test_the_page_on_the_architecture_lists_the_rooms_from_the_bottom_to_the_top():
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Data flow")[0]
    rows = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in table.splitlines() if line.startswith("| `")]
    listed = [name for row in rows for name in row]
    assert sorted(listed) == sorted(FLOORS)
    assert listed == sorted(listed, key=FLOORS.__getitem__)


def test_a_snakefile_has_rules_only():
    text = (PACKAGE / "pipeline" / "Snakefile").read_text(encoding="utf-8")
    assert not [line for line in text.splitlines() if line.startswith(("def ", "class ", "    def "))]


def test_a_benchmark_finds_what_it_imports():
    missing = []
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "vinetrack":
                for alias in node.names:
                    try:
                        if not hasattr(importlib.import_module(str(node.module)), alias.name):
                            importlib.import_module(f"{node.module}.{alias.name}")
                    except ModuleNotFoundError:
                        missing.append((path.name, node.module, alias.name))
    assert not missing


@pytest.mark.parametrize("name", sorted(vinetrack._HOMES))
def test_a_name_of_the_python_interface_is_documented(name):
    """Arguments with their meaning, what is returned (numpydoc), and an example."""
    thing = getattr(vinetrack, name)
    text = thing.__doc__ or ""
    assert ">>> " in text
    assert len(text) > 60
    if not isinstance(thing, type):
        arguments = thing.__code__.co_varnames[: thing.__code__.co_argcount]
        assert not arguments or "Parameters\n" in text
        assert all(re.search(rf"\b{argument}\b", text) for argument in arguments)
        assert not arguments or "Returns\n" in text


def test_a_module_takes_no_private_name_of_another_room():
    private = []
    for path in FILES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vinetrack."):
                parts = [*str(node.module).split("."), *(alias.name for alias in node.names)]
                if parts[1] != room(path) and any(re.match("_[^_]", part) for part in parts):
                    private.append((path, parts))
    assert not private


def test_every_deliberate_fault_still_finds_the_text_that_it_alters():
    command = [sys.executable, str(ROOT / "benchmarks" / "mutations.py"), "--list"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
