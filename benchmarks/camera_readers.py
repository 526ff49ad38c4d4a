"""Grey values, rate and exposure of Phantom and Photron files beside other readers.

    python benchmarks/camera_readers.py --other PYTHON

PYTHON is the interpreter of an environment of its own that holds pims, pycine and pyMRAW. Files are written by
`tests/helpers/camera_files.py`, which knows nothing of the package, with noise of seed 20960. Values are counted that
differ, rates and exposures printed side by side.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from camera_files import write_cine, write_mraw

from vinetrack.video.frames import PHANTOM_TABLE, read_frames

SEED = 20960

OTHER = """
import json, sys, warnings
import numpy as np
warnings.simplefilter("ignore")
def cine(name):
    from pims.cine import Cine
    film = Cine(name)
    frames = np.stack([np.asarray(film[i]) for i in range(len(film))])
    return frames, film.frame_rate, film.tagged_blocks["exposure_only"][0]
def pycine(name):
    from pycine.file import read_header
    from pycine.linLUT import linLUT
    setup = read_header(name)["setup"]
    return np.asarray(linLUT), setup.FrameRate, setup.ShutterNs * 1e-9
def mraw(name):
    import pyMRAW
    frames, facts = pyMRAW.load_video(name)
    return np.asarray(frames), facts["Record Rate(fps)"], facts["Shutter Speed(s)"]
out = {}
for name, reader in json.loads(sys.argv[1]):
    frames, rate, exposure = {"pims": cine, "pycine": pycine, "pyMRAW": mraw}[reader](name)
    np.save(name + "." + reader + ".npy", frames)
    out[name + reader] = [float(rate), float(exposure)]
print(json.dumps(out))
"""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--other", required=True, help="interpreter with pims, pycine and pyMRAW")
    other = parser.parse_args().other
    rng = np.random.default_rng(SEED)
    shape = (20, 120, 160)
    eight = rng.integers(0, 256, shape).astype(np.uint8)
    ten, twelve = (rng.integers(0, top, shape).astype(np.uint16) for top in (1024, 4096))
    clock = {"times_s": np.arange(20) / 5000 + 0.3, "exposures_s": np.full(20, 4e-5), "setup_bytes": 12432}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        asked = []
        for name, frames, options in (
            ("8 bit", eight, {"real_bits": 8}), ("16 bit", twelve, {}), ("packed 10 bit", ten, {"pack": 256}),
            ("packed 12 bit", twelve, {"pack": 1024, "annotation": b"12345678"}),
        ):  # fmt: skip
            path = write_cine(folder / f"{name}.cine", frames, **clock, **options)
            asked += [(str(path), "pims"), (str(path), "pycine")]
        for bits, frames in ((8, eight), (12, twelve), (16, twelve)):
            for side in (".cih", ".cihx"):
                path = write_mraw(folder / f"{bits} bit{side[1:]}.mraw", frames, bits, side, shutter="0.000025")
                asked.append((str(path.with_suffix(side)), "pyMRAW"))
        done = subprocess.run([other, "-c", OTHER, json.dumps(asked)], capture_output=True, text=True, check=True)
        told = json.loads(done.stdout.splitlines()[-1])
        print(
            f"{'file':24} {'reader':8} {'values':>8} {'differ':>7} "
            f"{'rate, ours':>12} {'its':>8} {'µs, ours':>10} {'its':>8}"
        )
        for path, reader in asked:
            ours = read_frames(path)
            values, its = ours.luma, np.load(f"{path}.{reader}.npy")
            if reader == "pycine":
                values = PHANTOM_TABLE
            elif "packed 10" in path:
                its = PHANTOM_TABLE[its]  # pims leaves them as they are packed
            rate, exposure_s = told[path + reader]
            print(
                f"{Path(path).name:24} {reader:8} {values.size:8} {int((values != its).sum()):7} "
                f"{ours.recording.capture_fps:12g} {rate:8g} "
                f"{1e6 * ours.recording.exposure_s:10.5g} {1e6 * exposure_s:8.5g}"
            )


if __name__ == "__main__":
    main()
