"""Real balls, cups and tubes: what holds, and whether the next trial of the same rig is where a fit puts it.

    VINETRACK_REAL_DATA=FOLDER python benchmarks/real_recordings.py [cups] [fall] [tubes]

The recordings are those that `docs/real_recordings.md` names; they are not part of the project.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tube.folder import write_folder
from tube.models import models
from tube.recordings import read_recordings

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.ladder import rms_of
from vinetrack.inference.fit_data import pairs_of
from vinetrack.inference.fit_result import Number, TrialFit
from vinetrack.video.track import track_recording

REAL = Path(os.environ.get("VINETRACK_REAL_DATA", ""))
RULER_M_PER_PX = 0.27307e-3


def sized(number: Number) -> str:
    """A number with its error, interval and degrees of freedom."""
    interval = f"[{number.low:.4g}, {number.high:.4g}], {number.dof:.1f} degrees"
    return f"{number.symbol} {number.value:.4g} ± {number.sigma:.2g} {interval}"


def rms_mm(trial: TrialFit) -> float:
    """Root mean square of what is missed from where something moves, mm."""
    return 1e3 * rms_of([trial])


def cups() -> None:
    """Drag of eight stacks: together, each, and each predicted from the other seven."""
    pairs, _ = pairs_of(vt.read_experiment(REAL / "falling_cups"))
    model = vt.make_model(["gravity", "air_drag"])
    print("all cups", sized(vt.fit(model, pairs)["C_D"]))
    for k, pair in enumerate(pairs):
        others = vt.fit(model, pairs[:k] + pairs[k + 1 :])
        missed = rms_mm(vt.predict(others, [pair])[0])
        alone = sized(vt.fit(model, [pair])["C_D"])
        print(
            f"{pair[0].name}: {alone}; predicted from the others {missed:.1f} mm off, noise {1e3 * others.noise_m:.1f}"
        )


def fall() -> None:
    """A steel ball beside a ruler: g, and what a diagnosis says of the scale."""
    trial = Trial(
        name="ball", video=REAL / "freefall_1000fps" / "freefall.mp4", capture_fps=1000.0, m_per_px=RULER_M_PER_PX,
        diameter_m=12.7e-3, payload_kg=8.4e-3, pressure_Pa=0.0, yield_pressure_Pa=0.0, travel_ratio=1,
    )  # fmt: skip
    pairs = [(trial, track_recording(trial).track)]
    model = vt.make_model(["gravity"])
    print(sized(vt.fit(model, pairs, free=("g",))["g"]))
    print(vt.diagnose(pairs, model=model, ladder=False, advice=False).explanation)


def tubes() -> None:
    """Eq. (2) fitted to one trial of a tube, the other trial of that tube predicted; then both fitted."""
    recordings = read_recordings(REAL / "everting_tube") + read_recordings(REAL / "everting_tube_repeats")
    tube_of = {one.name: one.tube for one in recordings}
    model = models()["Eq. (2)"]
    with tempfile.TemporaryDirectory() as scratch:
        pairs, _ = pairs_of(vt.read_experiment(write_folder(recordings, Path(scratch) / "tubes")))
    for tube in sorted(set(tube_of.values())):
        both = [pair for pair in pairs if tube_of[pair[0].name] == tube]
        for k, pair in enumerate(both):
            fit = vt.fit(model, [pair])
            said = ", ".join(sized(number) for number in fit.numbers)
            missed = rms_mm(vt.predict(fit, [both[1 - k]])[0])
            print(f"{pair[0].name}: {rms_mm(fit.trials[0]):.0f} mm off, the other trial {missed:.0f} mm; {said}")
        print(f"tube {tube}, both: {', '.join(sized(number) for number in vt.fit(model, both).numbers)}")


if __name__ == "__main__":
    for name in sys.argv[1:] or ("cups", "fall", "tubes"):
        {"cups": cups, "fall": fall, "tubes": tubes}[name]()
