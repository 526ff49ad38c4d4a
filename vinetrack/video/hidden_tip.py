"""Detect what hides the tip at the start: a door that stands or swings in front of it, or the mouth of a launcher.

A door leaves. While it hides the tip, the picture resembles neither film nor background, and the misfit shows it. A
mouth stays: its border with the background looks like a tip at rest while the tip moves behind it. What the tip leaves
behind tells the two apart: behind a tip that was seen at rest the film continues without a border; behind a tip that
came out of a mouth, the mouth's straight border stays where the edge rested.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.video.edge_repair import ASTRAY_PX
from vinetrack.video.edge_state import START_CLEARANCE_PX, EdgeState, clear_of_start, moving_frames
from vinetrack.video.strip import Strip

# Misfit, in units of the noise and as a ratio to the median, above which an object stands in front of the tip and the
# edge is a guess (chosen)
HIDDEN_MISFIT = 3.2
# Misfit above which nothing of the tip is visible, whatever its contrast (chosen)
COVERED_MISFIT = 1.12 * HIDDEN_MISFIT
# Ratio of the misfit to the median above which a frame differs from those clear of the start (chosen)
UNUSUAL_MISFIT_RATIO = 2.0
# Amplitude (contrast relative to that of the same pixels in other frames) below which too little of the edge is
# visible, and below which part of it is hidden (chosen)
LEAST_AMPLITUDE, REDUCED_AMPLITUDE = 0.6, 0.75
# Standard error of a guessed edge, smaller than that of a fit gone astray since the motion still bounds it
GUESSED_PX, NO_EDGE_PX = 0.7 * ASTRAY_PX, 2 * ASTRAY_PX
# First column after the start at which a door is looked for, the fewest columns that are conclusive (chosen)
DOOR_COLUMNS, DOOR_FRAMES = (6, 10), 15
# A door changes a column where its brightness varies by this part of the film's contrast and by so many grey levels
# (chosen)
DOOR_PART, DOOR_GREY = 0.25, 4.0

FEWEST_REST_FRAMES = 3  # Fewest frames of rest from which the resting place is known (chosen)
MIDDLE_ROWS = 0.6  # Part of the strip's rows, about its middle, that belong to the tube whatever its sides do (chosen)
# Columns left out on either side of a border, for its blur, and columns averaged beyond them (chosen)
BORDER_GAP_PX, BORDER_SIDE_PX = 3, 6
FILM_RANGE_PX = (20, 150)  # Distances beyond the border between which the film's own steps are taken (chosen)
SEARCH_PX = 3  # Distance from the resting place within which a border is looked for (chosen)
STRAIGHT_PART = 0.95  # Part of the rows that must show the border with the same sign (measured)
# Least ratio of the border to the largest step between neighbouring columns of film further on (measured)
BORDER_TO_FILM = 2.0
BORDER_TO_CONTRAST = 0.5  # Least ratio of the border to the film's contrast (measured)
FRAMES_AFTER_EXIT = 5  # Frames after the tip has come out from which its speed and acceleration are estimated (chosen)
# Ratio of a change of the step to the largest of the next four, above which the hidden frames do not belong to the
# motion that follows (chosen)
LEAP_RATIO = 3.0
LEAST_LEAP_PX = ASTRAY_PX  # Smallest change of the step that is a leap (chosen)
# Gain of speed over the next four frames (chosen)
SPEED_GAIN = 0.3


@dataclass(frozen=True)
class Mouth:
    """A launcher's mouth at the start. `before`, shape (n_frames,), marks the frames in which the edge stands at a
    border that stays after the tip has gone.
    """

    before: Bools
    moved_behind: bool


def find_mouth(strip: Strip, state: EdgeState, edge: Floats) -> Mouth:
    """Look for a straight border that stays where the edge rested. Shapes: edge (n_frames,)."""
    none = Mouth(np.zeros(len(edge), dtype=bool), False)
    first = int(np.flatnonzero(moving_frames(state.edge))[0])
    if first < FEWEST_REST_FRAMES:
        return none
    rest_px = float(np.median(edge[:first]))
    exited = np.flatnonzero((edge > rest_px + START_CLEARANCE_PX) & (np.arange(len(edge)) >= first))
    near = np.arange(round(rest_px) - SEARCH_PX, round(rest_px) + SEARCH_PX + 1)
    # Not where the tip comes to rest: it is round.
    later = np.arange(
        near[-1] + FILM_RANGE_PX[0], min(near[-1] + FILM_RANGE_PX[1], int(edge.max() - START_CLEARANCE_PX))
    )
    if len(exited) < FEWEST_REST_FRAMES or near[0] < BORDER_GAP_PX + BORDER_SIDE_PX or len(later) < FILM_RANGE_PX[0]:
        return none
    beside = BORDER_GAP_PX + BORDER_SIDE_PX
    film_picture = _middle_picture(strip, exited, slice(near[0] - beside, later[-1] + beside))
    near, film_columns = near - (near[0] - beside), later - (near[0] - beside)
    borders = _borders(film_picture)
    border_steps = borders[:, near - beside].T
    border = border_steps[int(np.argmax(np.abs(np.median(border_steps, axis=1))))]
    border_step = float(np.median(border))
    film_step = float(np.abs(np.median(borders[:, film_columns - beside], axis=0)).max())
    contrast = np.abs((state.appearance[0] - state.appearance[1]).mean(axis=0))[later]
    straight = float(np.mean(np.sign(border) == np.sign(border_step)))
    least_step = max(BORDER_TO_FILM * film_step, BORDER_TO_CONTRAST * float(np.median(contrast)))
    if straight < STRAIGHT_PART or abs(border_step) < least_step:
        return none
    clear_px = rest_px + 3 * state.blur + 1
    exit_frame = first + int(np.argmax(edge[first:] > clear_px))
    after_exit = edge[exit_frame : exit_frame + FRAMES_AFTER_EXIT]
    return Mouth(np.arange(len(edge)) < exit_frame, _moved_behind(after_exit, rest_px))


def disturbed_start(strip: Strip, state: EdgeState) -> float:
    """Share of the columns at the start that change before the edge reaches them: a door swings there."""
    begin, columns = state.edge[0], strip.values.shape[2]
    column_range = np.arange(int(begin) + DOOR_COLUMNS[0], min(int(begin + START_CLEARANCE_PX), columns - 1))
    moving = np.flatnonzero(moving_frames(state.edge))
    if len(column_range) < DOOR_COLUMNS[1] or moving[0] < 2:
        return 0.0
    first = max(0, int(moving[0]) - DOOR_FRAMES)
    rising = np.maximum.accumulate(state.edge)
    contrast = float(np.median(np.abs((state.appearance[0] - state.appearance[1]).mean(axis=0))))
    changed = 0
    for column in column_range:
        arrival = int(np.searchsorted(rising, column - 5.0))
        brightness = strip.values[first : max(arrival - 1, first + 1), :, column].mean(axis=1)
        frames = slice(first, first + len(brightness))
        change = np.ptp(brightness * strip.scale[frames] + strip.offset[frames])
        changed += change > max(DOOR_PART * contrast, DOOR_GREY)
    return changed / len(column_range)


def hidden_errors(fit: Floats, misfit_ratio: Floats, edge: Floats, added_px: Floats) -> Floats:
    """Enlarge the errors of frames in which a door still hides the tip. There the edge is a guess; where the picture
    differs entirely from the model, or hardly any contrast is left, there is no edge. Shapes: fit (n_frames, 6);
    misfit_ratio, edge, added_px (n_frames,) → (n_frames,).
    """
    near = edge < clear_of_start(edge) + 0.5 * START_CLEARANCE_PX
    misfit, amplitude = fit[:, 2], 1 + fit[:, 3]
    large, raised = misfit > HIDDEN_MISFIT, misfit > HIDDEN_MISFIT / 2
    no_edge = (misfit > COVERED_MISFIT) | raised & (amplitude < LEAST_AMPLITUDE)
    covered = near & (misfit_ratio > UNUSUAL_MISFIT_RATIO) & no_edge
    if covered.sum() > 1:
        # A door leaves and does not come: in earlier frames the tip was hidden too.
        earlier = np.arange(len(edge)) < int(np.flatnonzero(covered)[-1])
        covered |= earlier & moving_frames(edge)
        added_px = np.where(earlier, np.hypot(added_px, ASTRAY_PX), added_px)
    unlike_model = large & (misfit_ratio > HIDDEN_MISFIT)
    partly_hidden = raised & (misfit_ratio > UNUSUAL_MISFIT_RATIO) & (amplitude < REDUCED_AMPLITUDE)
    guessed = near & (unlike_model | partly_hidden)
    return np.where(covered, NO_EDGE_PX, np.where(guessed, np.hypot(added_px, GUESSED_PX), added_px))


def _middle_picture(strip: Strip, frames: NDArray[np.int_], columns: slice) -> NDArray[np.float32]:
    """Median of the middle rows over up to 15 of some frames, grey levels freed of flicker, in some columns. The moving
    tail averages out.
    """
    rows = strip.values.shape[1]
    edge_rows = round((1 - MIDDLE_ROWS) / 2 * rows)
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, 15).astype(int))]
    values = strip.values[chosen, edge_rows : rows - edge_rows, columns].astype(np.float32)
    level = values * strip.scale[chosen, None, None] + strip.offset[chosen, None, None]
    return np.asarray(np.median(level, axis=0), dtype=np.float32)


def _borders(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Step of brightness across each column, by row; the first column is BORDER_GAP_PX + BORDER_SIDE_PX. Shape (n_rows,
    n_columns).
    """
    sides = np.lib.stride_tricks.sliding_window_view(picture, BORDER_SIDE_PX, axis=1).mean(axis=2)
    apart = 2 * BORDER_GAP_PX + BORDER_SIDE_PX
    return np.asarray(sides[:, apart:] - sides[:, :-apart], dtype=np.float32)


