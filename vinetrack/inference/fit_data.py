"""The data of a fit: for each trial the positions used, their times, their noise, and the recorded pressure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import InputError, UserError, reasons_told
from vinetrack.core.records import END_FRACTION, Floats, Track, Trial, with_flag
from vinetrack.core.units import pressure_text
from vinetrack.inference.gauge_noise import DenoisedTrace, denoised_traces
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.tracks.position_noise import (
    FOURTH_DIFFERENCE,
    Smoothing,
    ar1_sd,
    common_rounding_noise,
    detect_smoothing,
    noise_shape,
    position_noise,
    rest_points,
    rough_noise,
)

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment

LENGTH_ERROR = 0.005  # Standard deviation of a vine's length, relative (chosen)


class FitError(UserError, ValueError):
    """The fit cannot be made; the message is one sentence with a remedy.

    >>> import vinetrack as vt
    >>> vt.fit(vt.base_model(), [])
    Traceback (most recent call last):
    vinetrack.inference.fit_data.FitError: No trial can be fitted: there is none.
    """


@dataclass(frozen=True)
class ImpreciseRest:
    """A rest before the motion whose points share an error, or have large ones: its end, position and error."""

    release_s: float
    origin_m: float
    sigma_m: float


@dataclass(frozen=True)
class FitTrial:
    """One trial as a fit sees it; arrays have shape (n_points,) unless stated. Positions: `first` marks the points that
    begin a stretch without gaps. `n_rest` counts the points at rest before the motion, 0 where the track begins in
    motion. `imprecise_rest` replaces a rest whose points are left out.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    first: NDArray[np.bool_]
    n_rest: int
    noise_m: float
    correlation: float
    trace: tuple[Floats, Floats] | None = None
    gauge_error: float = 0.0
    trace_errors_Pa: Floats | None = None
    imprecise_rest: ImpreciseRest | None = None
    position_systematic_m: float = 0.0  #: standard deviation of smooth errors of position that trials share
    stated_m: Floats | None = None
    slow_m: Floats | None = None
    relative_sd: Floats | None = None
    blur_s: float = 0.0
    smoothing: Smoothing | None = None  #: how positions were smoothed of which one in several is kept
    sees_end: bool = False  #: whether the last point lies behind the end of growth

    @cached_property
    def frame_s(self) -> float:
        """Median spacing of the points, s."""
        return float(np.median(np.diff(self.time_s)))

    @cached_property
    def window(self) -> tuple[Floats, Floats]:
        """Times relative to each point over which it is averaged, s, and their weights."""
        if self.smoothing is None:
            return np.zeros(1), np.ones(1)
        places = np.arange(self.smoothing.window) - self.smoothing.window // 2
        return np.asarray(places * (self.frame_s / self.smoothing.decimation)), self.smoothing.weights

    @property
    def point_sd(self) -> Floats:
        """`relative_sd`, or ones where all points are equally noisy, shape (n_points,)."""
        return np.ones(self.time_s.size) if self.relative_sd is None else self.relative_sd

    @property
    def mean_noise_m(self) -> float:
        """Root mean square of the noise of the points before the end of growth, m."""
        return self.noise_m * math.sqrt(float(np.mean(self.point_sd[: self.time_s.size - self.sees_end] ** 2)))

    @property
    def shows_rest(self) -> bool:
        """Whether the rest before the motion was recorded, precisely or not."""
        return self.n_rest > 0 or self.imprecise_rest is not None

    @property
    def rest_origin_m(self) -> float:
        """Position of the edge at rest before the motion, m: the mean of its points but the last, where they are in the
        fit.
        """
        if self.imprecise_rest is not None:
            return self.imprecise_rest.origin_m
        return float(np.mean(self.lead_position_m[: max(self.n_rest - 1, 1)]))

    @property
    def rest_end_s(self) -> float:
        """Time of the last frame at rest before the motion, s; of the first where none shows it."""
        return self.imprecise_rest.release_s if self.imprecise_rest else float(self.time_s[max(self.n_rest - 1, 0)])

    @cached_property
    def typical_pressure_Pa(self) -> float:
        """The set pressure, or the median of the recorded one."""
        return self.trial.pressure_Pa if self.trace is None else float(np.median(np.interp(self.time_s, *self.trace)))

    @cached_property
    def pressurised_in_recording(self) -> bool:
        """Whether the tube was pressurised during the recording; the trace then shows when the growth was started.
        Nothing else holds such a vine, and a free release would stand in for a threshold of the pressure.
        """
        # 0.5: where a trace begins below this part of its median, the tube was pressurised during the
        # recording (chosen)
        return self.trace is not None and bool(self.trace[1][0] < 0.5 * self.typical_pressure_Pa)


