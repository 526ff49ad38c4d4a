"""Initial path of the front through a strip, before film, background or the tip are known.

Two methods of `kymograph` complement each other. The path by change does not know what caused a change: a bright door
that comes to rest beside the tube outweighs the front. The path by appearance lets every pixel vote on whether it looks
as in the first or as in the last frames; votes are equal and a door has few rows. But a payload that has flown past by
the end, or an object that stood in front at the start, has no vote, and the path starts up to three frames late and
ends up to three frames early, because several frames are averaged at either end. The path that leaves the smaller
residual sum is used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video import kymograph as ky
from vinetrack.video.motion_end import growth_end
from vinetrack.video.strip import Strip
from vinetrack.video.threads import FEWEST_PICTURES, in_parts

# Change of a column, as returned by `kymograph.path_by_change`, from which it counts as changed (chosen)
MIN_LOG_CHANGE = 5.0
# Length of a run of columns, and the fraction of it that must have changed for a front to have passed (chosen)
RUN_LENGTH_PX, RUN_CHANGED_PART = 9, 0.6
MIN_FALL_PART, MIN_FALL_PX = 0.1, 0.2  # Minimum decrease from step to step of the run-up, going back in time (chosen)

AVERAGED_FRAMES = 12  # Frames after and before the front over which film and background are averaged (derived)

_FrontPath = tuple[Floats, tuple[int, int]]  # Column of the front by frame, shape (n_frames,), px


def initial_front_path(strip: Strip) -> tuple[Floats, tuple[int, int]]:
    """Find the initial path of the front, and the columns that it leaves permanently changed. Returns column of the
    front by frame, shape (n_frames,), px, first column passed, and the one behind the last.
    """
    return _cut_at_growth_end(strip, _better_path(strip))


def front_path_by_change(strip: Strip) -> tuple[Floats, tuple[int, int]]:
    """Find the initial path of the front by change alone, and the columns that it leaves permanently changed. Start and
    end of growth are more exact than by appearance, for which several frames are averaged. Returns as
    `initial_front_path`.
    """
    return _cut_at_growth_end(strip, _trim_to_changed_runs(*ky.path_by_change(strip)))


def _cut_at_growth_end(strip: Strip, front_path: _FrontPath) -> _FrontPath:
    """End the passed columns where the film ends: a payload may fly on beyond it."""
    path, (begin, end) = front_path
    end = growth_end(strip, path, (begin, end))
    if end <= begin:
        raise ValueError("what changes along the axis does not stay changed: nothing grows")
    return path, (begin, end)


def _better_path(strip: Strip) -> _FrontPath:
    """Return the path by change or by appearance, whichever leaves the smaller residual sum, and its columns."""
    candidates: list[_FrontPath] = []
    errors: list[ValueError] = []
    for path, change in (ky.path_by_change(strip), ky.path_by_appearance(strip)):
        try:
            candidates.append(_trim_to_changed_runs(path, change))
        except ValueError as error:
            errors.append(error)
    if not candidates:
        raise errors[0]
    if len(candidates) == 1:
        return candidates[0]
    columns = min(passed[0] for _, passed in candidates), max(passed[1] for _, passed in candidates)
    by_change, by_looks = (_residual_of_path(strip, front_path, columns) for front_path in candidates)
    return candidates[1] if by_looks < by_change else candidates[0]


def _residual_of_path(strip: Strip, front_path: _FrontPath, columns: tuple[int, int]) -> float:
    """Residual sum of a path over some columns, with the film and background that follow from it."""
    path, _ = front_path
    pictures = appearance_about_path(strip, path, columns)

    def residuals(first: int, last: int) -> Floats:
        part = slice(first, last)
        return ky.clipped_residual_sums(
            strip.values[part], strip.scale[part], strip.offset[part], strip.noise, path[part], pictures, *columns
        )

    return float(np.concatenate(in_parts(residuals, len(strip.values), FEWEST_PICTURES)).sum())


def appearance_about_path(strip: Strip, path: Floats, columns: tuple[int, int]) -> NDArray[np.float32]:
    """Average each pixel over the AVERAGED_FRAMES frames after (film) and before (background) the front passes it.
    Shapes: path (n_frames,) → (2, n_across, n_columns).
    """
    return ky.mean_appearance(strip.values, strip.scale, strip.offset, path, *columns, AVERAGED_FRAMES)


def _trim_to_changed_runs(path: Floats, change: Floats) -> _FrontPath:
    """Clip a path to the range of columns that changed in runs; prepend a run-up. A late beginning is better than an
    early one: neighbours then stand in for the background, whereas a column that never changed carries no information
    about the edge.
    """
    strong = change > MIN_LOG_CHANGE
    run = np.convolve(strong, np.ones(RUN_LENGTH_PX) / RUN_LENGTH_PX, mode="same") > RUN_CHANGED_PART
    if run.sum() < RUN_LENGTH_PX:
        raise ValueError("nothing moves along the axis")
    changed_columns = np.flatnonzero(run & strong)
    passed = max(int(changed_columns[0]), ky.column_after_leap(path)), int(changed_columns[-1]) + 1
    if passed[0] >= passed[1]:
        raise ValueError("what changes along the axis does so all at once: nothing grows")
    return _run_up(np.clip(path, *passed)), passed


def _run_up(path: Floats) -> Floats:
    """Replace the beginning of a path by steps that decrease going back in time, as from rest. An object such as a door
    may have stood where growth is first visible, and the tip may have come from further back. If it did not, the
    columns in between turn out to be film from the start, and the second path corrects this.
    """
    steps = np.diff(path)
    onset = int(np.argmax(steps > 0)) if np.any(steps > 0) else 0
    later = path[onset + 1 :]
    if onset < 2 or len(later) < 5:
        return path
    fall = max(float(np.median(np.diff(later[:5], 2))), MIN_FALL_PART * float(later[1] - later[0]), MIN_FALL_PX)
    out, step = path.copy(), float(np.median(np.diff(later[:4])))
    for t in range(onset, -1, -1):
        step = max(step - fall, 0.0)
        out[t] = max(out[t + 1] - step, 0.0)
    return out
