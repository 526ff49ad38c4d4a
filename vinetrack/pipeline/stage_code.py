"""The code that a stage of the workflow depends on, found from its imports, so that an edit reruns outdated stages.

Starting from the modules that a stage's command calls, every import of a vinetrack module is followed, including those
inside functions but not those for the type checker only. A module also depends on files beside it that it names in a
string: effects (`"*.py"`), templates, style sheets, YAML files.

The sources are scanned with regular expressions: parsing 300 files takes 1.3 s, scanning those of all stages 0.15 s,
and Snakemake waits for it at every start. A test compares the scan with the syntax trees of all files.
"""

from __future__ import annotations

import fnmatch
import hashlib
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

_EXPERIMENT_READERS = ("experiment.folder", "experiment.settings")
# Modules that the command of each stage calls
STAGE_MODULES = {
    "laboratory": ("laboratory.__main__",),
    "recording": ("pipeline.recordings_stage", *_EXPERIMENT_READERS),
    "tracks": ("pipeline.tracks_stage", *_EXPERIMENT_READERS),
    "gather": ("pipeline.tracks_stage", *_EXPERIMENT_READERS),
    "damping": ("pipeline.damping_stage", *_EXPERIMENT_READERS),
    "model": ("pipeline.model_stage", *_EXPERIMENT_READERS),
    "diagnosis": ("pipeline.diagnosis_stage", *_EXPERIMENT_READERS),
    "figures": ("pipeline.figures_stage", *_EXPERIMENT_READERS),
    "paper": ("pipeline.paper_stage", *_EXPERIMENT_READERS),
    "overlays": ("pipeline.overlays_stage", *_EXPERIMENT_READERS),
    "report": ("pipeline.report_stage", *_EXPERIMENT_READERS),
}

_TYPE_CHECKING_BLOCK = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t]+[^\n]*)?\n)+", re.MULTILINE)
_FROM = re.compile(r"^[ \t]*from (vinetrack[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(r"^[ \t]*import (vinetrack[\w.]*)", re.MULTILINE)
_RESOURCES = re.compile(r"""\bfiles\("(vinetrack[\w.]*)"\)""")
_STRING = re.compile(r'"([^"\n]+)"')
_PLACEHOLDER = re.compile(r"\{[^}]*\}")


def code_hash(stage: str, package: Path = PACKAGE) -> str:
    """Return a hash of the code of a stage, which as a parameter of its rule makes Snakemake rerun it after an edit."""
    digest = hashlib.sha256()
    for path in stage_files(stage, package):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + _content(path))
    return digest.hexdigest()[:16]


def stage_files(stage: str, package: Path = PACKAGE) -> list[Path]:
    """Return all files of the package that a stage runs or reads, sorted."""
    waiting = [path for name in STAGE_MODULES[stage] for path in _module_files(name, package)]
    reached: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in reached:
            reached.add(path)
            waiting.extend(_files_used(path, package))
    return sorted(reached)


@lru_cache(maxsize=1024)
def _files_used(path: Path, package: Path) -> tuple[Path, ...]:
    """Files of the package that one file imports or names; each file is scanned once per process."""
    if path.suffix != ".py":
        return ()
    text = _content(path).decode("utf-8")
    names = imported_names(text)
    modules = [file for name in names for file in _module_files(name, package)]
    resources = [file for name in _RESOURCES.findall(text) for file in _data_files(_folder(name, package))]
    return tuple(dict.fromkeys([*modules, *resources, *_named_beside(path, text)]))


def imported_names(text: str) -> set[str]:
    r"""Return the dotted names below `vinetrack` that a source imports at run time: modules and their members. `from
    vinetrack.core import published` gives `core` and `core.published`: the text alone does not tell whether `published`
    is a module.
    """
    text = _TYPE_CHECKING_BLOCK.sub("", text)
    names = set(_IMPORT.findall(text))
    for module, imported in _FROM.findall(text):
        names.add(module)
        names.update(f"{module}.{name}" for name in re.findall(r"(\w+)(?: as \w+)?", imported))
    return {name.removeprefix("vinetrack").lstrip(".") for name in names}


@lru_cache(maxsize=4096)
def _module_files(name: str, package: Path) -> tuple[Path, ...]:
    """File of a module and the `__init__.py` that Python runs before it; empty if the name is not a module. The
    `__init__.py` of vinetrack itself counts only if something is imported from it: it loads nothing.
    """
    if not name:
        return (package / "__init__.py",)
    folder = package.joinpath(*name.split("."))
    file = folder.with_suffix(".py")
    if file.is_file():
        init_file = file.with_name("__init__.py")
        return (file, init_file) if file.parent != package and init_file.is_file() else (file,)
    return (folder / "__init__.py",) if (folder / "__init__.py").is_file() else ()


def _folder(name: str, package: Path) -> Path:
    return package.joinpath(*name.split(".")[1:])


def _named_beside(path: Path, text: str) -> list[Path]:
    """Files beside a module, or folders of them, that it names in a string; `*` and `{…}` match any text."""
    neighbours = {entry.name: entry for entry in _entries(path.parent)}
    named: list[Path] = []
    for string in dict.fromkeys(_STRING.findall(text)):
        if string in neighbours:
            named.append(neighbours[string])
        elif "." in string and ("*" in string or "{" in string):
            pattern = _PLACEHOLDER.sub("*", string)
            # A pattern without a definite suffix (`*.*`, `*`) refers to files elsewhere.
            if re.search(r"\.\w+$", pattern):
                named += [neighbours[name] for name in fnmatch.filter(neighbours, pattern)]
    return [file for entry in named for file in (_data_files(entry) if entry.is_dir() else [entry])]


@lru_cache(maxsize=256)
def _entries(folder: Path) -> tuple[Path, ...]:
    """Files of a folder, and its subfolders that are not packages."""
    entries = [entry for entry in sorted(folder.iterdir()) if entry.name != "__pycache__"]
    return tuple(entry for entry in entries if entry.is_file() or not (entry / "__init__.py").exists())


def _data_files(folder: Path) -> list[Path]:
    """All files below a folder; of a package, only those that are not modules."""
    is_package = (folder / "__init__.py").exists()
    files: Iterable[Path] = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return [path for path in files if not (is_package and path.suffix == ".py")]


@lru_cache(maxsize=1024)
def _content(path: Path) -> bytes:
    return path.read_bytes()


def forget_scans() -> None:
    """Clear all caches, for a process in which the sources change."""
    for cached in (_files_used, _module_files, _entries, _content):
        cached.cache_clear()