Pairs = Iterable[tuple[Trial, Track]]


def prepare_trial(
    trial: Trial,
    track: Track,
    denoised: DenoisedTrace | None = None,
    smoothing: Smoothing | None = None,
    rounding_m: float = 0.0,
) -> FitTrial:
    """The data of one trial: its usable points, rest included, and the noise that they show."""
    excluded, end = _near_end_of_growth(trial, track)
    usable = track.usable & ~excluded
    imprecise, imprecise_rest = _imprecise_points(track, usable)
    usable &= ~imprecise
    smoothing, rounding_m = (smoothing, rounding_m) if trial.video is None else (None, 0.0)
    if rounding_m > 0 and imprecise_rest is None:
        quantised, imprecise_rest = _quantised_points(track, usable, rounding_m)
        usable &= ~quantised
    if smoothing is not None:
        # Near both ends the filter has no full window, and programs differ in how they pad it.
        places = np.flatnonzero(usable)[smoothing.window // 2 : -(smoothing.window // 2)]
        usable = np.isin(np.arange(usable.size), places[:: smoothing.decimation])
    time_s, position_m = track.time_s[usable].astype(float), track.lead_position_m[usable].astype(float)
    if time_s.size < FEWEST_POINTS:
        raise FitError(f"{time_s.size} usable points, at least {FEWEST_POINTS} are needed")
    steps = np.diff(time_s)
    if np.any(steps <= 0):
        raise FitError("its times do not increase: sort the rows or drop repeated ones")
    noise_m, correlation = position_noise(time_s, position_m)
    noise_m, pressures_Pa = max(noise_m, rounding_m), (trial.pressure_Pa, trial.yield_pressure_Pa)
    # The pressure must be able to move a bare vine within the errors of the sheet; gravity alone may move a payload.
    room_Pa = 3 * (np.nan_to_num(trial.pressure_sigma_Pa) + np.nan_to_num(trial.yield_pressure_sigma_Pa))
    bare = track.pressure_Pa is None and trial.travel_ratio != 1 and trial.payload_kg == 0
    if bare and trial.pressure_Pa + room_Pa < trial.yield_pressure_Pa:
        stated, least = (pressure_text(of_Pa, trial.pressure_unit, 6) for of_Pa in pressures_Pa)
        raise FitError(
            f"its pressure, {stated}, lies below the yield pressure, {least}, yet it moves: correct the sheet"
        )
    if trial.payload_kg == 0 and not trial.linear_density_kg_m > 0:
        raise FitError("it has no mass: fill in payload_g, the mass of a body that moves as a whole")
    moved_m = float(np.median(position_m[-3:]) - np.median(position_m[:3]))
    # 8.0: standard deviations by which the edge must move for a trial to be fitted
    if not moved_m > 8.0 * noise_m or moved_m <= 0:
        backwards = "its position decreases while it grows: change the sign, or the points that it is made of"
        never = "its leading edge never moves forward beyond its noise"
        raise FitError(backwards if moved_m < -8.0 * noise_m else never)
    n_rest = 0 if imprecise_rest is not None else _rest_before_motion(position_m)
    moving = time_s.size - n_rest
    if moving < 4:  # (derived)
        raise FitError(
            f"{moving} usable point{'s' * (moving != 1)} in motion, at least 4 are needed: film faster,"
            " or see in its overlay what hides the edge"
        )
    denoised = denoised or denoised_traces([track])[0]
    extended = None if denoised is None else denoised.extended().thinned()
    stated_m, filmed, smooth_m = track.lead_position_sigma_m[usable], bool(trial.video), trial.position_systematic_m
    # 1.5: A point later than this many frames after the previous one begins a new stretch, whose noise is
    # independent of the previous one's (derived)
    return FitTrial(
        trial=trial,
        time_s=time_s,
        lead_position_m=position_m,
        first=np.concatenate([[True], steps > 1.5 * np.median(steps)]),
        n_rest=n_rest,
        noise_m=noise_m,
        correlation=correlation,
        trace=None if extended is None else (extended.time_s, extended.pressure_Pa),
        gauge_error=0.0 if denoised is None else _gauge_error(denoised, time_s[max(n_rest - 1, 0) :]),
        trace_errors_Pa=None if extended is None or not extended.errors_Pa.size else extended.errors_Pa,
        imprecise_rest=imprecise_rest,
        position_systematic_m=smooth_m if math.isfinite(smooth_m) else trial.systematic_of_travel * moved_m,
        stated_m=None if filmed or not np.isfinite(stated_m).any() else stated_m.astype(float),
        slow_m=_slow_error(track, usable) if filmed else None,
        smoothing=smoothing,
        sees_end=bool(usable[end].any()),
    )


def _rest_before_motion(position_m: Floats) -> int:
    """Number of points at rest before the motion; 0 where there is none, or no motion."""
    n_rest = rest_points(position_m)
    return n_rest if n_rest < position_m.size else 0


def _slow_error(track: Track, usable: NDArray[np.bool_]) -> Floats | None:
    """The tracker's slowly varying error at the usable points, m, interpolated where a point states none. A track with
    a single stated error, as in results of 0.1.0, is taken to state the slow one, which is the larger.
    """
    for slow_m in (track.lead_position_systematic_m, track.lead_position_sigma_m):
        if slow_m is not None and np.isfinite(slow_m[usable]).any():
            stated = usable & np.isfinite(slow_m)
            return np.interp(np.flatnonzero(usable), np.flatnonzero(stated), slow_m[stated])
    return None


def _gauge_error(denoised: DenoisedTrace, moving_s: Floats) -> float:
    """Relative error of the denoised pressure that is constant over the motion."""
    in_motion = (denoised.time_s >= moving_s[0]) & (denoised.time_s <= moving_s[-1])
    typical_Pa = abs(float(np.median(denoised.pressure_Pa[in_motion]))) if in_motion.any() else math.nan
    if not typical_Pa > 0:
        return 0.0
    # The noise averages out over the samples during the motion only.
    return denoised.mean_error_Pa * math.sqrt(in_motion.size / np.count_nonzero(in_motion)) / typical_Pa


def _imprecise_points(track: Track, usable: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], ImpreciseRest | None]:
    """Points whose stated error is several times that of the others, such as an edge half behind the door, and the rest
    before the motion where it consists of them or is that of a recording: pictures of one edge share its slow error,
    and together they are worth one point.
    """
    sigma_m, slow_m = track.lead_position_sigma_m, track.lead_position_systematic_m
    if slow_m is not None:
        sigma_m = np.hypot(sigma_m, np.nan_to_num(slow_m))
    stated = usable & np.isfinite(sigma_m)
    if not stated.any():
        return np.zeros(usable.size, dtype=bool), None
    precise_half_m = sigma_m[stated & (sigma_m <= np.median(sigma_m[stated]))]
    # 3.0, 0.3, 0.5: A point is left out if its stated error exceeds the median of the better half by this factor,
    # provided that at least the second fraction of those in motion remains (chosen)
    imprecise = stated & (sigma_m > 3.0 * np.median(precise_half_m))
    usable_points = np.flatnonzero(usable)
    at_rest = usable_points[: _rest_before_motion(track.lead_position_m[usable_points])]
    imprecise_rest = None
    if at_rest.size and (slow_m is not None or np.mean(imprecise[at_rest]) > 0.5):
        imprecise[at_rest] = True  # The few others would determine the origin alone.
        imprecise_rest = ImpreciseRest(
            release_s=float(track.time_s[at_rest[-1]]),
            origin_m=float(np.median(track.lead_position_m[at_rest])),
            sigma_m=float(np.median(sigma_m[at_rest])),
        )
    least = max(FEWEST_POINTS, 0.3 * (usable_points.size - at_rest.size))
    if np.count_nonzero(usable & ~imprecise) < least:
        return np.zeros(usable.size, dtype=bool), None
    return imprecise, imprecise_rest


