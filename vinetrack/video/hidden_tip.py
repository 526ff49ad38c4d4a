"""What hides the tip where it starts: a door that stands or swings before it, the mouth of a launcher.

A door leaves: what it hid is told by pictures that resemble neither film nor background. A mouth stays, and its border
with the background looks like a tip at rest while the tip moves behind it. That is told by what the tip leaves: behind
a tip that was seen at rest the film goes on without a border, behind one that came out of something the straight
border of that stays where the edge rested.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.video.edge_repair import ASTRAY_PX
from vinetrack.video.edge_state import CLEAR_PX, EdgeState, clear_of_start, moving_frames
from vinetrack.video.strip import Strip

HIDDEN = 3.2
"""Misfit, in units of the noise and in usual ones, above which something else stands there and the edge is a guess.
Chosen: sqrt(3.2) is 1.8 standard deviations in every pixel, which noise never has. By reasoning: at half textured
backgrounds count as hidden; at twice payloads before the edge do not."""
SURELY_HIDDEN = 1.12 * HIDDEN
"""Misfit from which nothing of the tip is seen, whatever its contrast. Chosen: an eighth more than where it is a guess.
By reasoning: nearer 1 every guess is given up; at twice of it doors of the film's brightness leave guesses."""
UNUSUAL = 2.0
"""Misfit over the usual one from which a frame differs from those clear of the start. Chosen. By reasoning: near 1
every textured start counts, at twice dark doors before dark backgrounds do not."""
PALE, PARTLY_PALE = 0.6, 0.75
"""Amplitude, the contrast over that of the same pixels in other frames, below which too little of the edge is left, and
below which part of it is. Chosen. They are not FAINTEST of `edge_repair` (0.5): below that a fit is sought again, while
these judge what was found in the end. By reasoning: at half a door over two thirds of the tip passes; near 1 changing
light does not."""
GUESSED_PX, NO_EDGE_PX = 0.7 * ASTRAY_PX, 2 * ASTRAY_PX
"""Error of an edge that is a guess, less than that of a fit gone astray, since the motion still bounds it; and where
there is none: beyond LOST_SIGMA_PX of `point_quality`. Chosen; half or twice the first is the error of guesses."""
DOOR_COLUMNS, DOOR_FRAMES = (6, 10), 15
"""Columns from the start at which a door is looked for, the fewest of them that tell, and frames before the motion in
which it may swing. Chosen: clear of the tip's blur; at half of the frames slow doors are missed, at twice flicker
counts."""
DOOR_PART, DOOR_GREY = 0.25, 4.0
"""A column is changed by a door where its brightness varies by this part of the film's contrast and so many grey
levels. Chosen. By reasoning: at half noise counts as a door, at twice dark doors on dark ground do not."""

FEWEST_AT_REST = 3
"""Frames of rest from which a place is known. Chosen as in `point_quality`: two frames alike may be a slow start."""
MIDDLE_ROWS = 0.6
"""Part of the strip's rows, about its middle, that are the tube's whatever its sides do. Chosen: the strip is 1.15
times as high as the tube and 10 px more. By reasoning: at half few rows say whether the border is straight; with all of
them the background beside the tube says it is not."""
GAP_PX, SIDE_PX = 3, 6
"""Columns left out on either side of a border, for its blur, and those taken beyond. Chosen: blurs reach 3 px; six
columns average film's grain. At half of them grain decides, at twice a mouth near the strip's start is not seen."""
FILM_PX = (20, 150)
"""From and to how far beyond the border the film's own steps are taken. Chosen: clear of what is about the start, and a
few diameters of film. Half or twice changes the largest of them by its scatter."""
LOOKED_PX = 3
"""How far from the place of rest a border is looked for. Chosen: the edge at rest errs by less."""
STRAIGHT = 0.95
"""Part of the rows that must show the border with the same sign. Measured (tips seen at rest, laboratory and drawings
of other code, seeds 20410-20466): 0.94 at most in 36 recordings; 1.00 at six mouths (seed 20511)."""
STRONGEST = 2.0
"""The border against the largest step between neighbouring columns of film further on. Measured on the same: 1.6 at
most, and 2.6 at least at a mouth only 30 grey levels darker than the film."""
LEAST_PART = 0.5
"""The border against the film's contrast. Measured on the same: 0.36 at most, and 0.66 at least. By reasoning: at half,
backgrounds with strong marks count as mouths; at twice, a mouth as bright as the film is not seen."""
FRAMES_OUT = 5
"""Frames after the tip has come out by which speed and acceleration there are judged. Chosen: three numbers of a
parabola, and two frames more."""
LEAPS = 3.0
"""Change of the step, in the largest of the next four, from which hidden frames are not of the motion that follows.
Chosen: from rest steps grow evenly, and release between two frames makes one change 1.5 times the next. By reasoning:
at half such releases count as leaps, at twice a door that was followed passes for the tip."""
LEAST_LEAP_PX = ASTRAY_PX
"""The same at least. Chosen: what a guess may be off by. At half the noise of slow starts counts as a leap, at twice
small ones pass."""
SPEEDS_UP = 0.3
"""Gain of speed over the next four frames, in the step after a leap, from which a motion still speeds up. Chosen: force
and damping B·v^0.37 leave a third of the first acceleration at 0.3 of the final speed, so that a step reached within a
frame is followed by less. By reasoning: at half vines whose speed settles count as leaps, at twice some leaps pass."""


