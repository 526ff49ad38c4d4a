"""What a run need not make twice: tracks in pixels and figures of trials, kept in the results by their inputs.

Snakemake deletes the outputs of a job before it runs it again; what is kept lies beside them, in a folder that it does
not know. A file that is replaced, or another version of the program, has another key; what no run asks for in a month
is dropped.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.experiment.settings import FigureSettings
    from vinetrack.video.track import Tracking

PACKAGE = Path(__file__).parents[1]
TRACKER_LIBRARIES = ("numpy", "scipy", "numba", "av", "opencv-python-headless", "scikit-image")
SCALARS = (
    "blur_px", "exposure_frames", "tube_width_px", "tube_width_sigma_px", "seen_exposure_frames", "fast_px_per_frame",
)  # fmt: skip


@lru_cache(maxsize=2)
def code_hash(*rooms: str) -> str:
    """Hash of the code of some rooms of the package, or of all of it."""
    digest = hashlib.sha256()
    for path in sorted(path for room in rooms or (".",) for path in (PACKAGE / room).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def identity(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, size and time of modification of a file and of those that share its name, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else path.parent.glob(f"{path.stem}.*")
    stats = [(file.name, file.stat()) for file in sorted({path, *files}) if file.is_file()]
    return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)


class Kept:
    """The kept files of a results folder; `tracked` is the key of the last track that was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / ".kept"
        self.tracked = ""

    def track(self, inputs: tuple[object, ...], make: Callable[[], Tracking]) -> Tracking:
        """The tracking in pixels of a recording (the first input is its path), kept or made."""
        film, *others = inputs
        assert isinstance(film, Path)
        libraries = [version(name) for name in TRACKER_LIBRARIES]
        # ("core", "tracks", "video"): rooms whose code a track in pixels depends on
        self.tracked = _key(code_hash(*("core", "tracks", "video")), libraries, film.resolve(), identity(film), others)
        path = self.folder / f"{self.tracked}.npz"
        if not (data := _read(path)):
            data = packed(make())
            write_bytes(path, data)
        return unpacked(data)

    def figure(
        self,
        inputs: tuple[object, ...],
        path: Callable[[str], Path],
        settings: FigureSettings,
        draw: Callable[[], Figure],
    ) -> None:
        """Write a figure in every format, kept for these inputs or drawn; `path` gives the path for a suffix."""
        key = _key(code_hash(), settings.dpi, inputs)
        places: dict[str, Path] = {form: self.folder / f"{key}.{form}" for form in settings.formats}
        found = {form: _read(place) for form, place in places.items()}
        if missing := [form for form, data in found.items() if not data]:
            from vinetrack.figures.style import render

            made = render(draw(), missing, settings.dpi)
            for form in missing:
                write_bytes(places[form], made[form])
            found.update(made)
        for form, data in found.items():
            write_bytes(path(f".{form}"), data)

    def forget(self) -> None:
        """Drop what no run has asked for in a long time."""
        for path in self.folder.glob("*"):
            # 30 * 86400.0: time after which what nobody asks for is dropped (chosen)
            if path.stat().st_mtime < time.time() - (30 * 86400.0):
                path.unlink(missing_ok=True)


def _key(*inputs: object) -> str:
    return hashlib.sha256(repr(inputs).encode()).hexdigest()[:32]


def _read(path: Path) -> bytes:
    """Content of a kept file, which counts as asked for now; empty where there is none."""
    try:
        os.utime(path, (time.time(), time.time()))
        return path.read_bytes()
    except FileNotFoundError:
        return b""


def packed(tracking: Tracking) -> bytes:
    """A tracking in pixels as a file of arrays without pickled objects."""
    import numpy as np

    from vinetrack.video.curved_axis import axis_entry

    track, ending = tracking.track, tracking.ending
    text = {
        **{name: getattr(tracking, name) for name in SCALARS},
        "axis": axis_entry(tracking.axis) | {"width_px": tracking.axis.width_px},
        "notes": track.notes,
        "ending": vars(ending),
        "shown": [frame for frame, _ in tracking.pictures],
    }
    file = io.BytesIO()
    np.savez_compressed(
        file, text=np.array(json.dumps(text)), time_s=track.time_s, edge_px=track.edge_px, flag=track.flag,
        sigma_px=track.lead_position_sigma_m, systematic_px=np.asarray(track.lead_position_systematic_m),
        kymograph=tracking.kymograph, shake_px=tracking.shake_px, strip_frames=tracking.strip_rows,
        pictures=np.stack([picture for _, picture in tracking.pictures]),
    )  # fmt: skip
    return file.getvalue()


def unpacked(data: bytes) -> Tracking:
    """Read what `packed` wrote."""
    import numpy as np

    from vinetrack.core.records import Track
    from vinetrack.video.curved_axis import axis_from_entry
    from vinetrack.video.point_quality import Ending
    from vinetrack.video.track import Tracking

    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        text: dict[str, Any] = json.loads(str(arrays["text"]))
        track = Track(
            arrays["time_s"], np.full(len(arrays["time_s"]), np.nan), arrays["sigma_px"], arrays["flag"],
            arrays["edge_px"], notes=tuple(text["notes"]), lead_position_systematic_m=arrays["systematic_px"],
        )  # fmt: skip
        ending = Ending(**text["ending"])
        return Tracking(
            track=track, axis=axis_from_entry(text["axis"]), kymograph=arrays["kymograph"],
            pictures=tuple(zip(text["shown"], arrays["pictures"], strict=True)), shake_px=arrays["shake_px"],
            strip_frames=arrays["strip_frames"], ending=replace(ending, remarks=tuple(ending.remarks)),
            **{name: text[name] for name in SCALARS},
        )  # fmt: skip
