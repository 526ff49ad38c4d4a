"""The house keeps its shape: imports flow one way, importing does nothing, files stay readable."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import house_rules
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vinetrack"
RULES = PACKAGE / "pipeline" / "Snakefile"
FILES = sorted(PACKAGE.rglob("*.py"))

FLOORS = (
    {"core"},
    {"tracks"},
    {"effects"},
    {"experiment"},
    {"video"},
    {"dynamics"},
    {"kinematics"},
    {"inference"},
    {"planning"},
    {"diagnosis", "narrative"},
    {"paper"},
    {"laboratory"},
    {"results"},
    {"figures"},
    {"report"},
    {"pipeline"},
    {"explorer", "interface", "setup_page"},
    {"cli"},
)
"""From the ground up; a room may use its own floor and those below. `experiment` looks into tracks (video)."""

HEAVY = {"matplotlib", "cv2", "skimage", "numba", "scipy", "pandas", "jinja2", "bokeh", "odrpack"}
HEAVY_AT_IMPORT = {
    *("dynamics", "inference", "effects", "kinematics", "laboratory", "video", "tracks", "diagnosis", "explorer"),
    *("planning", "paper", "interface", "setup_page"),
}
"""Rooms that compute: whoever imports them wants what they stand on. All others must start at once."""


@pytest.fixture(scope="module", autouse=True)
def _trees_are_let_go():
    """The syntax trees of the whole package take 130 MB."""
    yield
    house_rules.parsed.cache_clear()


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

    visit(house_rules.parsed(path))
    return found


def rooms_used(path: Path) -> set[str]:
    return {name.split(".")[1] for name in imports(path) if name.startswith("vinetrack.")}


def floor_of(name: str) -> int:
    return next(i for i, floor in enumerate(FLOORS) if name in floor)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_uses_its_own_floor_and_those_below(path: Path) -> None:
    if path == PACKAGE / "__init__.py":
        pytest.skip("the package's own front door")
    above = {used for used in rooms_used(path) if floor_of(used) > floor_of(room(path))}
    assert not above


def test_nothing_but_itself_uses_the_laboratory() -> None:
    users = {path for path in FILES if "laboratory" in rooms_used(path) and room(path) != "laboratory"}
    assert not users


def test_a_room_that_does_not_compute_starts_without_heavy_libraries() -> None:
    late = {
        (str(path.relative_to(PACKAGE)), name)
        for path in FILES
        if room(path) not in HEAVY_AT_IMPORT
        for name in imports(path, at_import_only=True)
        if name.split(".")[0] in HEAVY
    }
    assert not late


@pytest.mark.parametrize("module", ["vinetrack.cli.main", "vinetrack.pipeline.workflow"])
def test_the_command_line_and_the_workflow_load_no_heavy_library(module: str) -> None:
    code = f"import sys, {module}; print(*sorted(set(sys.modules) & {HEAVY!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_no_file_is_longer_than_450_lines() -> None:
    sources = [*FILES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py"), RULES]
    long = {str(path.relative_to(ROOT)) for path in sources if len(path.read_text(encoding="utf-8").splitlines()) > 450}
    assert not long


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_importing_a_file_does_no_work(path: Path) -> None:
    """Loops, reading and writing at the top of a file would run in every process that imports it."""
    forbidden = []
    for node in house_rules.parsed(path).body:
        if isinstance(node, ast.For | ast.While | ast.With | ast.Try):
            forbidden.append(ast.unparse(node)[:60])
        calls = [ast.unparse(call.func) for call in ast.walk(node) if isinstance(call, ast.Call)]
        if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.If):
            forbidden += [call for call in calls if call.split(".")[-1] in ("open", "mkdir", "read_text", "write_text")]
    assert not forbidden


def test_the_page_on_the_architecture_lists_the_rooms_from_the_bottom_to_the_top() -> None:
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Data flow")[0]
    rows = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in table.splitlines() if line.startswith("| `")]
    listed = [name for row in rows for name in row]
    assert sorted(listed) == sorted(name for floor in FLOORS for name in floor)
    assert [floor_of(name) for name in listed] == sorted(floor_of(name) for name in listed)


def test_the_floors_name_every_room() -> None:
    rooms = {room(path) for path in FILES} - {"__init__"}
    assert rooms <= set().union(*FLOORS)


def test_a_snakefile_has_rules_only() -> None:
    text = RULES.read_text(encoding="utf-8")
    assert not [line for line in text.splitlines() if line.startswith(("def ", "class ", "    def "))]


def test_no_two_test_files_share_a_name() -> None:
    """Pytest imports test files by their name alone: the second of two would not be run. It knows each conftest.py."""
    names = [path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_a_benchmark_finds_what_it_imports(path: Path) -> None:
    for node in ast.walk(house_rules.parsed(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "vinetrack":
            room = importlib.import_module(str(node.module))
            for alias in node.names:
                if not hasattr(room, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")


@pytest.mark.parametrize(
    "rule",
    [
        house_rules.undocumented,
        house_rules.numbers_without_source,
        house_rules.vague_names,
        house_rules.private_imports,
    ],
    ids=lambda rule: rule.__name__,
)
def test_the_package_breaks_no_rule(rule: Callable[[Path], list[house_rules.Place]]) -> None:
    assert [str(place) for place in rule(PACKAGE)] == []


def test_no_two_public_classes_share_a_name() -> None:
    assert not house_rules.repeated_classes(PACKAGE)


def test_no_two_modules_share_a_name() -> None:
    assert not house_rules.repeated_modules(PACKAGE)
