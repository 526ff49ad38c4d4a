"""The source distribution, built, installed in a clean environment, and used from an empty folder.

    python benchmarks/installed_wheel.py [--folder FOLDER] [--python PYTHON]

Builds the sdist of this checkout, compares its files with those that git knows, installs it as `pip install` does,
without any extra, and runs `vinetrack check`, `run`, `diagnose`, `add` and `explore` on eight trials of measured
positions, written out in a folder that holds nothing else. Printed are what failed, and what the environment is made
of. A FOLDER that is named is kept, and the environment in it used again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENT = """
import pandas as pd, pathlib, vinetrack as vt
folder = pathlib.Path("my_experiment"); (folder / "tracks").mkdir(parents=True)
frame = vt.example_tracks(); rows = []
for name, trial in frame.groupby("trial", sort=False):
    file = f"tracks/{name}.csv"
    track = trial[["time_s", "lead_position_m"]].rename(columns={"lead_position_m": "position_m"})
    track.to_csv(folder / file, index=False)
    sheet = trial.iloc[0].drop(["trial", "time_s", "lead_position_m"])
    rows.append({"trial": name, "track": file, **sheet})
pd.DataFrame(rows).to_csv(folder / "trials.csv", index=False)
"""
WRITTEN = (
    "report.html", "provenance.json", "trials.csv", "damping.json", "fit.json", "diagnosis.json", "ladder.csv",
    "figures/model_comparison.svg",
)  # fmt: skip
MIB = 2**20


def ran(command: Sequence[str | Path], folder: Path, expected: int = 0) -> str:
    """What a command printed; raises SystemExit where it ends with another status than `expected`."""
    begun = time.monotonic()
    done = subprocess.run([str(word) for word in command], cwd=folder, capture_output=True, text=True, check=False)
    printed = done.stdout + done.stderr
    name = " ".join(Path(str(word)).name for word in command)[:70]
    print(f"{time.monotonic() - begun:6.1f} s  {name}", flush=True)
    if done.returncode != expected:
        raise SystemExit(f"ended with {done.returncode}, not {expected}:\n{printed[-3000:]}")
    return printed


def environment(python: str, folder: Path, *packages: str) -> Path:
    """The commands of a clean environment."""
    if not (folder / "bin").is_dir():
        ran([python, "-m", "venv", folder], ROOT)
        if packages:
            ran([folder / "bin" / "python", "-m", "pip", "install", "--quiet", *packages], ROOT)
    return folder / "bin"


def built(commands: Path, folder: Path) -> Path:
    """The source distribution, with every file that git knows in it."""
    code = f"import setuptools.build_meta as backend; print(backend.build_sdist({str(folder)!r}))"
    name = ran([commands / "python", "-c", code], ROOT).splitlines()[0]
    archive = max(folder.glob("*.tar.gz"), key=lambda path: path.stat().st_mtime)
    with tarfile.open(archive) as packed:
        held = {member.partition("/")[2] for member in packed.getnames()}
    known = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    missing = [path for path in known if path and path not in held and path != ".gitignore"]
    if missing:
        raise SystemExit(f"{name} lacks {len(missing)} files: {', '.join(missing[:8])}")
    print(f"          {archive.name}: {len(held)} entries, {archive.stat().st_size / MIB:.1f} MiB")
    return archive


def used(commands: Path, folder: Path) -> None:
    """The commands of the README on an experiment in a folder that holds nothing else."""
    ran([commands / "python", "-c", EXPERIMENT], folder)
    vinetrack, results = commands / "vinetrack", folder / "results" / "my_experiment"
    ran([vinetrack, "check", "my_experiment"], folder)
    print(ran([vinetrack, "run", "my_experiment", "--cores", "2"], folder).strip().splitlines()[-1])
    missing = [name for name in WRITTEN if not (results / name).is_file()]
    if missing:
        raise SystemExit(f"the run wrote no {', '.join(missing)}")
    ran([vinetrack, "diagnose", results, "--json", "again.json"], folder)
    ran([vinetrack, "add", "leak", results], folder)
    ran([vinetrack, "effects"], folder)
    said = ran([vinetrack, "explore", results], folder, expected=1)
    if "pip install 'vinetrack[explorer]'" not in said or "Traceback" in said or len(said.strip().splitlines()) > 2:
        raise SystemExit(f"without bokeh `explore` says: {said}")


def sizes(commands: Path) -> None:
    """What the environment is made of, largest first."""
    site = next(commands.parent.glob("lib/python*/site-packages"))
    size: dict[str, int] = {}
    for path in site.rglob("*"):
        if path.is_file() and not path.is_symlink():
            name = path.relative_to(site).parts[0].removesuffix(".libs")
            size[name] = size.get(name, 0) + path.stat().st_size
    total = sum(size.values())
    print(f"\n{total / MIB:.0f} MiB in {site.relative_to(commands.parent)}, of these")
    for name in sorted(size, key=lambda key: -size[key])[:14]:
        print(f"{size[name] / MIB:6.0f}  {name}")


def main() -> None:
    """Build, install, use, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="kept, and its environment used again")
    parser.add_argument("--python", default=sys.executable, help="the Python of the environment")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = wanted.folder.absolute() if wanted.folder else Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        commands = environment(wanted.python, folder / "environment")
        archive = built(environment(wanted.python, folder / "builder", "setuptools>=77"), folder)
        ran([commands / "python", "-m", "pip", "install", "--quiet", "--force-reinstall", "--no-deps", archive], folder)
        ran([commands / "python", "-m", "pip", "install", "--quiet", archive], folder)
        with tempfile.TemporaryDirectory() as empty:
            used(commands, Path(empty))
        sizes(commands)


if __name__ == "__main__":
    main()
