"""Provenance of a result: versions of program and libraries, settings, and the hashes of all input files."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import vinetrack


def describe_run(
    experiment: Path, inputs: Iterable[Path], settings: dict[str, Any], model: Iterable[str]
) -> dict[str, Any]:
    """Return the content of `provenance.json`: versions, platform, SHA-256 of every input, model, settings."""
    libraries = {name: name for name in ("numpy", "scipy", "pandas", "numba", "av", "matplotlib")}
    libraries |= {"opencv-python-headless": "cv2", "scikit-image": "skimage"}
    return {
        "vinetrack": vinetrack.__version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "libraries": {name: import_module(module).__version__ for name, module in libraries.items()},
        "experiment": experiment.absolute().as_posix(),
        "inputs": {
            (path.relative_to(experiment) if path.is_relative_to(experiment) else path).as_posix(): _hash_file(path)
            for path in inputs
        },
        "model": list(model),
        "settings": settings,
    }


def _hash_file(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of a folder of frames; else "missing" or "unreadable"."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        lines = [f"{file.relative_to(path).as_posix()} {_hash_file(file)}\n" for file in files]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if not path.is_file():
        return "missing"
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "unreadable"