@dataclass(frozen=True)
class Mouth:
    """`before`, shape (n_frames,), marks frames in which the edge stands at a border that stays when the tip has gone.

    `moved_behind`: the tip comes out faster than a start from rest at that border allows; it was further back.
    """

    before: Bools
    moved_behind: bool


def find_mouth(strip: Strip, state: EdgeState, edge: Floats) -> Mouth:
    """Look for a border that stays where the edge rested.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.
    edge : shape (n_frames,), px; finite.

    Returns
    -------
    Mouth
    """
    none = Mouth(np.zeros(len(edge), dtype=bool), False)
    first = int(np.flatnonzero(moving_frames(state.edge))[0])
    if first < FEWEST_AT_REST:
        return none
    place = float(np.median(edge[:first]))
    gone = np.flatnonzero((edge > place + CLEAR_PX) & (np.arange(len(edge)) >= first))
    near = np.arange(round(place) - LOOKED_PX, round(place) + LOOKED_PX + 1)
    # Not where the tip, which is round, comes to rest.
    later = np.arange(near[-1] + FILM_PX[0], min(near[-1] + FILM_PX[1], int(edge.max() - CLEAR_PX)))
    if len(gone) < FEWEST_AT_REST or near[0] < GAP_PX + SIDE_PX or len(later) < FILM_PX[0]:
        return none
    film = _middle_picture(strip, gone)
    steps = np.stack([_border(film, int(column)) for column in near])
    strongest = steps[int(np.argmax(np.abs(np.median(steps, axis=1))))]
    size = float(np.median(strongest))
    usual = max(abs(float(np.median(_border(film, int(column))))) for column in later)
    contrast = np.abs((state.pictures[0] - state.pictures[1]).mean(axis=0))[later]
    straight = float(np.mean(np.sign(strongest) == np.sign(size)))
    if straight < STRAIGHT or abs(size) < max(STRONGEST * usual, LEAST_PART * float(np.median(contrast))):
        return none
    out = place + 3 * state.blur + 1
    leaves = first + int(np.argmax(edge[first:] > out))
    return Mouth(np.arange(len(edge)) < leaves, _moved_behind(edge[leaves : leaves + FRAMES_OUT], place))


def disturbed_start(strip: Strip, state: EdgeState) -> float:
    """Share of the columns before the start that change before the edge reaches them: a door swings there.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.

    Returns
    -------
    0 to 1.
    """
    begin, columns = state.edge[0], strip.values.shape[2]
    places = np.arange(int(begin) + DOOR_COLUMNS[0], min(int(begin + CLEAR_PX), columns - 1))
    moving = np.flatnonzero(moving_frames(state.edge))
    if len(places) < DOOR_COLUMNS[1] or moving[0] < 2:
        return 0.0
    first = max(0, int(moving[0]) - DOOR_FRAMES)
    rising = np.maximum.accumulate(state.edge)
    contrast = float(np.median(np.abs((state.pictures[0] - state.pictures[1]).mean(axis=0))))
    changed = 0
    for place in places:
        arrival = int(np.searchsorted(rising, place - 5.0))
        seen = strip.values[first : max(arrival - 1, first + 1), :, place].mean(axis=1)
        change = np.ptp(seen * strip.scale[first : first + len(seen)] + strip.offset[first : first + len(seen)])
        changed += change > max(DOOR_PART * contrast, DOOR_GREY)
    return changed / len(places)


