"""How readable is the package, in numbers: size, documentation, sources of its numbers, names, imports.

    python benchmarks/house.py [--list] [PACKAGE ...]

`--list` names every place that breaks a rule; PACKAGE restricts the list to packages such as `video`.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

import house_rules as rules

PACKAGE = Path(__file__).resolve().parents[1] / "vinetrack"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", help="packages whose places are listed; all where none is named")
    parser.add_argument("--list", action="store_true", help="name every place")
    given = parser.parse_args()
    files = rules.sources(PACKAGE)
    lines = [len(path.read_text(encoding="utf-8").splitlines()) for path in files]
    public = list(rules.public_functions(PACKAGE))
    numbers = list(rules.module_numbers(PACKAGE))
    broken: dict[str, Sequence[object]] = {
        "public functions without Parameters or Returns": rules.undocumented(PACKAGE),
        "module-level numbers without a source": rules.numbers_without_source(PACKAGE),
        "names that say nothing": rules.vague_names(PACKAGE),
        "private names imported across packages": rules.private_imports(PACKAGE),
        "module names used twice": rules.repeated_modules(PACKAGE),
        "public class names used twice": rules.repeated_classes(PACKAGE),
    }
    chamber = [path for path in files if "chamber_l" in path.read_text(encoding="utf-8")]
    print(f"files {len(files)}, lines {sum(lines)}, median {statistics.median(lines):g}, longest {max(lines)}")
    print(f"public functions with arguments {len(public)}; module-level numbers {len(numbers)}")
    print(f"files that the column chamber_l touches {len(chamber)}")
    for rule, places in broken.items():
        print(f"{rule}: {len(places)}")
        shown = [str(place) for place in places if not given.packages or str(place).split("/")[0] in given.packages]
        if given.list:
            print("".join(f"    {place}\n" for place in shown), end="")


if __name__ == "__main__":
    main()
