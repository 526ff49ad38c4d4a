"""Simulated campaigns with known ground truth: measured as tracks, or filmed, with a picture of a calibration target.

Every trial has its own stream of random numbers, so that leaving one out does not change the others. A `GroundTruth` is
what is hidden from the analysis: physics, scatter, noise, faults. The true motion of a campaign may be filmed, so that
the results of a tracker can be compared with it; an experiment of tracks is turned into one of recordings with the same
sheet, a camera and a target. Files are H.264 as in cameras, or FFV1 without loss.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.core.tables import replacing, write_bytes, write_csv, write_text
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model, Value, make_model
from vinetrack.dynamics.simulate import simulate, simulate_many
from vinetrack.experiment.folder import REQUIRED_COLUMNS, SHEET, Experiment, read_experiment
from vinetrack.experiment.schema import COLUMNS
from vinetrack.inference.fit_result import DAMPING, EXPONENT
from vinetrack.laboratory.render import FrameRenderer, Motion, Truth, paint_board
from vinetrack.laboratory.scene import PATTERN_PX, Camera, Scene, Target, Tube, preset
from vinetrack.paper import motions
from vinetrack.tracks.position_noise import ar1_noise
from vinetrack.video.track import track_recording


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth of a simulated campaign. `effects` and `values` are the physics. Scatter of B and P is relative,
    between trials; `yield_error_kPa` is the standard deviation of the error of stated yield pressures.
    """

    effects: Sequence[str] = BASE_EFFECTS
    values: Mapping[str, Value] = field(default_factory=dict)
    damping_scatter: float = 0.03
    pressure_scatter: float = 0.01
    yield_error_kPa: float = 0.0
    noise_m: float = 1e-4
    noise_correlation: float = 0.0
    release_frames: Sequence[int] = (15, 40)
    frames_after_end: int = 4
    longest_frames: int = 12_000
    trace_sigma_kPa: float | None = None
    seed: int = 0

    def model(self) -> Model:
        """The true model with its true values."""
        return make_model(self.effects).with_values(self.values)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a ground truth from YAML, whose keys are the fields of `GroundTruth` and `filming`, which is ignored."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return GroundTruth(**{key: content[key] for key in content if key != "filming"})


@dataclass(frozen=True)
class VirtualTrial:
    """One simulated trial as the sheet has it (`stated`) and as it was (`true`), its true `model` with its own B;
    `track` is what is analysed, with arbitrary zeros, the rest the truth, SI, with `release_s` on the track's clock.
    """

    stated: Trial
    true: Trial
    model: Model
    track: Track
    release_s: float
    origin_m: float
    true_lead_position_m: Floats


def grow(trials: Sequence[Trial], truth: GroundTruth) -> list[VirtualTrial]:
    """Simulate and measure trials; the same seed gives the same numbers."""
    model = truth.model()
    draws = [_draw(truth.seed, 0, trial.name) for trial in trials]
    vines = dict.fromkeys(trial.vine for trial in trials)
    errors = {vine: 1e3 * truth.yield_error_kPa * _draw(truth.seed, 1, vine).standard_normal() for vine in vines}
    true, times, release = [], [], []
    theta = np.array([model.parameters_of(trial) for trial in trials])
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        set_Pa = trial.pressure_Pa * (1 + truth.pressure_scatter * draw.standard_normal())
        factor = 1 + truth.damping_scatter * draw.standard_normal()
        true.append(replace(trial, pressure_Pa=set_Pa, yield_pressure_Pa=trial.yield_pressure_Pa + errors[trial.vine]))
        if DAMPING in model.parameter_names:
            theta[i, model.parameter_names.index(DAMPING)] *= factor
        step_s = 1 / trial.capture_fps
        resting = draw.integers(truth.release_frames[0], truth.release_frames[1], endpoint=True)
        release.append(float((resting - 1 + draw.uniform()) * step_s))
        times.append(np.arange(truth.longest_frames, dtype=float) * step_s)
    moved = simulate_many(model, true, [t - t0 for t, t0 in zip(times, release, strict=True)], parameters=theta)
    grown = []
    for i, (trial, draw) in enumerate(zip(trials, draws, strict=True)):
        stop = times[i].size
        if moved[i].status == "ended":
            stop = min(stop, int(np.searchsorted(times[i] - release[i], moved[i].end_time_s)) + truth.frames_after_end)
        own_model = model.with_values(dict(zip(model.parameter_names, theta[i].tolist(), strict=True)))
        origin_m = draw.uniform(-0.05, 0.05)  # a track's zero of position is arbitrary
        noise_m = ar1_noise(stop, truth.noise_m, truth.noise_correlation, draw)
        time_s, lead_m = times[i][:stop], moved[i].lead_position_m[:stop]
        gauge_Pa = None
        if truth.trace_sigma_kPa is not None:
            velocity_m_s = moved[i].lead_velocity_m_s[:stop]
            gauge_Pa = evaluate(own_model, true[i], time_s - release[i], lead_m, velocity_m_s).pressure_Pa
            gauge_Pa = gauge_Pa + 1e3 * truth.trace_sigma_kPa * draw.standard_normal(stop)
        seen_m = origin_m + moved[i].observed_position_m[:stop] + noise_m
        track = plain_track(time_s, seen_m, pressure_Pa=gauge_Pa)
        grown.append(VirtualTrial(trial, true[i], own_model, track, release[i], origin_m, lead_m))
    return grown