def hidden_errors(fit: Floats, misfit_ratio: Floats, edge: Floats, apart: Floats) -> Floats:
    """Errors made larger where a door still stands before the tip.

    Then the edge is a guess, and none at all where the picture is quite another or hardly any contrast is left.

    Parameters
    ----------
    fit : from `edge_state.fit_edges`, shape (n_frames, 6).
    misfit_ratio : misfit over the usual one, shape (n_frames,).
    edge : shape (n_frames,), px.
    apart : what is to be added to the error in square, shape (n_frames,), px.

    Returns
    -------
    the same, larger where the tip is hidden, shape (n_frames,), px.
    """
    near = edge < clear_of_start(edge) + 0.5 * CLEAR_PX
    misfit, amplitude = fit[:, 2], 1 + fit[:, 3]
    other, odd = misfit > HIDDEN, misfit > HIDDEN / 2
    covered = near & (misfit_ratio > UNUSUAL) & ((misfit > SURELY_HIDDEN) | odd & (amplitude < PALE))
    if covered.sum() > 1:
        # A door leaves, it does not come: what stood before it was hidden too.
        earlier = np.arange(len(edge)) < int(np.flatnonzero(covered)[-1])
        covered |= earlier & moving_frames(edge)
        apart = np.where(earlier, np.hypot(apart, ASTRAY_PX), apart)
    guessed = near & (other & (misfit_ratio > HIDDEN) | odd & (misfit_ratio > UNUSUAL) & (amplitude < PARTLY_PALE))
    return np.where(covered, NO_EDGE_PX, np.where(guessed, np.hypot(apart, GUESSED_PX), apart))


def _middle_picture(strip: Strip, frames: NDArray[np.int_]) -> NDArray[np.float32]:
    """Median of the middle rows over some frames, grey levels freed of flicker: the moving tail averages out."""
    rows = strip.values.shape[1]
    edge_rows = round((1 - MIDDLE_ROWS) / 2 * rows)
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, 15).astype(int))]
    values = strip.values[chosen, edge_rows : rows - edge_rows].astype(np.float32)
    level = values * strip.scale[chosen, None, None] + strip.offset[chosen, None, None]
    return np.asarray(np.median(level, axis=0), dtype=np.float32)


def _border(picture: NDArray[np.float32], column: int) -> NDArray[np.float32]:
    """Step of each row across a column, shape (n_rows,)."""
    ahead = picture[:, column + GAP_PX : column + GAP_PX + SIDE_PX].mean(axis=1)
    behind = picture[:, column - GAP_PX - SIDE_PX : column - GAP_PX].mean(axis=1)
    return np.asarray(ahead - behind, dtype=np.float32)


def _moved_behind(edge: Floats, place: float) -> bool:
    """Whether a tip seen first at `edge` started further back than at `place`.

    From rest under the acceleration a that it has now, it would have come v²/2a: the speed it has, held against the way
    that is seen. As much again, and 5 px, are forgiven for an acceleration that falls.
    """
    if len(edge) < FRAMES_OUT:
        return False
    bend, speed, begin = np.polyfit(np.arange(FRAMES_OUT), edge, 2)
    run = speed**2 / (4 * bend) if bend > 0 else np.inf
    return bool(run > 2 * (begin - place) + 5)


def leap_error_px(edge: Floats, hidden: Bools) -> Floats:
    """How far hidden frames are from where the motion that follows comes from, if they do not lead up to it.

    What swings before the tip may be followed in its place, smoothly, until the tip comes out and the edge leaps to it.
    Back from the first frames that are not hidden, a step that differs from the one after it by more than LEAPS times
    what any of the next four do is such a leap, if these still speed up (SPEEDS_UP): a vine whose speed settles within
    a frame may set off like that, one that goes on speeding up was no faster to begin with. Before the leap the motion
    is followed back at their mean acceleration, no slower than rest, and the edge is off by as much as it differs.

    Parameters
    ----------
    edge : shape (n_frames,), px.
    hidden : frames in which something may hide the tip, mask (n_frames,).

    Returns
    -------
    shape (n_frames,), px; 0 where the edge leads up to the motion.
    """
    out = np.zeros(len(edge))
    if hidden.all():
        return out
    steps = np.diff(edge)
    bends = np.diff(steps)  # bends[t] is between the steps from t and from t + 1
    for t in range(int(np.argmin(hidden)) - 1, -1, -1):
        later = bends[t + 1 : t + FRAMES_OUT]
        if len(later) < FRAMES_OUT - 1 or not later.sum() > SPEEDS_UP * steps[t + 1]:
            continue
        if abs(bends[t]) <= max(LEAPS * np.abs(later).max(), LEAST_LEAP_PX):
            continue
        back = np.maximum(steps[t + 1] - max(float(later.mean()), 0.0) * np.arange(1, t + 2), 0.0)
        out[t::-1] = np.abs(edge[t::-1] - (edge[t + 1] - np.cumsum(back)))
        break
    return np.nan_to_num(out)
