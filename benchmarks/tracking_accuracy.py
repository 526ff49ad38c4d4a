"""How far tracked positions are from the truth, recording by recording.

    python benchmarks/tracking_accuracy.py [--set demo|hard|plain|bent|all] [--seeds score|tune] [--keep DIR]

Sets: `demo` like the shipped demonstration, `hard` one recording of each harder preset of the virtual laboratory at a
camera's bit rate, `plain` drawn by other code (tests/helpers/plain_scene.py), `bent` tubes that grow along curves,
drawn by the same: along a curve drawn by a hand that is 3 px off, along the curve that is found, and along
the straight axis that was found before curves were, on the same clips. Its truth is the arc length of the tip, its bias
the distance of the tip's place along the tracked axis; constants of curves were tuned on seeds 1-4 of it, its tables
are of seeds 601 and up. Constants of the tracker were tuned on
seeds 1-9; seeds 101-108, 151-158 and 301-308 were looked at along the way; the tables that count are of seeds 401 and
up, which no constant has seen.

SD: of tracked minus true position over moving frames, bias its mean (an origin is free in every analysis; the shape
of the tip decides it); stated: root mean square of the stated errors, noise and slow part together; pull: SD over
stated. Lost: moving frames without a usable position. `white` is the part of the SD that differs from frame to frame,
by the median fourth difference of the errors, `slow` what is left of the SD, and beside each what was stated of it;
these four are of frames more than START_PX of growth beyond the start, where no door hides the tip.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.laboratory.campaigns import render_recording
from vinetrack.laboratory.render import Truth
from vinetrack.laboratory.scene import Scene, Tube, preset
from vinetrack.video import track
from vinetrack.video.axis import Axis, axis_through, find_axis
from vinetrack.video.frames import RecordingError, inspect_recording, read_frames
from vinetrack.video.track import Tracking, track_frames

CAPTURE_FPS = 1069.0
HARD = (
    "door", "wobble", "flicker", "low_contrast", "dark_tube", "half_frame_exposure", "contrast_reversal", "shake",
    "reflections", "noisy", "strong_tail", "diagonal", "downward", "payload", "light_stream", "twelve_bit", "colour",
)  # fmt: skip
BODIES = ("falling_ball", "dark_ball")
START_PX = 60.0
"""Growth within which a door or the mouth may hide the tip: what noise and slow part are is asked beyond it."""
FEWEST = 10
"""Frames beyond it, at least, that tell noise from slow error."""


@dataclass(frozen=True)
class Row:
    """One recording's numbers, px."""

    name: str
    n_moving: int
    lost: int
    sd: float
    bias: float
    stated: float
    ms_per_frame: float
    white: float = np.nan
    white_stated: float = np.nan
    slow: float = np.nan
    slow_stated: float = np.nan
    note: str = ""

    @property
    def pull(self) -> float:
        """SD over the stated error."""
        return self.sd / self.stated


def approach(speed_m_s: float, rise_s: float, release_s: float, length_m: float):
    """Exponential approach to a steady speed, a dead stop at `length_m`."""

    def position_m(time_s: np.ndarray) -> np.ndarray:
        t = np.clip(np.asarray(time_s, float) - release_s, 0, None)
        return np.minimum(speed_m_s * (t - rise_s * (1 - np.exp(-t / rise_s))), length_m)

    return position_m


def free_fall(release_s: float):
    """Falling from rest."""
    return lambda time_s: 0.5 * 9.81 * np.clip(np.asarray(time_s, float) - release_s, 0, None) ** 2


def film(scene: Scene, name: str, seed: int, folder: Path, speed_m_s: float) -> tuple[Path, Truth]:
    """Render one recording into `folder`, or find it there."""
    rng = np.random.default_rng([seed, 77])
    release = (rng.integers(12, 30) + rng.uniform()) / CAPTURE_FPS
    if name in BODIES:
        motion, n_frames = free_fall(release), 250
    else:
        subject = scene.subject
        assert isinstance(subject, Tube)
        motion = approach(speed_m_s, 0.008, release, subject.length_m)
        n_frames = int((release + subject.length_m / speed_m_s + 0.02) * CAPTURE_FPS) + 4
    path = folder / f"{name}_{seed}.{'mkv' if scene.encoding.codec == 'ffv1' else 'mp4'}"
    truth_path = folder / "truth" / f"{path.stem}.npz"
    if path.exists() and truth_path.exists():
        return path, _stored(truth_path)
    truth = render_recording(
        scene, motion, n_frames=n_frames, capture_fps=CAPTURE_FPS, out_path=path, seed=seed,
    )  # fmt: skip
    truth_path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(truth_path, **vars(truth))
    return path, truth


