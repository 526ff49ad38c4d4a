"""Which code a stage of the workflow runs, read from the imports, so that an edit reruns what it makes stale.

Starting from the modules that a stage's command calls, every import of a vinetrack module is followed, those inside
functions included; imports for the type checker alone are not. A module also depends on the files beside it that it
names in a string: effects (`"*.py"`), templates, style sheets, yaml files.

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

_INTAKE = ("experiment.folder", "experiment.settings")
STAGE_MODULES = {
    "laboratory": ("laboratory.__main__",),
    "recording": ("pipeline.recordings_stage", *_INTAKE),
    "tracks": ("pipeline.tracks_stage", *_INTAKE),
    "gather": ("pipeline.tracks_stage", *_INTAKE),
    "damping": ("pipeline.damping_stage", *_INTAKE),
    "model": ("pipeline.model_stage", *_INTAKE),
    "diagnosis": ("pipeline.diagnosis_stage", *_INTAKE),
    "figures": ("pipeline.figures_stage", *_INTAKE),
    "paper": ("pipeline.paper_stage", *_INTAKE),
    "overlays": ("pipeline.overlays_stage", *_INTAKE),
    "report": ("pipeline.report_stage", *_INTAKE),
}
"""Modules that the command of each stage calls. The command line itself is not among them: it only hands options on,
and an edit of a help text should not rerun an analysis."""

_TYPE_CHECKING_BLOCK = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t]+[^\n]*)?\n)+", re.MULTILINE)
_FROM = re.compile(r"^[ \t]*from (vinetrack[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(r"^[ \t]*import (vinetrack[\w.]*)", re.MULTILINE)
_RESOURCES = re.compile(r"""\bfiles\("(vinetrack[\w.]*)"\)""")
_STRING = re.compile(r'"([^"\n]+)"')
_HOLE = re.compile(r"\{[^}]*\}")


def code_hash(stage: str, package: Path = PACKAGE) -> str:
    """Hash of the code that a stage runs; as a `params:` of a rule it makes Snakemake rerun what an edit made stale.

    Parameters
    ----------
    stage : a key of `STAGE_MODULES`.
    package : folder of the package, by default the one that is running.

    Returns
    -------
    16 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for path in stage_files(stage, package):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + _content(path))
    return digest.hexdigest()[:16]


def stage_files(stage: str, package: Path = PACKAGE) -> list[Path]:
    """Every file of the package that a stage runs or reads, sorted; see `code_hash` for the parameters.

    Parameters
    ----------
    stage : str
        A key of `STAGE_MODULES`.
    package : Path
        Folder of the package, by default the one that is running.

    Returns
    -------
    list of Path
    """
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
    """Files of the package that one file imports or names; each file is scanned once in a process."""
    if path.suffix != ".py":
        return ()
    text = _content(path).decode("utf-8")
    names = imported_names(text)
    modules = [file for name in names for file in _module_files(name, package)]
    resources = [file for name in _RESOURCES.findall(text) for file in _data_files(_folder(name, package))]
    return tuple(dict.fromkeys([*modules, *resources, *_named_beside(path, text)]))


def imported_names(text: str) -> set[str]:
    r"""Dotted names below `vinetrack` that a source imports at run time: modules, and what is taken from them.

    `from vinetrack.core import published` gives `core` and `core.published`: only the files tell which is a module.

    Parameters
    ----------
    text : str
        Source code.

    Returns
    -------
    set of str
        Dotted names without `vinetrack.`.

    Examples
    --------
    >>> sorted(imported_names("from vinetrack.core import published\nimport numpy"))
    ['core', 'core.published']
    """
    text = _TYPE_CHECKING_BLOCK.sub("", text)
    names = set(_IMPORT.findall(text))
    for module, imported in _FROM.findall(text):
        names.add(module)
        names.update(f"{module}.{name}" for name in re.findall(r"(\w+)(?: as \w+)?", imported))
    return {name.removeprefix("vinetrack").lstrip(".") for name in names}


@lru_cache(maxsize=4096)
def _module_files(name: str, package: Path) -> tuple[Path, ...]:
    """The file of a module and the `__init__.py` that Python runs before it; none where the name is no module.

    The package's own `__init__.py` counts only where something is taken from it: it loads nothing by itself.
    """
    if not name:
        return (package / "__init__.py",)
    folder = package.joinpath(*name.split("."))
    file = folder.with_suffix(".py")
    if file.is_file():
        before = file.with_name("__init__.py")
        return (file, before) if file.parent != package and before.is_file() else (file,)
    return (folder / "__init__.py",) if (folder / "__init__.py").is_file() else ()


def _folder(name: str, package: Path) -> Path:
    return package.joinpath(*name.split(".")[1:])


def _named_beside(path: Path, text: str) -> list[Path]:
    """Files beside a module that it names in a string; all of a folder. `*` and `{…}` stand for anything."""
    neighbours = {entry.name: entry for entry in _entries(path.parent)}
    named: list[Path] = []
    for string in dict.fromkeys(_STRING.findall(text)):
        if string in neighbours:
            named.append(neighbours[string])
        elif "." in string and ("*" in string or "{" in string):
            pattern = _HOLE.sub("*", string)
            # Without an ending of its own (`*.*`, `*`) a pattern is a path elsewhere, not a choice of these files.
            if re.search(r"\.\w+$", pattern):
                named += [neighbours[name] for name in fnmatch.filter(neighbours, pattern)]
    return [file for entry in named for file in (_data_files(entry) if entry.is_dir() else [entry])]


@lru_cache(maxsize=256)
def _entries(folder: Path) -> tuple[Path, ...]:
    """Files of a folder, and those of its folders that are no packages."""
    entries = [entry for entry in sorted(folder.iterdir()) if entry.name != "__pycache__"]
    return tuple(entry for entry in entries if entry.is_file() or not (entry / "__init__.py").exists())


def _data_files(folder: Path) -> list[Path]:
    """All files under a folder that is no package, or those of a package that are not modules."""
    is_package = (folder / "__init__.py").exists()
    files: Iterable[Path] = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return [path for path in files if not (is_package and path.suffix == ".py")]


@lru_cache(maxsize=1024)
def _content(path: Path) -> bytes:
    return path.read_bytes()


def forget_scans() -> None:
    """Read all files anew at the next call: for a process in which the sources change."""
    for cached in (_files_used, _module_files, _entries, _content):
        cached.cache_clear()