def _quantised_points(
    track: Track, usable: NDArray[np.bool_], rounding_m: float
) -> tuple[NDArray[np.bool_], ImpreciseRest | None]:
    """Points at standstill that rounding makes identical, because their noise is smaller than the rounding step: with
    the same error they are worth one point together. The rest before the motion is replaced by its mean with the error
    of one point; of a standstill at the end the first point is kept.
    """
    places = np.flatnonzero(usable)
    y = track.lead_position_m[places]
    quantised = np.zeros(usable.size, dtype=bool)
    n_rest = _rest_before_motion(y)
    # 1.5: range of rounded positions at rest, in rounding steps, up to which rounding hides their noise (derived)
    if n_rest == 0 or np.ptp(y[:n_rest]) > 1.5 * math.sqrt(12) * rounding_m:
        return quantised, None
    quantised[places[:n_rest]] = True
    standstill_start = int(np.flatnonzero(y != y[-1])[-1]) + 1
    quantised[places[standstill_start + 1 :]] = True
    return quantised, ImpreciseRest(float(track.time_s[places[n_rest - 1]]), float(np.median(y[:n_rest])), rounding_m)


def _near_end_of_growth(trial: Trial, track: Track) -> tuple[NDArray[np.bool_], NDArray[np.int_]]:
    """Frames on the last twentieth of the growth and after its end, and the index of the last one if it is kept, in an
    array: a standstill at the end shows how long the vine is, and is worth one point, unless the track begins in motion
    and does not tell how far it has grown.
    """
    excluded = np.zeros(track.time_s.size, dtype=bool)
    points = np.flatnonzero(track.usable if trial.video else track.usable | with_flag(track.flag, "after_end"))
    if not np.isfinite(trial.length_m) or points.size < FEWEST_POINTS:
        return excluded, points[:0]
    y = track.lead_position_m[points]
    noise_m, n_rest = rough_noise(y) + 1e-9, _rest_before_motion(y)
    begin_m = float(np.mean(y[: max(n_rest, 1)]))
    # A track that stands still at its end, after a last step far above its noise, includes the end of growth.
    still = np.abs(y - np.median(y[-2:])) < 5 * noise_m
    moving = np.flatnonzero(~still)
    end = int(moving[-1]) + 1 if moving.size else y.size
    end_reached = y.size - end >= 2 and y[end] - y[end - 1] > 5 * noise_m
    last_m = float(np.median(y[-2:])) - (1 - END_FRACTION) * trial.length_m if end_reached else np.inf
    excluded[points[y > min(begin_m + END_FRACTION * trial.length_m, last_m)]] = True
    behind = points[end:] if end_reached and n_rest else points[:0]
    kept = behind[track.usable[behind]][-1:]
    excluded[kept] = False
    return excluded, kept


