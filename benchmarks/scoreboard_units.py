"""What the scoreboard asks: groups of units of work, each of which gives one or more answers as flat rows.

Wherever it can, a unit goes through what the package promises to keep: `vinetrack.diagnose` and `vinetrack.fit` of a
folder, the command line, the files of a results folder. The rest is asked through the other benchmarks' functions.
"""

from __future__ import annotations

import ast
import json
import os
import random
import re
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from hidden.kinds import kinds
from hidden.laboratory_rows import ROWS
from numba.core import event
from tracking_accuracy import BODIES, HARD

Row = dict[str, object]
HERE = Path(__file__).resolve().parent
REAL = os.environ.get("VINETRACK_REAL_DATA", "")
MANY_TRACKS = 100


class Compiling(event.Listener):
    """Processor seconds that this process has spent on compiling, which a later run does not spend again."""

    depth, begun_s, spent_s = 0, 0.0, 0.0

    def on_start(self, event: object) -> None:  # noqa: ARG002, D102
        if self.depth == 0:
            self.begun_s = time.process_time()
        self.depth += 1

    def on_end(self, event: object) -> None:  # noqa: ARG002, D102
        self.depth -= 1
        if self.depth == 0:
            self.spent_s += time.process_time() - self.begun_s


COMPILING = Compiling()
event.register("numba:compile", COMPILING)


def processor_s() -> float:
    """Processor seconds of this process and its children so far, without those of compiling."""
    return sum(os.times()[:4]) - COMPILING.spent_s


def yardstick_s() -> float:
    """Processor seconds of a fixed piece of work, which tell how fast the machine is at the moment."""
    spent = []
    for _ in range(3):
        begun, square = time.process_time(), np.eye(60) + 0.01
        for k in range(1500):
            square = square @ square if k % 20 else np.eye(60) + 0.01 / (k + 1)
            square /= np.abs(square).max()
        spent.append(time.process_time() - begun)
    return float(np.median(spent))


def diagnosed(kind: str, seed: int, folder: Path, known: Sequence[float] | None) -> list[Row]:
    """`vinetrack.diagnose` of one campaign's folder, judged; `known` is how visible its truth is, if that is known."""
    from hidden import make, tables, write_folder
    from hidden.questions import _visibility, identity
    from hidden.verdicts import Answer

    import vinetrack as vt

    campaign = make(kind, seed)
    write_folder(campaign, folder / "campaign")
    begun = processor_s()
    said = vt.diagnose(folder / "campaign")
    row: Row = {"diagnosis_s": processor_s() - begun}
    content = json.loads(json.dumps(said.to_json(), default=float))
    answer, truth = Answer.of(content), campaign.truth
    asked = identity(campaign) | {
        "verdict": answer.verdict,
        "effects": "+".join(answer.effects),
        "answer": "|".join(answer.answer_set),
        "final": answer.final_verdict,
        "final_answer": "|".join(answer.final_answer),
    }
    judged = tables.judged(pd.DataFrame([asked])).iloc[0]
    found, hidden = tables._found(judged), set(filter(None, str(asked["hidden"]).split("+")))
    last = answer.final_answer if len(answer.final_answer) == 1 else ()
    if known is None:
        known = list(_visibility(said.fits[0], said.fits[-1], truth).values())
    row |= {
        name: asked[name] for name in ("hidden", "verdict", "effects", "answer", "final", "final_answer", "n_trials")
    }
    row |= {name: bool(judged[name]) for name in ("called", "right", "wrong_name", "fault_as_physics")}
    row |= {"set_size": len(answer.answer_set), "all": hidden <= found, "sigma": known[0], "sigma_second": known[1]}
    row["none_invented"] = {*answer.effects, *last} <= hidden
    stated = {f"{n['parameter']} {n['vine']}".strip(): n for n in answer.parameters}
    numbers = stated | {key: n for key, n in answer.numbers.items() if key not in stated}
    row["numbers"] = {key: [n["value"], n["low_95"], n["high_95"]] for key, n in numbers.items()}
    intervals = {key: (low, high) for key, (_, low, high) in row["numbers"].items() if pd.notna([low, high]).all()}
    true = {key: size for key, size in dict(truth.values).items() if key in intervals}
    row["sizes"] = {key: bool(intervals[key][0] <= size <= intervals[key][1]) for key, size in true.items()}
    return [row]