def _stored(path: Path) -> Truth:
    with np.load(path) as data:
        return Truth(**{key: (data[key] if data[key].ndim else data[key].item()) for key in data.files})


def measure(name: str, path: Path, truth: Truth, travel_ratio: float) -> tuple[Row, Tracking | None]:
    """Track and compare."""
    trial = Trial(
        name=name, video=path, capture_fps=CAPTURE_FPS, exposure_s=truth.exposure_s, m_per_px=1.0,
        travel_ratio=travel_ratio,
    )  # fmt: skip
    moving = np.diff(truth.lead_px, append=truth.lead_px[-1]) > 0.05
    moving &= truth.in_frame & np.isfinite(truth.lead_px)
    start = time.perf_counter()
    try:
        frames = read_frames(inspect_recording(path))
        decoded = time.perf_counter()
        tracking = track_frames(frames, trial, CAPTURE_FPS)
    except RecordingError as error:
        return Row(name, int(moving.sum()), int(moving.sum()), np.nan, np.nan, np.nan, np.nan, note=str(error)), None
    spent = (time.perf_counter() - decoded) / len(frames) * 1e3
    del start
    along = along_axis(truth, tracking)
    return compare(name, tracking, along, moving, spent), tracking


def along_axis(truth: Truth, tracking: Tracking) -> np.ndarray:
    """True edge along the tracked axis, freed of the camera's shake, which the places of the tip have."""
    tips = np.column_stack([truth.tip_x_px, truth.tip_y_px])
    seen = np.flatnonzero(np.isfinite(tips).all(axis=1) & np.isfinite(truth.lead_px) & truth.in_frame)
    heading = tips[seen[-1]] - tips[seen[0]]
    along = truth.lead_px * (heading @ tracking.axis.direction) / np.hypot(*heading)
    return along + np.median((tips[seen] - tracking.axis.from_px) @ tracking.axis.direction - along[seen])


def compare(name: str, tracking: Tracking, along_px: np.ndarray, moving: np.ndarray, spent: float) -> Row:
    """Numbers of one track against the true edge along its axis."""
    track = tracking.track
    used = moving & track.usable
    error = track.edge_px[used] - along_px[used]
    noise, slow = track.lead_position_sigma_m[used], track.lead_position_systematic_m[used]
    stated = float(np.sqrt(np.nanmean(noise**2 + slow**2)))
    lost = int((moving & ~track.usable).sum())
    row = Row(name, int(moving.sum()), lost, float(error.std()), float(error.mean()), stated, spent)
    clear = track.edge_px[used] - track.edge_px[used][0] > START_PX
    if clear.sum() < FEWEST:
        return row
    differences = np.convolve(error[clear], (1, -4, 6, -4, 1), "valid")
    white = 1.4826 * float(np.median(np.abs(differences))) / np.sqrt(70)
    return replace(
        row,
        white=white,
        white_stated=float(np.median(noise[clear])),
        slow=float(np.sqrt(max(error[clear].var() - white**2, 0.0))),
        slow_stated=float(np.sqrt(np.mean(slow[clear] ** 2))),
    )