def pairs_of(
    experiment: Experiment | Path | str | Pairs, tracks: Mapping[str, Track] | None = None
) -> tuple[list[tuple[Trial, Track]], dict[str, str]]:
    """Trials and their tracks, and the reason for each trial without one, by name."""
    from vinetrack.experiment.folder import Experiment, read_experiment
    from vinetrack.tracks.frame_timing import correct_frames
    from vinetrack.tracks.importers import load_track

    if isinstance(experiment, (str, Path)):
        experiment = read_experiment(experiment)
    if not isinstance(experiment, Experiment):
        return list(experiment), {}
    pairs, left_out = [], {**experiment.failed, **experiment.left_out}
    for trial in experiment.trials:
        if tracks is not None and trial.name in tracks:
            pairs.append((trial, tracks[trial.name]))
            continue
        if trial.track is None:
            untracked = "its recording has not been tracked: run `vinetrack run`, or give its track"
            left_out[trial.name] = untracked if tracks is None else "tracking failed, and `trials.csv` has the reason"
            continue
        try:
            pairs.append((trial, correct_frames(load_track(trial))))
        except InputError as error:
            left_out[trial.name] = str(error)
    if not pairs:
        raise none_to_fit(left_out)
    return pairs, left_out


def none_to_fit(left_out: Mapping[str, str]) -> FitError:
    """The error of an experiment without a trial to fit; `left_out` are the reasons, by name of trial."""
    return FitError(f"No trial can be fitted: {reasons_told(left_out) or 'there is none'}.")


# ------------------------------------------------------------------------------
# The data of all trials of a campaign, including properties of the noise that only the trials together show.
#
# A single track may not show whether its positions are rounded, smoothed, or have an error that grows with speed.


