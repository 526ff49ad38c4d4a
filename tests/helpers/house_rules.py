"""Rules of the package that a script can check: names, documentation, sources of numbers, imports.

Every function takes the folder of a package and returns what breaks the rule, so that a test can assert that nothing
does and `benchmarks/house.py` can print how far the package is.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

VAGUE_NAMES = frozenset({"found", "one", "own", "item", "said", "rest", "thing", "doubts", "beliefs", "belief", "lost"})
"""Names that say nothing or mean several things; the glossary in docs/conventions.md has the terms to use."""

SOURCE_WORDS = re.compile(
    r"\b(derived|measured|chosen|published|defined|convention|format|unit|standard|source)\b", re.IGNORECASE
)
"""A number states where it comes from with one of these words, in a comment or in the string below it."""


@dataclass(frozen=True)
class Place:
    """Where a rule is broken: the file, the line, and the name concerned."""

    file: str
    line: int
    name: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.name}"


def sources(package: Path) -> list[Path]:
    """Python files of a package, sorted."""
    return sorted(path for path in package.rglob("*.py") if "__pycache__" not in path.parts)


@cache
def parsed(path: Path) -> ast.Module:
    """Syntax tree of a file, which many rules read."""
    return ast.parse(path.read_text(encoding="utf-8"))


def public_functions(package: Path) -> Iterator[tuple[Path, ast.FunctionDef, str]]:
    """Public module-level functions and public methods of public classes that take arguments, with their names."""
    for path in sources(package):
        for node in parsed(path).body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and _arguments(node):
                yield path, node, node.name
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for method in node.body:
                    if isinstance(method, ast.FunctionDef) and not method.name.startswith("_") and _arguments(method):
                        yield path, method, f"{node.name}.{method.name}"


def _arguments(function: ast.FunctionDef) -> list[str]:
    given = function.args
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls")]


def undocumented(package: Path) -> list[Place]:
    """Public functions whose docstring lacks an argument under Parameters, or Returns where something is returned."""
    places = []
    for path, function, name in public_functions(package):
        if _is_hook(path, package):
            continue
        text = ast.get_docstring(function) or ""
        returns = function.returns is not None and ast.unparse(function.returns) not in ("None", "NoReturn")
        complete = not returns or "Returns\n-" in text or "Yields\n-" in text
        if not complete or not set(_arguments(function)) <= _documented_arguments(text):
            places.append(Place(path.relative_to(package).as_posix(), function.lineno, name))
    return places


def _documented_arguments(docstring: str) -> set[str]:
    """Names at the beginning of the lines of a Parameters section."""
    section = re.search(r"Parameters\n-+\n(.*?)(?=\n\n\w+\n-{3,}|\Z)", docstring, re.DOTALL)
    lines = [line for line in section[1].split("\n") if line and not line.startswith(" ")] if section else []
    return {name.strip().lstrip("*") for line in lines for name in line.split(" : ")[0].split(",")}


def _is_hook(path: Path, package: Path) -> bool:
    """Whether the file is an effect: its functions have the arguments that `effects/_base.py` documents once."""
    return path.parent in (package / "effects", package / "dynamics" / "probes") and not path.stem.startswith("_")


def module_numbers(package: Path) -> Iterator[tuple[Path, ast.stmt, str, bool]]:
    """Module-level constants that hold a number, and whether a source stands with them."""
    for path in sources(package):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        body = parsed(path).body
        for k, node in enumerate(body):
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            value = getattr(node, "value", None)
            if not isinstance(node, ast.Assign | ast.AnnAssign) or target is None or value is None:
                continue
            name = ast.unparse(target)
            if not name.isupper() and not all(part.strip(" _()").isupper() for part in name.split(",")):
                continue
            if not _holds_number(value):
                continue
            above = lines[max(node.lineno - 6, 0) : node.lineno - 1]
            comment = [line for line in above if line.strip().startswith("#")]
            inline = lines[node.lineno - 1 : node.end_lineno]
            after = body[k + 1] if k + 1 < len(body) else None
            below = after.value.value if _is_text(after) else ""  # type: ignore[union-attr]
            words = " ".join([*comment, *(line.split("#", 1)[1] for line in inline if "#" in line), str(below)])
            yield path, node, name, bool(SOURCE_WORDS.search(words))


def _is_text(node: ast.stmt | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _holds_number(value: ast.expr) -> bool:
    """Whether a value is a number, a sum of numbers, or a tuple of them (not a range, an index or a table of words)."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return _holds_number(value.operand)
    if isinstance(value, ast.BinOp):
        return _holds_number(value.left) and _holds_number(value.right)
    return isinstance(value, ast.Tuple) and bool(value.elts) and all(map(_holds_number, value.elts))


def numbers_without_source(package: Path) -> list[Place]:
    """Module-level numbers that state no source."""
    return [
        Place(path.relative_to(package).as_posix(), node.lineno, name)
        for path, node, name, has_source in module_numbers(package)
        if not has_source
    ]


def vague_names(package: Path) -> list[Place]:
    """Arguments, variables, attributes of classes, functions and classes with a name that says nothing."""
    places = []
    for path in sources(package):
        for node in ast.walk(parsed(path)):
            name = None
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            elif isinstance(node, ast.arg):
                name = node.arg
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                name = node.name
            if name in VAGUE_NAMES:
                places.append(Place(path.relative_to(package).as_posix(), getattr(node, "lineno", 0), str(name)))
    return places


def private_imports(package: Path) -> list[Place]:
    """Names beginning with an underscore that a module takes from a module of another package."""
    places = []
    for path in sources(package):
        here = path.relative_to(package).parts[0]
        for node in ast.walk(parsed(path)):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("vinetrack."):
                continue
            if str(node.module).split(".")[1] == here:
                continue
            for alias in node.names:
                hidden = alias.name.startswith("_") and not alias.name.startswith("__")
                if hidden or any(part.startswith("_") for part in str(node.module).split(".")):
                    places.append(
                        Place(path.relative_to(package).as_posix(), node.lineno, f"{node.module}.{alias.name}")
                    )
    return places


def repeated_modules(package: Path) -> list[str]:
    """Names that two modules share."""
    names = Counter(path.stem for path in sources(package) if not path.stem.startswith("__"))
    return sorted(name for name, times in names.items() if times > 1)


def repeated_classes(package: Path) -> list[str]:
    """Names that two public classes of different modules share."""
    names = Counter(
        node.name
        for path in sources(package)
        for node in parsed(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    return sorted(name for name, times in names.items() if times > 1)
