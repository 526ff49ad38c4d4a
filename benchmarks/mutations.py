"""Deliberate faults of the core, one at a time, and those of them that no test notices.

    python benchmarks/mutations.py [--only WORD ...] [--sample N [--seed S]] [--list]

Each mutation of `mutations.yaml` replaces one passage of one file in a copy of the package, and the tests named beside
it run against the copy. Printed are the survivors, those that no test noticed, and the share that was caught. Text that
is no longer found, or found twice, is an error: the list is then mended. So is a test that fails without any mutation.
A change that only moves results within their stated errors is no fault, and does not belong there.

Which test caught a fault is kept in `mutations_caught.json`; the next time that test is asked first, the others only if
it no longer notices.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ("tests", "benchmarks", "config", "data", "docs", "Snakefile", "pyproject.toml", "README.md")
"""What the tests read beside the package; linked to, not copied."""


@dataclass(frozen=True)
class Mutation:
    """One fault: `old` becomes `new` in `file` of the package; `tests` are those that should notice."""

    what: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


CAUGHT = Path(__file__).with_name("mutations_caught.json")


def caught_last() -> dict[str, str]:
    """By file and description of a fault, the test that caught it last."""
    return dict(json.loads(CAUGHT.read_text(encoding="utf-8"))) if CAUGHT.exists() else {}


def listed() -> list[Mutation]:
    """All mutations of the list."""
    files = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    return [
        Mutation(fault["what"], entry["file"], fault["old"], fault["new"], tuple(entry["tests"]))
        for entry in files
        for fault in entry["faults"]
    ]


def altered(mutation: Mutation) -> str:
    """The text of the file with the fault in it.

    Raises ValueError where the old text does not stand there exactly once.
    """
    text = (ROOT / "vinetrack" / mutation.file).read_text(encoding="utf-8")
    if (count := text.count(mutation.old)) != 1:
        raise ValueError(f"{mutation.file} holds {count} times, not once: {mutation.old!r} ({mutation.what})")
    changed = text.replace(mutation.old, mutation.new)
    if mutation.file.endswith(".py"):
        compile(changed, mutation.file, "exec")
    return changed


def copied(folder: Path) -> None:
    """The package, and links to what its tests read, in a folder of their own."""
    shutil.copytree(ROOT / "vinetrack", folder / "vinetrack")
    for name in BESIDE:
        (folder / name).symlink_to(ROOT / name)


def noticed(folder: Path, tests: tuple[str, ...], compiled: bool) -> tuple[bool, str]:
    """Whether any of these tests fails on the copy, and the end of what was printed."""
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    with tempfile.TemporaryDirectory() as cache:
        if compiled:  # what was compiled of the sound file does not know that it has changed
            environment["NUMBA_CACHE_DIR"] = cache
        run = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not real", *tests]
        done = subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode in (4, 5) and "::" in tests[0]:
        return False, ""  # a test of this name is no longer there
    if done.returncode not in (0, 1):
        raise RuntimeError(f"the tests did not run: {done.stdout[-2000:]}{done.stderr[-1000:]}")
    return done.returncode == 1, done.stdout[-1500:]


def main() -> None:
    """Try the mutations one after the other; exit 1 if any survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[""], help="those with one of these words in file or description")
    parser.add_argument("--sample", type=int, help="only so many, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawing")
    parser.add_argument("--list", action="store_true", help="only check that every old text is there")
    wanted = parser.parse_args()
    chosen = [one for one in listed() if any(word in f"{one.file} {one.what}" for word in wanted.only)]
    if wanted.sample is not None and wanted.sample < len(chosen):
        drawn = set(random.Random(wanted.seed).sample(range(len(chosen)), wanted.sample))
        chosen = [one for i, one in enumerate(chosen) if i in drawn]
    texts, stale = [], []
    for one in chosen:
        try:
            texts.append(altered(one))
        except ValueError as error:
            stale.append(str(error))
    if stale:
        raise SystemExit("\n".join(stale))
    if wanted.list:
        for one in chosen:
            print(f"{one.file:32s} {one.what}")
        print(f"{len(chosen)} mutations, every old text found once")
        return
    survivors, known = [], caught_last()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copied(folder)
        fails, printed = noticed(folder, tuple(sorted({test for one in chosen for test in one.tests})), compiled=False)
        if fails:
            raise SystemExit(f"A test fails without any mutation:\n{printed}")
        for one, text in zip(chosen, texts, strict=True):
            path = folder / "vinetrack" / one.file
            sound, stamp = path.read_text(encoding="utf-8"), path.stat()
            path.write_text(text, encoding="utf-8")
            begun = time.monotonic()
            key, compiled = f"{one.file}: {one.what}", bool(re.search(r"\bnjit\b|\bcompiled\b", sound))
            for tests in filter(all, ((known.get(key),), one.tests)):
                caught, printed = noticed(folder, tests, compiled)
                if caught:
                    break
            path.write_text(sound, encoding="utf-8")
            os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
            by = re.search(r"^(?:FAILED|ERROR) (\S+)", printed, re.MULTILINE)
            if by:
                known = caught_last() | {key: by[1]}
                CAUGHT.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            seconds = time.monotonic() - begun
            outcome = f"caught by {by[1]}" if by else "caught" if caught else "SURVIVES"
            print(f"{one.file:32s} {one.what}: {outcome} ({seconds:.0f} s)", flush=True)
            survivors += [] if caught else [one]
    print(f"\n{len(chosen) - len(survivors)} of {len(chosen)} caught")
    for one in survivors:
        print(f"survives: {one.file}: {one.what}")
    raise SystemExit(1 if survivors else 0)


if __name__ == "__main__":
    main()