def learned(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """What is learned of a force that is in no list: over which variables, and how well."""
    import learned_laws

    return [learned_laws.ask(seed, with_law=False)]


def laboratory(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """`vinetrack.diagnose` of the folder of one kind of laboratory."""
    import laboratories

    row = laboratories.ask((name, seed, laboratories.TRIALS, None))
    if row.get("failed"):
        raise RuntimeError(row["failed"])
    covered, intervals = row.pop("covered"), row.pop("intervals")
    return [row | {"held": [k < covered for k in range(intervals)]}]


def coverage(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """A fit with chamber, of 2 to 7 trials, or of 2 to 7 drops of a ball: whether its intervals hold the truth."""
    import fit_coverage

    ask = {"fit": fit_coverage.measure, "few": fit_coverage.measure_few, "drops": fit_coverage.measure_drops}
    return [ask[name](seed)]


def tracking(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """Recordings whose truth is known, tracked."""
    import tracking_accuracy

    if name == "long door":
        import long_doors

        line, refused, askew, wrong = long_doors.judged(seed, folder)
        return [{"clips": _checksum(folder), "line": line, "refused": refused, "askew": askew, "wrong": wrong}]
    if name == "demonstration":
        import demonstration

        experiment, truths = demonstration.film_demonstration(folder, 1)
        return [vars(row) for row in demonstration.measure_all(experiment, truths)]
    if name == "demo-like":
        rows = tracking_accuracy.demo_rows(list(range(seed, seed + 8)), folder)
    elif name == "other renderer":
        rows = tracking_accuracy.plain_rows([seed], folder)
    elif name == "bent":
        rows = tracking_accuracy.bent_rows([seed], folder)["curve found"]
    else:
        rows = tracking_accuracy.hard_rows([seed], folder, (name.removeprefix("hard "),))
    clips = _checksum(folder)
    return [vars(row) | {"clips": clips, "ms_per_frame": 0.0, "pull": row.pull} for row in rows]


def _checksum(folder: Path) -> int:
    """Of all recordings in a folder: where it differs, the clips are others, and so are the tracks."""
    return zlib.crc32(b"".join(path.read_bytes() for path in sorted(folder.glob("*.m*"))))


def real(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """Recordings made by others: a number with its interval, where it has one."""
    import real_recordings

    import vinetrack as vt

    if name == "ball":
        trial = real_recordings.Trial(
            name="ball", video=Path(REAL) / "freefall_1000fps" / "freefall.mp4", capture_fps=1000.0, travel_ratio=1,
            m_per_px=real_recordings.RULER_M_PER_PX, diameter_m=12.7e-3, payload_kg=8.4e-3, pressure_Pa=0.0,
            yield_pressure_Pa=0.0,
        )  # fmt: skip
        pairs = [(trial, real_recordings.track_recording(trial).track)]
        number = vt.fit(vt.make_model(["gravity"]), pairs, free=("g",))["g"]
        return [{"value": number.value, "low": number.low, "high": number.high}]
    if name == "cups":
        number = vt.fit(vt.make_model(["gravity", "air_drag"]), Path(REAL) / "falling_cups")["C_D"]
        said = vt.diagnose(Path(REAL) / "falling_cups")
        named = "|".join(said.answer_set)
        return [
            {"value": number.value, "low": number.low, "high": number.high, "verdict": said.verdict, "named": named}
        ]
    if name == "vine":
        trial = real_recordings.Trial(name="vine", video=Path(REAL) / "vine_growth", capture_fps=30.0, m_per_px=1.0)
        tracking = real_recordings.track_recording(trial)
        x = tracking.axis.points(tracking.track.edge_px)[:, 0]
        free = np.flatnonzero(tracking.track.usable & (x > 55) & (x < 200))
        return [{"value": np.polyfit(free, x[free], 1)[0], "points": len(free)}]
    from tube.folder import write_folder
    from tube.models import fit_tubes, models
    from tube.recordings import read_recordings

    recordings = [
        one for part in ("everting_tube", "everting_tube_repeats") for one in read_recordings(Path(REAL) / part)
    ]
    experiment = vt.read_experiment(write_folder(recordings, folder / "tubes"))
    outcome = fit_tubes("Eq. (2)", models()["Eq. (2)"], experiment, recordings)
    return [{"value": 1e3 * outcome.rms_m, "left_out_mm": 1e3 * outcome.left_out_m}]


def whole_run(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """Processor seconds of the demonstration, filmed and run, and of a campaign of many tracks, stage by stage."""
    if name == "many tracks":
        import many_trials

        used, verdict = many_trials.of_tracks("null:white", seed, MANY_TRACKS, folder)
        return [{"all_s": used.processor_s, "peak_mb": used.peak_mb, "verdict": verdict}]
    import demonstration
    from hidden.verdicts import Answer

    begun = processor_s()
    demonstration.film_demonstration(folder / "demo", 1)
    filmed = processor_s()
    command = [Path(sys.executable).with_name("vinetrack"), "run", folder / "demo", "--cores", "1"]
    subprocess.run([*command, "--results", folder / "results"], check=True, capture_output=True)
    row = {"film_s": filmed - begun, "run_s": processor_s() - filmed}
    said = json.loads(next((folder / "results").rglob("diagnosis.json")).read_text(encoding="utf-8"))
    answer = Answer.of(said)
    numbers = {
        f"{n['parameter']} {n['vine']}".strip(): [n["value"], n["low_95"], n["high_95"]] for n in answer.parameters
    }
    return [row | {"verdict": answer.verdict, "answer": "|".join(answer.answer_set), "numbers": numbers}]


def mutations(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """Deliberate faults of the core, a sample of `mutations.yaml`: whether a test notices."""
    command = [sys.executable, HERE / "mutations.py", "--sample", name.split()[0], "--seed", str(seed)]
    done = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=False)
    found = re.findall(r"^(\S+) +(.*): (caught|SURVIVES)", done.stdout, re.MULTILINE)
    if not found:
        raise RuntimeError(f"{done.stdout}{done.stderr}"[-300:])
    return [{"file": file, "what": what, "caught": outcome == "caught"} for file, what, outcome in found]


def house(name: str, seed: int, folder: Path, known: object) -> list[Row]:  # noqa: ARG001
    """Size of the code base: lines, files, module-level constants, words of documentation."""
    root = HERE.parent
    package = sorted((root / "vinetrack").rglob("*.py"))
    tests = sorted((root / "tests").rglob("*.py"))
    other = [path for path in (root / "vinetrack").rglob("*") if path.suffix in (".js", ".css", ".html", ".rst")]
    constants = 0
    for path in package:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = (
                node.targets
                if isinstance(node, ast.Assign)
                else [node.target]
                if isinstance(node, ast.AnnAssign)
                else []
            )
            names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
            constants += sum(name.isupper() for name in names)
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    return [
        {
            "package lines": _lines(package),
            "package files": len(package),
            "package constants": constants,
            "package lines of other text": _lines(other),
            "test lines": _lines(tests),
            "test files": len(tests),
            "words of documentation": sum(len(path.read_text(encoding="utf-8").split()) for path in pages),
        }
    ]


def _lines(paths: Sequence[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


@dataclass(frozen=True)
class Group:
    """Units of one sort: of `names`, in this order, the first `quick` are asked every day, the first `whole` in all.

    A name that comes again is asked with the next seed.
    """

    ask: Callable[[str, int, Path, Sequence[float] | None], list[Row]]
    names: Sequence[str]
    quick: int
    whole: int


def _shuffled(names: Sequence[str]) -> list[str]:
    return random.Random(1).sample(list(names), len(names))


CLIPS = (
    *("demonstration", "demo-like", "long door", "long door", "long door"),
    *(f"hard {name}" for name in _shuffled(HARD + BODIES)),
    *("other renderer", "bent"),
    *("long door",) * 9,
)

GROUPS: dict[str, Group] = {
    "size": Group(house, ("code",), 1, 1),
    "tracking": Group(tracking, CLIPS, 11, len(CLIPS)),
    "null": Group(diagnosed, _shuffled(kinds("nulls")), 8, 20),
    "effect": Group(diagnosed, _shuffled(kinds("effects")), 9, 29),
    "pair": Group(diagnosed, _shuffled(kinds("pairs")), 1, 5),
    "outsider": Group(diagnosed, _shuffled(kinds("outsiders")), 1, 4),
    "learned": Group(learned, ("law",) * 6, 0, 3),
    "laboratory": Group(laboratory, _shuffled(ROWS), 14, len(ROWS)),
    "coverage": Group(coverage, ("fit",) * 60, 20, 60),
    "few": Group(coverage, ("few", "drops") * 24, 12, 48),
    "real": Group(real, ("ball", "cups", "vine", "tubes") if REAL else (), 2, 4),
    "triple": Group(diagnosed, _shuffled(kinds("triples")), 0, 2),
    "other": Group(diagnosed, _shuffled(kinds("other")), 0, 3),
    "whole run": Group(whole_run, ("demonstration", "many tracks"), 0, 2),
    "mutations": Group(mutations, ("6 of them",), 0, 1),
}  # fmt: skip
"""In order of importance. Costs in processor seconds on today's code are in `benchmarks/RESULTS.md`."""
