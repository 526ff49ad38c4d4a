"""An edit of any file of the package reruns the stages that run it, and no others."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from functools import cache, lru_cache
from pathlib import Path

import pytest

from vinetrack.dynamics.kernel import PARTS
from vinetrack.pipeline import workflow
from vinetrack.pipeline.workflow import PACKAGE, STAGE_MODULES, code_hash, imported_names, stage_files

STAGES = tuple(STAGE_MODULES)
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package that may be edited."""
    target = tmp_path_factory.mktemp("copy") / "vinetrack"
    return shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))


@lru_cache
def hashes(copy: Path) -> dict[str, str]:
    """Hashes of all stages of the copy as it came."""
    workflow.forget_scans()
    return {stage: code_hash(stage, copy) for stage in STAGES}


def changed_by_an_edit(path: Path, copy: Path) -> set[str]:
    """Stages whose hash changes when a byte is added to a file, which is put back."""
    before = hashes(copy)
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    workflow.forget_scans()
    after = {stage: code_hash(stage, copy) for stage in STAGES}
    path.write_bytes(content)
    return {stage for stage in STAGES if before[stage] != after[stage]}


@cache
def imports_by_syntax(path: Path) -> frozenset[str]:
    """What a file imports at run time, read from its syntax tree: the slow way, beyond doubt."""
    names: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names if alias.name.split(".")[0] == "vinetrack")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "vinetrack":
            names.add(str(node.module))
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return frozenset(name.removeprefix("vinetrack").lstrip(".") for name in names)