def _moved_behind(edge: Floats, rest_px: float) -> bool:
    """Whether a tip first seen at `edge` started further back than at `rest_px`. From rest under its present
    acceleration a it would have come v²/2a, with v its present speed; this is compared with the distance from
    `rest_px`. As much again, and 5 px, are allowed for an acceleration that falls.
    """
    if len(edge) < FRAMES_AFTER_EXIT:
        return False
    half_acceleration, speed, start_px = np.polyfit(np.arange(FRAMES_AFTER_EXIT), edge, 2)
    run_up_px = speed**2 / (4 * half_acceleration) if half_acceleration > 0 else np.inf
    return bool(run_up_px > 2 * (start_px - rest_px) + 5)


def leap_error_px(edge: Floats, hidden: Bools) -> Floats:
    """Distance of hidden frames from the motion that follows, extrapolated backwards; 0 where they lead up to it. What
    swings in front of the tip may be followed in its place, smoothly, until the tip comes out and the edge leaps to it.
    Shapes: edge (n_frames,) → (n_frames,).
    """
    out = np.zeros(len(edge))
    if hidden.all():
        return out
    steps = np.diff(edge)
    bends = np.diff(steps)  # bends[t] is the change between the steps from t and from t + 1
    for t in range(int(np.argmin(hidden)) - 1, -1, -1):
        later = bends[t + 1 : t + FRAMES_AFTER_EXIT]
        if len(later) < FRAMES_AFTER_EXIT - 1 or not later.sum() > SPEED_GAIN * steps[t + 1]:
            continue
        if abs(bends[t]) <= max(LEAP_RATIO * np.abs(later).max(), LEAST_LEAP_PX):
            continue
        back = np.maximum(steps[t + 1] - max(float(later.mean()), 0.0) * np.arange(1, t + 2), 0.0)
        out[t::-1] = np.abs(edge[t::-1] - (edge[t + 1] - np.cumsum(back)))
        break
    return np.nan_to_num(out)
