"""A first path of the front through a strip, before anything is known of film, background or the tip.

There are two ways to it, and each fails where the other does not. What changes most tells nothing of what it was: a
bright door that comes to rest beside the tube outdoes it. What every pixel looks like, as in the first or as in the
last frames, is a vote in which each has the same say, and a door has few rows; but what has flown on by then, or stood
in front at first, has no vote, and what grows while the first and the last looks are taken is left out: the path begins
and ends up to three frames late and early. The path is taken whose pictures of film and background leave less
unexplained.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video import kymograph as ky
from vinetrack.video.motion_end import growth_end
from vinetrack.video.strip import Strip

LEAST_CHANGE = 5.0
"""Change of a column, as `kymograph.changing_path` states it, from which it counts as changed. Chosen: about 360 times
what noise brings to the score, e^(5/0.85). By reasoning: at half the path begins in what never changed; at twice faint
starts are cut off."""
RUN_PX, RUN_FILLED = 9, 0.6
"""Columns in a row of which this part must have changed for a front to have passed. Chosen: blur alone spreads a change
over half as many. By reasoning: at half a glint counts as growth; at twice short growth does not."""
FALL_PART, FALL_PX = 0.1, 0.2
"""Least fall of the steps in the run-up, as a part of the first difference seen and in px. Chosen: the run-up then
ends. By reasoning: at half it reaches twice as far back, which the second path takes back."""

SEEN_FRAMES = 12
"""Frames after and before the front over which film and background are averaged. Derived: as many as a memory of
MEMORY_FRAMES in `edge_state` has in effect, (Σw)²/Σw² = 2 · 6."""

_Way = tuple[Floats, tuple[int, int]]
"""Column of the front by frame, shape (n_frames,), px; the first column passed and the one behind the last."""


def grown_path(strip: Strip) -> tuple[Floats, tuple[int, int]]:
    """Find a first path of the front, and the columns that it leaves changed for good.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    column of the front by frame, shape (n_frames,), px
    first column passed, and the one behind the last

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    return _of_growth(strip, _likelier_path(strip))


def grown_by_change(strip: Strip) -> tuple[Floats, tuple[int, int]]:
    """Find a path of the front by what changes most alone, and the columns that it leaves changed for good.

    Where it begins and ends is told better than by looks, of which several frames are taken.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    as `grown_path`.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    return _of_growth(strip, _in_earnest(*ky.changing_path(strip)))


def _of_growth(strip: Strip, way: _Way) -> _Way:
    """A path over what film covers, without what a payload flies on over."""
    path, (begin, end) = way
    end = growth_end(strip, path, (begin, end))
    if end <= begin:
        raise ValueError("what changes along the axis does not stay changed: nothing grows")
    return path, (begin, end)


def _likelier_path(strip: Strip) -> _Way:
    """Of the path of changes and that of looks, the one whose pictures leave less unexplained, and what it passes."""
    ways: list[_Way] = []
    complaints: list[ValueError] = []
    for path, change in (ky.changing_path(strip), ky.lasting_path(strip)):
        try:
            ways.append(_in_earnest(path, change))
        except ValueError as error:
            complaints.append(error)
    if not ways:
        raise complaints[0]
    if len(ways) == 1:
        return ways[0]
    columns = min(passed[0] for _, passed in ways), max(passed[1] for _, passed in ways)
    by_change, by_looks = (_unexplained(strip, way, columns) for way in ways)
    return ways[1] if by_looks < by_change else ways[0]


def _unexplained(strip: Strip, way: _Way, columns: tuple[int, int]) -> float:
    """What a path leaves unexplained of some columns, with the pictures that follow from it."""
    path, _ = way
    pictures = sides_of_path(strip, path, columns)
    return float(ky.unexplained(strip.values, strip.scale, strip.offset, strip.noise, path, pictures, *columns))


def sides_of_path(strip: Strip, path: Floats, columns: tuple[int, int]) -> NDArray[np.float32]:
    """Mean brightness of each pixel in the SEEN_FRAMES frames after and before the front passes it.

    Parameters
    ----------
    strip : along the axis.
    path : column of the front by frame, never falling, shape (n_frames,), px.
    columns : the first, and the one behind the last.

    Returns
    -------
    film and background, shape (2, n_across, n_columns), grey levels.
    """
    return ky.sides_of_front(strip.values, strip.scale, strip.offset, path, *columns, SEEN_FRAMES)


def _in_earnest(path: Floats, change: Floats) -> _Way:
    """A path over the columns of which whole runs change, and the first and last of these.

    Rather begin late (the neighbours then stand in for the background) than early, where a column that never changed
    would say nothing at all about the edge.
    """
    strong = change > LEAST_CHANGE
    run = np.convolve(strong, np.ones(RUN_PX) / RUN_PX, mode="same") > RUN_FILLED
    if run.sum() < RUN_PX:
        raise ValueError("nothing moves along the axis")
    where = np.flatnonzero(run & strong)
    passed = max(int(where[0]), ky.after_jump(path)), int(where[-1]) + 1
    if passed[0] >= passed[1]:
        raise ValueError("what changes along the axis does so all at once: nothing grows")
    return _run_up(np.clip(path, *passed)), passed


def _run_up(path: Floats) -> Floats:
    """The path with its beginning replaced by a run-up of falling steps, as from rest.

    Where growth is first seen something else may have stood before (a door), and the tip have come from further back.
    If it did not, the columns between turn out to be film from the start, and the second path takes that back.
    """
    steps = np.diff(path)
    onset = int(np.argmax(steps > 0)) if np.any(steps > 0) else 0
    later = path[onset + 1 :]
    if onset < 2 or len(later) < 5:
        return path
    fall = max(float(np.median(np.diff(later[:5], 2))), FALL_PART * float(later[1] - later[0]), FALL_PX)
    out, step = path.copy(), float(np.median(np.diff(later[:4])))
    for t in range(onset, -1, -1):
        step = max(step - fall, 0.0)
        out[t] = max(out[t + 1] - step, 0.0)
    return out
