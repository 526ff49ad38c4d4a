"""Width and growth of tubes as a recording shows them, over what they are: what `check` compares with the sheet.

    python benchmarks/seen_sizes.py [--seeds tune|score] [--each N] [--keep DIR]

One row a recording of the virtual laboratory, two sizes like the demonstration's and every harder preset. Ratios are
seen over true. Allowances in `vinetrack.video.survey` were set on seeds 20900 and up (tune).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from tracking_accuracy import CAPTURE_FPS, HARD, film

from vinetrack.core.records import Trial
from vinetrack.laboratory.scene import Scene, Tube, preset
from vinetrack.video.frames import RecordingError
from vinetrack.video.track import track_recording

FIRST = {"tune": 20900, "score": 30900}


def scenes() -> dict[str, Scene]:
    """The demonstration's scene with its two tubes, and every harder preset."""
    found = {}
    for diameter_mm, length_mm in ((12, 140), (24, 200)):
        demo = preset("demo")
        assert isinstance(demo.subject, Tube)
        tube = replace(demo.subject, diameter_m=diameter_mm / 1e3, length_m=length_mm / 1e3)
        found[f"demo_{diameter_mm}"] = replace(demo, subject=tube)
    return found | {name: preset(name) for name in HARD}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", choices=FIRST, default="score")
    parser.add_argument("--each", type=int, default=1, help="recordings of each scene")
    parser.add_argument("--keep", type=Path, help="folder for the rendered recordings, to use them again")
    chosen = parser.parse_args()
    print(f"{'recording':32s}{'width':>12s}{'growth':>12s}")
    ratios = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = chosen.keep or Path(scratch)
        for name, scene in scenes().items():
            for seed in range(FIRST[chosen.seeds], FIRST[chosen.seeds] + chosen.each):
                path, _ = film(scene, name, seed, folder, (3.0, 6.0)[seed % 2])
                ratios.append(row(f"{name}_{seed}", path, scene))
    print(f"{'within':32s}", *(f"{np.nanmin(r):.3f}-{np.nanmax(r):.3f}" for r in np.array(ratios).T))


def row(name: str, path: Path, scene: Scene) -> list[float]:
    """Print and return the two ratios of one recording, NaN where a size is not seen."""
    tube = scene.subject
    assert isinstance(tube, Tube)
    m_per_px = scene.camera.m_per_px
    trial = Trial(name=name, video=path, capture_fps=CAPTURE_FPS, m_per_px=m_per_px)
    try:
        tracking = track_recording(trial)
        y = tracking.track.lead_position_m[tracking.track.usable]
        tracked = tracking.tube_width_px * m_per_px / tube.diameter_m, float(np.ptp(y)) / tube.length_m
    except RecordingError as error:
        print(f"{name:32s} {error}")
        tracked = np.nan, np.nan
    print(f"{name:32s}{tracked[0]:12.3f}{tracked[1]:12.3f}", flush=True)
    return list(tracked)


if __name__ == "__main__":
    main()