def show(rows: list[Row]) -> None:
    """Print the table and its medians."""
    heads = ("moving", "lost", "SD", "bias", "stated", "pull", "white", "stated", "slow", "stated", "ms/frame")
    print(f"{'recording':28s}" + "".join(f"{head:>9s}" for head in heads))
    for r in rows:
        numbers = f"{r.sd:9.3f}{r.bias:+9.3f}{r.stated:9.3f}{r.pull:9.2f}{r.white:9.3f}"
        numbers += f"{r.white_stated:9.3f}{r.slow:9.3f}{r.slow_stated:9.3f}{r.ms_per_frame:9.2f}"
        print(f"{r.name:28s}{r.n_moving:9d}{r.lost:9d}{numbers} {r.note}", flush=True)
    sd = np.array([r.sd for r in rows])
    within = np.mean([1 / 1.5 <= r.pull <= 1.5 for r in rows])
    lost, moving = sum(r.lost for r in rows), sum(r.n_moving for r in rows)
    print(
        f"median SD {np.nanmedian(sd):.3f} px, worst {np.nanmax(sd):.3f}; lost {lost} of {moving} moving frames; ",
        end="",
    )
    print(f"stated errors within a factor 1.5: {within:.0%}", flush=True)
    for part in ("white", "slow"):
        true, stated = (np.array([getattr(r, name) for r in rows]) for name in (part, f"{part}_stated"))
        ratio = true[true > 0] / stated[true > 0]
        rms = np.sqrt(np.nanmean(true**2) / np.nanmean(stated**2))
        print(
            f"{part}: true over stated error, median {np.nanmedian(ratio):.2f}, root mean squares {rms:.2f}, within a"
            f" factor 1.5: {np.nanmean((ratio > 1 / 1.5) & (ratio < 1.5)):.0%}"
        )
    print(flush=True)