def _draw(seed: int, kind: int, name: str) -> np.random.Generator:
    """The random generator of one trial (kind 0) or vine (kind 1), by its name."""
    return np.random.default_rng([seed, kind, zlib.crc32(name.encode())])


def write_tracks(grown: Sequence[VirtualTrial], folder: Path) -> None:
    """Write the track of each trial to `folder/<trial>.csv`."""
    for trial in grown:
        columns = {"time_s": trial.track.time_s.round(9), "position_m": trial.track.lead_position_m.round(8)}
        if trial.track.pressure_Pa is not None:
            columns["pressure_kPa"] = (trial.track.pressure_Pa / 1e3).round(5)
        write_csv(folder / f"{trial.stated.name}.csv", pd.DataFrame(columns))


def write_experiment(grown: Sequence[VirtualTrial], folder: Path, settings: str = "") -> None:
    """Write an experiment folder: sheet, tracks and, where given, the text of `experiment.yaml`; no truth."""
    write_tracks(grown, folder / "tracks")
    columns = ("capture_fps", *REQUIRED_COLUMNS, "payload_g")
    sheet = [
        {"trial": one.stated.name, "track": f"tracks/{one.stated.name}.csv"}
        | {name: round(COLUMNS[name].of_trial(one.stated), 6) for name in columns}
        for one in grown
    ]
    write_csv(folder / SHEET, pd.DataFrame(sheet))
    if settings:
        write_text(folder / "experiment.yaml", settings)


# ------------------------------------------------------------------------------
# Campaigns: vines, pressures, payloads and number of replicates. The published ones are in `data/paper`.


@dataclass(frozen=True)
class Vine:
    """A vine of a campaign, in the units of a trial sheet."""

    diameter_mm: float
    thickness_um: float
    length_mm: float
    yield_pressure_kPa: float = 3.0

    def trial(
        self, name: str, pressure_kPa: float, payload_g: float = 0.0, capture_fps: float = motions.CAPTURE_FPS
    ) -> Trial:
        """Make one trial with this vine."""
        return Trial(
            name=name, capture_fps=capture_fps, payload_kg=payload_g / 1e3,
            diameter_m=self.diameter_mm / 1e3, thickness_m=self.thickness_um / 1e6, length_m=self.length_mm / 1e3,
            pressure_Pa=pressure_kPa * 1e3, pressure_sigma_Pa=10.0 * pressure_kPa,
            yield_pressure_Pa=self.yield_pressure_kPa * 1e3, yield_pressure_sigma_Pa=200.0,
        )  # fmt: skip


def isometric_vine(scale: int) -> Vine:
    """The paper's vine of scale R = 1…4: 50R µm, 6R mm and, isometric with the 280 mm of R = 4, 70R mm."""
    return Vine(6.0 * scale, 50.0 * scale, 70.0 * scale)


def campaign(
    vine: Vine, pressures_kPa: Iterable[float], replicates: int, payload_g: float = 0.0, prefix: str = ""
) -> list[Trial]:
    """Make trials of every pressure, `replicates` times, with one vine and payload."""
    return [
        vine.trial(f"{prefix}{pressure_kPa:g}kPa_{k + 1}".replace(".", "p"), pressure_kPa, payload_g)
        for pressure_kPa in pressures_kPa
        for k in range(replicates)
    ]