def not_measured(pairs: Pairs) -> dict[str, str]:
    """Why the values of a trial were not measured in it, by its name: those of a copied track, and of a gauge at the
    end of its range, at one value to the last digit: below a set pressure though noisy in other trials, or whatever was
    set.
    """
    first_with: dict[bytes, str] = {}
    reasons, ending_at, is_noisy = dict[str, str](), dict[float, list[Trial]](), False
    for trial, track in pairs:
        original = first_with.setdefault(track.lead_position_m.tobytes(), trial.name)
        if original != trial.name:
            reasons[trial.name] = f"its positions are those of {original} to the last digit: give each trial its own"
        if track.pressure_Pa is not None and np.isfinite(track.pressure_Pa).any():
            largest_Pa = float(np.nanmax(track.pressure_Pa))
            # 0.1: part of a trace at its largest value from which it may stand at the end of the range (chosen)
            if np.mean(track.pressure_Pa == largest_Pa) > 0.1:
                ending_at.setdefault(largest_Pa, []).append(trial)
            else:
                is_noisy = True
    for largest_Pa, trials in ending_at.items():
        set_Pa = [trial.pressure_Pa for trial in trials]
        # 1.1: ratio of pressures that a gauge tells apart (chosen)
        if max(set_Pa) > 1.1 * min(set_Pa) or (is_noisy and min(set_Pa) > 1.1 * largest_Pa):
            for trial in trials:
                told_Pa = (largest_Pa, trial.pressure_Pa)
                end, stated = (pressure_text(of_Pa, trial.pressure_unit, 6) for of_Pa in told_Pa)
                said = f"its recorded pressure stands at {end} to the last digit, the sheet says {stated}"
                reasons[trial.name] = f"{said}: the end of the gauge's range? Blank its trace"
    return reasons


def prepare(pairs: Pairs, *, weighted: bool = True) -> tuple[list[FitTrial], dict[str, str]]:
    """Data of the trials that can be fitted, and the reason for each that cannot, by name."""
    data, left_out = [], {}
    pairs = list(pairs)
    # Estimated from all tracks: one with few points, or at constant speed, may not show it.
    imported = [track.lead_position_m[track.usable] for trial, track in pairs if trial.video is None]
    rounding_m = common_rounding_noise(imported)
    smoothing = detect_smoothing(pairs, rounding_m)
    refused = not_measured(pairs)
    for (trial, track), denoised in zip(pairs, denoised_traces([track for _, track in pairs]), strict=True):
        try:
            if trial.name in refused:
                raise FitError(refused[trial.name])
            data.append(prepare_trial(trial, track, denoised, smoothing, rounding_m))
        except FitError as error:
            left_out[trial.name] = str(error)
    # Smooth errors that are not stated are a part of the longest travel of the trials that are fitted.
    seen = [track.lead_position_m[track.usable] for trial, track in pairs if trial.name not in left_out]
    longest_m = max((float(np.ptp(position_m)) for position_m in seen), default=0.0)
    for i, one in enumerate(data):
        if not math.isfinite(one.trial.position_systematic_m):
            smooth_m = max(one.position_systematic_m, one.trial.systematic_of_travel * longest_m)
            data[i] = replace(one, position_systematic_m=smooth_m)
    return _with_errors_of_length(_with_weighted_points(data) if weighted else data), left_out


def _with_errors_of_length(data: list[FitTrial]) -> list[FitTrial]:
    """The trials with their ends weighted by the error of their vine's length, which its trials share."""
    of_vine = Counter(each.trial.vine for each in data if each.sees_end)
    for i, each in enumerate(data):
        if each.sees_end:
            relative_sd = each.point_sd.copy()
            error_m = LENGTH_ERROR * each.trial.length_m * math.sqrt(of_vine[each.trial.vine])
            relative_sd[-1] = math.hypot(relative_sd[-1], error_m / each.noise_m)
            data[i] = replace(each, relative_sd=relative_sd)
    return data


def _with_weighted_points(data: list[FitTrial]) -> list[FitTrial]:
    """The trials with weighted points, where the noise of imported positions varies. Points of this package's tracker
    keep equal weights: it states the error of each and leaves out the worst.
    """
    imported = [i for i, trial_data in enumerate(data) if trial_data.slow_m is None]
    of_track = [[getattr(data[i], name) for i in imported] for name in ("time_s", "lead_position_m", "stated_m")]
    if (shape := noise_shape(*of_track)) is None:
        return data
    # One correlation for all trials, as in a fit: a single track with unequal noise hardly determines it.
    correlation = np.average([data[i].correlation for i in imported], weights=[data[i].time_s.size for i in imported])
    gain = ar1_sd(FOURTH_DIFFERENCE, float(correlation)) / float(np.linalg.norm(FOURTH_DIFFERENCE))
    weighted = list(data)
    for i, sd_m in zip(imported, shape.sd_m, strict=True):
        typical_m = math.exp(float(np.mean(np.log(sd_m))))
        weighted[i] = replace(
            data[i],
            relative_sd=sd_m / typical_m,
            noise_m=typical_m / gain,
            correlation=float(correlation),
            blur_s=shape.blur_s,
        )
    return weighted