@cache
def modules_by_syntax(stage: str) -> set[Path]:
    """Modules that the imports of a stage reach; files that are read, not imported, are not among them."""
    waiting, reached = list(STAGE_MODULES[stage]), set()
    while waiting:
        base = PACKAGE.joinpath(*waiting.pop().split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py", base.parent / "__init__.py"):
            if path.is_file() and path not in reached and (path.parent != PACKAGE or path.stem != "__init__"):
                reached.add(path)
                waiting.extend(imports_by_syntax(path))
    return reached


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_scan_finds_what_the_syntax_tree_holds(path: Path) -> None:
    """More is found only where an import stands in a docstring or in the text of a module that is written out."""
    scanned = imported_names(path.read_text(encoding="utf-8"))
    assert imports_by_syntax(path) <= scanned
    written_out = {Path("__init__.py"), Path("dynamics/kernel.py")}
    assert path.relative_to(PACKAGE) in written_out or scanned == imports_by_syntax(path)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_holds_every_module_that_its_imports_reach(stage: str) -> None:
    assert modules_by_syntax(stage) <= set(stage_files(stage))


@pytest.mark.parametrize("room", ROOMS)
def test_an_edit_reruns_the_stages_that_import_the_file_and_no_others(room: str, copy: Path) -> None:
    modules = sorted(path for path in (PACKAGE / room).glob("*.py") if not path.stem.startswith("_"))
    reached = [path for path in modules if any(path in modules_by_syntax(stage) for stage in STAGES)]
    path = (reached or modules)[0]
    named = {stage for stage in STAGES if room == "effects" and PACKAGE / "effects/_catalogue.py" in stage_files(stage)}
    expected = {stage for stage in STAGES if path in modules_by_syntax(stage)} | named
    assert changed_by_an_edit(copy / path.relative_to(PACKAGE), copy) == expected


def test_an_edit_of_priors_and_published_values_reruns_the_diagnosis_that_uses_them(copy: Path) -> None:
    assert "diagnosis" in changed_by_an_edit(copy / "planning" / "scaling_priors.py", copy)
    assert "diagnosis" in changed_by_an_edit(copy / "core" / "published.py", copy)


def test_an_effect_reruns_the_model_though_nothing_imports_it(copy: Path) -> None:
    changed = changed_by_an_edit(copy / "effects" / "capstan_friction.py", copy)
    assert {"laboratory", "model", "diagnosis"} <= changed
    assert "damping" not in changed


def test_every_part_of_the_compiled_integrator_reruns_the_model(copy: Path) -> None:
    for name in PARTS:
        assert {"laboratory", "model", "diagnosis"} <= changed_by_an_edit(copy / "dynamics" / name, copy)


def test_templates_captions_and_tokens_rerun_the_report(copy: Path) -> None:
    assert changed_by_an_edit(copy / "report" / "templates" / "report.html", copy) == {"report"}
    assert changed_by_an_edit(copy / "report" / "captions" / "ladder.rst", copy) == {"report"}
    assert "report" in changed_by_an_edit(copy / "figures" / "page_tokens.css", copy)
    assert "recording" not in changed_by_an_edit(copy / "figures" / "page_tokens.css", copy)


def test_the_probe_of_a_diagnosis_and_the_truth_of_the_laboratory_count(copy: Path) -> None:
    # Models with effects of the catalogue are compiled with all that a diagnosis may ask about, the probe included.
    simulating = {"laboratory", "model", "diagnosis", "paper"}
    assert changed_by_an_edit(copy / "dynamics" / "probes" / "probe_force.py", copy) == simulating
    assert changed_by_an_edit(copy / "laboratory" / "paper.yaml", copy) == {"laboratory"}


@pytest.mark.parametrize("name", ["selection", "misfit_tests", "likelihood_ratio", "candidates", "ladder", "diagnose"])
def test_an_edit_of_how_a_diagnosis_is_made_reruns_the_diagnosis_alone(name: str, copy: Path) -> None:
    assert changed_by_an_edit(copy / "diagnosis" / f"{name}.py", copy) == {"diagnosis"}


@pytest.mark.parametrize("name", ["between_text", "diagnosis_text", "law_text", "plan_text", "verdict_text"])
def test_an_edit_of_words_refits_and_tracks_nothing(name: str, copy: Path) -> None:
    changed = changed_by_an_edit(copy / "narrative" / f"{name}.py", copy)
    assert not changed & {"recording", "tracks", "gather", "damping", "model"}


def test_an_edit_of_the_optimiser_redraws_nothing_by_itself(copy: Path) -> None:
    """What reads a fit from its file does not run the code that made it; it runs where the file has changed."""
    assert changed_by_an_edit(copy / "inference" / "optimiser.py", copy) == {"model", "diagnosis"}


def test_the_command_line_and_the_explorer_rerun_nothing(copy: Path) -> None:
    assert not changed_by_an_edit(copy / "cli" / "main.py", copy)
    assert not changed_by_an_edit(copy / "explorer" / "page.py", copy)


def test_what_the_commands_of_the_stages_import_is_part_of_them() -> None:
    """The command of a stage calls modules of the pipeline; those are the stage's entry."""
    tree = ast.parse((PACKAGE / "cli" / "main.py").read_text(encoding="utf-8"))
    commands = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    for stage in set(STAGES) & set(commands):
        used = {
            str(node.module).removeprefix("vinetrack.")
            for node in ast.walk(commands[stage])
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("vinetrack.pipeline")
        }
        assert used <= {*STAGE_MODULES[stage], "pipeline.workflow"}


def test_the_snakefile_asks_for_stages_that_exist_and_for_all_of_them() -> None:
    text = (PACKAGE / "pipeline" / "Snakefile").read_text(encoding="utf-8")
    asked = {part.split('"')[1] for part in text.split("code_hash(")[1:]}
    assert asked == set(STAGES)


def test_the_hashes_of_all_stages_read_every_file_once_and_load_no_library() -> None:
    """In a fresh process: Snakemake waits for them at every start."""
    code = (
        "import sys; from vinetrack.pipeline import stage_code as code; "
        "[code.code_hash(stage) for stage in code.STAGE_MODULES]; "
        "print(code._content.cache_info().misses, {'numpy', 'scipy', 'pandas', 'numba'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    reads, libraries = done.stdout.split(maxsplit=1)
    files = [path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert 100 < int(reads) <= len(files)
    assert libraries.strip() == "set()"
