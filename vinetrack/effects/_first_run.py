"""First run of a user's own effects: each is a program, so it is announced before it runs, and remembered by hash."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from pathlib import Path

CATALOGUE = Path(__file__).resolve().parents[1]  # Files below this folder belong to the package and are not announced
# Environment variable; with the value `known`, own effects that never ran here are refused
POLICY = "VINETRACK_OWN_EFFECTS"


def memory_file() -> Path:
    """Return the file that lists the user's effects that have run."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "vinetrack" / "own_effects.json"


def first_run(path: Path) -> str:
    """Announce an own effect that has not run before on standard error, and remember it."""
    path = path.resolve()
    if path.is_relative_to(CATALOGUE) or not path.is_file():
        return ""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    known = _known()
    if digest in known:
        return ""
    if os.environ.get(POLICY) == "known":
        return f"has never run here (sha256 {digest}), and {POLICY} is `known`: read it, then run it once without that"
    print(f"{path} (sha256 {digest}) runs for the first time: it is a program with your rights.", file=sys.stderr)
    remember(path)
    return ""


def remember(path: Path) -> None:
    """Remember an own effect as known, because it was announced or written by this program."""
    from vinetrack.core.tables import write_json

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with contextlib.suppress(OSError):
        write_json(memory_file(), _known() | {digest: str(path.resolve())})


def _known() -> dict[str, str]:
    """Effects that have run, by the SHA-256 of their files; empty where the list cannot be read."""
    try:
        known = json.loads(memory_file().read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError):
        return {}
    return known if isinstance(known, dict) else {}