def damping_values(trials: Iterable[Trial]) -> dict[str, dict[str, float] | float]:
    """Parameters of isometric vines as `GroundTruth.values` takes them: the printed B by vine, N·(s/m)ⁿ, and n."""
    by_vine = {trial.vine: motions.TABLE_I[round(trial.diameter_m / 6e-3)].B for trial in trials}
    return {DAMPING: by_vine, EXPONENT: motions.PRINTED_EXPONENT}


# ------------------------------------------------------------------------------
# Recordings: rendered frames written to files.


Frame = NDArray[np.uint8 | np.uint16]


def render_recording(
    scene: Scene, motion: Motion, *, n_frames: int, capture_fps: float, out_path: Path, seed: int = 0
) -> Truth:
    """Film `motion` in `scene` and write the recording to `out_path`, completely or not at all."""
    renderer = FrameRenderer(scene, motion, n_frames=n_frames, capture_fps=capture_fps, seed=seed)
    camera, encoding, depth = scene.camera, scene.encoding, scene.sensor.bit_depth
    is_h264 = encoding.codec == "h264"
    pixel_format = "yuv420p" if is_h264 else {8: "gray", 12: "gray12le", 16: "gray16le"}[depth]
    levels = {"low": 16.0, "span": 219.0} if is_h264 else {}
    # The two colour planes at half resolution, constant in time, since film is transparent; even for a grey scene
    height, width = (camera.height_px + 1) // 2, (camera.width_px + 1) // 2
    fade = np.linspace(0, 1, width)[None, :] + 0.2 * np.linspace(0, 1, height)[:, None]
    warm = (12, -8) if scene.sensor.colour else (0, 0)  # a warm wall and bluish film under LED lamps
    chroma = [(128 - change * fade).astype(np.uint8) for change in warm]
    options = {"movflags": "+faststart"} if out_path.suffix.lower() in (".mp4", ".mov") else {}
    with replacing(out_path) as draft, av.open(str(draft), "w", options=options) as container:
        # 60: frames per second that a file of a high-speed camera claims (chosen)
        stream: Any = container.add_stream("libx264" if is_h264 else encoding.codec, rate=Fraction(60))
        stream.width, stream.height, stream.pix_fmt = camera.width_px, camera.height_px, pixel_format
        stream.codec_context.thread_count = 1
        if is_h264:
            rate = {"crf": str(encoding.crf)}
            if encoding.bitrate_Mbit_s is not None:
                rate = dict.fromkeys(("b", "maxrate", "bufsize"), f"{encoding.bitrate_Mbit_s * 1000:.0f}k")
            stream.options = {"preset": "superfast", "bf": "0", "sc_threshold": "0", **rate}
            stream.gop_size = encoding.gop
            stream.codec_context.color_range = 1  # levels of 16…235
        for index in range(n_frames):
            picture: Any = av.VideoFrame(camera.width_px, camera.height_px, pixel_format)
            for plane, values in zip(picture.planes, (renderer.frame(index, **levels), *chroma), strict=False):
                rows = np.frombuffer(plane, values.dtype).reshape(-1, plane.line_size // values.itemsize)
                rows[: values.shape[0], : values.shape[1]] = values
            picture.pts = index
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return renderer.truth(np.arange(n_frames))


# ------------------------------------------------------------------------------
# Pictures of a calibration target.


def render_target(target: Target, scene: Scene, *, seed: int = 0) -> Frame:
    """One picture, (height, width), of a target through the camera of a scene, with its blur and noise; the light rises
    by a quarter across. `scene.camera.plane_from_picture`, times `m_per_px`, says where in the plane a pixel looks.
    """
    bare, camera = replace(scene.backdrop, launcher=False, ruler=False, clutter=False), scene.camera
    scene = replace(scene, backdrop=bare, door=None)
    empty = FrameRenderer(scene, np.zeros_like, n_frames=1, capture_fps=60.0, exposure_s=1e-3, seed=seed)
    board = target.board_squares((camera.plane_from_picture(camera.pixels()) - camera.centre_px) * camera.m_per_px)
    per_square = PATTERN_PX if target.kind == "charuco" else 1
    painted, share = np.zeros_like(empty.still), np.zeros_like(empty.still)
    paint_board(
        board, np.gradient(board, axis=1), np.gradient(board, axis=0), target.pattern(), per_square, target.margin,
        target.black, target.white, painted, share,
    )  # fmt: skip
    painted, share = (np.asarray(cv2.GaussianBlur(part, (0, 0), scene.psf_px), np.float32) for part in (painted, share))
    slope = 1 + 0.25 * (np.linspace(0, 1, camera.width_px, dtype=np.float32)[None, :] - 0.5)
    return empty.expose((empty.still * (1 - share) + painted) * slope, 0)


# ------------------------------------------------------------------------------
# Campaigns before a camera.


@dataclass(frozen=True)
class Filming:
    """How a campaign is filmed: scene preset, camera, exposure as a fraction of the frame interval, and the target."""

    scene: str = "demo"
    camera: Camera = field(default_factory=Camera)
    exposure_fraction: float = 0.1
    target: Target = field(default_factory=Target)


def make_filming(content: dict[str, Any]) -> Filming:
    """Read how trials are filmed from a YAML mapping."""
    parts = {"camera": Camera(**content.get("camera", {})), "target": Target(**content.get("target", {}))}
    return Filming(**(content | parts))


def film(trial: VirtualTrial, filming: Filming, out_path: Path, seed: int = 0) -> Truth:
    """Film one simulated trial, with a tube of the stated size; its truth is returned and not written."""
    stated, scene = trial.stated, preset(filming.scene)
    subject, capture_fps = scene.subject, stated.capture_fps
    if isinstance(subject, Tube):
        payload_m = 0.6 * stated.diameter_m if stated.payload_kg > 0 else 0.0
        subject = replace(subject, diameter_m=stated.diameter_m, length_m=stated.length_m, payload_diameter_m=payload_m)
    scene = replace(scene, subject=subject, camera=filming.camera, exposure_fraction=filming.exposure_fraction)
    n_frames = int(trial.track.time_s.size)
    time_s = np.linspace(0.0, n_frames / capture_fps, 8 * n_frames + 1)  # 8 samples a frame (chosen)
    moved = PchipInterpolator(time_s, simulate(trial.model, trial.true, time_s - trial.release_s).lead_position_m)
    how: dict[str, Any] = {"n_frames": n_frames, "capture_fps": capture_fps, "out_path": out_path, "seed": seed}
    return render_recording(scene, lambda at_s: moved(np.minimum(at_s, time_s[-1])), **how)


def compile_the_tracker() -> None:
    """Film and track a short growth, so that code is compiled while motions are computed: a quarter of a minute."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "growth.mp4")
        render_recording(preset("demo"), lambda at_s: 4.0 * at_s, n_frames=60, capture_fps=1069.0, out_path=path)
        track_recording(Trial(name="growth", video=path, capture_fps=1069.0, diameter_m=0.024, m_per_px=5e-4))


def picture_target(filming: Filming, path: Path, seed: int = 0) -> None:
    """Write a picture of the calibration target in the plane of growth as PNG."""
    picture = render_target(filming.target, replace(preset(filming.scene), camera=filming.camera), seed=seed)
    write_bytes(path, cv2.imencode(".png", picture)[1].tobytes())


def recording_experiment(experiment: Experiment, filming: Filming, folder: Path) -> Experiment:
    """Write sheet and settings of an experiment of recordings; nothing is filmed yet."""
    if experiment.settings.calibration is not None or any(trial.video for trial in experiment.trials):
        raise ValueError(f"{experiment.folder} is an experiment of recordings already")
    if folder.exists() and folder.samefile(experiment.folder):
        raise ValueError(f"{folder} is the experiment itself: name another folder")
    exposures_us = {round(1e6 * filming.exposure_fraction / trial.capture_fps, 3) for trial in experiment.trials}
    if len(exposures_us) != 1:
        raise ValueError("trials have several frame rates, so that no single exposure can be stated")
    target = filming.target
    board = {
        "kind": target.kind,
        "image": "calibration/board.png",
        "squares": list(target.squares),
        "square_mm": round(1e3 * target.square_m, 6),
        "marker_mm": round(1e3 * target.marker_m, 6),
        "dictionary": target.dictionary,
    }
    settings = {"exposure_us": exposures_us.pop(), "calibration": board}
    sheet = pd.read_csv(experiment.folder / SHEET, dtype=str, keep_default_na=False)
    sheet = sheet.rename(columns={"track": "video"}).assign(video=[f"videos/{trial}.mp4" for trial in sheet["trial"]])
    write_csv(folder / SHEET, sheet)
    path = experiment.folder / "experiment.yaml"
    shared = path.read_text(encoding="utf-8") if path.exists() else ""
    write_text(folder / "experiment.yaml", shared + yaml.safe_dump(settings, sort_keys=False))
    return read_experiment(folder, strict=True)
