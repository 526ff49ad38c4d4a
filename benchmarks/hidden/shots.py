"""A laboratory: its trials in the order they were made, its camera, and what both leave on disk.

Shares nothing with the package but the laws of physics: a trial is followed by `hidden.motion` (or `hidden.slack`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from hidden.designs import Setting, Wants, design
from hidden.motion import Floats, Physics, Tube, follow
from hidden.slack import follow_slack

Draw = np.random.Generator

MOST_FRAMES = 1500
FEWEST_MOVING = 12
FINER = 16
"""Steps in a frame where a picture is not taken all at once."""


@dataclass(frozen=True)
class Shot:
    """One trial: `setting` is what the sheet says, `tube` and `physics` what is true, SI.

    `valve_s` is the time in which a valve opens, after `valve_law`: "exponential" with this time constant and the power
    `valve_power` of the time in the exponent, or "smooth" over this time. `specimen` says which tube of its vine, `day`
    when. `scale` and `clock` are relative errors of this recording, beside those of the camera.
    """

    setting: Setting
    tube: Tube
    physics: Physics
    specimen: str = "a"
    day: str = "1"
    valve_s: float = 0.0
    valve_law: str = "exponential"
    valve_power: float = 1.0
    slack: bool = False
    scale: float = 0.0
    clock: float = 0.0


@dataclass(frozen=True)
class Camera:
    """What becomes of positions on their way to the file.

    Noise is `noise_m` with correlation `rho` from frame to frame, and white noise of `blur_s` times the speed of the
    edge. `wild_share` of the points are off by `wild_m`, evenly drawn. The lens adds k₃ u³ + k₅ u⁵, u from
    `lens_centre_m`; a camera that is tilted shows y (1 + `bow_per_m` y). The rows of the picture are read
    `row_delay_s_m` later by the metre; `scale` and `clock` are relative errors. `trace_late_s`: by how much the clock
    of a recorded pressure is ahead (NaN: none is recorded); its gauge, of time constant `gauge_lag_s`, has noise
    `trace_sigma_Pa`, of correlation `gauge_rho` from frame to frame, is read `gauge_Hz` times a second (NaN: at every
    frame) in multiples of `gauge_digit_Pa`, and the file joined by lines in between or, where it `gauge_holds`,
    repeated. The file has multiples of `trace_digit_Pa`. Positions are `smoothed` over so many frames by polynomials of
    `smoothed_degree`, 0 a moving average; at either end by as many frames as there are, as spreadsheets do. One frame
    in `kept_every` is looked at, and its position written in multiples of `digit_m`.
    """

    noise_m: float
    rho: float = 0.0
    blur_s: float = 0.0
    wild_share: float = 0.0
    wild_m: tuple[float, float] = (0.0, 0.0)
    lens_k3: float = 0.0
    lens_k5: float = 0.0
    lens_centre_m: float = 0.0
    bow_per_m: float = 0.0
    row_delay_s_m: float = 0.0
    scale: float = 0.0
    clock: float = 0.0
    trace_late_s: float = math.nan
    gauge_lag_s: float = 0.0
    trace_sigma_Pa: float = 50.0
    gauge_Hz: float = math.nan
    gauge_rho: float = 0.0
    gauge_digit_Pa: float = 0.0
    gauge_holds: bool = False
    trace_digit_Pa: float = 0.0
    sees_end: bool = False
    smoothed: int = 0
    smoothed_degree: int = 0
    kept_every: int = 1
    digit_m: float = 0.0


@dataclass(frozen=True)
class Laboratory:
    """A campaign before it is filmed. `shots` stand in the order they were made.

    `truths` are numbers worth comparing, by name, SI; `columns` of the optional `specimen`, `day`, `order` are written.
    """

    shots: tuple[Shot, ...]
    camera: Camera
    columns: tuple[str, ...] = ()
    truths: Mapping[str, float] = field(default_factory=dict)

    def known(self, **truths: float) -> Laboratory:
        """With these numbers noted down."""
        return replace(self, truths={**self.truths, **truths})


@dataclass(frozen=True)
class Recording:
    """A row of the sheet, by column, and the track that belongs to it: s, m, kPa."""

    cells: Mapping[str, str | float]
    time_s: Floats
    position_m: Floats
    pressure_kPa: Floats | None = None


@dataclass(frozen=True)
class Campaign:
    """What an experiment folder holds, and the truth that it does not."""

    recordings: tuple[Recording, ...]
    settings: Mapping[str, object]
    truth: Mapping[str, object]


Fault = Callable[[Laboratory, Draw], Laboratory]


def plan(draw: Draw, wants: Wants, accept: Callable[[list[Setting]], bool]) -> list[Setting]:
    """Settings of a campaign that the row accepts."""
    for _ in range(5000):
        settings = design(draw, wants)
        if accept(settings):
            return settings
    raise RuntimeError("No campaign of this kind comes up.")


def careful(settings: list[Setting], draw: Draw, quiet: float = 1.0) -> Laboratory:
    """A laboratory without any fault: B and pressure scatter a little, orders are random, noise is that of a camera.

    Parameters
    ----------
    settings : trials as planned
    quiet : factor on noise and scatter
    """
    damping, pressure = quiet * float(draw.uniform(0.005, 0.03)), quiet * float(draw.uniform(0.002, 0.008))
    noise_m = quiet * float(np.exp(draw.uniform(math.log(4e-5), math.log(2e-4))))
    yields = {one.vine: 100 * float(np.clip(draw.standard_normal(), -2, 2)) for one in settings}
    loads = {one.payload_g: 1 + 0.005 * float(draw.uniform(-1, 1)) for one in settings}
    shots = []
    for one in (settings[i] for i in draw.permutation(len(settings))):
        tube = Tube(
            pressure=1e3 * one.pressure_kPa * (1 + pressure * draw.standard_normal()),
            yield_pressure=1e3 * one.vine.yield_kPa + yields[one.vine],
            diameter=one.vine.diameter_mm / 1e3,
            thickness=one.vine.thickness_um / 1e6,
            length=one.vine.length_mm / 1e3,
            payload=one.payload_g / 1e3 * loads[one.payload_g],
            cosine=math.cos(math.radians(one.angle_deg)),
            chamber=one.chamber_l / 1e3 if math.isfinite(one.chamber_l) else math.inf,
            inlet_area=math.pi * (one.inlet_mm / 1e3) ** 2 / 4 if math.isfinite(one.inlet_mm) else math.inf,
        )
        B = one.vine.B * (1 + damping * float(np.clip(draw.standard_normal(), -3, 3)))
        shots.append(Shot(one, tube, Physics(B=B, n=one.vine.n)))
    camera = Camera(noise_m, rho=float(draw.choice([0.0, 0.0, 0.3])), sees_end=bool(draw.uniform() < 0.25))
    noted = {"B_scatter": damping, "pressure_scatter": pressure, "noise_m": noise_m}
    return Laboratory(tuple(shots), camera).known(**noted)


def film(laboratory: Laboratory, draw: Draw) -> tuple[Recording, ...] | None:
    """Every trial as a recording; None where one in ten or more hardly moves.

    The sheet is in the order of the trials, or, where it says their order, sorted by what was set.
    """
    recordings = []
    for k, shot in enumerate(laboratory.shots):
        camera = laboratory.camera
        camera = replace(camera, scale=camera.scale + shot.scale, clock=camera.clock + shot.clock)
        filmed = _film(shot, camera, draw)
        if filmed is None:
            continue
        extra = {"specimen": shot.specimen, "day": shot.day, "order": k + 1}
        cells = _cells(shot.setting, k) | {name: extra[name] for name in laboratory.columns}
        cells["capture_fps"] = shot.setting.capture_hz / laboratory.camera.kept_every
        recordings.append((shot.setting, Recording(cells, *filmed)))
    if len(recordings) < 0.9 * len(laboratory.shots):
        return None
    if "order" in laboratory.columns:
        recordings.sort(key=lambda pair: _by_setting(pair[0]))
    return tuple(recording for _, recording in recordings)


def _by_setting(one: Setting) -> tuple[float, ...]:
    return one.vine.diameter_mm, one.vine.thickness_um, one.payload_g, one.pressure_kPa, one.replicate


def _cells(one: Setting, k: int) -> dict[str, str | float]:
    return {
        "trial": f"t{k + 1:02d}",
        "track": f"tracks/t{k + 1:02d}.csv",
        "capture_fps": one.capture_hz,
        "diameter_mm": one.vine.diameter_mm,
        "thickness_um": one.vine.thickness_um,
        "length_mm": one.vine.length_mm,
        "pressure_kPa": one.pressure_kPa,
        "yield_pressure_kPa": one.vine.yield_kPa,
        "payload_g": one.payload_g,
        "growth_angle_deg": one.angle_deg,
        "chamber_l": one.chamber_l,
        "inlet_mm": one.inlet_mm,
    }


def _film(shot: Shot, camera: Camera, draw: Draw) -> tuple[Floats, Floats, Floats | None] | None:
    """Times, s, positions, m, and pressure, kPa, where it is recorded; None where the vine hardly moves."""
    step_s = 1 / shot.setting.capture_hz
    release_s = (int(draw.integers(10, 40)) - 1 + float(draw.uniform())) * step_s
    part, after = float(draw.uniform(0.8, 0.97)), int(draw.integers(3, 9))
    length = shot.tube.length
    times = np.arange(MOST_FRAMES) * step_s
    since = (times - release_s) / (1 + camera.clock)
    y, speed, gauge_Pa = seen(shot, camera, since)
    stop = int(np.searchsorted(y, part * length))
    if camera.sees_end and y[-1] >= length:
        stop = min(int(np.searchsorted(y, length)) + after, times.size)
    stop = min(stop, times.size)
    if np.count_nonzero(speed[:stop] > 0) < FEWEST_MOVING or y[stop - 1] < 0.25 * length:
        return None
    y, speed = y[:stop], speed[:stop]
    position = (
        imaged(y, camera) + float(draw.uniform(-0.05, 0.05)) + camera.noise_m * _correlated(draw, camera.rho, stop)
    )
    position += camera.blur_s * speed * draw.standard_normal(stop)
    wild = draw.uniform(size=stop) < camera.wild_share
    position[wild] += draw.choice([-1, 1], int(wild.sum())) * draw.uniform(*camera.wild_m, int(wild.sum()))
    trace = None
    if math.isfinite(camera.trace_late_s):
        trace = _recorded(times[:stop], gauge(times, gauge_Pa, camera)[:stop], camera, draw) / 1e3
    position = _smoothed(position, camera)
    if camera.digit_m > 0:
        position = np.round(position / camera.digit_m) * camera.digit_m
    kept = slice(int(draw.integers(camera.kept_every)) if camera.kept_every > 1 else 0, None, camera.kept_every)
    return times[:stop][kept], position[kept], None if trace is None else trace[kept]


def _smoothed(position: Floats, camera: Camera) -> Floats:
    """Positions as somebody hands them in who smoothed them first."""
    if camera.smoothed < 2:
        return position
    if camera.smoothed_degree:
        return np.asarray(savgol_filter(position, camera.smoothed, camera.smoothed_degree))
    window = np.ones(camera.smoothed)
    return np.asarray(np.convolve(position, window, "same") / np.convolve(np.ones(position.size), window, "same"))


def _recorded(times: Floats, pressure_Pa: Floats, camera: Camera, draw: Draw) -> Floats:
    """Pressure, Pa, as the file has it at every frame."""
    if not math.isfinite(camera.gauge_Hz):
        noise = camera.trace_sigma_Pa * _correlated(draw, camera.gauge_rho, times.size)
        return _rounded(_rounded(pressure_Pa + noise, camera.gauge_digit_Pa), camera.trace_digit_Pa)
    read = np.arange(
        times[0] - float(draw.uniform()) / camera.gauge_Hz, times[-1] + 1 / camera.gauge_Hz, 1 / camera.gauge_Hz
    )
    readings_Pa = np.interp(read, times, pressure_Pa) + camera.trace_sigma_Pa * draw.standard_normal(read.size)
    readings_Pa = _rounded(readings_Pa, camera.gauge_digit_Pa)
    if camera.gauge_holds:
        return _rounded(readings_Pa[np.searchsorted(read, times, side="right") - 1], camera.trace_digit_Pa)
    return _rounded(np.interp(times, read, readings_Pa), camera.trace_digit_Pa)


def _rounded(values: Floats, digit: float) -> Floats:
    """Values as multiples of a digit; as they are where it is 0."""
    return np.asarray(digit * np.round(values / digit)) if digit > 0 else values


def imaged(y: Floats, camera: Camera) -> Floats:
    """Positions, m, as tilt, lens and scale have them; the zero is arbitrary."""
    y = y * (1 + camera.bow_per_m * y)
    u = y - camera.lens_centre_m
    return (y + camera.lens_k3 * u**3 + camera.lens_k5 * u**5) * (1 + camera.scale)


def gauge(times: Floats, pressure_Pa: Floats, camera: Camera) -> Floats:
    """Pressure as a gauge tells it that is slow and whose clock is ahead; before the first time it was constant."""
    shown_Pa = pressure_Pa.copy()
    if camera.gauge_lag_s > 0:
        # Exact for a pressure that changes linearly from time to time
        for k, step_s in enumerate(np.diff(times)):
            u, slope = step_s / camera.gauge_lag_s, (pressure_Pa[k + 1] - pressure_Pa[k]) / step_s
            behind = shown_Pa[k] - pressure_Pa[k] + slope * camera.gauge_lag_s
            shown_Pa[k + 1] = pressure_Pa[k + 1] - slope * camera.gauge_lag_s + behind * math.exp(-u)
    return np.interp(times + camera.trace_late_s, times, shown_Pa)


def reported(shot: Shot, camera: Camera, since: Floats) -> tuple[Floats, Floats, Floats]:
    """What camera and gauge say without noise at times since release: position, m, lead speed, m/s, pressure, Pa."""
    y, speed, gauge_Pa = seen(shot, camera, since / (1 + camera.clock))
    return imaged(y, camera), speed, gauge_Pa


def seen(shot: Shot, camera: Camera, since: Floats) -> tuple[Floats, Floats, Floats]:
    """Lead position, m, lead speed, m/s, and pressure, Pa, as the rows of each frame catch them."""
    if camera.row_delay_s_m == 0:
        return _moved(shot, since)
    # The row at y is exposed s (y − y_c) after the middle one: the frame of time t shows y(τ), τ = t + s (y − y_c).
    step_s = since[1] - since[0]
    fine = np.arange(since[0] - step_s, since[-1] + step_s, step_s / FINER)
    y, speed, gauge_Pa = _moved(shot, fine)
    middle = fine - camera.row_delay_s_m * (y - camera.lens_centre_m)
    return tuple(np.interp(since, middle, values) for values in (y, speed, gauge_Pa))


def _moved(shot: Shot, since: Floats) -> tuple[Floats, Floats, Floats]:
    """Lead position, m, lead speed, m/s, and pressure at the source, Pa, at times since release."""
    if shot.slack:
        out = follow_slack(since, shot.tube, shot.physics.B, shot.physics.n)
        return out[:, 0], np.gradient(out[:, 0], since), np.full(since.size, shot.tube.pressure)
    opening: tuple[Floats, Floats] | tuple[()] = ()
    if shot.valve_s > 0:
        grid = np.linspace(0, 12 * shot.valve_s, 2000)
        opening = grid, shot.tube.pressure * opened(grid / shot.valve_s, shot.valve_law, shot.valve_power)
    out, _ = follow(since, shot.tube, shot.physics, np.empty((0, 3)), *opening)
    return out[:, 0], 0.5 * out[:, 2], out[:, 3]


def opened(part: Floats, law: str, power: float = 1.0) -> Floats:
    """Share of the pressure behind a valve, by the time since it began to open in its own time."""
    if law == "smooth":
        u = np.clip(part, 0, 1)
        return u * u * (3 - 2 * u)
    return 1 - np.exp(-(part**power))


def _correlated(draw: Draw, rho: float, count: int) -> NDArray[np.float64]:
    """Noise of unit variance with correlation ρ^k between points k apart."""
    kicks = draw.standard_normal(count)
    out = kicks.copy()
    for k in range(1, count):
        out[k] = rho * out[k - 1] + math.sqrt(1 - rho * rho) * kicks[k]
    return out