def demo_rows(seeds: list[int], folder: Path) -> list[Row]:
    """Recordings like the demonstration's: two diameters, several speeds."""
    rows = []
    for i, seed in enumerate(seeds):
        diameter, length = ((0.012, 0.14), (0.024, 0.20))[i % 2]
        scene = preset("demo")
        scene = replace(scene, subject=replace(scene.subject, diameter_m=diameter, length_m=length))
        speed = (3.0, 5.0, 8.0, 12.0)[(i // 2) % 4]
        name = f"demo_{diameter * 1e3:.0f}mm_{speed:.0f}m_s"
        rows.append(measure(f"{name}_{seed}", *film(scene, name, seed, folder, speed), 2.0)[0])
    return rows


def hard_rows(seeds: list[int], folder: Path, names: tuple[str, ...] = HARD + BODIES) -> list[Row]:
    """One recording of every harder preset and seed."""
    rows = []
    for name in names:
        for seed in seeds:
            path, truth = film(preset(name), name, seed, folder, 6.0)
            rows.append(measure(f"{name}_{seed}", path, truth, 1.0 if name in BODIES else 2.0)[0])
    return rows


HARDER: dict[str, dict] = {
    "plain": {},
    "door": {"door": True},
    "flicker": {"flicker": 0.05},
    "shake": {"shake": 1.2},
    "wobble": {"wobble": 3.0},
    "dark": {"film": 20.0},
    "low_contrast": {"film": 95.0, "wall_sd": 4.0, "tail_sd": 3.0},
    "half_exposure": {"speed": 40.0, "exposure": 0.5, "rise_frames": 4.0},
    "payload": {"payload": True, "door": True},
    "slow": {"speed": 3.0, "rise_frames": 30.0},
    "creeps_on": {"slows_frames": 60.0},
    "reversal": {"gradient": 110.0, "film": 130.0},
    "oblique": {"angle_deg": 12.0, "from_px": (30.0, 45.0), "end_px": 700.0},
    "leftward": {"angle_deg": 180.0, "from_px": (920.0, 120.0)},
    "no_rest": {"rest_frames": 0, "start_px": 80.0},
    "flat_tip": {"tip_depth": 0.0},
    "round_tip": {"tip_depth": 28.0},
    "strong_tail": {"tail_sd": 30.0},
}
"""Changes to the plan of a plain scene that make recordings harder, by name."""


def plain_rows(seeds: list[int], folder: Path) -> list[Row]:
    """Recordings drawn by other code, H.264 at a camera's rate."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
    from plain_scene import Plan, plain_scene, write_video

    rows = []
    for name, changes in HARDER.items():
        for seed in seeds:
            plan = replace(Plan(seed=seed), **changes)
            scene = plain_scene(plan)
            path = write_video(folder / f"plain_{name}_{seed}.mp4", scene.frames, bit_rate=15_000_000)
            direction = np.array([np.cos(np.radians(plan.angle_deg)), np.sin(np.radians(plan.angle_deg))])
            tips = np.asarray(plan.from_px) + scene.edge_px[:, None] * direction
            n = len(scene.frames)
            truth = Truth(
                np.arange(n) / CAPTURE_FPS, scene.edge_px, scene.edge_px, tips[:, 0], tips[:, 1],
                np.ones(n, bool), 0.0, plan.exposure / CAPTURE_FPS,
            )  # fmt: skip
            rows.append(measure(f"plain_{name}_{seed}", path, truth, 2.0)[0])
    return rows


def bent_rows(seeds: list[int], folder: Path) -> dict[str, list[Row]]:
    """Tubes that grow along curves, H.264 at a camera's rate: by a drawn axis, a found one, and a straight one."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
    from plain_scene import BENDS, BENT, plain_scene, write_video

    rows: dict[str, list[Row]] = {"curve drawn": [], "curve found": [], "straight axis found": []}
    for name, changes in BENDS.items():
        for seed in seeds:
            scene = plain_scene(replace(BENT, seed=seed, **changes))
            path = write_video(folder / f"bent_{name}_{seed}.mp4", scene.frames, bit_rate=15_000_000)
            hand = scene.places(np.linspace(8.0, scene.arc_px[-1] - 8.0, 6))
            drawn = axis_through(hand + np.random.default_rng([seed, 5]).normal(0, 3.0, hand.shape))
            for way, of_way in rows.items():
                row = bent_row(f"{name}_{seed}", path, scene, drawn if way == "curve drawn" else None, "curve" in way)
                of_way.append(row)
    return rows


def bent_row(name: str, path: Path, scene, drawn: Axis | None, curves: bool) -> Row:
    """Numbers of one clip; without `curves` the axis is sought among straight lines alone."""
    trial = Trial(
        name=name, video=path, capture_fps=CAPTURE_FPS, exposure_s=scene.plan.exposure / CAPTURE_FPS, m_per_px=1.0
    )
    moving = int(scene.moving.sum())
    frames = read_frames(inspect_recording(path))
    start = time.perf_counter()
    search = track.find_growth_axis if curves else find_axis
    try:
        with mock.patch.object(track, "find_growth_axis", search):
            tracking = track_frames(frames, trial, CAPTURE_FPS, drawn)
    except RecordingError as error:
        return Row(name, moving, moving, np.nan, np.nan, np.nan, np.nan, note=str(error))
    spent = (time.perf_counter() - start) / len(frames) * 1e3
    row = compare(name, tracking, scene.edge_px, scene.moving, spent)
    used = scene.moving & tracking.track.usable
    axis, places = tracking.axis, scene.places(scene.edge_px[used])
    along = axis.along_and_across(places)[0] if axis.bends else (places - axis.from_px) @ axis.direction
    return replace(row, bias=float(np.mean(tracking.track.edge_px[used] - along)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="all", choices=["demo", "hard", "plain", "bent", "all"])
    parser.add_argument("--seeds", default="score", choices=["score", "tune"])
    parser.add_argument("--only", default="", help="comma-separated presets of the set `hard`")
    parser.add_argument("--each", type=int, default=2, help="recordings of each harder preset")
    parser.add_argument("--keep", type=Path, help="folder for the rendered recordings, to use them again")
    chosen = parser.parse_args()
    first = 401 if chosen.seeds == "score" else 1
    with tempfile.TemporaryDirectory() as scratch:
        folder = chosen.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        if chosen.set in ("demo", "all"):
            show(demo_rows(list(range(first, first + 8)), folder))
        if chosen.set in ("hard", "all"):
            names = tuple(chosen.only.split(",")) if chosen.only else HARD + BODIES
            show(hard_rows(list(range(first, first + chosen.each)), folder, names))
        if chosen.set in ("plain", "all"):
            show(plain_rows(list(range(first, first + chosen.each)), folder))
        if chosen.set in ("bent", "all"):
            first = 601 if chosen.seeds == "score" else 1
            for way, rows in bent_rows(list(range(first, first + chosen.each)), folder).items():
                print(f"\nBent paths, {way}")
                show(rows)


if __name__ == "__main__":
    main()
